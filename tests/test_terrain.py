"""Tasks and worlds: what they are, that they can be walked, and that the mesh is the ground."""

import heapq
from collections import deque
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

import terrain
from terrain import PILLAR_TASKS, WORLDS, L, W, fuse_pillars, load_mesh, make_terrain, make_world

DATA = Path(pybullet_data.getDataPath())
NO_CLIMBING = ("maze", "office1", "office2", "dynamic", "forest")


@pytest.fixture
def client():
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(client)


def add_mesh(client, vertices, triangles):
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_MESH, vertices=vertices.tolist(), indices=triangles.ravel().tolist(),
        flags=pybullet.GEOM_FORCE_CONCAVE_TRIMESH, physicsClientId=client,
    )  # fmt: skip
    return pybullet.createMultiBody(0, shape, physicsClientId=client)


def heights_by_rays(client, vertices, triangles, x, y):
    """Where rays straight down meet a mesh in Bullet: (N,) z, or NaN."""
    body = add_mesh(client, vertices, triangles)
    top = vertices[:, 2].max() + 1
    bottom = vertices[:, 2].min() - 1
    z = []
    for k in range(0, len(x), 1000):
        ends = [np.c_[x, y, np.full(len(x), h)][k : k + 1000].tolist() for h in (top, bottom)]
        hits = pybullet.rayTestBatch(*ends, physicsClientId=client)
        z += [hit[3][2] if hit[0] >= 0 else np.nan for hit in hits]
    pybullet.removeBody(body, physicsClientId=client)
    return np.array(z)


def oracle(ground, climb, start, goal, cell=0.1, radius=0.25):
    """Whether a disc can roll from start to goal: plain breadth-first search over `cell`s.

    Holes up to 0.2 m across are stepped over: a low cell between two high ones counts as high.
    """
    length, width = ground.size
    x, y = np.arange(cell / 2, length, cell), np.arange(-width / 2 + cell / 2, width / 2, cell)
    z = np.maximum(ground(*np.meshgrid(x, y, indexing="ij")), -1e3)
    for axis in (0, 1):
        z = np.moveaxis(z, axis, 0)
        bridged = z.copy()
        for gap in (1, 2):
            for k in range(1, len(z) - gap):
                level = np.minimum(z[k - 1], z[k + gap])
                bridged[k : k + gap] = np.maximum(bridged[k : k + gap], level)
        z = np.moveaxis(bridged, 0, axis)
    bad = np.zeros(z.shape, bool)
    rise = np.abs(np.diff(z, axis=0)) > climb + 1e-6
    bad[1:] |= rise
    rise = np.abs(np.diff(z, axis=1)) > climb + 1e-6
    bad[:, 1:] |= rise
    # A disc that touches the middle of a bad cell's face cannot be there.
    reach = int(np.ceil(radius / cell)) - 1
    blocked = bad.copy()
    for i, j in zip(*np.nonzero(bad), strict=True):
        blocked[max(i - reach, 0) : i + reach, max(j - reach, 0) : j + reach] = True
    cells = [tuple(np.argmin(np.abs(a - p)) for a, p in zip((x, y), q[:2], strict=True))
             for q in (start, goal)]  # fmt: skip
    queue, seen = deque([cells[0]]), {cells[0]}
    while queue:
        i, j = queue.popleft()
        if (i, j) == cells[1]:
            return True
        for near in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            inside = 0 <= near[0] < len(x) and 0 <= near[1] < len(y)
            if inside and near not in seen and not blocked[near]:
                seen.add(near)
                queue.append(near)
    return False


def standable(ground, start, tall):
    """A robot of any yaw fits: nothing above `tall` m within 0.45 m, the middle is level."""
    x, y, z, _ = start
    u, v = np.mgrid[-0.45:0.46:0.03, -0.45:0.46:0.03]
    disc = np.hypot(u, v) <= 0.45
    around = ground(x + u[disc], y + v[disc])
    return around.max() - z <= tall and z - around.min() <= tall


