"""PPO against numbers worked out by hand, brute force, and environments whose answer is known."""

import csv
import math
import os
import pickle
import signal
import socket
from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from hypothesis import given, settings
from hypothesis import strategies as st

import ppo
from ppo import ActorCritic, PPOConfig, compute_gae, learn, ppo_loss, ppo_update

torch.set_num_threads(1)

SMALL = {"num_envs": 4, "num_steps": 32, "encoder_hidden": (16,), "trunk_hidden": (16,)}


class Probe(gym.Env):
    """One small env for every probe: what the reward is, and how long an episode lasts."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, reward=lambda obs, action, t: 1.0, length=1, truncates=False, blind=False):
        self.reward, self.length, self.truncates, self.blind = reward, length, truncates, blind

    def observe(self):
        self.obs = self.np_random.choice([-1.0, 1.0], 2).astype(np.float32) * (not self.blind)
        return self.obs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)  # learn clips what it hands to the env
        reward = float(self.reward(self.obs, action[0], self.t))
        self.t += 1
        last = self.t >= self.length
        info = {"t_cr": 0.5 + reward / 8, "task": "left" if self.obs[0] < 0 else "right"}
        info |= {"success": 1.0} if self.obs[0] < 0 else {}  # others, that end with it, say nothing
        if self.length > 1:
            self.observe()
        return self.obs, reward, last and not self.truncates, last and self.truncates, info


def train(env, updates, on_update=None, seed=0, **changes):
    settings_ = {**SMALL, "critic_learning_rate": 1e-2, "learning_rate": 3e-3,
                 "max_learning_rate": 1e-2, "target_kl": 0.05, "seed": seed, **changes}
    rows = settings_["num_envs"] * settings_["num_steps"]
    config = PPOConfig(total_timesteps=updates * rows // 2, **settings_)
    return learn(lambda index: env(), config, episode_keys=(), on_update=on_update)


def states(model):
    return {name: tensor.clone() for name, tensor in model.state_dict().items()}


def same_bits(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


# --- advantages


def column(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)[:, None]


def test_gae_by_hand():
    # An episode that terminates at step 1, its reset row, then one that the rollout cuts at step 3.
    rewards, values = column(1, 2, 0, 4), column(10, 20, 30, 40, 50)
    flags = [column(*x, dtype=torch.bool) for x in ((0, 1, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))]
    advantages, returns = compute_gae(rewards, values, *flags, gamma=0.5, gae_lambda=0.5)
    # delta_3 = 4 + 0.5 * 50 - 40 = -11; delta_1 = 2 - 20 = -18 (terminated: V[2] is no future);
    # delta_0 = 1 + 0.5 * 20 - 10 = 1, plus 0.25 * -18 = -3.5. The reset row is 0.
    assert advantages[:, 0].tolist() == [-3.5, -18.0, 0.0, -11.0]
    assert returns[:, 0].tolist() == [6.5, 2.0, 0.0, 29.0]


def test_gae_bootstraps_from_the_last_observation_at_a_time_limit():
    # As above, but step 1 is truncated: V[2] = 30 is its future, and still step 0 sums no further.
    rewards, values = column(1, 2, 0, 4), column(10, 20, 30, 40, 50)
    flags = [column(*x, dtype=torch.bool) for x in ((0, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))]
    advantages, _ = compute_gae(rewards, values, *flags, gamma=0.5, gae_lambda=0.5)
    # delta_1 = 2 + 0.5 * 30 - 20 = -3; advantage_0 = 1 + 0.25 * -3 = 0.25
    assert advantages[:, 0].tolist() == [0.25, -3.0, 0.0, -11.0]


@settings(deadline=None, max_examples=60)
@given(st.lists(st.sampled_from("..TL"), min_size=1, max_size=12), st.booleans(),
       st.floats(0, 1), st.floats(0, 1), st.integers(0, 99))
def test_gae_is_its_definition(ends, starts_with_reset, gamma, lam, seed):
    """T: terminated, L: at its time limit; a reset row follows either, also across rollouts."""
    rng, ended, rows = np.random.default_rng(seed), starts_with_reset, []
    for end in ends:
        end, prev = "." if ended else end, ended
        ended = end != "."
        rows.append((end == "T", ended, prev))
    terminated, done, prev_done = (column(*x, dtype=torch.bool) for x in zip(*rows, strict=True))
    rewards, values = rng.normal(size=len(ends)), rng.normal(size=len(ends) + 1)
    advantages, returns = compute_gae(column(*rewards), column(*values), terminated, done,
                                      prev_done, gamma, lam)
    for t, (_, _, reset_row) in enumerate(rows):
        expected = 0.0
        for k in range(t, len(ends)):  # sum of (gamma lambda)^(k-t) delta_k up to the ending
            future = 0.0 if rows[k][0] else values[k + 1]
            expected += (gamma * lam) ** (k - t) * (rewards[k] + gamma * future - values[k])
            if rows[k][1]:
                break
        expected = (0.0, 0.0) if reset_row else (expected, expected + values[t])
        got = (advantages[t, 0].item(), returns[t, 0].item())
        assert got == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("argument", range(1, 5))
def test_gae_refuses_shapes_that_do_not_fit(argument):
    no = torch.zeros(3, 2, dtype=torch.bool)
    arguments = [torch.zeros(3, 2), torch.zeros(4, 2), no, no, no]
    compute_gae(*arguments, 0.9, 0.9)
    arguments[argument] = arguments[argument][:-1]
    with pytest.raises(ValueError, match="must be"):
        compute_gae(*arguments, 0.9, 0.9)


# --- the loss


def test_loss_by_hand():
    log = math.log
    new, old = torch.tensor([log(1.5), log(0.5), log(1.5), log(1.0)]), torch.zeros(4)
    advantages = torch.tensor([1.0, -1.0, -1.0, 2.0])
    policy, value, kl, clipfrac = ppo_loss(new, old, advantages, torch.tensor([3.0, 0, 0, 0]),
                                           torch.tensor([1.0, 0, 0, 0]), clip_coef=0.2)
    # good and up: clipped at 1.2; bad and down: clipped at 0.8; bad and up: the full 1.5
    torch.testing.assert_close(policy, torch.tensor([-1.2, 0.8, 1.5, -2.0]))
    assert value.tolist() == [2.0, 0.0, 0.0, 0.0]  # (3 - 1)^2 / 2
    k3 = [0.5 - log(1.5), -0.5 - log(0.5), 0.5 - log(1.5), 0.0]  # ratio - 1 - log ratio
    torch.testing.assert_close(kl, torch.tensor(k3))
    assert clipfrac.tolist() == [1.0, 1.0, 1.0, 0.0]


@settings(deadline=None)
@given(st.floats(-20, 20, width=32), st.floats(-20, 20, width=32))
def test_approx_kl_is_never_negative(new, old):
    x = torch.tensor([new, old])
    assert ppo_loss(x, x.flip(0), x, x, x, 0.2)[2].min() >= 0


def rollout(model, rows=64):
    generator = torch.Generator().manual_seed(1)
    obs = torch.randn(rows, model.kwargs["obs_dim"], generator=generator)
    noise = torch.randn(rows, model.kwargs["act_dim"], generator=generator)
    actions, log_prob = model.act(obs, noise)
    advantages, returns = torch.randn(2, rows, generator=generator)
    return [model.views(obs), actions, log_prob, advantages, returns, no_advice(actions)]


def no_advice(actions):
    return torch.full_like(actions, math.nan)


def optimiser_of(model):
    actor = [model.free_log_std, *model.actor.parameters()]
    return torch.optim.Adam([{"params": actor, "lr": 3e-4},
                             {"params": list(model.critic.parameters()), "lr": 1e-3}])


def test_ratio_is_one_before_the_first_step():
    torch.manual_seed(0)
    model = ActorCritic(5, 2, (1, 3))
    model.update_normaliser(torch.randn(50, 5))
    batch = rollout(model)
    once = PPOConfig(update_epochs=1, num_minibatches=1)
    first = ppo_update(model, optimiser_of(model), batch, once, torch.Generator())
    assert first["approx_kl"] == pytest.approx(0, abs=1e-10) and first["clipfrac"] == 0
    again = ppo_update(model, optimiser_of(model), batch, once, torch.Generator())
    assert again["approx_kl"] > 1e-8  # it has moved: the first zero was no accident


@pytest.mark.parametrize(("target_kl", "learning_rate", "follows"), [
    (1.0, 3e-4, 4.5e-4), (1.0, 9e-4, 1e-3), (1e-9, 3e-4, 2e-4), (1e-9, 1.2e-4, 1e-4),
])
def test_step_size_follows_the_kl_within_its_bounds(target_kl, learning_rate, follows):
    torch.manual_seed(0)
    model = ActorCritic(5, 2)
    optimiser = optimiser_of(model)
    optimiser.param_groups[0]["lr"] = learning_rate
    ppo_update(model, optimiser, rollout(model), PPOConfig(target_kl=target_kl), torch.Generator())
    assert [g["lr"] for g in optimiser.param_groups] == pytest.approx([follows, 1e-3])


# --- the network


MIRROR = ([1, 0, 2, 3], [1, 1, -1, 1], [2, 1, 0], [1, -1, 1])


def test_log_prob_is_that_of_torch():
    torch.manual_seed(0)
    model = ActorCritic(4, 3, (2, 1), mirror=MIRROR)
    torch.nn.init.normal_(model.free_log_std)
    obs, actions = torch.randn(6, 5, 4), torch.randn(6, 5, 3)
    normal = torch.distributions.Normal(model.mean(obs), model.log_std().exp())
    log_prob, values, mean = model.evaluate(model.views(obs), actions)
    assert torch.equal(mean, model.mean(obs))
    torch.testing.assert_close(log_prob, normal.log_prob(actions).sum(-1))
    torch.testing.assert_close(values, model.value(obs))
    acted, log_prob = model.act(obs, noise := torch.randn(6, 5, 3))
    torch.testing.assert_close(acted, normal.mean + normal.stddev * noise)
    torch.testing.assert_close(log_prob, normal.log_prob(acted).sum(-1))


def test_actions_have_the_mean_and_the_std():
    torch.manual_seed(0)
    model = ActorCritic(2, 2, init_std=(0.5, 2.0))
    np.testing.assert_allclose(model.log_std().detach().exp(), [0.5, 2.0], rtol=1e-6)
    with pytest.raises(ValueError, match="3 entries"):
        ActorCritic(2, 2, init_std=(0.5, 2.0, 1.0))
    model = ActorCritic(2, 2, init_std=0.5)
    noise = torch.tensor([[1.0, -2.0]])
    moved = model.act(torch.ones(1, 2), noise)[0] - torch.from_numpy(model.mean_action(np.ones(2)))
    assert moved.tolist()[0] == pytest.approx([0.5, -1.0], abs=1e-6)


def test_the_mean_stays_where_noise_is_felt():
    model = ActorCritic(2, 2)
    torch.nn.init.constant_(model.actor.head.bias, 1.5)
    assert model.mean_action(np.ones(2)).tolist() == pytest.approx([math.tanh(1.5)] * 2, abs=0.05)


def test_mirror_is_exact_but_for_the_preferred_side():
    torch.manual_seed(0)
    plain, model = ActorCritic(4, 3, (1, 2)), ActorCritic(4, 3, (1, 2), mirror=MIRROR)
    data = torch.randn(500, 4) * torch.tensor([1.0, 5.0, 2.0, 0.1]) + 3
    for network in (plain, model):
        network.update_normaliser(data)
        torch.nn.init.normal_(network.free_log_std)
        torch.nn.init.normal_(network.actor.head.weight)
    obs_index, obs_sign, act_index, act_sign = map(torch.tensor, MIRROR)
    obs = torch.randn(200, 4) * 4
    turned = obs[:, obs_index] * obs_sign
    symmetric = obs + turned
    with torch.no_grad():
        mean = model.mean(symmetric)
        assert (mean - mean[:, act_index] * act_sign).abs().max() > 0.01  # it takes a side ...
        for network in (model.actor, model.critic):
            network.encoders[-1][0].weight[:, -1] = 0  # ... by the last entry of what it sees
        expected = model.mean(obs)[:, act_index] * act_sign
        torch.testing.assert_close(model.mean(turned), expected, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(model.value(turned), model.value(obs), rtol=1e-5, atol=1e-5)
        assert torch.equal(model.log_std()[act_index], model.log_std())
        # Not so by chance: without the mirror they differ.
        assert (plain.mean(turned) - plain.mean(obs)[:, act_index] * act_sign).abs().max() > 0.1
    assert torch.equal(model.obs_mean[obs_index] * obs_sign, model.obs_mean)
    assert torch.equal(model.obs_sum_sq[obs_index], model.obs_sum_sq)
    both = torch.cat((data, data[:, obs_index] * obs_sign)).double()
    torch.testing.assert_close(model.obs_mean, both.mean(0))
    torch.testing.assert_close(model.obs_sum_sq / model.count, both.var(0, correction=0))


@pytest.mark.parametrize("part", [0, 1, 2, 3])
def test_a_mirror_that_is_not_its_own_inverse_is_refused(part):
    bad = [list(p) for p in MIRROR]
    bad[part] = bad[part][:-1] if part % 2 else [1, 2, 0, 3][: len(bad[part])]
    with pytest.raises(ValueError, match="twice must give"):
        ActorCritic(4, 3, mirror=bad)


def test_a_scan_is_read_column_by_column():
    torch.manual_seed(0)
    encoder = ppo.ScanEncoder(3, 4, 5)
    scan = torch.randn(7, 3, 4)
    columns = torch.cat([encoder.column(scan[:, :, k]) for k in range(4)], dim=-1)
    torch.testing.assert_close(encoder(scan.flatten(1)), encoder.scan(columns))


def test_a_scan_beyond_the_observation_is_refused():
    with pytest.raises(ValueError, match=r"scan of \(5, 1\)"):
        ActorCritic(4, 3, exteroceptive=(5, 1))
    for valid in ((0, 0), (2, 2)):
        assert ActorCritic(4, 3, exteroceptive=valid).mean_action(np.zeros((7, 4))).shape == (7, 3)


def test_normaliser_is_numpys_mean_and_std_and_travels_with_the_model():
    rng = np.random.default_rng(0)
    data = rng.normal(1e4, [1e-1, 1.0, 0.0], (900, 3)).astype(np.float32)
    model = ActorCritic(3, 1)
    for part in np.split(data, [1, 17, 400]):
        model.update_normaliser(torch.from_numpy(part))
    state = model.state_dict()
    exact = data.astype(np.float64)
    np.testing.assert_allclose(state["obs_mean"], exact.mean(0), rtol=1e-12)
    std = (state["obs_sum_sq"] / state["count"]).sqrt()
    np.testing.assert_allclose(std, exact.std(0), rtol=1e-4, atol=1e-3)
    views = model.views(torch.from_numpy(data))[:, 0]
    assert views[:, :2].std(0, correction=0).tolist() == pytest.approx([1, 1], rel=1e-2)
    assert views[:, 2].abs().max() < 1e-3  # a constant says nothing, instead of exploding
    absurd = model.mean_action(np.array([1e30, -1e30, 1e4], np.float32))
    assert np.array_equal(absurd, model.mean_action(np.array([1e20, -1e20, 1e4], np.float32)))


# --- it learns


def test_probe_constant_reward():
    model = train(lambda: Probe(blind=True), 12)
    assert model.value(torch.zeros(2)).item() == pytest.approx(1, abs=0.05)


def test_probe_reward_is_the_observation():
    model = train(lambda: Probe(lambda obs, action, t: obs[0]), 20)
    values = model.value(torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]]))
    assert values.tolist() == pytest.approx([1, 1, -1, -1], abs=0.15)


class Delayed(Probe):
    """Two steps; the observation is the time, the reward comes with the second step."""

    def __init__(self):
        super().__init__(lambda obs, action, t: t, length=2)

    def observe(self):
        self.obs = np.array([getattr(self, "t", 0), 0], np.float32)
        return self.obs


def test_probe_delayed_reward():
    model = train(Delayed, 25, gamma=0.5)
    values = model.value(torch.tensor([[0.0, 0.0], [1.0, 0.0]]))
    assert values.tolist() == pytest.approx([0.5, 1], abs=0.1)  # gamma * 1, then 1


def test_probe_reward_is_the_action():
    rewards = lambda obs, action, t: -((action - 0.6) ** 2)  # noqa: E731
    model = train(lambda: Probe(rewards, blind=True), 45)
    assert model.mean_action(np.zeros(2)).item() == pytest.approx(0.6, abs=0.12)


def test_probe_action_must_follow_the_observation():
    model = train(lambda: Probe(lambda obs, action, t: obs[0] * action), 30)
    obs = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]], np.float32)
    assert (model.mean_action(obs)[:, 0] * obs[:, 0] > 0.6).all()


def test_value_under_a_time_limit_is_that_of_an_endless_task():
    # Reward 1 for ever: V = 1 / (1 - gamma) = 5. Taking the limit for an end would give about 3.
    model = train(lambda: Probe(length=5, truncates=True, blind=True), 50, gamma=0.8)
    assert model.value(torch.zeros(2)).item() == pytest.approx(5, abs=0.3)


def test_pendulum_swings_up():
    def make(index):
        env = gym.wrappers.RescaleAction(gym.make("Pendulum-v1"), np.float32(-1), np.float32(1))
        return gym.wrappers.TransformReward(env, lambda reward: 0.1 * reward)

    config = PPOConfig(
        total_timesteps=80_000, num_envs=8, num_steps=256, gamma=0.95, update_epochs=10,
        num_minibatches=16, learning_rate=1e-3, max_learning_rate=3e-3, critic_learning_rate=3e-3,
        target_kl=0.02, init_std=0.6, noise_correlation=0.5,
        encoder_hidden=(64,), trunk_hidden=(64,),
    )
    model = learn(make, config, episode_keys=())
    returns, env = [], make(0)
    for seed in range(20):
        obs, _ = env.reset(seed=1000 + seed)
        returns.append(0.0)
        for _ in range(200):
            obs, reward, *_ = env.step(model.mean_action(obs).clip(-1, 1))
            returns[-1] += 10 * reward
    assert np.mean(returns) > -200  # hanging gives about -1,400, random torque about -1,200


def test_the_same_seed_gives_the_same_bits_and_another_does_not():
    env = lambda: Probe(lambda obs, action, t: obs[0] * action, length=3)  # noqa: E731
    one, two, other = (states(train(env, 4, seed=seed)) for seed in (3, 3, 4))
    assert same_bits(one, two) and not same_bits(one, other)


def test_seeds_never_overlap():
    seen = []

    class Recorder(Probe):
        def reset(self, *, seed=None, options=None):
            seen.extend([] if seed is None else [seed])
            return super().reset(seed=seed)

    train(Recorder, 7, checkpoint_every=2)
    assert len(seen) >= 4 * 4 and len(set(seen)) == len(seen)


def test_the_noise_never_exceeds_its_bound():
    stds = []
    learn(lambda index: Square(1.0), PPOConfig(total_timesteps=600, max_std=0.2, **SMALL),
          on_update=lambda model, row: stds.append(row["std"]))
    assert len(stds) >= 2 and max(stds) <= 0.2 + 1e-6


def test_advantages_are_bounded(monkeypatch):
    model = ActorCritic(2, 1)
    views, actions, log_prob, _, returns, guide = rollout(model, 4)
    advantages = torch.tensor([0.0, 0.0, 0.0, 8.0])  # mean 2, std sqrt(12)
    for bound, valid in ((10.0, [-0.577350, 1.732051]), (1.0, [-0.577350, 1.0])):
        seen = set()

        def spy(log_prob, old, advantages, *rest, seen=seen):
            seen.update(advantages.tolist())
            return ppo_loss(log_prob, old, advantages, *rest)

        monkeypatch.setattr(ppo, "ppo_loss", spy)
        config = PPOConfig(max_advantage=bound, num_minibatches=1, num_envs=1, num_steps=4)
        batch = [views, actions, log_prob, advantages, returns, guide]
        ppo_update(model, optimiser_of(model), batch, config, torch.Generator())
        assert sorted(seen) == pytest.approx(valid, abs=1e-5)


def test_the_noise_lasts_from_step_to_step():
    taken = []
    env = partial(Probe, lambda obs, action, t: taken.append(action) or 0.0, length=10_000)
    config = PPOConfig(total_timesteps=2000, **SMALL | {"num_envs": 1, "num_steps": 2000},
                       init_std=0.3, noise_correlation=(0.9,), num_minibatches=1)
    learn(lambda index: env(), config, episode_keys=())
    noise = np.array(taken)
    assert noise.std() == pytest.approx(0.3, abs=0.06)  # as large as without
    for lag in (1, 5):
        assert np.corrcoef(noise[lag:], noise[:-lag])[0, 1] == pytest.approx(0.9**lag, abs=0.1)
    with pytest.raises(ValueError, match="noise_correlation has 2 entries"):
        learn(lambda index: env(), PPOConfig(noise_correlation=(0.9, 0.0), **SMALL))


# --- spaces


class Square(gym.Env):
    """Two-dimensional observations and actions, in float64."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (3, 2))
    action_space = gym.spaces.Box(-1e-3, 1e-3, (2, 2), np.float64)

    def __init__(self, reward=0.0):
        self.value = reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=(3, 2)).astype(np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action) and (np.abs(action) == 1e-3).any()
        return self.reset()[0], self.value, False, False, {}


