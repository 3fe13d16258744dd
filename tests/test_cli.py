"""The command line as a user calls it, and each wrong call."""

import csv
import dataclasses
import json
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import loco_mtrl
import ppo

ROOT = Path(loco_mtrl.__file__).parent


@dataclasses.dataclass(frozen=True)
class Small(ppo.PPOConfig):
    num_envs: int = 2
    num_steps: int = 16


def shrink(patch=setattr):
    """From now on an update takes 32 steps of 2 environments, each with one layout."""
    patch(loco_mtrl, "PPOConfig", Small)
    patch(loco_mtrl, "LAYOUTS", 1)


@pytest.fixture
def small(monkeypatch, tmp_path):
    """`main` trains as rank 0 of 1, in this process and on little, in a folder of its own."""
    shrink(monkeypatch.setattr)
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "1"), ("PPO_STAGE", "0")):
        monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two ranks on flat ground."""
    run = tmp_path_factory.mktemp("runs") / "a"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loco_mtrl, "__file__", __file__)  # what the ranks run
        assert loco_mtrl.main(["train", "--tasks", "flat", "--steps", "60", "--ranks", "2",
                               "--run-dir", str(run)]) == 0
    return run


def interrupt(program, word, *arguments, cwd):
    """Exit code, output and errors of a program that gets Ctrl-C once it says `word`."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, str(program), *arguments], cwd=cwd, env=environment, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)
    try:
        said = ""
        while word not in said:  # a progress bar ends no line
            said += process.stderr.read(1) or pytest.fail(f"no {word!r} in {said}")
        os.killpg(process.pid, signal.SIGINT)  # to all, as a terminal does
        out, error = process.communicate(timeout=100)
        return process.returncode, out, said + error
    finally:
        process.kill()


def progress(run):
    with open(run / "progress.csv", newline="") as file:
        return list(csv.DictReader(file))


def config(run):
    return json.loads((run / "config.json").read_text())


def test_training_leaves_what_a_person_needs(trained):
    names = {"config.json", "progress.csv", "checkpoint.pt", "policy.pt", "curve.png"}
    assert names <= {file.name for file in trained.iterdir()} <= names | {"lock"}
    rows = progress(trained)
    assert [int(row["steps"]) for row in rows] == [32, 64]
    assert float(rows[-1]["collect_s"]) > 0 and float(rows[-1]["approx_kl"]) >= 0
    assert config(trained)["meta"] == {"tg": True, "lidar": True, "tasks": ["flat"],
                                       "sequential": False, "seed": 0}
    assert config(trained)["ppo"]["total_timesteps"] == 60
    assert (trained / "policy.pt").stat().st_size < 3e5
    whole, shared = (ppo.load_policy(trained / name)[0] for name in ("checkpoint.pt", "policy.pt"))
    seen = np.random.default_rng(0).uniform(0, 1, (50, 202))
    assert np.abs(whole.mean_action(seen) - shared.mean_action(seen)).max() < 1e-3


@pytest.mark.parametrize(("flags", "n_obs", "n_scan", "n_act", "kind"), [
    ("--no-tg", 189, 160, 12, "reactive"), ("--no-lidar", 42, 0, 17, "no vision"),
    ("--tasks stairs", 202, 160, 17, "stairs"), ("--tasks flat,holes", 202, 160, 17, "ours"),
])
def test_ablations_give_policies_of_their_kind(small, tmp_path, flags, n_obs, n_scan, n_act, kind):
    arguments = ["train", *flags.split(), "--steps", "20", "--seed", "3", "--run-dir", "run"]
    assert loco_mtrl.main(arguments) == 0
    act, options, row = loco_mtrl.load_actor(str(tmp_path / "run" / "policy.pt"))
    assert row == kind and row in loco_mtrl.PAPER
    assert options == {"tg": "--no-tg" not in flags, "lidar": "--no-lidar" not in flags}
    assert act(np.zeros(n_obs)).shape == (n_act,)
    told = config(tmp_path / "run")
    assert (told["ppo"]["n_scan"], told["ppo"]["seed"]) == (n_scan, 3)


