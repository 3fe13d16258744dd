"""The environment: its senses against geometry, its reward and endings against the paper."""

import copy
import dataclasses
import math
import pickle
from contextlib import closing
from types import SimpleNamespace

import gymnasium
import numpy as np
import psutil
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st

import loco_mtrl
from loco_mtrl import LIDAR_RANGE, LocoEnv, action_parts, mirror, observation_parts, training_env
from terrain import Person, Terrain, fuse_pillars, make_terrain, make_world
from tg import STANDING, TrajectoryGenerator

ZERO = np.zeros(17)
AHEAD = loco_mtrl.LIDAR_ELEVATIONS.index(-3), 9  # a ray nearly level and nearly ahead
AIM = -np.radians(loco_mtrl.LIDAR_AZIMUTHS[AHEAD])  # the robot's yaw that turns it along x


def wall_ahead(rng, difficulty):
    """A wall across the whole terrain, from x = 6.0 to 6.4 m, but for a passage on the left."""
    heights = np.zeros((60, 40))
    heights[30:32, :32] = 2.0
    return heights


@pytest.fixture(scope="module")
def flat():
    with closing(LocoEnv("flat")) as env:
        yield env


def put(env, x, y, z, yaw=0.0, roll=0.0, pitch=0.0, velocity=(0, 0, 0), rates=(0, 0, 0)):
    """Sets the robot's base, in the terrain's frame, and observes without any physics."""
    p, robot = env.simulation.bullet, env.simulation.robot
    quaternion = p.getQuaternionFromEuler((roll, pitch, yaw))
    p.resetBasePositionAndOrientation(robot, np.add(env.origin, (x, y, z)), quaternion)
    p.resetBaseVelocity(robot, velocity, rates)
    env.robot = env.simulation.sense()
    return env.observe()


def throw(env, speed):
    env.simulation.bullet.resetBaseVelocity(env.simulation.robot, (speed, 0, 0))


def pose(env):
    """Where Bullet has the base: position in the terrain's frame, rotation matrix to the world."""
    p = env.simulation.bullet
    position, turn = p.getBasePositionAndOrientation(env.simulation.robot)
    return np.subtract(position, env.origin), np.reshape(p.getMatrixFromQuaternion(turn), (3, 3))


def rays(env):
    """Sources and directions in the terrain's frame, (160, 3) each: these are level, in gimbals."""
    (position, rotation), (sources, directions) = pose(env), loco_mtrl.lidar_rays()
    ahead = np.r_[rotation[:2, 0], 0] / np.hypot(*rotation[:2, 0])
    aside = np.cross((0, 0, 1), ahead)
    return sources @ rotation.T + position, directions @ [ahead, aside, (0, 0, 1)]


def assert_sees_floor(env, observation):
    """Level ground of 12 x 8 m, which nothing bounds; rays to its very border are left out."""
    source, direction = rays(env)
    far = np.where(direction[:, 2] < 0, -source[:, 2] / direction[:, 2].clip(None, -1e-9), 99)
    x, y, _ = (source + far[:, None] * direction).T
    inside = np.minimum(6 - np.abs(x - 6), 4 - np.abs(y))
    far = np.where(inside > 0, np.minimum(far, LIDAR_RANGE), LIDAR_RANGE)
    known = np.abs(inside) > 0.02
    np.testing.assert_allclose(metres(observation)[known], far[known], atol=1e-3)


def metres(observation):
    return LIDAR_RANGE * observation[:160] ** 2


@pytest.mark.parametrize("options", [{}, {"tg": False}, {"lidar": False}])
def test_gymnasium_checks_pass_without_a_warning(options):
    with closing(gymnasium.make("LocoMTRL-v0", tasks="flat", **options)) as env:
        check_env(env.unwrapped)


