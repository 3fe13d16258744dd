"""The environment: its senses against geometry, its reward and endings against the paper."""

import dataclasses
import math
from contextlib import closing

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import loco_mtrl
import terrain
from loco_mtrl import (
    DT,
    GOAL_RADIUS,
    LIDAR_FRONT,
    LIDAR_RANGE,
    N_RAYS,
    Guide,
    LocoEnv,
    Map,
    make_env,
    mirror,
    training_env,
)

SHAPE = (60, 40)
N_CHART = 24 * len(loco_mtrl.CHART_RADII)
N_MAP = N_CHART + 24


def wall_ahead(rng, difficulty):
    """A wall from 6 m on, across the whole terrain but for a passage at its side."""
    heights = np.zeros(SHAPE)
    heights[30:32, :32] = 2.0
    return heights


def metres(observation):
    """The distances (m) behind a scan, (N_RAYS,)."""
    return LIDAR_RANGE * observation[:N_RAYS] ** 2


@pytest.fixture(scope="module")
def flat():
    env = LocoEnv("flat")
    yield env
    env.close()


@pytest.fixture(scope="module")
def plane():
    env = LocoEnv(lambda rng, difficulty: np.zeros((150, 150)))  # 30 x 30 m
    yield env
    env.close()


def place(env, x, y, z, yaw=0.0, roll=0.0):
    """Puts the robot's base somewhere and takes an observation without any physics."""
    p = env.bullet
    quaternion = p.getQuaternionFromEuler((roll, 0, yaw))
    p.resetBasePositionAndOrientation(env.robot, env.origin + [x, y, z], quaternion)
    p.resetBaseVelocity(env.robot, (0, 0, 0), (0, 0, 0))
    return env._observe()


@pytest.mark.parametrize("options", [{}, {"tg": False}, {"lidar": False}])
def test_gymnasium_checks_pass_without_a_warning(options):
    env = gymnasium.make("LocoMTRL-v0", tasks="rugged", render_mode="rgb_array", **options)
    check_env(env.unwrapped)
    env.close()


@pytest.mark.parametrize("observed", [True, False])
def test_gymnasium_checks_pass_with_a_map(observed):
    with closing(Map(LocoEnv("rugged"), observed)) as env:
        with pytest.warns(UserWarning, match="different from the unwrapped version"):  # and no more
            check_env(env, skip_render_check=True)


@pytest.mark.parametrize(("options", "size", "mapped"), [
    ({}, 402, True), ({"paper": ["guide"]}, 402, True), ({"paper": ["map"]}, 282, False),
    ({"paper": ["map"], "guide": True}, 282, True), ({"lidar": False}, 42, False),
    ({"lidar": False, "guide": True}, 42, False), ({"tg": False}, 389, True),
])
def test_what_robots_of_each_kind_observe(options, size, mapped):
    with closing(make_env("flat", **options)) as env:
        observation, info = env.reset(seed=0)
        assert observation.shape == (size,) and observation in env.observation_space
        assert env.has_wrapper_attr("whole") == mapped
        assert ("guide" in info) == options.get("guide", False)


def test_a_map_comes_after_the_scan_and_changes_nothing_else(flat):
    bare, _ = flat.reset(seed=3)
    mapped, _ = Map(flat).reset(seed=3)
    assert mapped.dtype == np.float32
    np.testing.assert_array_equal(np.delete(mapped, N_RAYS + np.arange(N_MAP)), bare)
    np.testing.assert_array_equal(Map(flat, observed=False).reset(seed=3)[0], bare)


def test_observation_has_the_papers_parts_in_its_order(flat):
    observation, _ = flat.reset(seed=3)
    scan, goal, rates, joints, target, s_tg = np.split(
        observation, np.cumsum([N_RAYS, 2, 3, 12, 12])
    )
    assert scan.min() >= 0 and scan.max() <= 1
    assert goal[0] == pytest.approx(np.linalg.norm(np.subtract(flat.goal, flat.position)))
    np.testing.assert_allclose(rates, 0, atol=1e-6)
    np.testing.assert_allclose(joints, target, atol=1e-6)  # an episode starts in the TG's pose
    np.testing.assert_allclose(s_tg, flat.generator.state(), atol=1e-6)


