"""t_cr against minutes of training: `python policies/curve.py OUT.png EPISODES CHECKPOINT...`

The checkpoints are copies of one run's, taken as it went on. Unseen worlds beside held-out seeds of
the training tasks, EPISODES in each place.
"""

import os
import sys

import numpy as np
from matplotlib.figure import Figure

from loco_mtrl import PAPER, PILLAR_TASKS, WORLDS, evaluate
from ppo import load_checkpoint


def main(out, n_episodes, *checkpoints):
    counters = [load_checkpoint(path)["counters"] for path in checkpoints]
    minutes = [c["minutes"] for c in counters]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axis = figure.subplots()
    for label, places in (("training tasks, new seeds", PILLAR_TASKS), ("unseen worlds", WORLDS)):
        scores = evaluate(list(checkpoints), list(places), int(n_episodes), os.cpu_count())
        means = [np.mean([[run["t_cr"] for run in runs[k]] for runs in scores.values()])
                 for k in range(len(checkpoints))]
        axis.plot(minutes, means, "o-", label=label)
        for c, mean in zip(counters, means, strict=True):
            print(f"{label}: {c['steps']} steps, {c['minutes']:.1f} min: {mean:.3f}")
    paper = np.mean([int(figure) for figure in PAPER["ours"].split()[: len(WORLDS)]]) / 100
    axis.axhline(paper, color="k", ls=":", label="the paper, unseen worlds")
    axis.set(xlabel="minutes of training on two cores", ylabel="mean t_cr", ylim=(0, 1))
    axis.legend()
    figure.savefig(out, dpi=100)


if __name__ == "__main__":
    main(*sys.argv[1:])
