"""At home among the tools that people know: Gymnasium's wrappers, SB3, TensorBoard, pip."""

import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import loco_mtrl

ROOT = Path(loco_mtrl.__file__).parent
VECTORS = [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv]


@pytest.mark.parametrize("vector", VECTORS)
def test_vector_envs_and_wrappers(vector):
    make = partial(gym.make, "LocoMTRL-v0", tasks="flat", max_episode_steps=5)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(vector([make, make]))
    observations, _ = envs.reset(seed=3)
    assert observations.shape == (2, 202) and observations.dtype == np.float32
    total = np.zeros(2)
    for _ in range(5):
        _, reward, terminated, truncated, info = envs.step(np.zeros((2, 17), np.float32))
        total += reward
    assert truncated.all() and not terminated.any()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    assert (info["episode"]["l"] == 5).all() and (info["task"] == "flat").all()
    observations, reward, *_ = envs.step(np.ones((2, 17), np.float32))  # this one only resets
    assert not reward.any() and not observations[:, -5:].any()
    envs.close()


def test_sync_and_async_see_the_same():
    make, runs = partial(gym.make, "LocoMTRL-v0", tasks="rugged"), []
    for vector in VECTORS:
        envs = vector([make, make])
        envs.reset(seed=7)
        runs.append([envs.step(np.full((2, 17), 0.1, np.float32))[0] for _ in range(10)])
        envs.close()
    np.testing.assert_array_equal(*runs)


def test_wrappers_of_gymnasium_fit_around_it():
    env = gym.make("LocoMTRL-v0", tasks="flat", lidar=False)
    env = gym.wrappers.RescaleAction(env, np.float32(-2), np.float32(2))
    env = gym.wrappers.FlattenObservation(gym.wrappers.FrameStackObservation(env, 3))
    observation, _ = env.reset(seed=0)
    assert observation.shape == (3 * 42,)
    env.step(np.full(17, 2.0, np.float32))
    np.testing.assert_allclose(env.unwrapped.action[:5], 0.488)  # 2 of 2 is 1 of 1
    env.close()


def test_stable_baselines_trains_on_it_unchanged():
    PPO = pytest.importorskip("stable_baselines3").PPO
    env = gym.make("LocoMTRL-v0", tasks="flat")
    model = PPO("MlpPolicy", env, n_steps=128, batch_size=64, n_epochs=2, seed=0, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(256)
    assert model.num_timesteps == 256
    after = list(model.policy.parameters())
    assert all(p.isfinite().all() for p in after)
    assert any((a != b).any() for a, b in zip(after, before, strict=True))
    env.close()


def test_tensorboard_gets_the_columns_of_progress(tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    def learn(*_, on_update, **__):
        on_update(None, {"steps": 10, "t_cr": 0.25})
        on_update(None, {"steps": 20, "t_cr": 0.5})
        raise KeyboardInterrupt

    monkeypatch.setattr(loco_mtrl, "learn", learn)
    monkeypatch.setenv("RANK", "0")
    assert loco_mtrl.main(["train", "--tensorboard", "--run-dir", str(tmp_path)]) == 130
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(e.step, e.value) for e in events.Scalars("t_cr")] == [(10, 0.25), (20, 0.5)]


def test_without_tensorboard_one_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    monkeypatch.setenv("RANK", "0")
    assert loco_mtrl.main(["train", "--tensorboard", "--run-dir", str(tmp_path / "run")]) == 2
    error = capsys.readouterr().err
    assert "tensorboard" in error and error.count("\n") == 1 and not (tmp_path / "run").exists()


def test_the_wheel_runs_from_any_folder(tmp_path):
    def run(*command, **options):
        result = subprocess.run(command, capture_output=True, text=True, timeout=200, **options)
        assert result.returncode == 0, result.stderr
        return result.stdout

    source, site = tmp_path / "source", tmp_path / "site"
    source.mkdir()  # pip leaves its files beside the sources
    for name in ("loco_mtrl.py", "ppo.py", "terrain.py", "tg.py", "pyproject.toml", "README.md",
                 "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = sys.executable, "-m", "pip", "--disable-pip-version-check"
    run(*pip, "install", "--no-deps", "--no-index", "--no-build-isolation", "-q", "--target", site,
        source)
    modules = {path.name for path in site.glob("*.py")}
    assert modules == {"loco_mtrl.py", "ppo.py", "terrain.py", "tg.py"}
    script = ("import sys, loco_mtrl; from importlib.metadata import entry_points as found; "
              "(main,) = found(group='console_scripts', name='loco-mtrl'); "
              "print(loco_mtrl.__file__); main.load()(['gallery', '--help'])")
    out = run(sys.executable, "-c", script, cwd=tmp_path, env={"PYTHONPATH": str(site)})
    assert str(site) in out and "--seed" in out and (site / "bin" / "loco-mtrl").is_file()