# ---------------------------------------------------------------- meshes


def test_fused_mesh_of_two_by_two_pillars_by_hand():
    heights = np.array([[0.0, 1.0], [1.0, 1.0]])
    vertices, triangles = fuse_pillars(heights, 0.5, 0.25)
    # Tops: (0, 0) alone, (0, 1) alone, the row (1, 0)-(1, 1) as one. Walls: between (0, 0) and each
    # of its two neighbours. Five quads of four corners and two triangles each.
    assert vertices.shape == (20, 3) and triangles.shape == (10, 3)
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    tops, walls = normal[:6], normal[6:]
    assert (tops[:, 2] > 0).all() and (tops[:, :2] == 0).all()
    assert (walls[:, 2] == 0).all() and (walls[:, :2].min(1) < 0).all()  # they face (0, 0)
    assert tops[:, 2].sum() / 2 == pytest.approx(1.0 * 0.5)  # the whole area, once
    assert vertices.min(0) == pytest.approx([0, -0.25, 0])
    assert vertices.max(0) == pytest.approx([1, 0.25, 1])


def test_equal_pillars_fuse_into_one_rectangle():
    vertices, triangles = fuse_pillars(np.full((60, 40), 0.3), L, W)
    assert len(triangles) == 2 and np.ptp(vertices[:, 0]) == 60 * L


@settings(max_examples=25, deadline=None)
@given(arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=12),
              elements=st.sampled_from([-1.0, 0.0, 0.05, 0.5, 2.0])), st.integers(0, 99))
def test_a_ray_down_meets_the_pillars_height(heights, seed):
    client = pybullet.connect(pybullet.DIRECT)
    mesh = fuse_pillars(heights, L, W)
    rng = np.random.default_rng(seed)
    i, j = (rng.integers(n, size=50) for n in heights.shape)
    x, y = (i + rng.uniform(0.05, 0.95, 50)) * L, (j + rng.uniform(0.05, 0.95, 50)) * W
    y -= heights.shape[1] * W / 2
    np.testing.assert_allclose(heights_by_rays(client, *mesh, x, y), heights[i, j], atol=1e-4)
    np.testing.assert_array_equal(terrain.Ground(heights, (L, W))(x, y), heights[i, j])
    pybullet.disconnect(client)


def test_smooth_ground_is_its_triangles(client):
    nodes = np.random.default_rng(0).uniform(-0.5, 0.5, (9, 7))
    x, y = np.random.default_rng(1).uniform([0, -0.9], [2.4, 0.9], (300, 2)).T
    rays = heights_by_rays(client, *terrain.triangulate(nodes, (0.3, 0.3)), x, y)
    ground = terrain.Ground(nodes, (0.3, 0.3), smooth=True)
    np.testing.assert_allclose(ground(x, y), rays, atol=1e-4)


@pytest.mark.parametrize("heights", [np.zeros(3), np.zeros((2, 2, 2)), np.zeros((0, 4)),
                                     [[0.0, np.nan]], [[np.inf]]])  # fmt: skip
def test_bad_heights_are_named(heights):
    with pytest.raises(ValueError, match="finite 2-D"):
        fuse_pillars(heights, L, W)
    with pytest.raises(ValueError, match="finite 2-D"):
        terrain.triangulate(heights, (L, W))


@pytest.mark.parametrize("size", [0.0, -1.0, np.nan, np.inf])
def test_bad_pillar_sizes_are_named(size):
    with pytest.raises(ValueError, match="positive"):
        fuse_pillars(np.zeros((2, 2)), L, size)
    with pytest.raises(ValueError, match="positive"):
        terrain.triangulate(np.zeros((2, 2)), (size, W))


# ---------------------------------------------------------------- tasks


