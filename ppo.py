"""Proximal Policy Optimization (Schulman et al. 2017) for any Gymnasium env with Box spaces.

Read it from top to bottom: the settings, the networks, two pure functions that hold the theory
(`compute_gae`, `ppo_loss`), `Collector`, which gathers experience, `update`, which learns from it,
and `learn`, the loop around them. It runs in one process or in many ("ranks"), which `loco_mtrl.py`
or torchrun starts, on one machine or several.

Shapes: T = num_steps, N = environments of one rank, B = any batch.
"""

import atexit
import contextlib
import fcntl
import io
import json
import math
import os
import signal
import time
from collections import deque
from dataclasses import asdict, dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
import torch.distributed as dist
from torch import nn
from torch.nn.utils import clip_grad_norm_, parameters_to_vector, vector_to_parameters
from tqdm import tqdm

FORMAT = "ppo checkpoint 3"


@dataclass(frozen=True)
class PPOConfig:
    """The settings of PPO; the defaults are the main job's, to which `train` adds n_scan, init_std.

    Of two values the first holds at the beginning of the training and the second at its end; in
    between it changes linearly. Raises ValueError that names a value out of range.
    """

    total_timesteps: int = 250_000  # environment steps over all ranks, resets not counted
    num_envs: int = 34  # environments over all ranks
    num_steps: int = 128  # steps of each environment between two updates
    gamma: float = 0.998  # discount per step
    gae_lambda: float = 0.95  # 0: one-step TD, little variance; 1: Monte Carlo, no bias
    update_epochs: int = 6  # passes over each rollout
    num_minibatches: int = 8  # gradient steps per pass
    clip_coef: float = 0.2  # a probability ratio earns nothing outside 1 +- clip_coef
    # Advantages are cut there, in standard deviations: otherwise a few would drown the rest. Falls
    # are the lowest. They must weigh more than what haste gains, or the policy runs over edges.
    max_advantage: float = 1.0
    max_disadvantage: float = 3.0  # below zero
    max_grad_norm: float = 1.0  # for the actor and the critic, each on its own
    target_kl: tuple[float, float] = (0.06, 0.04)  # nats by which one update moves the policy
    learning_rate: float = 5e-4  # the actor's at first; then, in 1e-5 to 1e-3, it follows target_kl
    critic_learning_rate: float = 1e-3  # constant: the critic does not move the policy
    init_std: float | tuple[float, ...] = 0.37  # of the exploration noise; or one per action entry
    noise: tuple[float, float] = (1.0, 0.5)  # share of init_std that is in force
    n_scan: int = 0  # entries of a scan that leads the observation and has its own encoder
    hidden: tuple[int, ...] = (64, 64)  # layer widths of each encoder, and of the trunk after them
    checkpoint_every: int = 25  # updates
    seed: int = 0

    def __post_init__(self):
        for name, value in vars(self).items():
            least = 0 if name in ("gamma", "gae_lambda", "n_scan", "seed") else 1e-9
            most = 1 if name in ("gamma", "gae_lambda") else 2**53
            values = np.atleast_1d(value)
            if not len(values) or not ((least <= values) & (values <= most)).all():
                raise ValueError(f"{name} must be from {least:g} to {most:g}, got {value!r}")


# ---------------------------------------------------------------- ranks


def join_ranks():
    """(rank, number of ranks): meets the other processes of RANK and WORLD_SIZE, if there are."""
    if int(os.environ.get("WORLD_SIZE", 1)) > 1 and not dist.is_initialized():
        store, rank, world = next(dist.rendezvous("env://"))
        # After a crash and in a new stage the store is the same: the old addresses are not.
        restart = os.environ.get("TORCHELASTIC_RESTART_COUNT"), os.environ.get("PPO_STAGE")
        store = dist.PrefixStore(str(restart), store)
        dist.init_process_group("gloo", store=store, rank=rank, world_size=world)
        atexit.register(dist.destroy_process_group)  # or its threads, now and then, abort the exit
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def sum_over_ranks(tensor):
    """Sums `tensor` over all ranks, in place; every rank gets the same bits. Returns it.

    Raises ConnectionError if a rank is gone.
    """
    if dist.is_initialized():
        try:
            dist.all_reduce(tensor)
        except RuntimeError as error:  # gloo's own words are about sockets
            raise ConnectionError("another rank was lost: this one ends, too") from error
    return tensor