def test_sequential_training_takes_each_task_in_a_new_process(small, monkeypatch, tmp_path):
    stages, programs, make = [], [], loco_mtrl.training_env

    def execv(*command):
        programs.append(command)
        raise SystemExit

    def training_env(index, steps, args):
        env = make(index, steps, args)
        stages.append((steps, env.unwrapped.pool[0].name))
        return env

    monkeypatch.setattr(os, "execv", execv)
    monkeypatch.setattr(loco_mtrl, "training_env", training_env)
    arguments = ["train", "--sequential", "--tasks", "flat,stairs", "--steps", "60"]
    with pytest.raises(SystemExit):
        loco_mtrl.main(arguments)
    assert programs == [(sys.executable, [sys.executable, *sys.orig_argv[1:]])]
    assert loco_mtrl.main(arguments) == 0  # the new process: it knows its stage
    assert stages == [(0, "flat")] * 2 + [(32, "stairs")] * 2
    assert [int(row["steps"]) for row in progress(tmp_path / "runs/main")] == [32, 64]
    assert loco_mtrl.load_actor(str(tmp_path / "runs/main/policy.pt"))[2] == "sequential"
    first, _ = ppo.load_policy(tmp_path / "runs/main/policy-1.pt")  # after one task
    assert first.normaliser.count == 2 * 32


def test_resume_goes_on_and_so_does_a_longer_run(small, trained, tmp_path, capsys):
    run = shutil.copytree(trained, tmp_path / "run")
    command = ["train", "--tasks", "flat", "--ranks", "2", "--run-dir", str(run), "--steps"]
    assert loco_mtrl.main([*command, "60"]) == 2
    assert "already holds a run" in capsys.readouterr().err and progress(run) == progress(trained)
    (run / "policy.pt").unlink()  # Ctrl-C in the very last update: all is learned, nothing shared
    assert loco_mtrl.main([*command, "60", "--resume"]) == 0 and (run / "policy.pt").is_file()
    assert loco_mtrl.main([*command, "90", "--resume"]) == 0
    assert [int(row["steps"]) for row in progress(run)] == [32, 64, 96]
    assert progress(run)[:2] == progress(trained)
    assert config(run)["ppo"]["total_timesteps"] == 90
    # The noise is that of 64 of 90 steps, not that of a beginning.
    first, last = config(run)["ppo"]["noise"]
    stds = [float(row["std"]) for row in progress(run)]
    assert stds[2] / stds[0] == pytest.approx((first + (last - first) * 64 / 90) / first)


@pytest.mark.parametrize(("at", "times", "updates"), [
    (40, 1, 2),  # once: to the end of this update
    (40, 2, 1),  # twice: at once
    (1, 2, 0),  # before there is anything to go on from
])
def test_ctrl_c_says_how_to_go_on(small, monkeypatch, capsys, tmp_path, at, times, updates):
    step, steps = loco_mtrl.LocoEnv.step, []

    def interrupted(env, action):
        steps.append(action)
        for _ in range(times if len(steps) == at else 0):
            os.kill(os.getpid(), signal.SIGINT)
        return step(env, action)

    monkeypatch.setattr(loco_mtrl.LocoEnv, "step", interrupted)
    command = ["train", "--tasks", "flat", "--steps", "90", "--run-dir", "a run"]
    assert loco_mtrl.main(command) == 130
    out, error = capsys.readouterr()
    assert "Traceback" not in error
    if not updates:
        assert out == "\nStopped.\n"
        return
    words = shlex.split(out.removeprefix("\nStopped. To go on: "))
    assert words == ["python", "loco_mtrl.py", *command, "--resume"]
    saved = ppo.load_checkpoint(tmp_path / "a run" / "checkpoint.pt")["history"]
    assert len(saved) == len(progress(tmp_path / "a run")) == updates
    assert loco_mtrl.main(words[2:]) == 0
    assert [int(row["steps"]) for row in progress(tmp_path / "a run")] == [32, 64, 96]


def test_ctrl_c_stops_all_ranks_after_the_running_update(tmp_path):
    command = "train --tasks flat --ranks 2"
    code, out, error = interrupt(__file__, "t_cr", *command.split(), cwd=tmp_path)
    assert code == 130 and "Traceback" not in error
    assert out == f"\nStopped. To go on: python loco_mtrl.py {command} --resume\n"
    rows, run = progress(tmp_path / "runs" / "main"), tmp_path / "runs" / "main"
    saved = ppo.load_checkpoint(run / "checkpoint.pt")["history"]
    assert (len(saved), saved[-1]["steps"]) == (len(rows), int(rows[-1]["steps"]))