@pytest.mark.parametrize("difficulty", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("task", PILLAR_TASKS)
def test_tasks_can_be_stood_on_and_walked(task, difficulty):
    place = make_terrain(task, np.random.default_rng(7), difficulty)
    assert np.isfinite(place.vertices).all() and place.triangles.max() < len(place.vertices)
    most = 45_000 if task == "hills" else 16_000  # its pillars are four times as many, none equal
    assert len(place.triangles) < most and place.starts.shape == (8, 4)
    for k, (start, goal) in enumerate(zip(place.starts, place.goals, strict=True)):
        assert 6 <= np.hypot(*(goal - start[:3])[:2]) <= 9
        assert standable(place.height, start, 0.1)
        faces_goal = start[3] == pytest.approx(np.arctan2(*(goal - start[:3])[1::-1]))
        assert faces_goal == (k % 3 != 2)  # every third one looks any way
        assert start[2] == place.height(*start[:2]) and goal[2] == place.height(*goal[:2])
    assert oracle(place.height, terrain.STEP, place.starts[0], place.goals[0])


@pytest.mark.parametrize("task", ["ridges", "coasts"])
def test_drops_are_deep_long_before_the_way_is_hard(task):
    for difficulty, depth in ((0.1, 0.4), (0.3, 1.2), (1.0, 1.2)):
        heights = PILLAR_TASKS[task](np.random.default_rng(0), difficulty)
        assert heights.min() == pytest.approx(-depth)


@pytest.mark.parametrize("task", PILLAR_TASKS)
def test_difficulty_zero_is_flat_and_one_is_not(task):
    assert np.ptp(PILLAR_TASKS[task](np.random.default_rng(0), 0.0)) < 0.01
    hard = [np.ptp(PILLAR_TASKS[task](np.random.default_rng(s), 1.0)) for s in range(5)]
    assert min(hard) >= 0.1 or task == "flat"


def test_the_same_generator_gives_the_same_terrain():
    for task in ("rugged", "mazes", "crags"):
        one, two = (make_terrain(task, np.random.default_rng(3), 0.7) for _ in range(2))
        other = make_terrain(task, np.random.default_rng(4), 0.7)
        np.testing.assert_array_equal(one.vertices, two.vertices)
        np.testing.assert_array_equal(one.goals, two.goals)
        assert one.vertices.shape != other.vertices.shape or (one.vertices != other.vertices).any()


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(2, 6), st.integers(0, 99))
def test_doors_join_all_rooms_in_one_way_only(nx, ny, seed):
    """A tree: one door fewer than rooms, and every room is met from the first."""
    room = np.arange(nx * ny).reshape(nx, ny)
    walls = [*zip(room[1:].ravel(), room[:-1].ravel(), strict=True),
             *zip(room[:, 1:].ravel(), room[:, :-1].ravel(), strict=True)]  # fmt: skip
    doors = terrain._doors(np.random.default_rng(seed), walls, 0.0)
    assert doors.sum() == nx * ny - 1
    met = {0}
    for _ in range(nx * ny):
        met |= {b for pair, open_ in zip(walls, doors, strict=True) if open_ and met & {*pair}
                for b in pair}  # fmt: skip
    assert len(met) == nx * ny
    assert terrain._doors(np.random.default_rng(seed), walls, 1.0).all()


def test_thin_pillars_are_seen_by_the_search_for_routes():
    """No pole, 7 cm thick, within 0.2 m of a start or a goal, where a robot's legs would be."""
    place = make_terrain("poles", np.random.default_rng(0), 1.0)
    poles = (np.argwhere(place.height.heights > 0) + 0.5) * place.height.cell - [0, 4]
    assert len(poles) > 60
    for x, y, *_ in [*place.starts, *place.goals]:
        assert np.hypot(*(poles - [x, y]).T).min() > 0.2


def test_a_function_of_another_size_is_a_task():
    def ditch(rng, difficulty):
        heights = np.zeros((80, 30))
        heights[40] = -difficulty
        return heights

    place = make_terrain(ditch, np.random.default_rng(0), 0.5)
    assert place.name == "ditch" and place.height(40.5 * L, 0.0) == -0.5
    assert make_terrain(place, None, None) is place


