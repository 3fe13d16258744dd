"""Terrain: pillar tasks to train on, unseen worlds to be judged in, and the meshes of both.

The paper (section 2.3) builds every training terrain from m x n pillars and changes only their
heights. Here a task is a function of at most ten lines, from a random generator and a difficulty
in [0, 1] to those heights. Mesh, starts and goals are made in the same way for all of them.

Frame: x runs along the m pillars from 0, y along the n pillars with 0 in the middle, z is up. All
lengths are in metres and all angles in radians unless a name says otherwise.
"""

import io
import re
from dataclasses import dataclass, field, replace
from itertools import pairwise
from numbers import Real
from pathlib import Path

import numpy as np

L = 0.2  # m, cross-section of a training pillar (the paper's l and w)
SHAPE = (60, 40)  # m x n pillars: 12 m x 8 m
CELL = 0.1  # m, navigation grid, and the cell of the worlds' floor plans
STEP = 0.2  # m, highest step that Laikago's feet clear: what training may ask for
LEVEL = 0.05  # m, highest step on a level way; most that a start may be uneven
PAD = 9  # pillars, depth of the flat strips at both ends, where most episodes start (1.8 m)
ROUTES = 8  # start and goal pairs per training terrain
MAX_VERTICES, MAX_INDICES = 131_072, 524_288  # what PyBullet takes in one mesh
DRAWS, TRIES = 60, 10  # of a layout, and of a start in it, before it is said to have no route

# ---------------------------------------------------------------- what a terrain is


@dataclass(eq=False)
class Person:
    """A human who walks to and fro along `path` (P, 2), m, and stops when the robot is in the way.

    speed: m/s. along: m, how far along the path the person is. waited: s, for the robot.
    """

    path: np.ndarray
    speed: float
    along: float = 0.0
    direction: int = 1  # or -1, on the way back
    waited: float = 0.0

    RADIUS, HEIGHT = 0.25, 1.7  # m, of the body
    CLEARANCE = 1.1  # m from the middle of the robot: half a metre between the two bodies
    PATIENCE = 3.0  # s of waiting, and then the person turns back

    def __post_init__(self):
        self.mileage = np.r_[0.0, np.cumsum(np.hypot(*np.diff(self.path, axis=0).T))]  # (P,)

    def place(self):
        """(x, y, yaw) at this moment."""
        x, y = (float(np.interp(self.along, self.mileage, self.path[:, k])) for k in (0, 1))
        leg = int(np.searchsorted(self.mileage[1:-1], self.along, side="right"))
        dx, dy = (self.path[leg + 1] - self.path[leg]) * self.direction
        return x, y, float(np.arctan2(dy, dx))

    def walk(self, dt, robot):
        """The next `dt` s. robot: its (x, y)."""
        x, y, yaw = self.place()
        dx, dy = robot[0] - x, robot[1] - y
        if np.hypot(dx, dy) < self.CLEARANCE and dx * np.cos(yaw) + dy * np.sin(yaw) > 0:
            self.waited += dt
            if self.waited > self.PATIENCE:
                self.direction, self.waited = -self.direction, 0.0
            return
        self.waited = 0.0
        self.along += self.direction * self.speed * dt
        if not 0 <= self.along <= self.mileage[-1]:  # an end of the path
            self.along = float(np.clip(self.along, 0, self.mileage[-1]))
            self.direction = -self.direction


@dataclass(frozen=True, eq=False)
class Terrain:
    """One place to walk in: a mesh, routes over it, and heights, which the robot never reads.

    An episode draws one k: it begins at `starts[k]`, mostly facing its own goal, `goals[k]`.
    """

    name: str
    vertices: np.ndarray  # (V, 3) m
    triangles: np.ndarray  # (F, 3) int, counter-clockwise seen from outside
    starts: np.ndarray  # (K, 4) x, y, ground z, yaw
    goals: np.ndarray  # (K, 3) x, y, ground z
    heights: np.ndarray  # (m, n) m, on cells of `cell` m
    cell: float
    climb: float = STEP  # m, highest step on the way to a goal
    friction: float = 1.0  # of the ground, Bullet's coefficient
    people: list[Person] = field(default_factory=list)

    def height(self, x, y):
        """Height of the ground at any places, m; -inf outside."""
        m, n = self.heights.shape
        i, j = np.floor(np.divide(x, self.cell)), np.floor(np.divide(y, self.cell) + n / 2)
        inside = (i >= 0) & (i < m) & (j >= 0) & (j < n)
        i, j = (np.where(inside, k, 0).astype(int) for k in (i, j))
        return np.where(inside, self.heights[i, j], -np.inf)


# ---------------------------------------------------------------- meshes: (vertices, triangles)


def join(meshes):
    """One mesh from several."""
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in meshes[:-1]])
    triangles = [t + offset for (_, t), offset in zip(meshes, offsets, strict=True)]
    return np.concatenate([v for v, _ in meshes]), np.concatenate(triangles).astype(np.int32)


def _runs(a, b):
    """Where rows of a and b (m, n) keep unequal values: row, first, last (exclusive), values."""
    change = np.any([np.diff(side, axis=1, prepend=np.nan) != 0 for side in (a, b)], 0)
    begin = np.flatnonzero(change)  # every row begins a run
    row, first = np.divmod(begin, a.shape[1])
    last = first + np.diff(begin, append=a.size)
    z0, z1 = a.ravel()[begin], b.ravel()[begin]
    return (part[z0 != z1] for part in (row, first, last, z0, z1))


