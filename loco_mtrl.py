"""LocoMTRL: a Laikago learns to walk over many terrains with its own LiDAR eyes.

The environment (`LocoEnv`, PyBullet) and what one does with it: train, eval, play, gallery.
A small, complete implementation of "Learning Visual-Locomotion Policies that Generalize to
Diverse Environments"; the sections named below are the paper's.
"""

import argparse
import contextlib
import copy
import itertools
import json
import math
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache, partial
from multiprocessing import get_context
from numbers import Real
from pathlib import Path
from typing import NamedTuple

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

from ppo import PPOConfig, learn, load_policy, note_interrupt, save_policy
from terrain import PILLAR_TASKS, WORLDS, Navigation, Terrain, load_scan, make_terrain, make_world
from tg import LEGS, STANDING, TrajectoryGenerator


@contextlib.contextmanager
def quiet():
    """PyBullet prints banners from C; they have no place in progress bars and JSON."""
    with open(os.devnull, "w") as sink, contextlib.ExitStack() as stack:
        for file in (1, 2):
            with contextlib.suppress(OSError):  # it may be closed
                saved = os.dup(file)
                stack.callback(os.close, saved)
                stack.callback(os.dup2, saved, file)
                os.dup2(sink.fileno(), file)
        yield


with quiet():
    import pybullet
    import pybullet_data
    from pybullet_utils.bullet_client import BulletClient

# ------------------------------------------------------------------------------- the LiDAR

LIDAR_RANGE = 5.0  # m
LIDAR_FRONT, LIDAR_REAR = (0.36, 0.0, 0.08), (-0.38, 0.0, 0.08)  # m, of the two sensors
HOUSING = 0.04  # m, radius of the ball around each: it keeps the lens out of thin walls
# Degrees. Steep rays see the ground that the front feet are about to meet, level ones see walls.
LIDAR_ELEVATIONS = (-70, -52, -38, -27, -18, -10, -3, 8)
# The columns on the left, from ahead to behind, densest ahead, then the first of the right side.
# Each row is turned outwards by 0, 1 or 2 thirds of the way to the next column: together, three
# rows see poles that would slip through one.
_COLUMNS = (4, 13, 23, 34, 46, 60, 78, 102, 130, 158, 186)
_LEFT = [np.interp(np.arange(10) + row % 3 / 3, np.arange(11), _COLUMNS)
         for row in range(len(LIDAR_ELEVATIONS))]
LIDAR_AZIMUTHS = np.array([[*left[::-1], *-left] for left in _LEFT])  # degrees, (rows, columns)
SCAN_SHAPE, N_RAYS = LIDAR_AZIMUTHS.shape, LIDAR_AZIMUTHS.size


def lidar_rays():
    """Where the rays start, m in the base frame, and their unit vectors, (N_RAYS, 3) each.

    Row by row from the lowest, left to right. They start ahead of the chassis or, those that look
    back, behind it: a ray that crosses the robot's own hulls costs many times one that does not.
    The unit vectors turn with the robot's yaw alone, for the sensors hang level, in gimbals: on a
    robot that tilts with the ground, fixed ones see a steep slope as they see a flat floor.
    """
    up, left = np.radians(LIDAR_ELEVATIONS)[:, None], np.radians(LIDAR_AZIMUTHS)
    up, left = (angle.ravel() for angle in np.broadcast_arrays(up, left))
    directions = np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], 1)
    return np.where(directions[:, :1] > 0, LIDAR_FRONT, LIDAR_REAR), directions


# ------------------------------------------------------------------------------- the simulation

DATA = Path(pybullet_data.getDataPath())
LAIKAGO, CHEQUERS = DATA / "laikago" / "laikago_toes_zup.urdf", DATA / "checker_blue.png"
JOINTS = ("hip_motor_2_chassis_joint", "upper_leg_2_hip_motor_joint", "lower_leg_2_upper_leg_joint")
SUBSTEPS, DT = 5, 1 / 30  # physics steps in a control step, and its length in s
MAX_TORQUE = 40.0  # Nm
# Bullet's implicit PD, per physics step. Compliant on purpose: stiff legs fall more often.
POSITION_GAIN, VELOCITY_GAIN, SOLVER_ITERATIONS = 0.10, 1.0, 10
STATIC_GROUP = 2  # Bullet's collision group of bodies without mass: terrain and people
# m, where no terrain is, whatever its heights: for the robot, and for people who are not needed.
AWAY, PARKED = (-1000.0, 0.0, 0.0), (-2000.0, 0.0, 0.0)
PAINT = {"chassis": (0.95, 0.75, 0.15), "hip": (0.9, 0.35, 0.15), "upper": (0.25, 0.45, 0.8),
         "lower": (0.9, 0.9, 0.92), "toe": (0.2, 0.2, 0.2)}  # of a link, by a part of its name

# Collision shapes in place of the convex hulls, with which most of a step would be spent on hull
# against triangle: link, centre (m), roll (rad), kind, size (m). The two lenses are of the LiDAR.
SHAPES = [
    ("chassis", (-0.0125, 0, -0.016), 0, "box", {"size": "0.577 0.28 0.188"}),
    ("chassis", LIDAR_FRONT, 0, "sphere", {"radius": str(HOUSING)}),
    ("chassis", LIDAR_REAR, 0, "sphere", {"radius": str(HOUSING)}),
    ("upper_leg", (0, -0.104165, -0.0711), 2.16983, "capsule",
     {"radius": "0.03", "length": "0.25224"}),
    ("lower_leg", (0, -0.1125, -0.0099), 1.65857, "capsule",
     {"radius": "0.015", "length": "0.22587"}),  # ends inside the toe's sphere
]


def robot_urdf():
    """The Laikago's URDF, an ElementTree, with SHAPES."""
    tree = ET.parse(LAIKAGO)
    for mesh in tree.iter("mesh"):
        mesh.set("filename", str(LAIKAGO.parent / mesh.get("filename")))
    for link in tree.iter("link"):
        for contact in link.findall("contact"):
            contact.clear()  # drops spinning friction and the toes' friction anchors
            ET.SubElement(contact, "lateral_friction", value="1")
        if "toe" not in link.get("name"):  # hip motors lie inside the chassis: they need no shape
            for part in link.findall("collision"):
                link.remove(part)
        for name, centre, roll, kind, size in SHAPES:
            if link.get("name").endswith(name):
                collision = ET.SubElement(link, "collision")
                xyz = " ".join(map(str, centre))
                ET.SubElement(collision, "origin", xyz=xyz, rpy=f"{roll} 0 0")
                ET.SubElement(ET.SubElement(collision, "geometry"), kind, **size)
    return tree