@pytest.mark.parametrize("options", [{}, {"tg": False}, {"lidar": False}])
def test_an_observation_is_what_the_table_says(options):
    """Every entry from Bullet, by geometry, or by a generator of our own, after one decision."""
    tg, lidar = options.get("tg", True), options.get("lidar", True)
    table = [("LiDAR", 160)] * lidar + [("distance", 1), ("heading", 1), ("angular rates", 3),
                                        ("joint angles", 12), ("last command", 12)]
    table += [("TG: cosine", 8), ("TG: parameters", 5)] * tg
    parts = observation_parts(**options)
    assert [part.size for part in parts] == [size for _, size in table]
    assert all(part.name.startswith(name) for part, (name, _) in zip(parts, table, strict=True))
    with closing(LocoEnv("flat", **options)) as env:
        p, body = env.simulation.bullet, env.simulation.robot
        env.reset(seed=3, options={"route": 2})
        put(env, 6.0, 0.5, 0.3, yaw=0.4, rates=(0.1, -0.2, 0.3))
        generator = TrajectoryGenerator()
        generator.phase = env.generator.phase if tg else 0.0
        action = np.random.default_rng(0).uniform(-1, 1, 5 * tg + 12)
        observation, *_ = env.step(action)
        command = STANDING + 0.6 * 0.875 * action[-12:]
        for share in (0.2, 0.36, 0.488) if tg else ():
            command = generator.step(share * action[:5], 1 / 30) + 0.04 * 0.875 * action[-12:]
        position, rotation = pose(env)
        goal = env.terrain.goals[2] + (0, 0, 0.28)
        heading = math.atan2(*(goal - position)[1::-1]) - math.atan2(rotation[1, 0], rotation[0, 0])
        names = {p.getJointInfo(body, j)[1].decode(): j for j in range(p.getNumJoints(body))}
        joints = [p.getJointState(body, names[f"{leg}_{joint}_joint"])[0]
                  for leg in ("FR", "FL", "RR", "RL")
                  for joint in ("hip_motor_2_chassis", "upper_leg_2_hip_motor",
                                "lower_leg_2_upper_leg")]
        expected = [math.dist(goal, position), math.remainder(heading, 2 * math.pi),
                    *p.getBaseVelocity(body)[1] @ rotation, *joints, *command]
        if tg:
            legs = generator.phase + np.pi * np.array([0, 1, 1, 0])
            expected += [*np.cos(legs), *np.sin(legs), *0.488 * action[:5]]
        assert observation.dtype == np.float32 and observation in env.observation_space
        np.testing.assert_allclose(observation[160 * lidar :], expected, atol=1e-5)
        if lidar:
            assert_sees_floor(env, observation)


def test_heading_is_left_positive_and_rates_are_those_of_the_base(flat):
    flat.reset(seed=0)
    flat.goal = np.add(flat.origin, (6.0, 2.0, 0.5)).tolist()
    for yaw, heading in ((0, np.pi / 2), (np.pi / 2, 0), (-np.pi / 4, 3 * np.pi / 4)):
        assert put(flat, 6, 0, 0.5, yaw)[161] == pytest.approx(heading, abs=1e-6)
    seen = put(flat, 6, 0, 0.5, yaw=np.pi / 2, rates=(1.0, 2.0, 3.0))
    np.testing.assert_allclose(seen[162:165], [2.0, -1.0, 3.0], atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.2, 0.9), st.floats(-3, 3), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_lidar_over_a_plane(flat, height, yaw, roll, pitch):
    """Rays stay level on a tilted robot."""
    flat.reset(seed=0)
    assert_sees_floor(flat, put(flat, 6.0, 0.0, height, yaw, roll, pitch))


def test_lidar_sees_a_wall_at_its_distance():
    with closing(LocoEnv(wall_ahead)) as env:
        env.reset(seed=0)
        seen = metres(put(env, 4.5, -1.0, 0.5, yaw=0.3))
        source, direction = rays(env)
        to_wall = (6.0 - source[:, 0]) / direction[:, 0]
        y, z = (source + to_wall[:, None] * direction)[:, 1:].T
        hits = (to_wall > 0) & (to_wall < LIDAR_RANGE) & (np.abs(y + 0.8) < 3.1) & (z > 0.02)
        assert hits.sum() > 30
        np.testing.assert_allclose(seen[hits], to_wall[hits], atol=1e-3)


def test_lidar_never_sees_the_robot(flat):
    """The scan stays as it is with all four legs stretched out right before the sensors."""
    flat.reset(seed=0)
    before = put(flat, 6.0, 0.0, 0.9)[:160]
    p, simulation = flat.simulation.bullet, flat.simulation
    for joint, angle in zip(simulation.joints, [0.0, -1.5, -0.15] * 4, strict=True):
        p.resetJointState(simulation.robot, joint, angle)
    source, direction = rays(flat)
    ends = source + LIDAR_RANGE * direction + flat.origin
    hits = p.rayTestBatch((source + flat.origin).tolist(), ends.tolist())
    assert simulation.robot in {hit[0] for hit in hits}  # what it would see without its filter
    np.testing.assert_array_equal(put(flat, 6.0, 0.0, 0.9)[:160], before)


