"""Leg kinematics of the Laikago and the trajectory generator that shapes its gait (section 2.2).

Legs are in the order FR, FL, RR, RL; a leg's joints are abduction, hip and knee, rad, as in the
URDF. A foot is a toe's centre, (x forward, y left, z up), m, seen from its abduction joint.
"""

import math

import numpy as np

LEGS = ("FR", "FL", "RR", "RL")
SIDE = np.array([-1.0, 1.0, -1.0, 1.0])  # +1 on the left; abduction moves a foot outwards
# Read off laikago_toes_zup.urdf (m, rad): the abduction joints in the frame of the base, (4, 3).
HIP_POSITION = np.c_[np.repeat([0.199095, -0.238195], 2), 0.0817145 * SIDE, np.full(4, -0.03)]
LATERAL = np.array([-0.032875, 0.035165, -0.032875, 0.035165])  # leg plane from abduction axis
_SIDE, _LATERAL = SIDE.tolist(), LATERAL.tolist()
UPPER, LOWER = 0.252234, 0.250966  # lengths of the links
HIP_ZERO, KNEE_ZERO = 0.598933, -0.511159  # angle of the straight link minus the joint's


def foot_position(joints):
    """Forward kinematics: joints (..., 12), rad (else ValueError), to feet (..., 4, 3), m."""
    joints = np.reshape(joints, (*np.shape(joints)[:-1], 4, 3))
    roll = SIDE * joints[..., 0]
    hip = joints[..., 1] + HIP_ZERO
    shin = hip + joints[..., 2] + KNEE_ZERO
    x = -(UPPER * np.sin(hip) + LOWER * np.sin(shin))
    down = -(UPPER * np.cos(hip) + LOWER * np.cos(shin))  # along the leg plane, before the roll
    y = LATERAL * np.cos(roll) - down * np.sin(roll)
    z = LATERAL * np.sin(roll) + down * np.cos(roll)
    return np.stack([x, y, z], axis=-1)


def joint_angles(feet):
    """Inverse kinematics: feet (..., 4, 3), m (else ValueError), to joints (..., 12), rad.

    Knees bend backwards. For a foot out of reach the leg points at it, stretched or folded.
    """
    feet = np.asarray(feet, dtype=np.float64)
    if feet.shape[-2:] != (4, 3):
        raise ValueError(f"feet must have shape (..., 4, 3), got {feet.shape}")
    angles = [leg_angles(k % 4, *foot) for k, foot in enumerate(feet.reshape(-1, 3).tolist())]
    return np.reshape(angles, (*feet.shape[:-2], 12))


def leg_angles(leg, x, y, z):
    """`joint_angles` of one leg, in plain floats: NumPy is slow on so few numbers."""
    side, lateral = _SIDE[leg], _LATERAL[leg]
    # No foot reaches inside the cylinder that the leg plane sweeps around the abduction axis.
    square = max(y * y + z * z - lateral * lateral, 1e-12)
    down = -math.sqrt(square)
    # The roll turns (lateral, down) to (y, z): the angle between them, from cross and dot product.
    roll = math.atan2(lateral * z - down * y, lateral * y + down * z)
    cos_knee = (x * x + square - (UPPER**2 + LOWER**2)) / (2 * UPPER * LOWER)
    knee = -math.acos(min(max(cos_knee, -1.0), 1.0))
    shin = math.atan2(LOWER * math.sin(knee), UPPER + LOWER * math.cos(knee))
    hip = math.atan2(-x, -down) - shin
    return side * roll, hip - HIP_ZERO, knee - KNEE_ZERO


