"""Kinematics against Bullet's own, and what the trajectory generator promises."""

from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import tg

URDF = Path(pybullet_data.getDataPath()) / "laikago" / "laikago_toes_zup.urdf"
JOINTS = "hip_motor_2_chassis_joint", "upper_leg_2_hip_motor_joint", "lower_leg_2_upper_leg_joint"
ACTIONS = arrays(np.float64, 5, elements=st.floats(-1, 1))
PI = np.pi


@pytest.fixture(scope="module")
def bullet_feet():
    """Feet in the hip frames as Bullet computes them from the original URDF."""
    client = pybullet.connect(pybullet.DIRECT)
    robot = pybullet.loadURDF(str(URDF), useFixedBase=True, physicsClientId=client)
    infos = [pybullet.getJointInfo(robot, j, physicsClientId=client)
             for j in range(pybullet.getNumJoints(robot, physicsClientId=client))]
    joints = {info[1].decode(): info[0] for info in infos}
    base = pybullet.getBasePositionAndOrientation(robot, physicsClientId=client)[0]

    def feet(angles):
        names = [f"{leg}_{joint}" for leg in tg.LEGS for joint in JOINTS]
        for name, angle in zip(names, angles, strict=True):
            pybullet.resetJointState(robot, joints[name], angle, physicsClientId=client)
        toes = [pybullet.getLinkState(robot, joints[f"jtoe{leg}"], computeForwardKinematics=True,
                                      physicsClientId=client)[4] for leg in tg.LEGS]
        return np.array(toes) - base - tg.HIP_POSITION

    yield feet
    pybullet.disconnect(client)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float64, 12, elements=st.floats(-1.2, 1.2)))
def test_forward_kinematics_agree_with_bullet(bullet_feet, pose):
    np.testing.assert_allclose(tg.foot_position(pose), bullet_feet(pose), atol=1e-4)


def test_a_pose_by_hand():
    feet = tg.foot_position(np.tile([0.0, 0.07, -0.59], 4))
    # x = -(U sin h + L sin(h + k)), h = 0.07 + 0.598933, h + k = h - 0.59 - 0.511159
    assert feet[0] == pytest.approx([-0.1564 + 0.1052, -0.032875, -0.1979 - 0.2278], abs=2e-4)
    assert feet[1, 1] == pytest.approx(0.035165)


def test_standing_feet_are_spread_about_their_hips():
    feet = tg.foot_position(tg.STANDING)
    np.testing.assert_allclose(feet[:, 0], [0.11, 0.11, -0.05, -0.05])
    np.testing.assert_allclose(feet[:, 1], [-0.122875, 0.125165, -0.122875, 0.125165])
    np.testing.assert_allclose(feet[:, 2], -0.25)


@settings(max_examples=200, deadline=None)
@given(st.floats(-0.6, 0.6), st.floats(-1.4, 0.8), st.floats(-1.8, 0.2), st.sampled_from(range(4)))
def test_inverse_returns_the_joints(abduction, hip, knee, leg):
    joints = np.tile(tg.STANDING.reshape(4, 3)[0], (4, 1))
    joints[leg] = abduction, hip, knee
    feet = tg.foot_position(joints.ravel())
    if feet[leg, 2] < -0.1:  # a foot above the hip belongs to two poses
        np.testing.assert_allclose(tg.joint_angles(feet), joints.ravel(), atol=1e-6)


@settings(max_examples=200, deadline=None)
@given(arrays(np.float64, (4, 3), elements=st.floats(-5, 5)))
def test_inverse_is_finite_and_no_leg_becomes_longer(feet):
    reached = tg.foot_position(tg.joint_angles(feet))
    length = np.hypot(tg.UPPER + tg.LOWER, tg.LATERAL)
    assert (np.linalg.norm(reached, axis=1) <= length + 1e-9).all()  # false for nan, too


@pytest.mark.parametrize("far, length", [(1.0, tg.UPPER + tg.LOWER), (1e-4, tg.UPPER - tg.LOWER)])
def test_a_leg_points_at_a_foot_out_of_reach_stretched_or_folded(far, length):
    feet = np.stack([np.full(4, 0.6 * far), tg.LATERAL, np.full(4, -0.8 * far)], axis=1)
    reached = tg.foot_position(tg.joint_angles(feet))
    np.testing.assert_allclose(reached[:, 0], 0.6 * length, atol=1e-6)
    np.testing.assert_allclose(reached[:, 2], -0.8 * length, atol=1e-6)


def test_kinematics_take_batches():
    poses = np.random.default_rng(0).uniform(-0.5, 0.5, (7, 3, 12))
    feet = tg.foot_position(poses)
    assert feet.shape == (7, 3, 4, 3)
    np.testing.assert_array_equal(feet[2, 1], tg.foot_position(poses[2, 1]))
    np.testing.assert_array_equal(tg.joint_angles(feet)[2, 1], tg.joint_angles(feet[2, 1]))
    np.testing.assert_allclose(tg.leg_angles(3, *feet[2, 1, 3]), poses[2, 1, 9:], atol=1e-9)


