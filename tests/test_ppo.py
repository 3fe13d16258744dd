"""PPO against numbers worked out by hand, brute force, and environments whose answer is known."""

import csv
import json
import math
import os
import pickle
import re
import socket
from multiprocessing import get_context

import gymnasium as gym
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import ppo
from ppo import ActorCritic, Collector, PPOConfig, compute_gae, learn, ppo_loss, with_images

torch.set_num_threads(1)

SMALL = {"num_envs": 4, "num_steps": 32, "num_minibatches": 4, "hidden": (16,)}


class Probe(gym.Env):
    """One small env for every probe: what the reward is, and how long an episode lasts."""

    observation_space = gym.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    seeds = []  # of all resets in this process

    def __init__(self, reward=lambda obs, action, t: 1.0, length=1, truncates=False, signs=(-1, 1)):
        self.reward, self.length, self.truncates, self.signs = reward, length, truncates, signs

    def observe(self):
        self.obs = self.np_random.choice(self.signs, 2).astype(np.float32)
        return self.obs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds.extend([] if seed is None else [seed])
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)  # learn clips what it hands to the env
        reward = float(self.reward(self.obs, action[0], self.t))
        self.t += 1
        last = self.t >= self.length
        info = {"t_cr": reward, "task": "left" if self.obs[0] < 0 else "right"}
        if self.length > 1:
            self.observe()
        return self.obs, reward, last and not self.truncates, last and self.truncates, info


