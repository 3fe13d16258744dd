"""LocoMTRL: a Laikago learns to walk over many terrains with its own LiDAR eyes.

The environment (`LocoEnv`, PyBullet) and what one does with it: train, eval, play, gallery.
A small, complete implementation of "Learning Visual-Locomotion Policies that Generalize to
Diverse Environments"; the sections named below are the paper's.
"""

import argparse
import cmath
import contextlib
import json
import logging
import math
import multiprocessing
import operator
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from functools import partial
from numbers import Real
from pathlib import Path

import gymnasium
import numpy as np
import torch
from tqdm import tqdm

from ppo import PPOConfig, learn, load_checkpoint, load_policy, write_whole
from terrain import (
    PERSON_HEIGHT,
    PERSON_RADIUS,
    PILLAR_TASKS,
    WORLDS,
    Chart,
    Terrain,
    load_mesh,
    make_terrain,
    make_world,
)
from tg import CENTRE, LEGS, RANGE, STANDING, TrajectoryGenerator


@contextlib.contextmanager
def _quiet():
    """PyBullet prints banners from C; they have no place in progress bars and JSON."""
    sys.stdout.flush()
    saved, sink = [os.dup(1), os.dup(2)], os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 1), os.dup2(sink, 2)
    try:
        yield
    finally:
        os.dup2(saved[0], 1), os.dup2(saved[1], 2)
        for file in (*saved, sink):
            os.close(file)


with _quiet():
    import pybullet
    import pybullet_data
    from pybullet_utils.bullet_client import BulletClient

# ------------------------------------------------------------------------------- the robot

LAIKAGO = Path(pybullet_data.getDataPath()) / "laikago" / "laikago_toes_zup.urdf"
JOINTS = ("hip_motor_2_chassis_joint", "upper_leg_2_hip_motor_joint", "lower_leg_2_upper_leg_joint")


def robot_urdf(visual):
    """The Laikago's URDF as text, made cheap to simulate.

    Collision shapes become primitives: Bullet would spend most of a step between the original
    convex hulls and the terrain's triangles. Pictures are kept only if `visual`; they cost 0.3 s
    and 170 MB a robot.
    """
    tree = ET.parse(LAIKAGO)
    for mesh in tree.iter("mesh"):
        mesh.set("filename", str(LAIKAGO.parent / mesh.get("filename")))
    for link in tree.iter("link"):
        name, collision = link.get("name"), link.find("collision")
        for part in link.findall("visual"):
            if not visual:
                link.remove(part)
        for contact in link.findall("contact"):
            contact.clear()  # drops spinning friction and the toes' friction anchors
            ET.SubElement(contact, "lateral_friction", value="1")
        if name == "chassis":
            _replace(collision, (-0.0125, 0, -0.016), (0, 0, 1), "box", size="0.577 0.28 0.188")
            for lens in (LIDAR_FRONT, LIDAR_REAR):
                housing = ET.SubElement(link, "collision")
                _replace(housing, lens, (0, 0, 1), "sphere", radius=str(HOUSING))
        elif name.endswith("hip_motor"):
            link.remove(collision)  # inside the chassis box, but for a centimetre
        elif name.endswith("upper_leg"):
            _capsule(collision, (0, -0.20833, -0.1422), 0.03)
        elif name.endswith("lower_leg"):
            _capsule(collision, (0, -0.225, -0.0198), 0.015)  # ends inside the toe's sphere
    return ET.tostring(tree.getroot(), encoding="unicode")


def _replace(collision, centre, axis, shape, **size):
    """A primitive at `centre` whose own z axis points along `axis`."""
    pitch = math.atan2(math.hypot(axis[0], axis[1]), axis[2])
    rpy = f"0 {pitch} {math.atan2(axis[1], axis[0])}"
    collision.clear()
    ET.SubElement(collision, "origin", xyz="{} {} {}".format(*centre), rpy=rpy)
    ET.SubElement(ET.SubElement(collision, "geometry"), shape, **size)


def _capsule(collision, end, radius):
    """A capsule from the link's joint to `end`."""
    size = {"radius": str(radius), "length": str(math.hypot(*end))}
    _replace(collision, [c / 2 for c in end], end, "capsule", **size)


# ------------------------------------------------------------------------------- the senses

LIDAR_RANGE = 5.0  # m
LIDAR_EVERY = 2  # control steps from one scan to the next: it turns at 15 Hz, as real ones do
LIDAR_FRONT, LIDAR_REAR = (0.36, 0.0, 0.08), (-0.38, 0.0, 0.08)  # m, of the two sensors
HOUSING = 0.04  # m, radius of the ball around each: without it, a lens would enter whatever thin
# thing the robot runs into, and see nothing of it any more
# Degrees. Steep rays see the ground that the front feet are about to meet, level ones see walls.
LIDAR_ELEVATIONS = (-84, -70, -57, -45, -34, -25, -17, -10, -3, 8)
# The columns on the left, from ahead to behind, densest ahead, then the first of the right side.
# Each row is turned outwards by 0, 1 or 2 thirds of the way to the next column: together, three
# rows see poles that would slip through one.
_COLUMNS = (4, 12, 21, 31, 42, 54, 68, 84, 105, 130, 155, 175, 185)
_LEFT = [np.interp(np.arange(12) + row % 3 / 3, np.arange(13), _COLUMNS)
         for row in range(len(LIDAR_ELEVATIONS))]
LIDAR_AZIMUTHS = np.array([[*left[::-1], *-left] for left in _LEFT])  # degrees, (rows, columns)
N_RAYS = LIDAR_AZIMUTHS.size
HIT_FRACTION = operator.itemgetter(2)  # of the range, in what rayTestBatch gives for a ray


def lidar_rays():
    """Where the rays start (m) and their unit vectors, (N_RAYS, 3) each in the base frame.

    Row by row from the lowest, left to right. They start ahead of the chassis or, those that look
    back, behind it: nearer by 5 cm they would cost a quarter more, for many would cross a leg.
    """
    up, left = np.radians(LIDAR_ELEVATIONS)[:, None], np.radians(LIDAR_AZIMUTHS)
    up, left = (angle.ravel() for angle in np.broadcast_arrays(up, left))
    directions = np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], 1)
    return np.where(directions[:, :1] > 0, LIDAR_FRONT, LIDAR_REAR), directions


# ------------------------------------------------------------------------------- the environment

SUBSTEPS, DT = 5, 1 / 30  # physics steps in a control step, and its length in s
GRAVITY = 9.81  # m/s2
MAX_TORQUE = 40.0  # Nm
# Bullet's implicit PD, per physics step. Compliant on purpose: of 1,500 random gaits on rugged
# ground those with a position gain of 0.25 stayed up a third as long.
POSITION_GAIN, VELOCITY_GAIN = 0.10, 1.0
# Share of a new action that takes effect at once, for the generator's parameters and the joints:
# more would be jitter, less could not react.
SMOOTHING = [0.2] * TrajectoryGenerator.action_size + [0.5] * 12
RESIDUAL = {True: 0.1, False: 0.6}  # rad, largest u_fb with the TG, and without
GOAL_RADIUS = 0.5  # m, r_g
BASE_HEIGHT = 0.30  # m, of the walking base: a goal floats that high over the ground
EXPLODED = 1e3  # m or rad/s
# A person who meets more resistance steps back. A body that is moved regardless pushes with any
# force: with 70 kN people have pressed the robot through walls.
PUSH = 200.0  # N
FALL_UP, FALL_SPEED = 0.5, 2.5  # fallen: tipped by over 60 degrees, or dropping faster (m/s)
MAX_EPISODE_STEPS = 900  # 30 s
PICTURE = (400, 300)  # pixels
HOT = ("setJointMotorControlArray", "stepSimulation", "getBasePositionAndOrientation",
       "getBaseVelocity", "getMatrixFromQuaternion", "getJointStates", "rayTestBatch")