def test_any_box_shape():
    model = learn(lambda index: Square(), PPOConfig(total_timesteps=1, **SMALL))
    assert (model.kwargs["obs_dim"], model.kwargs["act_dim"]) == (6, 4)


def test_other_spaces_are_refused():
    env = Probe()
    env.action_space = gym.spaces.Discrete(2)
    with pytest.raises(ValueError, match=r"must be Box.*Discrete"):
        learn(lambda index: env, PPOConfig(total_timesteps=1, num_envs=1))


@pytest.mark.parametrize("reward", [math.nan, math.inf])
def test_rewards_that_are_no_numbers_stop_the_training(reward):
    with pytest.raises(FloatingPointError, match="update 1 "):
        learn(lambda index: Square(reward), PPOConfig(total_timesteps=1, **SMALL))


@pytest.mark.parametrize(("name", "value", "valid"), [
    ("total_timesteps", 0, "at least 1"), ("total_timesteps", 1e6, "whole"),
    ("num_envs", -1, "at least 1"), ("num_steps", 2.5, "whole"), ("update_epochs", 0, "at least 1"),
    ("num_minibatches", 1921, "at most 1920"), ("checkpoint_every", 0, "at least 1"),
    ("gamma", 1.01, "[0, 1]"), ("gamma", math.nan, "[0, 1]"), ("gae_lambda", -0.1, "[0, 1]"),
    ("clip_coef", 0, "above 0"), ("max_grad_norm", math.inf, "finite"), ("init_std", -1, "above 0"),
    ("noise_correlation", 1.5, "in [0, 1]"), ("noise_correlation", (0.5, -1), "in [0, 1]"),
    ("max_std", math.nan, "above 0"), ("max_advantage", 0.0, "above 0"),
    ("init_std", (0.1, 0.0), "above 0"), ("init_std", (), "above 0"),
    ("learning_rate", 1.0, "[0.0001, 0.001]"), ("learning_rate", 1e-5, "[0.0001, 0.001]"),
    ("critic_learning_rate", 0.0, "above 0"), ("target_kl", 0.0, "above 0"),
    ("seed", -1, "at least 0"),
    ("exteroceptive", (-1, 2), "at least 0"), ("exteroceptive", (4,), "two whole"),
    ("encoder_hidden", (), "non-empty"),
    ("trunk_hidden", (64, 0), "at least 1"),
])
def test_bad_settings_are_named(name, value, valid):
    with pytest.raises(ValueError) as error:
        PPOConfig(**{name: value})
    assert f"{name} = {value!r}" in str(error.value) and valid in str(error.value)