def gather_from_ranks(thing):
    """A list of every rank's `thing`."""
    things = [thing] * join_ranks()[1]
    if len(things) > 1:
        dist.all_gather_object(things, thing)
    return things


def moments(x):
    """Mean and variance of x (B,) over all ranks, two numbers."""
    x = x.double()
    n, total, square = sum_over_ranks(torch.stack((torch.ones_like(x), x, x * x)).sum(1)).tolist()
    return total / n, max(square / n - (total / n) ** 2, 0.0)


# ---------------------------------------------------------------- networks


def mlp(*widths):
    """Linear layers, an ELU after each: (..., widths[0]) -> (..., widths[-1])."""
    layers = [(nn.Linear(*pair), nn.ELU()) for pair in pairwise(widths)]
    return nn.Sequential(*sum(layers, ()))


class TwoEncoders(nn.Module):
    """Exteroceptive and proprioceptive entries, each through its encoder, then a trunk (2.2).

    (..., obs_dim) -> (..., out_dim). A part of width 0 has no encoder.
    """

    def __init__(self, obs_dim, out_dim, n_scan, hidden):
        super().__init__()
        self.widths = [width for width in (n_scan, obs_dim - n_scan) if width]
        self.encoders = nn.ModuleList(mlp(width, *hidden) for width in self.widths)
        self.trunk = mlp(hidden[-1] * len(self.widths), *hidden)
        self.head = nn.Linear(hidden[-1], out_dim)

    def forward(self, obs):
        parts = zip(self.encoders, obs.split(self.widths, -1), strict=True)
        return self.head(self.trunk(torch.cat([encoder(part) for encoder, part in parts], -1)))


class Normaliser(nn.Module):
    """Running mean and variance of observations: (..., obs) -> (..., obs) float32, normalised.

    They are buffers: no policy is saved, loaded or sent without them.
    """

    def __init__(self, obs_dim):
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("sum_sq", torch.zeros(obs_dim, dtype=torch.float64))

    def forward(self, obs):
        std = (self.sum_sq / self.count).sqrt() + 1e-6 if self.count else torch.ones(())
        obs = (obs.float() - self.mean.float()) / std.float()
        return obs.clamp(-10, 10)  # one absurd sensor value must not throw the network far out

    @torch.no_grad()
    def update(self, obs):
        """Takes the observations (B, obs) of all ranks into mean and variance."""
        # Deviations from the old mean: sums of squares about 0 would cancel where mean >> std.
        deviation = obs.double() - self.mean
        sums = (torch.tensor([len(obs)]), deviation.sum(0), (deviation**2).sum(0))
        count, total, square = sum_over_ranks(torch.cat(sums)).split((1, *2 * self.mean.shape))
        self.count += count[0]
        self.mean += total / self.count
        # From about the old mean to about the new one. Rounding must not make a constant negative.
        self.sum_sq += square - total**2 / self.count
        self.sum_sq.clamp_(min=0)


class ActorCritic(nn.Module):
    """A Gaussian policy and a value function, with the normaliser of the observations they share.

    n_scan, hidden, init_std: see PPOConfig. Raises ValueError if the scan exceeds the observation
    or init_std has another length than the action.
    """

    def __init__(self, obs_dim, act_dim, n_scan=0, hidden=(64, 64), init_std=0.37):
        super().__init__()
        init_std = torch.tensor(init_std, dtype=torch.float32)
        if n_scan > obs_dim or init_std.ndim and len(init_std) != act_dim:
            raise ValueError(f"{n_scan} entries of a scan and {init_std.numel()} of init_std do not"
                             f" fit observations of {obs_dim} and actions of {act_dim}")
        # What rebuilds this network, in plain types: it goes into the checkpoint.
        self.kwargs = {"obs_dim": obs_dim, "act_dim": act_dim, "n_scan": n_scan,
                       "hidden": list(hidden), "init_std": init_std.tolist()}
        self.normaliser = Normaliser(obs_dim)
        self.actor = TwoEncoders(obs_dim, act_dim, n_scan, hidden)
        self.critic = TwoEncoders(obs_dim, 1, n_scan, hidden)
        with torch.no_grad():  # the first policy is the zero action plus noise, in every state
            self.actor.head.weight.mul_(0.01)
            self.actor.head.bias.zero_()
        self.register_buffer("std", init_std.expand(act_dim).clone())

    def policy(self, obs):
        """The distribution of actions: (..., obs) -> Normal over (..., act).

        Its mean is bounded by tanh: where actions are clipped, noise changes nothing and nothing is
        learned, so a mean that has grown beyond the bounds would stay there.
        """
        mean = self.actor(self.normaliser(obs)).tanh()
        return torch.distributions.Normal(mean, self.std, validate_args=False)

    def log_prob(self, obs, actions):
        """Log-density of actions: (..., obs), (..., act) -> (...)."""
        return self.policy(obs).log_prob(actions).sum(-1)

    def value(self, obs):
        """Expected discounted return: (..., obs) -> (...)."""
        return self.critic(self.normaliser(obs)).squeeze(-1)

    @torch.no_grad()
    def mean_action(self, obs):
        """The action without noise, NumPy to NumPy: (..., obs) -> (..., act) float32."""
        return self.policy(torch.as_tensor(np.asarray(obs))).mean.numpy()