STATIC_GROUP = 2  # Bullet's collision group of all that does not move by itself: rays see only it


def _about_z(yaw):
    """Quaternion of a turn by `yaw` (rad) about the z axis."""
    return 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)


class LocoEnv(gymnasium.Env):
    """A Laikago walks to a goal over terrain that only its LiDAR shows it (section 2).

    ## Observation: Box((282,), float32), in the order of section 2.1
    | entries | meaning | unit |
    |---|---|---|
    | 240 | r, LiDAR scan: sqrt(distance / 5 m), 1: no hit; rows from low to high, left to right | |
    | 1 | g_d, distance to the goal | m |
    | 1 | g_h, heading of the goal relative to the robot's, left positive | rad |
    | 3 | angular rates of the base in its own frame (IMU) | rad/s |
    | 12 | q, joint angles: FR, FL, RR, RL x abduction, hip, knee | rad |
    | 12 | a_{t-1}, joint targets commanded in the previous step | rad |
    | 13 | s_tg, state of the trajectory generator; none with tg=False | |
    The scan is taken at 15 Hz, all else at 30 Hz; with lidar=False there is none. `Map` adds to it.

    ## Action: Box(-1, 1, (17,), float32), clipped to that range, then smoothed
    5 parameters of the trajectory generator (`tg.PARAMETERS`), then the 12 residuals u_fb;
    u_tg + u_fb are joint targets, which PD controllers with limited torque track (section 2.2).
    With tg=False (reactive), 12 offsets from the standing pose.

    ## Reward
    (d_{t-1} - d_t) / dt, the velocity toward the goal, m/s. The paper prints the opposite sign but
    calls it the velocity toward the target.

    ## Episode
    It terminates at the goal (base within 0.5 m) and in a fall (base tipped by over 60 degrees or
    dropping faster than 2.5 m/s: both break a real robot). The time limit is the wrapper's.

    `info` holds task, t_cr = 1 - d_T / d_0 in [0, 1] (1 at the goal), success, fall, collisions:
    how often the robot has bumped into a person, and exploded: that the simulation broke down,
    which ends the episode as a fall with an observation of zeros.

    Args:
        tasks: a task's name, a function (rng, difficulty) -> heights, a finished Terrain, or a list
            of these; None: all pillar tasks. The policy is not told which.
        difficulty: in [0, 1], or (low, high) to draw it from, once for each terrain.
        tg, lidar: the paper's ablations (section 3) leave one of them out.
        terrains: how many terrains of each task to build; Bullet never frees a mesh, so the pool
            is built once. An episode takes the one that has had least time so far, and chance
            decides between equals. A finished Terrain counts once.
        pool_seed: seeds the pool; `reset(seed=...)` seeds all else.
        render_mode: None or "rgb_array".
        gui: open PyBullet's window; it allows one in a process.

    Raises ValueError for any argument out of range, naming it and what is valid.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / DT)}

    def __init__(self, tasks=None, difficulty=(0.0, 1.0), tg=True, lidar=True, terrains=1,
                 pool_seed=0, render_mode=None, gui=False):
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        low, high = difficulty if np.size(difficulty) == 2 else (difficulty, difficulty)
        if not all(isinstance(d, Real) for d in (low, high)) or not 0 <= low <= high <= 1:
            raise ValueError(f"difficulty must be in [0, 1] or (low, high), got {difficulty}")
        if not isinstance(terrains, int) or terrains < 1:
            raise ValueError(f"terrains must be a whole number of at least 1, got {terrains!r}")
        self.render_mode, self.show_lidar, self.lidar = render_mode, False, lidar
        tasks = list(PILLAR_TASKS) if tasks is None else tasks
        tasks = tasks if isinstance(tasks, (list, tuple)) else [tasks]
        if not tasks:
            raise ValueError(f"tasks must hold at least one task; valid: {', '.join(PILLAR_TASKS)}")
        rng = np.random.default_rng(pool_seed)
        self.pool = [make_terrain(task, rng, rng.uniform(low, high)) for task in tasks
                     for _ in range(1 if isinstance(task, Terrain) else terrains)]
        self.generator = TrajectoryGenerator() if tg else None
        self._connect(gui)
        rows, columns = LIDAR_AZIMUTHS.shape
        self.scan_shape = rows * lidar, columns
        n_scan = math.prod(self.scan_shape)
        self.scan = np.zeros(n_scan, np.float32)
        # Generous bounds: what lies beyond them is no longer a robot, and the episode ends.
        high = [1e3, np.pi] + [1e3] * 3 + [1e2] * 24
        high += [1.0] * TrajectoryGenerator.state_size * tg
        low = np.concatenate([np.zeros(n_scan + 1), np.negative(high[1:])])
        high = np.concatenate([np.ones(n_scan), high])
        self.observation_space = gymnasium.spaces.Box(*np.float32([low, high]))
        n_act = 12 + TrajectoryGenerator.action_size * tg
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (n_act,))
        self.smoothing, self.residual = SMOOTHING[-n_act:], RESIDUAL[tg]
        self.spent = np.zeros(len(self.pool))  # seconds in each terrain, those of failures cheap
        self.time = 0.0

    def _connect(self, gui):
        self.visual = visual = gui or self.render_mode is not None
        with _quiet():
            mode = pybullet.GUI if gui else pybullet.DIRECT
            self.bullet = p = BulletClient(connection_mode=mode)
            p.configureDebugVisualizer(p.COV_ENABLE_GUI, 0)
        for name in HOT:  # BulletClient looks a function up anew for each call, which costs 3 us
            setattr(p, name, getattr(p, name))
        p.setGravity(0, 0, -GRAVITY)
        p.setPhysicsEngineParameter(fixedTimeStep=DT, numSubSteps=SUBSTEPS, numSolverIterations=20,
                                    enableConeFriction=0, deterministicOverlappingPairs=1)
        # Side by side, farther apart than the LiDAR reaches: a reset only moves the robot.
        self.offsets, edge = [], 0.0
        for terrain in self.pool:
            low, high = terrain.vertices[:, 0].min(), terrain.vertices[:, 0].max()
            self.offsets.append(edge - low)
            edge += high - low + 2 * LIDAR_RANGE
            self._add_mesh(terrain, self.offsets[-1], visual)
        self._load_robot()
        self.people, body = [], dict(shapeType=p.GEOM_CYLINDER, radius=PERSON_RADIUS)
        for _ in range(max(len(terrain.people) for terrain in self.pool)):
            shape = p.createCollisionShape(height=PERSON_HEIGHT, **body)
            looks = p.createVisualShape(length=PERSON_HEIGHT, rgbaColor=(0.9, 0.5, 0.2, 1),
                                        **body) if visual else -1
            self.people.append(p.createMultiBody(0, shape, looks))
        sources, directions = lidar_rays()
        if visual:
            sphere = p.createVisualShape(p.GEOM_SPHERE, radius=0.2, rgbaColor=(0.2, 0.8, 0.3, 1))
            self.flag = p.createMultiBody(0, -1, sphere)
        self._rays = sources.tolist(), (sources + LIDAR_RANGE * directions).tolist()
        self._gains = dict(positionGains=[POSITION_GAIN] * 12, velocityGains=[VELOCITY_GAIN] * 12,
                           forces=[MAX_TORQUE] * 12)
        for _ in range(3):  # Bullet files what stands still elsewhere after two steps: it would
            p.stepSimulation()  # change the last bits in the midst of the first episode

    def _load_robot(self):
        p = self.bullet
        with tempfile.TemporaryDirectory() as folder:
            urdf = Path(folder) / "laikago.urdf"
            urdf.write_text(robot_urdf(self.visual))
            self.robot = p.loadURDF(str(urdf), [0, 0, 1000])
        joints = [p.getJointInfo(self.robot, j) for j in range(p.getNumJoints(self.robot))]
        ids = {joint[1].decode(): joint[0] for joint in joints}
        self.joints = [ids[f"{leg}_{joint}"] for leg in LEGS for joint in JOINTS]

    def _add_mesh(self, terrain, offset, visual):
        p = self.bullet
        mesh = dict(vertices=terrain.vertices.tolist(), indices=terrain.triangles.ravel().tolist())
        shape = p.createCollisionShape(p.GEOM_MESH, flags=p.GEOM_FORCE_CONCAVE_TRIMESH, **mesh)
        body = p.createMultiBody(0, shape, basePosition=(offset, 0, 0))
        p.changeDynamics(body, -1, lateralFriction=1.0)
        if not visual:
            return
        # Ground and walls in colours of their own: shading alone does not tell them apart.
        a, b, c = (terrain.vertices[terrain.triangles[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        steep = np.abs(normal[:, 2]) < 0.5 * np.linalg.norm(normal, axis=1)
        for part, colour in ((~steep, (0.75, 0.78, 0.66, 1)), (steep, (0.6, 0.47, 0.4, 1))):
            if part.any():
                mesh["indices"] = terrain.triangles[part].ravel().tolist()
                looks = p.createVisualShape(p.GEOM_MESH, rgbaColor=colour, **mesh)
                p.createMultiBody(0, -1, looks, basePosition=(offset, 0, 0))

    # ---------------------------------------------------------------- one episode

    def reset(self, *, seed=None, options=None):
        """Stands the robot at a start; `options={"terrain": i, "route": k}` chooses which.

        Raises ValueError for another option, or one that the pool has not.
        """
        super().reset(seed=seed)
        p, rng, options = self.bullet, self.np_random, options or {}
        # The terrain that has had least so far comes next. Seconds are shared, not episodes, or
        # those that end in an early fall, and need it most, would get the least experience; and
        # where the robot still fails it trains up to six times as long as where it arrives.
        if self.time:
            progress = self._info(self.distance < GOAL_RADIUS, False)["t_cr"]
            self.spent[self.index] += self.time / (1.2 - progress)
        if seed is not None:  # Bullet's contact caches would remember the episodes before
            p.removeBody(self.robot)
            self._load_robot()
            self.spent[:] = 0
        least = np.flatnonzero(self.spent == self.spent.min())
        index = options.get("terrain", rng.choice(least))
        if not set(options) <= {"terrain", "route"} or index not in range(len(self.pool)):
            known = f"terrain, in range({len(self.pool)}), and route"
            raise ValueError(f"options may be {known}, got {options}")
        self.index, self.terrain = int(index), self.pool[int(index)]
        terrain = self.terrain
        route = options.get("route", rng.integers(len(terrain.starts)))
        if route not in range(len(terrain.starts)):
            raise ValueError(f"route must be in range({len(terrain.starts)}), got {route!r}")
        self.route = route = int(route)
        self.origin = np.array([self.offsets[self.index], 0.0, 0.0])
        x, y, z, yaw = terrain.starts[route]
        self.goal = (terrain.goals[route] + self.origin + [0, 0, BASE_HEIGHT]).tolist()
        yaw += rng.uniform(-0.5, 0.5)

        self.target = STANDING.tolist()
        if self.generator:
            self.generator.reset(rng.uniform(0, 2 * np.pi))
            self.target = self.generator.step([0.0] * self.generator.action_size, 0.0).tolist()
        self.action = [0.0] * len(self.smoothing)
        position = self.origin + [x, y, z + BASE_HEIGHT + 0.02]
        p.resetBasePositionAndOrientation(self.robot, position, _about_z(yaw))
        p.resetBaseVelocity(self.robot, [0, 0, 0], [0, 0, 0])
        for joint, angle in zip(self.joints, self.target, strict=True):
            p.resetJointState(self.robot, joint, angle)
        self.time, self.steps, self.collisions = 0.0, 0, 0
        self.touching = self.exploded = False
        self.walked = np.zeros(len(self.people))  # seconds that each of them has been walking
        for body in self.people:  # not all terrains have as many
            p.resetBasePositionAndOrientation(body, (0, 0, -1000), (0, 0, 0, 1))
        self._move_people()
        observation = self._observe()
        self.start_distance = self.distance
        if self.visual:
            p.resetBasePositionAndOrientation(self.flag, self.goal, (0, 0, 0, 1))
            dx, dy, _ = np.subtract(self.goal, self.position)
            self.view_yaw = math.degrees(math.atan2(dy, dx)) - 90
        return observation, self._info(False, False)

    def step(self, action):
        p = self.bullet
        action = np.asarray(action, dtype=np.float64)
        if action.shape != self.action_space.shape or not math.isfinite(sum(action.tolist())):
            raise ValueError(f"action must be {len(self.action)} finite numbers, got {action}")
        # Plain floats: NumPy is slow on so few numbers.
        pairs = zip(self.action, action.tolist(), self.smoothing, strict=True)
        self.action = [old + k * (min(max(new, -1.0), 1.0) - old) for old, new, k in pairs]
        u_tg = self.generator.step(self.action[:-12], DT) if self.generator else STANDING
        pairs = zip(u_tg.tolist(), self.action[-12:], strict=True)
        self.target = [u + self.residual * a for u, a in pairs]  # u_tg + u_fb
        p.setJointMotorControlArray(self.robot, self.joints, p.POSITION_CONTROL,
                                    self.target, **self._gains)
        p.stepSimulation()
        self.time += DT
        if self.people:
            contacts = [p.getContactPoints(self.robot, body) for body in self.people]
            before, self.touching = self.touching, any(contacts)
            self.collisions += self.touching and not before
            for k, points in enumerate(contacts):
                self.walked[k] += DT if sum(point[9] for point in points) < PUSH else -DT
            self._move_people()

        self.steps += 1
        distance = self.distance
        observation = self._observe(self.steps % LIDAR_EVERY == 0)
        if not math.hypot(self.distance, *self.rates) < EXPLODED:  # not: NaN compares to nothing
            p.removeBody(self.robot)
            self._load_robot()
            self.distance, self.exploded = distance, True
            return np.zeros_like(observation), 0.0, True, False, self._info(False, True)
        success = self.distance < GOAL_RADIUS
        fall = self.up < FALL_UP or self.velocity[2] < -FALL_SPEED
        reward = (distance - self.distance) / DT
        return observation, reward, success or fall, False, self._info(success, fall)

    def _info(self, success, fall):
        progress = 1.0 if success else 1.0 - self.distance / self.start_distance
        return {"task": self.terrain.name, "t_cr": max(0.0, progress), "success": success,
                "fall": fall and not success, "collisions": self.collisions,
                "exploded": self.exploded}

    def _move_people(self):
        for body, person, t in zip(self.people, self.terrain.people, self.walked, strict=False):
            x, y, yaw = person.position(t)
            place = x + self.origin[0], y, self.terrain.height(x, y) + PERSON_HEIGHT / 2
            self.bullet.resetBasePositionAndOrientation(body, place, _about_z(yaw))

    def _observe(self, turn_lidar=True):
        p = self.bullet
        position, quaternion = p.getBasePositionAndOrientation(self.robot)
        self.velocity, self.rates = p.getBaseVelocity(self.robot)
        r = p.getMatrixFromQuaternion(quaternion)
        self.position, self.rotation, self.up = position, r, r[8]
        self.distance = math.dist(self.goal, position)
        self.yaw = math.atan2(r[3], r[0])
        heading = math.atan2(self.goal[1] - position[1], self.goal[0] - position[0]) - self.yaw
        state = [self.distance, (heading + math.pi) % (2 * math.pi) - math.pi]
        wx, wy, wz = self.rates
        state += [r[i] * wx + r[3 + i] * wy + r[6 + i] * wz for i in range(3)]
        state += [joint[0] for joint in p.getJointStates(self.robot, self.joints)]
        state += self.target
        if self.generator:
            state += self.generator.state()
        observation = np.empty(self.scan.size + len(state), np.float32)
        observation[self.scan.size :] = state
        if turn_lidar and self.lidar and math.isfinite(self.distance):
            self.hits = p.rayTestBatch(*self._rays, parentObjectUniqueId=self.robot,
                                       parentLinkIndex=-1, collisionFilterMask=STATIC_GROUP)
            self.fractions = np.fromiter(map(HIT_FRACTION, self.hits), np.float32, N_RAYS)
            # The root: as fine as a scan of 3 m is near by, and yet it looks across a room.
            self.scan = np.sqrt(self.fractions)
        observation[: self.scan.size] = self.scan
        return observation

    def render(self):
        """The robot from above and behind, as uint8 (300, 400, 3).

        Raises ValueError if the environment was made without render_mode.
        """
        if not self.visual:
            raise ValueError("render() needs render_mode='rgb_array'")
        p, (width, height) = self.bullet, PICTURE
        view = p.computeViewMatrixFromYawPitchRoll(self.position, 2.4, self.view_yaw, -52, 0, 2)
        projection = p.computeProjectionMatrixFOV(55, width / height, 0.1, 40)
        rgba = p.getCameraImage(width, height, view, projection, lightDirection=(2, 3, 8),
                                renderer=p.ER_TINY_RENDERER)[2]
        picture = np.reshape(rgba, (height, width, 4))[..., :3].astype(np.uint8)
        if self.show_lidar and self.lidar:
            points = np.reshape([(*hit[3], 1.0) for hit in self.hits if hit[2] < 1], (-1, 4))
            matrices = [np.reshape(m, (4, 4)) for m in (view, projection)]  # both transposed
            x, y, _, w = (points @ matrices[0] @ matrices[1]).T
            columns, rows = (1 + x / w) / 2 * width, (1 - y / w) / 2 * height
            for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
                i, j = (rows + dy).astype(int), (columns + dx).astype(int)
                seen = (w > 0) & (i >= 0) & (i < height) & (j >= 0) & (j < width)
                picture[i[seen], j[seen]] = (220, 30, 30)
        return picture

    def close(self):
        if self.bullet is not None:
            with _quiet():  # the window says goodbye at length
                self.bullet.disconnect()
            self.bullet = None


if "LocoMTRL-v0" not in gymnasium.registry:  # run as a script, this file is imported once more
    gymnasium.register("LocoMTRL-v0", "loco_mtrl:LocoEnv", max_episode_steps=MAX_EPISODE_STEPS)


# ------------------------------------------------------------------------------- ours: map, guide

# What the paper has not: a guide in training (`Guide`), and a map among what the robot observes.
OURS = ("guide", "map")
CHART_RADII = 0.6, 1.5, 2.7, 4.5  # m: how far along a way its effort is observed
CHART_EVERY = 10  # control steps from one drawing of the map to the next
_LINES = np.radians(LIDAR_AZIMUTHS[0])  # the ways: one along each of the scan's columns
_PACES = np.arange(0.3, 4.6, 0.3)  # m, the places on a line
_PLACES, _TURN = _PACES[:, None] * np.exp(1j * _LINES), 0.3 * np.abs(_LINES) / np.pi
_CHARTED = np.isin(np.round(_PACES, 1), CHART_RADII)
LOG_WALL = math.log1p(225)  # all the way in a wall: what is observed are logarithms, in [0, 1]


def weigh_ways(chart, x, y, yaw):
    """What it would take, by the map, to go straight along each of the scan's columns from x, y.

    Returns, in metres of open ground, the effort of going as far as each of _PACES (15, 24); and
    the least that going by each column costs in all (24,): the effort to some place on it, from
    0.6 m on, what is left from there to the goal, and up to 0.3 m for the turn.
    """
    places = complex(x, y) + cmath.rect(1.0, yaw) * _PLACES
    x, y = places.real, places.imag
    way = 0.3 * chart.effort(x, y).cumsum(0)
    whole = (way + chart.to_go(x, y))[1:].min(0)  # nearer, all columns would look alike
    return way, whole + _TURN


class Map(gymnasium.Wrapper):
    """A robot that draws a map from its LiDAR's hits as it goes, `terrain.Chart`: ours.

    ## Observation: Box((402,), float32): LocoEnv's, and after its scan
    | entries | meaning | unit |
    |---|---|---|
    | 96 | effort of going 0.6, 1.5, 2.7, 4.5 m along each of the scan's columns | * |
    | 24 | what going each column's way costs in all, less the cheapest: `weigh_ways` | * |
    *: log(1 + metres of open ground) / log(226), in [0, 1]. Taken with each scan, at 15 Hz; the map
    is drawn anew every CHART_EVERY control steps.

    observed: False: the map is drawn, for a guide, but the observation remains LocoEnv's.
    Raises ValueError if the robot is blind.
    """

    def __init__(self, env, observed=True):
        super().__init__(env)
        self.robot, self.observed = env.unwrapped, observed
        if not self.robot.lidar:
            raise ValueError("a Map needs what the LiDAR sees: lidar must be True, got False")
        (rows, columns), space = self.robot.scan_shape, env.observation_space
        self.n_scan, n_map = rows * columns, (len(CHART_RADII) + 1) * columns * observed
        self.scan_shape = rows + n_map // columns, columns
        low, high = (np.insert(bound, self.n_scan, np.full(n_map, limit))
                     for bound, limit in ((space.low, 0), (space.high, 1)))
        self.observation_space = gymnasium.spaces.Box(low, high)
        self.eyes, directions = lidar_rays()
        self.reach = LIDAR_RANGE * directions

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        self.chart = Chart(*self.robot.position[:2], self.robot.goal)
        self.scans = []  # seen, not on the chart yet
        return self._look(observation), info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return self._look(observation), *rest

    def _look(self, observation):
        """Draws what the LiDAR has just seen and weighs the ways: the observation with them."""
        robot, (x, y, z) = self.robot, self.robot.position
        if robot.exploded:
            self.seen = np.zeros_like(self.seen)
        elif robot.steps % LIDAR_EVERY == 0:
            self.scans.append((robot.fractions, robot.rotation, robot.position))
            if robot.steps % CHART_EVERY == 0:
                fractions, turns, places = map(np.array, zip(*self.scans, strict=True))
                turns = turns.reshape(-1, 3, 3).transpose(0, 2, 1)
                eyes = self.eyes @ turns + places[:, None]
                hits = eyes + fractions[..., None] * (self.reach @ turns)
                self.chart.see(eyes.reshape(-1, 3), hits.reshape(-1, 3), fractions.ravel() < 1,
                               z - BASE_HEIGHT)
                self.chart.draw(x, y, z - BASE_HEIGHT)
                self.scans.clear()
            way, self.whole = weigh_ways(self.chart, x, y, robot.yaw)
            costs = np.append(way[_CHARTED], self.whole - self.whole.min())
            self.seen = np.float32(np.log1p(costs) / LOG_WALL)
        if not self.observed:
            return observation
        scan, rest = observation[: self.n_scan], observation[self.n_scan :]
        return np.concatenate([scan, self.seen, rest])


PACE = 0.21  # m, the guide's stride where his way is straight
ASIDE = 0.12  # m, at most, that his left and right strides are shorter and longer in a bend


def advise(env):
    """What a guide would do: take the cheapest of the ways that the robot's own `Map` shows.

    Without one he heads for the goal; on a slope he crouches. Returns an action (n_act,), NaN for
    all but two strides and the stance height.
    """
    robot = env.unwrapped
    advice = np.full(robot.action_space.shape, np.nan)
    if robot.exploded:
        return advice
    (x, y, _), (to_x, to_y, _) = robot.position, robot.goal
    turn = math.remainder(math.atan2(to_y - y, to_x - x) - robot.yaw, 2 * math.pi)
    if robot.distance > 0.7 and env.has_wrapper_attr("whole"):
        turn = _LINES[env.get_wrapper_attr("whole").argmin()]
    # The strides: slower in a bend, on the spot where the way lies to the side or behind.
    forward = PACE * max(0.0, math.cos(turn)) ** 2
    aside = ASIDE * min(max(1.2 * turn, -1.0), 1.0)
    strides = np.array([forward - aside, forward + aside])
    advice[1:3] = np.clip((strides - CENTRE[1:3]) / RANGE[1:3], -0.95, 0.95)
    tilt = math.acos(min(robot.up, 1.0))
    advice[4] = -min(max(5 * (tilt - 0.1), 0.0), 0.95)
    return advice


class Guide(gymnasium.Wrapper):
    """Tells a robot in training the way: info["guide"] is what `advise` says.

    He is no part of the policy, only of what it learns from: which way to go. The rest, NaN in his
    advice, it finds out for itself.
    """

    def reset(self, **kwargs):
        observation, info = self.env.reset(**kwargs)
        return observation, info | {"guide": advise(self)}

    def step(self, action):
        *rest, info = self.env.step(action)
        return *rest, info | {"guide": advise(self)}


def make_env(tasks, lidar=True, paper=(), guide=False, **options):
    """A robot as in training and scoring: LocoMTRL-v0 in a `Map`, in training with a `Guide`.

    paper: with "map" among them it does not observe one, and a blind robot has none.
    options: LocoEnv's.
    """
    env = gymnasium.make("LocoMTRL-v0", tasks=tasks, lidar=lidar, disable_env_checker=True,
                         **options)
    if lidar and (guide or "map" not in paper):
        env = Map(env, observed="map" not in paper)
    return Guide(env) if guide else env


def mirror(env):
    """The left-right symmetry: mirrored, o becomes o[i] * s and an action a becomes a[j] * t.

    Returns:
        (i, s, j, t): indices and signs over the observation, then over the action.
    """
    legs = np.arange(12).reshape(4, 3)[[1, 0, 3, 2]].ravel()  # joint angles mirror unsigned
    swap, tg = np.array([1, 0, 3, 2]), bool(env.unwrapped.generator)
    parameters = np.array([0, 2, 1, 3, 4])  # left and right stride change places
    shape = env.get_wrapper_attr("scan_shape")
    scan = np.arange(math.prod(shape)).reshape(shape)[:, ::-1].ravel()
    parts = [scan, np.arange(5), legs, legs] + [swap, swap, parameters] * tg
    actions = [parameters] * tg + [legs]
    signs = np.ones(env.observation_space.shape)
    signs[scan.size + np.array([1, 2, 4])] = -1  # heading, roll rate, yaw rate
    chain = [np.concatenate([p + sum(map(len, group[:k])) for k, p in enumerate(group)])
             for group in (parts, actions)]
    return chain[0], signs, chain[1], np.ones(env.action_space.shape)


# ------------------------------------------------------------------------------- train

REWARD_SCALE = 0.1  # keeps the critic's targets near 1
MAIN_STEPS = 240_000  # of the no-argument run
EASY_PART = 0.6  # of all steps: until it knows how to walk, difficulties are drawn from 0 on ...
HARD = (0.4, 1.0)  # ... and then from here
LAYOUTS = 10  # of an environment, at most: the more it sees, the less it learns by heart


def training_env(index, seed, tasks, stage=0, **options):
    """Environment number `index` over all ranks: one of the tasks, on layouts of its own.

    So all tasks have the same share of every batch, but for what does not divide evenly.
    """
    env = make_env(tasks[index % len(tasks)], terrains=min(len(tasks), LAYOUTS),
                   pool_seed=(seed, stage, index), **options)
    return gymnasium.wrappers.TransformReward(env, lambda reward: REWARD_SCALE * reward)


def plan(args):
    """The stages of a training: (tasks, difficulties, share of all steps done at its end, settings)

    With a guide the policy first does as he does, by large steps that no noise of rewards misleads.
    Then, and without a guide from the beginning, it learns by PPO. One task after the other
    (--sequential), it has no time but for the first.
    """
    # Short rollouts and large steps learn fastest at first; later the noise of so few samples holds
    # the policy back. A detour pays after many seconds: 200 steps, 1 / (1 - 0.995), are 6.7 s, and
    # later it is 17 s. At last there is little exploration noise: who is used to much of it is not
    # at his best without.
    first = dict(num_steps=256, gamma=0.995, update_epochs=2, learning_rate=5e-4, target_kl=0.05)
    last = first | dict(num_steps=512, gamma=0.998, target_kl=0.02, max_std=0.10)
    if args.tg and "guide" not in args.paper:
        # Advice has no noise that a trust region would have to guard against: a step size of 1e-3,
        # whatever the KL.
        rates = "learning_rate", "min_learning_rate", "max_learning_rate"
        first |= dict.fromkeys(rates, 1e-3) | dict(guide_share=1.0, target_kl=1e9, max_std=0.12)
        last |= dict(guide_share=0.5, min_learning_rate=1e-5, learning_rate=1e-4,
                     max_learning_rate=1e-4)
    if args.sequential:  # one task after the other (section 3), each for as long
        n = len(args.tasks)
        return [([task], (0, 1), (k + 1) / n, first) for k, task in enumerate(args.tasks)]
    return [(args.tasks, (0, 1), EASY_PART, first), (args.tasks, HARD, 1.0, last)]


def train(args):
    """`train`: one rank per core unless torchrun has started us already."""
    run_dir = Path(args.run_dir)
    if "WORLD_SIZE" not in os.environ and args.ranks > 1:
        return launch(args)
    options = {"tg": args.tg, "lidar": args.lidar, "paper": args.paper}
    meta = {**options, "tasks": args.tasks, "sequential": args.sequential,
            "seed": args.seed, "command": shlex.join(["python", "loco_mtrl.py", *args.argv]),
            "commit": _commit()}
    stages = plan(args)
    with contextlib.closing(make_env("flat", **options)) as env:
        symmetry, scan = mirror(env), env.get_wrapper_attr("scan_shape")
    n_tg = TrajectoryGenerator.action_size * args.tg
    # Without the generator the joints' actions are worth six times as many radians.
    init_std = (0.37,) * n_tg + (0.37 if args.tg else 0.25,) * 12
    noise_correlation = (0.9,) * n_tg + (0.0,) * 12  # 0.3 s: turns and stops are tried as such
    ranks = int(os.environ.get("WORLD_SIZE", 1))
    restarted = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") != "0"  # torchrun, after a crash
    resume, first = args.resume or restarted, int(os.environ.get("RANK", 0)) == 0
    on_update = tensorboard(run_dir) if args.tensorboard and first else None
    try:
        # Each stage resumes the one before.
        for k, (tasks, difficulty, share, settings) in enumerate(stages):
            resume |= k > 0
            if args.stage not in (None, k):
                continue
            # At least 20 environments, as many for each task, shared among the ranks.
            num_envs = math.ceil(len(tasks) * math.ceil(20 / len(tasks)) / ranks)
            config = PPOConfig(
                total_timesteps=round(share * args.steps), num_envs=num_envs, seed=args.seed,
                num_minibatches=min(settings["num_steps"] // 50, 16), exteroceptive=scan,
                checkpoint_every=10_000 // settings["num_steps"],
                encoder_hidden=(128, 128), trunk_hidden=(128, 128),
                init_std=init_std, noise_correlation=noise_correlation,
                gae_lambda=0.98, max_advantage=1.0, **settings,
            )
            training = partial(training_env, seed=args.seed, tasks=tasks, stage=k,
                               guide=config.guide_share > 0, difficulty=difficulty, **options)
            learn(training, config, run_dir=run_dir, resume=resume, mirror=symmetry, meta=meta,
                  episode_keys=("t_cr", "success", "fall", "exploded"), groups=args.tasks,
                  on_update=on_update)
    except KeyboardInterrupt:
        if first:
            print(f"\nStopped. To go on from the last checkpoint: {_again(args)}")
        return 130
    if first:
        checkpoint = load_checkpoint(run_dir / "checkpoint.pt")
        # To be shared: who acts needs no critic, and half the bits change an action by less than a
        # thousandth.
        checkpoint["optimiser"] = None
        checkpoint["model"] = {name: tensor.half() if tensor.dtype == torch.float32 else tensor
                               for name, tensor in checkpoint["model"].items()
                               if not name.startswith("critic.")}
        write_whole(checkpoint, run_dir / "policy.pt")
        if args.stage is None:
            print(MADE.format(run_dir))
    return 0


def tensorboard(run_dir):
    """An `on_update` for `learn` that also writes progress.csv's columns for TensorBoard."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ValueError("--tensorboard needs TensorBoard: pip install tensorboard") from None
    writer = SummaryWriter(run_dir)

    def on_update(_, row):
        for name, value in row.items():
            writer.add_scalar(name, value, row["steps"])
        writer.flush()

    return on_update


