"""Whatever stops a training, wherever it is: the last checkpoint is whole, and resuming goes on."""

import contextlib
import io
import os
import re
import resource
import select
import signal
import socket
import sys
import time
from argparse import Namespace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from test_ppo import Probe, same_bits, states, table
from torch.distributed.launcher.api import LaunchConfig, elastic_launch

import loco_mtrl
import ppo

ROOT = Path(loco_mtrl.__file__).parent
TINY = {"num_envs": 2, "num_steps": 8, "num_minibatches": 2, "hidden": (8,), "checkpoint_every": 1}
UPDATE = 2 * 7  # rows: 8 steps of 2 envs, whose 6th is a reset


class Stop(Exception):
    pass


def train(folder, stop=None, resume=False, total=3, env=Probe, changes=None, **options):
    """A training of `total` updates that saves after each, or of `stop`; returns the states."""
    config = ppo.PPOConfig(**TINY | (changes or {}), total_timesteps=total * UPDATE)

    def on_update(model, row):
        if row["update"] == stop:
            raise Stop

    options = {"on_update": on_update, "meta": {"a": 1}} | options
    make = lambda index, steps: env(lambda obs, action, t: obs[0] * action, length=5)  # noqa: E731
    try:
        return states(ppo.learn(make, config, run_dir=folder, resume=resume, **options)[0])
    except Stop:
        return None


def go_on(folder, **options):
    """What a person does after a crash: resumes or, before the first checkpoint, starts again."""
    return train(folder, resume=(folder / "checkpoint.pt").exists(), **options)


