"""The worlds are frozen: their numbers and layouts are those that the rulers were measured on."""

import json
from pathlib import Path

import numpy as np
import pytest
import worlds

from loco_mtrl import PAPER
from terrain import WORLDS, make_world

FROZEN = json.loads((Path(__file__).parent / "worlds.json").read_text())


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_are_those_that_were_measured(name):
    """Starts, goals (cm) and the mean height (mm) of three layouts: no score may move a world."""
    for seed, expected in FROZEN[name].items():
        world = make_world(name, int(seed))
        found = [*world.starts[0, :2] * 100, *world.goals[0, :2] * 100, world.heights.mean() * 1000]
        np.testing.assert_allclose(found, expected, atol=1)


@pytest.mark.parametrize("name", WORLDS)
def test_straight_scores_what_the_papers_policy_of_flat_ground_does(name):
    """Coarsely. `python tests/worlds.py` takes 200 layouts, and looks at the walker, too."""
    layouts = 60 if name == "cliff" else 20  # there, an episode lasts four seconds
    paper = int(PAPER["flat"].split()[list(WORLDS).index(name)]) / 100
    t_cr = [worlds.score(name, worlds.FIRST + k, "straight")[0] for k in range(layouts)]
    assert np.mean(t_cr) == pytest.approx(paper, abs=0.1)