MADE = "Policy: {0}/policy.pt   Curve: {0}/curve.png"  # what a person needs of a training
LOST = 3  # exit code of a rank that ends because another one is gone


def launch(args):
    """Starts one rank per core through torch's own launcher, and waits for them.

    Once for each stage of the training: Bullet gives a layout's memory back only when its process
    ends.
    """
    import torch.distributed.run as torchrun
    from torch.distributed.elastic.multiprocessing import SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError

    logging.getLogger("torch.distributed.elastic").setLevel(logging.CRITICAL)
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # what torchrun would set, with a warning
    command = ["--standalone", f"--nproc-per-node={args.ranks}", __file__, *args.argv, "--stage"]
    run_dir = Path(args.run_dir)
    try:
        stages = plan(args)
        for k, (_, _, share, _) in enumerate(stages):
            if k or args.resume:  # a bad checkpoint is better named by one process
                checkpoint = load_checkpoint(run_dir / "checkpoint.pt")
                done = checkpoint["counters"]["steps"] >= round(share * args.steps)
                if done and k + 1 < len(stages):  # the last one has policy.pt to write, too
                    continue
            torchrun.main([*command, str(k)])
    except SignalException as stop:
        return 128 + stop.sigval
    except ChildFailedError as error:
        codes = {rank: failure.exitcode for rank, failure in error.failures.items()}
        for code in codes.values():
            if code > 0 and code != LOST:
                return code  # that rank itself has said what is wrong
        # The launcher ends the other ranks by SIGTERM, and may record that, too.
        killed = [rank for rank, code in codes.items() if code not in (LOST, -signal.SIGTERM)]
        rank = (killed or list(codes))[0]
        end = f"was killed by signal {-codes[rank]}" if codes[rank] < 0 else "lost the others"
        print(f"loco_mtrl.py: error: rank {rank} {end}. "
              f"To go on from the last checkpoint: {_again(args)}", file=sys.stderr)
        return 1
    print(MADE.format(run_dir))
    return 0