# --- the run folder


def run(folder, updates, **options):
    # Episodes of 20 steps in rollouts of 32 x 4: without the reset rows more than 120 steps.
    config = PPOConfig(total_timesteps=updates * 120, checkpoint_every=2, **SMALL)
    env = lambda index: Probe(lambda obs, action, t: obs[0] * action, length=20)  # noqa: E731
    return learn(env, config, run_dir=folder, groups=("left", "right"), **options)


def table(folder):
    with open(folder / "progress.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_stopping_and_resuming_changes_no_bit(tmp_path):
    at = {}
    whole = run(tmp_path / "whole", 6, on_update=lambda m, row: at.update({row["update"]: row}))
    run(tmp_path / "parts", 4)
    stopped = ppo.load_checkpoint(tmp_path / "parts" / "checkpoint.pt")["counters"]
    assert stopped["update"] == 4 and stopped["steps"] == at[4]["steps"]
    with open(tmp_path / "parts" / "progress.csv", "a") as file:
        file.write("5,999\n6,9")  # what a crash after the checkpoint leaves behind
    parts = run(tmp_path / "parts", 6, resume=True)
    assert same_bits(states(whole), states(parts))
    assert [row["update"] for row in table(tmp_path / "parts")] == list("123456")
    last, other = table(tmp_path / "parts")[-1], table(tmp_path / "whole")[-1]
    assert last["steps"] == other["steps"] and last["approx_kl"] == other["approx_kl"]
    assert float(last["minutes"]) > stopped["minutes"] > 0


def test_a_resumed_run_keeps_to_its_new_bounds_of_the_step_size(tmp_path):
    env, rows = partial(Probe, length=3), []
    config = PPOConfig(total_timesteps=300, learning_rate=1e-3, **SMALL)
    learn(lambda index: env(), config, run_dir=tmp_path)
    config = PPOConfig(total_timesteps=600, learning_rate=1e-5, min_learning_rate=1e-6,
                       max_learning_rate=1e-5, **SMALL)
    learn(lambda index: env(), config, run_dir=tmp_path, resume=True,
          on_update=lambda _, row: rows.append(row["learning_rate"]))
    assert rows and max(rows) <= 1e-5


def test_run_folder(tmp_path):
    model = run(tmp_path, 2, meta={"command": "train", "commit": "abc"})
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"config.json", "progress.csv", "checkpoint.pt", "curve.png"}
    row = table(tmp_path)[-1]
    assert {"update", "steps", "minutes", "steps_per_s", "collect_s", "learn_s", "return", "t_cr",
            "success", "fall", "t_cr/left", "t_cr/right", "approx_kl", "clipfrac", "value_loss",
            "explained_variance", "std", "guide_loss", "learning_rate",
            "grad_norm"} == set(row)
    # 8 of 20 steps more than a rollout: two rollouts of 32 end 3 episodes (21 rows each) per env.
    assert int(row["steps"]) == 2 * 4 * 32 - 3 * 4
    assert row["fall"] == "nan" and row["success"] == "1" and abs(float(row["t_cr"]) - 0.5) <= 1 / 8
    assert float(row["t_cr"]) == pytest.approx(
        sum(float(row[f"t_cr/{side}"]) for side in ("left", "right")) / 2, abs=0.1)
    loaded, checkpoint = ppo.load_policy(tmp_path / "checkpoint.pt")
    assert checkpoint["meta"] == {"command": "train", "commit": "abc"}
    assert checkpoint["config"]["num_envs"] == 4
    assert same_bits(states(loaded), states(model))