def _about_z(yaw):
    """Quaternion of a turn by `yaw` (rad) about the z axis."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


class Robot(NamedTuple):
    """The robot at one moment, in the world's frame but for its rates."""

    position: tuple  # (x, y, z) m
    yaw: float  # rad
    turn: np.ndarray  # (3, 3), from the base's frame; turn[2, 2]: 1 upright, 0 on its side
    sink: float  # m/s, downward speed
    rates: list  # 3 angular rates in the frame of the base, rad/s
    joints: list  # 12 angles, rad


class Simulation:
    """PyBullet with one Laikago, a pool of terrains side by side, and people.

    Bullet never frees a mesh, so the pool is built once, and a reset only moves the robot.
    `origins` says where each terrain's own frame begins, (x, y, z) m.
    """

    def __init__(self, pool, visual, gui):
        self.visual = visual or gui
        with quiet():
            self.bullet = p = BulletClient(pybullet.GUI if gui else pybullet.DIRECT)
            p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0)
        p.setGravity(0, 0, -9.81)
        self.chequers = p.loadTexture(str(CHEQUERS)) if self.visual else None
        p.setPhysicsEngineParameter(
            fixedTimeStep=DT, numSubSteps=SUBSTEPS, numSolverIterations=SOLVER_ITERATIONS,
            enableConeFriction=0, deterministicOverlappingPairs=1)
        self.origins, edge = [], 0.0
        for terrain in pool:  # farther apart than the LiDAR reaches
            low, high = terrain.vertices[:, 0].min(), terrain.vertices[:, 0].max()
            self.origins.append((edge - low, 0.0, 0.0))
            edge += high - low + 2 * LIDAR_RANGE
            self._add_terrain(terrain, self.origins[-1])
        self.load_robot()
        crowd = max((terrain.people for terrain in pool), key=len)
        self.people = [self._add_body(p.GEOM_CYLINDER, (0.9, 0.5, 0.2, 1), who.RADIUS, who.HEIGHT)
                       for who in crowd]
        self.flag = self._add_body(p.GEOM_SPHERE, (0.2, 0.8, 0.3, 1), 0.2)
        self._rays = lidar_rays()
        self._gains = dict(positionGains=[POSITION_GAIN] * 12, velocityGains=[VELOCITY_GAIN] * 12,
                           forces=[MAX_TORQUE] * 12)

    def __reduce__(self):
        raise TypeError("a simulation cannot be copied or pickled: make another environment")

    def load_robot(self):
        p = self.bullet
        looks = 0 if self.visual else p.URDF_IGNORE_VISUAL_SHAPES  # they take 0.3 s and 170 MB
        with tempfile.NamedTemporaryFile(suffix=".urdf") as file:
            robot_urdf().write(file.name)
            self.robot = p.loadURDF(file.name, AWAY, flags=looks)
        joints = [p.getJointInfo(self.robot, j) for j in range(p.getNumJoints(self.robot))]
        ids = {joint[1].decode(): joint[0] for joint in joints}
        self.joints = [ids[f"{leg}_{joint}"] for leg in LEGS for joint in JOINTS]
        if self.visual:
            links = {-1: "chassis"} | {joint[0]: joint[12].decode() for joint in joints}
            for index, name in links.items():
                colour = next(rgb for part, rgb in PAINT.items() if part in name)
                p.changeVisualShape(self.robot, index, rgbaColor=(*colour, 1), textureUniqueId=-1)

    def _add_terrain(self, terrain, origin):
        p = self.bullet
        mesh = dict(vertices=terrain.vertices.tolist(), indices=terrain.triangles.ravel().tolist())
        shape = p.createCollisionShape(p.GEOM_MESH, flags=p.GEOM_FORCE_CONCAVE_TRIMESH, **mesh)
        body = p.createMultiBody(0, shape, basePosition=origin)
        p.changeDynamics(body, -1, lateralFriction=terrain.friction)
        if not self.visual:
            return
        # Ground and walls in colours of their own: shading alone does not tell them apart.
        a, b, c = (terrain.vertices[terrain.triangles[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        steep = np.abs(normal[:, 2]) < 0.5 * np.linalg.norm(normal, axis=1)
        x, y, z = terrain.vertices.T
        for part, colour, squares in ((~steep, (0.8, 0.76, 0.6, 1), (x, y)),
                                      (steep, (0.6, 0.47, 0.4, 1), (x + y, z))):
            if part.any():
                mesh["indices"] = terrain.triangles[part].ravel().tolist()
                mesh["uvs"] = (np.stack(squares, 1) + 1000).tolist()  # m; none may be negative
                looks = p.createVisualShape(p.GEOM_MESH, **mesh)
                body = p.createMultiBody(0, -1, looks, basePosition=origin)
                p.changeVisualShape(body, -1, rgbaColor=colour, textureUniqueId=self.chequers)

    def _add_body(self, kind, colour, radius, height=0.0):
        """A person or, without a height, a mark that nothing feels; at first far away."""
        p, shape, looks = self.bullet, -1, -1
        if height:
            shape = p.createCollisionShape(kind, radius=radius, height=height)
        if self.visual:
            looks = p.createVisualShape(kind, radius=radius, length=height, rgbaColor=colour)
        return p.createMultiBody(0, shape, looks, basePosition=PARKED)

    def place(self, position, yaw, joints):
        """Puts the robot down, at rest. What happens next depends on nothing that was before."""
        p = self.bullet
        for place in (AWAY, position):  # far away first: there Bullet forgets old contacts
            p.resetBasePositionAndOrientation(self.robot, place, _about_z(yaw))
            p.resetBaseVelocity(self.robot, [0, 0, 0], [0, 0, 0])
            for joint, angle in zip(self.joints, joints, strict=True):
                p.resetJointState(self.robot, joint, angle)
            if place is AWAY:
                self.step(joints)

    def step(self, targets):
        """One control step with the PD controllers' targets (12 joint angles, rad)."""
        p = self.bullet
        p.setJointMotorControlArray(self.robot, self.joints, p.POSITION_CONTROL, targets,
                                    **self._gains)
        p.stepSimulation()

    def sense(self):
        """The Robot as it is now."""
        p = self.bullet
        position, quaternion = p.getBasePositionAndOrientation(self.robot)
        velocity, rates = p.getBaseVelocity(self.robot)
        turn = np.reshape(p.getMatrixFromQuaternion(quaternion), (3, 3))
        yaw, rates = math.atan2(turn[1, 0], turn[0, 0]), (turn.T @ rates).tolist()
        joints = [joint[0] for joint in p.getJointStates(self.robot, self.joints)]
        return Robot(position, yaw, turn, -velocity[2], rates, joints)

    def scan(self, robot):
        """What rayTestBatch says of each ray: body, link, fraction of the range, position, ..."""
        sources, directions = self._rays
        sources = sources @ robot.turn.T + robot.position
        sin, cos = math.sin(robot.yaw), math.cos(robot.yaw)
        level = [(cos, sin, 0), (-sin, cos, 0), (0, 0, 1)]  # the axes of the gimbals, as rows
        ends = sources + LIDAR_RANGE * directions @ level
        return self.bullet.rayTestBatch(sources.tolist(), ends.tolist(),
                                        collisionFilterMask=STATIC_GROUP)

    def move_people(self, people, terrain, origin):
        """Puts the bodies where people are on the terrain; those that are not needed, far away."""
        for body, person in itertools.zip_longest(self.people, people):
            place, yaw = PARKED, 0.0
            if person:
                x, y, yaw = person.place()
                place = (x + origin[0], y, float(terrain.height(x, y)) + person.HEIGHT / 2)
            self.bullet.resetBasePositionAndOrientation(body, place, _about_z(yaw))

    def touches_people(self):
        return any(self.bullet.getContactPoints(self.robot, body) for body in self.people)

    def picture(self, position, yaw, hits):
        """The robot from above, behind and aside, uint8 (300, 400, 3). hits (H, 3) m: red dots."""
        p, width, height = self.bullet, 400, 300
        view = p.computeViewMatrixFromYawPitchRoll(position, 2.2, math.degrees(yaw) - 60, -42, 0, 2)
        projection = p.computeProjectionMatrixFOV(55, width / height, 0.1, 40)
        rgba = p.getCameraImage(
            width, height, view, projection, lightDirection=(2, 3, 8), lightAmbientCoeff=0.65,
            lightDiffuseCoeff=0.5, lightSpecularCoeff=0.05, renderer=p.ER_TINY_RENDERER)[2]
        picture = np.reshape(rgba, (height, width, 4))[..., :3].astype(np.uint8)
        # Bullet's matrices are for rows: (x, y, z, 1) @ view @ projection, then over the last.
        camera = np.reshape(view, (4, 4)) @ np.reshape(projection, (4, 4))
        seen = np.pad(np.reshape(hits, (-1, 3)), [(0, 0), (0, 1)], constant_values=1) @ camera
        seen = seen[(np.abs(seen[:, :2]) < seen[:, 3:]).all(1)]  # within the picture
        column, row = ((seen[:, :2] / seen[:, 3:] * (1, -1) + 1) / 2 * (width - 1, height - 1)).T
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            picture[row.astype(int) + i, column.astype(int) + j] = 230, 30, 30
        return picture


# ------------------------------------------------------------------------------- the environment

HOLD = 3  # control steps that one decision of the policy lasts: it decides at 10 Hz
RESIDUAL = {True: 0.04, False: 0.6}  # rad that a joint's action of 1 means, with and without TG
BASE_HEIGHT = 0.28  # m, of the base above the ground in the standing pose
GOAL_RADIUS = 0.5  # m, r_g
FALL_UP = 0.5  # cosine of the greatest tilt: a base tipped by over 60 degrees has fallen
FALL_SPEED = 2.5  # m/s, downward speed that would break a real robot
EXPLODED = 1e3  # m or rad/s that no robot reaches: the simulation has broken down


class Part(NamedTuple):
    """Part of an observation or an action; part[image] * sign is its left-right mirror image."""

    name: str
    low: float
    high: float
    image: list
    sign: int | list = 1  # one for all entries, or one for each
    std: float = 0.0  # of an action's exploration noise at first
    share: float = 0.0  # of a new action that takes effect in one control step

    @property
    def size(self):
        return len(self.image)


SWAP_RAYS = np.arange(N_RAYS).reshape(SCAN_SHAPE)[:, ::-1].ravel()
SWAP_LEGS = np.arange(12).reshape(4, 3)[[1, 0, 3, 2]].ravel()  # joint angles mirror unsigned
SWAP_STRIDES = [0, 2, 1, 3, 4]


def observation_parts(tg=True, lidar=True):
    """What an observation consists of, in its order (section 2.1)."""
    eyes = [Part("LiDAR scan, sqrt(distance / 5 m)", 0, 1, SWAP_RAYS)]
    body = [Part("distance to the goal, m", 0, 1e3, [0]),
            Part("heading of the goal, left positive, rad", -math.pi, math.pi, [0], -1),
            Part("angular rates of the base, rad/s", -1e3, 1e3, [0, 1, 2], [-1, 1, -1]),
            Part("joint angles, rad", -1e2, 1e2, SWAP_LEGS),
            Part("last commanded joint angles, rad", -1e2, 1e2, SWAP_LEGS)]
    gait = [Part("TG: cosine and sine of each leg's phase", -1, 1, [1, 0, 3, 2, 5, 4, 7, 6]),
            Part("TG: parameters in force", -1, 1, SWAP_STRIDES)]
    return (eyes if lidar else []) + body + (gait if tg else [])


def action_parts(tg=True):
    """What an action consists of."""
    if not tg:
        return [Part("joint offsets from the standing pose", -1, 1, SWAP_LEGS, std=0.5, share=0.5)]
    return [Part("TG: parameters", -1, 1, SWAP_STRIDES, std=0.3, share=0.2),
            Part("joint residuals", -1, 1, SWAP_LEGS, std=0.5, share=0.5)]


def box(parts):
    """The Gymnasium space of all parts."""
    bounds = np.float32([(part.low, part.high) for part in parts for _ in part.image])
    return gymnasium.spaces.Box(*bounds.T)


def mirror(parts):
    """(index, sign) over all parts: the image of an observation or action x is x[index] * sign."""
    index, sign = [], []
    for part in parts:
        index += [len(sign) + k for k in part.image]
        sign += np.broadcast_to(part.sign, part.size).tolist()
    return index, sign


class LocoEnv(gymnasium.Env):
    """A Laikago walks to a goal over terrain that only its LiDAR shows it (section 2).

    ## Observation: Box, float32
    `observation_parts` is the table of its entries, in the order of section 2.1.

    ## Action: Box(-1, 1), clipped to that range
    5 parameters of the trajectory generator (`tg.PARAMETERS`), then the 12 residuals u_fb;
    u_tg + u_fb are joint targets, which PD controllers with limited torque track (section 2.2).
    With tg=False (reactive), 12 offsets from the standing pose. An action is held for HOLD control
    steps of DT s, in which what is in force moves toward it (`Part.share`).

    ## Reward
    (d_{t-1} - d_t) / dt, the velocity toward the goal, m/s. The paper prints the opposite sign but
    calls it the velocity toward the target.

    ## Episode
    It terminates at the goal (base within GOAL_RADIUS) and in a fall (FALL_UP, FALL_SPEED: what
    breaks a real robot), looked for after each decision. The time limit is the wrapper's.

    `info` holds task, t_cr = 1 - d_T / d_0 in [0, 1] (1 at the goal), success, fall, collisions:
    how often the robot has bumped into a person, and exploded: that the simulation broke down,
    which ends the episode as a fall with an observation of zeros.

    Args:
        tasks: a task's name, a function (rng, difficulty) -> heights, a finished Terrain, or a list
            of these. The policy is not told which.
        difficulty: (low, high) in [0, 1], to draw it from, once for each terrain.
        tg, lidar: the paper's ablations (section 3) leave one of them out.
        layouts: how many terrains of each task to build. An episode draws one of them all.
        pool_seed: seeds the layouts; `reset(seed=...)` seeds all else.
        render_mode: None or "rgb_array".
        gui: open PyBullet's window; it allows one in a process.

    Raises ValueError for any argument out of range, naming it and what is valid.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT / HOLD)}

    def __init__(self, tasks=tuple(PILLAR_TASKS), difficulty=(0.0, 1.0), tg=True, lidar=True,
                 layouts=1, pool_seed=0, render_mode=None, gui=False):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        numbers = np.shape(difficulty) == (2,) and all(isinstance(d, Real) for d in difficulty)
        if not numbers or not 0 <= difficulty[0] <= difficulty[1] <= 1:
            raise ValueError(f"difficulty must be (low, high) in [0, 1], got {difficulty}")
        if not isinstance(layouts, (int, np.integer)) or layouts < 1:
            raise ValueError(f"layouts must be a whole number of at least 1, got {layouts!r}")
        tasks = tasks if isinstance(tasks, (list, tuple)) else [tasks]
        if not tasks:
            raise ValueError(f"tasks must hold at least one task; valid: {', '.join(PILLAR_TASKS)}")
        rng = np.random.default_rng(pool_seed)
        self.pool = [make_terrain(task, rng, rng.uniform(*difficulty)) for task in tasks
                     for _ in range(1 if isinstance(task, Terrain) else layouts)]
        self.render_mode, self.lidar, self.gui = render_mode, lidar, gui
        self.generator = TrajectoryGenerator() if tg else None
        self.observation_space = box(observation_parts(tg, lidar))
        self.action_space = box(action_parts(tg))
        self.smoothing = [part.share for part in action_parts(tg) for _ in part.image]
        self.residual = RESIDUAL[bool(tg)]
        self.simulation = Simulation(self.pool, render_mode is not None, gui)
        self.robot = None  # no episode yet

    def reset(self, *, seed=None, options=None):
        """Stands the robot at a start; `options={"terrain": i, "route": k}` chooses which.

        Raises ValueError for another option, or one that the pool has not.
        """
        self._check_open()
        super().reset(seed=seed)
        rng, options = self.np_random, dict(options or {})
        index = options.pop("terrain", rng.integers(len(self.pool)))
        if index not in range(len(self.pool)) or set(options) - {"route"}:
            raise ValueError(f"options may be terrain, in range({len(self.pool)}), and route, "
                             f"got {index!r}, {options}")
        starts = self.pool[int(index)].starts
        route = options.get("route", rng.integers(len(starts)))
        if route not in range(len(starts)):
            raise ValueError(f"route must be in range({len(starts)}), got {route!r}")
        self.terrain, self.origin = self.pool[int(index)], self.simulation.origins[int(index)]
        x, y, z, yaw = starts[int(route)]
        self.goal = (self.terrain.goals[int(route)] + self.origin + [0, 0, BASE_HEIGHT]).tolist()
        self.action = [0.0] * len(self.smoothing)  # in force, after smoothing
        self.target = STANDING.tolist()  # of the joints
        if self.generator:
            self.generator.reset(rng.uniform(0, 2 * np.pi))
            self.target = self.generator.step(self.action[:-12], 0.0)
        position = np.add(self.origin, (x, y, z + BASE_HEIGHT + 0.02)).tolist()
        self.people = copy.deepcopy(self.terrain.people)
        self.simulation.move_people(self.people, self.terrain, self.origin)
        self.simulation.place(position, yaw + rng.uniform(-0.5, 0.5), self.target)
        self.collisions, self.touching, self.seconds = 0, False, 0.0
        self.robot = self.simulation.sense()
        self.start_distance = self._distance(self.robot)
        self.simulation.bullet.resetBasePositionAndOrientation(
            self.simulation.flag, self.goal, (0, 0, 0, 1))
        return self.observe(), self._info(False, False)

    def step(self, action):
        self._check_open(running=True)
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not np.isfinite(action).all():
            raise ValueError(f"action must be {len(self.action)} finite numbers, got {action}")
        action = [min(max(a, -1.0), 1.0) for a in action.tolist()]
        before = self._distance(self.robot)
        for _ in range(HOLD):
            self._control(action)
        touching = self.simulation.touches_people()
        self.collisions += touching and not self.touching
        self.touching = touching
        robot = self.simulation.sense()
        if not math.hypot(self._distance(robot), *robot.rates) < EXPLODED:  # or NaN
            self.simulation.bullet.disconnect()  # NaN has spread in it
            self.simulation = Simulation(self.pool, self.render_mode is not None, self.gui)
            nothing = np.zeros(self.observation_space.shape, np.float32)
            return nothing, 0.0, True, False, self._info(False, True, exploded=True)
        self.robot = robot
        success = self._distance(robot) < GOAL_RADIUS
        fall = not success and (robot.turn[2, 2] < FALL_UP or robot.sink > FALL_SPEED)
        reward = (before - self._distance(robot)) / (HOLD * DT)
        return self.observe(), reward, success or fall, False, self._info(success, fall)

    def _control(self, action):
        """One control step: smoothing, trajectory generator, residuals, physics, people."""
        triples = zip(self.action, action, self.smoothing, strict=True)
        self.action = [old + share * (new - old) for old, new, share in triples]
        u_tg = STANDING.tolist()
        if self.generator:
            u_tg = self.generator.step(self.action[:-12], DT)
        pairs = zip(u_tg, self.action[-12:], strict=True)
        self.target = [u + self.residual * a for u, a in pairs]  # u_tg + u_fb
        self.simulation.step(self.target)
        self.seconds += DT
        for person in self.people:
            person.walk(DT, np.subtract(self.robot.position, self.origin)[:2])
        self.simulation.move_people(self.people, self.terrain, self.origin)

    def _distance(self, robot):
        """From the robot's base to the goal, m."""
        return math.dist(self.goal, robot.position)

    def observe(self):
        """The observation, whose order is that of `observation_parts`, (n_obs,) float32."""
        robot, scan = self.robot, []
        if self.lidar:
            # The root spends most of the range [0, 1] on what is near, and still sees 5 m far.
            scan = [math.sqrt(hit[2]) for hit in self.simulation.scan(robot)]
        dx, dy, _ = np.subtract(self.goal, robot.position).tolist()
        heading = math.remainder(math.atan2(dy, dx) - robot.yaw, 2 * math.pi)
        s_tg = self.generator.state() if self.generator else []
        return np.float32([*scan, self._distance(robot), heading, *robot.rates, *robot.joints,
                           *self.target, *s_tg])

    def _info(self, success, fall, exploded=False):
        progress = 1.0 if success else 1.0 - self._distance(self.robot) / self.start_distance
        return {"task": self.terrain.name, "t_cr": max(0.0, progress), "success": success,
                "fall": fall, "collisions": self.collisions, "exploded": exploded}

    def render(self):
        """The robot, the terrain around it and what its LiDAR hits, uint8 (300, 400, 3).

        Raises ValueError if the environment was made without render_mode.
        """
        if self.render_mode is None:
            raise ValueError("render() needs render_mode='rgb_array'")
        self._check_open(running=True)
        dx, dy, _ = np.subtract(self.goal, self.robot.position)
        hits = self.simulation.scan(self.robot) if self.lidar else []
        return self.simulation.picture(self.robot.position, math.atan2(dy, dx),
                                       [hit[3] for hit in hits if hit[2] < 1])

    def _check_open(self, running=False):
        if self.simulation is None:
            raise gymnasium.error.ClosedEnvironmentError("this environment is closed")
        if running and self.robot is None:
            raise gymnasium.error.ResetNeeded("call reset() first")

    def close(self):
        if self.simulation is not None:
            with quiet():  # the window says goodbye at length
                self.simulation.bullet.disconnect()
            self.simulation = self.robot = None


gymnasium.register("LocoMTRL-v0", LocoEnv, max_episode_steps=300)


def make_env(tasks, seconds=30, **options):
    """A LocoEnv whose episodes last at most so many seconds. options: LocoEnv's."""
    return gymnasium.wrappers.TimeLimit(LocoEnv(tasks, **options), round(seconds / DT / HOLD))


# ------------------------------------------------------------------------------- train

REWARD_SCALE = HOLD * DT  # rewards in metres of progress keep the critic's targets near 1
LAYOUTS = 8  # terrains of each training environment
PROGRAM = "python loco_mtrl.py"
STAGE = 50_000  # steps; then every process starts itself afresh, on new layouts


def stage(steps, args):
    """Where a step lies: (new layouts so far, index of the task with --sequential, its end)."""
    n = len(args.tasks) if args.sequential else 1
    layouts, task = steps // STAGE, min(n * steps // args.steps, n - 1)
    return layouts, task, min((layouts + 1) * STAGE, math.ceil((task + 1) * args.steps / n))


def training_env(index, steps, args):
    """Environment number `index` over all ranks, in the stage that begins at `steps`: one task.

    Each of the 34 environments keeps to one of the 17 tasks, so all tasks have the same share of
    every batch. With --sequential the stage's task has all environments.
    """
    layouts, k, _ = stage(steps, args)
    task = args.tasks[k if args.sequential else index % len(args.tasks)]
    env = make_env(task, tg=args.tg, lidar=args.lidar, layouts=LAYOUTS,
                   pool_seed=(args.seed, layouts, k, index))
    return gymnasium.wrappers.TransformReward(env, lambda reward: REWARD_SCALE * reward)


def train(args):
    """`train`: one process for each core, unless torchrun has started them already."""
    if "RANK" not in os.environ:
        return launch(args)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    first, run_dir = os.environ["RANK"] == "0", Path(args.run_dir)
    stages, checkpoint = int(os.environ.get("PPO_STAGE", 0)), run_dir / "checkpoint.pt"
    crashed = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"  # torchrun starts us again
    # Ablations change what is observed, what is commanded or which task comes when: nothing else.
    meta = {name: getattr(args, name) for name in ("tg", "lidar", "tasks", "sequential", "seed")}
    observation, action = observation_parts(args.tg, args.lidar), action_parts(args.tg)
    config = PPOConfig(
        total_timesteps=args.steps, seed=args.seed, n_scan=N_RAYS * args.lidar,
        init_std=tuple(part.std for part in action for _ in part.image))
    writer = None
    if args.tensorboard and first:
        from torch.utils.tensorboard import SummaryWriter

        writer = SummaryWriter(run_dir)

    def on_update(model, row):
        tasks = stage(row["steps"], args)[1]  # done, with --sequential: what do they leave?
        if tasks and not (run_dir / f"policy-{tasks}.pt").exists():
            save_policy(run_dir / f"policy-{tasks}.pt", model, meta)
        if writer:
            for name, value in row.items():
                writer.add_scalar(name, value, row["steps"])
            writer.flush()

    try:
        model, steps = learn(
            partial(training_env, args=args), config, run_dir=run_dir, meta=meta,
            resume=args.resume or stages > 0 or crashed and checkpoint.exists(),
            mirror=(mirror(observation), mirror(action)), stage_end=lambda n: stage(n, args)[2],
            episode_keys=("t_cr", "success", "fall", "exploded"), on_update=on_update)
    except KeyboardInterrupt:
        if first:
            print(f"\nStopped. To go on: {again(args)}" if checkpoint.exists() else "\nStopped.")
        return 130
    if steps < args.steps:  # Bullet gives no memory back but to a new process
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()
        os.environ["PPO_STAGE"] = str(stages + 1)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])
    if first:
        save_policy(run_dir / "policy.pt", model, meta)
        draw_curve(run_dir)
        print(f"Policy: {run_dir}/policy.pt   Curve: {run_dir}/curve.png")


def draw_curve(run_dir):
    """Writes curve.png, t_cr of training against minutes, where matplotlib is installed."""
    try:
        from matplotlib.figure import Figure  # not pyplot: a notebook keeps its backend
    except ImportError:
        return
    figure = Figure(figsize=(5, 3), layout="constrained")
    rows = np.genfromtxt(run_dir / "progress.csv", delimiter=",", names=True, ndmin=1)
    axis = figure.subplots()
    axis.plot(rows["minutes"], rows["t_cr"])
    axis.set(xlabel="minutes", ylabel="t_cr", ylim=(0, 1))
    figure.savefig(run_dir / "curve.png", dpi=100)


@contextlib.contextmanager
def deaf():
    """What is started here does not hear Ctrl-C, until it says otherwise."""
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def launch(args):
    """Starts one process for each rank, as torchrun would, and waits for them."""
    n_ranks = min(args.ranks, PPOConfig.num_envs)
    os.environ["LOCO_MTRL"] = "loco-mtrl" if Path(sys.argv[0]).name == "loco-mtrl" else PROGRAM
    store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    shared = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port), "OMP_NUM_THREADS": "1",
              "WORLD_SIZE": str(n_ranks), "TORCHELASTIC_USE_AGENT_STORE": "True"}
    command = [sys.executable, __file__, *args.argv]
    with deaf():
        ranks = [subprocess.Popen(command, env=os.environ | shared | {"RANK": str(rank)})
                 for rank in range(n_ranks)]
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        with note_interrupt():  # ranks hear of Ctrl-C by themselves
            while None in (codes := [rank.poll() for rank in ranks]) and not any(codes):
                time.sleep(0.1)
            for rank in ranks:  # where one fails, the others notice, or wait for it in vain
                with contextlib.suppress(subprocess.TimeoutExpired):
                    rank.wait(None if 130 in codes else 10)
            codes = [rank.poll() or 0 for rank in ranks]
    finally:
        for rank in ranks:
            rank.kill()
    for rank, code in enumerate(codes):
        if code < 0:
            print(f"loco_mtrl.py: error: rank {rank} was killed by signal {-code}. "
                  f"To go on from the last checkpoint: {again(args)}", file=sys.stderr)
    return next((abs(code) for code in codes if code), 0)