# ---------------------------------------------------------------- the theory


def compute_gae(rewards, values, terminated, done, prev_done, gamma, gae_lambda):
    """Generalized advantage estimation (Schulman et al. 2016) under NEXT_STEP autoreset.

    A vector env gives an episode's last observation as the next observation, also at a time limit,
    and spends the step after it on the reset, with the action ignored. So V[t+1] is always the
    value of what really came after step t. Only a true ending (`terminated`) has no future; any
    ending (`done`, that is terminated or truncated) stops the sum. Where `prev_done`, the step is
    a reset, which belongs to no episode and must be left out of losses and statistics.

    All are (T, N), but values (T + 1, N): its last row is for the observation after the rollout.
    Returns advantages and returns (the critic's targets), (T, N) each, 0 in reset rows. Raises
    ValueError if the shapes do not fit.
    """
    shapes = [tuple(x.shape) for x in (values[1:], terminated, done, prev_done)]
    if shapes != [tuple(rewards.shape)] * 4:
        raise ValueError(f"rewards are {tuple(rewards.shape)}, so values[1:], terminated, done and "
                         f"prev_done must be, too; they are {shapes}")
    delta = rewards + gamma * values[1:] * ~terminated - values[:-1]  # (T, N)
    advantages = torch.zeros_like(delta)
    following = torch.zeros_like(delta[0])  # (N,)
    for t in reversed(range(len(delta))):
        advantages[t] = following = delta[t] + gamma * gae_lambda * following * ~done[t]
    return advantages * ~prev_done, (advantages + values[:-1]) * ~prev_done


