"""Terrain: pillar tasks to train on, unseen worlds to be judged in, and the meshes of both.

The paper (section 2.3) builds every training terrain from m x n pillars and changes only their
heights. Here a task is a function of five to ten lines from a random generator and a difficulty
in [0, 1] to those heights; everything else (mesh, starts, goals) is common to all of them.

Frame: x runs along the m pillars from 0, y along the n pillars with 0 in the middle, z is up; all
lengths are in metres and all angles in radians unless a name says otherwise.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

L = W = 0.2  # m, cross-section of a training pillar
SHAPE = (60, 40)  # m x n pillars: 12 m x 8 m

CELL = 0.1  # m, navigation grid; a disc of 0.25 m radius is known on it to half a cell
CLIMB = 0.12  # m, highest step that Laikago's feet clear with room to spare
STEP = 0.2  # m, highest step that they clear at all: what training may ask for
FLAT = 0.05  # m, most that the ground under a start may vary
PAD = 9  # pillars, depth of the flat strips where most episodes start, at both ends (1.8 m)
ROUTES = 8  # start and goal pairs per training terrain
TRIES = 20  # redraws before a generator is said to yield no route

# The map that a robot draws, Chart.
CHART = 0.1  # m, its squares
BODY = 2  # squares that it needs on each side of the one in which it is
DROP = 0.21  # m below the robot's feet from where on a ray has passed an edge
STEEP, BRINK = 0.65, 0.08  # rays of a slope above STEEP have passed it BRINK m below the feet
HIDDEN = 4  # squares, at most, from the last ground that is seen to where a ray shows its edge
GRAZE = 0.05  # m below a height that a ray must pass to have passed through it
SPARED = 0.3  # m before a wall where rays pass through nothing: met at a slant, they graze it
LONG = 1.0  # m, rays that reach as far show what has gone; others end on the ground
FADE = 0.33  # of a height is left when a ray passes through it

PERSON_RADIUS, PERSON_HEIGHT = 0.25, 1.7  # m, the body that an environment gives a Person


# ---------------------------------------------------------------- what a terrain is


@dataclass(frozen=True, eq=False)
class Person:
    """A human who walks to and fro along a polyline `path` (P, 2) at `speed` (m/s), never pausing.

    `offset` (m) is how far along the path he is at t = 0.
    """

    path: np.ndarray
    speed: float
    offset: float = 0.0

    def position(self, t):
        """Where he is after `t` seconds: (x, y, yaw)."""
        along = np.r_[0.0, np.cumsum(np.hypot(*np.diff(self.path, axis=0).T))]
        total = along[-1]
        s = (self.offset + self.speed * t) % (2 * total)
        back = s > total
        s = 2 * total - s if back else s
        x, y = (np.interp(s, along, self.path[:, k]) for k in (0, 1))
        leg = min(np.searchsorted(along, s, side="right"), len(along) - 1)
        dx, dy = (self.path[leg] - self.path[leg - 1]) * (-1 if back else 1)
        return float(x), float(y), float(np.arctan2(dy, dx))


@dataclass(frozen=True, eq=False)
class Ground:
    """Height of the ground as a function that can be pickled: ground(x, y) -> z.

    `heights` are pillar tops, (m, n); or, if `smooth`, the nodes of the surface that
    `triangulate` makes, (m + 1, n + 1). `cell` is (l, w), the size of a pillar or of a square.
    Outside the ground is -inf.
    """

    heights: np.ndarray
    cell: tuple[float, float]
    smooth: bool = False

    @property
    def size(self):
        """(length, width) in metres: x in [0, length], y in [-width / 2, width / 2]."""
        return tuple((np.array(self.heights.shape) - self.smooth) * self.cell)

    def __call__(self, x, y):
        h = self.heights
        m, n = np.array(h.shape) - self.smooth
        u, v = np.broadcast_arrays(np.divide(x, self.cell[0]), np.divide(y, self.cell[1]) + n / 2)
        inside = (u >= 0) & (u <= m) & (v >= 0) & (v <= n)  # False for NaN
        i = np.minimum(np.where(inside, u, 0).astype(int), m - 1)
        j = np.minimum(np.where(inside, v, 0).astype(int), n - 1)
        z = h[i, j]
        if self.smooth:
            f, g = np.where(inside, u - i, 0), np.where(inside, v - j, 0)
            ahead, aside, across = h[i + 1, j], h[i, j + 1], h[i + 1, j + 1]
            lower = f * (ahead - z) + g * (across - ahead)
            upper = g * (aside - z) + f * (across - aside)
            z = z + np.where(f >= g, lower, upper)
        return np.where(inside, z, -np.inf)[()]


@dataclass(frozen=True, eq=False)
class Terrain:
    """One place to walk in: a triangle mesh, routes over it, the height under a point.

    An episode draws one k: it begins at `starts[k]`, mostly facing its own goal, `goals[k]`.
    """

    name: str
    vertices: np.ndarray  # (V, 3) m
    triangles: np.ndarray  # (F, 3) int, counter-clockwise seen from outside
    starts: np.ndarray  # (K, 4) x, y, ground z, yaw
    goals: np.ndarray  # (K, 3) x, y, ground z
    height: Ground  # height(x, y) -> ground z, arrays or scalars; -inf outside
    people: tuple[Person, ...] = ()


# ---------------------------------------------------------------- meshes


def _quads(*corners):
    """Mesh (vertices, triangles) of Q quads; each of the four corners is three arrays x, y, z."""
    flat = np.broadcast_arrays(*(axis for corner in corners for axis in corner))  # 12 of (Q,)
    vertices = np.stack(flat, -1).reshape(-1, 3)
    first = 4 * np.arange(len(vertices) // 4)[:, None]
    return vertices, np.concatenate([first + [0, 1, 2], first + [0, 2, 3]], 1).reshape(-1, 3)


def _join(parts):
    """One mesh from several (vertices, triangles)."""
    offsets = np.cumsum([0] + [len(v) for v, _ in parts[:-1]])
    triangles = [t + o for (_, t), o in zip(parts, offsets, strict=True)]
    return (np.concatenate([v for v, _ in parts]).astype(float),
            np.concatenate(triangles).astype(np.int32))


def _runs(*layers):
    """Longest runs along axis 1 in which every layer is constant: row, first, last + 1."""
    new = np.ones(layers[0].shape, bool)
    new[:, 1:] = np.any([a[:, 1:] != a[:, :-1] for a in layers], axis=0)
    row, first = np.nonzero(new)
    last = np.roll(first, -1)
    return row, first, np.where(last == 0, layers[0].shape[1], last)


def _walls(heights):
    """Walls between rows i and i + 1: x index, first and last y index, z behind, z ahead."""
    behind, ahead = heights[:-1], heights[1:]
    i, j0, j1 = _runs(behind, ahead)
    z0, z1 = behind[i, j0], ahead[i, j0]
    return tuple(a[z0 != z1] for a in (i + 1, j0, j1, z0, z1))


def _heights(heights, least, cell):
    """`heights` as an array, `least` or more a side; ValueError if they or `cell` are no good."""
    heights = np.asarray(heights, float)
    if heights.ndim != 2 or min(heights.shape) < least or not np.isfinite(heights).all():
        bad = np.count_nonzero(~np.isfinite(heights))
        raise ValueError(f"heights must be a finite 2-D array of at least {least} x {least}, got "
                         f"shape {heights.shape} with {bad} numbers that are not finite")
    if not all(0 < side < np.inf for side in cell):
        raise ValueError(f"the cross-section must be positive and finite, got {tuple(cell)}")
    return heights


def fuse_pillars(heights, l, w):  # noqa: E741 - the paper's own names
    """Mesh of m x n pillars without any face that cannot be seen (paper section 2.3).

    Tops of equal neighbours grow into rectangles, and walls stand only between unequal ones, so
    a ray straight down anywhere inside meets its pillar's height. The outer border stays open.

    heights: (m, n) m. l, w: m, pillar cross-section along x and y.
    Returns vertices (V, 3) float64 in m and triangles (F, 3) int32, counter-clockwise from outside.
    Raises ValueError if `heights` is not a finite 2-D array or a cross-section is not positive.
    """
    heights = _heights(heights, 1, (l, w))
    y_of = lambda j: (j - heights.shape[1] / 2) * w  # noqa: E731

    row, j0, j1 = _runs(heights)
    z = heights[row, j0]
    order = np.lexsort((row, z, j1, j0))  # runs that continue each other in x become neighbours
    row, j0, j1, z = (a[order] for a in (row, j0, j1, z))
    new = np.r_[True, (np.diff(row) != 1) | np.any(np.diff([j0, j1, z]) != 0, axis=0)]
    x0, x1 = row[new] * l, (row[np.r_[new[1:], True]] + 1) * l
    y0, y1, z = y_of(j0[new]), y_of(j1[new]), z[new]
    tops = _quads((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))

    # The corner order turns with the sign of z0 - z1: each wall faces its lower side by itself.
    i, j0, j1, z0, z1 = _walls(heights)
    x, y0, y1 = i * l, y_of(j0), y_of(j1)
    across = _quads((x, y0, z1), (x, y1, z1), (x, y1, z0), (x, y0, z0))
    j, i0, i1, z0, z1 = _walls(heights.T)
    y, x0, x1 = y_of(j), i0 * l, i1 * l
    along = _quads((x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1))
    return _join([tops, across, along])


# ---------------------------------------------------------------- navigation


def _window(a, radius, pick):
    """`pick` (np.maximum or the like) over the square of +-`radius` cells around each cell."""
    for _ in range(2):
        a = a.take(np.arange(-radius, len(a) + radius), 0, mode="clip")  # the rim goes on
        width = 1  # cells that each entry stands for; doubled, and at last made 2 * radius + 1
        while width <= 2 * radius:
            more = min(width, 2 * radius + 1 - width)
            a, width = pick(a[:-more], a[more:]), width + more
        a = a.T
    return a


def _navigation(ground, climb):
    """Where a robot can be, on a grid of CELL over `ground`.

    Returns x, y, z of the cell centres and three masks, all (nx, ny): `free`, a disc of 0.25 m
    radius meets no step above `climb` (m); `stand`, level within FLAT and no wall within 0.5 m;
    `solid`, not a hole. Holes up to 0.2 m across are filled first: legs step over those.
    """
    nx, ny = (max(round(s / CELL), 3) for s in ground.size)
    i, j = np.indices((nx, ny))
    x, y = (i + 0.5) * CELL, (j + 0.5 - ny / 2) * CELL
    z = np.maximum(ground(x, y), -1e3)
    filled = _window(_window(z, 1, np.maximum), 1, np.minimum)
    edge = np.ones(z.shape, bool)
    edge[1:-1, 1:-1] = False
    for shift in ((1, 0), (0, 1), (1, 1), (1, -1)):  # what wraps round lands on the edge
        step = np.abs(filled - np.roll(filled, shift, (0, 1))) > climb * np.hypot(*shift) + 1e-6
        edge |= step | np.roll(step, np.negative(shift), (0, 1))
    free = ~_window(edge, 1, np.maximum)  # cells beside an edge and theirs: nearer than 0.25 m
    stand = free & (_window(z, 5, np.maximum) - _window(z, 5, np.minimum) <= FLAT)
    return x, y, z, free, stand, z > filled - 0.02


def _flood(free, start):
    """Steps, 8-connected over `free`, from the cell `start` = (i, j) to each cell; -1: none."""
    steps = np.where(free, -1, -2).ravel()  # the outermost cells are never free: nothing wraps
    around = np.array([i * free.shape[1] + j for i in (-1, 0, 1) for j in (-1, 0, 1)])
    front = np.ravel_multi_index(start, free.shape)[None]
    count = 0
    while front.size:
        steps[front] = count
        count += 1
        near = (front[:, None] + around).ravel()
        front = np.unique(near[steps[near] == -1])
    return np.maximum(steps, -1).reshape(free.shape)


def _pick(rng, mask):
    """A random True cell of `mask` as (i, j), or None."""
    cells = np.argwhere(mask)
    return tuple(cells[rng.integers(len(cells))]) if len(cells) else None


def _routes(ground, rng, count, reach, climb=CLIMB, zones=((0, np.inf),), margin=0.5,
            floor=-np.inf):
    """`count` starts (K, 4) and goals (K, 3), as in Terrain; None: there are none.

    Start k lies in the k-th of `zones` (ranges of x, taken in turn); a goal lies `reach` = (least,
    most) metres from its start, measured straight; both keep `margin` m from the border and lie
    above `floor` (m).
    """
    x, y, z, free, stand, solid = _navigation(ground, climb)
    length, width = ground.size
    inside = (np.abs(x - length / 2) <= length / 2 - margin) & (np.abs(y) <= width / 2 - margin)
    inside &= z >= floor
    zones = [stand & inside & (x >= a) & (x <= b) for a, b in zones]
    home = _pick(rng, zones[0])
    if home is None:
        return None
    met = inside & (_flood(free, home) >= 0)
    starts, goals = [], []
    for k in range(count):
        s = _pick(rng, zones[k % len(zones)] & met)
        if s is None:
            return None
        far = np.hypot(x - x[s], y - y[s])
        g = _pick(rng, met & solid & (far >= reach[0]) & (far <= reach[1]))
        if g is None:
            return None
        starts.append((x[s], y[s], z[s], np.arctan2(y[g] - y[s], x[g] - x[s])))
        goals.append((x[g], y[g], z[g]))
    return np.array(starts), np.array(goals)


def _cost(z, free):
    """Chart.cost of squares: 1 a metre where all is level and `free` for three squares around.

    It is 5.5 beside what is not free, and 50 there; and 1 more for each tenth of slope above 0.2.
    Where z is NaN nothing is known of slopes, nor paid for them.
    """
    near, rings = ~free, round(0.4 / CHART)
    inside = near.astype(np.float32)  # in how many of the rings around what is not free
    for _ in range(rings - 1):
        near = _window(near, 1, np.logical_or)
        inside += near
    cost = 1 + 8 * (inside / rings) ** 2
    x, y = z[2:, 1:-1] - z[:-2, 1:-1], z[1:-1, 2:] - z[1:-1, :-2]
    slope = np.minimum(np.sqrt(x * x + y * y) / (2 * CHART), 1)
    cost[1:-1, 1:-1] += 10 * np.fmax(slope - 0.2, 0)
    cost[~free] = 50
    return cost


class Chart:
    """What a robot has seen of the ground, a map that it draws itself from its LiDAR's hits.

    Squares of CHART m a side know the lowest and the highest hit in them, and whether a ray has
    gone over them to something lower. What a ray passes through is forgotten: it was a person.
    Larger squares of 2 x 2 know what is `left` from there to the goal: the length of the way, a
    metre counted as in `_cost`. What is not seen yet is open ground; so at first that is the
    straight distance, and it grows as walls are found.

    The map is 32 m wide, around x, y (m), where the robot starts. goal: x, y, ... in m.
    """

    size, half = 320, 48  # squares: of all the map, and from the robot to what is looked at
    rounds = 12  # of value iteration, each time that the map is drawn

    def __init__(self, x, y, goal):
        self.corner = np.floor(np.array([x, y]) / CHART) - self.size // 2
        self.low, self.high, self.below = np.full((3, self.size**2), np.nan, np.float32)
        self.cost = np.ones((self.size, self.size), np.float32)
        at = (2 * np.arange(self.size // 2)[:, None] + self.corner + 1) * CHART
        self.left = np.hypot(at[:, :1] - goal[0], at[:, 1] - goal[1]).astype(np.float32)
        self.goal = tuple(self._squares(*goal[:2]).astype(int) // 2)
        self.least = self.left[self.goal]  # nearly 0, but for a goal beyond the map

    def _squares(self, x, y):
        """x, y (m, arrays) in squares from the corner, (2, ...); what is off the map at its rim."""
        squares = np.array((x, y)).T / CHART - self.corner
        return np.minimum(np.maximum(squares, 1.0), self.size - 2.01).T

    def _at(self, x, y):
        """Indices of the squares at x, y into a flat map."""
        i, j = self._squares(x, y).astype(int)
        return i * self.size + j

    def see(self, eyes, hits, hit, ground):
        """Enters scans: rays from `eyes` to `hits` (R, 3) m, where they end by a `hit` (R,) or in
        the air; `ground`: m, the height on which the robot stands.
        """
        way = hits - eyes
        self._clear(eyes, way, SPARED * (hits[:, 2] > ground + 0.1))
        # A little further: what is hit lies behind its surface, in the square there.
        x, y, z = (hits[hit] + 0.002 * way[hit]).T
        at, z = self._at(x, y), z.astype(np.float32)
        np.fmin.at(self.low, at, z)
        np.fmax.at(self.high, at, z)
        # Where a ray passes a step below, the ground can be no higher. A steep one needs less of a
        # margin, for no slope to walk on falls so: it has passed an edge.
        over = hits[:, 2] < ground - DROP
        a, way = eyes[over].T, way[over].T
        steep = -way[2] > STEEP * np.hypot(way[0], way[1])
        level = ground - np.where(steep, BRINK, DROP)
        x, y, _ = a + (level - a[2]) / way[2] * way
        level = np.where(steep, hits[over, 2], level).astype(np.float32)
        np.fmin.at(self.below, self._at(x, y), level)

    def _clear(self, eyes, way, spared):
        """Lowers what long rays pass through, `spared` m from their ends apart: people move on."""
        length = np.hypot(way[:, 0], way[:, 1])
        far = length > LONG
        length, end = length[far, None], (length - spared)[far, None]
        # In squares, and from 0.3 m on: nearer, the robot stands. Off the map x and y mean squares
        # at its other end, too far away to matter.
        unit, corner = np.array([1 / CHART, 1 / CHART, 1]), np.append(self.corner, 0)
        eye, pace = np.float32([eyes[far] * unit - corner, way[far] / length * unit])
        paces = np.arange(0.3, end.max(initial=0.3), CHART, dtype=np.float32)
        x, y, z = eye.T[..., None] + pace.T[..., None] * paces
        at = x.astype(np.int32) * self.size + y.astype(np.int32)
        gone = (self.high.take(at, mode="clip") > z + GRAZE) & (paces < end)
        at, z = at[gone].clip(0, self.high.size - 1), z[gone]
        low = self.low[at]
        self.low[at] = low = low + (1 - FADE) * np.minimum(z - low, 0)
        self.high[at] = low + FADE * (self.high[at] - low)

    def draw(self, x, y, ground):
        """Works out anew what a metre costs, and what is left from where, up to 4.8 m around x, y.

        `ground` as in `see`.
        """
        corner = 2 * (self._squares(x, y).astype(int) // 2)  # of a larger square
        here = tuple(slice(max(k - self.half, 0), k + self.half) for k in corner.tolist())
        low, high, below = (a.reshape(self.cost.shape)[here]
                            for a in (self.low, self.high, self.below))
        z = (low + high) / 2  # NaN: not seen yet
        edge = high - low > STEP
        off = np.abs(z - ground)  # of two squares with a step between, the odd one is in the way
        for one, other in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
            step, odd = np.abs(z[one] - z[other]) > STEP, off[one] > off[other]
            edge[one] |= step & odd
            edge[other] |= step & ~odd
        gone = np.isnan(z) & (_window(z, HIDDEN, np.fmax) - below > STEP)
        edge |= _window(gone, 1, np.maximum)  # the brink is nearer than where it shows
        self.cost[here] = cost = _cost(z, ~_window(edge, BODY, np.maximum))

        # Value iteration: what is left from a square is a step to one of the 8 around, each of the
        # two paid for its half of it, and what is left from there.
        cost = np.minimum(cost[::2], cost[1::2])
        straight = CHART * np.minimum(cost[:, ::2], cost[:, 1::2])
        diagonal = 2**0.5 * straight
        left = self.left[tuple(slice(k.start // 2, k.stop // 2) for k in here)]  # a view
        inner = np.s_[1:-1, 1:-1]
        for _ in range(self.rounds):
            a, b = left + straight, left + diagonal
            a = np.minimum(np.minimum(a[:-2, 1:-1], a[2:, 1:-1]),
                           np.minimum(a[1:-1, :-2], a[1:-1, 2:]))
            b = np.minimum(b[:-2], b[2:])
            b = np.minimum(b[:, :-2], b[:, 2:])
            left[inner] = np.minimum(a + straight[inner], b + diagonal[inner])
            self.left[self.goal] = self.least

    def effort(self, x, y):
        """What a metre costs at x, y (m, arrays), as far as is known: what is not costs 1."""
        return self.cost.take(self._at(x, y))

    def to_go(self, x, y):
        """What is left from x, y (m, arrays) to the goal, in metres of open ground."""
        at = self._squares(x, y) / 2 - 0.5
        i, j = whole = at.astype(int)
        f, g = at - whole
        n, left = self.size // 2, self.left.ravel()
        k = i * n + j
        near, far = left.take(k), left.take(k + n)
        near = near + g * (left.take(k + 1) - near)
        return near + f * (far + g * (left.take(k + n + 1) - far) - near)


# ---------------------------------------------------------------- the training tasks

# Pillar centres in m. U is the way into the task: 0 up to the flat strip's edge, then growing, so
# whatever depends on U alone meets both strips without a step.
_I, _J = np.indices(SHAPE)
X, Y = (_I + 0.5) * L, (_J + 0.5 - SHAPE[1] / 2) * W
U = np.clip(X, PAD * L, (SHAPE[0] - PAD) * L) - PAD * L
SPAN = U.max()  # m, 8.4


def _taper(reach):
    """(m, n) in [0, 1]: 0 at both flat strips, 1 from `reach` m on."""
    return np.clip(np.minimum(U, SPAN - U) / reach, 0, 1)


def _barrier(difficulty):
    """Height of a wall, or depth of a drop, m: past a fifth of the difficulty it stops everybody.

    If it grew with difficulty all the way, a third of the drops would be steps to run down.
    """
    return min(1.2, 4 * difficulty)


def _boxes(rng, count, size, height):
    """`count` boxes of `size` = (least, most) pillars a side and `height` = (least, most) m."""
    h = np.zeros(SHAPE)
    for _ in range(int(count)):
        i, j = rng.integers(PAD, SHAPE[0] - PAD), rng.integers(SHAPE[1])
        a, b = rng.integers(size[0], size[1] + 1, 2)
        h[i : i + a, j : j + b] = rng.uniform(*height)
    return h


def _bars(rng, count):
    """Mask of `count` lines one pillar thick across the way, at least 0.6 m apart."""
    rows = PAD + 1 + 3 * rng.choice((SHAPE[0] - 2 * PAD) // 3, int(count), replace=False)
    return np.isin(np.arange(SHAPE[0]), rows)[:, None] & np.ones(SHAPE, bool)


def _noise(rng, shape, coarse):
    """Smooth noise in [-1, 1], (m, n): `coarse` = (a, b) random values, eased between them."""
    for_axis = []
    for n, c in zip(shape, coarse, strict=True):
        at = np.linspace(0, c - 1, n)
        low = np.minimum(at.astype(int), c - 2)
        part = at - low
        ease = part * part * (3 - 2 * part)
        weight = np.zeros((n, c))
        weight[np.arange(n), low], weight[np.arange(n), low + 1] = 1 - ease, ease
        for_axis.append(weight)
    return for_axis[0] @ rng.uniform(-1, 1, coarse) @ for_axis[1].T


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


def poles(rng, difficulty):
    """Up to 20 tables' legs: four poles 7 cm thick, 0.4-1.4 m apart and 0.4-1.2 m tall, each."""
    h = np.zeros((3 * SHAPE[0], 3 * SHAPE[1]))
    for _ in range(round(20 * difficulty)):
        i, j = rng.integers(PAD, SHAPE[0] - PAD), rng.integers(SHAPE[1])
        a, b = np.minimum((i, j) + rng.integers(2, 8, 2), np.subtract(SHAPE, 1))
        h[np.ix_([3 * i, 3 * a], [3 * j, 3 * b])] = rng.uniform(0.4, 1.2)
    return h