def fuse_pillars(heights, cell):
    """Mesh of m x n pillars without the faces that cannot be seen (section 2.3).

    One mesh is simulated and scanned many times faster than 2,400 boxes. Equal neighbours along y
    share a top, equal steps along an edge share a wall. The outer border is open.

    heights: (m, n) m. cell: m, the pillars' cross-section.
    Returns vertices (V, 3) m and triangles (F, 3), counter-clockwise from outside.
    """
    middle = heights.shape[1] / 2
    i, first, last, z, _ = _runs(heights, heights - 1)  # every pillar has a top
    x0, x1, y0, y1 = i * cell, (i + 1) * cell, (first - middle) * cell, (last - middle) * cell
    tops = (x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)
    # The corners turn round with the sign of z0 - z1: each wall faces its lower side by itself.
    i, first, last, z0, z1 = _runs(heights[:-1], heights[1:])
    x, y0, y1 = (i + 1) * cell, (first - middle) * cell, (last - middle) * cell
    across = (x, y0, z1), (x, y1, z1), (x, y1, z0), (x, y0, z0)
    j, first, last, z0, z1 = _runs(heights[:, :-1].T, heights[:, 1:].T)
    x0, x1, y = first * cell, last * cell, (j + 1 - middle) * cell
    along = (x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)
    vertices = np.concatenate([tops, across, along], 2).transpose(2, 0, 1).reshape(-1, 3)
    first = 4 * np.arange(len(vertices) // 4)[:, None]
    return vertices, (first + [0, 1, 2, 0, 2, 3]).reshape(-1, 3).astype(np.int32)


def check_size(name, vertices, triangles):
    """Raises ValueError if PyBullet does not take a mesh, for it would not say why."""
    if len(vertices) > MAX_VERTICES or triangles.size > MAX_INDICES:
        raise ValueError(f"{name} is too large for PyBullet: {len(vertices)} vertices (at most "
                         f"{MAX_VERTICES}), {triangles.size} indices (at most {MAX_INDICES})")


def triangulate(nodes, cell):
    """Continuous mesh through (m + 1) x (n + 1) nodes, m, on squares of `cell` m."""
    i, j = np.indices(nodes.shape)
    n = nodes.shape[1]
    vertices = np.stack([i * cell, (j - (n - 1) / 2) * cell, nodes], -1).reshape(-1, 3)
    corner = (i * n + j)[:-1, :-1].reshape(-1, 1)  # of each square, at the least x and y
    return vertices, np.concatenate([corner + [0, n, n + 1], corner + [0, n + 1, 1]])


def prism(polygon, bottom, top):
    """Closed mesh of an upright prism over a convex polygon (K, 2), counter-clockwise."""
    k = len(polygon)
    vertices = np.r_[np.c_[polygon, np.full(k, bottom)], np.c_[polygon, np.full(k, top)]]
    i, j = np.arange(k), np.roll(np.arange(k), -1)
    fan = np.c_[np.zeros(k - 2, int), i[1:-1], i[2:]]
    walls = np.r_[np.c_[i, j, j + k], np.c_[i, j + k, i + k]]
    return vertices, np.r_[walls, fan + k, fan[:, ::-1]]


# ---------------------------------------------------------------- navigation


def _window(a, radius, pick):
    """`pick` (np.max or np.min) over the square of +-`radius` cells around each cell."""
    for _ in range(2):  # along x, and turned, along y
        padded = np.pad(a, [(radius, radius), (0, 0)], "edge")
        a = pick(np.lib.stride_tricks.sliding_window_view(padded, 2 * radius + 1, 0), -1).T
    return a


class Navigation:
    """Where a robot can be, on a grid of CELL over heights (m, n) on cells of `cell` m.

    All arrays are (nx, ny). x, y, z: cell centres, m. free: a disc of 0.25 m radius meets no step
    above `climb` (m) there. stand: free, level within LEVEL, no wall within 0.5 m. solid: not a
    hole. Holes up to 0.2 m across count as filled: legs step over those.
    """

    def __init__(self, heights, cell, climb):
        nx, ny = (max(round(n * cell / CELL), 3) for n in heights.shape)
        i, j = np.indices((nx, ny))
        self.x, self.y = (i + 0.5) * CELL, (j + 0.5 - ny / 2) * CELL
        # Of k x k places in a cell the highest counts: its middle alone would miss thin pillars.
        k = int(np.ceil(CELL / cell))
        rows, columns = (((np.arange(k * n) + 0.5) / k * CELL / cell).astype(int) for n in (nx, ny))
        fine = heights.take(rows, 0, mode="clip").take(columns, 1, mode="clip")
        self.z = z = fine.reshape(nx, k, ny, k).max((1, 3))
        filled = _window(_window(z, 1, np.max), 1, np.min)
        self.solid = z > filled - 0.02
        edge = np.ones(z.shape, bool)
        edge[1:-1, 1:-1] = False
        for shift in ((1, 0), (0, 1), (1, 1), (1, -1)):  # what wraps round lands on the edge
            step = np.abs(filled - np.roll(filled, shift, (0, 1))) > climb * np.hypot(*shift) + 1e-6
            edge |= step | np.roll(step, np.negative(shift), (0, 1))
        self.free = ~_window(edge, 1, np.max)
        self.stand = self.free & (_window(z, 5, np.max) - _window(z, 5, np.min) <= LEVEL)

    def cell(self, x, y):
        """Index (i, j) of the free cell nearest to a place."""
        far = np.where(self.free, np.hypot(self.x - x, self.y - y), np.inf)
        return np.unravel_index(np.argmin(far), far.shape)

    def distance(self, cell):
        """Length of the shortest free way from `cell` to every cell, m; inf where there is none.

        Every other step may also be diagonal; times 1.056, lengths are right to 6 %.
        """
        steps = np.where(self.free, np.inf, -1).ravel()  # outermost cells are never free
        row = self.free.shape[1]
        straight = np.array([-row, -1, 1, row])
        near = straight, np.r_[straight, -row - 1, -row + 1, row - 1, row + 1]
        front, count, last = np.array([cell[0] * row + cell[1]]), 0, np.zeros(steps.size, int)
        while front.size:
            steps[front] = count
            count += 1
            around = (front[:, None] + near[count % 2]).ravel()
            front = around[steps[around] == np.inf]
            last[front] = number = np.arange(front.size)  # each cell once: np.unique would sort
            front = front[last[front] == number]
        return np.where(self.free, steps.reshape(self.free.shape) * CELL * 1.056, np.inf)

    def way(self, start, goal):
        """Shortest free way between two cells, (P, 2) m; None if there is none."""
        far, cell = self.distance(goal), start
        path = [cell]
        while 0 < far[cell] < np.inf:
            i, j = cell
            around = [(i + a, j + b) for a in (0, -1, 1) for b in (0, -1, 1)]
            cell = min(around, key=far.__getitem__)
            path.append(cell)
        return np.array([(self.x[c], self.y[c]) for c in path]) if far[cell] == 0 else None


def _pick(rng, mask):
    """A random True cell of `mask` as (i, j), or None."""
    cells = np.argwhere(mask)
    return tuple(cells[rng.integers(len(cells))]) if len(cells) else None


def find_routes(nav, rng, count, reach, detour=(0, np.inf), zones=((0, np.inf),), margin=0.5,
                floor=-np.inf):
    """`count` starts (K, 4) and goals (K, 3), as in Terrain; None if there are none.

    Start k lies in the k-th of `zones` (ranges of x, taken in turn). Its goal lies `reach` =
    (least, most) metres away, measured straight; the shortest way is `detour` = (least, most) times
    as long. Both keep `margin` m from the border and lie above `floor` (m).
    """
    length, width = np.array(nav.free.shape) * CELL
    inside = (np.abs(nav.x - length / 2) <= length / 2 - margin) & (nav.z >= floor)
    inside &= np.abs(nav.y) <= width / 2 - margin
    starts, goals = [], []
    for k in range(count):
        low, high = zones[k % len(zones)]
        for _ in range(TRIES):
            s = _pick(rng, nav.stand & inside & (nav.x >= low) & (nav.x <= high))
            if s is None:
                return None
            far = np.hypot(nav.x - nav.x[s], nav.y - nav.y[s])
            way = nav.distance(s) / np.maximum(far, CELL)
            goal = inside & nav.solid & np.isfinite(way) & (detour[0] <= way) & (way <= detour[1])
            g = _pick(rng, goal & (reach[0] <= far) & (far <= reach[1]))
            if g is not None:
                break
        else:
            return None
        yaw = np.arctan2(nav.y[g] - nav.y[s], nav.x[g] - nav.x[s])
        starts.append((nav.x[s], nav.y[s], nav.z[s], yaw))
        goals.append((nav.x[g], nav.y[g], nav.z[g]))
    return np.array(starts), np.array(goals)


# ---------------------------------------------------------------- the training tasks


def _grid(cell=L):
    """Pillar centres x, y in m, and u, the way into the task, in m.

    u is 0 up to the edge of the flat strip where episodes start, then grows to SPAN: whatever
    depends on u alone meets both strips without a step.
    """
    i, j = np.indices((round(SHAPE[0] * L / cell), round(SHAPE[1] * L / cell)))
    x, y = (i + 0.5) * cell, (j + 0.5) * cell - SHAPE[1] * L / 2
    return x, y, np.clip(x, PAD * L, (SHAPE[0] - PAD) * L) - PAD * L


X, Y, U = _grid()
SPAN = U.max()  # m, 8.4


def _barrier(difficulty):
    """Height of a wall or depth of a drop, m: a step up to difficulty 0.05, 1.2 m from 0.3 on."""
    return min(1.2, 4 * difficulty)


def _boxes(rng, count, size, height):
    """`count` boxes of `size` = (least, most) pillars a side and `height` = (least, most) m."""
    h = np.zeros(SHAPE)
    for _ in range(int(count)):
        i, j = rng.integers(PAD, SHAPE[0] - PAD), rng.integers(SHAPE[1])
        a, b = rng.integers(size[0], size[1] + 1, 2)
        h[i : i + a, j : j + b] = rng.uniform(*height)
    return h


def _tracks(rng, difficulty):
    """Mask of two tracks from end to end, 2 m down to 1 m wide, with 1 to 4 right-angled bends."""
    half, bends = (2.0 - difficulty) / 2, 1 + round(3 * difficulty)
    track = (U == 0) | (U == SPAN)
    for _ in range(2):
        xs = np.r_[0, PAD * L + SPAN * (np.arange(bends) + rng.uniform(0.3, 0.7)) / bends, 12]
        ys = rng.uniform(-2.6, 2.6, bends + 2)
        for (x0, x1), (y0, y1) in zip(pairwise(xs), pairwise(ys), strict=True):
            track |= (np.abs(Y - y0) <= half) & (X >= x0 - half) & (X <= x1 + half)
            across = np.abs(Y - (y0 + y1) / 2) <= abs(y1 - y0) / 2 + half
            track |= (np.abs(X - x1) <= half) & across
    return track


def flat(rng, difficulty):
    """Level ground at every difficulty."""
    return np.zeros(SHAPE)


def rugged(rng, difficulty):
    """Every pillar's height uniform in [0, 0.18 m] (paper figure 3b)."""
    return rng.uniform(0, 0.18 * difficulty, SHAPE)


def holes(rng, difficulty):
    """Up to a fifth of the pillars missing."""
    return np.where(rng.random(SHAPE) < 0.2 * difficulty, -1.0, 0.0)


def obstacles(rng, difficulty):
    """Up to 45 boxes of 0.2-0.8 m a side, 0.3-1 m tall, to walk around (paper figure 3a)."""
    return _boxes(rng, 45 * difficulty, (1, 4), (0.3, 1.0))


def stairs(rng, difficulty):
    """Flights up and down, 3 to 7 steps of up to 0.18 m, treads of 0.4 or 0.6 m."""
    n = rng.integers(3, 8)
    flight = np.r_[np.arange(n), [n] * rng.integers(2, 5), np.arange(n)[::-1], [0] * 2]
    tread = rng.choice([0.4, 0.4, 0.6])
    return 0.18 * difficulty * np.resize(flight, 99)[(U / tread + 1e-6).astype(int)]


def slopes(rng, difficulty):
    """A ridge or a valley across the way, up and down at up to 28 degrees, to 1.6 m high."""
    _, _, u = _grid(slopes.cell)
    up, down = rng.uniform(1.5, 3.0, 2)
    steep = np.radians(min(40 * difficulty, 28) * rng.uniform(0.75, 1))
    top = np.tan(steep) * min(up, down)
    a, b = np.sort(rng.uniform(up, SPAN - down, 2))
    return rng.choice([-1, 1]) * np.interp(u, [a - up, a, b, b + down], [0, top, top, 0])


def ridges(rng, difficulty):
    """Up to 10 ridges, 1-4 m wide and up to 1 m high, with flanks of up to 50 degrees."""
    x, y, _ = _grid(ridges.cell)
    h = np.zeros(x.shape)
    for _ in range(round(10 * difficulty)):
        x0, y0, half = rng.uniform((2.5, -4, 0.5), (9.5, 4, 2.0))
        top, degrees = rng.uniform((0.3, 20), (1.0, 50)) * difficulty
        flanks = top - np.tan(np.radians(degrees)) * np.abs(x - x0)
        h = np.where(np.abs(y - y0) <= half, np.maximum(h, flanks), h)
    return h


def hills(rng, difficulty):
    """Twelve round hills and hollows, 1.5-3.5 m across, with flanks of up to 38 degrees each."""
    x, y, u = _grid(hills.cell)
    h = np.zeros(x.shape)
    for _ in range(12):
        radius, steep = rng.uniform(0.75, 1.75), np.tan(np.radians(38 * difficulty))
        far = np.hypot(x - rng.uniform(2, 10), y - rng.uniform(-4, 4)) / radius
        bump = 0.64 * radius * np.cos(np.pi / 2 * far.clip(0, 1)) ** 2  # steepest: 1
        h += rng.choice([-1, 1]) * rng.uniform(0.5, 1) * steep * bump
    return h * np.clip(np.minimum(u, SPAN - u) / 1.2, 0, 1)


def pyramids(rng, difficulty):
    """Seven stepped pyramids, or pits, of 2 to 5 steps of up to 0.18 m, treads of 0.4 m."""
    level = np.zeros(SHAPE)
    for x, y in zip(rng.uniform(3, 9, 7), rng.uniform(-4, 4, 7), strict=True):
        ring = np.maximum(np.abs(X - x), np.abs(Y - y)) / 0.4
        level = np.maximum(level, np.floor(np.clip(rng.integers(3, 7) - ring, 0, None)))
    level = np.minimum(level, np.floor(np.minimum(U, SPAN - U) / 0.4 + 1e-6))
    return rng.choice([-1, 1]) * 0.18 * difficulty * level


def bars(rng, difficulty):
    """Up to 8 bars, or trenches, across the way, 0.2 m wide: 0.2 m high, or 0.8 m deep."""
    rows = PAD + 1 + 3 * rng.permutation((SHAPE[0] - 2 * PAD) // 3)[: 2 + round(6 * difficulty)]
    h = np.zeros(SHAPE)
    h[rows] = rng.choice([0.2, -0.8]) * difficulty
    return h


def pits(rng, difficulty):
    """Up to 14 pits of 0.6-2.4 m a side, to walk around."""
    deep = _barrier(difficulty)
    return -_boxes(rng, 14 * difficulty, (3, 12), (0.5 * deep, deep))


def causeways(rng, difficulty):
    """Two paths with right-angled bends over a drop."""
    return np.where(_tracks(rng, difficulty), 0.0, -_barrier(difficulty))


def corridors(rng, difficulty):
    """Two corridors with right-angled bends cut through a solid wall."""
    return np.where(_tracks(rng, difficulty), 0.0, _barrier(difficulty))


def walls(rng, difficulty):
    """Slalom: up to 5 walls across, each with openings of 2 m down to 1 m somewhere else."""
    h = np.zeros(SHAPE)
    for row in np.linspace(PAD + 3, SHAPE[0] - PAD - 4, 1 + round(4 * difficulty)).astype(int):
        gap = (Y[0] + rng.uniform(0, 4)) % (2.6 + 1.4 * difficulty) < 2.0 - difficulty
        h[row] = np.where(gap, 0.0, _barrier(difficulty))
    return h


def screens(rng, difficulty):
    """Up to 20 free-standing walls of 0.8-3 m, along and across the way."""
    h = np.zeros(SHAPE)
    for _ in range(round(20 * difficulty)):
        i, j, long = rng.integers(PAD, SHAPE[0] - PAD), rng.integers(SHAPE[1]), rng.integers(4, 16)
        wall = np.s_[i, j : j + long] if rng.random() < 0.6 else np.s_[i : i + long, j]
        h[wall] = _barrier(difficulty)
    return h


def traps(rng, difficulty):
    """Up to 6 dead ends to walk out of, 1.4-3 m wide and 0.6-1.6 m deep, open to either end."""
    h = np.zeros(SHAPE)
    for _ in range(round(6 * difficulty)):
        i, j = rng.integers(PAD + 8, SHAPE[0] - PAD - 8), rng.integers(1, SHAPE[1] - 16)
        wide, deep = rng.integers(7, 16), rng.choice([-1, 1]) * rng.integers(3, 9)
        sides = slice(min(i, i + deep), max(i, i + deep) + 1)
        h[i, j : j + wide] = h[sides, j] = h[sides, j + wide - 1] = _barrier(difficulty)
    return h


def poles(rng, difficulty):
    """Up to 80 poles 7 cm thick and 0.4-1.2 m tall."""
    x, y, u = _grid(poles.cell)
    pole = (rng.random(x.shape) < 80 * difficulty / x.size) & (u > 0) & (u < SPAN)
    return np.where(pole, rng.uniform(0.4, 1.2, x.shape), 0.0)


# With these frictions the level tops of low pillars are about as slippery as smooth ground with 1:
# an upright trot slips from some 20 degrees on, a crouched one from some 30.
slopes.cell = ridges.cell = L / 8  # m
slopes.friction = ridges.friction = 0.75
hills.cell, hills.friction = L / 2, 0.5
poles.cell = L / 3
ridges.climb = hills.climb = 0.05  # m: the way leads round flanks steeper than 27 degrees
for _task in (obstacles, poles, corridors, walls, screens, traps):
    _task.fence = True  # walls all around: exploring along a wall must not lead off the border

PILLAR_TASKS = {task.__name__: task for task in (
    flat, rugged, holes, obstacles, stairs, slopes, hills, pyramids, bars, pits, causeways,
    corridors, walls, screens, traps, poles, ridges)}


def make_terrain(task, rng, difficulty):
    """A terrain to train on (section 2.3): pillars, their mesh, and ROUTES routes of 6-9 m.

    task: a name in PILLAR_TASKS, a function (rng, difficulty) -> heights (m, n) in m, or a
    finished Terrain, which is returned as it is. rng: numpy Generator; difficulty: in [0, 1].
    A function may have attributes: `cell`, m, the pillars' cross-section if it is not L; `climb`,
    m, the highest step on a way if it is not STEP; `friction`, if it is not 1; `fence`, walls along
    the border.
    Raises ValueError for an unknown task, a difficulty outside [0, 1], a bad attribute, heights not
    finite, not 2-D or too many for PyBullet, and a task without a route in DRAWS draws.
    """
    if isinstance(task, Terrain):
        return task
    if not callable(task) and task not in PILLAR_TASKS:
        raise ValueError(f"unknown task {task!r}; valid tasks: {', '.join(PILLAR_TASKS)}")
    if not 0 <= difficulty <= 1:
        raise ValueError(f"difficulty must be in [0, 1], got {difficulty}")
    generate = task if callable(task) else PILLAR_TASKS[task]
    name, cell = getattr(generate, "__name__", "terrain"), getattr(generate, "cell", L)
    climb, friction = getattr(generate, "climb", STEP), getattr(generate, "friction", 1.0)
    for what, value in (("cell", cell), ("climb", climb), ("friction", friction)):
        if not isinstance(value, Real) or not 0.02 <= value <= 10:
            raise ValueError(f"task {name!r}: {what} must be from 0.02 to 10, got {value!r}")
    for _ in range(DRAWS):
        heights = np.array(generate(rng, difficulty), float)
        if heights.ndim != 2 or not heights.size or not np.isfinite(heights).all():
            raise ValueError(f"task {name!r}: heights must be finite and 2-D, got {heights.shape}")
        pad = round(PAD * L / cell)
        for strip in (heights[:pad], heights[-pad:]):  # level, for episodes to start there
            strip[:] = np.median(strip)
        if getattr(generate, "fence", False):
            heights[[0, -1]] = heights[:, [0, -1]] = _barrier(difficulty)
        length = len(heights) * cell
        # From either end, in turn with wherever else a robot can stand: in a corridor, say.
        zones = (1.0, PAD * L), (length - PAD * L, length - 1.0), (0.0, length)
        routes = find_routes(Navigation(heights, cell, climb), rng, ROUTES, (min(6, length / 2), 9),
                             zones=zones, margin=1.0)
        if routes:
            # Some begin with their back to the goal: what lies behind it is worth a look, too.
            routes[0][2::3, 3] += rng.uniform(-np.pi, np.pi, len(routes[0][2::3]))
            mesh = fuse_pillars(heights, cell)
            check_size(name, *mesh)
            return Terrain(name, *mesh, *routes, heights, cell, climb, friction)
    raise ValueError(f"task {name!r} gave no walkable route in {DRAWS} draws of {heights.shape}")


# ---------------------------------------------------------------- the unseen worlds


def _interpolate(nodes, x, y):
    """Values (X, Y) of a grid of nodes at places x, y (1-D, in nodes) between them, eased."""
    weights = []
    for at, n in ((x, nodes.shape[0]), (y, nodes.shape[1])):
        low = np.minimum(at.astype(int), n - 2)
        part = (at - low)[:, None]
        ease = part * part * (3 - 2 * part)
        weights.append(np.eye(n)[low] * (1 - ease) + np.eye(n)[low + 1] * ease)
    return weights[0] @ nodes @ weights[1].T


def _fractal(rng, size, coarse, octaves, degrees):
    """Heights at the corners of CELLs over `size` m; 5 % of it is steeper than `degrees`.

    coarse: m between the nodes of the first octave; each later one is twice as fine and 2.6 times
    as low. A level spot of 0.9 m radius is made where x is small, to start from.
    """
    m, n = (round(side / CELL) + 1 for side in size)
    h, x, y = np.zeros((m, n)), np.arange(m) * CELL, np.arange(n) * CELL
    for k in range(octaves):
        fine = coarse / 2**k
        nodes = rng.uniform(-1, 1, (int(x[-1] / fine) + 2, int(y[-1] / fine) + 2))
        h += _interpolate(nodes, x / fine, y / fine) / 2.6**k
    h *= np.tan(np.radians(degrees)) / np.percentile(np.hypot(*np.gradient(h, CELL)), 95)
    i, j = rng.integers(15, 26), rng.integers(20, n - 20)
    far = np.hypot.outer(x - x[i], y - y[j])
    return h[i, j] + (h - h[i, j]) * np.clip((far - 0.9) / 1.2, 0, 1)


def _surface(corners):
    """(plan, meshes) of ground through the corners of CELLs, (m + 1, n + 1) m, in 0.2 m squares."""
    plan = (corners[1:, 1:] + corners[:-1, :-1]) / 2
    return plan, [triangulate(corners[::2, ::2], 2 * CELL)]


def _put(plan, polygon, bottom, top):
    """Mesh of an upright prism over a convex polygon (K, 2); it is entered in the plan, too."""
    i, j = np.indices(plan.shape)
    x, y = (i + 0.5) * CELL, (j + 0.5 - plan.shape[1] / 2) * CELL
    inside = np.ones(plan.shape, bool)  # or half a cell outside
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        across = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
        inside &= across >= -CELL / 2 * np.hypot(bx - ax, by - ay)
    plan[inside] = np.maximum(plan[inside], top)
    return prism(polygon, bottom, top)


def maze(rng, opened, corridor):
    """Walls 1.3 m tall and 0.1 m thick around corridors `corridor` m wide, 7 x 5 of them.

    opened: share of the walls between corridors that are left out.
    """
    wide = round(corridor / CELL) + 1  # in CELLs, with a wall
    plan = np.zeros((7 * wide + 1, 5 * wide + 1))
    plan[::wide] = plan[:, ::wide] = 1.3
    for view in (plan, plan.T):
        for i in range(wide, len(view) - 1, wide):
            for j in range(1, view.shape[1], wide):
                if rng.random() < opened:
                    view[i, j : j + wide - 1] = 0.0
    return plan, [fuse_pillars(plan, CELL)]


def mountain(rng, faces, degrees):
    """Fractal slopes, 5 % of them steeper than `degrees`, strewn with 20 rocks: 14 x 10 m.

    faces: how many rock faces, 1-3 m long and 0.5-1 m tall, stand there to be walked around.
    """
    plan, meshes = _surface(_fractal(rng, (14.0, 10.0), 5.0, 4, degrees))
    for k in range(faces + 20):
        long = rng.uniform(1, 3) if k < faces else rng.uniform(0.2, 0.5)
        tall = rng.uniform(0.5, 1.0) if k < faces else rng.uniform(0.1, 0.4)
        middle, turn = rng.uniform((3.3, -4.5), (13.5, 4.5)), rng.uniform(0, np.pi)
        along = np.array([np.cos(turn), np.sin(turn)]) * long / 2
        aside = np.array([-np.sin(turn), np.cos(turn)]) * rng.uniform(0.1, 0.25)
        polygon = middle + np.array([-along - aside, along - aside, along + aside, aside - along])
        foot = plan[tuple((middle / CELL + (0, 50)).astype(int))]
        meshes.append(_put(plan, polygon, foot - 1.0, foot + tall))
    return plan, meshes


def forest(rng, trunks):
    """Ground with bumps of 0.1 m and so many trunks, 0.16-0.4 m thick: 12 x 10 m."""
    bumps = rng.uniform(-0.07, 0.07, (25, 21))
    corners = _interpolate(bumps, np.arange(121) / 5, np.arange(101) / 5)
    plan, meshes = _surface(corners)
    turn = 2 * np.pi * np.arange(9)[:, None] / 9
    for _ in range(trunks):
        radius, middle = rng.uniform(0.08, 0.2), rng.uniform((0.3, -4.7), (11.7, 4.7))
        polygon = middle + radius * np.hstack([np.cos(turn), np.sin(turn)])
        meshes.append(_put(plan, polygon, -0.2, 2.0))
    return plan, meshes


def cliff(rng, swing):
    """A path 1.0-1.5 m wide that winds along 13 m, uneven by 2 cm, over a drop of 1.2 m.

    swing: m, how far the path winds to either side, on average.
    """
    i, j = np.indices((130, 100))
    x, y = (i + 0.5) * CELL, (j - 49.5) * CELL
    phase, bulge = rng.uniform(0, 2 * np.pi, 2)
    k, swing = 2 * np.pi / rng.uniform(5, 8), swing * rng.uniform(0.7, 1.3)
    width = 1.25 + 0.25 * np.sin(rng.uniform(0.5, 1.5) * x + bulge)
    across = np.abs(y - swing * np.sin(k * x + phase))  # along y; divided, at right angles to it
    across /= np.hypot(1, swing * k * np.cos(k * x + phase))
    uneven = np.kron(rng.uniform(-0.02, 0.02, (33, 25)), np.ones((4, 4)))[:130]
    plan = np.where(across <= width / 2, uneven, -1.2)
    for end in (1.5, 11.5):  # a place to stand, and one to arrive
        plan[np.hypot(x - end, y - swing * np.sin(k * end + phase)) <= 0.9] = 0.0
    return plan, [fuse_pillars(plan, CELL)]


def continuous(rng, degrees):
    """A smooth random surface of triangles, 5 % of it steeper than `degrees`: 13 x 10 m."""
    return _surface(_fractal(rng, (13.0, 10.0), 3.0, 2, degrees))


def _doorway(rng, wall):
    """Opens a doorway of 0.9 or 1.0 m somewhere in a wall's cells (a view of a plan)."""
    wide = rng.integers(9, 11)
    at = rng.integers(3, len(wall) - wide - 2)
    wall[at : at + wide] = 0.0


def _furnish(rng, plan, furniture):
    """(plan, meshes) of walls with so many pieces of furniture where nothing stood.

    A cupboard, 1.8 m tall, is solid. Desks, 0.75 m, and stools, 0.45 m, stand on legs of 5 cm: the
    LiDAR looks through below them.
    """
    meshes = [fuse_pillars(plan, CELL)]
    for _ in range(furniture):
        a, b, tall = [(4, 8, 1.8), (7, 14, 0.75), (4, 4, 0.45)][rng.integers(3)]
        a, b = (a, b) if rng.random() < 0.5 else (b, a)
        i, j = rng.integers(2, plan.shape[0] - a - 1), rng.integers(2, plan.shape[1] - b - 1)
        if plan[i - 1 : i + a + 1, j - 1 : j + b + 1].any():
            continue
        plan[i : i + a, j : j + b] = tall
        corner = np.array([i, j - plan.shape[1] / 2]) * CELL
        square, size = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]), np.array([a, b]) * CELL
        meshes.append(prism(corner + square * size, 0.0 if tall > 1 else tall - 0.04, tall))
        for leg in square if tall < 1 else ():
            meshes.append(prism(corner + leg * (size - 0.05) + square * 0.05, 0.0, tall - 0.04))
    return plan, meshes


