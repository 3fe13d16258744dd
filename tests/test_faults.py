"""Whatever stops a training, wherever it is: the last checkpoint is whole, and resuming goes on."""

import csv
import json
import os
import resource
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from test_ppo import SMALL, Probe, same_bits, states

import loco_mtrl
import ppo

ROOT = Path(loco_mtrl.__file__).parent


def train(folder, updates, resume=False, **options):
    """A small training that saves after every update, of 4 x 32 rows with some resets in them."""
    config = ppo.PPOConfig(total_timesteps=updates * 120, checkpoint_every=1, **SMALL)
    env = lambda index: Probe(lambda obs, action, t: obs[0] * action, length=20)  # noqa: E731
    return ppo.learn(env, config, run_dir=folder, resume=resume, episode_keys=(), **options)


def in_a_child(function):
    """Runs `function` in a process of its own; returns the signal that ended it, or 0."""
    child = os.fork()
    if not child:
        try:
            function()
        finally:
            os._exit(0)
    return os.WTERMSIG(os.waitpid(child, 0)[1])


def die(*_, **__):
    os.kill(os.getpid(), signal.SIGKILL)


# ---------------------------------------------------------------- killed while it saves


class Dying:
    """A file whose disk takes `left` bytes, and then the process is killed."""

    def __init__(self, path, mode, left):
        self.file, self.left = open(path, mode, buffering=0), left

    def write(self, data):
        self.file.write(bytes(data)[: self.left])
        self.left -= len(data)
        if self.left <= 0:
            die()
        return len(data)

    def __getattr__(self, name):
        return getattr(self.file, name)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.file.close()


@pytest.fixture(scope="module")
def run_of_two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    train(folder, 2)
    return folder


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """Parameters after four updates that nothing has stopped."""
    return states(train(tmp_path_factory.mktemp("unbroken"), 4))


MOMENTS = [*np.random.default_rng(0).uniform(0, 1, 17).round(3).tolist(), "fsync", "replace", "end"]


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_while_saving(moment, tmp_path, run_of_two, unbroken, monkeypatch):
    for file in run_of_two.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    size = (tmp_path / "checkpoint.pt").stat().st_size

    def third_update():
        if moment in ("fsync", "replace"):
            monkeypatch.setattr(os, moment, die)
        elif moment == "end":
            replace = os.replace
            monkeypatch.setattr(os, "replace", lambda *names: (replace(*names), die()))
        else:
            dying = lambda path, mode="r", **how: (  # noqa: E731
                Dying(path, mode, round(moment * size)) if mode == "wb"
                else open(path, mode, **how)
            )
            monkeypatch.setattr(ppo, "open", dying, raising=False)
        train(tmp_path, 3, resume=True)

    assert in_a_child(third_update) == signal.SIGKILL
    counters = ppo.load_checkpoint(tmp_path / "checkpoint.pt")["counters"]
    assert counters["update"] == (3 if moment == "end" else 2)
    resumed = train(tmp_path, 4, resume=True)
    assert same_bits(states(resumed), unbroken)


@pytest.mark.parametrize("full", ["checkpoint.pt.tmp", "progress.csv"])
def test_a_full_disk_leaves_the_last_checkpoint(full, tmp_path, unbroken):
    train(tmp_path, 2)
    before = (tmp_path / "checkpoint.pt").read_bytes()
    if full == "progress.csv":
        size = (tmp_path / full).stat().st_size
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limit[1]))
    else:
        (tmp_path / full).symlink_to("/dev/full")
    try:
        with pytest.raises(OSError, match="No space left|File too large"):
            train(tmp_path, 3, resume=True)
    finally:
        if full == "progress.csv":
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert (tmp_path / "checkpoint.pt").read_bytes() == before
    (tmp_path / "checkpoint.pt.tmp").unlink(missing_ok=True)
    assert same_bits(states(train(tmp_path, 4, resume=True)), unbroken)


def test_a_second_ctrl_c_stops_at_once_and_the_last_checkpoint_is_whole(tmp_path):
    class Impatient(Probe):
        def step(self, action):
            for _ in range(2 * (signals.count(True) == 300)):
                os.kill(os.getpid(), signal.SIGINT)
            signals.append(True)
            return super().step(action)

    signals = []
    config = ppo.PPOConfig(total_timesteps=9999, checkpoint_every=1, **SMALL)
    with pytest.raises(KeyboardInterrupt):
        ppo.learn(lambda index: Impatient(), config, run_dir=tmp_path, episode_keys=())
    assert len(signals) == 300  # in the third update, of 128 steps and resets each
    assert ppo.load_checkpoint(tmp_path / "checkpoint.pt")["counters"]["update"] < 5


# ---------------------------------------------------------------- killed ranks, lost machines