def test_a_run_is_not_overwritten(tmp_path):
    run(tmp_path, 1)
    with pytest.raises(FileExistsError, match="already holds a run"):
        run(tmp_path, 1)


def test_resuming_needs_a_checkpoint_and_an_env_that_fits(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"checkpoint\.pt"):
        run(tmp_path, 1, resume=True)
    run(tmp_path, 1)
    config = PPOConfig(total_timesteps=10_000, **SMALL)
    with pytest.raises(ValueError, match="other columns"):
        learn(lambda index: Probe(), config, run_dir=tmp_path, resume=True)
    with pytest.raises(ValueError, match="obs_dim = 2, but the env has 6"):
        learn(lambda index: Square(), PPOConfig(**SMALL), run_dir=tmp_path, resume=True)


@pytest.mark.parametrize(("wrong", "named"), [
    ({"resume": True}, "resume = True"),
    ({"episode_keys": "t_cr"}, "'t_cr'"), ({"groups": "flat"}, "'flat'"),
    ({"mirror": ([1, 2], [1, 1], [0], [1])}, r"\[1, 2\]"),
])
def test_bad_arguments_of_learn_are_named(wrong, named):
    with pytest.raises(ValueError, match=named):
        learn(lambda index: Probe(), PPOConfig(**SMALL), **wrong)