def again(args):
    """The command that resumes this run, by the program that the user has called."""
    kept = [argument for argument in args.argv or ["train"] if argument != "--resume"]
    return f"{os.environ.get('LOCO_MTRL', PROGRAM)} {shlex.join([*kept, '--resume'])}"


# ------------------------------------------------------------------------------- eval, play

GIF_EVERY = 2  # decisions a frame: 5 frames a second
EVAL_SECONDS = 60  # an episode's limit
EVAL_SEED = 10_000  # episode k of every policy in every world has seed EVAL_SEED + k
# Tables 1 and 2, t_cr in the order of WORLDS: means, then standard deviations, in hundredths.
PAPER = {
    "flat": "39 22 54 51 50 43 32 57  17 21 12 16 12 13 18 12",
    "rugged": "57 28 64 60 59 65 36 73  18 11 12 15 16 18 16 17",
    "holes": "33 22 41 38 38 39 52 57  18 12 15 16 13 12 15 13",
    "obstacles": "70 23 67 69 68 59 55 53  19 04 19 15 17 09 13 16",
    "stairs": "39 28 52 49 43 60 38 68  18 11 14 13 16 19 18 10",
    "reactive": "67 65 76 77 56 75 68 64  13 16 16 19 12 14 10 14",
    "no vision": "56 44 54 51 47 57 32 54  17 12 16 15 17 16 08 13",
    "sequential": "60 29 63 62 59 61 57 61  18 15 17 14 19 13 14 17",
    "ours": "72 67 84 83 79 78 70 72  13 12 11 13 14 10 17 19",
}