def _again(args):
    """The command that resumes this run."""
    kept = [a for a in args.argv if a != "--resume"]
    return shlex.join(["python", "loco_mtrl.py", *kept, "--resume"])


def _commit():
    """The commit of this code, for the record of a run; empty outside a git checkout."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()
    except OSError:
        return ""


# ------------------------------------------------------------------------------- eval

EVAL_SECONDS = 60  # an episode's limit: 36 m at 0.6 m/s, three times the farthest goal
GIF_EVERY = 4  # control steps a frame: 7.5 frames a second
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


def zero_action(observation, env):
    """The trajectory generator alone."""
    return np.zeros(env.action_space.shape)


def walk_straight(observation, env):
    """Walks straight at the goal on the same trajectory generator: steers, but sees nothing."""
    action = np.zeros(env.action_space.shape)
    heading = observation[math.prod(env.get_wrapper_attr("scan_shape")) + 1]
    action[1:3] = 0.75 + np.clip(heading, -0.6, 0.6) * np.array([-0.4, 0.4])  # two strides
    return action


def follow_guide(observation, env):
    """The guide himself: the ways that the map shows, no learning, on the same generator."""
    return np.nan_to_num(advise(env))


REFERENCES = {"zero": zero_action, "straight": walk_straight, "guide": follow_guide}


def load_actor(name):
    """(act, options, row): `act(observation, env)`, make_env's options, the name of its row in
    PAPER, if it is there.

    `name` is a checkpoint's path or one of REFERENCES. Raises as `load_checkpoint` does.
    """
    if name in REFERENCES:
        return REFERENCES[name], {}, None
    model, checkpoint = load_policy(name)
    meta = checkpoint["meta"] or {}
    if not {"tg", "lidar", "paper", "tasks", "sequential"} <= set(meta):
        raise ValueError(f"{name} is not a policy for LocoEnv: {meta}")
    options, tasks = {k: meta[k] for k in ("tg", "lidar", "paper")}, meta["tasks"]
    with contextlib.closing(make_env("flat", **options)) as env:
        size, given = env.observation_space.shape[0], model.kwargs["obs_dim"]
    if size != given:
        raise ValueError(f"{name} takes observations of {given} numbers, a robot here gives {size}")
    kinds = {"reactive": not meta["tg"], "no vision": not meta["lidar"],
             "sequential": meta["sequential"], tasks[0]: len(tasks) == 1, "ours": True}
    row = next(kind for kind, holds in kinds.items() if holds)
    return lambda observation, env: model.mean_action(observation), options, row


def make_place(place, seed):
    """The terrain of episode `seed`: of a world, a task, or a mesh, (path, scale, up)."""
    if isinstance(place, tuple):
        return load_mesh(*place)
    if place in WORLDS:
        return make_world(place, seed)
    rng = np.random.default_rng(seed)
    return make_terrain(place, rng, rng.uniform())


def episodes(job):
    """One episode of each actor: job = (place, seed, actors) -> job, [{t_cr, success, ...}, ...]"""
    place, seed, actors = job
    torch.set_num_threads(1)
    terrain, results = make_place(place, seed), []
    for actor in actors:
        act, options, _ = load_actor(actor)
        env = make_env(terrain, max_episode_steps=round(EVAL_SECONDS / DT), **options)
        observation, info = env.reset(seed=seed)
        terminated = truncated = False
        while not (terminated or truncated):
            observation, _, terminated, truncated, info = env.step(act(observation, env))
        result = {k: float(info[k]) for k in ("t_cr", "success", "fall", "collisions")}
        results.append(result | {"seconds": env.unwrapped.time})
        env.close()
    return job, results


def evaluate(actors, places, n_episodes, workers):
    """Scores of every actor in every place: {place: a list of dicts for each actor}.

    Every episode runs in an environment of its own, so the scores do not depend on `workers`.
    """
    jobs = [(place, EVAL_SEED + k, actors) for place in places for k in range(n_episodes)]
    scores = {place: [[None] * n_episodes for _ in actors] for place in places}
    # Workers are replaced now and then: Bullet never gives a mesh's memory back.
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=20) as pool:
        done = pool.imap_unordered(episodes, jobs)
        for (place, seed, _), results in tqdm(done, total=len(jobs), unit="episode"):
            for k, result in enumerate(results):
                scores[place][k][seed - EVAL_SEED] = result
    return scores


def eval_command(args):
    """`eval`: the table of the paper for one or more policies."""
    if args.json:  # bad files are named before any work
        Path(args.json).open("a").close()
    rows = [load_actor(actor)[2] for actor in args.policies]
    places = args.worlds
    if args.mesh:
        places = [(args.mesh, args.scale, args.up)]
        load_mesh(*places[0])
    scores = evaluate(args.policies, places, args.episodes, args.ranks)
    report = {"policies": args.policies, "episodes": args.episodes, "worlds": {}}
    for place, runs in scores.items():
        flat = [run for policy in runs for run in policy]
        mean = {k: float(np.mean([run[k] for run in flat])) for k in flat[0]}
        mean["std"] = float(np.std([run["t_cr"] for run in flat]))
        mean["per_policy"] = [float(np.mean([run["t_cr"] for run in policy])) for policy in runs]
        report["worlds"][Path(place[0]).stem if args.mesh else place] = mean
    table = report["worlds"]
    report["mean_t_cr"] = float(np.mean([world["t_cr"] for world in table.values()]))
    lines = [("", list(table)), ("t_cr", [f"{w['t_cr']:.2f}" for w in table.values()]),
             ("+- std", [f"{w['std']:.2f}" for w in table.values()])]
    if len(set(rows)) == 1 and rows[0] in PAPER and list(table) == list(WORLDS):
        figures = ["0." + figure for figure in PAPER[rows[0]].split()]
        lines += [(f"paper: {rows[0]}", figures[:8]), ("+- std", figures[8:])]
    for key in ("success", "fall", "collisions", "seconds"):
        lines.append((key, [f"{w[key]:.2f}" for w in table.values()]))
    for name, cells in lines:
        print(f"{name:18}" + "".join(f"{cell:>14}" for cell in cells))
    for k, actor in enumerate(args.policies):
        each = np.mean([w["per_policy"][k] for w in table.values()])
        print(f"mean t_cr {each:.3f}  {actor}")
    if args.json:
        Path(args.json).write_text(json.dumps(report, indent=2) + "\n")
    return 0


# ------------------------------------------------------------------------------- play, gallery


def draw_map(axis, terrain):
    """Draws a terrain from above: shaded heights, starts (white), goals (green), people's ways."""
    from matplotlib import colormaps
    from matplotlib.colors import LightSource

    low, high = terrain.vertices[:, :2].min(0), terrain.vertices[:, :2].max(0)
    x, y = (np.arange(a + 0.025, b, 0.05) for a, b in zip(low, high, strict=True))
    z = terrain.height(*np.meshgrid(x, y))
    z = np.where(np.isfinite(z), z, z[np.isfinite(z)].min())
    span = dict(vmin=min(z.min(), -0.5), vmax=max(z.max(), 0.5))
    shaded = LightSource(315, 40).shade(z, colormaps["cividis"], blend_mode="soft", **span)
    axis.imshow(shaded, origin="lower", extent=(low[0], high[0], low[1], high[1]))
    for person in terrain.people:
        axis.plot(*person.path.T, color="tab:orange", lw=0.8)
    axis.plot(*terrain.starts[:, :2].T, "wo", ms=4, mec="k")
    axis.plot(*terrain.goals[:, :2].T, "o", color="tab:green", ms=4, mec="k")
    axis.set(xticks=[], yticks=[])