@pytest.mark.parametrize("task, difficulty, named", [
    ("lava", 0.5, "lava.*flat.*crags"), ("flat", 2, "2"), ("flat", -0.1, "-0.1"),
    ("flat", np.nan, "nan"), (lambda rng, d: np.zeros(5), 0.5, "2-D"),
    (lambda rng, d: np.full((60, 40), np.nan), 0.5, "finite"),
    (lambda rng, d: np.indices((60, 20)).sum(0) % 2 * 9.0, 0.5, "route"), (None, 0.5, "None"),
])  # fmt: skip
def test_bad_tasks_are_named(task, difficulty, named):
    with pytest.raises(ValueError, match=named):
        make_terrain(task, np.random.default_rng(0), difficulty)


# ---------------------------------------------------------------- worlds


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", WORLDS)
def test_worlds_can_be_stood_on_and_walked(name, seed):
    world = make_world(name, seed)
    assert len(world.triangles) < 20_000
    (start,), (goal,) = world.starts, world.goals
    assert 6 <= np.hypot(*(goal - start[:3])[:2]) <= 12
    assert standable(world.height, start, 0.1)
    climb = terrain.LEVEL if name in NO_CLIMBING else terrain.CLIMB
    assert oracle(world.height, climb, start, goal)
    again, other = make_world(name, seed), make_world(name, seed + 100)
    np.testing.assert_array_equal(world.vertices, again.vertices)
    assert not np.array_equal(world.goals, other.goals)


@pytest.mark.parametrize("name", WORLDS)
def test_the_height_of_a_world_is_its_mesh(name, client):
    world = make_world(name, 1)
    length, width = world.height.size
    x, y = np.random.default_rng(0).uniform([0, -width / 2], [length, width / 2], (3000, 2)).T
    error = np.abs(heights_by_rays(client, world.vertices, world.triangles, x, y)
                   - world.height(x, y))  # fmt: skip
    # Round trunks and rocks, and chairs below their backs, are only near to their 0.1 m cells.
    assert np.mean(error < 0.06) > 0.95


def test_walls_of_the_maze_and_its_corridors():
    heights = make_world("maze", 0).height.heights
    assert set(np.unique(heights)) == {0.0, 1.3}
    assert (heights[::13, ::13] == 1.3).all() and (heights[6::13, 6::13] == 0).all()  # 1.2 m wide


def test_slopes_of_mountain_and_continuous():
    for name, least, most in (("mountain", 24, 34), ("continuous", 20, 28)):
        steep = []
        for seed in range(4):
            world = make_world(name, seed)
            a, b, c = (world.vertices[world.triangles[:, k]] for k in range(3))
            normal = np.cross(b - a, c - a)
            surface = normal[:, 2] > 0.3 * np.linalg.norm(normal, axis=1)  # not a rock's side
            cosine = normal[surface, 2] / np.linalg.norm(normal[surface], axis=1)
            steep.append(np.degrees(np.arccos(np.percentile(cosine, 5))))
        assert least <= np.mean(steep) <= most


def test_the_cliffs_path_is_narrow_and_the_drop_deep():
    for seed in range(4):
        plan = make_world("cliff", seed).height.heights
        path = plan > -0.5
        assert plan[~path].max() <= -1.0
        width = path[30:100].sum(1) * terrain.FINE  # along y: a winding path looks wider
        assert 0.9 <= width.min() and np.median(width) <= 2.2


def test_a_metre_costs_more_on_slopes_and_beside_what_is_not_free():
    """On 6 x 6 m, by hand: away from the rim slopes alone count, in a lane its walls."""
    free = np.ones((60, 60), bool)
    free[[0, -1]] = free[:, [0, -1]] = False
    x = np.broadcast_to((np.arange(60)[:, None] + 0.5) * 0.1, free.shape)
    for slope, cost in ((0.0, 1.0), (0.2, 1.0), (0.5, 4.0), (3.0, 9.0)):
        assert terrain._cost(slope * x, free)[10:50, 10:50] == pytest.approx(cost, rel=1e-3)
    free[:, :28] = free[:, 33:] = False  # a lane, five cells of 0.1 m wide
    cost = terrain._cost(0 * x, free)
    # Its middle is the third cell from what is blocked; from the fourth on there is no charge.
    assert cost[25, 30] == pytest.approx(1 + 8 * (1 - 3 / 4) ** 2, rel=1e-3)
    assert cost[25, 27] == 50