def zero(observation):
    """The trajectory generator alone."""
    return np.zeros(17)


def straight(observation):
    """Walks straight at the goal on the same trajectory generator. For a robot without LiDAR."""
    turn = 0.4 * np.clip(observation[1], -0.6, 0.6)
    return np.array([0.0, 0.75 - turn, 0.75 + turn, *[0.0] * 14])


REFERENCES = {"zero": zero, "straight": straight}


@lru_cache
def load_actor(name):
    """(act, options, row): observation -> action, LocoEnv's options, the row's name in PAPER.

    `name` is a checkpoint's path or one of REFERENCES. Raises as `load_checkpoint` does.
    """
    if name in REFERENCES:
        return REFERENCES[name], {"lidar": False}, None
    model, meta = load_policy(name)
    if not {"tg", "lidar", "tasks", "sequential"} <= set(meta or {}) or not meta["tasks"]:
        raise ValueError(f"{name} is not a policy for LocoEnv: {meta}")
    options, tasks = {"tg": meta["tg"], "lidar": meta["lidar"]}, meta["tasks"]
    sizes = box(observation_parts(**options)).shape + box(action_parts(meta["tg"])).shape
    given = model.kwargs["obs_dim"], model.kwargs["act_dim"]
    if sizes != given:
        raise ValueError(f"{name} is for observations and actions of {given} numbers, but a robot "
                         f"here has {sizes}")
    kinds = {"reactive": not meta["tg"], "no vision": not meta["lidar"],
             "sequential": meta["sequential"], tasks[0]: len(tasks) == 1, "ours": True}
    return model.mean_action, options, next(kind for kind, holds in kinds.items() if holds)


