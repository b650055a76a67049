"""
BRO from top to bottom in one file: configuration, networks, optimizer, update, replay buffer, training loop.

"Bigger, Regularized, Optimistic: scaling for compute and sample-efficient continuous control" (Nauman et al. 2024,
https://arxiv.org/abs/2405.16158). This version is for reading and for changing by hand; ``sb3_sample.BRO`` is the same
algorithm for use: faster, resumable, with Stable-Baselines3's interface. Each reproduces updates recorded from the
authors' code, and the other's updates (``tests/test_bro_in_one_file.py``).

    python examples/bro_in_one_file.py --env dmc/cheetah-run-v0 --steps 100000 --seed 0
    python examples/bro_in_one_file.py --env Pendulum-v1 --steps 6000 --model-size 0.55M --fast

Shapes: B batch, E = 2 critics, K quantiles, O observation, A action. Actions lie in [-1, 1].
"""

import argparse
import copy
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

# ------------------------------------------------------------------------------------------------- configuration

#: Residual blocks and width of the critics, by the total number of parameters of all networks (BRO, table 7).
MODEL_SIZES = {"0.55M": (1, 128), "1.05M": (1, 256), "2.83M": (1, 512), "4.92M": (2, 512), "26.31M": (3, 1024)}


@dataclass(frozen=True)
class Config:
    """BRO's published numbers (BRO, table 5; the authors' code where it differs)."""

    # Bigger
    critic_blocks: int = 2
    critic_width: int = 512
    actor_blocks: int = 1
    actor_width: int = 256
    n_quantiles: int = 100
    replay_ratio: int = 10  # gradient steps per environment step

    # Regularized, besides the layer norms in the networks
    weight_decay: float = 1e-4
    resets: tuple[int, ...] = (15_000, 50_000, 250_000, 500_000, 750_000, 1_000_000, 1_500_000, 2_000_000)

    # Optimistic
    pessimism: float = 0.0  # values learned from: mean minus this times the critics' disagreement; 1: their minimum
    initial_optimism: float = 1.0
    initial_kl_weight: float = 0.25
    kl_target: float = 0.05  # divergence of the two actors per action dimension
    std_multiplier: float = 0.75  # factor on the standard deviation while exploring
    adjustment_learning_rate: float = 3e-5  # for optimism and KL weight

    # Soft actor-critic
    learning_rate: float = 3e-4
    batch_size: int = 128
    discount: float = 0.99
    tau: float = 0.005  # weight of the new critics in the Polyak average
    learning_starts: int = 2_500  # environment steps with random actions before the first gradient step
    buffer_size: int = 1_000_000


# ------------------------------------------------------------------------------------------------------ networks


def dense(n_in: int, n_out: int, gain: float = math.sqrt(2), bias: bool = True) -> nn.Linear:
    """Dense layer with an orthogonal kernel and zero biases (the authors' code)."""
    layer = nn.Linear(n_in, n_out, bias=bias)
    nn.init.orthogonal_(layer.weight, gain)
    if bias:
        nn.init.zeros_(layer.bias)
    return layer


def dense_norm(n_in: int, width: int) -> list[nn.Module]:
    """Dense layer and layer norm, with the epsilon of Flax, and so of the authors' code; torch's is 1e-5."""
    return [dense(n_in, width), nn.LayerNorm(width, eps=1e-6)]


class BroNet(nn.Module):
    """Residual network without an output layer, (B, n_in) to (B, width) (BRO, figure 5)."""

    def __init__(self, n_in: int, width: int, n_blocks: int):
        super().__init__()
        self.embedding = nn.Sequential(*dense_norm(n_in, width), nn.ReLU())
        blocks = ([*dense_norm(width, width), nn.ReLU(), *dense_norm(width, width)] for _ in range(n_blocks))
        self.blocks = nn.ModuleList(nn.Sequential(*block) for block in blocks)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        h = self.embedding(x)
        for block in self.blocks:
            h = h + block(h)  # Nothing follows the addition.
        return h