def test_heading_is_left_positive_and_relative_to_the_robot(flat):
    flat.reset(seed=0)
    flat.goal = flat.origin + [6.0, 2.0, 0.5]
    heading = lambda yaw: place(flat, 6.0, 0.0, 0.5, yaw)[N_RAYS + 1]  # noqa: E731
    assert heading(0.0) == pytest.approx(np.pi / 2, abs=1e-6)
    assert heading(np.pi / 2) == pytest.approx(0.0, abs=1e-6)
    assert heading(-np.pi / 4) == pytest.approx(3 * np.pi / 4, abs=1e-6)


def test_imu_gives_rates_in_the_frame_of_the_base(flat):
    flat.reset(seed=0)
    place(flat, 6, 0, 0.5, yaw=np.pi / 2)
    flat.bullet.resetBaseVelocity(flat.robot, (0, 0, 0), (1.0, 2.0, 3.0))
    rates = flat._observe()[N_RAYS + 2 : N_RAYS + 5]
    np.testing.assert_allclose(rates, [2.0, -1.0, 3.0], atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.2, 0.9), st.floats(-3, 3))
def test_lidar_over_a_plane(plane, height, yaw):
    plane.reset(seed=0)
    seen = metres(place(plane, 15.0, 0.0, height, yaw))
    with np.errstate(divide="ignore"):
        drop = -loco_mtrl.lidar_rays()[1][:, 2]
        expected = np.where(drop > 0, (height + LIDAR_FRONT[2]) / drop, np.inf)
    np.testing.assert_allclose(seen, np.minimum(expected, LIDAR_RANGE), atol=6e-4)


def test_lidar_sees_a_wall_at_its_distance():
    env = LocoEnv(wall_ahead)
    env.reset(seed=0)
    yaw = 0.3
    seen = metres(place(env, 4.5, -1.0, 0.5, yaw))
    sources, directions = loco_mtrl.lidar_rays()
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    x, y, z = (np.array([4.5, -1.0, 0.5]) + sources @ turn.T).T
    directions = directions @ turn.T
    with np.errstate(divide="ignore"):
        to_wall = np.where(directions[:, 0] > 0, (6.0 - x) / directions[:, 0], np.inf)
        to_floor = np.where(directions[:, 2] < 0, -z / directions[:, 2], np.inf)
    inside = np.abs(y + to_wall.clip(0, 9) * directions[:, 1] + 0.8) < 3.1
    expected = np.minimum(np.where(inside, to_wall, np.inf), to_floor).clip(0, LIDAR_RANGE)
    on_terrain = np.abs(y + to_floor.clip(0, LIDAR_RANGE) * directions[:, 1]) < 4
    compared = inside | ~np.isfinite(to_wall) & on_terrain
    np.testing.assert_allclose(seen[compared], expected[compared], atol=6e-4)
    assert (expected[compared] == to_wall[compared]).sum() > 30
    env.close()


def with_person(x0, x1, speed):
    """Flat ground on which a person walks to and fro along x."""
    ground = terrain.make_terrain("flat", np.random.default_rng(0), 0.0)
    person = terrain.Person(np.array([[x0, 0.0], [x1, 0.0]]), speed)
    return LocoEnv(dataclasses.replace(ground, people=(person,)))


def test_lidar_sees_a_person_where_he_is_and_as_he_moves():
    env = with_person(7.0, 5.0, speed=1.0)
    env.reset(seed=0)
    row, column = loco_mtrl.LIDAR_ELEVATIONS.index(-3), 11  # a ray a little to the left
    yaw = -np.radians(loco_mtrl.LIDAR_AZIMUTHS[row, column])
    sensor = 3.6 + LIDAR_FRONT[0] * np.cos(yaw), LIDAR_FRONT[0] * np.sin(yaw)
    for seconds in (0.0, 0.5, 1.0, 2.5):
        env.walked[0] = seconds
        env._move_people()
        seen = metres(place(env, 3.6, 0.0, 0.4, yaw)).reshape(loco_mtrl.LIDAR_AZIMUTHS.shape)
        centre = 7.0 - seconds if seconds <= 2 else 5.0 + (seconds - 2)
        along = centre - sensor[0] - np.sqrt(terrain.PERSON_RADIUS**2 - sensor[1] ** 2)
        expected = min(along / np.cos(np.radians(3)), LIDAR_RANGE)
        assert seen[row, column] == pytest.approx(expected, abs=0.006)
    env.close()


