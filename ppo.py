"""Proximal Policy Optimization (Schulman et al. 2017) for any Gymnasium env with Box spaces.

Read it from top to bottom: the settings, the network, two pure functions that hold the theory
(`compute_gae`, `ppo_loss`), one update of the parameters, the run's files, and `learn`, the loop
around them: one process or, started by torchrun, all cores or several machines.

Shapes: T = num_steps, N = num_envs of one rank, B = any batch.
"""

import atexit
import csv
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
from tqdm import tqdm

FORMAT = "ppo checkpoint 1"


@dataclass(frozen=True)
class PPOConfig:
    """Every number PPO needs. Raises ValueError that names a bad value and what is valid."""

    total_timesteps: int = 1_000_000  # environment steps over all ranks, resets not counted
    num_envs: int = 12  # environments per rank
    num_steps: int = 160  # steps per environment between two updates
    gamma: float = 0.99  # discount per step
    gae_lambda: float = 0.95  # 0: one-step TD, little variance; 1: Monte Carlo, no bias
    update_epochs: int = 4  # passes over each rollout
    num_minibatches: int = 4  # gradient steps per pass
    clip_coef: float = 0.2  # a probability ratio earns nothing outside 1 +- clip_coef
    # Largest advantage, in standard deviations. A few falls and finds, many times the rest, fill
    # the gradient with noise; bounded, they still say good or bad.
    max_advantage: float = 10.0
    # How much of what the actor learns comes from a guide (see `learn`): 0, nothing; 1, all of it,
    # and nothing from rewards.
    guide_share: float = 0.0
    max_grad_norm: float = 1.0  # for the actor and the critic, each on its own
    # The actor's step size of a run that begins; it then follows target_kl, over resumptions, too.
    learning_rate: float = 3e-4
    min_learning_rate: float = 1e-4  # but never falls below this (too small: learning stops)
    max_learning_rate: float = 1e-3  # nor rises above this
    critic_learning_rate: float = 1e-3  # constant: the critic does not move the policy
    target_kl: float = 0.01  # nats by which one update should move the policy
    init_std: float | tuple[float, ...] = 0.37  # of the exploration noise; or one per action entry
    max_std: float = 10.0  # upper bound of that noise at any time
    # Share of that noise that lives on to the next step, again one or one per action entry. White
    # noise (0) is thirty small nudges a second that cancel out; noise that lasts tries out turns.
    noise_correlation: float | tuple[float, ...] = 0.0
    exteroceptive: tuple[int, int] = (0, 0)  # rows, columns of a scan that leads the observation
    encoder_hidden: tuple[int, ...] = (128, 64)  # layer widths of each encoder
    trunk_hidden: tuple[int, ...] = (64, 64)  # layer widths after the encoders
    checkpoint_every: int = 50  # updates
    seed: int = 0

    def __post_init__(self):
        def check(name, good, valid):
            if not good:
                raise ValueError(f"{name} = {getattr(self, name)!r}, but it must be {valid}")

        for name, value in vars(self).items():
            values = value if isinstance(value, tuple) else (value,)
            if name == "exteroceptive":
                good = len(value) == 2 and all(isinstance(n, int) and n >= 0 for n in value)
                check(name, good, "two whole numbers of at least 0, rows and columns")
            elif name.endswith("_hidden"):
                good = len(value) > 0 and all(isinstance(w, int) and w >= 1 for w in value)
                check(name, good, "a non-empty tuple of whole numbers of at least 1")
            elif name in ("gamma", "gae_lambda", "noise_correlation", "guide_share"):
                check(name, values and all(0 <= v <= 1 for v in values), "in [0, 1]")
            elif isinstance(getattr(PPOConfig, name), int):
                least = 0 if name == "seed" else 1
                good = isinstance(value, int) and value >= least
                check(name, good, f"a whole number of at least {least}")
            else:
                check(name, values and all(0 < v < math.inf for v in values), "above 0 and finite")
        low, high = self.min_learning_rate, self.max_learning_rate
        check("learning_rate", low <= self.learning_rate <= high, f"in [{low}, {high}]")
        rows = self.num_envs * self.num_steps
        check("num_minibatches", self.num_minibatches <= rows, f"at most {rows}")