def office1(rng, furniture):
    """Furnished rooms, 2.7-7.1 m long, on both sides of a corridor 1.6 m wide: 14 x 9.6 m."""
    plan = np.zeros((141, 97))
    plan[[0, -1]] = plan[:, [0, -1]] = 2.5
    for wall, side in ((40, slice(1, 40)), (57, slice(58, 96))):  # the corridor's sides
        plan[:, wall] = 2.5
        edges = [0]
        while 140 - edges[-1] > 72:
            edges.append(edges[-1] + rng.integers(28, 45))
        for a, b in pairwise([*edges, 140]):
            plan[b, side] = 2.5
            _doorway(rng, plan[a:b, wall])
            if b < 140 and rng.random() < 0.3:
                _doorway(rng, plan[b, side])
    return _furnish(rng, plan, furniture)


def office2(rng, furniture):
    """A furnished hall with a lift shaft, two meeting rooms, partitions of 1.4 m: 12 x 12 m."""
    plan = np.zeros((121, 121))
    plan[[0, -1]] = plan[:, [0, -1]] = 2.5
    i, j = rng.integers(45, 56, 2)
    plan[i : i + 22, j : j + 26] = 2.5
    for corner in (plan, plan[::-1, ::-1]):
        a, b = rng.integers(30, 40, 2)
        corner[a, :b] = corner[: a + 1, b] = 2.5
        _doorway(rng, corner[a, :b])
    for _ in range(5):
        k, at, long = rng.integers(12, 108), rng.integers(5, 90), rng.integers(15, 30)
        partition = (plan if rng.random() < 0.5 else plan.T)[k, at : at + long]
        partition[:] = np.maximum(partition, 1.4)
    return _furnish(rng, plan, furniture)