def test_a_person_can_be_bumped_into():
    env = with_person(6.0, 3.0, speed=1.2)
    env.reset(seed=0)
    place(env, 4.0, 0.0, 0.4)
    hits = [env.step(np.zeros(17))[4]["collisions"] for _ in range(60)]
    assert hits[0] == 0 and hits[-1] >= 1 and hits == sorted(hits)
    env.close()


def test_a_person_presses_nobody_through_a_wall():
    """Moved regardless, he would with 160 kN, and the robot would stand behind it."""
    ground = terrain.make_terrain("flat", np.random.default_rng(0), 0.0)
    heights = np.zeros(SHAPE)
    heights[30] = 1.2  # from x = 6.0 to 6.2 m
    vertices, triangles = terrain.fuse_pillars(heights, terrain.L, terrain.W)
    person = terrain.Person(np.array([[3.0, 0.0], [7.0, 0.0]]), 1.2)
    ground = dataclasses.replace(ground, vertices=vertices, triangles=triangles, people=(person,))
    with closing(LocoEnv(ground)) as env:
        env.reset(seed=0)
        place(env, 5.4, 0.0, 0.32)
        force = []
        for _ in range(120):
            env.step(np.zeros(17))
            contacts = env.bullet.getContactPoints(env.robot, env.people[0])
            force.append(sum(contact[9] for contact in contacts))
            assert env.position[0] - env.origin[0] < 5.9
        assert loco_mtrl.PUSH < max(force) < 5000


def test_a_blind_robot_has_no_rays_to_draw():
    with closing(LocoEnv("flat", lidar=False, render_mode="rgb_array")) as env:
        env.show_lidar = True
        env.reset(seed=0)
        assert env.render().shape == (300, 400, 3)


def test_without_pictures_there_is_nothing_to_render(flat):
    with pytest.raises(ValueError, match="render_mode"):
        flat.render()


def test_lidar_never_sees_the_robot(flat):
    """The scan stays that of the plane with a leg stretched out right before the sensor."""
    flat.reset(seed=0)
    before = place(flat, 6.0, 0.0, 0.9)[:N_RAYS]
    for joint, angle in zip(flat.joints, [0.0, -1.5, -0.15] * 4, strict=True):
        flat.bullet.resetJointState(flat.robot, joint, angle)
    sources, directions = loco_mtrl.lidar_rays()
    starts = sources + flat.origin + [6.0, 0.0, 0.9]
    ends = starts + LIDAR_RANGE * directions
    seen = [hit[0] for hit in flat.bullet.rayTestBatch(starts.tolist(), ends.tolist())]
    assert flat.robot in seen  # without the filter it would see its leg
    np.testing.assert_array_equal(flat._observe()[:N_RAYS], before)


