"""Tasks and worlds: what they are, that they can be walked, and that the mesh is the ground."""

import inspect
import sys
from collections import Counter, deque
from heapq import heappop, heappush
from pathlib import Path
from types import CodeType, FunctionType

import numpy as np
import pybullet
import pybullet_data
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

import terrain
from terrain import CELL, LEVEL, WORLDS, L, Navigation, load_scan, make_terrain, make_world

DATA = Path(pybullet_data.getDataPath())
CLIMB = 0.12  # m, the highest step on the way in a scan
SHORT, LONG = 0.94, 1.06  # what Navigation promises of its lengths
HEIGHTS = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=9),
                 elements=st.sampled_from([-1.0, 0.0, 0.05, 0.5, 2.0]))


def rng(seed=0):
    return np.random.default_rng(seed)


def place_of(heights, cell=CELL):
    return terrain.Terrain("a", None, None, None, None, heights, cell)


def rays_down(mesh, x, y, top=30.0):
    """Where rays straight down from `top` first meet a mesh in Bullet: (N,) z, or nan."""
    client = pybullet.connect(pybullet.DIRECT)
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH, vertices=mesh[0].tolist(), indices=mesh[1].ravel().tolist(),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH, physicsClientId=client)
    pybullet.createMultiBody(0, shape, physicsClientId=client)
    hits = []
    for k in range(0, len(x), 1000):
        ends = [np.c_[x, y, np.full(len(x), end)][k : k + 1000].tolist() for end in (top, -30)]
        hits += pybullet.rayTestBatch(*ends, physicsClientId=client)
    pybullet.disconnect(client)
    return np.array([hit[3][2] if hit[0] >= 0 else np.nan for hit in hits])


def mesh_of(place):
    return place.vertices, place.triangles


def volume(vertices, triangles):
    """By the divergence theorem: above 0 if triangles turn counter-clockwise from outside."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return (a * np.cross(b, c)).sum() / 6


def shortest(free, start):
    """Lengths of the shortest ways over the eight neighbours by Dijkstra, m."""
    best, queue = np.full(free.shape, np.inf), [(0.0, *start)]
    while queue:
        length, i, j = heappop(queue)
        if length >= best[i, j]:
            continue
        best[i, j] = length
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            if free[i + a, j + b]:
                heappush(queue, (length + CELL * np.hypot(a, b), i + a, j + b))
    return best


def reachable(place, climb, start, goal):
    """Whether a disc of 0.25 m can roll from start to goal: breadth-first search.

    Holes up to 0.2 m across are stepped over: a low cell between two high ones counts as high.
    """
    size = np.array(place.heights.shape) * place.cell
    x, y = np.arange(0.05, size[0], 0.1), np.arange(0.05, size[1], 0.1) - size[1] / 2
    z = place.height(*np.meshgrid(x, y, indexing="ij"))
    for axis in (0, 1):
        z = np.moveaxis(z, axis, 0)
        filled = z.copy()
        for gap in (1, 2):
            for k in range(1, len(z) - gap):
                level = np.minimum(z[k - 1], z[k + gap])
                filled[k : k + gap] = np.maximum(filled[k : k + gap], level)
        z = np.moveaxis(filled, 0, axis)
    free = np.zeros(z.shape, bool)
    free[2:-2, 2:-2] = True
    for axis in (0, 1):  # the two cells at either side of a step are not free, nor beside them
        for i, j in np.argwhere(np.abs(np.diff(z, axis=axis)) > climb + 1e-6):
            end_i, end_j = i + 2 + (axis == 0), j + 2 + (axis == 1)
            free[max(i - 1, 0) : end_i, max(j - 1, 0) : end_j] = False
    cells = [(np.argmin(abs(x - p[0])), np.argmin(abs(y - p[1]))) for p in (start, goal)]
    queue, seen = deque(cells[:1]), set(cells[:1])
    while queue:
        i, j = queue.popleft()
        for near in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if near not in seen and free[near]:
                seen.add(near)
                queue.append(near)
    return cells[1] in seen


def check_route(place, start, goal, least, most):
    """A robot of any yaw can stand on the start; z is the ground's; the goal is not too far."""
    u, v = np.mgrid[-0.45:0.46:0.03, -0.45:0.46:0.03]
    disc = np.hypot(u, v) <= 0.45
    assert np.ptp(place.height(start[0] + u[disc], start[1] + v[disc])) <= LEVEL
    # Of pillars finer than the navigation grid the highest in a cell counts.
    finer = 0.12 if place.cell < CELL else 0.0
    for spot in (start, goal):
        assert spot[2] == pytest.approx(float(place.height(*spot[:2])), abs=finer)
    assert least <= np.hypot(*(goal - start[:3])[:2]) <= most


def yaw_to(start, goal):
    return pytest.approx(np.arctan2(goal[1] - start[1], goal[0] - start[0]))


# ---------------------------------------------------------------- meshes


def test_fused_mesh_of_two_by_two_pillars_by_hand():
    vertices, triangles = terrain.fuse_pillars(np.array([[0.0, 1.0], [1.0, 1.0]]), 0.5)
    # Tops: (0, 0) alone, (0, 1) alone, the row (1, 0)-(1, 1) as one. Walls: between (0, 0) and each
    # of its two neighbours. Five quads of four corners and two triangles each.
    assert vertices.shape == (20, 3) and triangles.shape == (10, 3)
    assert vertices.min(0) == pytest.approx([0, -0.5, 0])
    assert vertices.max(0) == pytest.approx([1, 0.5, 1])
    assert len(terrain.fuse_pillars(np.full((60, 40), 0.3), L)[1]) == 2 * 60  # a row is one top