def dynamic(rng, furniture):
    """One of the two offices, with people who walk about at 0.5-1.2 m/s."""
    return (office1 if rng.random() < 0.5 else office2)(rng, furniture)


@dataclass(frozen=True)
class World:
    """How a world is made. Two rulers (tests/worlds.py) set its numbers; no policy's score may."""

    build: callable  # (rng, **numbers) -> heights on CELLs (m, n), meshes
    numbers: dict
    goal: tuple[float, float]  # least and most distance of the goal, m
    detour: tuple[float, float] = (0, np.inf)  # least and most length of the way, in distances
    climb: float = LEVEL  # m, highest step on the way; 0.04 is a slope of 22 degrees
    floor: float = -np.inf  # m, least height of start and goal
    people: int = 0


WORLDS = {
    "maze": World(maze, dict(opened=0.5, corridor=1.5), (3.3, 6.3), (0, 1.58)),
    "mountain": World(mountain, dict(faces=60, degrees=11), (6, 10), (1.45, 2.0), climb=0.035),
    "office1": World(office1, dict(furniture=8), (3, 6), (0, 1.12)),
    "office2": World(office2, dict(furniture=20), (3.5, 6.5), (0, 1.18)),
    "dynamic": World(dynamic, dict(furniture=14), (3.25, 6.25), (0, 1.16), people=5),
    "forest": World(forest, dict(trunks=63), (6, 10)),
    "cliff": World(cliff, dict(swing=0.9), (4.5, 6.5), floor=-0.5),
    "continuous": World(continuous, dict(degrees=42), (6, 10), (1.25, 2.4), climb=0.04),
}


