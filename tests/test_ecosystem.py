"""At home among the tools that people know: Gymnasium's wrappers, SB3, TensorBoard, pip."""

import subprocess
import sys
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

import loco_mtrl

ROOT = Path(loco_mtrl.__file__).parent


@pytest.mark.parametrize("vector", [gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv])
@pytest.mark.parametrize(("maker", "size"), [
    (partial(gym.make, "LocoMTRL-v0"), 282), (loco_mtrl.make_env, 402),
])
def test_vector_envs_and_wrappers(vector, maker, size):
    make = partial(maker, tasks="flat", max_episode_steps=5)
    envs = gym.wrappers.vector.RecordEpisodeStatistics(vector([make, make]))
    observations, _ = envs.reset(seed=3)
    assert observations.shape == (2, size) and observations.dtype == np.float32
    total = np.zeros(2)
    for _ in range(5):
        _, reward, terminated, truncated, info = envs.step(np.zeros((2, 17), np.float32))
        total += reward
    assert truncated.all() and not terminated.any()
    np.testing.assert_allclose(info["episode"]["r"], total, rtol=1e-5)
    assert (info["episode"]["l"] == 5).all() and (info["task"] == "flat").all()
    envs.close()


def test_sync_and_async_see_the_same():
    make = partial(gym.make, "LocoMTRL-v0", tasks="rugged")
    runs = []
    for vector in (gym.vector.SyncVectorEnv, gym.vector.AsyncVectorEnv):
        envs = vector([make, make])
        envs.reset(seed=7)
        runs.append([envs.step(np.full((2, 17), 0.1, np.float32))[0] for _ in range(10)])
        envs.close()
    np.testing.assert_array_equal(*runs)


def test_stable_baselines_trains_on_it_unchanged():
    PPO = pytest.importorskip("stable_baselines3").PPO
    env = gym.make("LocoMTRL-v0", tasks="flat")
    model = PPO("MlpPolicy", env, n_steps=512, batch_size=128, n_epochs=2, seed=0, device="cpu")
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(2048)
    assert model.num_timesteps == 2048
    after = list(model.policy.parameters())
    assert all(p.isfinite().all() for p in after)
    assert any((a != b).any() for a, b in zip(after, before, strict=True))
    env.close()


def test_tensorboard_gets_the_columns_of_progress(tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    on_update = loco_mtrl.tensorboard(tmp_path)
    on_update(None, {"steps": 10, "t_cr": 0.25})
    on_update(None, {"steps": 20, "t_cr": 0.5})
    events = EventAccumulator(str(tmp_path)).Reload()
    assert [(e.step, e.value) for e in events.Scalars("t_cr")] == [(10, 0.25), (20, 0.5)]


def test_without_tensorboard_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(ValueError, match="pip install tensorboard"):
        loco_mtrl.tensorboard(tmp_path)


def test_the_wheel_runs_from_any_folder(tmp_path):
    def run(*command, **options):
        result = subprocess.run(command, capture_output=True, text=True, **options)
        assert result.returncode == 0, result.stderr
        return result.stdout

    pip = sys.executable, "-m", "pip", "--disable-pip-version-check"
    run(*pip, "wheel", "--no-deps", "--no-build-isolation", "-q", "-w", tmp_path, ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    run(*pip, "install", "--no-deps", "-q", "--target", tmp_path / "site", wheel)
    modules = {path.name for path in (tmp_path / "site").glob("*.py")}
    assert modules == {"loco_mtrl.py", "ppo.py", "terrain.py", "tg.py"}
    script = "import loco_mtrl; print(loco_mtrl.__file__); loco_mtrl.main(['gallery', '--help'])"
    command = sys.executable, "-c", script
    out = run(*command, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path / "site")})
    assert str(tmp_path) in out and "--seed" in out
    console = tmp_path / "site" / "bin" / "loco-mtrl"
    assert "gallery" in run(sys.executable, console, "--help", cwd=tmp_path,
                            env={"PYTHONPATH": str(tmp_path / "site")})
