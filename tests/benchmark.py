"""How fast the project is, as a table: `python tests/benchmark.py`, 10 to 15 minutes.

Asserts nothing, for times depend on the machine: run it on an idle one and compare the ratios.
"""

import csv
import math
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
import psutil
import torch

import loco_mtrl
import ppo
from loco_mtrl import LAIKAGO, PILLAR_TASKS, LocoEnv, training_env

STEPS = 2000


class NaiveEnv(LocoEnv):
    """The same scene as one would first write it: a box per pillar, the URDF's own meshes."""

    def _add_mesh(self, terrain, offset, visual):
        p, ground = self.bullet, terrain.height
        half = np.append(np.array(ground.cell) / 2, 0.5)
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=half)
        for (i, j), height in np.ndenumerate(ground.heights):
            x, y = (i + 0.5) * ground.cell[0], (j + 0.5) * ground.cell[1] - ground.size[1] / 2
            p.createMultiBody(0, shape, basePosition=(x + offset, y, height - 0.5))

    def _load_robot(self):
        p = self.bullet
        self.robot = p.loadURDF(str(LAIKAGO), [0, 0, 1000])
        joints = [p.getJointInfo(self.robot, j) for j in range(p.getNumJoints(self.robot))]
        ids = {joint[1].decode(): joint[0] for joint in joints}
        names = [f"{leg}_{joint}" for leg in loco_mtrl.LEGS for joint in loco_mtrl.JOINTS]
        self.joints = [ids[name] for name in names]


def timed(owner, name, spent):
    """From now on the seconds of each call of owner.name are listed in spent[name]."""
    function = getattr(owner, name)

    def wrapper(*args, **kwargs):
        start = time.perf_counter()
        result = function(*args, **kwargs)
        spent.setdefault(name, []).append(time.perf_counter() - start)
        return result

    setattr(owner, name, wrapper)


def walk(env, steps, spent=None):
    """Seconds a step, and a reset, of gentle random actions on rugged pillars."""
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    for name in ("stepSimulation", "rayTestBatch") if spent is not None else ():
        timed(env.unwrapped.bullet, name, spent)
    resets, elapsed = [], 0.0
    for _ in range(steps):
        action = rng.normal(0, 0.2, env.action_space.shape)
        start = time.perf_counter()
        _, _, terminated, _, _ = env.step(action)
        elapsed += time.perf_counter() - start
        if terminated:
            start = time.perf_counter()
            env.reset()
            resets.append(time.perf_counter() - start)
    for _ in range(20):
        start = time.perf_counter()
        env.reset()
        resets.append(time.perf_counter() - start)
    return elapsed / steps, np.mean(resets)


def training(ranks):
    """Steps/s and the share of learning in the easy part of a short training on all tasks.

    Steps/s from the second rollout on.
    """
    total = 30_000 * ranks
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "loco_mtrl", "train", "--run-dir", folder]
        command += ["--ranks", str(ranks), "--steps", str(total)]
        subprocess.run(command, check=True, capture_output=True)
        rows = list(csv.DictReader(open(Path(folder) / "progress.csv")))
    easy = (loco_mtrl.EASY_PART + 0.05) * total  # its last rollout ends a little later
    rows = [row for row in rows if float(row["steps"]) <= easy]
    collect, learn = (sum(float(row[k]) for row in rows) for k in ("collect_s", "learn_s"))
    steps = float(rows[-1]["steps"]) - float(rows[0]["steps"])
    minutes = float(rows[-1]["minutes"]) - float(rows[0]["minutes"])
    return steps / minutes / 60, learn / (collect + learn)


def apart():
    """Steps/s of two trainings of one rank each at once, together: as much as the machine gives."""
    with ThreadPoolExecutor(2) as pool:
        return sum(rate for rate, _ in pool.map(training, (1, 1)))


def precautions(rate):
    """Share of a training's time, at `rate` steps/s, for checkpoints, curves and checks for NaN."""
    spent, steps = {}, 30_000
    for name in ("save_checkpoint", "draw_curve"):
        timed(ppo, name, spent)
    timed(torch.Tensor, "isfinite", spent)  # of the parameters
    timed(math, "isfinite", spent)  # of every action: mostly the wrapper's own time
    with tempfile.TemporaryDirectory() as folder:
        loco_mtrl.main(["train", "--ranks", "1", "--steps", str(steps), "--run-dir", folder])
    checkpoint = np.mean(spent["save_checkpoint"]) + np.mean(spent["draw_curve"])
    between = 10_000 * len(PILLAR_TASKS)  # steps from one checkpoint to the next
    return checkpoint * rate / between + sum(spent["isfinite"]) * rate / steps


def memory():
    """MB of one rank with all tasks, and its growth from the 500th to the 5,000th reset."""
    make = [lambda i=i: training_env(i, 0, tasks=list(PILLAR_TASKS)) for i in range(12)]
    envs = gymnasium.vector.SyncVectorEnv(make)
    process, sizes = psutil.Process(), {}
    for k in range(5001):
        envs.envs[k % 12].reset()
        if k in (500, 5000):
            sizes[k] = process.memory_info().rss / 2**20
    envs.close()
    return sizes[500], sizes[5000] - sizes[500]


def show(name, value):
    print(f"{name:55}{value:>15}", flush=True)  # at once: whoever stops it keeps what is measured


def main():
    for label, wrap in (("with a Map around", loco_mtrl.Map), ("LocoEnv", lambda env: env)):
        spent, env = {}, wrap(LocoEnv("rugged", difficulty=0.5))
        step, reset = walk(env, STEPS)
        measured, _ = walk(env, STEPS, spent)
        env.close()
        inside = sum(map(sum, spent.values())) / STEPS
        show(f"steps/s on one core, rugged pillars, {label}", f"{1 / step:.0f}")
        for name, seconds in spent.items():
            show(f"  ms a step in {name}", f"{sum(seconds) / STEPS * 1e3:.3f}")
        show("  share inside those two", f"{inside / measured:.2f}")
        show("  reset", f"{reset * 1e3:.1f} ms")
    naive, _ = walk(NaiveEnv("rugged", difficulty=0.5), 200)
    show("one box per pillar and the URDF's meshes: slower by", f"{naive / step:.0f}x")
    size, growth = memory()
    show("memory of one rank, all tasks", f"{size:.0f} MB")
    show("  growth over resets 500 to 5,000", f"{growth:.1f} MB")
    for _ in range(3):  # in turns, since a machine's own speed may change by a third within minutes
        (one, _), (two, share), both = training(1), training(2), apart()
        rates = f"{one:.0f} {two:.0f} {both:.0f}"
        show("training steps/s: 1 rank, 2 ranks, two separate ones", rates)
        show("  times those of 1 rank", f"{two / one:.2f} {both / one:.2f}")
        show("  share of learning, 2 ranks", f"{share:.2f}")
    show("training steps/s, 4 ranks", f"{training(4)[0]:.0f}")
    show("share of checkpoints, curves, checks for NaN", f"{precautions(one):.2%}")


if __name__ == "__main__":
    main()