def play(args):
    """`play`: one episode in PyBullet's window, or as a GIF and a picture of the path."""
    act, options, _ = load_actor(args.policy)
    place = (args.mesh, args.scale, args.up) if args.mesh else args.world
    terrain = make_place(place, args.seed)
    if not args.gui:  # what is not installed or cannot be written is named before the work
        from matplotlib.figure import Figure  # not pyplot: it needs no display
        from PIL import Image

        Path(args.gif).open("a").close()
    options |= {"gui": True} if args.gui else {"render_mode": "rgb_array"}
    env = make_env(terrain, max_episode_steps=round(EVAL_SECONDS / DT), **options)
    robot = env.unwrapped
    robot.show_lidar = args.lidar
    observation, info = env.reset(seed=args.seed)
    frames, path, terminated, truncated = [], [], False, False
    with tqdm(total=EVAL_SECONDS, unit="s", bar_format="{l_bar}{bar}|{n:.0f}/{total} s") as bar:
        while not (terminated or truncated):
            if args.gui:
                robot.bullet.resetDebugVisualizerCamera(2.4, robot.view_yaw, -40, robot.position)
                time.sleep(DT)
            elif len(path) % GIF_EVERY == 0:
                frames.append(env.render())
            path.append(robot.position - robot.origin)
            observation, _, terminated, truncated, info = env.step(act(observation, env))
            bar.update(DT)
    end = "reached the goal" if info["success"] else "fell" if info["fall"] else "ran out of time"
    print(f"{terrain.name}: t_cr {info['t_cr']:.2f}, {end} after {len(path) * DT:.1f} s")
    if not args.gui:
        some = frames[:: -(len(frames) // 8 + 1)]  # the last one among them: it shows the goal
        palette = Image.fromarray(np.concatenate(some)).quantize(64)
        pictures = [Image.fromarray(frame).quantize(palette=palette, dither=0) for frame in frames]
        pictures[0].save(args.gif, save_all=True, append_images=pictures[1:], loop=0,
                         duration=round(1000 * GIF_EVERY * DT))
        figure = Figure(figsize=(6, 5), layout="constrained")
        axis = figure.subplots()
        draw_map(axis, terrain)
        axis.plot(*np.array(path)[:, :2].T, color="tab:red")
        axis.set_title(f"{terrain.name}, seed {args.seed}: {end}, t_cr {info['t_cr']:.2f}")
        picture = Path(args.gif).with_suffix(".png")
        figure.savefig(picture, dpi=100)
        print(f"{args.gif}  {picture}")
    env.close()
    return 0


def gallery(args):
    """`gallery`: every training task and every unseen world from above, in one picture."""
    from matplotlib.figure import Figure

    Path(args.out).open("a").close()  # as in play
    figure = Figure(figsize=(15, 11), layout="constrained")
    names = [*PILLAR_TASKS, *WORLDS]
    axes = figure.subplots(-(-len(names) // 7), 7).ravel()
    for axis in axes[len(names) :]:
        axis.remove()
    for axis, name in zip(axes, tqdm(names, unit="terrain"), strict=False):
        rng = np.random.default_rng(args.seed)
        unseen = name in WORLDS
        draw_map(axis, make_world(name, args.seed) if unseen else make_terrain(name, rng, 0.8))
        axis.set_title(name, color="tab:red" if unseen else "k", fontsize=11)
    figure.savefig(args.out, dpi=75)
    print(args.out)
    return 0


# ------------------------------------------------------------------------------- command line


def _names(valid, what, text):
    names = text.split(",")
    for name in names:
        if name not in valid:
            raise argparse.ArgumentTypeError(f"unknown {what} {name!r}; valid: {', '.join(valid)}")
    return names


def _whole(least, text):
    with contextlib.suppress(ValueError, OverflowError):
        value = int(float(text))
        if value == float(text) >= least:
            return value
    raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}, got {text!r}")


def _file(suffix, text):
    if not text.endswith(suffix):
        raise argparse.ArgumentTypeError(f"must end in {suffix}, got {text!r}")
    return text


def mesh_options(p):
    p.add_argument("--mesh", metavar="FILE.obj", help="a scanned building instead")
    p.add_argument("--scale", type=float, default=1.0, help="of the mesh, metres a unit")
    p.add_argument("--up", choices=("z", "y"), default="z", help="axis of the mesh that points up")


def parse(argv):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    parser = argparse.ArgumentParser("loco_mtrl.py", description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command")
    places = partial(_names, [*WORLDS, *PILLAR_TASKS], "world")
    natural, positive = partial(_whole, 0), partial(_whole, 1)

    p = commands.add_parser("train", help="train a policy")
    p.add_argument("--steps", type=positive, default=MAIN_STEPS, help="of the environment, in all")
    p.add_argument("--tasks", type=partial(_names, PILLAR_TASKS, "task"),
                   default=list(PILLAR_TASKS), help="comma-separated; default: all %(default)s")
    p.add_argument("--no-tg", dest="tg", action="store_false", help="reactive policy")
    p.add_argument("--no-lidar", dest="lidar", action="store_false", help="blind policy")
    p.add_argument("--paper", type=partial(_names, OURS, "part"), nargs="?", const=list(OURS),
                   default=[], metavar="PARTS",
                   help="state and training as in the paper, without what is ours: a guide who "
                   "shows the way in training, and the robot's map; or only without those named "
                   f"({','.join(OURS)})")
    p.add_argument("--sequential", action="store_true", help="one task after the other, not mixed")
    p.add_argument("--seed", type=natural, default=0)
    p.add_argument("--run-dir", default="runs/main", help="(default %(default)s)")
    p.add_argument("--resume", action="store_true", help="go on from the run's checkpoint")
    p.add_argument("--tensorboard", action="store_true", help="log for TensorBoard, too")
    p.add_argument("--ranks", type=positive, default=cores, help="processes; default: every core")
    p.add_argument("--stage", type=natural, help=argparse.SUPPRESS)  # see launch
    p.set_defaults(run=train)

    p = commands.add_parser("eval", help="score policies in worlds they never saw")
    p.add_argument("policies", nargs="+", metavar="POLICY",
                   help=f"a .pt file, or a reference: {', '.join(REFERENCES)}")
    p.add_argument("--worlds", type=places, default=list(WORLDS),
                   help="comma-separated worlds, or training tasks on held-out seeds")
    mesh_options(p)
    p.add_argument("--episodes", type=positive, default=20, help="per world (default %(default)s)")
    p.add_argument("--json", metavar="FILE", help="write the scores there, too")
    p.add_argument("--ranks", type=positive, default=cores, help="processes; default: every core")
    p.set_defaults(run=eval_command)

    p = commands.add_parser("play", help="watch a policy for one episode")
    p.add_argument("policy", metavar="POLICY", help="as in eval")
    p.add_argument("--world", choices=[*WORLDS, *PILLAR_TASKS], metavar="WORLD", default="maze",
                   help="a world or a training task (default %(default)s)")
    mesh_options(p)
    p.add_argument("--seed", type=natural, default=EVAL_SEED, help="layout (default %(default)s)")
    p.add_argument("--gif", type=partial(_file, ".gif"), metavar="FILE.gif", default="play.gif",
                   help="(default %(default)s)")
    p.add_argument("--lidar", action="store_true", help="draw where the LiDAR's rays hit")
    p.add_argument("--gui", action="store_true", help="PyBullet's window instead of a GIF")
    p.set_defaults(run=play)

    p = commands.add_parser("gallery", help="draw all terrains in one picture")
    p.add_argument("--out", type=partial(_file, ".png"), metavar="FILE.png", default="gallery.png",
                   help="(default %(default)s)")
    p.add_argument("--seed", type=natural, default=0)
    p.set_defaults(run=gallery)

    args = parser.parse_args(argv)
    args.argv = argv[:-2] if getattr(args, "stage", None) is not None else argv
    return args


def main(argv=None):
    argv = sys.argv[1:] if argv is None else argv
    args = parse(argv or ["train"])
    try:
        code = args.run(args)
        if not argv and not code:  # the main job: train, then score
            code = eval_command(parse(["eval", str(Path(args.run_dir) / "policy.pt")]))
        return code
    except (ValueError, OSError, ImportError, FloatingPointError) as error:
        print(f"loco_mtrl.py: error: {error}", file=sys.stderr)
        return LOST if isinstance(error, ConnectionError) else 2


if __name__ == "__main__":
    import loco_mtrl  # by the name that gymnasium and the worker processes know

    sys.exit(loco_mtrl.main())