@pytest.mark.parametrize("side", [1, -1])
def test_lidar_still_sees_a_thin_wall_that_it_touches(side):
    """A lens that entered what the robot leans on would be blind to it."""
    heights = np.zeros((200, 60))
    heights[100] = 1.0  # from x = 5 m on, 5 cm thick
    mesh, ground = terrain.fuse_pillars(heights, 0.05, 0.1), terrain.Ground(heights, (0.05, 0.1))
    start, goal = np.array([[5.0, 0.0, 0.0, 0.0]]), np.array([[9.0, 0.0, 0.0]])
    row = loco_mtrl.LIDAR_ELEVATIONS.index(-3)
    column = np.abs(loco_mtrl.LIDAR_AZIMUTHS[row]).argsort()[0 if side > 0 else -1]
    with closing(LocoEnv(terrain.Terrain("thin", *mesh, start, goal, ground))) as env:
        env.reset(seed=0)
        place(env, 5.025 - 0.6 * side, 0.0, 0.3)
        touched, action = 0, np.zeros(17)
        action[4] = 1.0  # on long legs: the knees of bent ones would be first at the wall
        for _ in range(40):  # pushed against it, head or tail on
            push = (400.0 * side, 0, 0), (0, 0, 0), env.bullet.LINK_FRAME
            env.bullet.applyExternalForce(env.robot, -1, *push)
            seen = metres(env.step(action)[0]).reshape(loco_mtrl.LIDAR_AZIMUTHS.shape)
            if env.steps % loco_mtrl.LIDAR_EVERY == 0:
                base = env.bullet.getContactPoints(env.robot, linkIndexA=-1)
                if any(abs(contact[7][0]) > 0.9 for contact in base):
                    touched += 1
                    assert seen[row, column] < 0.15
        assert touched > 2


def test_the_scan_and_the_map_are_taken_every_other_step(flat):
    env = Map(flat)
    env.reset(seed=0)
    scans = [env.step(np.zeros(17))[0][: N_RAYS + N_MAP] for _ in range(8)]
    for part in (slice(N_RAYS), slice(N_RAYS, None)):
        changed = [bool((a[part] != b[part]).any()) for a, b in zip(scans, scans[1:], strict=False)]
        assert changed == [True, False] * 3 + [True]


def test_ways_are_weighed_as_defined():
    """Against the definition, place by place; on open ground what is left is the distance."""
    goal = 9.0, -2.0
    chart = terrain.Chart(6.0, 1.0, goal)
    chart.cost[:] = 2.0
    way, whole = loco_mtrl.weigh_ways(chart, 6.0, 1.0, yaw=2.0)
    for k, azimuth in enumerate(np.radians(loco_mtrl.LIDAR_AZIMUTHS[0])):
        totals = []
        for row, far in enumerate(0.3 * np.arange(1, 16)):
            x, y = 6 + far * np.cos(2 + azimuth), 1 + far * np.sin(2 + azimuth)
            assert way[row, k] == pytest.approx(2 * far)
            totals.append(2 * far + math.hypot(x - goal[0], y - goal[1]))
        least = min(totals[1:]) + 0.3 * abs(azimuth) / np.pi
        assert whole[k] == pytest.approx(least, abs=0.1)  # between squares of 0.2 m


def test_ways_are_told_less_the_cheapest(flat):
    env = Map(flat)
    told = env.reset(seed=0)[0][N_RAYS + N_CHART : N_RAYS + N_MAP]
    whole = env.whole
    np.testing.assert_allclose(np.expm1(told * math.log(226)), whole - whole.min(), atol=1e-4)
    assert told.min() == 0 and told.max() > 0.1


def test_chart_shows_the_wall_that_the_lidar_has_seen_and_the_way_around_it():
    """By hand: a metre in the open counts as one, and 50 times that in the wall's front."""
    with closing(Map(LocoEnv(wall_ahead))) as env:
        def effort():
            observation = env._look(env.robot._observe())
            return np.expm1(observation[N_RAYS : N_RAYS + N_CHART].reshape(4, 24) * math.log(226))

        env.reset(seed=0)
        place(env.robot, 4.6, -1.0, 0.3)
        x, y, _ = env.robot.position
        env.chart = terrain.Chart(x, y, env.robot.goal)  # as if it had only just come there
        ahead = np.abs(loco_mtrl.LIDAR_AZIMUTHS[0]) < 15
        seen = effort()
        np.testing.assert_allclose(seen[0], 0.6, atol=1e-4)  # 0.6 m on, all around
        assert seen[2, ahead].min() > 15
        np.testing.assert_allclose(seen[:, 0], [0.6, 1.5, 2.7, 4.5], atol=1e-4)  # behind
        place(env.robot, 4.6, -1.0, 0.3, yaw=math.pi)  # it has turned, and knows what is behind it
        seen = effort()
        assert seen[2, [0, -1]].min() > 15 and seen[2, ahead].max() < 5
        env.reset()
        assert np.isnan(env.chart.low).sum() > env.chart.low.size - 300  # a new episode, a new map


