"""Draws how a policy's t_cr grows, where it was trained and in the unseen worlds:

    python tests/curve.py curve.png checkpoint1.pt checkpoint2.pt ...

with copies of one run's checkpoint.pt, made while it trained. 5 episodes a world, one of each
training task on held-out seeds. Prints what it draws; asserts nothing.
"""

import os
import sys

import numpy as np
from matplotlib.figure import Figure

import loco_mtrl
from ppo import load_checkpoint


def main(out, *checkpoints):
    actors = ["zero", *checkpoints]  # an untrained policy's mean is the zero action
    counters = [{"steps": 0, "minutes": 0.0}]
    counters += [load_checkpoint(name)["counters"] for name in checkpoints]
    minutes = [counter["minutes"] for counter in counters]
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axis = figure.subplots()
    for label, places, episodes in (("training tasks", loco_mtrl.PILLAR_TASKS, 1),
                                    ("unseen worlds", loco_mtrl.WORLDS, 5)):
        scores = loco_mtrl.evaluate(actors, list(places), episodes, os.cpu_count())
        t_cr = {place: [np.mean([run["t_cr"] for run in runs]) for runs in of_place]
                for place, of_place in scores.items()}
        mean = np.mean(list(t_cr.values()), 0)
        axis.plot(minutes, mean, "o-", lw=3, label=f"{label}, mean")
        if places is loco_mtrl.WORLDS:
            for world, values in t_cr.items():
                axis.plot(minutes, values, lw=1, label=world)
        for counter, value in zip(counters, mean, strict=True):
            steps, after = counter["steps"], counter["minutes"]
            print(f"{label}: {value:.3f} after {steps} steps, {after:.1f} minutes")
    axis.set(xlabel="minutes of training on two cores", ylabel="t_cr", ylim=(0, 1.02))
    figure.legend(loc="outside right upper")
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    if len(sys.argv) < 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