def test_means_go_on_after_a_resume(tmp_path):
    """Those of episodes that ended before the checkpoint count as if nothing had stopped."""
    train(tmp_path / "a")
    train(tmp_path / "b", stop=1)
    train(tmp_path / "b", resume=True)
    columns = [[row["return"] for row in table(tmp_path / name)] for name in "ab"]
    assert columns[0] == columns[1] and len(set(columns[0])) == 3


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Parameters after three updates that nothing has stopped."""
    return train(tmp_path_factory.mktemp("unbroken"))


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def in_a_child(function):
    """Runs `function` in a process of its own; returns its exit code, -9 if it was killed."""
    child = get_context("fork").Process(target=function)
    child.start()
    child.join(60)
    child.kill()
    child.join()
    return child.exitcode


def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)


# ---------------------------------------------------------------- killed, wherever it is


WRITERS = [function.__code__ for function in (
    ppo.RunFolder.__init__, ppo.RunFolder.log, ppo.RunFolder.save, ppo.save, ppo.write_whole)]


@pytest.mark.parametrize("stop", [None, 1], ids=["fresh", "resumed"])
def test_killed_before_any_line_that_writes(stop, tmp_path, unbroken):
    """Before every third line, from the first that opens the folder to the last save."""
    def trace(frame, event, _):
        nonlocal left
        left -= event == "line" and frame.f_code in WRITERS
        if not left:
            die()
        return trace if frame.f_code in WRITERS else None

    def doomed():
        sys.settrace(trace)
        go_on(folder, stop=2)

    for moment in range(1 + bool(stop), 99, 3):
        folder, left = tmp_path / str(moment), moment
        if stop:
            train(folder, stop=stop)
        code = in_a_child(doomed)
        assert same_bits(go_on(folder), unbroken)
        assert [row["update"] for row in table(folder)] == ["1", "2", "3"]
        if code == 0:  # it came to its end
            break
        assert code == -9
    assert 30 < moment < 90


class Dying(io.FileIO):
    """A file whose disk takes `left` bytes, and then the process is killed."""

    def write(self, data):
        super().write(bytes(data)[: self.left])
        self.left -= len(data)
        if self.left <= 0:
            die()
        return len(data)


@pytest.mark.parametrize("share", [0.0, 0.03, 0.4, 0.8, 0.999])
@pytest.mark.parametrize("saved", [0, 1])
def test_killed_in_the_midst_of_a_checkpoint(share, saved, tmp_path, unbroken, monkeypatch):
    train(tmp_path, stop=1)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    if not saved:
        (tmp_path / "checkpoint.pt").unlink()

    def open_(path, mode="r", **how):
        if "checkpoint" not in str(path):
            return open(path, mode, **how)
        file = Dying(path, mode)
        file.left = round(share * len(before))
        return file

    with monkeypatch.context() as patch:
        patch.setattr(ppo, "open", open_, raising=False)
        assert in_a_child(lambda: go_on(tmp_path)) == -9
    assert saved == (tmp_path / "checkpoint.pt").exists()
    assert not saved or (tmp_path / "checkpoint.pt").read_bytes() == before
    assert same_bits(go_on(tmp_path), unbroken)


@pytest.mark.parametrize("room", [100, 1000, 9000])  # not enough for any file, the last, all of it
def test_a_full_disk_leaves_the_last_checkpoint(room, tmp_path, unbroken):
    def full():
        sys.stderr = open(os.devnull, "w")  # or pytest's own file would be full, too
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
        with pytest.raises(OSError, match="File too large"):
            train(tmp_path, resume=True)

    train(tmp_path, stop=1)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    assert in_a_child(full) == 0 and len(before) > 9000
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    assert not list(tmp_path.glob("*.tmp"))
    assert same_bits(train(tmp_path, resume=True), unbroken)


@pytest.mark.parametrize("damage", [None, "", "upd", "update,steps\n1,2\n9,99\n"])
def test_a_damaged_table_is_written_anew(damage, tmp_path, unbroken):
    train(tmp_path, stop=1)
    (tmp_path / "progress.csv").unlink()
    if damage is not None:
        (tmp_path / "progress.csv").write_text(damage)
    assert same_bits(train(tmp_path, resume=True), unbroken)
    assert [int(row["steps"]) for row in table(tmp_path)] == [UPDATE, 2 * UPDATE, 3 * UPDATE]


# ---------------------------------------------------------------- stopped and resumed


def test_stages_in_turn_make_the_run_in_one_piece(tmp_path, unbroken):
    seen, config = [], ppo.PPOConfig(total_timesteps=3 * UPDATE, **TINY)

    def make(index, steps):
        seen.append((index, steps))
        return Probe(lambda obs, action, t: obs[0] * action, length=5)

    for number in range(3):
        model, steps = ppo.learn(make, config, run_dir=tmp_path, resume=number > 0,
                                 stage_end=lambda steps: steps + 1)
        assert steps == (number + 1) * UPDATE
    assert same_bits(states(model), unbroken)
    assert seen == [(index, number * UPDATE) for number in range(3) for index in range(2)]


def test_a_run_is_not_opened_twice(tmp_path):
    """Neither before its first checkpoint nor after it, and nothing is touched."""
    def refused(resume):
        before = content(tmp_path)
        with pytest.raises(BlockingIOError, match="another process is training in"):
            train(tmp_path, resume=resume)
        assert content(tmp_path) == before
        tries.append(resume)

    class Nosy(Probe):
        def __init__(self, *args, **options):
            super().__init__(*args, **options)
            refused(False)

    tries = []
    train(tmp_path, total=1, env=Nosy, on_update=lambda *_: refused(True))
    assert tries == [False] * 2 + [True]


def test_a_failed_training_lets_its_folder_go(tmp_path, unbroken):
    def fail(*_):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as kept:  # its traceback still knows all of `learn`
        train(tmp_path, on_update=fail)
    assert same_bits(train(tmp_path, resume=True), unbroken) and kept


def test_what_does_not_fit_is_refused_before_anything_is_touched(tmp_path):
    train(tmp_path, stop=1)
    before = content(tmp_path)
    for kind, named, options in (
            (FileExistsError, "already holds a run", {}),
            (ValueError, r"holds another run: \{'a': 1\}", {"resume": True, "meta": {"a": 2}}),
            (TypeError, "JSON", {"resume": True, "meta": {"a": 1j}})):
        with pytest.raises(kind, match=named):
            train(tmp_path, **options)
        assert content(tmp_path) == before
    with pytest.raises(ValueError, match="no run_dir to go on from"):
        train(None, resume=True)
    with pytest.raises(ValueError, match=r"network is .*\[8\].* asked for is .*\[9\]"):
        train(tmp_path, resume=True, changes={"hidden": (9,)})
    model, _ = ppo.load_policy(tmp_path / "checkpoint.pt")
    ppo.save_policy(tmp_path / "checkpoint.pt", model, {"a": 1})
    with pytest.raises(ValueError, match="holds another run"):  # a policy is no checkpoint
        train(tmp_path, resume=True)
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        train(tmp_path / "new", resume=True)
    assert not (tmp_path / "new").exists()


def test_ctrl_c_finishes_the_update_and_keeps_it(tmp_path, unbroken):
    def interrupt(model, row):
        if row["update"] == 1:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, on_update=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    assert ppo.load_checkpoint(tmp_path / "checkpoint.pt")["history"][-1]["steps"] == 2 * UPDATE
    assert len(table(tmp_path)) == 2
    assert same_bits(train(tmp_path, resume=True), unbroken)


def test_a_second_ctrl_c_stops_at_once_and_the_last_checkpoint_is_whole(tmp_path, unbroken):
    class Impatient(Probe):
        def step(self, action):
            steps.append(action)
            if len(steps) == 2 * UPDATE + 5:  # in the third update
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGINT)
            return super().step(action)

    steps = []
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, env=Impatient)
    assert len(steps) == 2 * UPDATE + 5
    assert ppo.load_checkpoint(tmp_path / "checkpoint.pt")["history"][-1]["update"] == 2
    assert same_bits(train(tmp_path, resume=True), unbroken)


# ---------------------------------------------------------------- many processes

started = []


@pytest.fixture(scope="module", autouse=True)
def no_orphans():
    """Even where a test has failed."""
    yield
    for process in started:
        with contextlib.suppress(psutil.NoSuchProcess):
            for child in psutil.Process(process.pid).children(recursive=True):
                child.kill()
        process.kill()


def start(main, **environment):
    """Forks a process for main(); returns it, and the pipe of all that it and its children say."""
    reader, writer = os.pipe()

    def child():
        os.environ.update(environment, OMP_NUM_THREADS="1", PYTHONPATH=f"{ROOT}:{ROOT / 'tests'}")
        os.dup2(writer, 1), os.dup2(writer, 2), os.close(writer)
        sys.stdout = sys.stderr = open(2, "w", buffering=1, closefd=False)
        sys.exit(main())

    process = get_context("fork").Process(target=child)
    process.start()
    os.close(writer)
    started.append(process)
    return process, reader


def read(process, until=None, seconds=200):
    """What the process says until a word, or until it and all its children are gone."""
    (process, reader), end, text = process, time.monotonic() + seconds, b""
    while until is None or until.encode() not in text:
        if not select.select([reader], [], [], end - time.monotonic())[0]:
            pytest.fail(f"still running after {seconds} s: {text.decode()}")
        if not (said := os.read(reader, 4096)):
            process.join()
            os.close(reader)
            assert until is None, text
            break
        text += said
    return text.decode()


JOB = """
import os, sys
from dataclasses import dataclass
import loco_mtrl

