"""Leg kinematics of the Laikago and the trajectory generator that shapes its gait.

Knows no simulator: NumPy only. Arrays over legs are in the order FR, FL, RR, RL; joints of a leg
are abduction, hip, knee, in radians as in the URDF; a foot (the centre of its toe) is (x forward,
y left, z up) in metres in its hip frame, whose origin is the leg's abduction joint.
"""

import math

import numpy as np

LEGS = ("FR", "FL", "RR", "RL")
SIDE = np.array([-1.0, 1.0, -1.0, 1.0])  # +1 on the left; abduction moves a foot outwards
# Read off laikago_toes_zup.urdf (metres, radians).
# Of the abduction joints, in the frame of the base.
HIP_POSITION = np.c_[np.repeat([0.199095, -0.238195], 2), 0.0817145 * SIDE, np.full(4, -0.03)]
LATERAL = np.array([-0.032875, 0.035165, -0.032875, 0.035165])  # leg plane from abduction axis
_SIDE, _LATERAL = SIDE.tolist(), LATERAL.tolist()
UPPER, LOWER = 0.252234, 0.250966  # lengths of the links
HIP_ZERO, KNEE_ZERO = 0.598933, -0.511159  # angle of the straight link minus the joint's


def foot_position(joints):
    """Forward kinematics: joints (..., 12), rad, to feet (..., 4, 3) in their hip frames, m.

    Raises ValueError if the last axis is not 12 long.
    """
    joints = np.asarray(joints, dtype=np.float64)
    if joints.ndim == 0 or joints.shape[-1] != 12:
        raise ValueError(f"joints must have shape (..., 12), got {joints.shape}")
    abduction, hip, knee = np.moveaxis(joints.reshape(*joints.shape[:-1], 4, 3), -1, 0)
    roll, hip = SIDE * abduction, hip + HIP_ZERO
    shin = hip + knee + KNEE_ZERO
    x = -(UPPER * np.sin(hip) + LOWER * np.sin(shin))
    down = -(UPPER * np.cos(hip) + LOWER * np.cos(shin))  # along the leg plane, before the roll
    y = LATERAL * np.cos(roll) - down * np.sin(roll)
    z = LATERAL * np.sin(roll) + down * np.cos(roll)
    return np.stack([x, y, z], axis=-1)


def joint_angles(feet):
    """Inverse kinematics in closed form: feet (..., 4, 3), m, to joints (..., 12), rad.

    Undoes `foot_position`, knees bent backwards. A foot out of reach is clamped: the leg points at
    it, stretched straight (or folded), so that finite feet always give finite angles. Raises
    ValueError if the last axes are not (4, 3).
    """
    feet = np.asarray(feet, dtype=np.float64)
    if feet.shape[-2:] != (4, 3):
        raise ValueError(f"feet must have shape (..., 4, 3), got {feet.shape}")
    angles = [_leg_angles(k % 4, *foot) for k, foot in enumerate(feet.reshape(-1, 3).tolist())]
    return np.reshape(angles, (*feet.shape[:-2], 12))


def _leg_angles(leg, x, y, z):
    """Abduction, hip and knee of one leg in plain floats: NumPy is slow on so few numbers."""
    side, lateral = _SIDE[leg], _LATERAL[leg]
    # Inside the cylinder that the leg plane sweeps around the abduction axis nothing is in reach.
    square = max(y * y + z * z - lateral * lateral, 1e-12)
    down = -math.sqrt(square)
    # The roll turns (lateral, down) to (y, z): the angle between them, from cross and dot product.
    roll = math.atan2(lateral * z - down * y, lateral * y + down * z)
    cos_knee = (x * x + square - (UPPER**2 + LOWER**2)) / (2 * UPPER * LOWER)
    knee = -math.acos(min(max(cos_knee, -1.0), 1.0))
    shin = math.atan2(LOWER * math.sin(knee), UPPER + LOWER * math.cos(knee))
    hip = math.atan2(-x, -down) - shin
    return side * roll, hip - HIP_ZERO, knee - KNEE_ZERO


