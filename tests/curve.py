"""Draws how a policy's t_cr grows, on held-out layouts of the tasks and in the unseen worlds:

    python tests/curve.py curve.png checkpoint1.pt checkpoint2.pt ...

with copies of one run's checkpoint.pt, made while it trained. Five episodes a world, two of each
task on held-out seeds. Prints what it draws; asserts nothing.
"""

import os
import sys

import numpy as np
from matplotlib.figure import Figure

from loco_mtrl import PILLAR_TASKS, WORLDS, evaluate
from ppo import load_checkpoint


def main(out, *checkpoints):
    minutes = [load_checkpoint(name)["history"][-1]["minutes"] for name in checkpoints]
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    for label, places, episodes in (("tasks", PILLAR_TASKS, 2), ("unseen worlds", WORLDS, 5)):
        scores = evaluate(checkpoints, list(places), episodes, os.cpu_count())
        t_cr = {key: np.mean([run["t_cr"] for run in runs]) for key, runs in scores.items()}
        mean = [np.mean([t_cr[name, place] for place in places]) for name in checkpoints]
        axis.plot(minutes, mean, "o-", lw=3, label=f"{label}, mean")
        for minute, value in zip(minutes, mean, strict=True):
            print(f"{label}: {value:.3f} after {minute:.1f} minutes")
        for place in places if places is WORLDS else ():
            axis.plot(minutes, [t_cr[name, place] for name in checkpoints], lw=1, label=place)
    axis.set(xlabel="minutes of training on two cores", ylabel="t_cr", ylim=(0, 1.02))
    figure.legend(loc="outside right upper")
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