class Critics(nn.Module):
    """Two critics, each of which predicts K quantiles of the return."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        width = config.critic_width
        trunks = (BroNet(obs_dim + act_dim, width, config.critic_blocks) for _ in range(2))
        self.members = nn.ModuleList(nn.Sequential(trunk, dense(width, config.n_quantiles)) for trunk in trunks)

    def forward(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """(B, O) and (B, A) to (E, B, K)."""
        x = torch.cat((observations, actions), dim=1)
        return torch.stack([critic(x) for critic in self.members])


class Actor(nn.Module):
    """Tanh-Gaussian actor, the pessimistic one of the paper, used for TD targets and evaluations."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.trunk = BroNet(obs_dim, config.actor_width, config.actor_blocks)
        self.mean = dense(config.actor_width, act_dim)
        self.log_std = dense(config.actor_width, act_dim, gain=1.0)

    def forward(self, observations: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, O) to mean and log standard deviation before the tanh, (B, A) each, the latter in [-10, 2]."""
        h = self.trunk(observations)
        return self.mean(h), -10 + 6 * (1 + torch.tanh(self.log_std(h)))

    def sample(self, observations: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, O) and standard normal noise, (B, A), to actions, (B, A), and their log-probability, (B, 1)."""
        mean, log_std = self(observations)
        x = mean + log_std.exp() * noise
        # From x and the noise, not from the action: if the action rounds to 1, its atanh is infinite.
        gaussian = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
        log_derivative = 2 * (math.log(2) - x - F.softplus(-2 * x))  # log(1 - tanh(x)^2)
        return torch.tanh(x), (gaussian - log_derivative).sum(dim=1, keepdim=True)


class OptimisticShift(nn.Module):
    """Optimistic actor, as a shift of the actor's mean; used for exploration only (BRO, section B.7)."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        super().__init__()
        self.trunk = BroNet(obs_dim + act_dim, config.actor_width, config.actor_blocks)
        self.shift = dense(config.actor_width, act_dim, gain=0.01, bias=False)  # nearly no shift at the start

    def forward(self, observations: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
        """(B, O) and the actor's mean before the tanh, (B, A), to the shift of that mean, (B, A)."""
        return self.shift(self.trunk(torch.cat((observations, mean), dim=1)))


class BoundedScalar(nn.Module):
    """Learned number between exp(-10) and exp(7.5), as for optimism and KL weight in the authors' code."""

    def __init__(self, initial: float):
        super().__init__()
        self.raw = nn.Parameter(torch.tensor(math.atanh((math.log(initial) + 10) / 8.75 - 1)))

    def forward(self) -> torch.Tensor:
        return torch.exp(-10 + 8.75 * (1 + torch.tanh(self.raw)))


# ----------------------------------------------------------------------------------------------------- optimizer