def test_every_terrain_has_its_own_friction():
    with closing(LocoEnv(["flat", "slopes", "hills", "ridges"])) as env:
        frictions = [env.simulation.bullet.getDynamicsInfo(body, -1)[1] for body in range(4)]
        assert frictions == pytest.approx([1, 0.75, 0.5, 0.75])


@pytest.mark.parametrize("side", [1, -1])
def test_lidar_still_sees_a_thin_wall_that_it_touches(side):
    """A lens that entered what the robot leans on, head or tail, would be blind to it."""
    heights = np.zeros((200, 60))
    heights[100] = 1.0  # from x = 5 m on, 5 cm thick
    start, goal = np.array([[5.0, 0.0, 0.0, 0.0]]), np.array([[9.0, 0.0, 0.0]])
    place = Terrain("thin", *fuse_pillars(heights, 0.05), start, goal, heights, 0.05)
    column = np.abs(loco_mtrl.LIDAR_AZIMUTHS[AHEAD[0]]).argsort()[0 if side > 0 else -1]
    tall = TrajectoryGenerator().step([0, 0, 0, 0, 1], 0.0)  # or bent knees would be there first
    with closing(LocoEnv(place)) as env:
        env.reset(seed=0)
        put(env, 5.025 - 0.6 * side, 0.0, 0.3)
        p, robot, touched = env.simulation.bullet, env.simulation.robot, 0
        for _ in range(60):
            p.applyExternalForce(robot, -1, (400.0 * side, 0, 0), (0, 0, 0), p.LINK_FRAME)
            env.simulation.step(tall)
            contacts = p.getContactPoints(robot, linkIndexA=-1)
            if any(abs(contact[7][0]) > 0.9 for contact in contacts):
                touched, env.robot = touched + 1, env.simulation.sense()
                seen = metres(env.observe()).reshape(loco_mtrl.SCAN_SHAPE)
                assert seen[AHEAD[0], column] < 0.15
        assert touched > 2


def with_person(x0, x1, speed, **options):
    """Flat ground on which a person walks to and fro along x, and the robot stands at (3, 0)."""
    ground = make_terrain("flat", np.random.default_rng(0), 0.0)
    person = Person(np.array([[x0, 0.0], [x1, 0.0]]), speed)
    env = LocoEnv(["rugged", dataclasses.replace(ground, people=[person])], **options)
    env.reset(seed=0, options={"terrain": 1})
    put(env, 3.0, 0.0, 0.3, yaw=AIM)
    return env


def test_lidar_sees_a_person_where_he_is_and_as_he_moves():
    """Against ray and cylinder, by Pythagoras; he walks 1 m/s from x = 7 to 5 m, and back."""
    with closing(with_person(7.0, 5.0, speed=1.0)) as env:
        side, level = 0.36 * math.sin(AIM), math.cos(math.radians(3))
        for x in (7.0, 6.5, 6.0, 5.5, 5.0, 5.5, 6.0):
            seen = metres(put(env, 3.0, 0.0, 0.3, yaw=AIM)).reshape(loco_mtrl.SCAN_SHAPE)[AHEAD]
            surface = x - math.sqrt(Person.RADIUS**2 - side**2)
            assert seen == pytest.approx((surface - 3 - 0.36 * math.cos(AIM)) / level, abs=0.006)
            for _ in range(5):
                env.step(ZERO)


def test_a_person_stops_before_the_robot_and_turns_back():
    """At 1.2 m/s, 4 cm a step, 4.08 is the first x below 4.1 m. He waits there for 3 s."""
    with closing(with_person(5.0, 3.0, 1.2, tg=False, lidar=False)) as env:
        places = []
        for _ in range(45):
            *_, info = env.step(np.zeros(12))
            places.append(env.people[0].place()[0])
            assert not info["fall"] and info["collisions"] == 0
        assert abs(min(places) - 4.1) < 0.05 and places[-1] > 4.5
        assert 29 <= np.isclose(places, min(places)).sum() <= 32
        x, y, _ = np.subtract(env.robot.position, env.origin)
        assert math.hypot(x - 3.0, y) < 0.05  # nobody has pushed it