@settings(max_examples=40, deadline=None)
@given(HEIGHTS)
def test_the_faces_of_pillars_are_those_that_are_seen_once_each_and_from_outside(heights):
    vertices, triangles = terrain.fuse_pillars(heights, L)
    place = place_of(heights, L)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal, centre = np.cross(b - a, c - a) / 2, (a + b + c) / 3
    area = np.linalg.norm(normal, axis=1)
    out, inside = (centre + side * normal / area[:, None] * 1e-3 for side in (1, -1))
    assert (out[:, 2] > place.height(*out.T[:2])).all()
    assert (inside[:, 2] < place.height(*inside.T[:2])).all()
    top = normal[:, 2] > 0
    assert area[top].sum() == pytest.approx(heights.size * L * L)
    walls = sum(np.abs(np.diff(heights, axis=k)).sum() * L for k in (0, 1))
    assert area[~top].sum() == pytest.approx(walls)
    assert len({tuple(sorted(map(tuple, vertices[t].round(6)))) for t in triangles}) == len(area)


@settings(max_examples=15, deadline=None)
@given(HEIGHTS, st.integers(0, 99))
def test_a_ray_down_meets_the_pillars_height(heights, seed):
    i, j = (rng(seed).integers(n, size=50) for n in heights.shape)
    x, y = (i + rng(seed).uniform(0.05, 0.95, 50)) * L, (j + rng(seed).uniform(0.05, 0.95, 50)) * L
    y -= heights.shape[1] * L / 2
    z = rays_down(terrain.fuse_pillars(heights, L), x, y)
    np.testing.assert_allclose(z, heights[i, j], atol=1e-4)
    np.testing.assert_array_equal(place_of(heights, L).height(x, y), heights[i, j])


def test_height_by_hand_and_outside():
    place = place_of(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), 0.5)  # 1 m x 1.5 m
    assert place.height(0.7, 0.3) == 6 and place.height(0.1, 0.0) == 2
    x, y = np.array([[0.2, -0.01, 1.01], [0.9, 0.2, np.nan]]), np.array([[-0.7], [0.7]])
    np.testing.assert_array_equal(place.height(x, y), [[1, -np.inf, -np.inf], [6, 3, -np.inf]])
    assert place.height(0.2, 0.76) == place.height(0.2, -0.76) == -np.inf


def test_smooth_ground_goes_through_its_nodes():
    nodes = rng().uniform(-0.5, 0.5, (9, 7))
    vertices, triangles = terrain.triangulate(nodes, 0.3)
    i, j = np.indices(nodes.shape)
    np.testing.assert_allclose(
        vertices, np.c_[i.ravel() * 0.3, (j.ravel() - 3) * 0.3, nodes.ravel()])
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.allclose(normal[:, 2], 0.09) and len(triangles) == 2 * 8 * 6  # half a square each
    assert np.ptp(vertices[triangles][..., :2], 1).max() < 0.3 + 1e-9


@settings(max_examples=40, deadline=None)
@given(st.integers(3, 9), st.floats(0.1, 3), st.floats(-2, 2), st.floats(0.05, 2))
def test_a_prism_is_closed_and_of_the_right_volume(corners, stretch, bottom, height):
    turn = np.sort(rng(corners).uniform(0, 2 * np.pi, corners))
    x, y = polygon = np.array([stretch * np.cos(turn), np.sin(turn)])
    vertices, triangles = terrain.prism(polygon.T, bottom, bottom + height)
    area = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert volume(vertices, triangles) == pytest.approx(area * height)
    edges = Counter((int(t[k - 1]), int(t[k])) for t in triangles for k in range(3))
    assert set(edges.values()) == {1} and all((b, a) in edges for a, b in edges)
    joined = terrain.join([(vertices, triangles), (vertices * 2, triangles)] * 2)
    assert volume(*joined) == pytest.approx(2 * (1 + 8) * area * height)


# ---------------------------------------------------------------- navigation


def some_ground(seed, shape=(12, 10)):
    """Level ground with boxes, holes and low bumps of 0.4 m a side, 4.8 x 4 m."""
    heights = rng(seed).choice([0.0, 0.04, 0.5, -0.5], shape, p=[0.85, 0.09, 0.03, 0.03])
    return np.kron(heights, np.ones((4, 4)))


@pytest.mark.parametrize("seed", range(3))
def test_free_is_where_a_disc_meets_no_step(seed):
    """Against the distances from each cell's middle to all lines between unequal cells."""
    heights = some_ground(seed)
    nav = Navigation(heights, CELL, LEVEL)
    np.testing.assert_array_equal(nav.z, heights)
    x, y, far = nav.x / CELL, nav.y / CELL + 20, np.full(heights.shape, np.inf)
    for i, j in np.argwhere(np.abs(np.diff(heights, axis=0)) > LEVEL):
        far = np.minimum(far, CELL * np.hypot(x - i - 1, y - y.clip(j, j + 1)))
    for i, j in np.argwhere(np.abs(np.diff(heights, axis=1)) > LEVEL):
        far = np.minimum(far, CELL * np.hypot(x - x.clip(i, i + 1), y - j - 1))
    border = np.minimum(np.minimum(nav.x, 4.8 - nav.x), 2 - abs(nav.y))
    assert (far[nav.free] > 0.249).all() and (border[nav.free] > 0.249).all()
    blocked = ~nav.free & (border > 0.249)
    assert (far[blocked] < 0.25 * 2**0.5).all()  # the disc's square may do so, at its corners
    for i, j in np.argwhere(nav.free):
        around = heights[max(i - 5, 0) : i + 6, max(j - 5, 0) : j + 6]
        assert nav.stand[i, j] == (np.ptp(around) <= LEVEL)
    assert not (nav.stand & ~nav.free).any() and nav.stand.any()