def test_reward_is_velocity_toward_the_goal_and_sums_to_the_progress():
    env = LocoEnv("rugged", difficulty=0.35)
    env.reset(seed=1)

    first, total = env.distance, 0.0
    for _ in range(120):
        before = env.distance
        _, reward, terminated, _, info = env.step(np.zeros(17))
        assert reward == pytest.approx((before - env.distance) / DT)
        total += reward * DT
        assert not terminated
    assert total == pytest.approx(first - env.distance)
    assert total > 0.5  # the zero action has walked toward the goal, and that is positive
    assert info["t_cr"] == pytest.approx(1 - env.distance / first)
    env.close()


def test_the_guide_leads_around_a_wall():
    """Straight on would end at the wall; the legs of the guide's gait alone reach the goal."""
    with closing(Guide(Map(LocoEnv(wall_ahead)))) as env:
        _, info = env.reset(seed=0, options={"route": 0})
        goal, terminated = env.unwrapped.terrain.goals[0], False
        assert (env.unwrapped.position[0] < 6) != (goal[0] < 6)  # the wall is between them
        while not terminated and env.unwrapped.time < 30:
            assert np.isnan(info["guide"][[0, 3, *range(5, 17)]]).all()
            assert np.abs(info["guide"][1:3]).max() <= 0.95
            _, _, terminated, _, info = env.step(np.nan_to_num(info["guide"]))
        assert info["success"]


@pytest.mark.parametrize("world", ["office2", "cliff"])
def test_the_guide_reaches_the_goal_of_a_world(world):
    _, (result,) = loco_mtrl.episodes((world, 4, ["guide"]))
    assert result["success"] and result["seconds"] < 40


@pytest.mark.parametrize(("arguments", "shares"), [
    ([], [1.0, 0.5]), (["--paper", "guide"], [0.0, 0.0]), (["--paper"], [0.0, 0.0]),
    (["--paper", "map"], [1.0, 0.5]),
    (["--no-tg"], [0.0, 0.0]), (["--no-lidar"], [1.0, 0.5]),
    (["--sequential", "--tasks", "flat,walls"], [1.0, 1.0]),
])
def test_who_learns_from_the_guide(arguments, shares):
    """Strides and crouching are all that he teaches; the paper knows no guide."""
    stages = loco_mtrl.plan(loco_mtrl.parse(["train", *arguments]))
    assert [settings.get("guide_share", 0.0) for *_, settings in stages] == shares
    assert stages[-1][2] == 1.0


@pytest.mark.parametrize(("yaw", "turns"), [(0.0, 0), (1.2, -1), (-1.2, 1), (2.8, -1)])
def test_the_guide_turns_to_the_goal(yaw, turns):
    """On open ground, the goal ahead, to the right, to the left, behind on the right."""
    with closing(Guide(Map(LocoEnv("flat")))) as env:
        env.reset(seed=0)
        x, y, _ = np.subtract(env.unwrapped.position, env.unwrapped.origin)
        goal = env.unwrapped.terrain.goals[env.unwrapped.route]
        place(env.unwrapped, x, y, 0.35, yaw=math.atan2(goal[1] - y, goal[0] - x) + yaw)
        for _ in range(loco_mtrl.LIDAR_EVERY):  # until he has looked
            *_, info = env.step(np.zeros(17))
        left, right = 0.13 + 0.27 * info["guide"][1:3]  # m
        assert right - left == pytest.approx(0.24 * turns, abs=0.05)
        assert (left + right) / 2 == pytest.approx(0.21 * max(0, math.cos(yaw)) ** 2, abs=0.05)