# What the policy modulates: (value at a zero action, half the range that an action in [-1, 1]
# spans). The zero action is a trot that walks by itself, crouched and with feet lifted high: on
# rough ground, with exploration noise, it falls less than half as often as legs of 0.32 m do.
PARAMETERS = {
    "frequency": (3.0, 1.0),  # Hz, strides a second
    "left_stride": (0.13, 0.27),  # m, travel of the left feet during stance; negative walks back
    "right_stride": (0.13, 0.27),  # m; unlike the left one, it turns the robot, on the spot, too
    "swing_height": (0.26, 0.10),  # m, lift of the feet in mid-swing; soft legs reach 0.14-0.18 m
    "stance_height": (0.25, 0.07),  # m, hips above the feet
}
CENTRE, RANGE = np.array(list(PARAMETERS.values())).T
PHASE_OFFSET = (0.0, math.pi, math.pi, 0.0)  # trot: diagonal legs move together
DUTY = 0.5  # share of a stride that a foot stands: two feet are down at any time
OUTWARD = 0.09  # m that feet stand outside their leg plane: 0.06 falls more, 0.12 climbs less
FORWARD = (0.11, 0.11, -0.05, -0.05)  # m that they stand ahead of their hips: a long one, slopes
MOST_TURN = 0.5  # rad in a stance, that feet go aside for: 0.15 m, as far as a long stride's half
_STANDING_FEET = np.stack([FORWARD, LATERAL + SIDE * OUTWARD, [-CENTRE[4]] * 4], 1)
_FEET = _STANDING_FEET.tolist()
_AHEAD, _LEFT, _ = (HIP_POSITION + _STANDING_FEET).T.tolist()  # of the base's middle
STANDING = joint_angles(_STANDING_FEET)  # (12,) rad, the pose of a gait without strides


class TrajectoryGenerator:
    """Periodic foot paths for a trotting gait, modulated by a policy (paper section 2.2).

    A common phase advances at `frequency`; each leg adds its own offset. During stance a foot
    slides back by the stride length of its side, and where the two differ also aside, around the
    robot's middle; during swing it returns, lifted along half a sine. Feet become joint angles by
    inverse kinematics.

    Attributes:
        phase: common phase, rad in [0, 2 pi).
        parameters: the 5 values of PARAMETERS in force, a list; scaled: the same in [-1, 1].
    """

    action_size = len(PARAMETERS)
    state_size = 2 * len(LEGS) + len(PARAMETERS)

    def __init__(self):
        self.reset()

    def reset(self, phase=0.0):
        """Starts the stride at `phase` (rad, else ValueError) with the zero action's parameters."""
        if not math.isfinite(phase):
            raise ValueError(f"phase must be a finite number, got {phase}")
        self.phase = float(phase) % (2 * np.pi)
        self.scaled, self.parameters = [0.0] * len(PARAMETERS), CENTRE.tolist()

    def step(self, action, dt):
        """Joint targets (12,), rad, `dt` s later, under the parameters that `action` sets.

        action: (5,) in [-1, 1], in the order of PARAMETERS; clipped to that range.
        Raises ValueError if it has another shape or is not finite, or dt is not a time.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != CENTRE.shape or not math.isfinite(sum(action.tolist())):
            raise ValueError(f"action must be {CENTRE.size} finite numbers, got {action}")
        if not 0 <= dt < math.inf:
            raise ValueError(f"dt must be at least 0 and finite, got {dt}")
        # Lists from here on: NumPy is slow on so few numbers.
        self.scaled = [min(max(value, -1.0), 1.0) for value in action.tolist()]
        pairs = zip(PARAMETERS.values(), self.scaled, strict=True)
        self.parameters = [centre + half * scaled for (centre, half), scaled in pairs]
        self.phase = (self.phase + 2 * math.pi * self.parameters[0] * dt) % (2 * math.pi)
        legs = enumerate(self._feet())
        return np.array([angle for k, foot in legs for angle in _leg_angles(k, *foot)])

    def feet(self):
        """Foot targets (4, 3) in the hip frames at the present phase and parameters, m."""
        return np.array(self._feet())

    def _feet(self):
        _, left, right, lift, height = self.parameters
        # Unlike strides turn the robot, by this angle in a stance, and its feet go in circles about
        # its middle. In straight lines they would skid: on rough ground it fell as it turned.
        turn = min(max((right - left) / (_LEFT[1] - _LEFT[0]), -MOST_TURN), MOST_TURN)
        feet = []
        for leg, stride in enumerate((right, left, right, left)):
            cycle = (self.phase + PHASE_OFFSET[leg]) / (2 * math.pi) % 1.0  # 0: touches down
            if cycle < DUTY:
                part, z = 0.5 - cycle / DUTY, -height
            else:
                swing = (cycle - DUTY) / (1 - DUTY)
                part, z = swing - 0.5, lift * math.sin(math.pi * swing) - height
            x, y, _ = _FEET[leg]
            feet.append((x + part * stride, y + part * turn * _AHEAD[leg], z))
        return feet

    def state(self):
        """s_tg, a list of 13: cosine and sine of each leg's phase, then `scaled`."""
        phases = [self.phase + offset for offset in PHASE_OFFSET]
        return [*map(math.cos, phases), *map(math.sin, phases), *self.scaled]