@pytest.fixture
def scan(tmp_path):
    """A closed room of 8 x 6 x 3 m, in centimetres and with y up."""
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((800, 300, 600)).export(tmp_path / "hall.obj")
    return ["--scan", str(tmp_path / "hall.obj"), "--scale", "0.01", "--up", "y"]


@pytest.mark.parametrize(("upright", "up", "hint"), [
    (True, "z", None), (False, "y", None), (False, "z", "--up y"), (True, "y", "--up z")])
def test_a_scan_that_lies_on_its_side_gets_a_hint(upright, up, hint, tmp_path, capsys):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((8, 6, 3) if upright else (8, 3, 6)).export(tmp_path / "hall.ply")
    args = loco_mtrl.parse(["eval", "zero", "--scan", str(tmp_path / "hall.ply"), "--up", up])
    place = loco_mtrl.open_scan(args)
    first, *rest = capsys.readouterr().err.splitlines()
    assert first.startswith("hall: " + " x ".join(f"{side:.1f}" for side in np.ptp(
        place.vertices, 0)))
    assert rest == ([f"It may lie on its side: if so, {hint}"] if hint else [])


def test_eval_prints_the_same_table_twice_and_with_more_workers(trained, tmp_path, scan, capfd):
    """In a scanned building: its worlds are for `test_the_table_by_hand`, and for Ctrl-C."""
    policy, tables, reports = str(trained / "policy.pt"), [], []
    for workers in ("1", "2"):
        file = tmp_path / f"{workers}.json"
        assert loco_mtrl.main(["eval", policy, "straight", *scan, "--episodes", "1", "--ranks",
                               workers, "--json", str(file)]) == 0
        tables.append(capfd.readouterr().out)  # of the workers, too: no banners
        reports.append(json.loads(file.read_text()))
    assert tables[0] == tables[1] and reports[0] == reports[1]
    words, hall = [line.split() for line in tables[0].splitlines()], reports[0]["worlds"]["hall"]
    assert words[0] == ["hall"] and words[1] == ["t_cr", f"{hall['t_cr']:.2f}"] and len(words) == 9
    assert set(hall) == {"t_cr", "std", "success", "fall", "collisions", "seconds", "per_policy"}
    assert reports[0]["policies"] == [policy, "straight"] and reports[0]["episodes"] == 1
    assert hall["per_policy"][1] == 1.0  # on a level floor, the goal ahead, no luck is needed
    assert reports[0]["mean_t_cr"] == pytest.approx(np.mean(hall["per_policy"]))


def test_the_table_by_hand(monkeypatch, capsys, trained):
    """t_cr of 0.2, 0.6 and 1.0, 0.4: mean 0.55, variance (.35^2 + .05^2 + .45^2 + .15^2) / 4."""
    policy = str(trained / "policy.pt")

    def evaluate(actors, places, n_episodes, workers):
        assert (n_episodes, workers) == (2, 3)
        scores = {policy: (0.2, 0.6), "zero": (1.0, 0.4)}
        return {(actor, place): [{"t_cr": t_cr, "success": float(t_cr == 1), "fall": 0.0,
                                  "collisions": 2.0, "seconds": 30.0} for t_cr in scores[actor]]
                for place in places for actor in actors}

    monkeypatch.setattr(loco_mtrl, "evaluate", evaluate)
    counts = ["--episodes", "2", "--ranks", "3"]
    assert loco_mtrl.main(["eval", policy, "zero", *counts]) == 0
    table = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert table[0] == list(loco_mtrl.WORLDS)
    assert table[1:7] == [["t_cr", *["0.55"] * 8], ["std", *["0.30"] * 8],
                          ["success", *["0.25"] * 8], ["fall", *["0.00"] * 8],
                          ["collisions", *["2.00"] * 8], ["seconds", *["30.00"] * 8]]
    assert table[7] == "paper: flat 0.39 0.22 0.54 0.51 0.50 0.43 0.32 0.57".split()
    assert table[8] == "paper: std 0.17 0.21 0.12 0.16 0.12 0.13 0.18 0.12".split()
    assert table[9:] == [["mean", "t_cr", "0.400", policy], ["mean", "t_cr", "0.700", "zero"]]
    for others in (["zero"], [policy, "--worlds", "maze,forest"]):  # the paper says nothing of them
        assert loco_mtrl.main(["eval", *others, *counts]) == 0
        assert "paper" not in capsys.readouterr().out