def test_without_a_map_the_guide_heads_for_the_goal():
    with closing(Guide(LocoEnv("flat"))) as env:
        _, info = env.reset(seed=0)
        x, y, _ = np.subtract(env.unwrapped.goal, env.unwrapped.position)
        turn = math.remainder(math.atan2(y, x) - env.unwrapped.yaw, 2 * math.pi)
        left, right = info["guide"][1:3]
        assert np.sign(right - left) == np.sign(turn) and abs(turn) > 0.05


def test_the_guide_walks_out_of_a_dead_end():
    """A pocket 3 m deep, its back to the goal: he has to walk away from the goal first."""
    def pocket(rng, difficulty):
        heights = np.zeros(SHAPE)
        heights[40, 10:30] = heights[25:40, [10, 29]] = 1.0
        return heights

    ground = terrain.make_terrain(pocket, np.random.default_rng(0), 1.0)
    ground.starts[0], ground.goals[0] = (7.0, 0, 0, 0), (10.0, 0, 0)
    with closing(Map(LocoEnv(ground))) as env:
        env.reset(seed=0, options={"route": 0})
        robot, x = env.robot, []
        while robot.time < 40 and robot.distance > 0.5:
            x.append(robot.position[0] - robot.origin[0])
            env.step(np.nan_to_num(loco_mtrl.advise(env)))
        assert robot.distance < 0.5 and min(x) < 5.0 < max(x)


@pytest.mark.parametrize(("roll", "crouch"), [(0.0, 0), (0.2, -0.5), (-0.2, -0.5), (0.5, -0.95)])
def test_the_guide_crouches_on_slopes(plane, roll, crouch):
    """Five times what the tilt exceeds 0.1 rad, whichever way it goes."""
    plane.reset(seed=0)
    place(plane, 3.0, 0.0, 0.4, roll=roll)
    assert loco_mtrl.advise(plane)[4] == pytest.approx(crouch, abs=1e-6)


@pytest.mark.parametrize("steps", [0, 1])  # the second time the LiDAR turns
def test_the_guide_is_silent_when_the_simulation_breaks_down(steps):
    with closing(Guide(Map(LocoEnv("flat")))) as env:
        env.reset(seed=0)
        for _ in range(steps):
            env.step(np.zeros(17))
        env.unwrapped.bullet.resetBaseVelocity(env.unwrapped.robot, (0, 0, 0), (np.nan, 0, 0))
        observation, _, terminated, _, info = env.step(np.zeros(17))
        assert terminated and info["exploded"] and np.isnan(info["guide"]).all()
        assert observation.shape == (402,) and not observation.any()


def test_zero_action_walks_by_itself(plane):
    """At least 0.3 m/s for 8 s on flat ground, from any phase of the stride."""
    for seed in range(6):
        plane.reset(seed=seed)
        start = np.array(plane.position)
        for _ in range(round(8 / DT)):
            _, _, terminated, _, info = plane.step(np.zeros(17))
            assert not info["fall"]
            if terminated:
                break
        assert np.hypot(*(np.array(plane.position) - start)[:2]) / plane.time >= 0.3


def test_success_ends_the_episode_at_the_goal(flat):
    flat.reset(seed=0)
    place(flat, *(np.array(flat.goal) - flat.origin - [GOAL_RADIUS - 0.1, 0, 0]))
    _, _, terminated, truncated, info = flat.step(np.zeros(17))
    assert terminated and not truncated
    assert info["success"] and not info["fall"] and info["t_cr"] == 1.0


def test_tipping_over_is_a_fall(flat):
    flat.reset(seed=0)
    place(flat, *np.subtract(flat.position, flat.origin)[:2], 0.6, roll=1.4)
    before = flat.distance
    _, reward, terminated, _, info = flat.step(np.zeros(17))
    assert terminated and info["fall"] and not info["success"]
    assert reward * DT == pytest.approx(before - flat.distance)


def test_dropping_off_an_edge_is_a_fall():
    env = LocoEnv("flat")
    env.reset(seed=0)
    place(env, -3.0, 0, 0.6)  # beside the terrain: nothing below
    steps = 0
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step(np.zeros(17))
        steps += 1
    assert info["fall"]
    # g t = 2.5 m/s after 0.255 s
    assert steps == pytest.approx(0.255 / DT, abs=1)
    env.close()