def sum_over_ranks(tensor):
    """Sum `tensor` over all ranks, in place; every rank gets the same bits. Returns it.

    Raises ConnectionError if a rank is gone.
    """
    if dist.is_initialized():
        try:
            dist.all_reduce(tensor)
        except RuntimeError as error:  # gloo's own words are about sockets
            raise ConnectionError("another rank was lost: this one ends, too") from error
    return tensor


def mlp(*widths):
    """Linear layers, an ELU after each: (..., widths[0]) -> (..., widths[-1])."""
    layers = [(nn.Linear(*pair), nn.ELU()) for pair in pairwise(widths)]
    return nn.Sequential(*sum(layers, ()))


class ScanEncoder(nn.Module):
    """One small network reads each column of a scan, the next one reads what it said of them all.

    So what a wall or an edge looks like is learned once, not once for each direction. Maps
    (..., rows * columns), row by row, to (..., out_dim).
    """

    def __init__(self, rows, columns, out_dim):
        super().__init__()
        self.shape = rows, columns
        self.column, self.scan = mlp(rows, 32, 16), mlp(16 * columns, out_dim)

    def forward(self, scan):
        columns = scan.unflatten(-1, self.shape).transpose(-1, -2)
        return self.scan(self.column(columns).flatten(-2))


class TwoEncoders(nn.Module):
    """Exteroceptive and proprioceptive entries, each through its encoder, then one trunk.

    Maps (..., obs_dim) to (..., out_dim). A part of width 0 has no encoder.
    """

    def __init__(self, obs_dim, out_dim, exteroceptive, encoder_hidden, trunk_hidden):
        super().__init__()
        n_scan = math.prod(exteroceptive)
        self.widths = [w for w in (n_scan, obs_dim - n_scan) if w > 0]
        self.encoders = nn.ModuleList()
        if n_scan > 0:
            self.encoders.append(ScanEncoder(*exteroceptive, encoder_hidden[-1]))
        if n_scan < obs_dim:
            self.encoders.append(mlp(obs_dim - n_scan, *encoder_hidden))
        self.trunk = mlp(encoder_hidden[-1] * len(self.widths), *trunk_hidden)
        self.head = nn.Linear(trunk_hidden[-1], out_dim)

    def forward(self, obs):
        parts = zip(self.encoders, obs.split(self.widths, -1), strict=True)
        return self.head(self.trunk(torch.cat([encoder(part) for encoder, part in parts], -1)))


def flip(x, index, sign):
    """The left-right mirror image of observations or actions (..., D)."""
    return x[..., index] * sign