def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_killed_worker_ends_eval_with_one_line(monkeypatch, capfd):
    monkeypatch.setattr(loco_mtrl, "score", die)
    assert loco_mtrl.main(["eval", "zero", "--episodes", "3", "--ranks", "1"]) not in (0, None)
    out, error = capfd.readouterr()
    assert "Traceback" not in error and "terminated" in error.splitlines()[-1] and not out


def test_ctrl_c_in_eval_prints_no_traceback(tmp_path):
    code, out, error = interrupt(
        ROOT / "loco_mtrl.py", "1/90", "eval", "straight", "--worlds", "flat", "--episodes", "90",
        "--ranks", "1", "--json", "scores.json", cwd=tmp_path)
    assert code == 130 and "Stopped." in error and "Traceback" not in error and not out
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_in_play_prints_no_traceback_and_leaves_no_file(tmp_path):
    code, out, error = interrupt(ROOT / "loco_mtrl.py", "1/60 s", "play", "straight", cwd=tmp_path)
    assert code == 130 and "Stopped." in error and "Traceback" not in error and not out
    assert list(tmp_path.iterdir()) == []


def test_a_script_without_a_main_guard_ends(tmp_path):
    """The workers import the script, which must not start workers of its own for ever."""
    script = tmp_path / "mine.py"
    script.write_text("from loco_mtrl import evaluate\nevaluate(['zero'], ['flat'], 1, 1)\n")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=100,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 1 and "__main__" in done.stderr and "BrokenProcessPool" in done.stderr


@pytest.mark.parametrize("closed", ["1", "2", "012"])
def test_it_can_be_imported_without_output(closed):
    close = "".join(f"exec {stream}>&-; " for stream in closed)
    done = subprocess.run(["bash", "-c", f"{close} {sys.executable} -c 'import loco_mtrl'"],
                          cwd=ROOT, timeout=100)
    assert done.returncode == 0


def test_play_writes_a_gif_that_moves(scan, tmp_path, capsys, monkeypatch):
    Image = pytest.importorskip("PIL.Image")
    monkeypatch.setattr(loco_mtrl, "EVAL_SECONDS", 3)
    monkeypatch.chdir(tmp_path)
    assert loco_mtrl.main(["play", "straight", *scan]) == 0
    said, error = capsys.readouterr()
    said = said.splitlines()
    assert "hall: 6.0 x 8.0 x 3.0 m; its floor lies 0.00 m above the lowest point\n" in error
    assert said[0].startswith("hall: t_cr 0.") and said[0].endswith("ran out of time after 3.0 s")
    assert said[1:] == ["play.gif"]
    assert {path.name for path in tmp_path.iterdir()} == {"play.gif", "hall.obj"}
    with Image.open("play.gif") as gif:
        assert gif.n_frames == 16 and gif.info["duration"] == 200  # 5 a second, as time goes by
        frames = []
        for k in (0, 15):
            gif.seek(k)
            frames.append(np.asarray(gif.convert("RGB"), dtype=int))
    assert frames[0].shape == (300, 400, 3) and np.abs(frames[0] - frames[1]).mean() > 1


def test_gallery_draws_every_terrain(tmp_path, capsys):
    Image = pytest.importorskip("PIL.Image")
    assert loco_mtrl.main(["gallery", "--out", str(tmp_path / "all.png")]) == 0
    assert capsys.readouterr().out == f"{tmp_path}/all.png\n"
    with Image.open(tmp_path / "all.png") as picture:
        assert min(picture.size) > 500 and len(picture.convert("L").getcolors()) > 50


@pytest.mark.parametrize(("world", "seed"), [("mountain", 10013), ("continuous", 10004)])
def test_a_map_shows_the_way_even_where_it_is_found_only_from_the_start(world, seed):
    Figure = pytest.importorskip("matplotlib.figure").Figure
    axis, terrain = Figure().subplots(), loco_mtrl.make_world(world, seed)
    loco_mtrl.draw_map(axis, terrain)
    (way,) = [line for line in axis.lines if line.get_linestyle() == ":"]
    ends = way.get_xydata()[[-1, 0]]
    np.testing.assert_allclose(ends, [terrain.starts[0, :2], terrain.goals[0, :2]], atol=0.06)