def ppo_loss(log_prob, old_log_prob, advantages, clip_coef):
    """The clipped objective, to be minimised. All but clip_coef are (B,).

    Returns its mean, and of the same rows approx_kl, in nats (Schulman's k3, which is never
    negative and right on average), and clipfrac, the share of ratios outside the clip.
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    # The minimum takes the clip only where it makes the objective worse: the policy may always
    # come back, but earns nothing by going further.
    loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
    approx_kl = (torch.expm1(log_ratio) - log_ratio).mean()
    return loss, approx_kl, (ratio != clipped).float().mean()


# ---------------------------------------------------------------- collecting


class Collector:
    """This rank's environments, and where they are between two rollouts.

    Environment i of all num_envs is on rank i % world: where neighbours are alike, as tasks are,
    each rank has some of all kinds. keys: what to note of an episode's last info, beside "return".
    Raises ValueError if the spaces are not Box.
    """

    def __init__(self, make_env, num_envs, rank, world, keys=()):
        if num_envs < world:
            raise ValueError(f"{num_envs} environments are too few for {world} ranks")
        self.envs = gym.vector.SyncVectorEnv(
            [partial(make_env, index) for index in range(rank, num_envs, world)])
        spaces = self.envs.single_observation_space, self.envs.single_action_space
        if not all(isinstance(space, gym.spaces.Box) for space in spaces):
            raise ValueError("both spaces must be Box, but they are {} and {}".format(*spaces))
        self.obs_dim, self.act_dim = (math.prod(space.shape) for space in spaces)
        self.keys, self.episodes = keys, deque(maxlen=100)  # dicts of numbers
        self.generator = torch.Generator()

    def reset(self, *seed):
        """Begins new episodes. All that follows is a function of the whole numbers `seed`."""
        seeds = np.random.SeedSequence(seed).generate_state(self.envs.num_envs + 1, np.uint64)
        self.generator.manual_seed(int(seeds[-1]))
        self.next_obs, _ = self.envs.reset(seed=seeds[:-1].tolist())
        self.ended, self.returned = np.zeros((2, self.envs.num_envs))

    @torch.no_grad()
    def collect(self, model, num_steps):
        """A rollout of num_steps steps of the policy with its noise.

        Returns obs (T + 1, N, obs), unclipped actions (T, N, act), and rewards, terminated, done,
        prev_done (T, N).
        """
        shape, space = (num_steps, self.envs.num_envs), self.envs.single_action_space
        obs = torch.zeros(num_steps + 1, shape[1], self.obs_dim)
        noise = torch.randn(*shape, self.act_dim, generator=self.generator)
        actions, rewards = torch.zeros_like(noise), torch.zeros(shape)
        terminated, done, prev_done = torch.zeros(3, *shape, dtype=torch.bool)
        for t in range(num_steps):
            obs[t] = torch.from_numpy(self.next_obs).flatten(1)
            prev_done[t] = torch.from_numpy(self.ended)
            actions[t] = model.policy(obs[t]).mean + model.std * noise[t]
            command = actions[t].numpy().reshape(self.envs.action_space.shape)
            command = command.clip(space.low, space.high).astype(space.dtype)
            self.next_obs, reward, terminal, truncated, info = self.envs.step(command)
            self.ended = terminal | truncated
            rewards[t], terminated[t] = torch.from_numpy(reward), torch.from_numpy(terminal)
            done[t] = torch.from_numpy(self.ended)
            self.returned += reward
            for i in np.flatnonzero(self.ended):
                # Gymnasium pads what an env does not give: its masks, "_name", say who does.
                given = {key: float(info[key][i]) for key in self.keys
                         if key in info and info[f"_{key}"][i]}
                self.episodes.append({"return": float(self.returned[i]), **given})
            self.returned[self.ended] = 0
        obs[-1] = torch.from_numpy(self.next_obs).flatten(1)
        return obs, actions, rewards, terminated, done, prev_done

    def averages(self):
        """Means of "return" and the keys over each rank's last 100 episodes; NaN where unknown."""
        names = ("return", *self.keys)
        known = [[e[name] for e in self.episodes if name in e] for name in names]
        sums = [[sum(values), len(values)] for values in known]
        totals, counts = sum_over_ranks(torch.tensor(sums, dtype=torch.float64)).T
        return dict(zip(names, (totals / counts).tolist(), strict=True))


# ---------------------------------------------------------------- learning


def with_images(x, index, sign):
    """Every row and, after them, every row's left-right mirror image: (B, D) -> (2 B, D).

    Robot, tasks and reward are alike on both sides, so an image is as good an experience. The
    image of a row x is x[index] * sign.
    """
    return torch.cat((x, x[:, torch.as_tensor(index)] * torch.as_tensor(sign, dtype=x.dtype)))