class ActorCritic(nn.Module):
    """A Gaussian policy, a value function, and the normaliser of the observations they share.

    exteroceptive, init_std, the hidden widths: see PPOConfig. mirror: None, or (obs_index,
    obs_sign, act_index, act_sign): the left-right mirror image of an observation o is
    `o[obs_index] * obs_sign`, and likewise for an action. The networks see o, with 1 appended,
    and its image, with -1, and their outputs are averaged. So what is learned for one side is
    known for the other; and thanks to the number appended the policy may still prefer a side,
    as it must before a wall that is as wide on the left as on the right.

    Raises ValueError if the scan exceeds the observation, the mirror is not its own inverse, or
    init_std has another length than the action.
    """

    def __init__(self, obs_dim, act_dim, exteroceptive=(0, 0), encoder_hidden=(128, 64),
                 trunk_hidden=(64, 64), init_std=0.37, mirror=None):
        super().__init__()
        if not 0 <= math.prod(exteroceptive) <= obs_dim:
            raise ValueError(f"a scan of {exteroceptive}, but an observation has {obs_dim} entries")
        self.flip_obs = self.flip_act = None
        if mirror is not None:
            mirror = [np.asarray(part).astype(int).tolist() for part in mirror]
            for size, index, sign in ((obs_dim, *mirror[:2]), (act_dim, *mirror[2:])):
                if sorted(index) != list(range(size)) or len(sign) != size or any(
                    index[index[i]] != i or sign[i] * sign[index[i]] != 1 for i in range(size)
                ):
                    raise ValueError(f"mirror: twice must give {size} entries back: {index} {sign}")
            parts = [torch.tensor(part) for part in mirror]
            self.flip_obs, self.flip_act = parts[:2], parts[2:]
        std = torch.tensor(init_std, dtype=torch.float32)
        if std.ndim and len(std) != act_dim:
            raise ValueError(f"init_std has {len(std)} entries, but an action has {act_dim}")
        # What rebuilds this network, in plain types: it goes into the checkpoint.
        self.kwargs = {"obs_dim": obs_dim, "act_dim": act_dim, "exteroceptive": list(exteroceptive),
                       "encoder_hidden": list(encoder_hidden), "trunk_hidden": list(trunk_hidden),
                       "init_std": std.tolist(), "mirror": mirror}
        n_in = obs_dim + (mirror is not None)
        self.actor = TwoEncoders(n_in, act_dim, exteroceptive, encoder_hidden, trunk_hidden)
        self.critic = TwoEncoders(n_in, 1, exteroceptive, encoder_hidden, trunk_hidden)
        with torch.no_grad():  # the first policy is the zero action plus noise, in every state
            self.actor.head.weight.mul_(0.01)
            self.actor.head.bias.zero_()
        self.free_log_std = nn.Parameter(std.log().expand(act_dim).clone())
        # Buffers, so that a policy is never saved, loaded or sent without its normaliser.
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_sum_sq", torch.zeros(obs_dim, dtype=torch.float64))

    def views(self, obs):
        """What the networks see: normalised observations, (..., obs) -> (..., 1, obs) float32.

        Or (..., 2, obs + 1) with the mirror image, and the side in the last column.
        """
        obs = obs.float()
        if self.count > 0:
            std = (self.obs_sum_sq / self.count).sqrt() + 1e-6  # an entry may be constant
            obs = (obs - self.obs_mean.float()) / std.float()
        # Clipped: one absurd sensor value must not throw the network out of all it has seen.
        obs = obs.clamp(-10, 10)
        if not self.flip_obs:
            return obs.unsqueeze(-2)
        side = torch.ones_like(obs[..., :1])
        image = flip(obs, *self.flip_obs)
        return torch.stack((torch.cat((obs, side), -1), torch.cat((image, -side), -1)), -2)

    def _mean(self, views):
        out = self.actor(views).unbind(-2)
        out = (out[0] + flip(out[1], *self.flip_act)) / 2 if self.flip_act else out[0]
        return out.tanh()

    def mean(self, obs):
        """Mean of the policy, in (-1, 1): (..., obs) -> (..., act).

        Bounded, for where actions are clipped, noise changes nothing and nothing is learned: a mean
        that has once grown beyond the bounds would stay there.
        """
        return self._mean(self.views(obs))

    def log_std(self):
        """Logarithm of the exploration noise's standard deviation: (act,)."""
        free = self.free_log_std
        return (free + free[self.flip_act[0]]) / 2 if self.flip_act else free

    @torch.no_grad()
    def limit_std(self, max_std):
        """Keep the exploration noise's standard deviation at `max_std` or below."""
        self.free_log_std.clamp_(max=math.log(max_std))

    def value(self, obs):
        """Expected discounted return: (..., obs) -> (...)."""
        return self.critic(self.views(obs)).mean((-2, -1))

    def _log_density(self, noise):
        """Log-density of the action that `noise` standard deviations off the mean are: (...)."""
        return (-0.5 * noise**2 - self.log_std() - 0.5 * math.log(2 * math.pi)).sum(-1)

    def evaluate(self, views, actions):
        """Log-density of `actions` (..., act) and values, (...) each, then the policy's mean.

        Where `views(obs)` was seen: a rollout's are made once and serve all its minibatches.
        """
        mean = self._mean(views)
        noise = (actions - mean) / self.log_std().exp()
        return self._log_density(noise), self.critic(views).mean((-2, -1)), mean

    @torch.no_grad()
    def act(self, obs, noise):
        """Actions, unclipped, and their log-density for `noise`, standard normal.

        (..., obs), (..., act) -> (..., act), (...).
        """
        return self.mean(obs) + self.log_std().exp() * noise, self._log_density(noise)

    @torch.no_grad()
    def mean_action(self, obs):
        """The action without noise, NumPy to NumPy: (..., obs) -> (..., act) float32."""
        return self.mean(torch.as_tensor(np.asarray(obs))).numpy()

    @torch.no_grad()
    def update_normaliser(self, obs):
        """Take the observations (B, obs) of this rank, and so of all ranks, into mean and std."""
        # Deviations from the old mean: sums of squares about 0 would cancel where mean >> std.
        deviation = obs.double() - self.obs_mean
        count = torch.tensor([len(obs)], dtype=torch.float64)
        total, square = deviation.sum(0), (deviation**2).sum(0)
        if self.flip_obs:  # the mean is symmetric, so deviations mirror as observations do
            count, total = 2 * count, total + flip(total, *self.flip_obs)
            square = square + square[self.flip_obs[0]]
        sums = sum_over_ranks(torch.cat((count, total, square)))
        count, total, square = sums.split((1, len(total), len(square)))
        self.count += count[0]
        self.obs_mean += total / self.count
        # From about the old mean to about the new one. Rounding must not make a constant negative.
        self.obs_sum_sq += square - total**2 / self.count
        self.obs_sum_sq.clamp_(min=0)