def test_doorways_of_the_offices():
    for seed in range(4):
        heights = make_world("office1", seed).height.heights
        for wall in (40, 57):  # of the corridor
            row = "".join("#" if h == terrain.CLOSED else "." for h in heights[:, wall])
            doors = [len(gap) for gap in row.split("#") if gap]
            assert len(doors) >= 2 and set(doors) <= {9, 10}  # 0.9-1.0 m


def test_people_walk_at_a_humans_speed_and_never_through_walls():
    for seed in range(3):
        world = make_world("dynamic", seed)
        assert len(world.people) >= 4
        t = np.arange(0, 60, 0.1)
        for person in world.people:
            x, y, yaw = np.array([person.position(s) for s in t]).T
            assert np.hypot(x[0] - world.starts[0, 0], y[0] - world.starts[0, 1]) >= 1.5
            speed = np.hypot(np.diff(x), np.diff(y)) / 0.1
            assert 0.5 <= person.speed <= 1.2 and speed.max() <= person.speed + 1e-6
            assert np.median(speed) > 0.9 * person.speed
            for angle in np.arange(0, 6.28, 0.4):  # his whole body stands on the free floor
                body = world.height(x + 0.2 * np.cos(angle), y + 0.2 * np.sin(angle))
                assert (np.abs(body) < 0.1).all()
            ahead = np.cos(np.arctan2(np.diff(y), np.diff(x)) - yaw[:-1])
            assert np.median(ahead) > 0.7  # he looks where he goes


@pytest.mark.parametrize("name, seed, named", [
    ("moon", 0, "moon.*maze.*continuous"), ("maze", -1, "-1"), ("maze", 1.5, "1.5"),
    ("maze", "x", "'x'"),
])  # fmt: skip
def test_bad_worlds_are_named(name, seed, named):
    with pytest.raises(ValueError, match=named):
        make_world(name, seed)


# ---------------------------------------------------------------- scanned buildings


@pytest.mark.parametrize("file, scale, up", [
    ("samurai_monastry.obj", 1.0, "y"), ("roboschool/models_outdoor/stadium/stadium.obj", 1.0, "z"),
    ("plane100.obj", 0.2, "z"), ("random_urdfs/970/970.obj", 2.0, "y"),
    ("samurai_monastry.obj", 0.2, "y"), ("samurai_monastry.obj", 0.2, "z"),
])  # fmt: skip
def test_meshes_that_nobody_made_for_us(file, scale, up, client):
    place = load_mesh(DATA / file, scale, up)
    (start,), (goal,) = place.starts, place.goals
    assert 1 <= np.hypot(*(goal - start[:3])[:2]) <= 12
    add_mesh(client, place.vertices, place.triangles)
    for x, y, z in (start[:3], goal):
        hit = pybullet.rayTest((x, y, z + 0.6), (x, y, z - 0.6), physicsClientId=client)[0]
        assert hit[0] >= 0 and hit[3][2] == pytest.approx(z, abs=0.02)


