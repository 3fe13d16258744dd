"""Tables 1 and 2 of the paper, made from nothing: `python tests/tables.py [--quick]`.

Trains every row of the two tables from several seeds, in runs/tables, scores each policy in the
eight unseen worlds and keeps the scores in policies/results.csv. It does what is missing there, so
it can be stopped and called again at any time. Then it prints both tables as Markdown, with the
paper's figures under each row, and draws policies/tables.png. Every core trains a row of its own:
side by side two rows are done sooner than one after the other on both cores.

--quick shows in minutes that all of it works: hardly any training, one episode, other folders.
"""

import argparse
import csv
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from loco_mtrl import PAPER, PILLAR_TASKS, WORLDS, evaluate
from ppo import PPOConfig, load_checkpoint

ROOT = Path(__file__).parent.parent
RUNS = ROOT / "runs"
# The rows by their names in PAPER: what `train` is told, and how many seeds.
ROWS = {
    **{task: (["--tasks", task], 3) for task in ("flat", "rugged", "holes", "obstacles", "stairs")},
    "reactive": (["--no-tg"], 3),
    "no vision": (["--no-lidar"], 3),
    "sequential": (["--sequential"], 3),
    "ours": ([], 5),
}
TABLES = {"Table 1: one terrain against many": ["flat", "rugged", "holes", "obstacles", "stairs",
                                                "ours"],
          "Table 2: what each part is worth": ["reactive", "no vision", "sequential", "ours"]}
EPISODES = 20
FIRST = list(PILLAR_TASKS)[:3]  # what sequential training may forget
AFTER = (1, 2, 4, 8, 16, 17)  # tasks trained in sequence, after which that is looked at
COLUMNS = ["row", "seed", "world", "episodes", "t_cr", "std", "success", "fall", "steps", "minutes",
           "commit"]


def read(path):
    """The rows of results.csv, dicts of text; none if there is no such file."""
    if not path.exists():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def append(path, rows):
    new = not path.exists()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)


def train(row, seed, folder, steps):
    """Trains, or goes on training, until there is a policy; returns its path."""
    run = folder / f"{row.replace(' ', '-')}-{seed}"
    if not (run / "policy.pt").exists():
        run.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, ROOT / "loco_mtrl.py", "train", *ROWS[row][0], "--seed",
                   str(seed), "--steps", str(steps), "--run-dir", run, "--ranks", "1"]
        if (run / "checkpoint.pt").exists():
            command.append("--resume")
        with open(run / "log", "a") as log:  # its progress: several bars would make no sense
            subprocess.run(command, check=True, stdout=log, stderr=log)
    return run / "policy.pt"


def score(row, seed, policy, places, episodes, share=1.0):
    """A policy's rows of results.csv, one a place. share: of its training that was done."""
    last = load_checkpoint(policy.parent / "checkpoint.pt")["history"][-1]
    steps, minutes = round(share * last["steps"]), share * last["minutes"]
    commit = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, text=True,
                            capture_output=True).stdout.strip()
    scores = evaluate([str(policy)], places, episodes, os.cpu_count())
    rows = []
    for place in places:
        runs = scores[str(policy), place]
        means = {key: f"{np.mean([run[key] for run in runs]):.4f}"
                 for key in ("t_cr", "success", "fall")}
        std = f"{np.std([run['t_cr'] for run in runs]):.4f}"
        rows.append({"row": row, "seed": seed, "world": place, "episodes": episodes, **means,
                     "std": std, "steps": steps, "minutes": f"{minutes:.1f}", "commit": commit})
    return rows


def means(results):
    """{row: (seeds, 8) mean t_cr}, worlds in their order."""
    known = {}
    for result in results:
        if result["world"] in WORLDS:
            seeds = known.setdefault(result["row"], {})
            seeds.setdefault(result["seed"], {})[result["world"]] = float(result["t_cr"])
    return {row: np.array([[worlds[world] for world in WORLDS] for worlds in seeds.values()])
            for row, seeds in known.items()}


def paper(row):
    return np.array(PAPER[row].split()[:8], float) / 100