# What the policy modulates: (value at a zero action, half of an action's range). The zero action
# is a trot that walks by itself, crouched and with feet lifted high.
PARAMETERS = {
    "frequency": (3.0, 1.0),  # Hz, strides a second
    "left_stride": (0.13, 0.27),  # m, travel of the left feet during stance; negative walks back
    "right_stride": (0.13, 0.27),  # m; unlike the left one, it turns the robot
    "swing_height": (0.26, 0.10),  # m, lift of the feet in mid-swing; soft legs reach 0.14-0.18 m
    "stance_height": (0.25, 0.07),  # m, hips above the feet
}
CENTRE, RANGE = np.array(list(PARAMETERS.values())).T
PHASE_OFFSET = (0.0, math.pi, math.pi, 0.0)  # trot: diagonal legs move together
DUTY = 0.5  # share of a stride that a foot stands: two feet are down at any time
OUTWARD = 0.09  # m that feet stand outside their leg plane
FORWARD = (0.11, 0.11, -0.05, -0.05)  # m that they stand ahead of their hips
MOST_TURN = 0.5  # rad in a stance, so that turning asks for no more than long strides do
_FEET = np.stack([FORWARD, LATERAL + SIDE * OUTWARD, [-CENTRE[4]] * 4], 1)  # standing, (4, 3)
STANDING = joint_angles(_FEET)  # (12,) rad, the pose of a gait without strides
_AHEAD, _LEFT, _ = (HIP_POSITION + _FEET).T.tolist()  # of standing feet, from the base's middle


class TrajectoryGenerator:
    """Periodic foot paths for a trotting gait, modulated by a policy (section 2.2).

    In stance a foot slides back by the stride of its side; where the two strides differ, the feet
    go in circles around the robot's middle. In swing it returns, lifted along half a sine.
    `phase`, rad, is common to all legs. `scaled` are the 5 parameters in force, in [-1, 1].
    """
    action_size = len(PARAMETERS)

    def __init__(self):
        self.reset()

    def reset(self, phase=0.0):
        """Starts a stride at `phase`, rad, with the parameters of the zero action."""
        self.phase = phase % (2 * math.pi)
        self.scaled = [0.0] * self.action_size

    def step(self, action, dt):
        """Joint targets u_tg, a list of 12, rad, `dt` s later, under the parameters of `action`.

        action: 5 finite numbers (else ValueError), as in PARAMETERS, clipped to [-1, 1].
        """
        if len(action) != self.action_size or not math.isfinite(sum(action)):
            raise ValueError(f"action must be {self.action_size} finite numbers, got {action}")
        self.scaled = [min(max(float(value), -1.0), 1.0) for value in action]
        frequency = CENTRE[0] + RANGE[0] * self.scaled[0]
        self.phase = (self.phase + 2 * math.pi * float(frequency) * dt) % (2 * math.pi)
        return [angle for leg, foot in enumerate(self.feet()) for angle in leg_angles(leg, *foot)]

    def feet(self):
        """Foot targets at the present phase and parameters: 4 x (x, y, z), m."""
        pairs = zip(PARAMETERS.values(), self.scaled, strict=True)
        _, left, right, lift, height = (centre + half * scaled for (centre, half), scaled in pairs)
        turn = min(max((right - left) / (_LEFT[1] - _LEFT[0]), -MOST_TURN), MOST_TURN)  # rad
        feet = []
        for leg, stride in enumerate((right, left, right, left)):
            cycle = (self.phase + PHASE_OFFSET[leg]) / (2 * math.pi) % 1.0  # 0: touches down
            if cycle < DUTY:
                part, z = 0.5 - cycle / DUTY, -height  # part of a stride ahead of the middle
            else:
                swing = (cycle - DUTY) / (1 - DUTY)
                part, z = swing - 0.5, lift * math.sin(math.pi * swing) - height
            x, y = FORWARD[leg], float(_FEET[leg, 1])
            feet.append((x + part * stride, y + part * turn * _AHEAD[leg], z))
        return feet

    def state(self):
        """s_tg, a list of 13: cosine and sine of each leg's phase, then `scaled`."""
        phases = [self.phase + offset for offset in PHASE_OFFSET]
        return [*map(math.cos, phases), *map(math.sin, phases), *self.scaled]