def update(model, optimiser, rollout, config, generator, target_kl, mirror=None):
    """Several epochs of clipped gradient steps on one rollout, on all ranks together.

    Args:
        optimiser: with two parameter groups, the actor's (whose step size it adapts), the critic's.
        rollout: what Collector.collect returns.
        mirror: (index, sign) for observations and for actions, see `with_images`; None: there is
            no such symmetry.

    Returns a dict of plain numbers, the same on every rank: columns of progress.csv.
    """
    obs, actions, rewards, terminated, done, prev_done = rollout
    with torch.no_grad():
        values = model.value(obs)
    advantages, returns = compute_gae(rewards, values, terminated, done, prev_done,
                                      config.gamma, config.gae_lambda)
    kept = ~prev_done
    obs, actions = obs[:-1][kept], actions[kept]
    advantages, returns = advantages[kept], returns[kept]
    (mean, error), (_, variance) = moments(advantages), moments(returns)
    advantages = (advantages - mean) / (math.sqrt(error) + 1e-8)
    advantages = advantages.clamp(-config.max_disadvantage, config.max_advantage)
    advantages = advantages - moments(advantages)[0]  # the cut has moved the mean
    if mirror:
        obs, actions = with_images(obs, *mirror[0]), with_images(actions, *mirror[1])
        advantages, returns = advantages.repeat(2), returns.repeat(2)
    with torch.no_grad():
        old_log_prob = model.log_prob(obs, actions)
    if len(obs) < config.num_minibatches:
        raise ValueError(f"{len(obs)} rows are too few for {config.num_minibatches} minibatches")

    for _epoch in range(config.update_epochs):
        stats = torch.zeros(3)  # value loss, approx_kl, clipfrac
        # tensor_split, not split: the same number of minibatches on every rank, or they deadlock.
        shuffled = torch.randperm(len(obs), generator=generator)
        for rows in shuffled.tensor_split(config.num_minibatches):
            loss, *kl_and_clip = ppo_loss(model.log_prob(obs[rows], actions[rows]),
                                          old_log_prob[rows], advantages[rows], config.clip_coef)
            value_loss = 0.5 * ((model.value(obs[rows]) - returns[rows]) ** 2).mean()
            # Nothing weighs one against the other: actor and critic share no parameter.
            descend(model, optimiser, loss + value_loss, config.max_grad_norm)
            stats += torch.stack((value_loss, *kl_and_clip)).detach()
        stats = sum_over_ranks(stats) / config.num_minibatches / join_ranks()[1]
        value_loss, approx_kl, clipfrac = stats.tolist()
        if approx_kl > 2 * target_kl:  # a number of all ranks, so that all of them stop
            break
    actor = optimiser.param_groups[0]
    if approx_kl > 2 * target_kl:
        actor["lr"] = min(actor["lr"], max(actor["lr"] / 1.5, 1e-5))
    elif approx_kl < target_kl / 2:
        actor["lr"] = max(actor["lr"], min(actor["lr"] * 1.5, 1e-3))
    model.normaliser.update(obs)  # only now: the old and the new policy must see the same scale
    # The critic's errors are the advantages, since returns = advantages + values.
    return {"approx_kl": approx_kl, "clipfrac": clipfrac, "value_loss": value_loss,
            "explained_variance": 1 - error / variance if variance > 0 else math.nan,
            "std": model.std.mean().item(), "learning_rate": actor["lr"]}


def descend(model, optimiser, loss, max_grad_norm):
    """One gradient step on the mean of all ranks' losses."""
    optimiser.zero_grad()
    loss.backward()
    gradients = [parameter.grad for parameter in model.parameters()]
    total = sum_over_ranks(parameters_to_vector(gradients))  # one message instead of twenty
    vector_to_parameters(total / join_ranks()[1], gradients)
    for group in optimiser.param_groups:
        clip_grad_norm_(group["params"], max_grad_norm)
    optimiser.step()