def tables(results):
    """Both tables as Markdown: mean over seeds and episodes, and the standard error over seeds."""
    table, lines = means(results), []
    for title, rows in TABLES.items():
        lines += [f"**{title}**", "", f"| | seeds | {' | '.join(WORLDS)} | mean |",
                  "|---" * (len(WORLDS) + 3) + "|"]
        for row in rows:
            if row in table:
                t_cr = table[row]
                cells = [f"{value:.2f}" for value in t_cr.mean(0)]
                mean = f"**{t_cr.mean():.3f}**"
                if len(t_cr) > 1:
                    mean += f" ± {t_cr.mean(1).std(ddof=1) / len(t_cr) ** 0.5:.3f}"
                lines.append(f"| {row} | {len(t_cr)} | {' | '.join(cells)} | {mean} |")
            cells = [f"{value:.2f}" for value in paper(row)]
            lines.append(f"| *{row}, paper* | | {' | '.join(cells)} | {paper(row).mean():.3f} |")
        lines.append("")
    return "\n".join(lines)


def forgetting(results):
    """What sequential training leaves of its first tasks, as Markdown: t_cr after n tasks."""
    table = {}
    for result in results:
        if result["world"] in FIRST:
            row = table.setdefault(result["row"], {task: [] for task in FIRST})
            row[result["world"]].append(float(result["t_cr"]))
    lines = [f"| | {' | '.join(FIRST)} |", "|---" * (len(FIRST) + 1) + "|"]
    for name in sorted(table, key=lambda name: int(name.split()[1])):
        cells = [f"{np.mean(t_cr):.2f}" for t_cr in table[name].values()]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(["**Forgetting**: t_cr on the first tasks, in sequence", "", *lines, ""])


def draw(results, path):
    """Rows x worlds, ours and the paper's side by side; only rows that have been trained."""
    table = means(results)
    figure = Figure(figsize=(11, 4), layout="constrained")
    rows = [row for row in ROWS if row in table]
    ours, theirs = [table[row].mean(0) for row in rows], [paper(row) for row in rows]
    for axis, values, title in zip(figure.subplots(1, 2, sharey=True), (ours, theirs),
                                   ("here", "in the paper"), strict=True):
        axis.imshow(values, vmin=0.2, vmax=0.9, cmap="viridis", aspect="auto")
        for (i, j), value in np.ndenumerate(values):
            axis.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=8,
                      color="k" if value > 0.6 else "w")
        axis.set_xticks(range(len(WORLDS)), WORLDS, rotation=30)
        axis.set(yticks=range(len(rows)), yticklabels=rows, title=f"t_cr {title}")
    figure.savefig(path, dpi=100)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="shows in minutes that all works")
    quick = parser.parse_args(argv).quick
    runs = RUNS / ("quick" if quick else "tables")
    out = runs if quick else ROOT / "policies"
    out.mkdir(parents=True, exist_ok=True)
    steps, episodes = (1, 1) if quick else (PPOConfig.total_timesteps, EPISODES)
    # Seed by seed, not row by row: whenever it is stopped, all rows have about as many.
    jobs = [(row, seed) for seed in range(1 if quick else 5) for row in ROWS
            if seed < ROWS[row][1]]
    known = {(result["row"], result["seed"]) for result in read(out / "results.csv")}
    jobs = [(row, seed) for row, seed in jobs if (row, str(seed)) not in known]
    pool = ThreadPoolExecutor(os.cpu_count())
    try:
        trained = [pool.submit(train, row, seed, runs, steps) for row, seed in jobs]
        for (row, seed), job in tqdm(zip(jobs, trained, strict=True), "rows", len(jobs)):
            policy = job.result()
            rows = score(row, seed, policy, list(WORLDS), episodes)
            for n in AFTER if row == "sequential" else ():
                after = policy.with_name(f"policy-{n}.pt")
                after = policy if n == len(PILLAR_TASKS) else after
                if after.exists():  # --quick is over before the first task ends
                    rows += score(f"after {n} tasks", seed, after, FIRST, episodes,
                                  n / len(PILLAR_TASKS))
            append(out / "results.csv", rows)
    finally:
        pool.shutdown(cancel_futures=True)
    results = read(out / "results.csv")
    print(tables(results), forgetting(results), sep="\n")
    draw(results, out / "tables.png")


if __name__ == "__main__":
    main()