def test_a_bump_is_counted_once_and_people_are_solid(monkeypatch):
    with closing(with_person(4.0, 4.01, 1e-9)) as env:
        assert env.step(ZERO)[4]["collisions"] == 0  # his belly is 0.75 m away, its nose 0.4 m
        for _ in range(40):
            *_, info = env.step(ZERO)
        assert info["collisions"] > 0
        x, y, _ = np.subtract(env.robot.position, env.origin)
        assert math.hypot(x - 4.0, y) > Person.RADIUS + 0.1
        assert env.reset(options={"terrain": 1})[1]["collisions"] == 0
        touches = [False, True, True, False, True]
        monkeypatch.setattr(env.simulation, "touches_people", iter(touches).__next__)
        assert [env.step(ZERO)[4]["collisions"] for _ in touches] == [0, 1, 1, 1, 2]


def test_an_action_is_held_for_three_control_steps_and_smoothed(flat):
    """From 0 to 1 by shares of 0.2: 1 - 0.8^3; of 0.5: 1 - 0.5^3. Then back to 0."""
    flat.reset(seed=0)
    flat.step(np.ones(17))
    np.testing.assert_allclose(flat.action, [0.488] * 5 + [0.875] * 12)
    np.testing.assert_allclose(flat.generator.scaled, [0.488] * 5)
    flat.step(ZERO)
    np.testing.assert_allclose(flat.action, [0.488 * 0.512] * 5 + [0.875 * 0.125] * 12)
    assert flat.seconds == pytest.approx(6 / 30)
    flat.reset(seed=0)
    assert flat.action == [0.0] * 17 and flat.seconds == 0


def test_residuals_are_added_to_the_generators_targets_and_actions_clipped(flat):
    targets, residual = [], np.linspace(-1, 1, 12)
    for left, joints in ((1.0, 0 * residual), (1.0, residual), (7.0, residual)):
        flat.reset(seed=5)
        flat.step([0.3, left, -0.2, 0.1, -0.4, *joints])
        targets.append(flat.target)
    added = 0.04 * 0.875 * residual
    np.testing.assert_allclose(np.subtract(targets[1], targets[0]), added, atol=1e-12)
    assert targets[2] == targets[1]


def test_a_reactive_robot_starts_from_the_standing_pose_and_stays_in_it():
    with closing(LocoEnv("flat", tg=False, lidar=False)) as env:
        observation, _ = env.reset(seed=0)
        np.testing.assert_allclose(observation[5:17], STANDING, atol=1e-6)
        start = env.robot.position
        for _ in range(20):
            observation, _, terminated, *_ = env.step(np.zeros(12))
        np.testing.assert_allclose(observation[17:], STANDING, atol=1e-6)
        assert not terminated and math.dist(start[:2], env.robot.position[:2]) < 0.1


@pytest.mark.parametrize("action", [np.zeros(16), np.full(17, np.nan), np.full(17, np.inf), 0.0])
def test_bad_actions_are_named(flat, action):
    flat.reset(seed=0)
    with pytest.raises(ValueError, match="17 finite numbers"):
        flat.step(action)


def test_reward_is_velocity_toward_the_goal_and_sums_to_the_progress(flat):
    observation, _ = flat.reset(seed=1, options={"route": 1})
    goal, total = np.add(flat.terrain.goals[1] + (0, 0, 0.28), flat.origin), 0.0
    before = first = math.dist(goal, flat.robot.position)
    for _ in range(40):
        observation, reward, terminated, _, info = flat.step(loco_mtrl.straight(observation[160:]))
        after = math.dist(goal, flat.robot.position)
        assert reward == pytest.approx((before - after) / 0.1) and not terminated
        before, total = after, total + reward * 0.1
    assert total == pytest.approx(first - after) and total > 0.5
    assert info["t_cr"] == pytest.approx(1 - after / first)
    x, y, z = flat.terrain.goals[1] + (0, 0, 0.28)
    for back, t_cr in ((first / 4, 0.75), (first + 1, 0.0)):
        put(flat, x - back, y, z)
        assert flat.step(ZERO)[4]["t_cr"] == pytest.approx(t_cr, abs=0.02)