def make_model(config, collector, checkpoint=None):
    """The ActorCritic and its optimiser, new or as they were; equal on every rank.

    Raises ValueError if the checkpoint's network is another one.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = ActorCritic(collector.obs_dim, collector.act_dim, config.n_scan, config.hidden,
                            config.init_std)
    optimiser = torch.optim.Adam(
        [{"params": list(model.actor.parameters()), "lr": config.learning_rate},
         {"params": list(model.critic.parameters()), "lr": config.critic_learning_rate}],
        fused=True)
    if checkpoint:
        if checkpoint["kwargs"] != model.kwargs:
            raise ValueError(f"the checkpoint's network is {checkpoint['kwargs']}, but what is "
                             f"asked for is {model.kwargs}")
        model.load_state_dict(checkpoint["model"])
        optimiser.load_state_dict(checkpoint["optimiser"])
    return model, optimiser


def iterate(model, optimiser, collector, config, progress, mirror):
    """One iteration of PPO: a rollout and an update. progress: share of the training that is done.

    Returns a dict of numbers, columns of progress.csv, and how many steps were taken. Raises
    FloatingPointError if the parameters stop being numbers.
    """
    noise, target_kl = (first + progress * (last - first)
                        for first, last in (config.noise, config.target_kl))
    model.std.copy_(noise * torch.tensor(config.init_std))
    start = time.perf_counter()
    rollout = collector.collect(model, config.num_steps)
    collected = time.perf_counter()
    stats = update(model, optimiser, rollout, config, collector.generator, target_kl, mirror)
    if not all(tensor.isfinite().all() for tensor in model.state_dict().values()):
        raise FloatingPointError("an update made parameters infinite or NaN: are all rewards and "
                                 "observations of the env numbers?")
    seconds = {"collect_s": collected - start, "learn_s": time.perf_counter() - collected}
    return seconds | stats, int((~rollout[-1]).sum())


# ---------------------------------------------------------------- the files of a run


def write_whole(path, content):
    """Writes bytes; `path` is whole or as it was, even if the power fails or the disk is full."""
    part = Path(f"{path}.tmp")
    try:
        with open(part, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)  # or it would keep a full disk full


def save(path, **content):
    """Writes a checkpoint or a policy: tensors and plain values."""
    buffer = io.BytesIO()  # torch's own words about a full disk are no OSError
    torch.save({"format": FORMAT, **content}, buffer)
    write_whole(path, buffer.getvalue())


def save_policy(path, model, meta):
    """Writes a policy to share: in half precision, without critic. `meta`: dict of plain values."""
    state = {name: tensor.half() if tensor.dtype == torch.float32 else tensor
             for name, tensor in model.state_dict().items() if not name.startswith("critic.")}
    save(path, kwargs=model.kwargs, model=state, meta=meta)


def load_checkpoint(path):
    """The dict in a checkpoint or a policy. Runs no code that a file may carry.

    Raises FileNotFoundError if there is none, ValueError if it is damaged or not one of ours.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no checkpoint at {path}")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds, over many lines
        raise ValueError(f"{path} is damaged, or holds more than plain data") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} is not a checkpoint of this program ({FORMAT!r})")
    return content


def load_policy(path):
    """(ActorCritic, meta) of a checkpoint or a policy; raises as load_checkpoint."""
    checkpoint = load_checkpoint(path)
    try:
        model = ActorCritic(**checkpoint["kwargs"])
        missing = model.critic.state_dict(prefix="critic.")  # a shared policy has no critic
        model.load_state_dict({**missing, **checkpoint["model"]})
        return model, checkpoint["meta"]
    except (KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path} is damaged: no network fits what it holds") from error


class RunFolder:
    """The folder of a run: config.json, progress.csv, checkpoint.pt. Rank 0 alone has one.

    `checkpoint` is what to go on from, or None; its "history" holds the rows of progress.csv.
    Raises FileExistsError rather than write over a run, BlockingIOError if another process writes
    there, ValueError if a run is resumed with another `meta`, and what load_checkpoint raises.
    """

    def __init__(self, path, config, meta, resume):
        self.path, self.checkpoint = Path(path), None
        self.note = json.dumps({"ppo": asdict(config), "meta": meta}, indent=2)
        self.meta = json.loads(self.note)["meta"]
        if resume:
            self.checkpoint = load_checkpoint(self.path / "checkpoint.pt")
            if self.checkpoint["meta"] != self.meta or "optimiser" not in self.checkpoint:
                raise ValueError(f"{path} holds another run: {self.checkpoint['meta']}")
        elif (self.path / "checkpoint.pt").exists():
            raise FileExistsError(f"{path} already holds a run: resume it, or name another folder")
        self.path.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.path / "lock", "w")
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.lock.close()
            raise BlockingIOError(f"another process is training in {path}") from None

    def log(self, history):
        """Writes progress.csv: a row, a dict of numbers, for each update."""
        rows = [history[0], *(map("{:.10g}".format, row.values()) for row in history)]
        write_whole(self.path / "progress.csv", "\n".join(map(",".join, rows)).encode() + b"\n")

    def save(self, model, optimiser, history, episodes):
        """Writes checkpoint.pt and config.json."""
        save(self.path / "checkpoint.pt", kwargs=model.kwargs, model=model.state_dict(),
             optimiser=optimiser.state_dict(), history=history, episodes=episodes,
             meta=self.meta)
        write_whole(self.path / "config.json", self.note.encode() + b"\n")


def open_run(run_dir, config, meta, resume):
    """(RunFolder or None, checkpoint or None): rank 0 opens the folder, all know what it held."""
    if resume and run_dir is None:
        raise ValueError("resume = True, but there is no run_dir to go on from")
    run, found = None, [None]
    rank, _ = join_ranks()
    if run_dir is not None and rank == 0:
        try:
            run = RunFolder(run_dir, config, meta, resume)
            found = [run.checkpoint]
        except (OSError, ValueError, TypeError) as error:
            found = [error]
    if dist.is_initialized():  # only rank 0's machine has the folder
        dist.broadcast_object_list(found)
    if isinstance(found[0], Exception):
        raise found[0] if rank == 0 else SystemExit(2)  # one message is enough
    return run, found[0]