def test_stance_slides_back_and_swing_lifts():
    generator = tg.TrajectoryGenerator()
    feet = np.array(generator.feet())  # FR and RL touch down, the others take off
    ahead = feet[:, 0] - [0.11, 0.11, -0.05, -0.05]
    np.testing.assert_allclose(ahead, [0.065, -0.065, -0.065, 0.065])  # half of 0.13 m
    np.testing.assert_allclose(feet[:, 2], -0.25)
    generator.reset(2 * PI * 0.75)  # FR is half through its swing, FL half through its stance
    feet = generator.feet()
    assert feet[0] == pytest.approx([0.11, tg.LATERAL[0] - 0.09, -0.25 + 0.26])
    assert feet[1] == pytest.approx([0.11, tg.LATERAL[1] + 0.09, -0.25])
    generator.reset(2 * PI * 0.1)  # a fifth of the stance of FR is over
    assert generator.feet()[0][0] == pytest.approx(0.11 + 0.065 - 0.13 / 5)


@pytest.mark.parametrize("left, right", [(-0.07, 0.07), (0.1, -0.1), (0.06, 0.20)])
def test_feet_go_in_circles_around_the_middle_of_a_robot_that_turns(left, right):
    """Against a base that moves by the mean stride and turns: a standing foot stays where it is."""
    generator, strides = tg.TrajectoryGenerator(), (np.array([left, right]) - 0.13) / 0.27
    ends = []
    for phase in (0.0, PI - 1e-9):  # FR and RL touch down; the same, about to lift off
        generator.reset(phase)
        generator.step([0, *strides, 0, 0], 0.0)
        ends.append((tg.HIP_POSITION + generator.feet())[[0, 3], :2])
    turn = (right - left) / 0.41  # m between left and right feet
    for before, after in zip(*ends, strict=True):
        x, y = (before + after) / 2
        moved = [(left + right) / 2 - turn * y, turn * x]
        np.testing.assert_allclose(before - after, moved, atol=0.002)


def test_feet_go_aside_for_half_a_radian_at_most():
    generator = tg.TrajectoryGenerator()
    generator.step([0, 1, -1, 0, 0], 0.0)  # strides of 0.40 and -0.14 m
    aside = np.array(generator.feet())[:, 1] - tg.LATERAL - 0.09 * tg.SIDE
    # half of 0.5 rad, times 0.199095 + 0.11 m in front and 0.238195 + 0.05 m behind
    np.testing.assert_allclose(aside, [-0.0773, 0.0773, -0.0720, 0.0720], atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(ACTIONS, st.floats(0, 6.28))
def test_feet_move_without_jumps(action, phase):
    generator, path = tg.TrajectoryGenerator(), []
    generator.reset(phase)
    for _ in range(500):  # at 2 Hz or more a whole stride
        generator.step(action, 1e-3)
        path.append(generator.feet())
    # 0.40 m of stride in a swing of 0.5 / 4 s at most, 0.36 m of lift along half a sine
    fastest = max(0.40 / 0.125, PI * 0.36 / 0.125)
    assert np.abs(np.diff(path, axis=0)).max() < 1e-3 * fastest + 1e-9


@settings(max_examples=50, deadline=None)
@given(arrays(np.float64, 5, elements=st.floats(-100, 100)))
def test_actions_are_clipped_and_the_state_stays_in_its_limits(action):
    generator = tg.TrajectoryGenerator()
    targets = generator.step(action, 0.03)
    assert generator.scaled == np.clip(action, -1, 1).tolist()
    np.testing.assert_allclose(tg.foot_position(targets)[:, 1], np.array(generator.feet())[:, 1])
    assert len(generator.state()) == 13
    assert generator.state()[8:] == generator.scaled and np.abs(generator.state()).max() <= 1
    generator.reset()
    assert generator.scaled == [0.0] * 5 and generator.phase == 0


def test_phase_advances_by_the_frequency():
    generator = tg.TrajectoryGenerator()
    for _ in range(30):
        generator.step([0.5, 0, 0, 0, 0], 1 / 30)  # 3.5 Hz for 1 s
    assert generator.phase == pytest.approx(PI, abs=1e-9)
    generator.reset(5 * PI / 2)  # a quarter of a stride: FR and RL; FL and RR are half a one off
    assert generator.state()[:4] == pytest.approx([0, 0, 0, 0], abs=1e-9)
    assert generator.state()[4:8] == pytest.approx([1, -1, -1, 1])


def test_left_and_right_are_mirror_images():
    one, other = tg.TrajectoryGenerator(), tg.TrajectoryGenerator()
    other.reset(PI)
    a = np.reshape(one.step([0.1, 0.9, -0.4, 0.2, -0.3], 0.02), (4, 3))
    b = np.reshape(other.step([0.1, -0.4, 0.9, 0.2, -0.3], 0.02), (4, 3))
    # Not exact: the right leg plane is 2 mm nearer to its axis than the left one.
    np.testing.assert_allclose(a, b[[1, 0, 3, 2]], atol=0.01)


@pytest.mark.parametrize("call, named", [
    (lambda: tg.foot_position(np.zeros(11)), "11.*4,3"), (lambda: tg.foot_position(0.0), "1.*4,3"),
    (lambda: tg.joint_angles(np.zeros((3, 4))), r"must.*\(3, 4\)"),
    (lambda: tg.joint_angles(np.zeros(12)), r"must.*\(12,\)"),
    (lambda: tg.TrajectoryGenerator().step(np.zeros(4), 0.01), "must.*5 finite.*0"),
    (lambda: tg.TrajectoryGenerator().step([0, np.nan, 0, 0, 0], 0.01), "must.*nan"),
    (lambda: tg.TrajectoryGenerator().step([np.inf, 0, -np.inf, 0, 0], 0.01), "must.*inf")])
def test_bad_input_is_named(call, named):
    with pytest.raises(ValueError, match=named):
        call()