@pytest.mark.parametrize("cells, crossed", [(1, True), (2, True), (3, False)])
def test_legs_step_over_trenches_of_two_cells(cells, crossed):
    heights = np.zeros((40, 20))
    heights[20 : 20 + cells] = -0.5
    nav = Navigation(heights, CELL, LEVEL)
    assert np.isfinite(nav.distance((5, 10))[35, 10]) == crossed
    assert (nav.solid[20 : 20 + cells] != crossed).all() and nav.solid[:20].all()


@pytest.mark.parametrize("cell", [0.05, L / 3, L / 2, L, 0.25])
def test_every_pillar_is_seen_whatever_its_cross_section(cell):
    """A single pillar in the way, wherever it is: nothing is free around it."""
    for k in range(30, 36):
        heights = np.zeros((70, 70))
        heights[k, k + 1] = 1.0
        nav = Navigation(heights, cell, terrain.STEP)
        x, y = (k + 0.5) * cell, (k + 1.5 - 35) * cell
        beside = np.maximum(abs(nav.x - x), abs(nav.y - y)) < cell / 2 + 0.15
        assert not nav.free[beside].any(), k


def test_distances_in_the_open_are_right_to_6_percent():
    nav = Navigation(np.zeros((120, 110)), CELL, LEVEL)
    far = nav.distance((60, 50))
    straight = np.hypot(nav.x - nav.x[60, 50], nav.y - nav.y[60, 50])[nav.free]
    assert (far[nav.free] >= SHORT * straight - CELL).all()
    assert (far[nav.free] <= LONG * straight + CELL).all()
    assert np.isinf(far[~nav.free]).all() and far[60, 50] == 0