def compute_gae(rewards, values, terminated, done, prev_done, gamma, gae_lambda):
    """Generalized advantage estimation (Schulman et al. 2016) under NEXT_STEP autoreset.

    A vector env gives an episode's last observation as the next observation, also at a time limit,
    and spends the step after it on the reset, with the action ignored. So V[t+1] is always the
    value of what really came after step t: no extra call of the critic at a time limit. Only a
    true ending (`terminated`) has no future; any ending (`done`) stops the sum.

    Args:
        rewards, terminated, done: (T, N); done = terminated or truncated at step t.
        values: (T + 1, N), the last row for the observation after the rollout.
        prev_done: (T, N), whether step t is a reset row, the step before it having been done.

    Returns advantages and returns (the critic's targets), (T, N) each. Both are 0 in reset rows,
    which belong to no episode and must be left out of losses and statistics. Raises ValueError if
    the shapes do not fit.
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


def ppo_loss(log_prob, old_log_prob, advantages, values, returns, clip_coef):
    """The clipped objective, row by row: all arguments but clip_coef are (B,).

    Returns (4, B): policy loss, value loss, approx_kl and clipfrac of each row. Minimise the mean
    of the first two. Nothing weighs one against the other: actor and critic share no parameter.
    approx_kl is Schulman's k3, never negative and right on average, in nats.
    """
    log_ratio = log_prob - old_log_prob
    ratio = log_ratio.exp()
    clipped = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    # The minimum believes the clip only where it makes the objective worse: the policy may always
    # come back, but earns nothing by going further.
    policy_loss = -torch.minimum(ratio * advantages, clipped * advantages)
    value_loss = 0.5 * (values - returns) ** 2
    approx_kl = torch.expm1(log_ratio) - log_ratio
    return torch.stack((policy_loss, value_loss, approx_kl, (ratio != clipped).to(ratio.dtype)))


def guide_loss(mean, guide):
    """How far the policy's mean is from the guide's advice, (B, act) each: (B,).

    Advice that is NaN counts for nothing. The distance is absolute, not squared: where a guide who
    knows more turns left as often as right, the least squares lie in the middle, and in the wall.
    """
    return (mean - torch.where(guide.isnan(), mean.detach(), guide)).abs().sum(-1)


def ppo_update(model, optimiser, batch, config, generator):
    """Several epochs of clipped gradient steps on one rollout, on all ranks together.

    Args:
        batch: model.views of observations (B, ...), actions (B, act), old log-densities,
            advantages and returns (B,), the guide's advice (B, act). B may differ from rank to
            rank, since each has its own number of reset rows.
        optimiser: with two parameter groups, the actor's (whose step size it adapts), the critic's.

    Returns a dict of plain numbers, the same on every rank: columns of progress.csv.
    """
    views, actions, old_log_prob, advantages, returns, guide = batch
    a, r = advantages.double(), returns.double()
    moments = sum_over_ranks(torch.stack((torch.ones_like(a), a, a**2, r, r**2)).sum(1))
    a_mean, a_square, r_mean, r_square = (moments[1:] / moments[0]).tolist()
    a_var, r_var = max(a_square - a_mean**2, 0.0), max(r_square - r_mean**2, 0.0)
    advantages = (advantages - a_mean) / (math.sqrt(a_var) + 1e-8)
    advantages = advantages.clamp(-config.max_advantage, config.max_advantage)

    # Every gradient is a view into one flat tensor, with the minibatch's sums behind them: a single
    # all_reduce gives all ranks the gradient, the KL and the number of rows. Ranks may bring
    # different numbers of rows: they add sums, and the one division by all rows comes after.
    parameters = list(model.parameters())
    sizes = [p.numel() for p in parameters]
    flat = torch.zeros(sum(sizes) + 6)
    for p, gradient in zip(parameters, flat.split([*sizes, 6]), strict=False):
        p.grad = gradient.view_as(p)

    for _epoch in range(config.update_epochs):
        pieces = torch.zeros(5)
        # tensor_split, not split: the same number of minibatches on every rank, or they deadlock.
        shuffled = torch.randperm(len(views), generator=generator)
        for rows in shuffled.tensor_split(config.num_minibatches):
            flat.zero_()
            log_prob, values, mean = model.evaluate(views[rows], actions[rows])
            if config.guide_share == 1:  # ratios may overflow then, and 0 times infinity is not 0
                log_prob = log_prob.detach()
            loss = ppo_loss(log_prob, old_log_prob[rows], advantages[rows], values, returns[rows],
                            config.clip_coef).sum(1)
            distance = guide_loss(mean, guide[rows]).sum()
            objective = config.guide_share * distance + loss[1]
            if config.guide_share < 1:
                objective = objective + (1 - config.guide_share) * loss[0]
            objective.backward()
            flat[-6:-1] = torch.stack((*loss.detach(), distance.detach()))
            flat[-1] = len(rows)
            sum_over_ranks(flat)
            flat /= max(flat[-1].item(), 1.0)
            pieces += flat[-6:-1] / config.num_minibatches
            norms = [nn.utils.clip_grad_norm_(group["params"], config.max_grad_norm)
                     for group in optimiser.param_groups]
            optimiser.step()
        _, value_loss, approx_kl, clipfrac, guide_distance = pieces.tolist()
        if approx_kl > 2 * config.target_kl:  # a number of all ranks, so that all of them stop
            break

    actor = optimiser.param_groups[0]
    if approx_kl > 2 * config.target_kl:
        actor["lr"] = max(actor["lr"] / 1.5, config.min_learning_rate)
    elif approx_kl < config.target_kl / 2:
        actor["lr"] = min(actor["lr"] * 1.5, config.max_learning_rate)
    return {"approx_kl": approx_kl, "clipfrac": clipfrac,
            # The critic's errors are the advantages, since returns = advantages + values.
            "explained_variance": 1 - a_var / r_var if r_var > 0 else math.nan,
            "value_loss": value_loss, "std": model.log_std().exp().mean().item(),
            "guide_loss": guide_distance, "learning_rate": actor["lr"],
            "grad_norm": norms[0].item()}


def save_checkpoint(path, model, config, *, optimiser=None, counters=None, meta=None):
    """Write a checkpoint that is whole or not there at all, even if the power fails.

    `meta` is the caller's own dict of plain values (else TypeError). Without `optimiser` the file
    is a policy to share: it can be evaluated, but not resumed.
    """
    content = {"format": FORMAT, "kwargs": model.kwargs, "model": model.state_dict(),
               "optimiser": optimiser.state_dict() if optimiser else None,
               "counters": counters, "config": asdict(config),
               # Through JSON: what could not be loaded as plain data fails now, not in a month.
               "meta": json.loads(json.dumps(meta))}
    write_whole(content, path)


def write_whole(content, path):
    """torch.save, but aside, and moved: whoever opens `path` finds all of it."""
    with open(f"{path}.tmp", "wb") as file:
        torch.save(content, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(f"{path}.tmp", path)


def load_checkpoint(path):
    """The dict that `save_checkpoint` wrote. Runs no code that a file may carry.

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