def train(env, updates, **changes):
    """A short training, with options of PPOConfig or of `learn`; returns the model."""
    values = {**SMALL, "critic_learning_rate": 1e-2, "learning_rate": 1e-3, "max_advantage": 3.0,
              "target_kl": (0.1, 0.02), **changes}
    options = {name: values.pop(name) for name in ("mirror", "on_update") if name in values}
    rows = values["num_envs"] * values["num_steps"]
    config = PPOConfig(total_timesteps=updates * rows // 2, **values)
    return learn(lambda index, steps: env(), config, **options)[0]


def states(model):
    return {name: tensor.clone() for name, tensor in model.state_dict().items()}


def same_bits(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def table(folder):
    with open(folder / "progress.csv", newline="") as file:
        return list(csv.DictReader(file))


def in_ranks(world, function, seconds=60):
    """Runs function(rank) in `world` forked ranks that meet each other; returns the exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def main(rank):
        os.environ.update(RANK=str(rank), WORLD_SIZE=str(world), MASTER_ADDR="127.0.0.1",
                          MASTER_PORT=str(port))
        function(rank)

    ranks = [get_context("fork").Process(target=main, args=(rank,)) for rank in range(world)]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join(seconds)
        rank.kill()
        rank.join()
    return [rank.exitcode for rank in ranks]


# --- settings


@pytest.mark.parametrize(("name", "value"), [
    ("total_timesteps", 0), ("num_envs", -1), ("num_steps", 0), ("update_epochs", 0),
    ("num_minibatches", 0), ("checkpoint_every", 0), ("gamma", 1.01), ("gamma", math.nan),
    ("gae_lambda", -0.1), ("clip_coef", 0), ("max_advantage", 0.0), ("max_grad_norm", math.inf),
    ("max_disadvantage", -3.0),
    ("target_kl", (0.03, 0.0)), ("learning_rate", 0.0), ("critic_learning_rate", -1e-3),
    ("init_std", -1), ("init_std", (0.1, 0.0)), ("init_std", ()), ("noise", (1.0, math.nan)),
    ("n_scan", -1), ("hidden", ()), ("hidden", (64, 0)), ("seed", -1),
    ("noise", (1, 0)),
])
def test_bad_settings_are_named(name, value):
    with pytest.raises(ValueError) as error:
        PPOConfig(**{name: value})
    assert re.match(rf"{name} must be from .*, got {re.escape(repr(value))}", str(error.value))
    PPOConfig(gamma=1, gae_lambda=0, n_scan=0, seed=10**15, init_std=(0.1, 0.2), hidden=(1,))


# --- advantages


def column(*numbers, dtype=torch.float64):
    return torch.tensor(numbers, dtype=dtype)[:, None]


@pytest.mark.parametrize(("terminated", "expected"), [
    # delta_3 = 4 + 0.5 * 50 - 40 = -11; delta_1 = 2 - 20 = -18 (terminated: V[2] is no future);
    # delta_0 = 1 + 0.5 * 20 - 10 = 1, plus 0.25 * -18 = -3.5. The reset row is 0.
    (1, [-3.5, -18.0, 0.0, -11.0]),
    # At a time limit V[2] is the future: delta_1 = 2 + 0.5 * 30 - 20 = -3, and 1 + 0.25 * -3.
    (0, [0.25, -3.0, 0.0, -11.0]),
])
def test_gae_by_hand(terminated, expected):
    """An episode that ends at step 1, its reset row, then one that the rollout cuts at step 3."""
    rewards, values = column(1, 2, 0, 4), column(10, 20, 30, 40, 50)
    flags = [column(*x, dtype=torch.bool)
             for x in ((0, terminated, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0))]
    advantages, returns = compute_gae(rewards, values, *flags, gamma=0.5, gae_lambda=0.5)
    assert advantages[:, 0].tolist() == expected
    kept = [0, 1, 3]
    assert returns[kept, 0].tolist() == [expected[t] + (10, 20, 30, 40)[t] for t in kept]
    assert returns[2, 0] == 0


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


@pytest.mark.parametrize("argument", range(5))
def test_gae_refuses_shapes_that_do_not_fit(argument):
    no = torch.zeros(3, 2, dtype=torch.bool)
    arguments = [torch.zeros(3, 2), torch.zeros(4, 2), no, no, no]
    compute_gae(*arguments, 0.9, 0.9)
    arguments[argument] = arguments[argument][:, :1]  # it would broadcast
    with pytest.raises(ValueError, match=r"rewards are \(3, [12]\), so .* must be, too"):
        compute_gae(*arguments, 0.9, 0.9)


# --- the loss


@pytest.mark.parametrize(("ratio", "advantage", "loss", "clipped"), [
    (1.5, 1.0, -1.2, 1), (0.5, 1.0, -0.5, 1),  # a good action earns up to 1.2 and no more
    (0.5, -1.0, 0.8, 1), (1.5, -1.0, 1.5, 1),  # a bad one costs in full, gains to 0.8
    (1.1, 2.0, -2.2, 0), (0.9, -2.0, 1.8, 0),
])
def test_loss_by_hand(ratio, advantage, loss, clipped):
    log_ratio = torch.tensor([math.log(ratio)], dtype=torch.float64, requires_grad=True)
    got, kl, clipfrac = ppo_loss(log_ratio - 3, torch.tensor([-3.0]), torch.tensor([advantage]),
                                 clip_coef=0.2)
    assert got.item() == pytest.approx(loss) and clipfrac.item() == clipped
    k3 = ratio - 1 - math.log(ratio)  # Schulman's estimate
    assert kl.item() == pytest.approx(k3)
    got.backward()  # d loss / d log ratio = loss, or 0 where the clip holds
    assert log_ratio.grad.item() == pytest.approx(0 if loss in (-1.2, 0.8) else loss)
    two = torch.cat((log_ratio, torch.zeros(1)))  # and a row with ratio 1: the means
    got = ppo_loss(two, torch.zeros(2), torch.tensor([advantage, 3.0]), clip_coef=0.2)
    assert [x.item() for x in got] == pytest.approx([(loss - 3) / 2, k3 / 2, clipped / 2])


@settings(deadline=None)
@given(st.floats(-20, 20, width=32), st.floats(-20, 20, width=32))
def test_approx_kl_is_never_negative(new, old):
    x = torch.tensor([new, old])
    assert ppo_loss(x, x.flip(0), x, 0.2)[1] >= 0
    assert ppo_loss(x[:1], x[1:], x[:1], 0.2)[1] >= 0


# --- the networks


def test_moments_are_numpys():
    x = torch.from_numpy(np.random.default_rng(0).normal(3, 2, 1000)).float()
    assert ppo.moments(x) == pytest.approx((x.double().mean().item(), x.double().numpy().var()))
    assert ppo.moments(torch.full((7,), 0.1))[1] >= 0  # rounding makes no negative variance


def test_normaliser_is_numpys_mean_and_std_and_travels_with_the_model():
    rng = np.random.default_rng(0)
    data = rng.normal(1e4, [1e-1, 1.0, 0.0], (900, 3)).astype(np.float32)
    model = ActorCritic(3, 1)
    assert model.normaliser(torch.tensor([3.0, 30, -30])).tolist() == [3, 10, -10]  # knows nothing
    for part in np.split(data, [1, 17, 400]):
        model.normaliser.update(torch.from_numpy(part))
    state, exact = model.state_dict(), data.astype(np.float64)
    assert state["normaliser.count"] == 900
    np.testing.assert_allclose(state["normaliser.mean"], exact.mean(0), rtol=1e-12)
    std = (state["normaliser.sum_sq"] / 900).sqrt()
    np.testing.assert_allclose(std, exact.std(0), rtol=1e-6, atol=1e-5)
    seen = model.normaliser(torch.from_numpy(data))
    assert seen.dtype == torch.float32
    assert seen[:, :2].std(0, correction=0).tolist() == pytest.approx([1, 1], rel=1e-2)
    assert seen[:, 2].abs().max() < 1e-3  # a constant says nothing, instead of exploding
    assert model.normaliser(torch.tensor([1e30, -1e30, 1e4])).tolist() == [10, -10, 0]
    other = ActorCritic(3, 1)
    other.load_state_dict(state)
    assert torch.equal(other.normaliser(torch.from_numpy(data)), seen)


def test_log_prob_is_that_of_a_gaussian():
    torch.manual_seed(0)
    model = ActorCritic(4, 3, n_scan=2, init_std=(0.1, 0.5, 2.0))
    torch.nn.init.normal_(model.actor.head.weight)
    obs, actions = torch.randn(6, 5, 4), torch.randn(6, 5, 3)
    mean, std = torch.tensor(model.mean_action(obs)), torch.tensor([0.1, 0.5, 2.0])
    by_hand = -((actions - mean) ** 2) / (2 * std**2) - (std * math.sqrt(2 * math.pi)).log()
    log_prob = model.log_prob(obs, actions)
    torch.testing.assert_close(log_prob, by_hand.sum(-1))
    normal = torch.distributions.Normal(mean, std)
    torch.testing.assert_close(log_prob, normal.log_prob(actions).sum(-1))
    assert model.value(obs).shape == (6, 5)


def test_the_first_policy_is_the_zero_action_and_later_means_stay_below_one():
    torch.manual_seed(0)
    model, obs = ActorCritic(4, 3, init_std=0.5), np.random.default_rng(0).normal(size=(99, 4))
    assert np.abs(model.mean_action(obs)).max() < 0.02 and model.std.tolist() == [0.5] * 3
    torch.nn.init.zeros_(model.actor.head.weight)
    model.actor.head.bias.data.copy_(torch.tensor([0.5, -2.0, 99.0]))
    action = model.mean_action(np.zeros(4))
    assert action.dtype == np.float32
    assert action.tolist() == pytest.approx([math.tanh(0.5), math.tanh(-2.0), 1.0])


@pytest.mark.parametrize("network", ["actor", "critic"])
def test_each_part_of_the_observation_has_its_own_encoder(network):
    """An encoder that is silenced takes its own entries away, and no others."""
    for silent, gone in ((0, [0, 1, 2]), (1, [3, 4])):
        torch.manual_seed(0)
        net = getattr(ActorCritic(5, 2, n_scan=3), network)
        torch.nn.init.zeros_(net.encoders[silent][-2].weight)
        obs = torch.randn(1, 5, requires_grad=True)
        net(obs).sum().backward()
        assert (obs.grad[0] == 0).nonzero()[:, 0].tolist() == gone
    for n_scan in (0, 5):
        assert len(getattr(ActorCritic(5, 2, n_scan=n_scan), network).encoders) == 1


@pytest.mark.parametrize(("wrong", "named"), [
    ({"n_scan": 5}, "5 entries of a scan and 1 of init_std do not fit observations of 4"),
    ({"init_std": (0.1, 0.2)}, "0 entries of a scan and 2 of init_std .* actions of 3"),
])
def test_parts_that_do_not_fit_are_refused(wrong, named):
    with pytest.raises(ValueError, match=named):
        ActorCritic(4, 3, **wrong)


# --- the mirror


def test_the_image_of_an_image_is_the_original():
    index, sign = [1, 0, 2, 3], [1, 1, -1, 1]
    x = torch.tensor([[1.0, 2, 3, 4], [5, 6, 7, 8]])
    both = with_images(x, index, sign)
    assert both.tolist() == [[1, 2, 3, 4], [5, 6, 7, 8], [2, 1, -3, 4], [6, 5, -7, 8]]
    assert torch.equal(with_images(both[2:], index, sign)[2:], x)


@pytest.mark.parametrize("mirror", [None, (([0, 1], [-1, 1]), ([0], [-1]))])
def test_what_is_learned_on_one_side_holds_on_the_other(mirror):
    """Only obs[0] = 1 ever occurs, where a large action is best; its image is a small one."""
    model = train(lambda: Probe(lambda obs, action, t: action, signs=(1, 1)), 10, mirror=mirror)
    right, left = model.mean_action(np.float32([[1, 1], [-1, 1]]))[:, 0]
    assert right > 0.4 and (abs(left + right) < 0.05) == bool(mirror)
    assert (model.normaliser.mean[0] == 0) == bool(mirror)


# --- collecting


class Script(gym.Env):
    """Observations count: 10 * episode + step. Action k is in `taken`, the reward is its number."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-0.5, 0.25, (2, 1), np.float64)

    def __init__(self, length, truncates, infos=None):
        self.length, self.truncates, self.infos = length, truncates, infos
        self.episode, self.taken, self.seeds = -1, [], []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seeds += [seed] if seed is not None else []
        self.episode, self.t = self.episode + 1, 0
        return np.float32([10 * self.episode]), {}

    def step(self, action):
        self.taken.append(action)
        self.t += 1
        end, info = self.t == self.length, self.infos[self.episode] if self.infos else {}
        return (np.float32([10 * self.episode + self.t]), float(len(self.taken)),
                end and not self.truncates, end and self.truncates, info)


def test_a_rollout_holds_what_happened():
    envs = [Script(2, False), Script(3, True)]
    collector = Collector(lambda index: envs[index], 2, 0, 1)
    torch.manual_seed(0)
    model = ActorCritic(1, 2, init_std=(0.4, 0.8))
    collector.reset(5)
    random = collector.generator.clone_state()
    noise = torch.cat([torch.randn(T, 2, 2, generator=random) for T in (6, 3)])
    first, second = collector.collect(model, 6), collector.collect(model, 3)
    obs, actions, rewards, terminated, done, prev_done = (
        torch.cat((a[:6], b)) for a, b in zip(first, second, strict=True))
    assert torch.equal(first[0][6], second[0][0])  # the second begins where the first has ended
    # The first env: two steps and a reset row; the second: three steps and a reset row.
    assert obs[..., 0].T.tolist() == [[0, 1, 2, 10, 11, 12, 20, 21, 22, 30],
                                      [0, 1, 2, 3, 10, 11, 12, 13, 20, 21]]
    assert rewards.T.tolist() == [[1, 2, 0, 3, 4, 0, 5, 6, 0], [1, 2, 3, 0, 4, 5, 6, 0, 7]]
    ends = [[0, 1, 0, 0, 1, 0, 0, 1, 0], [0, 0, 1, 0, 0, 0, 1, 0, 0]]
    assert done.T.tolist() == ends and terminated.T.tolist() == [ends[0], [0] * 9]
    assert prev_done.T.tolist() == [[0, *end[:-1]] for end in ends]
    # The rollout keeps the policy's own actions; the env gets them clipped, as its space is.
    assert actions.min() < -0.5 and actions.max() > 0.25
    torch.testing.assert_close(actions, model.policy(obs[:-1]).mean + model.std * noise)
    for k, env in enumerate(envs):
        own = actions[~prev_done[:, k], k].numpy()
        np.testing.assert_array_equal(np.array(env.taken)[..., 0], own.clip(-0.5, 0.25))
        assert env.taken[0].dtype == np.float64


def test_all_that_follows_a_reset_is_a_function_of_its_seed():
    seeds, noise = [], []
    for rank, update in ((0, 0), (0, 1), (1, 0), (1, 1)):
        envs, states_ = {}, []
        make = lambda index, envs=envs: envs.setdefault(index, Script(2, True))  # noqa: E731
        collector = Collector(make, 5, rank, 2)
        for _ in range(2):
            collector.reset(7, update, rank)
            states_.append(collector.generator.get_state())
        assert torch.equal(*states_) and list(envs) == ([0, 2, 4], [1, 3])[rank]
        assert all(env.seeds[0] == env.seeds[1] for env in envs.values())
        seeds += [env.seeds[0] for env in envs.values()]
        noise.append(torch.randn((), generator=collector.generator).item())
    assert len(set(seeds)) == len(seeds) == 10 and len(set(noise)) == 4


def test_averages_leave_out_what_nobody_said():
    infos = ([{"task": "left", "t_cr": 0.5}, {"task": "left", "t_cr": 1.0, "success": True}],
             [{"task": "right", "t_cr": 0.0}] * 2)
    # Returns 1 + 2, then 3 + 4, which ends with the other's 1 + 2 + 3 + 4 + 5.
    collector = Collector(lambda index: Script(2 + 3 * index, False, infos[index]), 2, 0, 1,
                          ("t_cr", "success", "fall"))
    collector.reset(0)
    assert all(math.isnan(mean) for mean in collector.averages().values())
    collector.collect(ActorCritic(1, 2), 5)
    means = collector.averages()
    assert means == pytest.approx(
        {"return": (3 + 7 + 15) / 3, "t_cr": 0.5, "success": 1.0, "fall": math.nan},
        nan_ok=True)


# --- one update


def experience(model, T=16, N=4, ends=True):
    """A rollout of random numbers as `collect` returns it, with the reset row of each ending."""
    generator = torch.Generator().manual_seed(1)
    obs = torch.randn(T + 1, N, model.kwargs["obs_dim"], generator=generator)
    noise = torch.randn(T, N, model.kwargs["act_dim"], generator=generator)
    with torch.no_grad():
        actions = model.policy(obs[:-1]).mean + model.std * noise
    done = torch.zeros(T, N, dtype=torch.bool)
    done[3, 0] = done[9, 2] = done[12, 1] = ends
    prev_done = done.roll(1, 0)
    return [obs, actions, torch.randn(T, N, generator=generator), done & (obs[1:, :, 0] > 0), done,
            prev_done]


def fresh(**changes):
    """(model, optimiser, config) of one encoder, with the optimiser of `learn`."""
    config = PPOConfig(hidden=(16,), **changes)
    shape = type("Shape", (), {"obs_dim": 5, "act_dim": 2})
    return *ppo.make_model(config, shape, None), config


@pytest.fixture
def losses(monkeypatch):
    """All calls of ppo_loss as (log_prob, old_log_prob, advantages, loss, approx_kl)."""
    calls = []

    def spy(log_prob, old, advantages, clip_coef):
        result = ppo_loss(log_prob, old, advantages, clip_coef)
        calls.append((log_prob, old, advantages, *result[:2]))
        return result

    monkeypatch.setattr(ppo, "ppo_loss", spy)
    return calls


def test_ratio_is_one_on_the_first_minibatch_and_no_other(losses):
    model, optimiser, config = fresh(update_epochs=1, num_minibatches=4)
    ppo.update(model, optimiser, experience(model), config, torch.Generator(), 0.03)
    (log_prob, old, advantages, loss, kl), *others = losses
    torch.testing.assert_close(log_prob, old, rtol=0, atol=1e-5)
    assert loss.item() == pytest.approx(-advantages.mean().item(), abs=1e-5)
    assert abs(kl.item()) < 1e-9
    assert len(others) == 3 and all(kl.item() > 1e-8 for *_, kl in others)


@pytest.mark.parametrize(("low", "high"), [(99.0, 99.0), (1.0, 1.0), (1.5, 0.5)])
def test_an_update_reports_and_uses_what_its_rollout_holds(low, high, losses):
    model, optimiser, config = fresh(update_epochs=1, num_minibatches=1, max_advantage=high,
                                     max_disadvantage=low)
    rollout = experience(model)
    with torch.no_grad():
        values = model.value(rollout[0])
    kept = ~rollout[-1]
    raw, returns = (x[kept].double().numpy()
                    for x in compute_gae(rollout[2], values, *rollout[3:],
                                               config.gamma, config.gae_lambda))
    stats = ppo.update(model, optimiser, rollout, config, torch.Generator(), 0.03)
    expected = ((raw - raw.mean()) / raw.std()).clip(-low, high)
    expected -= expected.mean()
    assert len(raw) == 16 * 4 - 3
    np.testing.assert_allclose(losses[0][2].sort()[0], np.sort(expected), atol=1e-5)
    assert stats == pytest.approx({
        "approx_kl": 0, "clipfrac": 0, "value_loss": (raw**2).mean() / 2, "std": 0.37,
        "explained_variance": 1 - raw.var() / returns.var(), "learning_rate": 7.5e-4}, abs=1e-5)


def test_reset_rows_teach_nothing():
    ends = []
    for nonsense in (0.0, 1e6):
        model, optimiser, config = fresh(update_epochs=1)
        rollout = experience(model)
        for part in rollout[1:3]:  # the action that nobody took, and its reward
            part[rollout[-1]] = nonsense
        ppo.update(model, optimiser, rollout, config, torch.Generator().manual_seed(0), 0.03)
        ends.append(states(model))
    assert same_bits(*ends)


@pytest.mark.parametrize(("target_kl", "learning_rate", "follows", "epochs"), [
    (1.0, 3e-4, 4.5e-4, 3), (1.0, 9e-4, 1e-3, 3), (1e-9, 3e-4, 2e-4, 1), (1e-9, 1.2e-5, 1e-5, 1),
    (None, 3e-4, 3e-4, 3),
])
def test_step_size_follows_the_kl_and_too_large_a_step_ends_the_update(
        target_kl, learning_rate, follows, epochs, losses):
    model, optimiser, config = fresh(learning_rate=learning_rate, update_epochs=3)
    start, rollout = states(model), experience(model)
    if target_kl is None:  # what the update will reach
        probe, other, _ = fresh(learning_rate=learning_rate, update_epochs=3)
        target_kl = ppo.update(probe, other, rollout, config, torch.Generator().manual_seed(0),
                               1.0)["approx_kl"]
        losses.clear()
        assert same_bits(states(model), start)
    stats = ppo.update(model, optimiser, rollout, config, torch.Generator().manual_seed(0),
                       target_kl)
    assert [g["lr"] for g in optimiser.param_groups] == pytest.approx([follows, 1e-3])
    assert stats["learning_rate"] == pytest.approx(follows)
    assert len(losses) == epochs * config.num_minibatches
    kls = [kl.item() for *_, kl in losses[-config.num_minibatches:]]  # of the last pass
    assert stats["approx_kl"] == pytest.approx(np.mean(kls), rel=1e-4, abs=1e-9)


def test_actor_and_critic_are_clipped_each_on_its_own():
    model, optimiser, _ = fresh()
    obs = torch.randn(8, 5, generator=torch.Generator().manual_seed(0))
    small = model.policy(obs).mean.sum() * 1e-3
    loss = small + 1e3 * model.value(obs).sum()
    exact = torch.autograd.grad(loss, list(model.parameters()), retain_graph=True)
    ppo.descend(model, optimiser, loss, max_grad_norm=0.5)
    got = [p.grad for p in model.parameters()]
    n = len(list(model.actor.parameters()))
    for mine, right in zip(got[:n], exact[:n], strict=True):
        torch.testing.assert_close(mine, right)  # the critic's 1e3 does not scale it down
    norm = torch.cat([g.flatten() for g in exact[n:]]).norm()
    for mine, right in zip(got[n:], exact[n:], strict=True):
        torch.testing.assert_close(mine, right * 0.5 / norm)


# --- two ranks


def test_two_ranks_hold_the_same_bits_and_learn_what_one_does(tmp_path):
    """Episodes' length depends on the env: the ranks have different numbers of rows."""
    env = lambda index, steps: Probe(  # noqa: E731
        lambda obs, action, t: action + index, length=2 + 3 * index)

    def shared(rank=0, world=1):  # two passes over a share of one rollout
        model, optimiser, config = fresh(update_epochs=2, num_minibatches=1)
        mine = [x[:, rank::world] for x in experience(model, ends=False)]
        return ppo.update(model, optimiser, mine, config, torch.Generator(), 0.03), states(model)

    def main(rank):
        torch.manual_seed(rank)  # the parameters must not depend on it
        Probe.seeds.clear()
        rows, config = [], PPOConfig(total_timesteps=900, checkpoint_every=2, **SMALL)
        model, steps = learn(env, config, run_dir=tmp_path / "run",
                             on_update=lambda _, row: rows.append(row))
        moments = ppo.moments(torch.arange(4.0)[rank::3])  # 0, 3 and 1
        torch.save([states(model), steps, len(rows), moments, shared(rank, 2), Probe.seeds],
                   tmp_path / f"rank{rank}.pt")

    assert in_ranks(2, main) == [0, 0]
    (one, steps, calls, moments, mine, seeds), (two, other_steps, no_calls, _, others, more) = (
        torch.load(tmp_path / f"rank{rank}.pt") for rank in (0, 1))
    assert same_bits(one, two) and same_bits(mine[1], others[1]) and mine[0] == others[0]
    rows = table(tmp_path / "run")
    # 32 steps of 4 envs; of env k every (3 + 3 k)th is a reset: 10, 5, 3 and 2 of 32.
    assert int(rows[0]["steps"]) == 128 - 20
    assert one["normaliser.count"] == int(rows[-1]["steps"]) == steps == other_steps >= 900
    assert calls == len(rows) and no_calls == 0
    assert moments == pytest.approx([4 / 3, 14 / 9])
    assert len(seeds) == len(more) >= 2 * 4 and len({*seeds, *more}) == len(seeds) + len(more)
    stats, state = shared()
    assert mine[0] == pytest.approx(stats, rel=1e-4, abs=1e-7)
    torch.testing.assert_close(mine[1], state, rtol=1e-4, atol=1e-6)


# --- it learns


FOUR = [[1, 1], [1, -1], [-1, 1], [-1, -1]]


class Delayed(Probe):
    """Two steps; the observation is the time, the reward comes with the second step."""

    def __init__(self):
        super().__init__(lambda obs, action, t: t, length=2)

    def observe(self):
        self.obs = np.array([self.t, 0], np.float32)
        return self.obs


@pytest.mark.parametrize(("env", "updates", "gamma", "obs", "values"), [
    (lambda: Probe(signs=(0, 0)), 8, 0.9, [[0, 0]], [1]),
    (lambda: Probe(lambda obs, action, t: obs[0]), 15, 0.9, FOUR, [1, 1, -1, -1]),
    (Delayed, 15, 0.5, [[0, 0], [1, 0]], [0.5, 1]),
    # Reward 1 for ever: V = 1 / (1 - gamma). Taking the time limit for an end would give about 3.
    (lambda: Probe(length=5, truncates=True, signs=(0, 0)), 20, 0.8, [[0, 0]], [5]),
], ids=["constant reward", "reward is the observation", "delayed reward", "endless task"])
def test_values(env, updates, gamma, obs, values):
    model = train(env, updates, gamma=gamma)
    assert model.value(torch.tensor(obs)).tolist() == pytest.approx(values, abs=0.1)


def test_actions():
    """What pays is a positive action; and one that follows the observation."""
    model = train(lambda: Probe(lambda obs, action, t: np.sign(action), signs=(0, 0)), 20)
    assert model.mean_action(np.zeros(2)).item() > 0.6
    model = train(lambda: Probe(lambda obs, action, t: obs[0] * action), 20)
    assert (model.mean_action(FOUR)[:, 0] * np.array(FOUR)[:, 0] > 0.6).all()


def test_noise_and_target_kl_fall_linearly_over_the_training(monkeypatch):
    targets, rows, real = [], [], ppo.update
    monkeypatch.setattr(ppo, "update", lambda *args: targets.append(args[5]) or real(*args))
    config = PPOConfig(total_timesteps=4 * 128, init_std=0.5, noise=(1.0, 0.2),
                       target_kl=(0.05, 0.01), **SMALL)
    model, steps = learn(lambda index, steps: Probe(length=10_000), config,
                         on_update=lambda _, row: rows.append(row))
    assert steps == 512 and [row["steps"] for row in rows] == [128, 256, 384, 512]
    assert [row["std"] for row in rows] == pytest.approx([0.5, 0.4, 0.3, 0.2])
    assert targets == pytest.approx([0.05, 0.04, 0.03, 0.02])
    assert model.std.tolist() == pytest.approx([0.2])


def test_the_seed_decides_every_bit():
    env = lambda: Probe(lambda obs, action, t: obs[0] * action, length=3)  # noqa: E731
    one, two, other = (states(train(env, 4, seed=seed)) for seed in (3, 3, 4))
    assert same_bits(one, two) and not same_bits(one, other)


# --- spaces


def test_other_spaces_are_refused():
    env = Probe()
    env.action_space = gym.spaces.Discrete(2)
    with pytest.raises(ValueError, match=r"must be Box.*Discrete"):
        learn(lambda index, steps: env, PPOConfig(total_timesteps=1, num_envs=1))


@pytest.mark.parametrize("reward", [math.nan, math.inf])
def test_rewards_that_are_no_numbers_stop_the_training_and_reach_no_checkpoint(reward, tmp_path):
    env = lambda index, steps: Probe(lambda obs, action, t: next(rewards))  # noqa: E731
    rewards = iter([1.0] * 80 + [reward] * 80)
    with pytest.raises(FloatingPointError, match="infinite or NaN"):
        learn(env, PPOConfig(total_timesteps=999, checkpoint_every=1, **SMALL), run_dir=tmp_path)
    assert ppo.load_checkpoint(tmp_path / "checkpoint.pt")["history"][-1]["update"] == 1


# --- the run folder


def test_a_run_leaves_its_files_and_tells_on_update_what_it_writes(tmp_path):
    def on_update(model, row):
        rows.append(row)
        assert (tmp_path / "checkpoint.pt").exists()  # from the first update on

    rows, meta = [], {"tasks": ["left", "right"], "seed": 7}
    config = PPOConfig(total_timesteps=240, **SMALL)
    env = lambda index, steps: Probe(lambda obs, action, t: obs[0], length=20)  # noqa: E731
    model, steps = learn(env, config, run_dir=tmp_path, meta=meta, episode_keys=("t_cr", "fall"),
                         on_update=on_update)
    assert {path.name for path in tmp_path.iterdir()} == {
        "config.json", "progress.csv", "checkpoint.pt", "lock"}
    written = table(tmp_path)
    assert len(written) == 2 and set(written[0]) == {
        "update", "steps", "minutes", "return", "t_cr", "fall", "collect_s", "learn_s", "approx_kl",
        "clipfrac", "value_loss", "explained_variance", "std", "learning_rate"}
    for mine, told in zip(written, rows, strict=True):
        assert {k: float(v) for k, v in mine.items()} == pytest.approx(told, nan_ok=True)
    # The first checkpoint resets all envs, so of each 32 steps of an env the 21st is a reset.
    assert steps == rows[-1]["steps"] == 2 * 128 - 4 * 2 and rows[-1]["update"] == 2
    assert math.isnan(rows[-1]["fall"])
    assert json.loads((tmp_path / "config.json").read_text()) == {
        "ppo": json.loads(json.dumps(vars(config))), "meta": meta}
    loaded, kept = ppo.load_policy(tmp_path / "checkpoint.pt")
    assert kept == meta and same_bits(states(loaded), states(model))


def test_a_shared_policy_acts_alike_and_is_small(tmp_path):
    torch.manual_seed(0)
    model = ActorCritic(200, 17, n_scan=160, init_std=(0.3,) * 5 + (0.5,) * 12)
    torch.nn.init.normal_(model.actor.head.weight, std=0.3)
    model.normaliser.update(torch.randn(99, 200) * 3 + 100)
    ppo.save_policy(tmp_path / "p.pt", model, {"score": 0.5})
    loaded, meta = ppo.load_policy(tmp_path / "p.pt")
    obs = np.random.default_rng(0).normal(100, 3, (50, 200)).astype(np.float32)
    action = model.mean_action(obs)
    assert np.abs(action).max() > 0.5 and np.abs(loaded.mean_action(obs) - action).max() < 1e-3
    assert meta == {"score": 0.5} and loaded.kwargs == model.kwargs
    parameters = sum(p.numel() for p in model.actor.parameters())
    assert (tmp_path / "p.pt").stat().st_size < 2 * parameters + 20_000
    assert [path.name for path in tmp_path.iterdir()] == ["p.pt"]


class Trap:
    """Unpickled, it makes a directory."""

    def __reduce__(self):
        return os.mkdir, ("owned",)


def test_bad_checkpoints_are_refused_and_run_no_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "bad.pt"
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*bad\.pt"):
        ppo.load_checkpoint(path)
    ppo.save_policy(path, ActorCritic(2, 1), {})
    good = path.read_bytes()
    torch.save({"format": ppo.FORMAT, "x": Trap()}, tmp_path / "trap.pt")
    for content in (b"", b"hello", good[: len(good) // 2], good[:-1], pickle.dumps(Trap()),
                    (tmp_path / "trap.pt").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.pt is damaged"):
            ppo.load_policy(path)
    assert not (tmp_path / "owned").exists()
    for foreign in ({"weights": torch.zeros(2)}, [1], {"format": "ppo checkpoint 2"}):
        torch.save(foreign, path)
        with pytest.raises(ValueError, match=r"bad\.pt is not a checkpoint of this program"):
            ppo.load_policy(path)
