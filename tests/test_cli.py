"""The command line as a user calls it, and each wrong call."""

import csv
import json
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import psutil
import pybullet_data
import pytest
import torch

import loco_mtrl
import ppo

ROOT = Path(__file__).parent.parent


def run(*arguments, cwd):
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, str(ROOT / "loco_mtrl.py"), *map(str, arguments)],
        cwd=cwd, env=environment, capture_output=True, text=True, timeout=200,
    )  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two ranks and a few updates on flat ground, as a user starts it."""
    folder = tmp_path_factory.mktemp("runs")
    result = run("train", "--tasks", "flat", "--steps", 5000, "--ranks", 2, "--run-dir", "a",
                 cwd=folder)  # fmt: skip
    assert result.returncode == 0, result.stderr
    return folder / "a"


def progress(run_dir):
    with open(run_dir / "progress.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_training_leaves_what_a_person_needs(trained):
    assert {f.name for f in trained.iterdir()} >= {
        "config.json", "progress.csv", "checkpoint.pt", "policy.pt", "curve.png"
    }  # fmt: skip
    rows = progress(trained)
    assert int(rows[-1]["steps"]) >= 5000
    assert 0 < float(rows[-1]["steps_per_s"]) and float(rows[-1]["approx_kl"]) >= 0
    config = json.loads((trained / "config.json").read_text())
    assert config["meta"]["tasks"] == ["flat"] and config["ppo"]["seed"] == 0
    assert (trained / "policy.pt").stat().st_size < 3e5
    whole, shared = (ppo.load_policy(trained / name)[0] for name in ("checkpoint.pt", "policy.pt"))
    seen = np.random.default_rng(0).uniform(0, 1, (50, whole.kwargs["obs_dim"]))
    assert np.abs(whole.mean_action(seen) - shared.mean_action(seen)).max() < 1e-3


def test_ctrl_c_saves_and_a_killed_rank_stops_all(tmp_path):
    command = ["train", "--tasks", "flat", "--ranks", 2, "--run-dir", tmp_path / "b"]

    def stop_after_two_updates(*more, stop):
        process = subprocess.Popen(
            [sys.executable, str(ROOT / "loco_mtrl.py"), *map(str, [*command, *more])],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        )  # fmt: skip
        bars = ""
        while bars.count("t_cr") < 2:  # the bar names it after every update
            bars += process.stdout.read(20) or pytest.fail(bars)
        stop(process)
        text, _ = process.communicate(timeout=100)
        return process.returncode, text.splitlines()

    interrupt = lambda process: os.killpg(process.pid, signal.SIGINT)  # noqa: E731
    code, lines = stop_after_two_updates(stop=interrupt)
    assert code == 130 and "To go on from the last checkpoint: python loco_mtrl.py" in lines[-1]
    saved = progress(tmp_path / "b")

    def kill_a_rank(process):
        ranks = psutil.Process(process.pid).children()
        ranks[-1].kill()

    code, lines = stop_after_two_updates("--resume", stop=kill_a_rank)
    assert code == 1 and "killed by signal 9" in lines[-1] and "--resume" in lines[-1]
    ppo.load_policy(tmp_path / "b" / "checkpoint.pt")
    assert progress(tmp_path / "b")[: len(saved)] == saved  # continued, nothing lost


def test_resume_goes_on(trained):
    command = ["train", "--tasks", "flat", "--steps", 9000, "--ranks", 2, "--run-dir", trained]
    result = run(*command, "--resume", cwd=trained)
    assert result.returncode == 0, result.stderr
    steps = [int(row["steps"]) for row in progress(trained)]
    assert steps == sorted(set(steps)) and 5000 < steps[-1] < 9000 + 2 * 12 * 160
    # Ctrl-C in the very last update leaves a whole checkpoint, but no policy yet.
    (trained / "policy.pt").unlink()
    result = run(*command, "--resume", cwd=trained)
    assert result.returncode == 0 and (trained / "policy.pt").is_file(), result.stderr


def test_eval_prints_the_same_table_twice_and_writes_json(trained):
    arguments = ["eval", trained / "policy.pt", "--worlds", "flat,stairs", "--episodes", 2]
    first = run(*arguments, "--json", trained / "one.json", "--ranks", 2, cwd=trained)
    second = run(*arguments, "--json", trained / "two.json", "--ranks", 1, cwd=trained)
    assert first.returncode == 0, first.stderr
    assert first.stdout == second.stdout
    assert "stairs" in first.stdout and "t_cr" in first.stdout
    one, two = (json.loads((trained / f"{n}.json").read_text()) for n in ("one", "two"))
    assert one == two
    flat = one["worlds"]["flat"]
    assert set(flat) >= {"t_cr", "std", "success", "fall", "collisions", "seconds", "per_policy"}
    assert 0 <= flat["t_cr"] <= 1 and one["episodes"] == 2


def test_eval_in_a_scanned_building(tmp_path):
    mesh = Path(pybullet_data.getDataPath()) / "roboschool/models_outdoor/stadium/stadium.obj"
    result = run("eval", "zero", "--mesh", mesh, "--scale", 0.5, "--episodes", 1, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "stadium" in result.stdout and "mean t_cr" in result.stdout


def test_references_need_no_policy(tmp_path):
    result = run("eval", "zero", "straight", "--worlds", "flat", "--episodes", 2, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    scores = [float(line.split()[2]) for line in result.stdout.splitlines() if "mean t_cr" in line]
    assert scores[1] > 0.9 > scores[0] > 0.2  # steering reaches the goal, drifting does not


def test_play_writes_a_gif_that_moves_and_a_map(trained):
    from PIL import Image

    result = run("play", "straight", "--world", "flat", "--gif", "walk.gif", "--lidar", cwd=trained)
    assert result.returncode == 0, result.stderr
    assert "reached the goal" in result.stdout
    with Image.open(trained / "walk.gif") as gif:
        assert gif.n_frames > 20
        frames = []
        for k in (0, gif.n_frames // 2):
            gif.seek(k)
            frames.append(np.asarray(gif.convert("RGB"), dtype=int))
    assert np.abs(frames[0] - frames[1]).mean() > 1
    for frame in frames:  # the robot is the one dark thing there, and the camera follows it
        rows, columns = np.nonzero(frame.max(-1) < 60)
        assert rows.size > 500
        assert (np.abs([rows.mean() - 150, columns.mean() - 200]) < 60).all()
    with Image.open(trained / "walk.png") as picture:
        assert picture.size[0] > 300


@pytest.mark.parametrize(
    "arguments, named",
    [
        (["fly"], "fly"),
        (["train", "--tasks", "lava"], "lava"),
        (["train", "--paper", "map,legs"], "unknown part 'legs'"),
        (["train", "--tasks", ""], "unknown task ''"),
        (["train", "--steps", "-5"], "-5"),
        (["train", "--steps", "0"], "0"),
        (["train", "--steps", "many"], "many"),
        (["train", "--steps", "nan"], "nan"),
        (["train", "--ranks", "0"], "0"),
        (["train", "--seed", "x"], "x"),
        (["train", "--seed", "-1"], "-1"),
        (["train", "--seed", "1e999"], "1e999"),
        (["train", "--steps", "2.5"], "2.5"),
        (["train", "--fast"], "--fast"),
        (["train", "--resume", "--run-dir", "nowhere"], "nowhere"),
        (["train", "--run-dir", "/proc/nowhere", "--ranks", "1"], "/proc/nowhere"),
        (["eval"], "POLICY"),
        (["eval", "nothing.pt"], "nothing.pt"),
        (["eval", "zero", "--worlds", "moon"], "moon"),
        (["eval", "zero", "--episodes", "0"], "0"),
        (["play", "zero", "--world", "moon"], "moon"),
        (["play", "zero", "--mesh", "nothing.obj"], "nothing.obj"),
        (["eval", "zero", "--mesh", "nothing.obj"], "nothing.obj"),
        (["eval", "zero", "--up", "x"], "'x'"),
        (["eval", "zero", "--json", "/proc/nowhere/scores.json"], "/proc/nowhere"),
        (["play", "zero", "--gif", "/proc/nowhere/walk.gif"], "/proc/nowhere"),
        (["play", "zero", "--seed", "-3"], "-3"),
        (["gallery", "--out", "/proc/nowhere/all.png"], "/proc/nowhere"),
        (["play", "zero", "--gif", "walk.png"], "walk.png"),
        (["gallery", "--out", "all.gif"], "all.gif"),
        (["gallery", "--seed", "0.5"], "0.5"),
        (["eval", "zero", "--json", "."], "directory"),
        (["train", "--steps", "1.2.3"], "whole number"),
        (["train", "--steps", "inf"], "whole number"),
    ],
)
def test_wrong_calls_end_with_one_clear_line(arguments, named, capsys):
    try:
        code = loco_mtrl.main(arguments)
    except SystemExit as stop:
        code = stop.code
    error = capsys.readouterr().err
    assert code == 2
    assert named in error.strip().splitlines()[-1]
    assert "Traceback" not in error


def test_wrong_checkpoints_are_named(trained, tmp_path, capsys):
    whole = (trained / "checkpoint.pt").read_bytes()
    (tmp_path / "cut.pt").write_bytes(whole[:1000])
    (tmp_path / "text.pt").write_text("not a checkpoint")
    (tmp_path / "code.pt").write_bytes(pickle.dumps(os.system))
    torch.save({"model": 1}, tmp_path / "other.pt")
    model = ppo.ActorCritic(obs_dim=7, act_dim=2)
    meta = {"tg": True, "lidar": True, "paper": [], "tasks": ["flat"], "sequential": False}
    ppo.save_checkpoint(tmp_path / "sizes.pt", model, ppo.PPOConfig(), meta=meta)
    ppo.save_checkpoint(tmp_path / "silent.pt", model, ppo.PPOConfig())
    for name in ("cut", "text", "code", "other", "sizes", "silent"):
        assert loco_mtrl.main(["eval", str(tmp_path / f"{name}.pt")]) == 2
        error = capsys.readouterr().err
        assert f"{name}.pt" in error and error.count("\n") == 1


def test_a_run_is_not_overwritten(trained):
    result = run("train", "--tasks", "flat", "--steps", 100, "--run-dir", trained, cwd=trained)
    assert result.returncode == 2
    assert "already holds a run" in result.stderr and "Traceback" not in result.stderr


def test_help_names_every_command(tmp_path):
    result = run("--help", cwd=tmp_path)
    assert result.returncode == 0
    for command in ("train", "eval", "play", "gallery"):
        assert command in result.stdout