@pytest.mark.parametrize(("command", "words"), [
    ("", ["train", "eval", "play", "gallery"]), ("train", [", ".join(loco_mtrl.PILLAR_TASKS)]),
    ("eval", [*loco_mtrl.REFERENCES, "--json"]), ("play", ["maze", "--scan"]),
    ("gallery", ["gallery.png"]),
])
def test_help_is_for_people(command, words, capsys):
    with pytest.raises(SystemExit) as stop:
        loco_mtrl.main([*command.split(), "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert stop.value.code == 0 and "['" not in said and "%" not in said
    for word in words:
        assert word in said


@pytest.mark.parametrize(("arguments", "named"), [
    ("fly", "fly"),
    ("train --tasks lava", "lava"), ("train --tasks flat,,holes", "unknown task ''"),
    *[(f"train --steps {bad}", bad) for bad in ("-5", "0", "many", "nan", "inf", "2.5", "1e6")],
    *[(f"train --seed {bad}", bad) for bad in ("x", "-1", "1e20", "9007199254740993", "0.5")],
    ("train --ranks 0", "'0'"), ("train --fast", "--fast"), ("train --no-lidar=1", "--no-lidar"),
    ("train --resume --run-dir nowhere", "nowhere"), ("train --run-dir /proc/nowhere", "/proc/"),
    ("train --run-dir /dev/null", "/dev/null"),
    ("eval", "POLICY"), ("eval nothing.pt", "nothing.pt"), ("eval .", "checkpoint at ."),
    ("eval zero --worlds moon", "moon"), ("eval zero --episodes 0", "'0'"),
    ("eval zero --json /proc/nowhere/scores.json", "/proc/nowhere"), ("eval zero --json .", "."),
    ("eval zero --ranks 1.5", "1.5"), ("eval zero --up x", "'x'"),
    ("eval zero --scan nothing.obj", "nothing.obj"), ("eval zero --scan /dev/null", "/dev/null"),
    (f"eval zero --scan {__file__}", "test_cli.py"),
    (f"play zero --scan {__file__} --scale 0", "0.0"),
    (f"play zero --scan {__file__} --scale nan", "nan"), ("play zero --scale big", "big"),
    ("play zero --world moon", "moon"), ("play zero --seed -3", "-3"), ("play", "POLICY"),
    ("play zero --gif /proc/nowhere/walk.gif", "/proc/nowhere"), ("play zero --gif a.png", "a.png"),
    ("play nothing.pt", "nothing.pt"),
    ("gallery --out /proc/nowhere/all.png", "/proc/nowhere"), ("gallery --out all.gif", "all.gif"),
    ("gallery --seed 0.5", "0.5"),
])
def test_wrong_calls_end_with_one_clear_line(small, arguments, named, capsys, tmp_path):
    try:
        code = loco_mtrl.main(arguments.split())
    except SystemExit as stop:
        code = stop.code
    out, error = capsys.readouterr()
    assert code == 2 and not out and "Traceback" not in error
    *usage, line = error.splitlines()
    assert "error: " in line and named in line
    assert not usage or usage[0].startswith("usage: ")  # argparse's, before its line
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_call_of_two_ranks_is_one_line_too(tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert loco_mtrl.main(["train", "--resume", "--run-dir", "nowhere", "--ranks", "2"]) == 2
    out, error = capfd.readouterr()
    assert "nowhere" in error and error.count("\n") == 1 and not out


def test_wrong_checkpoints_are_named(trained, tmp_path, capsys):
    whole = (trained / "checkpoint.pt").read_bytes()
    for name, content in (("cut", whole[:1000]), ("half", whole[: len(whole) // 2]), ("empty", b""),
                          ("text", b"not a checkpoint"), ("code", pickle.dumps(os.system))):
        (tmp_path / f"{name}.pt").write_bytes(content)
    torch.save({"model": 1}, tmp_path / "other.pt")
    model, meta = ppo.ActorCritic(obs_dim=77, act_dim=17), config(trained)["meta"]
    ppo.save_policy(tmp_path / "sizes.pt", model, meta)
    ppo.save_policy(tmp_path / "silent.pt", model, None)
    for path in sorted(tmp_path.iterdir()):
        assert loco_mtrl.main(["eval", str(path), "--ranks", "1"]) == 2
        out, error = capsys.readouterr()
        assert path.name in error and error.count("\n") == 1 and not out
        assert path.name != "sizes.pt" or "77" in error and "202" in error


if __name__ == "__main__":
    shrink()
    loco_mtrl.__file__ = __file__
    sys.exit(loco_mtrl.main())
