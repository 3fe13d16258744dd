"""A walker that knows the true ground: it follows the shortest walkable way on the bare gait.

Not a policy, and no part of the project: with perfect knowledge it arrives in every unseen world,
which shows that what a policy fails there is not beyond the legs. `tests/worlds.py` scores it.
"""

import heapq
import math

import numpy as np

from terrain import CELL, Navigation


class Walker:
    """Plans once, then steers at a point of its way a little ahead. actions: (17,)."""

    def __init__(self, env):
        self.env = env
        self.nav = Navigation(env.terrain.heights, env.terrain.cell, env.terrain.climb)
        route = env.goal[0] - env.origin[0], env.goal[1]
        self.way = self._plan(route)

    def _plan(self, goal):
        """Cheapest way to the goal by Dijkstra: open, level ground before narrow or steep."""
        nav, (x, y, _) = self.nav, np.subtract(self.env.robot.position, self.env.origin)
        near, tight = ~nav.free, 0.0
        for _ in range(4):  # rings of 0.1 m around what is not free
            tight = tight + near
            near = near | np.roll(near, 1, 0) | np.roll(near, -1, 0) | np.roll(near, 1, 1)
            near |= np.roll(near, -1, 1)
        slope = np.hypot(*np.gradient(nav.z, CELL))
        cost = 1 + tight + 20 * np.clip(slope - 0.15, 0, 0.6)
        start, end = nav.cell(x, y), nav.cell(*goal)
        best, before, queue = {end: 0.0}, {}, [(0.0, end)]
        while queue:
            total, cell = heapq.heappop(queue)
            if cell == start:
                break
            if total > best[cell]:
                continue
            for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
                near = cell[0] + di, cell[1] + dj
                if not nav.free[near]:
                    continue
                new = total + math.hypot(di, dj) * (cost[cell] + cost[near]) / 2
                if new < best.get(near, math.inf):
                    best[near], before[near] = new, cell
                    heapq.heappush(queue, (new, near))
        way, cell = [start], start
        while cell in before:
            cell = before[cell]
            way.append(cell)
        return np.array([(nav.x[c], nav.y[c]) for c in way])

    def act(self):
        env, (x, y, _) = self.env, np.subtract(self.env.robot.position, self.env.origin)
        nearest = int(np.argmin(np.hypot(*(self.way - (x, y)).T)))
        to = self.way[min(nearest + 5, len(self.way) - 1)]
        turn = math.remainder(math.atan2(to[1] - y, to[0] - x) - env.robot.yaw, 2 * math.pi)
        action = np.zeros(17)
        forward = 0.21 * max(0.0, math.cos(turn)) ** 2
        for person in env.people:
            px, py, _ = person.place()
            ahead = math.cos(env.robot.yaw) * (px - x) + math.sin(env.robot.yaw) * (py - y)
            if 0 < ahead < 1.2 and math.hypot(px - x, py - y) < 1.2:
                forward = min(forward, 0.0)
        aside = 0.12 * min(max(1.2 * turn, -1.0), 1.0)
        action[1:3] = (np.array([forward - aside, forward + aside]) - 0.13) / 0.27
        tilt = math.acos(min(env.robot.turn[2, 2], 1.0))
        action[4] = -min(max(5 * (tilt - 0.1), 0.0), 0.95)
        return action
