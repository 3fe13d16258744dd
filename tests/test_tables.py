"""The tables are what results.csv says, and one command makes both."""

from pathlib import Path

import numpy as np
import pytest
import tables

from loco_mtrl import PAPER, WORLDS

ROOT = Path(tables.ROOT)


def results(**scores):
    """results.csv of a few rows; scores: the mean t_cr of each seed, alike in all worlds."""
    return [{"row": row, "seed": str(seed), "world": world, "t_cr": str(t_cr)}
            for row, seeds in scores.items() for seed, t_cr in enumerate(seeds) for world in WORLDS]


def test_tables_by_hand():
    """0.2 and 0.6: mean 0.4, standard deviation of the two 0.283, error of the mean 0.2."""
    lines = tables.tables(results(flat=(0.2, 0.6), ours=(0.9,))).splitlines()
    found = [line.split(" | ") for line in lines]
    assert ["| flat", "2", *["0.40"] * 8, "**0.400** ± 0.200 |"] in found
    assert found.count(["| ours", "1", *["0.90"] * 8, "**0.900** |"]) == 2  # in both tables
    mean = np.mean([int(figure) for figure in PAPER["flat"].split()[:8]]) / 100
    figures = "0.39 | 0.22 | 0.54 | 0.51 | 0.50 | 0.43 | 0.32 | 0.57"
    assert f"| *flat, paper* | | {figures} | {mean:.3f} |" in lines
    assert sum(", paper*" in line for line in lines) == 10 and "| reactive" not in str(found)


def test_forgetting_by_hand():
    scores = ("after 10 tasks", "0.1"), ("after 9 tasks", "0.5"), ("after 9 tasks", "0.7")
    told = [{"world": task, "row": row, "t_cr": t_cr}
            for row, t_cr in scores for task in ("flat", "rugged", "holes")]
    lines = tables.forgetting(told + results(ours=(0.9,))).splitlines()
    assert lines[-2:] == ["| after 9 tasks | 0.60 | 0.60 | 0.60 |",
                          "| after 10 tasks | 0.10 | 0.10 | 0.10 |"]


def test_readme_shows_the_tables_of_the_results():
    path = ROOT / "policies" / "results.csv"
    if not path.exists():
        pytest.skip("no row of the tables has been trained yet")
    assert tables.tables(tables.read(path)) in (ROOT / "README.md").read_text()


def evaluate(actors, places, n_episodes, workers):
    """In place of minutes of walking; the real one has its own tests."""
    return {(actor, place): [{"t_cr": 0.25, "success": 0.0, "fall": 1.0}] * n_episodes
            for actor in actors for place in places}


def test_quick_makes_rows_once_and_then_only_the_table(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(tables, "ROWS", {"flat": (["--tasks", "flat", "--no-lidar"], 3)})
    monkeypatch.setattr(tables, "TABLES", {"Table 1": ["flat"]})
    monkeypatch.setattr(tables, "RUNS", tmp_path)
    monkeypatch.setattr(tables, "evaluate", evaluate)
    tables.main(["--quick"])
    table, rows = capfd.readouterr().out, tables.read(tmp_path / "quick" / "results.csv")
    assert [row["world"] for row in rows] == list(WORLDS) and {row["seed"] for row in rows} == {"0"}
    assert all(float(row["t_cr"]) == 0.25 and int(row["steps"]) > 4_000 for row in rows)
    monkeypatch.setattr(tables, "train", None)
    tables.main(["--quick"])
    assert capfd.readouterr().out.strip() in table
    assert (tmp_path / "quick" / "tables.png").read_bytes().startswith(b"\x89PNG")
