"""Access of diagnostics to a model's transitions and TD targets, without side effects on the model."""

import contextlib
import random
from collections.abc import Iterator

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_sample.learner.batch import Batch
from sb3_sample.learner.target import bootstrap, outputs
from sb3_sample.replay.buffers import samples_at
from sb3_sample.sac import SAC

#: Newest transitions whose TD loss is compared with that of the replay buffer.
NEWEST = 16


@contextlib.contextmanager
def untouched(model: SAC) -> Iterator[None]:
    """
    Put the model's networks into evaluation mode; afterwards their modes and the global generators are as before.

    :param model: the model
    """
    modes = {module: module.training for module in model.policy.modules()}
    python_state, numpy_state = random.getstate(), np.random.get_state()  # noqa: NPY002
    cuda = [model.device] if model.device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices=cuda):
            model.policy.eval()
            yield
    finally:
        random.setstate(python_state)
        np.random.set_state(numpy_state)  # noqa: NPY002
        for module, mode in modes.items():
            module.training = mode


def training_places(buffer: ReplayBuffer) -> np.ndarray:
    """
    Places of the transitions that the algorithm trains on.

    :param buffer: replay buffer
    :return: (n,), position * n_envs + environment, the oldest step first
    """
    usable = np.ones((buffer.size(), buffer.n_envs), dtype=bool)
    held_out = getattr(buffer, "held_out", None)
    if held_out is not None:
        usable &= ~held_out[: len(usable)]
    if buffer.optimize_memory_usage and buffer.full:
        usable[buffer.pos] = False  # its next observation is overwritten
    places = np.flatnonzero(usable)
    oldest = buffer.pos * buffer.n_envs if buffer.full else 0
    first = int(np.searchsorted(places, oldest))
    return np.concatenate([places[first:], places[:first]])


def batch_at(model: SAC, buffer: ReplayBuffer, places: np.ndarray) -> Batch:
    """
    Gather single transitions as they were experienced.

    :param model: the model, which normalises them
    :param buffer: replay buffer
    :param places: position * n_envs + environment, (B,)
    :return: the transitions
    """
    samples = samples_at(buffer, *np.divmod(places, buffer.n_envs), model.get_vec_normalize_env())
    return Batch.of(samples, model.gamma)


def noise(model: SAC, rng: np.random.Generator, n: int) -> torch.Tensor:
    """
    :param model: the model
    :param rng: draws
    :param n: how many actions
    :return: standard normal noise of actions, (n, A)
    """
    drawn = rng.standard_normal((n, model.actor.action_dim), dtype=np.float32)
    return torch.as_tensor(drawn, device=model.device)


def targets(model: SAC, batch: Batch, rng: np.random.Generator) -> tuple[Batch, torch.Tensor]:
    """
    Make the TD targets of transitions, as in the critics' training.

    :param model: the model
    :param batch: transitions
    :param rng: draws the next actions, and the subset of critics if targets use one
    :return: the transitions in the critics' scale of rewards, and the targets, (B, K)
    """
    if model.reward_scaler is not None:
        batch = model.reward_scaler.transform(batch, None)
    own: torch.Tensor | None = model.objective.own_target(model.learner, batch)
    if own is not None:
        return batch, own
    subset = None
    if model.target_subset is not None:
        subset = torch.from_numpy(rng.permutation(model.critic.n_critics)[: model.target_subset])
    drawn = noise(model, rng, len(batch.actions))
    next_q, entropy_bonus = bootstrap(model.learner, batch, model.temperature(), drawn, subset)
    return batch, model.learner.head.target(batch, next_q, model.pessimism_rule.value, entropy_bonus)


def td_loss(model: SAC, batch: Batch, rng: np.random.Generator) -> torch.Tensor:
    """
    Compute the critics' training loss.

    :param model: the model
    :param batch: transitions
    :param rng: draws the random numbers of the targets
    :return: scalar
    """
    batch, target = targets(model, batch, rng)
    q = outputs(model.critic, batch.observations, batch.actions)
    return model.learner.head.loss(q, target)


def newest_overfitting(model: SAC, batch_size: int, rng: np.random.Generator) -> dict[str, float]:
    """
    Overfitting as "Value-Based Deep RL Scales Predictably" measures it (appendix B.1): the TD loss on the 16 newest
    transitions, which have hardly been trained on, minus that on a batch of the replay buffer.

    :param model: the model
    :param batch_size: transitions of the replay buffer, fewer if fewer are stored
    :param rng: draws
    :return: "td_loss_newest", "td_loss_replay" and their difference "overfitting_newest"; empty before there are 17
        transitions
    """
    buffer = model.replay_buffer
    assert buffer is not None
    places = training_places(buffer)
    if len(places) <= NEWEST:
        return {}
    drawn = rng.choice(places, min(batch_size, len(places)), replace=False)
    with torch.no_grad():
        newest = td_loss(model, batch_at(model, buffer, places[-NEWEST:]), rng).item()
        replay = td_loss(model, batch_at(model, buffer, drawn), rng).item()
    return {"td_loss_newest": newest, "td_loss_replay": replay, "overfitting_newest": newest - replay}
