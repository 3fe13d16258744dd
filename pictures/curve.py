"""Draws pictures/curve.png from curve.csv: t_cr against minutes of training, on two cores.

Each row is a checkpoint of a run, scored on terrain it had not seen: `tasks` is the mean over the
25 training tasks (difficulty uniform), `worlds` that over the eight unseen worlds.
"""

import csv
from collections import defaultdict
from pathlib import Path

from matplotlib.figure import Figure

here = Path(__file__).parent
runs = defaultdict(list)
with open(here / "curve.csv", newline="") as file:
    for row in csv.DictReader(file):
        runs[row["seed"]].append([float(row[k]) for k in ("minutes", "tasks", "worlds")])

figure = Figure(figsize=(6, 3.6), layout="constrained")
axis = figure.subplots()
for seed, rows in runs.items():
    minutes, tasks, worlds = zip(*rows, strict=True)
    axis.plot(minutes, tasks, "o-", color="tab:gray", label=f"training tasks, seed {seed}")
    axis.plot(minutes, worlds, "o-", color="tab:red", label=f"unseen worlds, seed {seed}")
axis.axhline(0.756, color="k", ls=":", label="the paper, unseen worlds")
axis.set(xlabel="minutes of training", ylabel="t_cr", ylim=(0, 1))
axis.legend(fontsize=8)
figure.savefig(here / "curve.png", dpi=100)