@pytest.mark.parametrize("speed", [np.nan, np.inf])
def test_an_exploding_robot_ends_the_episode_and_poisons_nothing(flat, speed):
    flat.reset(seed=0)
    flat.bullet.resetBaseVelocity(flat.robot, (0, 0, 0), (speed, 0, 0))
    observation, reward, terminated, _, info = flat.step(np.zeros(17))
    assert terminated and info["fall"] and info["exploded"]
    assert reward == 0 and observation in flat.observation_space
    assert 0 <= info["t_cr"] <= 1
    flat.reset()
    for _ in range(30):
        observation, reward, terminated, _, info = flat.step(np.zeros(17))
        assert not terminated and np.isfinite(observation).all() and not info["exploded"]


def test_time_limit_truncates():
    env = gymnasium.make("LocoMTRL-v0", tasks="flat", max_episode_steps=7)
    env.reset(seed=0)
    for step in range(1, 8):
        _, _, terminated, truncated, _ = env.step(np.zeros(17, np.float32))
        assert truncated == (step == 7) and not terminated
    env.close()
    assert gymnasium.spec("LocoMTRL-v0").max_episode_steps == 900


def episode(env, seed, steps=300):
    rng = np.random.default_rng(0)
    observations = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        observation, _, terminated, _, _ = env.step(rng.uniform(-1, 1, 17))
        observations.append(observation)
        if terminated:
            observations.append(env.reset()[0])
    return np.array(observations)


def test_same_seed_same_observations():
    one, other = LocoEnv(["rugged", "stairs"]), LocoEnv(["rugged", "stairs"])
    for seed in range(3):
        first = episode(one, seed)
        np.testing.assert_array_equal(first, episode(one, seed))  # in a used environment
        np.testing.assert_array_equal(first, episode(other, seed))  # in another one
    assert not np.array_equal(first, episode(one, seed=6))
    one.close(), other.close()


def test_tasks_that_fail_get_six_times_the_seconds_of_those_that_succeed(monkeypatch):
    env = LocoEnv(["flat", "rugged"])
    seconds = {"flat": 0.0, "rugged": 0.0}
    monkeypatch.setattr(env, "_info", lambda *_: {"t_cr": float(env.terrain.name == "flat")})
    env.reset(seed=0)
    for _ in range(400):
        env.time = 4.0 if env.terrain.name == "flat" else 1.0  # rugged: a quick fall, t_cr 0
        seconds[env.terrain.name] += env.time
        env.reset()
    assert seconds["rugged"] / seconds["flat"] == pytest.approx(6, rel=0.1)
    env.close()


def test_each_training_environment_has_one_task_and_as_many_layouts_as_there_are_tasks():
    tasks = ["flat", "rugged", "ridges"]
    pools = []
    for index in range(4):
        with closing(training_env(index, seed=0, tasks=tasks)) as env:
            pools.append(env.unwrapped.pool)
    assert [{t.name for t in pool} for pool in pools] == [{tasks[i % 3]} for i in range(4)]
    assert {len(pool) for pool in pools} == {3}
    first, second, third = (terrain.vertices.tobytes() for terrain in pools[1])
    assert len({first, second, third}) == 3


def test_every_task_is_drawn_and_named():
    env = LocoEnv(["flat", "holes", wall_ahead])
    tasks = {env.reset(seed=s)[1]["task"] for s in range(30)}
    assert tasks == {"flat", "holes", "wall_ahead"}
    env.close()


def test_a_finished_terrain_can_be_walked():
    place_ = terrain.make_terrain("stairs", np.random.default_rng(0), 0.3)
    env = LocoEnv(place_)
    env.reset(seed=0, options={"terrain": 0, "route": 2})
    np.testing.assert_allclose(env.goal[:2] - env.origin[:2], place_.goals[2][:2])
    env.close()