def build_policy(checkpoint):
    """The ActorCritic in what `load_checkpoint` gave; a new critic, if it has none."""
    model = ActorCritic(**checkpoint["kwargs"])
    model.load_state_dict({**model.critic.state_dict(prefix="critic."), **checkpoint["model"]})
    return model


def load_policy(path):
    """(ActorCritic, dict whose "meta" and "config" tell its making); raises as load_checkpoint."""
    checkpoint = load_checkpoint(path)
    return build_policy(checkpoint), checkpoint


def open_run(run_dir, config, meta=None, resume=False):
    """Make the run folder, or go back to its last checkpoint. Returns the checkpoint, or None.

    Rows of progress.csv after the checkpoint are dropped: those updates will be made again.
    Raises FileExistsError rather than write over a run; on resume as load_checkpoint.
    """
    run_dir, checkpoint = Path(run_dir), None
    progress = run_dir / "progress.csv"
    if resume:
        checkpoint = load_checkpoint(run_dir / "checkpoint.pt")
        if checkpoint["optimiser"] is None:
            raise ValueError(f"{run_dir / 'checkpoint.pt'} is a policy only: it cannot be resumed")
        header, *rows = progress.read_text().splitlines(keepends=True)
        last = checkpoint["counters"]["update"]
        kept = [row for row in rows if row.endswith("\n") and int(row.split(",")[0]) <= last]
        progress.write_text("".join([header, *kept]))
    elif progress.exists():
        raise FileExistsError(f"{run_dir} already holds a run: resume it, or name another folder")
    run_dir.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"ppo": asdict(config), "meta": meta}, indent=2)
    (run_dir / "config.json").write_text(text + "\n")
    return checkpoint


