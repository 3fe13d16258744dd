"""The two rulers of the unseen worlds, as a table: `python tests/worlds.py [WORLD ...]`.

`straight`, which sees nothing and heads for the goal, is to score what the paper's policy scores
that was trained on flat ground; `Walker`, which knows the ground, is to arrive. Both walk on the
same gait, 60 s at most. All worlds take some 20 minutes on two cores.
"""

import contextlib
import os
import sys
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm
from walker import Walker

from loco_mtrl import EVAL_SECONDS, PAPER, WORLDS, make_env, make_world, straight

FIRST = 20_000  # seed of the first layout
LAYOUTS = {"straight": 200, "walker": 40}


def score(name, seed, who):
    """(t_cr, fall) of one episode."""
    terrain = make_world(name, seed)
    with contextlib.closing(make_env(terrain, EVAL_SECONDS, lidar=False)) as env:
        observation, _ = env.reset(seed=seed)
        walker, ended = Walker(env.unwrapped), False
        while not ended:
            action = straight(observation) if who == "straight" else walker.act()
            observation, _, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
    return info["t_cr"], float(info["fall"])


def ruler(name, who, layouts):
    """Mean t_cr, its standard error, and the share of falls over so many layouts of a world."""
    jobs = zip(*((name, FIRST + k, who) for k in range(layouts)), strict=True)
    with ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        results = list(tqdm(pool.map(score, *jobs), total=layouts, leave=False, desc=name))
    t_cr, fall = np.array(results).T
    return t_cr.mean(), t_cr.std() / layouts**0.5, fall.mean()


def main(*names):
    print("| world | paper, flat | straight | falls | walker | falls |\n" + "|---" * 6 + "|")
    for name in names or WORLDS:
        cells = [name, "0." + PAPER["flat"].split()[list(WORLDS).index(name)]]
        for who, layouts in LAYOUTS.items():
            mean, error, falls = ruler(name, who, layouts)
            cells += [f"{mean:.3f} ± {error:.3f}", f"{falls:.2f}"]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