@settings(max_examples=15, deadline=None)
@given(arrays(np.float32, 17, elements=st.floats(-1e6, 1e6, width=32)))
def test_any_finite_action_gives_an_observation_in_the_space(flat, action):
    flat.reset(seed=0)
    for _ in range(20):
        observation, reward, terminated, _, _ = flat.step(action)
        assert observation in flat.observation_space and np.isfinite(reward)
        if terminated:
            break


def test_mirror_is_its_own_inverse_and_fits_the_spaces():
    for options in ({}, {"tg": False}, {"lidar": False}, {"paper": ["map"], "guide": True}):
        env = make_env("flat", **options)
        i, s, j, t = mirror(env)
        observation = np.arange(env.observation_space.shape[0], dtype=float)
        action = np.arange(env.action_space.shape[0], dtype=float)
        np.testing.assert_array_equal((observation[i] * s)[i] * s, observation)
        np.testing.assert_array_equal((action[j] * t)[j] * t, action)
        env.close()


def test_mirror_is_what_a_mirrored_robot_would_observe(flat):
    """Everything reflected in the x-z plane: pose, goal, legs, stride."""
    env = Map(flat)
    env.reset(seed=0)
    i, s, j, t = mirror(env)
    action = np.random.default_rng(1).uniform(-1, 1, 17)
    observations = []
    for side, act in ((1, action), (-1, action[j] * t)):
        flat.generator.reset(0.7 + (np.pi if side < 0 else 0.0))
        flat.goal = flat.origin + [9.0, 1.5 * side, 0.45]
        env.chart = terrain.Chart(flat.origin[0] + 6.0, 0.0, flat.goal)  # nothing seen yet
        flat.target = flat.generator.step(act[:5], 0.01).tolist()
        joints = np.random.default_rng(2).uniform(-0.5, 0.5, 12).reshape(4, 3)
        joints = (joints if side > 0 else joints[[1, 0, 3, 2]]).ravel()
        for joint, angle in zip(flat.joints, joints, strict=True):
            flat.bullet.resetJointState(flat.robot, joint, angle)
        place(flat, 6.0, 0.2 * side, 0.6, yaw=0.4 * side, roll=0.1 * side)
        flat.bullet.resetBaseVelocity(flat.robot, (0, 0, 0), (0.3 * side, 0.5, 0.7 * side))
        observations.append(env._look(flat._observe()))
    # The TG's targets mirror to a few hundredths: right and left legs are not built quite alike.
    np.testing.assert_allclose(observations[0][i] * s, observations[1], atol=0.02)


@pytest.mark.parametrize(
    "options, named",
    [
        ({"tasks": "lava"}, "lava"),
        ({"tasks": ["flat", "lava"]}, "lava"),
        ({"tasks": []}, "task"),
        ({"difficulty": 2}, "2"),
        ({"difficulty": (0.5, 0.2)}, "0.5"),
        ({"difficulty": float("nan")}, "nan"),
        ({"difficulty": "hard"}, "hard"),
        ({"terrains": 0}, "0"),
        ({"terrains": 1.5}, "1.5"),
        ({"render_mode": "ascii"}, "ascii"),
    ],
)
def test_bad_arguments_are_named(options, named):
    with pytest.raises(ValueError, match=named):
        LocoEnv(**options)


def test_a_blind_robot_draws_no_map():
    with closing(LocoEnv("flat", lidar=False)) as env:
        with pytest.raises(ValueError, match="lidar"):
            Map(env)


@pytest.mark.parametrize("options", [{"terrain": 1}, {"terrain": -1}, {"terrain": "flat"},
                                     {"route": 8}, {"route": 0.5}, {"route": np.nan},
                                     {"seed": 3}])  # fmt: skip
def test_bad_reset_options_are_named(flat, options):
    with pytest.raises(ValueError, match=next(iter(options))):
        flat.reset(seed=0, options=options)


@pytest.mark.parametrize("action", [np.zeros(16), np.full(17, np.nan), np.full(17, np.inf), 0.0])
def test_bad_actions_are_named(flat, action):
    flat.reset(seed=0)
    with pytest.raises(ValueError, match="17 finite"):
        flat.step(action)