# ---------------------------------------------------------------- the loop


@contextlib.contextmanager
def note_interrupt():
    """A list that the first Ctrl-C makes true; a second Ctrl-C raises KeyboardInterrupt."""
    def note(*_):
        came.append(True)
        signal.signal(signal.SIGINT, signal.default_int_handler)

    came, before = [], signal.signal(signal.SIGINT, note)
    try:
        yield came
    finally:
        signal.signal(signal.SIGINT, before)


def learn(make_env, config, *, run_dir=None, resume=False, mirror=None, meta=None,
          episode_keys=(), on_update=None, stage_end=lambda steps: math.inf):
    """Trains on `make_env` until config.total_timesteps. Returns the ActorCritic and its steps.

    Args:
        make_env: function of the environment's number over all ranks, and of the steps so far, to a
            Gymnasium env with Box spaces. What the env gets is clipped to its action space, and the
            policy's mean lies in (-1, 1): other bounds need gymnasium.wrappers.RescaleAction.
        run_dir: folder of the run's files; None: no files. resume: go on from its checkpoint.
        mirror: see `update`. episode_keys: see Collector. meta: plain dict kept in the checkpoint.
        on_update: called on rank 0 after every update as on_update(model, row of progress.csv).
        stage_end: function of the steps so far to those at which to return before the end.

    At each checkpoint all envs are reset, and random numbers start afresh from (seed, update,
    rank): a run that was stopped goes on to the last bit as one that was not (with as many ranks).
    Ctrl-C stops all ranks after the running update, with a checkpoint, by KeyboardInterrupt; a
    second one aborts. Also raises what iterate, RunFolder, Collector and ActorCritic raise.
    """
    torch.set_num_threads(1)  # more threads only cost time on nets this small
    rank, world = join_ranks()
    run, checkpoint = open_run(run_dir, config, meta, resume)
    history = checkpoint["history"] if checkpoint else []
    steps, minutes = (history[-1]["steps"], history[-1]["minutes"]) if history else (0, 0.0)
    total, shown = config.total_timesteps, ["return", *episode_keys[:1]]
    end, fresh, stopped = min(stage_end(steps), total), True, False
    with contextlib.ExitStack() as stack:
        stack.enter_context(run.lock if run else contextlib.nullcontext())
        collector = Collector(partial(make_env, steps=steps), config.num_envs, rank, world,
                              episode_keys)
        stack.enter_context(contextlib.closing(collector.envs))
        model, optimiser = make_model(config, collector, checkpoint)
        if checkpoint and rank < len(checkpoint["episodes"]):
            collector.episodes.extend(checkpoint["episodes"][rank])
        interrupted = stack.enter_context(note_interrupt())
        bar = stack.enter_context(tqdm(total=total, initial=steps, unit="step", disable=rank > 0))
        while steps < end and not stopped:
            if fresh:
                collector.reset(config.seed, len(history), rank)
            stats, seen = iterate(model, optimiser, collector, config, steps / total, mirror)
            seen, stopped = sum_over_ranks(torch.tensor([seen, bool(interrupted)])).tolist()
            steps += seen
            minutes += (stats["collect_s"] + stats["learn_s"]) / 60
            row = {"update": len(history) + 1, "steps": steps, "minutes": minutes,
                   **collector.averages(), **stats}
            history.append(row)
            fresh = (len(history) == 1 or len(history) % config.checkpoint_every == 0 or stopped
                     or steps >= end)
            bar.update(seen)
            bar.set_postfix({name: f"{row[name]:.3g}" for name in shown})
            episodes = gather_from_ranks(list(collector.episodes)) if fresh else []
            if run:
                run.log(history)
                if fresh:
                    run.save(model, optimiser, history, episodes)
            if on_update and rank == 0:
                on_update(model, row)
        bar.leave = stopped or steps >= total  # in the end there is one bar, not one a stage
    if stopped or interrupted:
        raise KeyboardInterrupt
    return model, steps