def test_bad_meshes_are_named(tmp_path):
    square = "v 0 0 0\nv 9 0 0\nv 9 9 0\nv 0 9 0\n"

    def error(text, *more, name="a.obj"):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError) as caught:
            load_mesh(tmp_path / name, *more)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    assert load_mesh(_write(tmp_path / "ok.obj", square + "f 1 2 3 4\n")).name == "ok"
    assert load_mesh(_write(tmp_path / "ok.obj", square + "f -4/1 -3/2/2 -2//3 -1\n")).name == "ok"
    assert "empty" in error("") and "a.obj" in error("")
    assert "no faces" in error(square)
    assert "line 1" in error("v one two three\n")
    assert "line 5" in error(square + "f a b c\n")
    assert "not finite" in error("v nan 0 0\n" + square + "f 1 2 3\n")
    assert "not there" in error(square + "f 1 2 9\n")
    assert "not there" in error("v 0 0 0\nf 0 1 2\n" + square)
    assert "no floor" in error("v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    assert "too large" in error("v 0 0 0\n" * 131_073 + "f 1 2 3\n")
    assert "too large" in error(square + "f 1 2 3\n" * 174_763)
    for scale in (0.0, -1.0, np.nan, np.inf):
        assert "scale" in error(square + "f 1 2 3 4\n", scale)
    assert "'x'" in error(square + "f 1 2 3 4\n", 1.0, "x")
    with pytest.raises(FileNotFoundError, match="nothing"):
        load_mesh(tmp_path / "nothing.obj")


def _write(path, text):
    path.write_text(text)
    return path


def sweep(chart, ground, eye, times=1):
    """Enters what 72 x 25 level to steep rays of 5 m see of `ground`(x, y) from `eye` (x, y, z)."""
    turn, down = np.radians(np.arange(0, 360, 5)), np.radians(np.arange(-3, 72, 3))
    turn, down = (a.ravel() for a in np.meshgrid(turn, down))
    ray = np.stack([np.cos(down) * np.cos(turn), np.cos(down) * np.sin(turn), -np.sin(down)], 1)
    along = eye + ray * np.arange(0.02, 5, 0.02)[:, None, None]  # (steps, rays, 3)
    inside = along[..., 2] <= ground(along[..., 0], along[..., 1])
    hit = inside.any(0)
    ends = along[np.where(hit, inside.argmax(0), -1), np.arange(len(turn))]
    for _ in range(times):
        chart.see(np.broadcast_to(eye, ends.shape), ends, hit, 0.0)
        chart.draw(eye[0], eye[1], 0.0)


@pytest.mark.parametrize("shape, x, blocked", [
    ("flat", 0.7, False), ("wall", 0.7, True), ("wall", -0.7, False), ("drop", 0.7, True),
    ("drop", -0.7, False), ("ramp", 0.7, False), ("kerb", 0.7, False)])
def test_chart_knows_walls_and_edges_and_lets_ramps_and_kerbs_be(shape, x, blocked):
    """All of them begin at x = 0.6 m, across the way of a robot whose lens has come to 0.2 m."""
    ground = {"flat": lambda x, y: 0 * x, "wall": lambda x, y: np.where(x > 0.6, 1.0, 0.0),
              "drop": lambda x, y: np.where(x > 0.6, -1.2, 0.0),
              "ramp": lambda x, y: 0.36 * np.maximum(x - 0.6, 0),  # 20 degrees
              "kerb": lambda x, y: np.where(x > 0.6, 0.1, 0.0)}[shape]
    chart = terrain.Chart(0, 0, (8, 0))
    for eye in (0.0, 0.1, 0.2):
        sweep(chart, ground, np.array([eye, 0.0, 0.38]))
    y = np.linspace(-0.5, 0.5, 11)
    assert (chart.effort(np.full(11, x), y) > 40).all() == blocked
    assert blocked or (chart.effort(np.full(11, x), y) < 40).all()
    assert (chart.effort(np.full(11, -0.3), y) < 4).all()  # nearer there is nothing


def test_chart_takes_the_unknown_for_open_ground_and_forgets_people():
    chart = terrain.Chart(0, 0, (8, 0))
    person = lambda x, y: np.where(np.hypot(x - 2, y) < 0.3, 1.7, 0.0)  # noqa: E731
    eye = np.array([0.0, 0.0, 0.38])
    sweep(chart, person, eye)
    assert chart.effort(np.array([1.8, 3.0, 4.7]), np.zeros(3)).tolist()[1:] == [1, 1]
    assert chart.effort(1.8, 0.0) == 50
    sweep(chart, lambda x, y: 0 * x, eye, times=2)
    assert chart.effort(1.8, 0.0) < 10


def test_chart_remembers_a_wall_where_it_is_when_the_robot_goes_on():
    chart = terrain.Chart(0, 0, (8, 0))
    sweep(chart, lambda x, y: np.where(x > 1.4, 1.0, 0.0), np.array([0.0, 0.0, 0.38]))
    for x, y in ((-1.0, 0.7), (-2.3, -1.1)):
        chart.draw(x, y, 0.0)
        assert chart.effort(1.5, 0.0) == 50 and chart.effort(0.5, 0.0) == 1


def test_chart_goes_on_where_the_robot_leaves_the_map():
    chart = terrain.Chart(0, 0, (8, 0))
    wall = lambda x, y: np.where((x > 15.4) | (y > 1) | (y < -1), 1.0, 0.0)  # noqa: E731
    for x in np.linspace(14.5, 18, 8):
        sweep(chart, wall, np.array([x, 0.0, 0.38]))
        assert chart.to_go(x, 0.0) > 6 and chart.effort(0.0, 0.0) == 1
        sweep(chart, lambda x, y: 0 * x, np.array([x, 0.0, 0.38]), times=3)
    assert chart.effort(14.5, 0.0) < 50


def test_to_go_is_the_straight_distance_until_something_is_seen():
    chart = terrain.Chart(3.0, -1.0, (9.0, 2.0))
    x, y = np.random.default_rng(0).uniform(-8, 12, (2, 500))
    x, y = (a[np.hypot(x - 9, y - 2) > 0.5] for a in (x, y))  # between squares it is a cone's tip
    np.testing.assert_allclose(chart.to_go(x, y), np.hypot(x - 9, y - 2), atol=0.02)


def test_to_go_is_the_shortest_way_by_dijkstra():
    """Around a wall in the middle of what the robot sees, against a search with a heap."""
    chart = terrain.Chart(0, 0, (2.5, 0.3))
    wall = lambda x, y: np.where((np.abs(x - 1.2) < 0.1) & (y < 1.5), 1.0, 0.0)  # noqa: E731
    sweep(chart, wall, np.array([0.0, 0.0, 0.38]), times=20)
    squares = np.s_[112:208]  # those of 0.1 m that lie within 4.8 m
    cost = chart.cost[squares, squares].reshape(48, 2, 48, 2).min((1, 3))
    left = chart.left[56:104, 56:104].copy()
    best = np.full((48, 48), np.inf)  # seeds: the goal, and the rim with what was left from there
    rim = [(i, j) for i in range(48) for j in range(48) if {i, j} & {0, 47}]
    heap = [(left[c], c) for c in [*rim, (24 + 12, 24 + 1)]]
    heapq.heapify(heap)
    while heap:
        so_far, (i, j) = heapq.heappop(heap)
        if so_far >= best[i, j]:
            continue
        best[i, j] = so_far
        for a in (-1, 0, 1):
            for b in (-1, 0, 1):
                c = i + a, j + b
                if (a or b) and 0 < c[0] < 47 and 0 < c[1] < 47:
                    step = 0.2 * np.hypot(a, b) * (cost[i, j] + cost[c]) / 2
                    heapq.heappush(heap, (so_far + step, c))
    np.testing.assert_allclose(left[1:-1, 1:-1], best[1:-1, 1:-1], rtol=1e-4)
    straight = np.hypot(2.5, 0.3)
    assert chart.to_go(0.0, 0.0) > straight + 0.5  # the way around is longer


def test_a_goal_beyond_the_map_is_far_away():
    chart = terrain.Chart(0, 0, (40.0, 0.0))
    chart.draw(0.0, 0.0, 0.0)
    assert chart.to_go(0.0, 0.0) == pytest.approx(40, abs=0.1)
    assert chart.to_go(100.0, 100.0) > 20  # whoever leaves the map stands at its rim