def open_scan(args):
    """The scan that --scan names; says what was taken for its floor."""
    scan = load_scan(args.scan, args.scale, args.up)
    low, high = scan.vertices.min(0), scan.vertices.max(0)
    size = " x ".join(f"{side:.1f}" for side in high - low)
    print(f"{scan.name}: {size} m; its floor lies {abs(low[2]):.2f} m above the lowest point",
          file=sys.stderr)
    a, b, c = (scan.vertices[scan.triangles[:, k]] for k in range(3))
    facing = np.abs(np.cross(b - a, c - a)).sum(0)  # how much of it faces x, y, z
    other, axis = ("y", 1) if args.up == "z" else ("z", 0)
    if facing[axis] > facing[2]:  # floors and ceilings are more than walls, mostly
        print(f"It may lie on its side: if so, --up {other}", file=sys.stderr)
    return scan


def episode(actor, place, seed, **options):
    """One episode, step by step: yields (env, info), at first of the reset.

    place: a world, a training task, on held-out seeds, or a Terrain. options: LocoEnv's.
    """
    act, kind, _ = load_actor(actor)
    # By the golden ratio the difficulties of a few seeds in a row are spread evenly, too.
    rng, difficulty = np.random.default_rng(seed), 0.618034 * seed % 1
    place = make_world(place, seed) if place in WORLDS else make_terrain(place, rng, difficulty)
    with contextlib.closing(make_env(place, EVAL_SECONDS, **kind, **options)) as env:
        observation, info = env.reset(seed=seed)
        terminated = truncated = False
        yield env.unwrapped, info
        while not (terminated or truncated):
            observation, _, terminated, truncated, info = env.step(act(observation))
            yield env.unwrapped, info