@pytest.mark.parametrize(("place", "ends"), [
    (dict(x=-0.4), "success"), (dict(x=-0.65), None),  # 0.5 m
    (dict(x=-3, z=0.6, roll=1.15), "fall"), (dict(x=-3, z=0.6, roll=0.95), None),  # 60 degrees
    (dict(x=-3, z=3, velocity=(0, 0, -1.75)), "fall"),  # 0.98 m/s faster after 0.1 s
    (dict(x=-3, z=3, velocity=(0, 0, -1.3)), None),
    (dict(x=-0.1, roll=1.15), "success"),  # on its side, but it has arrived
])
def test_how_an_episode_ends(flat, place, ends):
    flat.reset(seed=0, options={"route": 0})
    x, y, z = flat.terrain.goals[0] + (0, 0, 0.28)
    put(flat, **{"y": y, "z": z, **place, "x": x + place["x"]})
    _, _, terminated, truncated, info = flat.step(ZERO)
    assert (terminated, truncated) == (ends is not None, False)
    assert (info["success"], info["fall"]) == (ends == "success", ends == "fall")
    assert info["t_cr"] == 1.0 if ends == "success" else info["t_cr"] < 1


def test_time_limit_truncates():
    assert gymnasium.spec("LocoMTRL-v0").max_episode_steps == 300  # 30 s at 10 Hz
    with closing(loco_mtrl.make_env("flat", seconds=0.7)) as env:
        env.reset(seed=0)
        assert [env.step(ZERO)[2:4] for _ in range(7)] == [(False, False)] * 6 + [(False, True)]


@pytest.mark.parametrize(("x", "speed"), [(6, np.nan), (6, np.inf), (6, 1e300), (2000, 0)])
def test_an_explosion_ends_the_episode_as_a_fall_and_poisons_nothing(x, speed):
    with closing(LocoEnv("flat")) as env:
        env.reset(seed=0)
        put(env, x, 0.0, 0.4, velocity=(speed, 0, 0))
        observation, reward, terminated, truncated, info = env.step(ZERO)
        assert terminated and not truncated and reward == 0
        assert info["fall"] and info["exploded"] and not info["success"] and 0 <= info["t_cr"] <= 1
        assert observation in env.observation_space and not observation.any()
        observation, info = env.reset(seed=0)
        assert not info["exploded"]
        for _ in range(10):  # it stands on the ground
            observation, _, terminated, *_ = env.step(ZERO)
            assert not terminated
        assert_sees_floor(env, put(env, 6.0, 0.0, 0.4))  # and sees it


def test_step_wants_a_reset_first_and_an_open_environment():
    env = LocoEnv("flat")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(ZERO)
    for _ in range(2):  # closing twice does no harm
        env.close()
        with pytest.raises(gymnasium.error.ClosedEnvironmentError):
            env.step(ZERO)


def episode(env, seed, steps=25):
    rng, observations = np.random.default_rng(0), [env.reset(seed=seed)[0]]
    while len(observations) < steps:
        observation, _, terminated, *_ = env.step(rng.uniform(-1, 1, 17))
        observations.append(env.reset()[0] if terminated else observation)
    return np.array(observations)


def test_a_seed_gives_the_same_bits_whatever_was_before():
    tasks = ["rugged", make_world("dynamic", 3)]
    with closing(LocoEnv(tasks)) as fresh, closing(LocoEnv(tasks)) as used:
        first = [episode(fresh, seed) for seed in range(3)]
        assert len({observations.tobytes() for observations in first}) == 3
        for speed in (0.0, 10.0, np.nan):  # a robot at rest, a crash, an explosion
            used.reset(seed=9)
            throw(used, speed)
            used.step(ZERO)
            for seed in range(3):
                np.testing.assert_array_equal(first[seed], episode(used, seed), f"after {speed}")


def test_resets_leak_no_memory(flat):
    process, sizes = psutil.Process(), []
    for _ in range(4):
        for _ in range(100):
            flat.reset()
        sizes.append(process.memory_info().rss)
    assert sizes[-1] - sizes[0] < 1e6


@pytest.mark.parametrize("height", [-2000, -1000, 1000])
def test_the_walk_is_the_same_at_any_height(height):
    """To 2 cm, for Bullet's floats leave a tenth of a millimetre of a kilometre at each step."""
    def walk(height):
        def plain(rng, difficulty):
            return np.full((60, 40), float(height))

        with closing(LocoEnv(plain)) as env:
            scan = env.reset(seed=0)[0][:160]
            for _ in range(5):
                env.step(np.zeros(17))
            return scan, np.subtract(env.robot.position, (*env.origin[:2], height))

    (scan, place), (other, elsewhere) = walk(0), walk(height)
    np.testing.assert_allclose(scan, other, atol=1e-3)
    np.testing.assert_allclose(place, elsewhere, atol=0.02)