poles.cell = L / 3  # m, cross-section of the pillars: L and W are too thick for a leg


def stairs(rng, difficulty):
    """Flights up and down, 3 to 7 steps of up to 0.18 m, treads of 0.4 or 0.6 m."""
    n = rng.integers(3, 8)
    flight = np.r_[np.arange(n), [n] * rng.integers(2, 5), np.arange(n)[::-1], [0] * 2]
    tread = rng.choice([0.4, 0.4, 0.6])
    return 0.18 * difficulty * np.resize(flight, 99)[(U / tread + 1e-6).astype(int)]


def stones(rng, difficulty):
    """Stepping stones 1 m down to 0.6 m wide, 0.2 m apart in brick bond, over a pit to 0.8 m."""
    k = 4 + round(2 * (1 - difficulty))
    i, j = np.indices(SHAPE)
    course = (i + rng.integers(k)) // k
    pit = ((i + rng.integers(k)) % k == 0) | ((j + rng.integers(0, k, 99)[course]) % k == 0)
    top = 0.04 * difficulty * rng.uniform(-1, 1, SHAPE)
    return np.where(pit & (U > 0) & (U < SPAN), -0.8 * difficulty, top)


def slopes(rng, difficulty):
    """A hill or a valley across the way, up and down at up to 38 degrees, to 2.3 m high."""
    up, down = rng.uniform(1.5, 3.0, 2)
    top = np.tan(np.radians(38 * difficulty * rng.uniform(0.7, 1))) * min(up, down)
    a, b = np.sort(rng.uniform(up, SPAN - down, 2))
    return rng.choice([-1, 1]) * np.interp(U, [a - up, a, b, b + down], [0, top, top, 0])