def score(actor, place, seed):
    """The score of one episode: {t_cr, success, fall, collisions, seconds}."""
    torch.set_num_threads(1)
    *_, (env, info) = episode(actor, place, seed)
    keys = ("t_cr", "success", "fall", "collisions")
    return {key: float(info[key]) for key in keys} | {"seconds": env.seconds}


def evaluate(actors, places, n_episodes, workers):
    """Scores of every actor in every place: {(actor, place's name): [score's dict, ...]}.

    Every episode has an environment of its own, so the scores do not depend on `workers`.
    Raises RuntimeError if a worker is killed, or if a script calls it without a main guard.
    """
    seeds = range(EVAL_SEED, EVAL_SEED + n_episodes)
    jobs = [(actor, place, seed) for place in places for actor in actors for seed in seeds]
    scores = {}
    with tqdm(total=len(jobs), unit="episode") as bar:
        while jobs:  # new workers now and then, for Bullet never frees a mesh
            some, jobs = jobs[:200], jobs[200:]
            pool = ProcessPoolExecutor(workers, get_context("spawn"))
            try:
                with deaf():
                    results = pool.map(score, *zip(*some, strict=True))
                for (actor, place, _), result in zip(some, results, strict=True):
                    scores.setdefault((actor, getattr(place, "name", place)), []).append(result)
                    bar.update()
            finally:
                pool.shutdown(cancel_futures=True)
    return scores


