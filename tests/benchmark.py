"""How fast the project is, as a table: `python tests/benchmark.py`, some 15 minutes.

Asserts nothing, for times depend on the machine: run it on an idle one and compare the ratios.
"""

import csv
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import psutil

import loco_mtrl
from loco_mtrl import HOLD, JOINTS, LAIKAGO, LocoEnv, Simulation
from ppo import PPOConfig
from tg import LEGS

PROGRAM = loco_mtrl.__file__
BULLET = ("stepSimulation", "rayTestBatch")  # where the time should go


class NaiveSimulation(Simulation):
    """The same scene as one would first write it: a box per pillar, the URDF's own meshes."""

    def _add_terrain(self, terrain, origin):
        p, (m, n), cell = self.bullet, terrain.heights.shape, terrain.cell
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[cell / 2, cell / 2, 0.5])
        for i in range(m):
            for j in range(n):
                centre = (i + 0.5) * cell, (j + 0.5 - n / 2) * cell, terrain.heights[i, j] - 0.5
                p.createMultiBody(0, shape, basePosition=np.add(origin, centre))

    def load_robot(self):
        p = self.bullet
        self.robot = p.loadURDF(str(LAIKAGO), [0, 0, 1000])
        names = {p.getJointInfo(self.robot, j)[1].decode(): j
                 for j in range(p.getNumJoints(self.robot))}
        self.joints = [names[f"{leg}_{joint}"] for leg in LEGS for joint in JOINTS]


def timed(owner, name, spent):
    """From now on the seconds of each call of owner.name are added to spent[name]."""
    function = getattr(owner, name)

    def wrapper(*args, **kwargs):
        start = time.perf_counter()
        result = function(*args, **kwargs)
        spent[name] = spent.get(name, 0.0) + time.perf_counter() - start
        return result

    setattr(owner, name, wrapper)


def walk(env, decisions, spent=None):
    """(s a decision, s a reset) of gentle random actions; `spent`: where that time goes."""
    rng, seconds, resets = np.random.default_rng(0), 0.0, []
    env.reset(seed=0)
    for name in BULLET if spent is not None else ():
        timed(env.simulation.bullet, name, spent)
    for k in range(decisions):
        action = rng.normal(0, 0.2, env.action_space.shape)
        start = time.perf_counter()
        _, _, terminated, *_ = env.step(action)
        seconds += time.perf_counter() - start
        if terminated or k >= decisions - 5:
            start, before = time.perf_counter(), dict(spent or {})
            env.reset()
            resets.append(time.perf_counter() - start)
            if spent is not None:
                spent.update(before)
    return seconds / decisions, float(np.mean(resets))


def one_core(decisions, naive_decisions):
    """{label: value} of LocoEnv with its LiDAR on rugged pillars."""
    spent, place = {}, dict(tasks="rugged", difficulty=(0.5, 0.5))
    with closing(LocoEnv(**place)) as env:
        step, reset = walk(env, decisions)
        inside, _ = walk(env, decisions, spent)
    original, loco_mtrl.Simulation = loco_mtrl.Simulation, NaiveSimulation
    try:
        with closing(LocoEnv(**place)) as env:
            naive, _ = walk(env, naive_decisions)
    finally:
        loco_mtrl.Simulation = original
    physics, scan = (spent[name] / decisions for name in BULLET)
    return {
        "decisions/s on one core, rugged pillars": f"{1 / step:.0f}",
        "  control steps/s": f"{HOLD / step:.0f}",
        "  ms in stepSimulation, of each control step": f"{physics / HOLD * 1e3:.3f}",
        "  ms in rayTestBatch, of each scan": f"{scan * 1e3:.3f}",
        "  share of both, inside Bullet": f"{(physics + scan) / inside:.2f}",
        "  ms a reset": f"{reset * 1e3:.1f}",
        "a box per pillar and the URDF's meshes: slower by": f"{naive / step:.1f}x",
    }


def training(ranks, updates):
    """(rows/s, share of learning) of a training on all tasks, from its second update on."""
    steps = PPOConfig.num_steps * PPOConfig.num_envs * updates
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, PROGRAM, "train", "--run-dir", folder]
        subprocess.run([*command, "--ranks", str(ranks), "--steps", str(steps)], check=True,
                       capture_output=True)
        with open(Path(folder) / "progress.csv", newline="") as file:
            table = [{name: float(row[name]) for name in ("steps", "collect_s", "learn_s")}
                     for row in csv.DictReader(file)]
    collect, learn = (sum(row[name] for row in table[1:]) for name in ("collect_s", "learn_s"))
    return (table[-1]["steps"] - table[0]["steps"]) / (collect + learn), learn / (collect + learn)


def in_turns(rounds, updates):
    """{label: value}: a machine's own speed may change by a third within minutes, so in turns."""
    turns = np.array([[training(ranks, updates) for ranks in (1, 2)] for _ in range(rounds)])
    (one, two), (learn_one, learn_two) = turns.T[0], turns.T[1].mean(1)
    return {
        "training rows/s, 1 rank": " ".join(f"{rate:.0f}" for rate in one),
        "training rows/s, 2 ranks": " ".join(f"{rate:.0f}" for rate in two),
        "  times those of 1 rank": " ".join(f"{ratio:.2f}" for ratio in two / one),
        "  share of learning, 1 and 2 ranks": f"{learn_one:.2f} {learn_two:.2f}",
    }


def memory(num_envs, resets):
    """{label: value} of one of two ranks, as it collects: no gradients."""
    process, args = psutil.Process(), loco_mtrl.parse(["train"])
    before = process.memory_info().rss
    make = [partial(loco_mtrl.training_env, i, 0, args) for i in range(0, num_envs, 2)]
    with closing(gymnasium.vector.SyncVectorEnv(make)) as envs:
        envs.reset(seed=0)
        size = process.memory_info().rss
        for k in range(resets):
            envs.envs[k % len(make)].reset()
        growth = process.memory_info().rss - size
    return {"MB of one of two ranks, all tasks": f"{size / 2**20:.0f}",
            "  of that, environments": f"{(size - before) / 2**20:.0f}",
            f"  growth over {resets} resets": f"{growth / 2**20:.1f}"}


def show(table):
    for name, value in table.items():
        print(f"{name:55}{value:>20}", flush=True)  # at once: whoever stops it keeps what is there


def main():
    show(memory(PPOConfig.num_envs, 5000))  # first: Bullet gives nothing back
    show(one_core(2000, 200))
    show(in_turns(3, 6))


if __name__ == "__main__":
    main()