def hills(rng, difficulty):
    """Hills and hollows of many sizes, slopes to about 34 degrees, and up to 25 boulders."""
    shape, fine = (2 * SHAPE[0], 2 * SHAPE[1]), np.ones((2, 2))
    coarse = rng.integers(2, 5, 2)
    ground = sum(_noise(rng, shape, coarse * 2**k + 1) / 2.3**k for k in range(3))
    slope = np.percentile(np.hypot(*np.gradient(ground, L / 2)), 95)
    x = np.abs(np.arange(shape[0]) - (shape[0] - 1) / 2) * L / 2  # m from the middle
    ground *= np.clip((SPAN / 2 - x) / 1.5, 0, 1)[:, None]  # level where episodes start
    ground *= np.tan(np.radians(34 * difficulty)) / slope
    return ground + np.kron(_boxes(rng, 25 * difficulty, (1, 3), (0.05, 0.4)), fine)


hills.cell = L / 2  # m: steps so low that slopes feel, and look to the LiDAR, nearly smooth


def pyramids_up(rng, difficulty):
    """Stepped pyramids of 2 to 5 steps of up to 0.18 m, treads of 0.4 m."""
    level = np.zeros(SHAPE)
    for x, y in zip(rng.uniform(3, 9, 7), rng.uniform(-4, 4, 7), strict=True):
        ring = np.maximum(np.abs(X - x), np.abs(Y - y)) / 0.4
        level = np.maximum(level, np.floor(np.clip(rng.integers(3, 7) - ring, 0, None)))
    return 0.18 * difficulty * np.minimum(level, np.floor(np.minimum(U, SPAN - U) / 0.4 + 1e-6))