def eval_command(args):
    """`eval`: the table of the paper for one or more policies."""
    kinds = {load_actor(actor)[2] for actor in args.policies}
    places = [open_scan(args)] if args.scan else args.worlds
    if args.json:  # a bad place is named before any work
        check_writable(args.json)
    scores = evaluate(args.policies, places, args.episodes, args.ranks)
    names = list(dict.fromkeys(name for _, name in scores))
    table = {}
    for name in names:
        runs = [run for actor in args.policies for run in scores[actor, name]]
        t_cr = np.reshape([run["t_cr"] for run in runs], (len(args.policies), -1))
        means = {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}
        table[name] = means | {"std": float(t_cr.std()), "per_policy": t_cr.mean(1).tolist()}
    lines = [("", names)] + [(key, [f"{table[name][key]:.2f}" for name in names]) for key in
                             ("t_cr", "std", "success", "fall", "collisions", "seconds")]
    if names == list(WORLDS):
        for kind in (kind for kind in PAPER if kind in kinds):
            figures = ["0." + figure for figure in PAPER[kind].split()]
            lines += [(f"paper: {kind}", figures[:8]), ("paper: std", figures[8:])]
    for name, cells in lines:
        print(f"{name:18}" + "".join(f"{cell:>12}" for cell in cells))
    for k, actor in enumerate(args.policies):
        print(f"mean t_cr {np.mean([w['per_policy'][k] for w in table.values()]):.3f}  {actor}")
    if args.json:
        report = {"policies": args.policies, "episodes": args.episodes, "worlds": table,
                  "mean_t_cr": float(np.mean([world["t_cr"] for world in table.values()]))}
        Path(args.json).write_text(json.dumps(report, indent=2) + "\n")


def check_writable(path):
    """Raises OSError if a file cannot be written there; leaves no trace."""
    existed = Path(path).exists()
    with open(path, "a"):
        pass
    if not existed:
        Path(path).unlink()