def make_world(name, seed, **changes):
    """One of the eight unseen worlds (section 3): another layout and route for each seed.

    changes: to fields of its World.
    Raises ValueError for an unknown name, a seed that is not a whole number of at least 0, and if
    there is no walkable route in DRAWS draws.
    """
    if name not in WORLDS:
        raise ValueError(f"unknown world {name!r}; valid worlds: {', '.join(WORLDS)}")
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed must be a whole number of at least 0, got {seed!r}")
    world, rng = replace(WORLDS[name], **changes), np.random.default_rng(seed)
    for _ in range(DRAWS):
        plan, meshes = world.build(rng, **world.numbers)
        nav = Navigation(plan, CELL, world.climb)
        routes = find_routes(nav, rng, 1, world.goal, world.detour, floor=world.floor)
        people = [_person(rng, nav, routes[0][0]) for _ in range(world.people) if routes]
        if routes and None not in people:
            return Terrain(name, *join(meshes), *routes, plan, CELL, world.climb, people=people)
    raise ValueError(f"world {name!r} has no walkable route with seed {seed}")


def _person(rng, nav, start):
    """A Person on a way of 4 m or more, at first 1.5 m or more from `start`; None if none found."""
    met = np.isfinite(nav.distance(nav.cell(*start[:2])))
    for _ in range(TRIES):
        path = nav.way(_pick(rng, met), _pick(rng, met))
        if path is not None and len(path) > 40:
            person = Person(path, rng.uniform(0.5, 1.2), rng.uniform(0, 4.0))
            if np.hypot(*np.subtract(person.place()[:2], start[:2])) >= 1.5:
                return person
    return None