def test_options_choose_terrain_and_route():
    with closing(LocoEnv(["flat", wall_ahead, "stairs"])) as env:
        for terrain, route in ((2, 7), (1, 0), (0, 3)):
            _, info = env.reset(seed=0, options={"terrain": terrain, "route": route})
            place, shift = env.pool[terrain], env.simulation.origins[terrain]
            assert info["task"] == place.name == ["flat", "wall_ahead", "stairs"][terrain]
            np.testing.assert_allclose(env.goal, place.goals[route] + shift + (0, 0, 0.28))
            stands = place.starts[route][:3] + shift + (0, 0, 0.30)
            np.testing.assert_allclose(env.robot.position, stands, atol=1e-6)
        assert {env.reset(seed=s)[1]["task"] for s in range(20)} == {"flat", "wall_ahead", "stairs"}


@pytest.mark.parametrize("options", [{"terrain": 1}, {"terrain": -1}, {"terrain": "flat"},
                                     {"terrain": 0.5}, {"route": 8}, {"route": 0.5},
                                     {"route": np.nan}, {"seed": 3}])
def test_bad_reset_options_are_named(flat, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        flat.reset(seed=0, options=options)


@pytest.mark.parametrize(("options", "named"), [
    ({"tasks": "lava"}, "lava"), ({"tasks": ["flat", "lava"]}, "lava"), ({"tasks": []}, "tasks"),
    ({"difficulty": 0.5}, "difficulty.*0.5"), ({"difficulty": (0.5, 0.2)}, "difficulty.*0.5, 0.2"),
    ({"difficulty": (0, 2)}, "difficulty.*2"), ({"difficulty": (float("nan"), 1)}, "nan"),
    ({"layouts": 0}, "layouts.*0"), ({"render_mode": "ascii"}, "render_mode.*ascii"),
])
def test_bad_arguments_are_named(options, named):
    with pytest.raises(ValueError, match=named):
        LocoEnv(**options)


def test_numpys_numbers_are_numbers_too():
    with closing(LocoEnv("flat", (np.float32(0), np.int64(1)), layouts=np.int64(2))) as env:
        assert len(env.pool) == 2


def test_environments_are_not_copied(flat):
    for copies in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match="make another environment"):
            copies(flat)


@pytest.mark.parametrize("parts", [observation_parts(), observation_parts(tg=False),
                                   observation_parts(lidar=False), action_parts(),
                                   action_parts(tg=False)])
def test_mirror_is_its_own_inverse(parts):
    index, sign = mirror(parts)
    x = np.random.default_rng(0).normal(size=sum(part.size for part in parts))
    assert not np.array_equal(x[index] * sign, x)
    np.testing.assert_array_equal((x[index] * sign)[index] * sign, x)


def test_mirror_is_what_a_mirrored_robot_would_observe(flat):
    """Everything reflected in the x-z plane: pose, goal, legs, stride."""
    flat.reset(seed=0)
    (i, s), (j, t) = mirror(observation_parts()), mirror(action_parts())
    action, observations = np.random.default_rng(1).uniform(-1, 1, 17), []
    for side, act in ((1, action), (-1, action[j] * t)):
        flat.generator.phase = 0.7 + (np.pi if side < 0 else 0.0)
        flat.goal = np.add(flat.origin, (9.0, 1.5 * side, 0.45)).tolist()
        flat.target = flat.generator.step(act[:5], 0.01)
        joints = np.random.default_rng(2).uniform(-0.5, 0.5, 12).reshape(4, 3)
        joints = (joints if side > 0 else joints[[1, 0, 3, 2]]).ravel()
        for joint, angle in zip(flat.simulation.joints, joints, strict=True):
            flat.simulation.bullet.resetJointState(flat.simulation.robot, joint, angle)
        observations.append(put(flat, 6.0, 0.2 * side, 0.6, 0.4 * side, 0.1 * side,
                                rates=(0.3 * side, 0.5, 0.7 * side)))
    # The TG's targets mirror to a few hundredths: right and left legs are not built quite alike.
    np.testing.assert_allclose(observations[0][i] * s, observations[1], atol=0.02)