def pyramids_down(rng, difficulty):
    """Stepped pits to walk down into and out of: `pyramids_up` upside down."""
    return -pyramids_up(rng, difficulty)


def gaps(rng, difficulty):
    """Up to 8 trenches across, 0.2 m wide and up to 0.8 m deep."""
    return np.where(_bars(rng, 2 + 6 * difficulty), -0.8 * difficulty, 0.0)


def hurdles(rng, difficulty):
    """Up to 8 bars across, 0.2 m thick and up to 0.2 m high."""
    return np.where(_bars(rng, 2 + 6 * difficulty), 0.2 * difficulty, 0.0)


def ridges(rng, difficulty):
    """Two winding paths, 2 m down to 0.8 m wide, over a drop."""
    path = (U == 0) | (U == SPAN)
    for _ in range(2):
        turn, phase, swing = rng.uniform(0.5, 1.2), rng.uniform(0, 6.3), rng.uniform(0.3, 1.5)
        middle = rng.uniform(-2, 2) + swing * np.sin(turn * X + phase)
        across = (2.0 - 1.2 * difficulty) * np.hypot(1, swing * turn * np.cos(turn * X + phase))
        path |= np.abs(Y - middle) <= across / 2
    return np.where(path, 0.0, -_barrier(difficulty))


def corridors(rng, difficulty):
    """Two corridors, 2 m down to 1 m wide, with 1 to 4 bends, cut through a solid wall."""
    half = (2.0 - difficulty) / 2
    open_ = (U == 0) | (U == SPAN)
    for _ in range(2):
        bends = 1 + round(3 * difficulty)
        xs = np.r_[0, PAD * L + SPAN * (np.arange(bends) + rng.uniform(0.3, 0.7)) / bends, 12]
        ys = rng.uniform(-2.6, 2.6, bends + 1)
        for k, (x0, x1) in enumerate(pairwise(xs)):
            open_ |= (np.abs(Y - ys[k]) <= half) & (X >= x0 - half) & (X <= x1 + half)
            y0, y1 = np.sort(ys[k : k + 2][[0, -1]])
            open_ |= (np.abs(X - x1) <= half) & (Y >= y0 - half) & (Y <= y1 + half)
    return np.where(open_, 0.0, _barrier(difficulty))


def walls(rng, difficulty):
    """Slalom: up to 5 walls across, each with openings of 2 m down to 1 m somewhere else."""
    h = np.zeros(SHAPE)
    for row in np.linspace(PAD + 3, SHAPE[0] - PAD - 4, 1 + round(4 * difficulty)).astype(int):
        gap = (Y[0] + rng.uniform(0, 4)) % (2.6 + 1.4 * difficulty) < 2.0 - difficulty
        h[row] = np.where(gap, 0.0, _barrier(difficulty))
    return h