def test_ctrl_c_finishes_the_update_and_keeps_it(tmp_path):
    def interrupt(model, row):
        if row["update"] == 3:
            os.kill(os.getpid(), signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 99, on_update=interrupt)
    assert signal.getsignal(signal.SIGINT) is before
    assert ppo.load_checkpoint(tmp_path / "checkpoint.pt")["counters"]["update"] == 4
    assert len(table(tmp_path)) == 4


def test_policy_survives_the_checkpoint_and_is_small(tmp_path):
    torch.manual_seed(0)
    mirror = (range(200), [1] * 200, range(18), [1] * 18)
    model = ActorCritic(200, 18, (8, 16), mirror=mirror)
    model.update_normaliser(torch.randn(9, 200))
    ppo.save_checkpoint(tmp_path / "p.pt", model, PPOConfig(), meta={"score": np.float64(0.5)})
    loaded, checkpoint = ppo.load_policy(tmp_path / "p.pt")
    obs = np.random.default_rng(0).normal(size=(3, 200)).astype(np.float32)
    assert np.array_equal(loaded.mean_action(obs), model.mean_action(obs))
    assert checkpoint["meta"] == {"score": 0.5}
    assert (tmp_path / "p.pt").stat().st_size < 1_000_000
    assert [path.name for path in tmp_path.iterdir()] == ["p.pt"]
    (tmp_path / "p.pt").rename(tmp_path / "checkpoint.pt")
    with pytest.raises(ValueError, match="policy only"):
        ppo.open_run(tmp_path, PPOConfig(), resume=True)
    with pytest.raises(TypeError):
        ppo.save_checkpoint(tmp_path / "q.pt", model, PPOConfig(), meta={"bad": object()})
    assert not (tmp_path / "q.pt").exists()