class AdamW:
    """
    Adam with decoupled weight decay (Loshchilov and Hutter 2019), with the decay added to Adam's direction.

    ``torch.optim.AdamW`` first multiplies the parameters by ``1 - learning_rate * weight_decay``, here 1 - 3e-8. The
    nearest number in float32 is 1 - 6e-8, and the product is rounded again, so that the decay comes out 2.6 times as
    strong. The authors' code (Optax) adds decay and direction first, and subtracts both at once.
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], learning_rate: float, beta1: float = 0.9, weight_decay: float = 0.0
    ):
        self.parameters, self.learning_rate, self.weight_decay = list(parameters), learning_rate, weight_decay
        self.beta1, self.beta2, self.eps = beta1, 0.999, 1e-8
        self.moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in self.parameters]
        self.n_steps = 0

    def minimize(self, loss: torch.Tensor) -> None:
        """Take one step down a loss. Only these parameters get a gradient, whatever else the loss depends on."""
        for p in self.parameters:
            p.grad = None
        loss.backward(inputs=self.parameters)
        self.n_steps += 1
        with torch.no_grad():
            for p, (m, v) in zip(self.parameters, self.moments, strict=True):
                m.lerp_(p.grad, 1 - self.beta1)
                v.lerp_(p.grad.square(), 1 - self.beta2)
                m_hat, v_hat = m / (1 - self.beta1**self.n_steps), v / (1 - self.beta2**self.n_steps)
                p.sub_(self.learning_rate * (m_hat / (v_hat.sqrt() + self.eps) + self.weight_decay * p))


# -------------------------------------------------------------------------------------------------------- update


class Batch(NamedTuple):
    """Transitions: observations (B, O), actions (B, A), rewards and terminations (B, 1)."""

    observations: torch.Tensor
    actions: torch.Tensor
    rewards: torch.Tensor
    terminated: torch.Tensor  # 1 if the episode terminated, 0 at a time limit, after which the return continues
    next_observations: torch.Tensor


def disagreement(q: torch.Tensor) -> torch.Tensor:
    """Standard deviation over two critics, quantile by quantile, (E, B, K) to (B, K)."""
    return (q[0] - q[1]).abs() / 2


def ensemble_value(q: torch.Tensor, weight: torch.Tensor | float) -> torch.Tensor:
    """Mean of two critics plus a multiple of their disagreement, quantile by quantile, (E, B, K) to (B, K)."""
    return q.mean(dim=0) + weight * disagreement(q)


def quantile_huber(q: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """
    Quantile Huber loss of predictions (E, B, K) for targets (B, K), threshold 1 (Dabney et al. 2018, equation 10): the
    sum over critics and predicted quantiles, the mean over batch and target quantiles.
    """
    predicted, target = torch.broadcast_tensors(q[..., None], target[:, None, :])  # (E, B, K, K): all pairs
    huber = F.huber_loss(predicted, target, reduction="none")
    midpoints = (torch.arange(q.shape[2])[:, None] + 0.5) / q.shape[2]
    weight = torch.where(target < predicted, 1 - midpoints, midpoints)
    return (weight * huber).mean(dim=(1, 3)).sum()


class Agent:
    """Networks, learned numbers and optimizers, all re-created by a full-parameter reset; actions, and the update."""

    def __init__(self, obs_dim: int, act_dim: int, config: Config):
        self.config, self.act_dim = config, act_dim
        self.actor = Actor(obs_dim, act_dim, config)
        self.optimist = OptimisticShift(obs_dim, act_dim, config)
        self.critics = Critics(obs_dim, act_dim, config)
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.log_temperature = nn.Parameter(torch.tensor(0.0))
        self.optimism = BoundedScalar(config.initial_optimism)
        self.kl_weight = BoundedScalar(config.initial_kl_weight)

        # Weight decay applies to all network parameters, biases and layer norms too, but not to the learned numbers.
        lr, adjustment_lr, decay = config.learning_rate, config.adjustment_learning_rate, config.weight_decay
        self.actor_optimizer = AdamW(self.actor.parameters(), lr, weight_decay=decay)
        self.optimist_optimizer = AdamW(self.optimist.parameters(), lr, weight_decay=decay)
        self.critic_optimizer = AdamW(self.critics.parameters(), lr, weight_decay=decay)
        self.temperature_optimizer = AdamW([self.log_temperature], lr, beta1=0.5)
        self.adjustment_optimizer = AdamW([self.optimism.raw, self.kl_weight.raw], adjustment_lr, beta1=0.5)

    @torch.no_grad()
    def explore(self, observation: np.ndarray) -> np.ndarray:
        """Sample an action of the optimistic actor, (O,) to (A,) (BRO, algorithm 2, line 3)."""
        observations = torch.as_tensor(observation, dtype=torch.float32)[None]
        mean, log_std = self.actor(observations)
        noise = self.config.std_multiplier * log_std.exp() * torch.randn_like(mean)
        return torch.tanh(mean + self.optimist(observations, mean) + noise)[0].numpy()

    @torch.no_grad()
    def mean_action(self, observation: np.ndarray) -> np.ndarray:
        """Mean action of the actor, as in evaluation, (O,) to (A,)."""
        mean, _ = self.actor(torch.as_tensor(observation, dtype=torch.float32)[None])
        return torch.tanh(mean)[0].numpy()

    def update(self, batch: Batch, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        """
        Take one gradient step (BRO, algorithm 2, lines 7 to 15), with everything random passed in.

        :param batch: transitions
        :param noise: standard normal noise of the three sampled actions, (3, B, A)
        :return: numbers to log, by name, each from before the update of its module
        """
        alpha = self.log_temperature.exp()
        metrics = self._update_critics(batch, alpha.detach(), noise[0])
        metrics |= self._update_actor(batch, alpha.detach(), noise[1])
        metrics |= self._update_optimist(batch, noise[2])
        metrics |= self._update_temperature(alpha, metrics["train/entropy"].detach())
        metrics |= self._update_adjustments(metrics["exploration/kl"].detach())
        return {name: value.detach() for name, value in metrics.items()}

    def _update_critics(self, batch: Batch, alpha: torch.Tensor, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        """Lines 7 and 8: targets from the mean of the target critics, not from their minimum as in clipped double Q."""
        with torch.no_grad():
            next_actions, log_prob = self.actor.sample(batch.next_observations, noise)
            next_q = self.target_critics(batch.next_observations, next_actions)
            # Line 8 prints the entropy bonus outside the discount: a misprint that the authors' code does not share.
            soft_value = ensemble_value(next_q, -self.config.pessimism) - alpha * log_prob
            target = batch.rewards + self.config.discount * (1 - batch.terminated) * soft_value
        q = self.critics(batch.observations, batch.actions)
        loss = quantile_huber(q, target)
        self.critic_optimizer.minimize(loss)
        with torch.no_grad():  # Polyak average, directly after the critics' update (the authors' code).
            for old, new in zip(self.target_critics.parameters(), self.critics.parameters(), strict=True):
                old.lerp_(new, self.config.tau)
        return {"train/critic_loss": loss, "train/q_mean": q.mean()}

    def _update_actor(self, batch: Batch, alpha: torch.Tensor, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        """Lines 9 and 10, with the new critics."""
        actions, log_prob = self.actor.sample(batch.observations, noise)
        value = ensemble_value(self.critics(batch.observations, actions), -self.config.pessimism)
        loss = (alpha * log_prob).mean() - value.mean()
        self.actor_optimizer.minimize(loss)
        return {"train/actor_loss": loss, "train/entropy": -log_prob.mean()}

    def _update_optimist(self, batch: Batch, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        """Lines 11 and 12, with the new critics and the new actor."""
        with torch.no_grad():
            mean, log_std = self.actor(batch.observations)
            optimism, kl_weight, std = self.optimism(), self.kl_weight(), log_std.exp()
        shift = self.optimist(batch.observations, mean)
        q = self.critics(batch.observations, torch.tanh(mean + shift + self.config.std_multiplier * std * noise))
        # KL from the optimistic to the pessimistic Gaussian, the former without its multiplier (the authors' code; line
        # 12 prints the other order): as the standard deviations are equal, only the term of the shift remains.
        kl = (shift.square() / (2 * std.square())).sum(dim=1).mean()
        # Optimism counts once: line 12 prints it again, but the value of line 11 already contains it.
        loss = kl_weight * kl - ensemble_value(q, optimism).mean()
        self.optimist_optimizer.minimize(loss)
        metrics = {"actor_loss": loss, "kl": kl / self.act_dim, "q_mean": q.mean(), "q_std": disagreement(q).mean()}
        return {f"exploration/{name}": value for name, value in metrics.items()}

    def _update_temperature(self, alpha: torch.Tensor, entropy: torch.Tensor) -> dict[str, torch.Tensor]:
        """Line 13: towards an entropy of -A/2. The loss is on the temperature itself, not on its logarithm."""
        loss = alpha * (entropy + self.act_dim / 2)
        self.temperature_optimizer.minimize(loss)
        return {"train/ent_coef": alpha, "train/ent_coef_loss": loss}

    def _update_adjustments(self, kl: torch.Tensor) -> dict[str, torch.Tensor]:
        """Lines 14 and 15: if the two actors are too far apart, optimism falls and the divergence weighs more."""
        gap, optimism, kl_weight = kl - self.config.kl_target, self.optimism(), self.kl_weight()
        losses = {"optimism_loss": (optimism - self.config.pessimism) * gap, "kl_weight_loss": -kl_weight * gap}
        self.adjustment_optimizer.minimize(sum(losses.values()))
        metrics = {"optimism": optimism, "kl_weight": kl_weight, **losses}
        return {f"exploration/{name}": value for name, value in metrics.items()}


# ------------------------------------------------------------------------------------------------------ training


class ReplayBuffer:
    """The latest transitions, in one ring buffer for each entry of ``Batch``."""

    def __init__(self, capacity: int, obs_dim: int, act_dim: int):
        widths = (obs_dim, act_dim, 1, 1, obs_dim)
        self.rings = [np.zeros((capacity, width), np.float32) for width in widths]
        self.capacity, self.n_added = capacity, 0

    def add(self, *transition: np.ndarray | float) -> None:
        for ring, value in zip(self.rings, transition, strict=True):
            ring[self.n_added % self.capacity] = value
        self.n_added += 1

    def sample(self, n: int, rng: np.random.Generator) -> Batch:
        """Draw transitions uniformly, with replacement."""
        rows = rng.integers(min(self.n_added, self.capacity), size=n)
        return Batch(*(torch.from_numpy(ring[rows]) for ring in self.rings))


def make_env(env_id: str) -> gym.Env:
    """Make an environment with flat observations and actions in [-1, 1]; ValueError if its actions are unbounded."""
    env = gym.make(env_id)
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not space.is_bounded():
        raise ValueError(f"env must have a bounded Box with one axis as its action space; {env_id} has {space}")
    return gym.wrappers.RescaleAction(gym.wrappers.FlattenObservation(env), np.float32(-1), np.float32(1))


def evaluate(agent: Agent, env: gym.Env, n_episodes: int = 5) -> float:
    """Mean return over episodes with the actor's mean action."""
    total = 0.0
    for _ in range(n_episodes):
        observation, done = env.reset()[0], False
        while not done:
            observation, reward, terminated, truncated, _ = env.step(agent.mean_action(observation))
            total, done = total + float(reward), terminated or truncated
    return total / n_episodes


