"""The worlds are frozen: their numbers and layouts are those that the rulers were measured on."""

import json
from pathlib import Path

import numpy as np
import pytest

from terrain import WORLDS, make_world

FROZEN = json.loads((Path(__file__).parent / "worlds.json").read_text())


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_are_those_that_were_measured(name):
    """Starts, goals (cm) and the mean height (mm) of three layouts: no score may move a world."""
    for seed, expected in FROZEN[name].items():
        world = make_world(name, int(seed))
        found = [*world.starts[0, :2] * 100, *world.goals[0, :2] * 100, world.heights.mean() * 1000]
        np.testing.assert_allclose(found, expected, atol=1)