def draw_curve(run_dir, *names):
    """Draw columns of progress.csv against minutes as curve.png, where matplotlib is installed."""
    try:
        from matplotlib.figure import Figure  # not pyplot: a notebook keeps its backend
    except ImportError:
        return
    with open(Path(run_dir) / "progress.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(4 * len(names), 3), layout="constrained")
    for axis, name in zip(figure.subplots(1, len(names), squeeze=False)[0], names, strict=True):
        axis.plot([float(row["minutes"]) for row in rows], [float(row[name]) for row in rows])
        axis.set(xlabel="minutes", ylabel=name)
    figure.savefig(Path(run_dir) / "curve.png", dpi=100)


def learn(make_env, config, *, run_dir=None, resume=False, mirror=None,
          episode_keys=("t_cr", "success", "fall"), groups=(), meta=None, on_update=None):
    """Train on `make_env` until config.total_timesteps; returns the ActorCritic.

    Args:
        make_env: function of the environment's number over all ranks, dealt out in turns, to a
            Gymnasium env with Box observations and actions. What the env gets is clipped to its
            action space, and the policy's mean lies in (-1, 1): other bounds need
            gymnasium.wrappers.RescaleAction.
        run_dir: folder for config.json, progress.csv, curve.png, checkpoint.pt; None: no files.
        resume: go on from run_dir's checkpoint, with its network and its mirror.
        mirror: see ActorCritic.
        episode_keys: what to average from the info of an episode's last step; the first of them
            also for each of `groups`, the values of info["task"]. progress.csv has the means
            over each rank's last 100 episodes, NaN where there is none.
        meta: plain dict kept in the checkpoint and in config.json.
        on_update: called on rank 0 after every update as on_update(model, row of progress.csv).

    An env may put a guide's advice into every info, info["guide"] (act,): with a guide_share above
    0 the policy's mean is drawn to what the guide would do next; NaN where he has no advice.

    Every checkpoint_every updates all envs are reset and the random numbers start afresh from
    (seed, update, rank). So a checkpoint made there holds everything, and going on from it gives
    the same bits as never having stopped (with as many ranks, and envs that reset(seed) defines).

    The first Ctrl-C stops after the running update, writes a checkpoint and raises
    KeyboardInterrupt; a second one aborts. Raises ValueError if an argument is wrong or the env
    does not fit, FloatingPointError if the parameters stop being numbers, and what `open_run`
    raises.
    """
    if resume and run_dir is None:
        raise ValueError("resume = True, but there is no run_dir to go on from")
    for names in (episode_keys, groups):
        if isinstance(names, str):
            raise ValueError(f"episode_keys and groups must be several names, but got {names!r}")
    torch.set_num_threads(1)  # nets this small only lose by more
    if int(os.environ.get("WORLD_SIZE", 1)) > 1 and not dist.is_initialized():
        # An optimiser would import it later, when it would keep hold of the open group for good.
        import torch.distributed.nn as _  # noqa: F401

        store, rank, world = next(dist.rendezvous("env://"))
        # After a crash torchrun starts the ranks again, with the same store (--max-restarts): they
        # must not find the addresses of the dead in it.
        store = dist.PrefixStore(os.environ.get("TORCHELASTIC_RESTART_COUNT", "0"), store)
        dist.init_process_group("gloo", store=store, rank=rank, world_size=world)
        # Open until the process ends: a second learn() goes on with it. But closed then: threads
        # of it that outlive Python now and then abort the process.
        atexit.register(lambda: dist.is_initialized() and dist.destroy_process_group())
    rank, world = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)

    opened = [None]
    if run_dir is not None and rank == 0:
        try:
            opened = [open_run(run_dir, config, meta, resume)]
        except (OSError, ValueError, TypeError) as error:
            opened = [error]
    if world > 1:  # only rank 0's machine has the folder, but all must know what it said
        dist.broadcast_object_list(opened)
    checkpoint = opened[0]
    if isinstance(checkpoint, Exception):
        raise checkpoint
    if checkpoint and checkpoint["counters"]["steps"] >= config.total_timesteps:
        return build_policy(checkpoint)  # nothing left to learn

    num_steps, num_envs = config.num_steps, config.num_envs
    kept = torch.tensor(config.noise_correlation)  # share of the noise that lives on
    # In turns: where neighbours are alike, as tasks are, each rank has some of all kinds.
    envs = gym.vector.SyncVectorEnv([partial(make_env, rank + world * i) for i in range(num_envs)])
    obs_space, act_space = envs.single_observation_space, envs.single_action_space
    if not all(isinstance(space, gym.spaces.Box) for space in (obs_space, act_space)):
        raise ValueError(f"both spaces must be Box, but they are {obs_space} and {act_space}")
    dims = {"obs_dim": math.prod(obs_space.shape), "act_dim": math.prod(act_space.shape)}
    if checkpoint:
        model = build_policy(checkpoint)
    else:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            model = ActorCritic(**dims, exteroceptive=config.exteroceptive, mirror=mirror,
                                encoder_hidden=config.encoder_hidden,
                                trunk_hidden=config.trunk_hidden, init_std=config.init_std)
    if kept.ndim and len(kept) != dims["act_dim"]:
        raise ValueError(f"noise_correlation has {len(kept)} entries, but an action has "
                         f"{dims['act_dim']}")
    for name, size in dims.items():
        if model.kwargs[name] != size:
            raise ValueError(f"policy has {name} = {model.kwargs[name]}, but the env has {size}")
    for tensor in model.state_dict().values() if world > 1 else ():
        dist.broadcast(tensor, 0)
    actor = [model.free_log_std, *model.actor.parameters()]
    optimiser = torch.optim.Adam(
        [{"params": actor, "lr": config.learning_rate},
         {"params": list(model.critic.parameters()), "lr": config.critic_learning_rate}],
        fused=True)
    update, steps, minutes_before = 0, 0, 0.0
    if checkpoint:
        optimiser.load_state_dict(checkpoint["optimiser"])
        actor_group = optimiser.param_groups[0]  # the settings may have changed since
        actor_group["lr"] = min(max(actor_group["lr"], config.min_learning_rate),
                                config.max_learning_rate)
        update, steps, minutes_before = checkpoint["counters"].values()
    model.limit_std(config.max_std)

    obs = torch.zeros(num_steps + 1, num_envs, dims["obs_dim"])
    actions = torch.zeros(num_steps, num_envs, dims["act_dim"])
    guide = torch.full_like(actions, math.nan)
    rewards, log_prob = torch.zeros(2, num_steps, num_envs)
    terminated, done, prev_done = torch.zeros(3, num_steps, num_envs, dtype=torch.bool)
    generator = torch.Generator()
    episodes = deque(maxlen=100)
    means = ["return", *episode_keys]
    means += [f"{key}/{group}" for key in episode_keys[:1] for group in groups]
    interrupts = []

    def on_interrupt(_signal, _frame):
        if interrupts:
            raise KeyboardInterrupt
        interrupts.append(True)

    previous_handler = signal.signal(signal.SIGINT, on_interrupt)
    bar = tqdm(total=config.total_timesteps, initial=steps, unit="step", disable=rank > 0)
    began, fresh, stopped = time.perf_counter(), True, False
    try:
        while steps < config.total_timesteps and not stopped:
            start = time.perf_counter()
            if fresh or update % config.checkpoint_every == 0:
                seeds = np.random.SeedSequence((config.seed, update, rank))
                torch_seed, *env_seeds = seeds.generate_state(num_envs + 1, np.uint64).tolist()
                generator.manual_seed(torch_seed)
                next_obs, info = envs.reset(seed=env_seeds)
                noise = torch.randn(num_envs, dims["act_dim"], generator=generator)
                ended, returned, fresh = np.zeros(num_envs, bool), np.zeros(num_envs), False

            for t in range(num_steps):
                obs[t] = torch.from_numpy(next_obs).flatten(1)
                prev_done[t] = torch.from_numpy(ended)
                if "guide" in info:
                    guide[t] = torch.from_numpy(np.stack(info["guide"]))
                # Each action by itself is still drawn from the policy, so the loss stays the same.
                fresh_noise = torch.randn(noise.shape, generator=generator)
                noise = kept * noise + (1 - kept**2).sqrt() * fresh_noise
                actions[t], log_prob[t] = model.act(obs[t], noise)
                command = actions[t].numpy().reshape(envs.action_space.shape)
                command = command.clip(act_space.low, act_space.high).astype(act_space.dtype)
                next_obs, reward, terminal, truncated, info = envs.step(command)
                ended = terminal | truncated
                rewards[t] = torch.from_numpy(reward)
                terminated[t], done[t] = torch.from_numpy(terminal), torch.from_numpy(ended)
                returned += reward
                for i in np.flatnonzero(ended):
                    # Gymnasium pads what an env does not give: its masks say who does.
                    given = [k for k in episode_keys if f"_{k}" in info and info[f"_{k}"][i]]
                    episode = {k: float(info[k][i]) for k in given}
                    for k in episode_keys[:1] if "task" in info else ():
                        episode[f"{k}/{info['task'][i]}"] = episode.get(k, math.nan)
                    episodes.append({"return": returned[i], **episode})
                returned[ended] = 0
            obs[-1] = torch.from_numpy(next_obs).flatten(1)
            collect_s = time.perf_counter() - start

            with torch.no_grad():  # with the parameters and the normaliser that have acted
                values, seen = model.value(obs), obs[:-1][~prev_done]
                views = model.views(seen)
            advantages, returns = compute_gae(rewards, values, terminated, done, prev_done,
                                              config.gamma, config.gae_lambda)
            batch = [x[~prev_done] for x in (actions, log_prob, advantages, returns, guide)]
            stats = ppo_update(model, optimiser, [views, *batch], config, generator)
            model.limit_std(config.max_std)
            # Only now: while learning, the old and the new policy must see the same scale.
            model.update_normaliser(seen)
            if not all(tensor.isfinite().all() for tensor in model.state_dict().values()):
                raise FloatingPointError(f"update {update + 1} made parameters infinite or NaN: "
                                         "are all rewards and observations of the env numbers?")

            known = [[e[name] for e in episodes if name in e] for name in means]
            sums = [*map(sum, known), *map(len, known), len(seen), len(interrupts)]
            sums = sum_over_ranks(torch.tensor(sums, dtype=torch.float64)).tolist()
            new_steps, stopped = int(sums[-2]), sums[-1] > 0  # one Ctrl-C stops all ranks
            update, steps = update + 1, steps + new_steps
            now = time.perf_counter()
            minutes = minutes_before + (now - began) / 60
            row = {"update": update, "steps": steps, "minutes": minutes,
                   "steps_per_s": new_steps / (now - start), "collect_s": collect_s,
                   "learn_s": now - start - collect_s}
            for name, total, number in zip(means, sums, sums[len(means):], strict=False):
                row[name] = total / number if number else math.nan
            row |= stats
            bar.update(new_steps)
            bar.set_postfix({k: f"{row[k]:.3g}" for k in means[:2] if row[k] == row[k]})
            if run_dir is not None and rank == 0:
                progress = Path(run_dir) / "progress.csv"
                header = ",".join(row) + "\n"
                with open(progress, "a+") as file:
                    file.seek(0)
                    if (first_line := file.readline()) not in ("", header):
                        raise ValueError(f"{progress} has other columns: resume it as it was")
                    file.write("" if first_line else header)
                    file.write(",".join(f"{x:.10g}" for x in row.values()) + "\n")
                finished = stopped or steps >= config.total_timesteps
                if finished or update % config.checkpoint_every == 0:
                    counters = {"update": update, "steps": steps, "minutes": minutes}
                    save_checkpoint(Path(run_dir) / "checkpoint.pt", model, config, meta=meta,
                                    optimiser=optimiser, counters=counters)
                    draw_curve(run_dir, *means[:2])
            if on_update is not None and rank == 0:
                on_update(model, row)
    finally:
        signal.signal(signal.SIGINT, previous_handler)
        bar.close()
        envs.close()
    if stopped:
        raise KeyboardInterrupt
    return model