# ---------------------------------------------------------------- scanned buildings

HEADROOM = 8  # CELLs, least clearance over a floor
WINDOW = 20.0  # m, from the middle of a scan in x and y to where the rest is cut off
MAX_SIZE = 1000.0  # m, of a scan: more is a mistake in its scale


def read_scan(path, scale, up):
    """The part of a scan within WINDOW of its middle, a trimesh, z up; see load_scan."""
    if not 0 < scale < np.inf or up not in ("y", "z"):
        raise ValueError(f"scale must be above 0 and finite, and up 'y' or 'z': {scale}, {up!r}")
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no scan at {path}")
    try:
        import trimesh
    except ImportError:
        raise ImportError("scans need trimesh: pip install 'loco-mtrl[scans]'") from None
    try:
        file, kind = str(path), Path(path).suffix[1:].lower()
        if kind == "obj":  # trimesh takes no remark behind a face, and every face to be convex
            content = re.sub(rb"#.*|\\\r?\n", b"", Path(path).read_bytes())
            file = io.BytesIO(content)
            if re.search(rb"^ *f([ \t]+\S+){5}", content, re.M):
                raise ValueError("it has faces of more than four corners: triangulate it first")
        mesh = trimesh.load(file, file_type=kind, force="mesh")
        corners = np.array(mesh.triangles)[..., [2, 0, 1] if up == "y" else [0, 1, 2]] * scale
    except Exception as error:  # trimesh raises many kinds
        raise ValueError(f"{path} is not a mesh: {error}") from None
    if not len(corners) or not np.isfinite(corners).all():
        raise ValueError(f"{path} has {len(corners)} triangles, or corners that are not finite")
    corners -= np.median(corners.reshape(-1, 3), 0)  # a stray triangle far away moves no median
    low, high = corners.min(1), corners.max(1)
    corners = corners[((low < WINDOW) & (high > -WINDOW))[:, :2].all(1)]
    if not len(corners):
        raise ValueError(f"{path} has nothing within {WINDOW:.0f} m of its middle")
    if np.ptp(corners, (0, 1)).max() > MAX_SIZE:
        raise ValueError(f"{path} is more than {MAX_SIZE:.0f} m wide: is scale {scale} right?")
    whole = trimesh.Trimesh(**trimesh.triangles.to_kwargs(corners))
    mesh = whole.subdivide_to_size(2.0, max_iter=20)
    mesh.update_faces((np.abs(mesh.triangles_center[:, :2]) < WINDOW).all(1))
    mesh.remove_unreferenced_vertices()
    check_size(path, mesh.vertices, mesh.faces)
    return mesh