def _doors(rng, walls, extra):
    """Which of the walls between rooms, pairs (a, b) of their numbers, have a door.

    A random spanning tree, so that every room can be reached, and a share `extra` of the rest.
    """
    group = np.arange(np.max(walls) + 1)  # rooms that are connected share a number
    doors = np.zeros(len(walls), bool)
    for k in rng.permutation(len(walls)):
        one, other = group[list(walls[k])]
        doors[k] = one != other or rng.random() < extra
        group[group == other] = one
    return doors


def _rooms(rng, x, y, difficulty, door):
    """Rooms between walls on the lines `x` across the way and `y` along it (pillars).

    Doors are `door` = (least, most) pillars wide; the harder, the fewer: 1 leaves one way.
    """
    h = np.zeros(SHAPE)
    h[x], h[x[0] : x[-1], y] = 1, 1
    nx, ny = len(x) - 1, len(y) - 1
    room = np.arange(nx * ny).reshape(nx, ny)
    room = np.pad(room, ((1, 1), (0, 0)), constant_values=((nx * ny, nx * ny + 1), (0, 0)))
    walls = [(room[i, j], room[i + 1, j], h[x[i], y[j] + 1 : y[j + 1]])
             for i in range(nx + 1) for j in range(ny)]
    walls += [(room[i + 1, j - 1], room[i + 1, j], h[x[i] + 1 : x[i + 1], y[j]])
              for i in range(nx) for j in range(1, ny)]
    for k in np.flatnonzero(_doors(rng, [wall[:2] for wall in walls], 0.8 * (1 - difficulty))):
        wall = walls[k][2]
        wide = min(rng.integers(door[0], door[1] + 1), len(wall))
        at = rng.integers(len(wall) - wide + 1)
        wall[at : at + wide] = 0
    return h * _barrier(difficulty)


def _lines(rng, low, high, size):
    """Lines from `low` to `high` (pillars), `size` = (least, most) apart, the last ones farther."""
    lines = low + np.r_[0, np.cumsum(rng.integers(size[0], size[1] + 1, 9))]
    return np.r_[lines[lines <= high - size[0]], high]


def rooms(rng, difficulty):
    """Rooms of 1.4 m and more with doors of 0.8-1.6 m, and up to 15 things in them."""
    x = _lines(rng, PAD + 1, SHAPE[0] - PAD - 2, (8, 21))
    h = _rooms(rng, x, _lines(rng, 0, SHAPE[1] - 1, (8, 21)), difficulty, (4, 8))
    return np.maximum(h, _boxes(rng, 15 * difficulty, (1, 4), (0.3, 1.2)))


def mazes(rng, difficulty):
    """Mazes of corridors 1.4-1.8 m wide, at the border a little more."""
    size = [rng.integers(8, 11)] * 2
    x = _lines(rng, PAD + 1, SHAPE[0] - PAD - 2, size)
    return _rooms(rng, x, _lines(rng, 0, SHAPE[1] - 1, size), difficulty, (99, 99))


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
        i, j = rng.integers(PAD + 1, SHAPE[0] - PAD - 1), rng.integers(1, SHAPE[1] - 8)
        wide, deep = rng.integers(7, 16), rng.choice([-1, 1]) * rng.integers(3, 9)
        a, b = sorted((i, int(np.clip(i + deep, PAD, SHAPE[0] - PAD))))
        h[i, j : j + wide] = h[a : b + 1, [j, min(j + wide, SHAPE[1]) - 1]] = _barrier(difficulty)
    return h


def pits(rng, difficulty):
    """Up to 14 pits of 0.6-2.4 m a side, to walk around."""
    deep = _barrier(difficulty)
    return -_boxes(rng, 14 * difficulty, (3, 12), (0.5 * deep, deep))


def coasts(rng, difficulty):
    """A winding edge along the way, the more so the harder, a drop on one side of it."""
    turn, phase, swing = rng.uniform(0.5, 1), rng.uniform(0, 6.3), 2 * difficulty
    edge, side = rng.uniform(-1, 1) + swing * np.sin(turn * X + phase), rng.choice([-1, 1])
    return np.where((side * Y > edge) & (U > 0) & (U < SPAN), -_barrier(difficulty), 0.0)


def crags(rng, difficulty):
    """Hills 4 m long with slopes to about 35 degrees, bumps of 6 cm and up to 25 boulders."""
    hills = _noise(rng, SHAPE, (4, 3))
    slope = np.percentile(np.hypot(*np.gradient(hills, L)), 90)
    ground = hills * np.tan(np.radians(35 * difficulty)) / slope * _taper(2.5)
    bumps = rng.uniform(0, 0.06 * difficulty, SHAPE)
    return ground + bumps + _boxes(rng, 25 * difficulty, (1, 3), (0.05, 0.4))


def blocks(rng, difficulty):
    """Up to 60 low boxes and steps of 0.03-0.2 m to tread on, and 15 tall ones to avoid."""
    low = _boxes(rng, 60 * difficulty, (2, 6), (0.03, 0.2))
    return np.maximum(low, _boxes(rng, 15 * difficulty, (1, 3), (0.4, 1.0)))


def waves(rng, difficulty):
    """Sine waves along and across, 2.5-4 m long, slopes to about 31 degrees."""
    k, phase = 2 * np.pi / rng.uniform(2.5, 4, 2), rng.uniform(0, 2 * np.pi, 2)
    swell = np.sin(k[0] * X + phase[0]) / k[0] + 0.7 * np.sin(k[1] * Y + phase[1]) / k[1]
    return 0.6 * difficulty * swell * _taper(1.6)


for _task in (obstacles, poles, corridors, walls, rooms, mazes, screens, traps):
    _task.fence = True  # walls all around: who looks for a way must not fall off the world

# Ranks take them in turns: in this order every other one makes half of the work.
PILLAR_TASKS = {task.__name__: task for task in (
    flat, rugged, holes, obstacles, poles, stairs, stones, hills, slopes, pyramids_up,
    pyramids_down, gaps, hurdles, ridges, pits, coasts, walls, corridors, rooms, mazes,
    screens, traps, blocks, waves, crags)}


def make_terrain(task, rng, difficulty):
    """A terrain to train on (paper section 2.3): pillars, their mesh, and ROUTES routes.

    task: a name in PILLAR_TASKS, a function (rng, difficulty) -> heights (m, n) in m, or a
    finished Terrain, which is returned as it is. rng: numpy Generator; difficulty: in [0, 1].
    A function may have attributes: `cell`, m, the pillars' cross-section if it is not L, and
    `fence`, walls along the border that grow with difficulty.
    The strips at both ends are made level, for the episodes to start there; goals lie 6-9 m away.
    Raises ValueError for an unknown task, a difficulty outside [0, 1], heights that are not a
    finite 2-D array, and a task that yields no route in TRIES draws.
    """
    if isinstance(task, Terrain):
        return task
    if not callable(task) and task not in PILLAR_TASKS:
        raise ValueError(f"unknown task {task!r}; valid tasks: {', '.join(PILLAR_TASKS)}")
    if not 0 <= difficulty <= 1:
        raise ValueError(f"difficulty must be in [0, 1], got {difficulty}")
    generate = task if callable(task) else PILLAR_TASKS[task]
    name, cell = getattr(generate, "__name__", "terrain"), getattr(generate, "cell", L)
    for _ in range(TRIES):
        heights = _heights(generate(rng, difficulty), 1, (cell, cell)).copy()
        pad = round(PAD * L / cell)
        for strip in (heights[:pad], heights[-pad:]):
            strip[:] = np.median(strip)
        if getattr(generate, "fence", False):
            heights[[0, -1]], heights[:, [0, -1]] = _barrier(difficulty), _barrier(difficulty)
        ground = Ground(heights, (cell, cell))
        length = ground.size[0]
        # From either end, in turn with wherever else a robot can stand: in a maze, on a ridge.
        zones = (1.0, PAD * L), (length - PAD * L, length - 1.0), (0.0, length)
        routes = _routes(ground, rng, ROUTES, (min(6, length / 2), 9), STEP, zones, margin=1.0)
        if routes:
            # Some begin with their back to the goal: what lies behind it is worth a look, too.
            yaw = routes[0][2::3, 3]
            yaw += rng.uniform(-np.pi, np.pi, len(yaw))
            return Terrain(name, *fuse_pillars(heights, cell, cell), *routes, ground)
    raise ValueError(f"task {name!r} gave no walkable route in {TRIES} draws of {heights.shape}")