class Malicious:
    def __reduce__(self):
        return os.mkdir, (self.path,)


def test_bad_checkpoints_are_refused(tmp_path):
    path = tmp_path / "bad.pt"
    with pytest.raises(FileNotFoundError, match=r"bad\.pt"):
        ppo.load_checkpoint(path)
    ppo.save_checkpoint(path, ActorCritic(2, 1), PPOConfig())
    good = path.read_bytes()
    trap = Malicious()
    trap.path = str(tmp_path / "owned")
    torch.save({"format": ppo.FORMAT, "x": trap}, tmp_path / "trap.pt")
    for content in (b"", b"hello", good[: len(good) // 2], pickle.dumps(trap),
                    (tmp_path / "trap.pt").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.pt is damaged"):
            ppo.load_checkpoint(path)
    assert not (tmp_path / "owned").exists()
    torch.save({"weights": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match=r"bad\.pt is not a checkpoint"):
        ppo.load_checkpoint(path)


# --- the guide


def test_guide_loss_by_hand():
    mean = torch.tensor([[0.5, -0.5, 0.1], [0.0, 0.2, 0.3]], requires_grad=True)
    advice = torch.tensor([[0.1, 0.5, math.nan], [math.nan, math.nan, math.nan]])
    loss = ppo.guide_loss(mean, advice)
    assert loss.tolist() == pytest.approx([1.4, 0.0])
    loss.sum().backward()  # where there is no advice nothing pulls, and NaN does not spread
    assert mean.grad.tolist() == [[1, -1, 0], [0, 0, 0]]


def test_where_a_guide_turns_both_ways_the_policy_picks_the_more_frequent():
    """Of 0.8, 0.8 and -0.8 the mean is 0.27, which nobody advised; the median is 0.8."""
    mean = torch.zeros(3, 1, requires_grad=True)
    for _ in range(100):
        ppo.guide_loss(mean[:1].expand(3, 1), torch.tensor([[0.8], [0.8], [-0.8]])).sum().backward()
        with torch.no_grad():
            mean -= 0.01 * mean.grad
        mean.grad = None
    assert mean[0].item() == pytest.approx(0.8, abs=0.02)


def test_a_guide_alone_may_lead_as_far_as_he_likes():
    """A ratio that overflows is no concern of his: nothing of it reaches the parameters."""
    torch.manual_seed(0)
    model = ActorCritic(5, 2)
    views, actions, log_prob, *rest, guide = rollout(model)
    batch = [views, actions, log_prob - 1000, *rest, torch.full_like(guide, 0.5)]
    config = PPOConfig(guide_share=1.0, target_kl=1e9, learning_rate=1e-3)
    stats = [ppo_update(model, optimiser_of(model), batch, config, torch.Generator())
             for _ in range(20)]
    assert stats[-1]["guide_loss"] < stats[0]["guide_loss"]
    assert all(torch.isfinite(p).all() for p in model.parameters())


class Guided(Probe):
    """Rewards are for nothing; the guide says what to do, but for every second episode."""

    def told(self, info):
        return info | {"guide": np.array([0.5 * self.obs[0] if self.obs[1] > 0 else np.nan])}

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        return obs, self.told(info)

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, self.told(info)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_policy_learns_what_its_guide_does(share):
    config = PPOConfig(total_timesteps=6000, guide_share=share, target_kl=1.0, **SMALL)
    rows = []
    model = learn(lambda index: Guided(lambda *_: 0.0, length=3), config, episode_keys=(),
                  on_update=lambda _, row: rows.append(row))
    obs = np.array([[1.0, 1.0], [-1.0, 1.0]], np.float32)
    assert model.mean_action(obs)[:, 0] == pytest.approx([0.5, -0.5], abs=0.1)
    assert rows[-1]["guide_loss"] < 0.3 * rows[0]["guide_loss"]


# --- two ranks


def rank_main(rank, folder):
    os.environ.update(RANK=str(rank), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1",
                      MASTER_PORT=(folder / "port").read_text())
    # Episodes whose length depends on the env: the ranks have different numbers of reset rows.
    env = lambda index: Probe(lambda obs, action, t: action, length=2 + 3 * index)  # noqa: E731
    config = PPOConfig(total_timesteps=900, checkpoint_every=2, **SMALL)
    torch.manual_seed(rank)  # the parameters must not depend on it
    model = learn(env, config, run_dir=folder / "run", episode_keys=())
    shared = one_update(slice(0, 20) if rank == 0 else slice(20, 64))
    torch.save([states(model), model.count.item(), shared], folder / f"rank{rank}.pt")


def one_update(rows):
    """Statistics and first gradient step from some rows of a fixed rollout."""
    torch.manual_seed(0)
    model = ActorCritic(5, 2, (3, 1), (16,), (16,))
    batch = [x[rows] for x in rollout(model)]  # without a mirror or statistics, views are obs
    config = PPOConfig(update_epochs=1, num_minibatches=1)
    stats = ppo_update(model, optimiser_of(model), batch, config, torch.Generator())
    model.update_normaliser(batch[0][:, 0])
    return [stats, model.actor.head.bias.grad.clone(), states(model)]


def test_two_ranks_hold_the_same_bits(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        (tmp_path / "port").write_text(str(free.getsockname()[1]))
    mp.spawn(rank_main, (tmp_path,), nprocs=2)
    (one, count, shared), (two, _, _) = (torch.load(tmp_path / f"rank{r}.pt") for r in (0, 1))
    assert same_bits(one, two)
    rows = table(tmp_path / "run")
    assert count == int(rows[-1]["steps"]) >= 900  # both ranks' observations, reset rows left out
    assert len(rows) < 900 / 100  # ... and both ranks' steps
    # 20 rows on one rank and 44 on the other make the update that one rank makes of all 64.
    (stats, gradient, state), alone = shared, one_update(slice(0, 64))
    assert stats == pytest.approx(alone[0], abs=1e-6)
    torch.testing.assert_close(gradient, alone[1])
    for name in ("count", "obs_mean", "obs_sum_sq"):
        torch.testing.assert_close(state[name], alone[2][name])