def test_each_training_environment_has_one_task_and_layouts_of_its_own(monkeypatch):
    monkeypatch.setattr(loco_mtrl, "LAYOUTS", 2)
    args = dict(tasks=["flat", "rugged", "stairs"], tg=True, lidar=False, sequential=False, seed=0,
                steps=900_000)

    def pool(index, steps=0, **changes):
        with closing(training_env(index, steps, SimpleNamespace(**args | changes))) as env:
            assert env.observation_space.shape == (42,)
            return [(terrain.name, terrain.vertices.tobytes()) for terrain in env.unwrapped.pool]

    assert [{name for name, _ in pool(index)} for index in range(4)] == [
        {"flat"}, {"rugged"}, {"stairs"}, {"flat"}]
    first = pool(1)
    assert len(set(first)) == 2 and pool(1) == first
    others = pool(4) + pool(1, 50_000) + pool(1, seed=1)  # index, stage, seed
    assert {name for name, _ in others} == {"rugged"} and len(set(first + others)) == 8
    assert {name for name, _ in pool(0, 600_000, sequential=True)} == {"stairs"}


def test_a_new_stage_begins_every_50000_steps_and_with_each_task_that_follows_another():
    args = SimpleNamespace(tasks=["flat", "rugged", "stairs"], steps=180_000, sequential=False)
    stages = {0: (0, 0, 50_000), 49_999: (0, 0, 50_000), 50_000: (1, 0, 100_000),
              150_001: (3, 0, 180_000), 180_500: (3, 0, 180_000)}
    assert {steps: loco_mtrl.stage(steps, args) for steps in stages} == stages
    args.sequential = True
    stages = {0: (0, 0, 50_000), 50_000: (1, 0, 60_000), 60_000: (1, 1, 100_000),
              120_000: (2, 2, 150_000), 150_000: (3, 2, 180_000), 180_500: (3, 2, 180_000)}
    assert {steps: loco_mtrl.stage(steps, args) for steps in stages} == stages


def test_a_finished_terrain_is_walked_as_it_is():
    place = make_terrain("stairs", np.random.default_rng(0), 0.3)
    with closing(LocoEnv(["flat", place], layouts=2)) as env:
        assert len(env.pool) == 3 and env.pool[2] is place
        env.reset(seed=0, options={"terrain": 2})
        hits = [hit[3] for hit in env.simulation.scan(env.robot) if hit[0] != -1]
        assert len(hits) > 60
        for x, y, z in np.subtract(hits, env.origin):  # on a tread, or on the side of a step
            around = place.height(x + np.array([-0.01, 0.01]), y)
            assert around.min() - 1e-3 <= z <= around.max() + 1e-3


def test_pictures_show_the_robot(flat):
    with pytest.raises(ValueError, match="render_mode"):
        flat.render()
    with closing(LocoEnv("flat", lidar=False, render_mode="rgb_array")) as env:
        env.reset(seed=0)
        frame = env.render()
        assert frame.shape == (300, 400, 3) and frame.dtype == np.uint8
        red, green, blue = frame.astype(int).transpose(2, 0, 1)
        rows, columns = np.nonzero((red - blue > 100) & (green - blue > 50))  # the yellow chassis
        assert rows.size > 500 and np.abs([rows.mean() - 150, columns.mean() - 200]).max() < 60
        rows, columns = np.nonzero(blue - red > 50)  # the blue thighs
        assert rows.size > 300 and np.abs([rows.mean() - 150, columns.mean() - 200]).max() < 60


def test_pictures_show_what_the_lidar_hits():
    pictures = []
    for lidar in (True, False):
        with closing(LocoEnv("flat", lidar=lidar, render_mode="rgb_array")) as env:
            env.reset(seed=0)
            pictures.append(env.render())
            aside = np.add(env.goal, (0.8, 0.6, 0.0))  # so that the goal is not in the middle
            behind = np.add(env.goal, (-9.0, -9.0, 9.0))
            marked = env.simulation.picture(aside, 0.4, [env.goal, behind])
    changed = (pictures[0] != pictures[1]).any(-1)
    assert 100 < changed.sum() <= 640 and (pictures[0][changed] == (230, 30, 30)).all()
    dot = np.argwhere((marked == (230, 30, 30)).all(-1))  # 2 x 2 pixels, on the green ball
    red, green, blue = marked.astype(int).transpose(2, 0, 1)
    ball = np.argwhere((green - red > 60) & (green - blue > 40))
    assert len(dot) == 4 and len(ball) > 100
    np.testing.assert_allclose(dot.mean(0), ball.mean(0), atol=6)  # its lit side alone is green