# ---------------------------------------------------------------- the unseen worlds

FINE = 0.1  # m, cell of the worlds' plans; no training task has it
LEVEL = 0.05  # m, highest step where no climbing is asked for


def triangulate(heights, cell):
    """Continuous mesh through (m + 1) x (n + 1) nodes, the surface of `Ground(..., smooth=True)`.

    Returns and raises as `fuse_pillars` does. heights: m, at least 2 x 2; cell: (l, w), m.
    """
    heights = _heights(heights, 2, cell)
    i, j = np.indices(heights.shape)
    n = heights.shape[1]
    vertices = np.stack([i * cell[0], (j - (n - 1) / 2) * cell[1], heights], -1).reshape(-1, 3)
    a = (i * n + j)[:-1, :-1].ravel()  # each square's corner at the least x and y
    lower, upper = np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)
    return vertices, np.concatenate([lower, upper]).astype(np.int32)


def _prisms(x, y, radius, bottom, top, sides):
    """Mesh of upright prisms at x, y (P,) with `sides` walls and a lid: rocks, trunks."""
    turn = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    parts = []
    for cx, cy, r, z0, z1 in zip(*np.broadcast_arrays(x, y, radius, bottom, top), strict=True):
        px, py = cx + r * np.cos(turn), cy + r * np.sin(turn)
        qx, qy = np.roll(px, -1), np.roll(py, -1)
        parts.append(_quads((px, py, z0), (qx, qy, z0), (qx, qy, z1), (px, py, z1)))
        parts.append(_quads((px, py, z1), (qx, qy, z1), (cx, cy, z1), (cx, cy, z1)))
    return _join(parts)


def _box_mesh(boxes):
    """Mesh of B boxes (B, 6): x0, x1, y0, y1, z0, z1 in metres."""
    x0, x1, y0, y1, z0, z1 = np.array(boxes).T
    return _join([
        _quads((x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)),
        _quads((x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0)),
        _quads((x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)),
        _quads((x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)),
        _quads((x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)),
        _quads((x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)),
    ])


def _world(name, rng, plan, mesh, climb, people=0, floor=-np.inf):
    """Terrain over `plan`, heights (m, n) on FINE cells, with one route; None if it has none."""
    ground = Ground(plan, (FINE, FINE))
    routes = _routes(ground, rng, 1, (6, 12), climb=climb, floor=floor)
    if routes is None:
        return None
    walkers = tuple(_walker(rng, ground, routes[0][0]) for _ in range(people))
    return None if None in walkers else Terrain(name, *mesh, *routes, ground, walkers)


def _walker(rng, ground, start):
    """A Person on the shortest way between two places, 1.5 m or more from `start` at first.

    None if TRIES draws find no such way.
    """
    x, y, _, free, *_ = _navigation(ground, LEVEL)
    cell = np.unravel_index(np.argmin(np.hypot(x - start[0], y - start[1])), x.shape)
    met = _flood(free, cell) >= 0
    for _ in range(TRIES):
        steps = _flood(free, _pick(rng, met))
        if steps.max() < 40:  # 4 m
            continue
        cell = _pick(rng, steps >= 40)
        path = [cell]
        while steps[cell]:
            i, j = cell
            around = [(i + a, j + b) for a in (0, -1, 1) for b in (0, -1, 1)]  # straight first
            cell = next(c for c in around if steps[c] == steps[i, j] - 1)
            path.append(cell)
        path = np.array([(x[c], y[c]) for c in path])
        person = Person(path, rng.uniform(0.5, 1.2), rng.uniform(0, 2 * len(path) * CELL))
        if np.hypot(*np.subtract(person.position(0)[:2], start[:2])) >= 1.5:
            return person


def maze(rng):
    """Walls 1.3 m tall and 0.1 m thick around corridors 1.2 m wide, 8 x 6 of them: 10.5 x 7.9 m.

    A random spanning tree, then one in eight of the walls left is opened: there are several ways.
    """
    nx, ny, pitch = 8, 6, 13  # pitch in FINE cells: the corridor's 12 and the wall's 1
    plan = np.zeros((nx * pitch + 1, ny * pitch + 1))
    plan[::pitch], plan[:, ::pitch] = 1.3, 1.3
    room = np.arange(nx * ny).reshape(nx, ny)
    walls = [(room[i - 1, j], room[i, j], plan[i * pitch, j * pitch + 1 : (j + 1) * pitch])
             for i in range(1, nx) for j in range(ny)]
    walls += [(room[i, j - 1], room[i, j], plan[i * pitch + 1 : (i + 1) * pitch, j * pitch])
              for i in range(nx) for j in range(1, ny)]
    for k in np.flatnonzero(_doors(rng, [wall[:2] for wall in walls], 0.125)):
        walls[k][2][:] = 0
    return _world("maze", rng, plan, fuse_pillars(plan, FINE, FINE), LEVEL)


def _plan_of(nodes, cell, shape):
    """Heights of a smooth surface at the centres of `shape` FINE cells."""
    x, y = (np.indices(shape) + 0.5) * FINE
    return Ground(nodes, (cell, cell), smooth=True)(x, y - shape[1] * FINE / 2)


def _smooth(rng, size, cell, coarse, octaves, degrees):
    """Nodes of a fractal surface over `size` m, scaled so that 5 % of it is steeper than `degrees`.

    A level spot of 0.9 m radius, eased into the slope, is made where x is small to start from.
    """
    shape = tuple(round(s / cell) + 1 for s in size)
    nodes = sum(_noise(rng, shape, tuple(c * 2**k + 1 for c in coarse)) / 2.6**k
                for k in range(octaves))
    slope = np.hypot(*np.gradient(nodes, cell))
    nodes *= np.tan(np.radians(degrees)) / np.percentile(slope, 95)
    x, y = np.indices(shape) * cell
    spot = rng.uniform(1.5, 2.5), rng.uniform(2.0, size[1] - 2.0)
    level = nodes[round(spot[0] / cell), round(spot[1] / cell)]
    far = np.clip((np.hypot(x - spot[0], y - spot[1]) - 0.9) / 1.2, 0, 1)
    return level + (nodes - level) * far * far * (3 - 2 * far)


def mountain(rng):
    """Fractal slopes, 5 % of them steeper than 28 degrees, with 40 rocks to 0.4 m: 14 x 10 m."""
    size, cell = (14.0, 10.0), 0.2
    nodes = _smooth(rng, size, cell, (2, 2), 4, 28)
    plan = _plan_of(nodes, cell, (140, 100))
    x, y = rng.uniform(3.8, 13.5, 40), rng.uniform(-4.7, 4.7, 40)
    radius, tall = rng.uniform(0.12, 0.35, 40), rng.uniform(0.1, 0.4, 40)
    i, j = (np.indices(plan.shape) + 0.5) * FINE
    foot = Ground(nodes, (cell, cell), smooth=True)(x, y)
    for k in range(40):
        plan[np.hypot(i - x[k], j - 5.0 - y[k]) <= radius[k]] = foot[k] + tall[k]
    rocks = _prisms(x, y, radius, foot - 0.5, foot + tall, 7)
    return _world("mountain", rng, plan, _join([triangulate(nodes, (cell, cell)), rocks]), CLIMB)