@pytest.mark.parametrize("seed", range(4))
def test_distances_and_ways_around_things(seed):
    """Against Dijkstra's on the eight neighbours, which itself is up to 8.3 % too long."""
    nav = Navigation(some_ground(seed), CELL, LEVEL)
    cells = np.argwhere(nav.free)
    start = tuple(cells[len(cells) // 2])
    true, far = shortest(nav.free, start), nav.distance(start)
    np.testing.assert_array_equal(np.isfinite(far), np.isfinite(true))
    met = np.isfinite(true)
    assert (far[met] <= LONG * true[met] + CELL).all()
    assert (far[met] >= SHORT / 1.083 * true[met] - CELL).all()
    for cell in map(tuple, cells[::37]):
        way = nav.way(cell, start)
        assert (way is None) == (not met[cell])
        if way is not None:
            assert np.allclose(way[[0, -1]], [(nav.x[c], nav.y[c]) for c in (cell, start)])
            i, j = np.round(way / CELL - 0.5 + (0, nav.free.shape[1] / 2)).astype(int).T
            steps = np.abs(np.diff(np.c_[i, j], axis=0))
            assert nav.free[i, j].all() and steps.max(initial=1) == 1
            assert np.hypot(*steps.T).sum() * CELL <= 1.12 * true[cell] + CELL
    x, y = rng(seed).uniform((0, -2), (5, 2))
    assert nav.cell(x, y) == min(map(tuple, cells),
                                 key=lambda c: np.hypot(nav.x[c] - x, nav.y[c] - y))


def hall(door=0.0):
    """8 x 6 m, a wall at x = 4 m with a doorway of `door` m at its low end in y."""
    heights = np.zeros((80, 60))
    heights[39:41] = 1.0
    heights[39:41, 5 : 5 + round(door / CELL)] = 0.0
    return heights


@pytest.mark.parametrize("reach, detour, zones", [
    ((3, 4.5), (1.3, 2.0), ((0, 3.0), (5.0, np.inf))), ((2, 6), (0, 1.03), ((0, 8),))])
def test_routes_keep_all_that_was_asked_for(reach, detour, zones):
    nav = Navigation(hall(1.0), CELL, LEVEL)
    starts, goals = terrain.find_routes(nav, rng(), 6, reach, detour, zones, margin=0.8)
    assert starts.shape == (6, 4) and goals.shape == (6, 3)
    for k, (start, goal) in enumerate(zip(starts, goals, strict=True)):
        check_route(place_of(hall(1.0)), start, goal, *reach)
        assert start[3] == yaw_to(start, goal)
        assert zones[k % len(zones)][0] <= start[0] <= zones[k % len(zones)][1]
        for x, y in (start[:2], goal[:2]):
            assert 0.8 <= x <= 7.2 and abs(y) <= 2.2
        way = shortest(nav.free, nav.cell(*start[:2]))[nav.cell(*goal[:2])]
        far = np.hypot(*(goal - start[:3])[:2])
        assert SHORT * detour[0] * far <= way <= LONG * 1.083 * detour[1] * far
    assert len({tuple(start) for start in starts}) > 3


def test_routes_stay_above_the_floor():
    heights = np.zeros((80, 60))
    heights[30:] = -1.2
    nav = Navigation(heights, CELL, LEVEL)
    for seed in range(5):
        (start,), (goal,) = terrain.find_routes(nav, rng(seed), 1, (1, 3), floor=-0.5)
        assert start[2] == goal[2] == 0
    (start,), (goal,) = terrain.find_routes(nav, rng(0), 1, (1, 3), zones=((4, 8),))
    assert start[2] == goal[2] == -1.2


@pytest.mark.parametrize("door, asked", [
    (0.0, dict(reach=(6, 9))), (1.0, dict(reach=(10, 20))), (1.0, dict(floor=0.1)),
    (1.0, dict(zones=((9, 12),))), (1.0, dict(margin=4.0)), (1.0, dict(detour=(9, 12))),
    (1.0, dict(zones=((3.5, 4.5),)))])
def test_there_is_no_route_where_there_can_be_none(door, asked):
    nav = Navigation(hall(door), CELL, LEVEL)
    assert terrain.find_routes(nav, rng(), 2, **{"reach": (1, 9)} | asked) is None


# ---------------------------------------------------------------- tasks


@pytest.mark.parametrize("difficulty", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("task", terrain.PILLAR_TASKS)
def test_tasks_can_be_stood_on_and_walked(task, difficulty):
    place = make_terrain(task, rng(7), difficulty)
    size, pad = np.array(place.heights.shape) * place.cell, round(1.8 / place.cell)
    assert place.name == task and size == pytest.approx([12, 8])
    assert place.climb == (0.05 if task in ("ridges", "hills") else terrain.STEP)
    assert np.isfinite(place.vertices).all() and place.triangles.max() < len(place.vertices)
    assert len(place.triangles) < (45_000 if task == "hills" else 16_000)
    fence = min(1.2, 4 * difficulty) if hasattr(terrain.PILLAR_TASKS[task], "fence") else 0
    for strip in (place.heights[:pad], place.heights[-pad:]):
        assert np.ptp(strip[1:-1, 1:-1]) == 0 and np.ptp(strip) == fence
    assert place.starts.shape == (8, 4) and place.goals.shape == (8, 3)
    for k, (start, goal) in enumerate(zip(place.starts, place.goals, strict=True)):
        check_route(place, start, goal, 6, 9)
        assert 1 <= min(start[0], goal[0]) and max(start[0], goal[0]) <= 11
        assert max(abs(start[1]), abs(goal[1])) <= 3
        assert k % 3 == 2 or (start[0] <= 1.8, start[0] >= 10.2)[k % 3]
        assert (start[3] == yaw_to(start, goal)) == (k % 3 != 2)  # every third looks any way
    assert all(reachable(place, place.climb, place.starts[k], place.goals[k]) for k in range(3))


@pytest.mark.parametrize("task", terrain.PILLAR_TASKS)
def test_a_task_is_short_easy_at_first_and_not_at_last(task):
    generate = terrain.PILLAR_TASKS[task]
    assert len(inspect.getsource(generate).splitlines()) <= 10 and generate.__doc__
    assert np.ptp(generate(rng(), 0.0)) < 0.01
    hard = [np.ptp(generate(rng(seed), 1.0)) for seed in range(5)]
    assert min(hard) >= 0.1 or task == "flat"


@pytest.mark.parametrize("task, low, high, step", [
    ("flat", 0, 0, 0), ("rugged", 0, 0.18, 0.18), ("holes", -1, 0, 1), ("obstacles", 0, 1, 1),
    ("stairs", 0, 1.26, 0.18), ("slopes", -2.101, 2.101, 0.141), ("pyramids", -0.9, 0.9, 0.18),
    ("pits", -1.2, 0, 1.2), ("causeways", -1.2, 0, 1.2), ("corridors", 0, 1.2, 1.2),
    ("walls", 0, 1.2, 1.2), ("screens", 0, 1.2, 1.2), ("traps", 0, 1.2, 1.2),
    ("poles", 0, 1.2, 1.2)])
def test_heights_and_steps_are_as_told(task, low, high, step):
    """At full difficulty, between neighbours, behind the fence."""
    for seed in range(4):
        h = make_terrain(task, rng(seed), 1.0).heights[1:-1, 1:-1]
        assert low - 1e-9 <= h.min() and h.max() <= high + 1e-9
        assert max(np.abs(np.diff(h, axis=k)).max() for k in (0, 1)) <= step + 1e-9


def test_the_same_generator_gives_the_same_terrain():
    for task in ("rugged", "corridors", "traps"):
        one, two, other = (make_terrain(task, rng(seed), 0.7) for seed in (3, 3, 4))
        np.testing.assert_array_equal(one.vertices, two.vertices)
        np.testing.assert_array_equal(one.goals, two.goals)
        assert not np.array_equal(one.heights, other.heights)


def test_a_function_of_another_size_is_a_task():
    def ditch(rng, difficulty):
        heights = np.zeros((80, 30))
        heights[40] = -difficulty
        return heights

    place = make_terrain(ditch, rng(), 0.5)
    assert place.name == "ditch" and place.height(40.5 * L, 0.0) == -0.5
    assert make_terrain(place, None, None) is place
    ditch.cell, ditch.fence = 0.15, True
    place = make_terrain(ditch, rng(), 0.25)  # 12 m x 4.5 m
    assert place.cell == 0.15 and place.vertices.max(0) == pytest.approx([12, 2.25, 1.0])
    assert (place.heights[[0, -1]] == 1).all() and (place.heights[:, [0, -1]] == 1).all()
    assert (place.heights[1:12, 1:-1] == 0).all() and place.heights[40, 5] == -0.25


@pytest.mark.parametrize("task, difficulty, named", [
    ("lava", 0.5, "lava.*flat.*poles"), ("flat", 2, "2"), ("flat", -0.1, "-0.1"),
    ("flat", np.nan, "nan"), (lambda rng, d: np.zeros(5), 0.5, r"2-D.*\(5,\)"),
    (lambda rng, d: np.zeros((60, 40, 2)), 0.5, r"2-D.*\(60, 40, 2\)"),
    (lambda rng, d: np.full((60, 40), np.nan), 0.5, "finite"),
    (lambda rng, d: np.full((60, 40), np.inf), 0.5, "finite"),
    (lambda rng, d: np.zeros((0, 40)), 0.5, r"2-D.*\(0, 40\)"),
    (lambda rng, d: np.indices((60, 20)).sum(0) % 2 * 9.0, 0.5, r"route.*\(60, 20\)"),
    (None, 0.5, "None")])
def test_bad_tasks_are_named(task, difficulty, named):
    with pytest.raises(ValueError, match=named):
        make_terrain(task, rng(), difficulty)


# ---------------------------------------------------------------- worlds


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_can_be_stood_on_and_walked(name):
    made, layouts = WORLDS[name], []
    for seed in range(10):
        world = make_world(name, seed)
        (start,), (goal,) = world.starts, world.goals
        check_route(world, start, goal, *made.goal)
        assert start[3] == yaw_to(start, goal) and world.climb == made.climb
        assert len(world.triangles) < 20_000 and world.triangles.max() < len(world.vertices)
        assert np.isfinite(world.heights).all() and len(world.people) == made.people
        layouts.append(world.heights)
        if seed < 2:
            assert reachable(world, made.climb, start, goal)
            nav = Navigation(world.heights, CELL, made.climb)
            way = shortest(nav.free, nav.cell(*start[:2]))[nav.cell(*goal[:2])]
            way /= np.hypot(*(goal - start[:3])[:2])
            assert SHORT * made.detour[0] <= way <= LONG * 1.083 * made.detour[1]
    again = make_world(name, 9)
    np.testing.assert_array_equal(world.vertices, again.vertices)
    np.testing.assert_array_equal(world.goals, again.goals)
    assert not any(np.array_equal(one, layouts[-1]) for one in layouts[:-1])


@pytest.mark.parametrize("name", WORLDS)
def test_the_height_of_a_world_is_its_mesh(name):
    for seed in (1, 2):
        world = make_world(name, seed)
        length, width = np.array(world.heights.shape) * CELL
        x, y = rng().uniform([0, -width / 2], [length, width / 2], (2000, 2)).T
        above = world.height(x, y) - rays_down(mesh_of(world), x, y)
        # Trunks and rocks fill all cells that they touch; slopes rise by up to 0.1 m in a cell.
        assert np.mean(np.abs(above) < 0.1) > 0.9 and np.mean(above > -0.1) > 0.998
        trunk = world.height(x, y) > 1.9
        assert name != "forest" or np.mean(np.abs(above[trunk]) < 0.1) > 0.35


def test_walls_of_the_maze_and_its_corridors():
    for corridor in (1.2, 1.5):
        heights = make_world("maze", 0, numbers=dict(opened=0.5, corridor=corridor)).heights
        wide = round(corridor / CELL) + 1
        assert set(np.unique(heights)) == {0.0, 1.3} and (heights[::wide, ::wide] == 1.3).all()
        middles = heights[wide // 2 :: wide, wide // 2 :: wide]
        assert middles.shape == (7, 5) and (middles == 0).all()


def test_slopes_of_mountain_and_continuous():
    """5 % of the bare ground is steeper than was asked for: what is no level spot, nor rock."""
    for name, degrees in (("mountain", 20), ("continuous", 26)):
        numbers, steep = WORLDS[name].numbers | {"degrees": degrees}, []
        for seed in range(4):
            vertices, triangles = mesh_of(make_world(name, seed, numbers=numbers, detour=(0, 9)))
            a, b, c = (vertices[triangles[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            normal = normal[np.isclose(normal[:, 2], 0.04)]  # m^2, squares of 0.2 m
            cosine = normal[:, 2] / np.linalg.norm(normal, axis=1)
            steep.append(np.degrees(np.arccos(np.percentile(cosine, 5))))
        assert degrees - 3 <= np.mean(steep) <= degrees + 1


def test_the_cliffs_path_is_narrow_and_the_drop_deep():
    for seed in range(4):
        plan = make_world("cliff", seed).heights
        path = plan > -0.5
        assert (plan[~path] == -1.2).all() and np.abs(plan[path]).max() <= 0.02
        width = path[30:100].sum(1) * CELL  # along y: a winding path looks wider
        assert 0.9 <= width.min() and np.median(width) <= 2.2


def test_doorways_of_the_offices():
    for seed in range(4):
        heights = make_world("office1", seed).heights
        for wall in (40, 57):  # of the corridor
            row = "".join("#" if h == 2.5 else "." for h in heights[:, wall])
            doors = [len(gap) for gap in row.split("#") if gap]
            assert len(doors) >= 2 and set(doors) <= {9, 10}  # 0.9-1.0 m


@pytest.mark.parametrize("name, seed, changes, named", [
    ("moon", 0, {}, "moon.*maze.*continuous"), (None, 0, {}, "None"), ("maze", -1, {}, "-1"),
    ("maze", 1.5, {}, "1.5"), ("maze", "x", {}, "'x'"),
    ("maze", 3, dict(numbers=dict(opened=0, corridor=0.4)), "maze.*no walkable route.*3")])
def test_bad_worlds_are_named(name, seed, changes, named):
    with pytest.raises(ValueError, match=named):
        make_world(name, seed, **changes)


def helpers(function):
    """Names of the functions of terrain.py that a function calls, or those that it calls."""
    found, codes = set(), [function.__code__]
    while codes:
        code = codes.pop()
        codes += [part for part in code.co_consts if isinstance(part, CodeType)]
        for name in code.co_names:
            called = getattr(terrain, name, None)
            ours = isinstance(called, FunctionType) and called.__module__ == "terrain"
            if ours and name not in found:
                found.add(name)
                codes.append(called.__code__)
    return found


def test_no_training_task_shares_a_helper_with_an_unseen_world():
    trained = set().union(*map(helpers, terrain.PILLAR_TASKS.values()))
    unseen = set().union(*(helpers(world.build) for world in WORLDS.values()))
    assert {"_boxes", "_tracks", "_barrier"} <= trained and {"_fractal", "_furnish"} <= unseen
    assert not trained & unseen and not {*terrain.PILLAR_TASKS} & unseen


# ---------------------------------------------------------------- people


def test_a_person_walks_to_and_fro_at_his_speed():
    person = terrain.Person(np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)]), 0.5, along=0.25)
    seen = []
    for _ in range(120):  # 12 s and 6 m
        seen.append(person.place())
        person.walk(0.1, (50.0, 50.0))
    x, y, yaw = np.array(seen).T
    assert seen[0] == pytest.approx((0.25, 0, 0)) and seen[20] == pytest.approx((1.25, 0, 0))
    assert seen[45] == pytest.approx((2, 0.5, np.pi / 2))
    assert seen[75][:2] == pytest.approx((2, 0), abs=0.06)  # 0.25 + 3.75 m: back at the corner
    assert yaw[60] == pytest.approx(-np.pi / 2) and abs(yaw[100]) == pytest.approx(np.pi)
    assert (np.minimum(abs(y), abs(x - 2)) < 1e-9).all()  # never off his path
    steps = np.hypot(np.diff(x), np.diff(y))
    assert np.median(steps) == pytest.approx(0.05) and steps.max() < 0.05 + 1e-9


def test_a_person_waits_for_a_robot_ahead_and_turns_back():
    person = terrain.Person(np.array([(0.0, 0.0), (9.0, 0.0)]), 1.0)
    while person.waited == 0:
        person.walk(0.1, (5.0, 0.3))
    x = person.place()[0]
    assert 0.999 <= np.hypot(5 - x, 0.3) <= 1.1  # he stops within 0.1 m of coming that near
    for _ in range(28):
        person.walk(0.1, (5.0, 0.3))
        assert person.place()[:2] == (x, 0)
    for _ in range(10):  # 3 s are over: away from the robot, which is behind him now
        person.walk(0.1, (5.0, 0.3))
    x, _, yaw = np.subtract(person.place(), (x, 0, 0))
    assert -1 < x < -0.5 and abs(yaw) == pytest.approx(np.pi)


def test_a_person_who_waited_goes_on_when_the_robot_does():
    person = terrain.Person(np.array([(0.0, 0.0), (9.0, 0.0)]), 1.0, along=4.5)
    for _ in range(3):
        for _ in range(25):
            person.walk(0.1, (5.0, 0.0))
        assert person.place()[0] == pytest.approx(4.5) and person.direction == 1
        person.walk(1e-6, (5.0, 9.0))  # the robot is gone for a moment: patience begins anew
    for robot in ((4.0, 0.0), (4.4, 0.4), (5.7, 0.0)):
        before = person.place()[0]
        person.walk(0.1, robot)
        assert (person.place()[0] > before) == (robot[0] < 5)  # not for one behind


def test_people_of_dynamic_stand_off_and_never_walk_through_walls():
    for seed in range(5):
        world = make_world("dynamic", seed)
        for person in world.people:
            x, y, _ = person.place()
            assert np.hypot(*np.subtract((x, y), world.starts[0, :2])) >= 1.5
            assert 0.5 <= person.speed <= 1.2 and person.mileage[-1] >= 4
            along = np.linspace(0, person.mileage[-1], 300)
            x, y = (np.interp(along, person.mileage, person.path[:, k]) for k in (0, 1))
            for angle in np.arange(0, 6.28, 0.4):  # his whole body stands on the free floor
                body = world.height(x + 0.24 * np.cos(angle), y + 0.24 * np.sin(angle))
                assert (body == 0).all()


# ---------------------------------------------------------------- scanned buildings


def quad(*corners):
    return np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)])


def level(x0, y0, x1, y1, z):
    return quad((x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z))


def upright(x0, y0, x1, y1, top=2.5):
    return quad((x0, y0, 0), (x1, y1, 0), (x1, y1, top), (x0, y0, top))


def box(x0, y0, x1, y1, bottom, top):
    return terrain.prism(level(x0, y0, x1, y1, 0)[0][:, :2], bottom, top)


def room(*things, ceiling=True):
    """8 x 6 m, 2.5 m high, walls without thickness."""
    walls = upright(0, 0, 8, 0), upright(8, 0, 8, 6), upright(8, 6, 0, 6), upright(0, 6, 0, 0)
    return [level(0, 0, 8, 6, 0), *walls, *[level(0, 0, 8, 6, 2.5)] * ceiling, *things]


TABLES = [box(2, 2, 3.5, 3.2, 0, 0.4), box(5, 3, 6.5, 4.5, 0.36, 0.4)]  # solid, and a top alone


def saved(path, parts, change=lambda corners: corners):
    vertices, triangles = terrain.join(parts)
    trimesh.Trimesh(change(vertices), triangles, process=False).export(path)
    return path


@pytest.mark.parametrize("file, ceiling, change, options", [
    ("a.obj", True, None, {}), ("a.ply", True, None, {}), ("a.stl", True, None, {}),
    ("a.glb", True, None, {}), ("a.obj", False, None, {}),
    ("a.glb", True, lambda v: v[:, [1, 2, 0]], {"up": "y"}),
    ("a.obj", False, lambda v: v[:, [1, 2, 0]] * 1000, {"up": "y", "scale": 0.001}),
    ("a.stl", True, lambda v: v / 5, {"scale": 5}),
    ("a.obj", True, lambda v: v - (0, 0, 1500), {}),
    ("a.obj", False, lambda v: v + (5e5, 5e6, 312.34), {})])
def test_a_scanned_room_is_walked_on_its_floor(file, ceiling, change, options, tmp_path):
    """Not on its tables, 0.4 m high, nor on its ceiling."""
    parts = room(*TABLES, ceiling=ceiling)
    place = load_scan(saved(tmp_path / file, parts, change or (lambda v: v)), **options)
    assert place.name == "a" and not place.people
    np.testing.assert_allclose(np.ptp(place.vertices, 0), (8, 6, 2.5), atol=1e-3)
    assert place.vertices[:, 2].min() == pytest.approx(0, abs=0.05)
    # The second table's top is where it was, and not turned inside out.
    low = place.vertices.min(0)
    corners = place.vertices[place.triangles] - low
    top = ((corners > (4.9, 2.9, 0.3)) & (corners < (6.6, 4.6, 0.5))).all((1, 2))
    assert volume(place.vertices, place.triangles[top]) == pytest.approx(0.09, rel=0.02)
    (start,), (goal,) = place.starts, place.goals
    check_route(place, start, goal, 4, 12)
    assert start[3] == yaw_to(start, goal)
    # All around the start, and at the goal, the floor is the next thing below a robot.
    turn = np.arange(0, 2 * np.pi, 0.3)
    x, y = np.c_[goal[:2], start[:2, None] + 0.4 * np.array([np.cos(turn), np.sin(turn)])]
    below = rays_down(mesh_of(place), x, y, 1.0)
    np.testing.assert_allclose(below, place.vertices[:, 2].min(), atol=1e-3)
    assert start[2] == goal[2] == pytest.approx(below[0], abs=1e-3)


HOLED = [level(x, y, x + 0.5, y + 0.5, 0) for x in np.arange(0, 8, 0.5)
         for y in np.arange(0, 6, 0.5) if rng(int(100 * x + y)).random() > 0.1]


@pytest.mark.parametrize("parts", [
    [*HOLED, *room()[1:], *TABLES], room(*TABLES, level(-1, -1, 9, 7, 2.8)),
    [level(0, 0, 8, 6, z) for z in np.arange(0, 20, 0.5)]], ids=["holes", "flat roof", "sheets"])
def test_floors_under_something_odd(parts, tmp_path):
    place = load_scan(saved(tmp_path / "a.obj", parts))
    check_route(place, place.starts[0], place.goals[0], 4, 12)
    assert place.starts[0, 2] == pytest.approx(0, abs=1e-6)
    assert place.vertices[:, 2].max() < 21


@pytest.mark.parametrize("start, end, face", [
    ("", "", "f %d %d %d"), ("\ufeff# a byte order mark\n", "", "f %d %d %d"),
    ("", "", "f %d %d \\\n %d"), ("", "", "f %d %d %d # a remark"),
    ("", "v -500000 -5000000 0\n", "f %d %d %d"),  # which no face uses
], ids=["plain", "byte order mark", "continued", "remark", "unused vertex"])
def test_odd_but_legal_files_are_read(start, end, face, tmp_path):
    vertices, triangles = terrain.join(room(*TABLES))
    lines = ["v {:.3f} {:.3f} {:.3f}".format(*vertex) for vertex in vertices]
    lines += [face % tuple(triangle + 1) for triangle in triangles]
    (tmp_path / "a.obj").write_text(start + "\n".join(lines) + "\n" + end)
    place = load_scan(tmp_path / "a.obj")
    np.testing.assert_allclose(np.ptp(place.vertices, 0), (8, 6, 2.5), atol=1e-3)
    check_route(place, place.starts[0], place.goals[0], 4, 12)


def test_suffixes_may_be_upper_case_and_files_lie_in_pieces(tmp_path):
    lines = saved(tmp_path / "a.obj", room(*TABLES)).read_text().splitlines()
    remarks = [line + " # a remark" * line.startswith("f") for line in lines]
    (tmp_path / "a.OBJ").write_text("\n".join(remarks))
    mesh = trimesh.load(tmp_path / "a.obj", force="mesh")
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
        (tmp_path / name).write_bytes(data)
    for name in ("a.OBJ", "model.gltf"):
        place = load_scan(tmp_path / name)
        np.testing.assert_allclose(np.ptp(place.vertices, 0), (8, 6, 2.5), atol=1e-3)


def test_a_scan_with_nothing_about_its_middle_is_named(tmp_path):
    around = [level(x, y, x + 2, y + 2, 0) for x in (0, 30, 60) for y in (0, 30, 60)
              if (x, y) != (30, 30)]
    with pytest.raises(ValueError, match=r"ring.obj has nothing within 20 m of its middle"):
        load_scan(saved(tmp_path / "ring.obj", around))


def test_a_scan_in_millimetres_is_named_and_a_wide_one_is_cut(tmp_path):
    path = saved(tmp_path / "a.obj", room(), lambda corners: 1000 * corners)
    with pytest.raises(ValueError, match="a.obj is more than 1000 m wide: is scale 1.0 right"):
        load_scan(path)
    ground = terrain.triangulate(np.zeros((61, 61)), 10.0)  # 600 m
    place = load_scan(saved(path, [ground]))
    assert max(place.heights.shape) <= 401


def test_the_floor_is_the_storey_with_most_room(tmp_path):
    """Below, 48 m^2 have something above them; above, one half does. Walls may count as not."""
    parts = [*room(*TABLES), level(0, 0, 8, 6, 2.7), level(0, 0, 4, 6, 5)]
    place = load_scan(saved(tmp_path / "a.obj", parts))
    assert place.starts[0, 2] == place.goals[0, 2] == pytest.approx(0, abs=0.05)
    assert place.vertices[:, 2].max() == pytest.approx(5, abs=0.05)
    assert ((place.heights < 0.5) & (place.heights > -0.1)).sum() > 4000  # no upper floor


@pytest.mark.parametrize("file, scale", [
    ("roboschool/models_outdoor/stadium/stadium.obj", 0.2), ("terrain.obj", 0.4),
    ("plane100.obj", 0.04)])
def test_meshes_that_nobody_made_for_us(file, scale):
    place = load_scan(DATA / file, scale)
    (start,), (goal,) = place.starts, place.goals
    check_route(place, start, goal, 4, 12)
    assert reachable(place, CLIMB, start, goal)
    for x, y, z in (start[:3], goal):
        assert rays_down(mesh_of(place), [x], [y], z + 0.6) == pytest.approx(z, abs=0.02)


@pytest.mark.parametrize("far", [80, 100_000])
def test_a_stray_triangle_far_away_changes_little(far, tmp_path):
    stray = level(far, far, far + 0.01, far + 0.01, 0.0)[0][:3], np.array([(0, 1, 2)])
    for ceiling in (True, False):
        parts = room(*TABLES, stray, ceiling=ceiling)
        place = load_scan(saved(tmp_path / "a.obj", parts))
        assert max(place.heights.shape) <= 120 and place.vertices.max() < 13
        check_route(place, place.starts[0], place.goals[0], 4, 12)


@pytest.mark.parametrize("thing, there", [
    (None, None), (upright(4.03, 0, 4.03, 6), (7, 5)), (box(3.93, 0, 4.07, 6, 0, 2.5), (7, 5)),
    (upright(0, 3, 8, 3.5), (7, 5)), (box(3, 2, 5, 4, 0, 1.8), (4, 3))])
def test_no_way_leads_through_the_walls_of_a_scan_nor_into_its_cupboards(thing, there, tmp_path):
    place = load_scan(saved(tmp_path / "a.obj", room(*[thing] if thing else ())))
    nav = Navigation(place.heights, CELL, CLIMB)
    corner = place.vertices.min(0)[:2] + (0, nav.free.shape[1] / 2 * CELL)
    here, *ends = (tuple(((point + corner) / CELL).astype(int))
                   for point in np.array([(1, 1), there or (4, 3), there or (7, 5)]))
    far = nav.distance(here)
    assert nav.free[here] and all(np.isinf(far[end]) == bool(there) for end in ends)


def test_a_floor_of_two_triangles_may_be_larger_than_what_is_searched(tmp_path, monkeypatch):
    monkeypatch.setattr(terrain, "WINDOW", 4.0)
    for side in (7, 20):
        place = load_scan(saved(tmp_path / "a.obj", [level(0, 0, side, side, 1.0)]))
        assert np.abs(np.subtract(place.heights.shape, 10 * min(side, 8))).max() <= 20
        assert place.starts[0, 2] == pytest.approx(0) == place.goals[0, 2]


def test_a_scan_is_at_most_what_pybullet_takes(tmp_path, monkeypatch):
    """45,000 triangles: with three corners of its own each it would have too many vertices."""
    ground = terrain.triangulate(np.zeros((151, 151)), 0.02)
    place = load_scan(saved(tmp_path / "a.stl", [ground]))
    assert len(place.vertices) <= 131_072 and len(place.triangles) == 45_000
    monkeypatch.setattr(terrain, "MAX_INDICES", 134_999)
    with pytest.raises(ValueError, match="a.stl.*too large.*135000 indices.*134999"):
        load_scan(tmp_path / "a.stl")


CORNERS = "v 0 0 0\nv 9 0 0\nv 9 9 0\nv 0 9 0\n"


@pytest.mark.parametrize("text, options, named", [
    ("v 9 9 0\nv 3 9 0\nv 3 3 0\nv 0 3 0\nv 0 0 0\nv 9 0 0\nf 1 2 3 4 5 6\n", {},
     "more than four corners: triangulate it first"),  # an L, whose fan of triangles is no L
    ("", {}, "a.obj.* 0 triangles"), ("no mesh at all", {}, "a.obj"), (CORNERS, {}, "0 triangles"),
    (CORNERS + "f 1 2 9\n", {}, "a.obj"), ("v nan 0 0\n" + CORNERS + "f 1 2 3\n", {}, "finite"),
    ("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n", {}, "no floor"),
    ("v 0 0 0\nv 9 0 0\nv 9 0 2\nf 1 2 3\n", {}, "no floor"),  # upright
    (CORNERS + "f 1 2 3 4\n", {"scale": 0.01}, "no floor.*0.01"),
    (CORNERS + "f 1 2 3 4\n", {"up": "y"}, "no floor.*'y'"), ("", {"up": "x"}, "'x'"),
    ("", {"scale": 0.0}, "scale.*0.0"), ("", {"scale": -1.0}, "scale.*-1.0"),
    ("", {"scale": np.nan}, "scale.*nan"), ("", {"scale": np.inf}, "scale.*inf")])
def test_bad_scans_are_named(text, options, named, tmp_path):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(ValueError, match=named):
        load_scan(tmp_path / "a.obj", **options)


@pytest.mark.parametrize("name", ["a.ply", "a.stl", "a.glb", "a.txt"])
def test_files_that_are_no_meshes_are_named(name, tmp_path):
    for text in ("", "no mesh at all"):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=name):
            load_scan(str(tmp_path / name))
    for path in (tmp_path / "nothing.obj", tmp_path):
        with pytest.raises(FileNotFoundError, match=path.name):
            load_scan(path)


def test_without_trimesh_the_error_says_what_to_install(tmp_path, monkeypatch):
    path = saved(tmp_path / "a.obj", room())
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError, match="trimesh.*pip install"):
        load_scan(path)


def test_own_terrains_beyond_pybullets_limit_are_named():
    def gravel(rng, difficulty):
        return rng.uniform(0, 0.04, (240, 160))

    gravel.cell = 0.05
    with pytest.raises(ValueError, match="gravel is too large for PyBullet"):
        make_terrain(gravel, np.random.default_rng(0), 0.5)


@pytest.mark.parametrize("name", ["cell", "climb", "friction"])
@pytest.mark.parametrize("value", [(0.2, 0.1), "x", None, 0, -1, 1e-9, np.nan, np.inf])
def test_own_terrains_with_a_bad_attribute_are_named(name, value):
    def mine(rng, difficulty):
        return np.zeros((60, 40))

    setattr(mine, name, value)
    with pytest.raises(ValueError, match=rf"task 'mine': {name} must be from 0.02 to 10,"):
        make_terrain(mine, np.random.default_rng(0), 0.5)