def draw_map(axis, terrain):
    """Draws a terrain from above: heights, starts, goals (green), a world's way, people's ways."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    length, width = np.array(terrain.heights.shape) * terrain.cell
    x, y = np.arange(0.025, length, 0.05), np.arange(0.025 - width / 2, width / 2, 0.05)
    z = terrain.height(*np.meshgrid(x, y))
    span = dict(vmin=min(z.min(), -0.5), vmax=max(z.max(), 0.5))
    shaded = LightSource(315, 40).shade(z, colormaps["gist_earth"], blend_mode="soft", **span)
    axis.imshow(shaded, origin="lower", extent=(0, length, -width / 2, width / 2))
    for person in terrain.people:
        axis.plot(*person.path.T, color="tab:orange", lw=1)
    if len(terrain.starts) == 1:
        nav = Navigation(terrain.heights, terrain.cell, terrain.climb)
        # From the goal back, as find_routes looks: diagonals count at other steps the other way.
        ends = (nav.cell(*place[0, :2]) for place in (terrain.goals, terrain.starts))
        axis.plot(*nav.way(*ends).T, "w:", lw=1.5)
    axis.plot(*terrain.starts[:, :2].T, "wo", ms=5, mec="k")
    axis.plot(*terrain.goals[:, :2].T, "o", color="tab:green", ms=5, mec="k")
    axis.set(xticks=[], yticks=[])


def play(args):
    """`play`: one episode in PyBullet's window, or as a GIF."""
    load_actor(args.policy)  # what is wrong is named before the work
    place = open_scan(args) if args.scan else args.world
    options = {"gui": True} if args.gui else {"render_mode": "rgb_array"}
    if not args.gui:
        from PIL import Image

        check_writable(args.gif)
    frames, steps = [], enumerate(episode(args.policy, place, args.seed, **options))
    with tqdm(total=EVAL_SECONDS, unit="s", bar_format="{l_bar}{bar}|{n:.0f}/{total} s") as bar:
        for k, (env, info) in steps:  # noqa: B007
            if args.gui:
                env.simulation.bullet.resetDebugVisualizerCamera(
                    2.4, math.degrees(env.robot.yaw) - 90, -40, env.robot.position)
                time.sleep(DT * HOLD)
            elif k % GIF_EVERY == 0:
                frames.append(env.render())
            bar.update(min(env.seconds, EVAL_SECONDS) - bar.n)
    end = "reached the goal" if info["success"] else "fell" if info["fall"] else "ran out of time"
    print(f"{info['task']}: t_cr {info['t_cr']:.2f}, {end} after {env.seconds:.1f} s")
    if not args.gui:
        some = frames[:: -(len(frames) // 8 + 1)]  # the last one among them: it shows the goal
        palette = Image.fromarray(np.concatenate(some)).quantize(200)
        pictures = [Image.fromarray(frame).quantize(palette=palette, dither=0) for frame in frames]
        pictures[0].save(args.gif, save_all=True, append_images=pictures[1:], loop=0,
                         duration=round(1000 * GIF_EVERY * HOLD * DT))
        print(args.gif)


def gallery(args):
    """`gallery`: every training task and every unseen world from above, in one picture."""
    from matplotlib.figure import Figure

    check_writable(args.out)
    names = [*PILLAR_TASKS, *WORLDS]
    figure, rows = Figure(figsize=(13, 12), layout="constrained"), math.ceil(len(names) / 5)
    for k, name in enumerate(tqdm(names, unit="terrain")):
        axis = figure.add_subplot(rows, 5, k + 1)
        rng, unseen = np.random.default_rng(args.seed), name in WORLDS
        draw_map(axis, make_world(name, args.seed) if unseen else make_terrain(name, rng, 0.8))
        axis.set_title(name, color="tab:red" if unseen else "k", fontsize=13)
    figure.savefig(args.out, dpi=75)
    print(args.out)


# ------------------------------------------------------------------------------- command line


def _names(valid, what, text):
    names = text.split(",")
    for name in names:
        if name not in valid:
            raise argparse.ArgumentTypeError(f"unknown {what} {name!r}; valid: {', '.join(valid)}")
    return names


def _whole(least, text):
    number = int(text) if text.isascii() and text.isdigit() else -1
    if not least <= number < 2**53:
        raise argparse.ArgumentTypeError(
            f"must be a whole number from {least} to {2**53 - 1}, got {text!r}")
    return number


def _file(suffix, text):
    if not text.endswith(suffix):
        raise argparse.ArgumentTypeError(f"must end in {suffix}, got {text!r}")
    return text


def parse(argv):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser = argparse.ArgumentParser("loco_mtrl.py", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command")
    places = partial(_names, [*WORLDS, *PILLAR_TASKS], "world")
    natural, positive = partial(_whole, 0), partial(_whole, 1)
    ranks = dict(type=positive, default=cores, help="processes; default: every core")

    p = commands.add_parser("train", help="train a policy")
    p.add_argument("--steps", type=positive, default=PPOConfig.total_timesteps,
                   help="decisions of the policy, in all (default %(default)s)")
    p.add_argument("--tasks", type=partial(_names, PILLAR_TASKS, "task"), metavar="TASKS",
                   default=list(PILLAR_TASKS), help=f"default: all of {', '.join(PILLAR_TASKS)}")
    p.add_argument("--no-tg", dest="tg", action="store_false", help="reactive policy")
    p.add_argument("--no-lidar", dest="lidar", action="store_false", help="blind policy")
    p.add_argument("--sequential", action="store_true", help="one task after the other, not mixed")
    p.add_argument("--seed", type=natural, default=0)
    p.add_argument("--run-dir", default="runs/main", help="(default %(default)s)")
    p.add_argument("--resume", action="store_true", help="go on from the run's checkpoint")
    p.add_argument("--tensorboard", action="store_true", help="log for TensorBoard, too")
    p.add_argument("--ranks", **ranks)
    p.set_defaults(run=train)

    scan = argparse.ArgumentParser(add_help=False)
    scan.add_argument("--scan", metavar="FILE", help="a scanned building instead")
    scan.add_argument("--scale", type=float, default=1.0, help="of the scan, metres a unit")
    scan.add_argument("--up", choices=("z", "y"), default="z", help="axis of the scan that is up")

    p = commands.add_parser("eval", parents=[scan], help="score policies in unseen worlds")
    p.add_argument("policies", nargs="+", metavar="POLICY",
                   help=f"a .pt file, or a reference: {', '.join(REFERENCES)}")
    p.add_argument("--worlds", type=places, default=list(WORLDS), metavar="WORLDS",
                   help="comma-separated worlds, or training tasks on held-out seeds")
    p.add_argument("--episodes", type=positive, default=20, help="per world (default %(default)s)")
    p.add_argument("--json", metavar="FILE", help="write the scores there, too")
    p.add_argument("--ranks", **ranks)
    p.set_defaults(run=eval_command)

    p = commands.add_parser("play", parents=[scan], help="watch a policy for one episode")
    p.add_argument("policy", metavar="POLICY", help="as in eval")
    p.add_argument("--world", choices=[*WORLDS, *PILLAR_TASKS], metavar="WORLD", default="maze",
                   help="a world or a training task (default %(default)s)")
    p.add_argument("--seed", type=natural, default=EVAL_SEED, help="layout (default %(default)s)")
    p.add_argument("--gif", type=partial(_file, ".gif"), metavar="FILE.gif",
                   default="play.gif", help="(default %(default)s)")
    p.add_argument("--gui", action="store_true", help="PyBullet's window instead of a GIF")
    p.set_defaults(run=play)

    p = commands.add_parser("gallery", help="draw all terrains in one picture")
    p.add_argument("--out", type=partial(_file, ".png"), metavar="FILE.png",
                   default="gallery.png", help="(default %(default)s)")
    p.add_argument("--seed", type=natural, default=0)
    p.set_defaults(run=gallery)

    args = parser.parse_args(argv or ["train"])
    args.argv = argv
    return args


def main(argv=None):
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv)
    try:
        code = args.run(args) or 0
        if not argv and not code and "RANK" not in os.environ:  # the main job: train, then score
            eval_command(parse(["eval", str(Path(args.run_dir) / "policy.pt")]))
        return code
    except (ValueError, OSError, ImportError, ArithmeticError, RuntimeError) as error:
        print(f"loco_mtrl.py: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("\nStopped.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