@pytest.mark.parametrize("victims", ["one rank", "all ranks"])
def test_killed_ranks_stop_the_training_with_one_message(victims, tmp_path):
    command = [sys.executable, str(ROOT / "loco_mtrl.py"), "train", "--tasks", "flat", "--ranks",
               "2", "--run-dir", str(tmp_path / "run")]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    bars = ""
    while "t_cr" not in bars:  # the bar names it after every update
        bars += process.stdout.read(20) or pytest.fail(bars)
    ranks = psutil.Process(process.pid).children()
    for rank in ranks[: 1 if victims == "one rank" else 2]:
        rank.kill()
    text, _ = process.communicate(timeout=30)
    assert process.returncode == 1
    assert "killed by signal 9" in text.splitlines()[-1] and "Traceback" not in text
    assert not any(rank.is_running() for rank in ranks)


AGENT = """
import os, sys
from pathlib import Path
from test_faults import train
from test_ppo import states
import torch
folder, rank = Path(sys.argv[1]), os.environ["RANK"]
first = os.environ["TORCHELASTIC_RESTART_COUNT"] == "0"
def fault(model, row):
    if sys.argv[2] == "crash" and first and row["update"] == 3:
        os.kill(os.getpid(), 9)
    if row["update"] == 2:
        print("two updates", flush=True)
model = train(folder / "run", int(sys.argv[3]), resume=not first, on_update=fault)
torch.save(states(model), folder / f"rank{rank}.pt")
if sys.argv[2] == "whole" and os.path.exists("/proc"):  # does closing the group end its threads?
    torch.distributed.destroy_process_group()
    threads = [file.read_text() for file in Path("/proc/self/task").glob("*/comm")]
    assert not any("gloo" in name for name in threads), threads
"""


def agents(folder, count, *arguments, restarts=0):
    """Starts `count` torchrun agents that share four ranks and a rendezvous on this machine."""
    folder.mkdir()
    (folder / "agent.py").write_text(AGENT)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "torch.distributed.run", "--nnodes", str(count),
               "--nproc-per-node", str(4 // count), "--max-restarts", str(restarts),
               "--rdzv-backend", "c10d", "--rdzv-endpoint", f"127.0.0.1:{port}",
               str(folder / "agent.py"), str(folder), *map(str, arguments)]  # fmt: skip
    paths = f"{ROOT}{os.pathsep}{ROOT / 'tests'}"
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    return [subprocess.Popen(command, env=environment, text=True, stdout=subprocess.PIPE,
                             stderr=subprocess.STDOUT) for _ in range(count)]  # fmt: skip


def test_two_agents_train_what_one_does(tmp_path):
    ends = []
    for name, count in (("one", 1), ("two", 2)):
        processes = agents(tmp_path / name, count, "whole", 3)
        for process in processes:
            text, _ = process.communicate(timeout=120)
            assert process.returncode == 0, text
        ends.append([torch.load(tmp_path / name / f"rank{rank}.pt") for rank in range(4)])
    for state in [*ends[0], *ends[1]]:
        assert same_bits(state, ends[0][0])


def test_a_crash_under_max_restarts_goes_on_from_the_checkpoint(tmp_path):
    (process,) = agents(tmp_path / "a", 1, "crash", 9, restarts=1)
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 0, text
    with open(tmp_path / "a" / "run" / "progress.csv", newline="") as file:
        updates = [int(row["update"]) for row in csv.DictReader(file)]
    assert updates == list(range(1, len(updates) + 1)) and len(updates) >= 3


def test_a_lost_agent_ends_the_other(tmp_path):
    one, two = agents(tmp_path / "a", 2, "endless", 10**6)
    line = ""
    while "two updates" not in line:
        line = one.stdout.readline() or two.stdout.readline() or pytest.fail("no update")
    for process in [*psutil.Process(two.pid).children(), psutil.Process(two.pid)]:
        process.kill()
    text, _ = one.communicate(timeout=30)
    two.communicate()
    assert one.returncode != 0 and "another rank was lost" in text


# ---------------------------------------------------------------- the same twice, and for long


def test_two_trainings_of_fifty_updates_are_equal(tmp_path):
    ends = []
    for name in "ab":
        config = ppo.PPOConfig(num_envs=2, num_steps=16, total_timesteps=50 * 32 - 20,
                               checkpoint_every=20, exteroceptive=(10, 16))  # fmt: skip
        make = partial(loco_mtrl.training_env, seed=0, tasks=["stairs", "obstacles"])
        ends.append(states(ppo.learn(make, config, run_dir=tmp_path / name)))
        with open(tmp_path / name / "progress.csv", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) >= 50
        for row in rows:  # all but the clock
            for key in ("minutes", "steps_per_s", "collect_s", "learn_s"):
                del row[key]
        (tmp_path / f"{name}.json").write_text(json.dumps(rows))
    assert same_bits(*ends)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()


def test_memory_stays_flat_over_twenty_thousand_episodes():
    env = loco_mtrl.Map(loco_mtrl.LocoEnv(["flat", "stairs"]))
    rng, process, sizes = np.random.default_rng(0), psutil.Process(), []
    env.reset(seed=0)
    actions = rng.normal(0, 0.3, (100, *env.action_space.shape))
    for episode in range(20_000):
        for k in range(3):
            env.step(actions[(episode + k) % 100])
        env.reset()
        if episode in (2_000, 19_999):
            sizes.append(process.memory_info().rss)
    env.close()
    assert sizes[1] - sizes[0] < 8e6