@dataclass(frozen=True)
class Tiny(loco_mtrl.PPOConfig):
    num_envs: int = 2
    num_steps: int = 8
    num_minibatches: int = 2

loco_mtrl.PPOConfig, loco_mtrl.LAYOUTS, loco_mtrl.STAGE = Tiny, 1, int(os.environ["STAGE"])
os.write(1, f"rank {os.getpid()}\\n".encode())  # at once, lest the ranks' words mix
sys.exit(loco_mtrl.main())
"""


@pytest.fixture
def job(tmp_path, monkeypatch):
    """Starts the command line for a tiny training of two ranks, with another length of a stage."""
    def begin(stage, *arguments):
        command = ["train", "--tasks", "flat", "--no-lidar", "--ranks", "2", "--run-dir",
                   str(tmp_path / "run"), *map(str, arguments)]
        return start(lambda: loco_mtrl.main(command), STAGE=str(stage))

    (tmp_path / "job.py").write_text(JOB)
    monkeypatch.setattr(loco_mtrl, "__file__", str(tmp_path / "job.py"))
    return begin


def test_after_each_stage_every_process_starts_itself_afresh(job, tmp_path):
    process = job(40, "--steps", 64)  # of 16 steps each: three updates, and one
    text = read(process)
    assert process[0].exitcode == 0 and "policy.pt" in text, text
    ranks = re.findall(r"rank (\d+)\n", text)
    assert len(ranks) == 4 and len(set(ranks)) == 2, text
    assert [row["steps"] for row in table(tmp_path / "run")] == ["16", "32", "48", "64"]


def test_a_killed_rank_ends_the_training_with_one_message(job, tmp_path):
    process = job(10**9)
    read(process, until="32/")  # two updates
    ranks = psutil.Process(process[0].pid).children()
    ranks[1].kill()
    text = read(process)  # to its end: nobody is left that could write
    assert not any(rank.is_running() for rank in ranks)
    assert process[0].exitcode == 2, text
    assert "rank 1 was killed by signal 9. To go on" in text.splitlines()[-1]
    assert text.splitlines()[-1].endswith(f"--run-dir {tmp_path / 'run'} --resume")
    assert "Traceback" not in text
    assert ppo.load_checkpoint(tmp_path / "run" / "checkpoint.pt")["history"][-1]["update"] >= 1


def test_after_ctrl_c_a_slow_rank_gets_all_the_time_that_its_update_takes(monkeypatch):
    class Rank:
        def __init__(self, command, env):
            self.code = 130 if env["RANK"] == "0" else None

        def poll(self):
            return self.code

        def wait(self, timeout):
            waits.append(timeout)
            self.code = 130

        def kill(self):
            assert self.code == 130

    waits = []
    monkeypatch.setattr(loco_mtrl.subprocess, "Popen", Rank)
    assert loco_mtrl.main(["train", "--ranks", "2"]) == 130
    assert waits == [None, None]


@pytest.mark.parametrize("program", ["loco-mtrl", "python loco_mtrl.py"])
def test_killed_ranks_are_all_named_and_the_program_as_it_was_called(
        tmp_path, monkeypatch, capsys, program):
    (tmp_path / "job.py").write_text("import os; os.kill(os.getpid(), 9)")
    monkeypatch.setattr(loco_mtrl, "__file__", str(tmp_path / "job.py"))
    monkeypatch.setattr(sys, "argv", [f"/somewhere/{program.split()[-1]}", "train"])
    monkeypatch.setenv("LOCO_MTRL", "")  # put back after the test
    assert loco_mtrl.main(["train", "--ranks", "2"]) == 9
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all(
        f"error: rank {k} was killed by signal 9" in line for k, line in enumerate(lines))
    assert all(line.endswith(f"checkpoint: {program} train --ranks 2 --resume") for line in lines)


def rank_of_torchrun(folder, crashes):
    """What a process that torchrun starts does here: trains, and writes down its states."""
    again, rank = os.environ["TORCHELASTIC_RESTART_COUNT"] != "0", os.environ["RANK"]

    def on_update(model, row):
        if crashes and not again and row["update"] == 2:
            die()

    model = train(f"{folder}/run", total=3 * 2, changes={"num_envs": 4}, resume=again,
                  on_update=on_update)
    torch.save([model, again], f"{folder}/rank{rank}.pt")


@pytest.fixture(scope="module")
def ranks_of_torchrun(tmp_path_factory):
    """States of two ranks that torchrun's agents start: of two agents, and of one, with a crash.

    As `python -m torch.distributed.run` does, but for its agents, which are forked to save seconds.
    Ranks must not be: a fork of an agent keeps what its threads have locked, now and then for ever.
    """
    def all_ranks(agents, crashes):
        folder = tmp_path_factory.mktemp("torchrun")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        config = LaunchConfig(
            min_nodes=agents, max_nodes=agents, nproc_per_node=2 // agents, max_restarts=crashes,
            rdzv_backend="c10d", rdzv_endpoint=f"127.0.0.1:{port}", run_id="test",
            monitor_interval=0.1)
        command = f"import test_faults; test_faults.rank_of_torchrun({str(folder)!r}, {crashes})"
        launch = elastic_launch(config, sys.executable)
        for process in [start(lambda: launch("-c", command) and 0) for _ in range(agents)]:
            text = read(process)
            assert process[0].exitcode == 0, text
        assert [row["update"] for row in table(folder / "run")] == ["1", "2", "3"]
        return [torch.load(folder / f"rank{rank}.pt") for rank in range(2)]

    return all_ranks(2, 0), all_ranks(1, 1)


def test_two_agents_train_what_one_does_that_crashes(ranks_of_torchrun):
    """Under --max-restarts it goes on from its checkpoint."""
    two, one = ranks_of_torchrun
    for state, again in two:
        assert same_bits(state, two[0][0]) and not again
    for state, again in one:
        assert same_bits(state, two[0][0]) and again


# ---------------------------------------------------------------- the robot


def walk(folder, monkeypatch, stop=None, resume=False):
    """Six updates of two robots with LiDAR and symmetry, in two stages."""
    monkeypatch.setattr(loco_mtrl, "LAYOUTS", 1)
    monkeypatch.setattr(loco_mtrl, "STAGE", 128)
    args = Namespace(tg=True, lidar=True, tasks=["stairs", "obstacles"], sequential=False, seed=0,
                     steps=192)
    config = ppo.PPOConfig(num_envs=2, num_steps=16, total_timesteps=192, checkpoint_every=2,
                           n_scan=loco_mtrl.N_RAYS, num_minibatches=2, hidden=(16,))
    mirror = tuple(map(loco_mtrl.mirror, (loco_mtrl.observation_parts(), loco_mtrl.action_parts())))

    def on_update(model, row):
        if row["update"] == stop:
            raise Stop

    steps = 0
    while steps < 192:
        model, steps = ppo.learn(
            partial(loco_mtrl.training_env, args=args), config, run_dir=folder, mirror=mirror,
            resume=resume or steps > 0, episode_keys=("t_cr",), on_update=on_update,
            stage_end=lambda n: loco_mtrl.stage(n, args)[2])
    return states(model)


def test_a_robots_training_is_the_same_twice_and_after_a_stop(tmp_path, monkeypatch):
    once, twice = (walk(tmp_path / name, monkeypatch) for name in "ab")
    with pytest.raises(Stop):
        walk(tmp_path / "c", monkeypatch, stop=3)  # one update after a checkpoint
    assert same_bits(once, twice)
    assert same_bits(once, walk(tmp_path / "c", monkeypatch, resume=True))
    tables = [[{key: value for key, value in row.items() if key not in (
        "minutes", "collect_s", "learn_s")} for row in table(tmp_path / name)] for name in "abc"]
    assert tables[0] == tables[1] == tables[2] and len(tables[0]) == 6


def test_memory_stays_flat_over_many_episodes():
    env = loco_mtrl.LocoEnv(["flat", "stairs"], lidar=False)
    process, sizes = psutil.Process(), []
    action = np.full(env.action_space.shape, 0.3)
    for episode in range(801):
        env.reset(seed=episode if episode % 2 else None)
        env.step(action)
        if episode in (200, 800):
            sizes.append(process.memory_info().rss)
    env.close()
    assert sizes[1] - sizes[0] < 1e6