def load_scan(path, scale=1.0, up="z"):
    """A scanned building as a Terrain (section 3 takes its offices from Gibson).

    Its surface is sampled into voxels of CELL. A floor has HEADROOM free voxels above it. Taken is
    the level with most floor below a ceiling or, where hardly any floor has one, with most floor.
    The route is one of 8 to 12 m on it, or as long as is found. The scan is moved: x from 0, y
    around 0, the floor about 0.

    path: a file that trimesh reads: .obj, .ply, .stl, .glb ... scale: metres a unit. up: "z" or
    "y", the file's upward axis.
    Raises ImportError without trimesh, FileNotFoundError, or ValueError for a bad scale or axis, a
    file that is no mesh, more triangles than PyBullet takes, and a scan without a floor.
    """
    mesh = read_scan(path, scale, up)
    points = mesh.subdivide_to_size(CELL, max_iter=20).vertices
    low = points.min(0) - (0, 0, CELL)
    i, j, k = np.floor((points - low) / CELL).astype(int).T
    voxels = np.zeros((i.max() + 1, j.max() + 1, k.max() + HEADROOM + 2), bool)
    voxels[i, j, k] = True
    window = np.lib.stride_tricks.sliding_window_view(voxels, HEADROOM + 1, 2)  # from k on
    floor = window[..., 0] & ~window[..., 1:].any(-1)
    ceiling = np.cumsum(voxels[..., ::-1], 2)[..., ::-1][..., HEADROOM:] > 0
    if (floor & ceiling).sum() > 0.2 * floor.sum():
        floor &= ceiling
    area = floor.sum((0, 1))  # of each level, in voxels
    for level in np.argsort(-area, kind="stable")[: min(3, (area > 0).sum())]:
        plan, at = np.full(voxels.shape[:2], -100.0), (k >= level - 1) & (k <= level + 1)
        zero = np.median(points[k == level, 2])
        np.maximum.at(plan, (i[at], j[at]), points[at, 2] - zero)
        plan[voxels[..., level + 2 : level + 1 + HEADROOM].any(2)] = 1.0  # walls, furniture
        nav, rng = Navigation(plan, CELL, 0.12), np.random.default_rng(0)
        for least in (8, 4, 2, 1):
            routes = find_routes(nav, rng, 1, (least, 12), floor=-1.0)
            if routes:
                vertices = mesh.vertices - (low[0], (low[1] + len(plan[0]) * CELL / 2), zero)
                return Terrain(Path(path).stem, vertices, mesh.faces, *routes, plan, CELL, 0.12)
    raise ValueError(f"{path} has no floor to walk on: is scale {scale}, or up {up!r}, right?")