def check_numbers(n_steps: int, seed: int, eval_every: int, config: Config) -> None:
    """ValueError if there are too few steps for learning or between evaluations, or the seed is negative."""
    if n_steps <= config.learning_starts:
        raise ValueError(f"n_steps must be more than learning_starts={config.learning_starts}, not {n_steps}")
    if seed < 0:
        raise ValueError(f"seed must be at least 0, not {seed}")
    if eval_every < 1:
        raise ValueError(f"eval_every must be at least 1, not {eval_every}")


def train(env_id: str, config: Config, n_steps: int, seed: int, eval_every: int) -> tuple[Agent, list[float]]:
    """
    :param env_id: id of an environment that ``make_env`` accepts
    :param config: hyperparameters
    :param n_steps: environment steps, more than ``learning_starts``
    :param seed: of everything random
    :param eval_every: environment steps between two evaluations; another one comes at the end
    :return: the agent, and the mean return of every evaluation
    """
    check_numbers(n_steps, seed, eval_every, config)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    env, eval_env = make_env(env_id), make_env(env_id)
    observation, _ = env.reset(seed=seed)
    eval_env.reset(seed=seed + 1_000)
    sizes = (env.observation_space.shape[0], env.action_space.shape[0])
    agent, buffer = Agent(*sizes, config), ReplayBuffer(min(config.buffer_size, n_steps), *sizes)
    returns, metrics = [], {}
    for step in range(1, n_steps + 1):
        warm_up = step <= config.learning_starts
        action = rng.uniform(-1, 1, sizes[1]).astype(np.float32) if warm_up else agent.explore(observation)
        next_observation, reward, terminated, truncated, _ = env.step(action)
        buffer.add(observation, action, float(reward), float(terminated), next_observation)
        observation = env.reset()[0] if terminated or truncated else next_observation
        if step in config.resets:  # Full-parameter reset: everything but the replay buffer (BRO, section 2.2).
            with torch.random.fork_rng(devices=[]):  # As published: back to the initial parameters.
                torch.manual_seed(seed)
                agent = Agent(*sizes, config)
        for _ in range(0 if warm_up else config.replay_ratio):
            metrics = agent.update(buffer.sample(config.batch_size, rng), torch.randn(3, config.batch_size, sizes[1]))
        if step % eval_every == 0 or step == n_steps:
            returns.append(evaluate(agent, eval_env))
            shown = (f"{name} {value.item():.3g}" for name, value in metrics.items())
            print(f"step {step}, return {returns[-1]:.1f}", *shown, sep=", ", flush=True)
    return agent, returns


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="dmc/cheetah-run-v0", help="environment id")
    parser.add_argument("--steps", type=int, default=100_000, help="environment steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--model-size", choices=MODEL_SIZES, default="4.92M", help="parameters of all networks")
    parser.add_argument("--fast", action="store_true", help="BRO Fast: replay ratio 2, and the first reset only")
    parser.add_argument("--eval-every", type=int, default=5_000, help="environment steps between two evaluations")
    args = parser.parse_args()
    if args.env not in gym.registry:
        import sb3_sample  # noqa: F401 - registers DeepMind Control and other suites
    try:
        make_env(args.env).close()
        check_numbers(args.steps, args.seed, args.eval_every, Config())
    except (ValueError, ImportError, gym.error.Error) as error:
        parser.error(str(error))

    blocks, width = MODEL_SIZES[args.model_size]
    fast = {"replay_ratio": 2, "resets": Config.resets[:1]} if args.fast else {}
    train(args.env, Config(critic_blocks=blocks, critic_width=width, **fast), args.steps, args.seed, args.eval_every)


if __name__ == "__main__":
    main()