def forest(rng):
    """Ground with bumps of 0.1 m and a trunk, 0.16-0.4 m thick, on every 3 m2: 12 x 10 m."""
    cell, count, shape = 0.25, 40, (49, 41)
    nodes = 0.05 * _noise(rng, shape, (9, 8)) + rng.uniform(-0.04, 0.04, shape)
    plan = _plan_of(nodes, cell, (120, 100))
    x, y = rng.uniform(0.3, 11.7, count), rng.uniform(-4.7, 4.7, count)
    radius = rng.uniform(0.08, 0.2, count)
    i, j = (np.indices(plan.shape) + 0.5) * FINE
    for k in range(count):
        plan[np.hypot(i - x[k], j - 5.0 - y[k]) <= radius[k] + FINE / 2] = 2.0
    trunks = _prisms(x, y, radius, -0.2, 2.0, 9)
    mesh = _join([triangulate(nodes, (cell, cell)), trunks])
    return _world("forest", rng, plan, mesh, LEVEL)


def cliff(rng):
    """A path 1.0-1.5 m wide that winds along 13 m, uneven by 2 cm, over a drop of 1.2 m."""
    shape = (130, 100)
    x, y = (np.indices(shape) + 0.5) * FINE
    y -= shape[1] * FINE / 2
    phase, bulge = rng.uniform(0, 2 * np.pi, 2)
    k, swing = 2 * np.pi / rng.uniform(5, 8), rng.uniform(0.8, 1.6)
    width = 1.25 + 0.25 * np.sin(rng.uniform(0.5, 1.5) * x + bulge)
    across = np.abs(y - swing * np.sin(k * x + phase))  # along y; divided, at right angles to it
    across /= np.hypot(1, swing * k * np.cos(k * x + phase))
    uneven = np.kron(rng.uniform(-0.02, 0.02, (33, 25)), np.ones((4, 4)))[: shape[0], : shape[1]]
    plan = np.where(across <= width / 2, uneven, -1.2)
    for end in (1.5, 11.5):  # a place to stand, and one to arrive
        middle = swing * np.sin(k * end + phase)
        plan[np.hypot(x - end, y - middle) <= 0.9] = 0.0
    return _world("cliff", rng, plan, fuse_pillars(plan, FINE, FINE), CLIMB, floor=-0.5)


def continuous(rng):
    """A smooth random surface of triangles, 5 % of it steeper than 24 degrees: 13 x 10 m."""
    cell = 0.25
    nodes = _smooth(rng, (13.0, 10.0), cell, (4, 3), 2, 24)
    plan = _plan_of(nodes, cell, (130, 100))
    return _world("continuous", rng, plan, triangulate(nodes, (cell, cell)), CLIMB)


CLOSED = 2.5  # m, height of an office's walls


def _doorway(rng, plan, line, a, b):
    """Opens a doorway of 0.9 or 1.0 m somewhere in `plan[line, a:b]`."""
    wide = rng.integers(9, 11)
    at = rng.integers(a + 3, b - wide - 2)
    plan[line, at : at + wide] = 0.0


def _corridor_plan(rng):
    """Rooms 2.8-7.2 m long beside a corridor 1.6 m wide: 14 x 9.6 m. Returns walls and rooms."""
    plan, rooms = np.zeros((141, 97)), []
    plan[[0, -1]], plan[:, [0, -1]] = CLOSED, CLOSED
    for wall, low, high in ((40, 0, 40), (57, 57, 96)):  # the corridor's sides, in FINE cells
        plan[:, wall] = CLOSED
        edges = [0]
        while 140 - edges[-1] > 72:
            edges.append(edges[-1] + rng.integers(28, 45))
        edges.append(140)
        for a, b in pairwise(edges):
            plan[b, low:high] = CLOSED
            _doorway(rng, plan.T, wall, a, b)
            rooms.append((a + 1, b, low + 1, high))
        for b in edges[1:-1]:
            if rng.random() < 0.3:
                _doorway(rng, plan, b, low, high)
    return plan, rooms


def _open_plan(rng):
    """A hall of 12 x 12 m around a lift shaft, two meeting rooms, partitions 1.4 m tall."""
    plan = np.zeros((121, 121))
    plan[[0, -1]], plan[:, [0, -1]] = CLOSED, CLOSED
    i, j = rng.integers(45, 56, 2)
    plan[i : i + 22, j : j + 26] = CLOSED
    a, b, c, d = rng.integers(30, 40, 4)
    plan[a, :b], plan[: a + 1, b] = CLOSED, CLOSED
    plan[-c, -d:], plan[-c:, -d] = CLOSED, CLOSED
    _doorway(rng, plan, a, 0, b)
    _doorway(rng, plan, 121 - c, 121 - d, 120)
    for _ in range(5):
        k, at, long = rng.integers(12, 108), rng.integers(5, 90), rng.integers(15, 30)
        view = plan if rng.random() < 0.5 else plan.T
        view[k, at : at + long] = np.maximum(view[k, at : at + long], 1.4)
    return plan, [(1, 120, 1, 120)] * 6 + [(1, a, 1, b), (122 - c, 120, 122 - d, 120)]


def _furnish(rng, bare, rooms):
    """Puts a cupboard, desks and their chairs into each room where nothing stands.

    Cupboards 0.4 x 0.8 x 1.8 m stay part of the walls' plan; desks 0.7 x 1.4 m, 0.75 m high on four
    legs, and chairs 0.4 m square, seat at 0.45 m, are boxes: the LiDAR looks through below them.
    Returns the plan with all tops in it, the plan without desks and chairs, and the boxes.
    """
    plan, boxes = bare.copy(), []

    def place(i, j, a, b, height):
        around = plan[max(i - 1, 0) : i + a + 1, max(j - 1, 0) : j + b + 1]
        if around.shape != (a + 2, b + 2) or around.any():
            return False
        plan[i : i + a, j : j + b] = height
        return True

    def slab(i, j, a, b, z):
        x0, y0 = i * FINE, (j - plan.shape[1] / 2) * FINE
        x1, y1 = x0 + a * FINE, y0 + b * FINE
        boxes.append((x0, x1, y0, y1, z - 0.04, z))
        boxes.extend((x, x + 0.05, y, y + 0.05, 0, z - 0.04)
                     for x in (x0, x1 - 0.05) for y in (y0, y1 - 0.05))

    for i0, i1, j0, j1 in rooms:
        i, j = rng.integers(i0 + 1, i1 - 5), rng.integers(j0 + 1, j1 - 9)
        if place(i, j, 4, 8, 1.8):
            bare[i : i + 4, j : j + 8] = 1.8
        for _ in range(2):
            i = rng.integers(i0 + 1, max(i1 - 14, i0 + 2))
            j = rng.integers(j0 + 1, max(j1 - 14, j0 + 2))
            turned = rng.random() < 0.5
            a, b = (14, 7) if turned else (7, 14)
            if not place(i, j, a, b, 0.75):
                continue
            slab(i, j, a, b, 0.75)
            i, j = (i + 5, j + b + 1) if turned else (i + a + 1, j + 5)
            if place(i, j, 4, 4, 0.9):
                slab(i, j, 4, 4, 0.45)
                x, y = i * FINE, (j - plan.shape[1] / 2) * FINE
                boxes.append((x, x + 0.4, y + 0.35, y + 0.4, 0.45, 0.9))
    return plan, bare, boxes


def _office(name, rng, layout, people=0):
    plan, bare, boxes = _furnish(rng, *layout(rng))
    mesh = _join([fuse_pillars(bare, FINE, FINE)] + ([_box_mesh(boxes)] if boxes else []))
    return _world(name, rng, plan, mesh, LEVEL, people)


def office1(rng):
    """Rooms with doorways of 0.9-1.0 m along both sides of a corridor, furnished: 14 x 9.6 m."""
    return _office("office1", rng, _corridor_plan)


def office2(rng):
    """An open plan with a lift shaft, meeting rooms and partitions, furnished: 12 x 12 m."""
    return _office("office2", rng, _open_plan)


def dynamic(rng):
    """One of the two offices with five people who walk about at 0.5-1.2 m/s."""
    return _office("dynamic", rng, _open_plan if rng.random() < 0.5 else _corridor_plan, people=5)


WORLDS = {world.__name__: world for world in (
    maze, mountain, office1, office2, dynamic, forest, cliff, continuous)}


def make_world(name, seed):
    """One of the eight unseen worlds (paper section 3): another layout and route for each seed.

    Raises ValueError for an unknown name, a seed that is not a whole number of at least 0, and if
    there is no walkable route in TRIES draws.
    """
    if name not in WORLDS:
        raise ValueError(f"unknown world {name!r}; valid worlds: {', '.join(WORLDS)}")
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed must be a whole number of at least 0, got {seed!r}")
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        world = WORLDS[name](rng)
        if world is not None:
            return world
    raise ValueError(f"world {name!r} has no walkable route with seed {seed}")


# ---------------------------------------------------------------- scanned buildings

MAX_VERTICES, MAX_INDICES = 131_072, 524_288  # what PyBullet takes in one mesh
HEADROOM = 0.7  # m, least clearance over a floor
WINDOW = 40.0  # m, side of the square around a mesh's middle that is searched for a floor


def _read_obj(path):
    """Vertices (V, 3) and triangles (F, 3) of a Wavefront file; polygons become fans."""
    vertices, triangles = [], []
    with open(path, errors="replace") as file:
        for number, line in enumerate(file, 1):
            kind, *words = line.split() or [""]
            try:
                if kind == "v":
                    x, y, z = map(float, words[:3])
                    vertices.append((x, y, z))
                elif kind == "f":
                    corners = [int(word.split("/")[0]) for word in words]
                    corners = [c - 1 if c >= 0 else len(vertices) + c for c in corners]
                    triangles += [(corners[0], *pair) for pair in pairwise(corners[1:])]
            except ValueError:
                bad = f"{path} is not a mesh: line {number} reads {line[:40]!r}"
                raise ValueError(bad) from None
    if not triangles:
        raise ValueError(f"{path} is not a mesh, or an empty one: it has no faces")
    return np.array(vertices).reshape(-1, 3), np.array(triangles)


def _columns(vertices, triangles, shape):
    """Where vertical rays through the centres of `shape` CELL cells meet the triangles.

    Returns cell indices i, j, heights z (m), all (H,), sorted by cell, then from below.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    corners = np.stack([a, b, c])[..., :2]
    origin = np.array([0.0, -shape[1] * CELL / 2])
    low = np.ceil((corners.min(0) - origin) / CELL - 0.5).astype(int).clip(0, shape)
    high = np.floor((corners.max(0) - origin) / CELL - 0.5).astype(int) + 1
    wide = np.maximum(high.clip(0, shape) - low, 0)
    cross = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    count = np.where(np.abs(cross) > 1e-12, wide.prod(1), 0)
    t = np.repeat(np.arange(len(triangles)), count)  # one row for each cell under a triangle's box
    k = np.arange(len(t)) - np.repeat(np.cumsum(count) - count, count)
    i, j = low[t, 0] + k // wide[t, 1], low[t, 1] + k % wide[t, 1]
    p = np.stack([i, j], 1) * CELL + CELL / 2 + origin - a[t, :2]
    ab, ac = (b - a)[t], (c - a)[t]
    u = (p[:, 0] * ac[:, 1] - p[:, 1] * ac[:, 0]) / cross[t]
    v = (ab[:, 0] * p[:, 1] - ab[:, 1] * p[:, 0]) / cross[t]
    inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
    i, j, z = i[inside], j[inside], (a[t, 2] + u * ab[:, 2] + v * ac[:, 2])[inside]
    order = np.lexsort((z, j, i))
    return i[order], j[order], z[order]


def load_mesh(path, scale=1.0, up="z"):
    """A scanned building as a Terrain (paper section 3 takes its offices from Gibson).

    The floor is the most common height with HEADROOM above it, found by vertical rays; the route
    one of 9 to 12 m on it, or as long as is found. The mesh is moved: x from 0, y around 0.

    path: a Wavefront .obj file. scale: metres a unit. up: "z" or "y", the file's upward axis.
    Raises FileNotFoundError, or ValueError for a bad scale or axis, a file that is no mesh or an
    empty one, numbers that are not finite, more than PyBullet takes, and a mesh without a floor.
    """
    if not 0 < scale < np.inf:
        raise ValueError(f"scale must be above 0 and finite, got {scale}")
    if up not in ("y", "z"):
        raise ValueError(f"up must be 'y' or 'z', got {up!r}")
    vertices, triangles = _read_obj(path)
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path} has vertices that are not finite numbers")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise ValueError(f"{path} is not a mesh: a face names a vertex that is not there")
    if len(vertices) > MAX_VERTICES or triangles.size > MAX_INDICES:
        raise ValueError(f"{path} is too large for PyBullet: {len(vertices)} vertices (at most "
                         f"{MAX_VERTICES}), {triangles.size} indices (at most {MAX_INDICES})")
    if up == "y":
        vertices = np.stack([vertices[:, 2], vertices[:, 0], vertices[:, 1]], 1)
    vertices = vertices * scale
    low, high = vertices.min(0)[:2], vertices.max(0)[:2]
    middle, half = (low + high) / 2, np.minimum((high - low) / 2, WINDOW / 2)
    shape = np.maximum(np.ceil(2 * half / CELL).astype(int), 3)
    vertices = vertices - [middle[0] - half[0], middle[1], 0]
    i, j, z = _columns(vertices, triangles, shape)
    above = np.append(z[1:], np.inf)
    above[np.append((np.diff(i) != 0) | (np.diff(j) != 0), True)] = np.inf
    floor = above - z >= HEADROOM
    i, j, z = i[floor], j[floor], z[floor]
    bins, counts = np.unique(np.round(z / 0.1), return_counts=True)
    for level in bins[np.argsort(-counts)][:5] * 0.1:  # floors, the most common first
        plan = np.full(shape, z.min() - 10)
        order = np.argsort(-np.abs(z - level), kind="stable")  # the nearest is written last
        plan[i[order], j[order]] = z[order]
        ground = Ground(plan, (CELL, CELL))
        rng = np.random.default_rng(0)
        for least in np.repeat((9, 6, 4, 2, 1), 5):
            # Where there is no floor the plan lies far below: nobody starts or ends there.
            routes = _routes(ground, rng, 1, (least, 12), floor=z.min())
            if routes:
                return Terrain(Path(path).stem, vertices, triangles, *routes, ground)
    raise ValueError(f"{path} has no floor to walk on: is scale {scale}, or up {up!r}, right?")
