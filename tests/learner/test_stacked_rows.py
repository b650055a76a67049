"""``Network.stacks_rows``: current and next rows in one forward pass, as critics with batch statistics need it."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from sb3_sample import SAC
from sb3_sample.networks import MLP
from sb3_sample.parts import Network, Noise, linear, values
from tests.sac.common import COMPILES, bro, differing, random_batch, sac, state, vec


class CrossQ(Network):
    """One layer with batch norm, each critic its own statistics, of current and next rows together."""

    compilable = True
    stacks_rows = "online"

    def __init__(self, in_features: int, n_copies: int | None = None, width: int = 8):
        super().__init__()
        self.out_features, self.n_copies = width, n_copies
        # Without the bias, which batch norm takes out again: its gradient is rounding.
        self.dense = linear(in_features, width, n_copies, bias=False)
        self.norm = nn.BatchNorm1d((n_copies or 1) * width)
        #: Rows of every forward pass in training mode.
        self.seen: list[int] = []

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.training and not torch.compiler.is_compiling():
            self.seen.append(x.shape[-2])
        h = self.dense(x)
        columns = h.transpose(0, 1).flatten(1) if h.ndim == 3 else h
        columns = self.norm(columns)
        return torch.relu(columns.view(len(columns), h.shape[0], -1).transpose(0, 1) if h.ndim == 3 else columns)


class WithTargets(CrossQ):
    stacks_rows = "target"


class Stacked(MLP):
    """A network whose output for a row does not depend on the others: stacked or not is the same."""

    stacks_rows = "target"


class Wrong(CrossQ):
    stacks_rows = "both"


def crossq(cls: Any = CrossQ, **kwargs: Any) -> Any:
    settings = dict(seed=1, ent_coef=0.2, learning_rate=1e-2) | ({} if cls is CrossQ else {"tau": 0.1})
    return sac(
        policy_kwargs={"critic_network": cls, "net_arch": None} | kwargs.pop("policy_kwargs", {}), **settings | kwargs
    )


def drawn(n: int = 16) -> Noise:
    g = torch.Generator().manual_seed(3)
    return Noise(*(torch.randn(n, 2, generator=g) for _ in range(3)))


@pytest.mark.parametrize("cls", [CrossQ, WithTargets])
def test_a_step_by_hand(cls: Any) -> None:
    """The critics' step and the running statistics after a whole one, written out from CrossQ's equations."""
    model = crossq(cls)
    batch, noise = random_batch(model, 16), drawn()
    critic = copy.deepcopy(model.critic)
    judge = critic if cls is CrossQ else copy.deepcopy(model.critic_target)
    own_actor = copy.deepcopy(model.actor)

    def forward(critics: Any, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Both critics by hand on 2B rows: their outputs, and means and variances of all 16 neurons."""
        h = torch.stack([x @ w for w in critics.trunk.dense.weight])
        mean, var = h.mean(1, keepdim=True), h.var(1, unbiased=False, keepdim=True)
        norm = critics.trunk.norm
        weight, bias = norm.weight.view(2, 1, 8), norm.bias.view(2, 1, 8)
        hidden = torch.relu((h - mean) / (var + norm.eps).sqrt() * weight + bias)
        out = torch.stack([hidden[e] @ critics.head.weight[e] + critics.head.bias[e] for e in range(2)])
        return out, mean.flatten(), h.var(1).flatten()

    with torch.no_grad():
        actions, log_prob = own_actor.sample(batch.next_observations, noise.critic)
    now = torch.cat((batch.observations, batch.actions), 1)
    x = torch.cat((now, torch.cat((batch.next_observations, actions), 1)))
    q, mean, var = forward(critic, x)
    following = forward(judge, x)[0].detach()[:, 16:]
    target = batch.rewards + (1 - batch.dones) * model.gamma * (following.amin(0) - 0.2 * log_prob)
    loss = (q[:, :16] - target).square().mean((1, 2)).sum()
    parameters = list(critic.parameters())
    gradients = torch.autograd.grad(loss, parameters)

    metrics = model.learner.update(batch, noise)
    torch.testing.assert_close(metrics["train/critic_loss"], loss.detach())
    for parameter, gradient in zip(model.critic.parameters(), gradients, strict=True):
        torch.testing.assert_close(parameter.grad, gradient, rtol=1e-4, atol=1e-6)
    norm = model.critic.trunk.norm
    torch.testing.assert_close(norm.running_mean, 0.1 * mean)
    torch.testing.assert_close(norm.running_var, 0.9 + 0.1 * var)
    # One pass, over 2B rows; the actor's objective, and with it all else, reads the running statistics.
    assert model.critic.trunk.seen == [32] and norm.num_batches_tracked == 1
    assert model.critic_target.trunk.seen == ([] if cls is CrossQ else [32])


def test_the_actor_asks_for_values_in_evaluation_mode() -> None:
    model = crossq()
    batch = random_batch(model, 16)
    model.policy.set_training_mode(True)
    asked = values(model.learner, model.critic, batch.observations, batch.actions)
    assert model.critic.trunk.seen == [] and model.critic.training
    model.policy.set_training_mode(False)
    assert torch.equal(asked, model.critic.q_values(batch.observations, batch.actions))


def test_rows_that_know_nothing_of_each_other() -> None:
    """There stacked is as apart, for every part that asks critics for values."""
    for kwargs in ({}, {"sam_radius": 0.05}, {"target_subset": 1}, {"pessimism": "gpl"}):
        models = [
            sac(
                seed=2, policy_kwargs={"critic_network": cls, "critic_network_kwargs": {"hidden_sizes": (8,)}}, **kwargs
            )
            for cls in (Stacked, MLP)
        ]
        for model in models:
            torch.manual_seed(0)
            model.learner.update(random_batch(model, 16), drawn())
        for (name, a), b in zip(models[0].policy.named_parameters(), models[1].policy.parameters(), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-6, msg=f"{kwargs} {name}")


# ReDo recycles in a network that lists its hidden units.
@pytest.mark.parametrize(("cls", "redo_period"), [(CrossQ, None), (WithTargets, None), (Stacked, 7)])
@pytest.mark.parametrize("pessimism", ["gpl", pytest.param(1.0, marks=pytest.mark.slow)])
def test_trains_saves_and_resumes(cls: Any, redo_period: int | None, pessimism: Any, tmp_path: Path) -> None:
    def make() -> Any:
        return crossq(cls, pessimism=pessimism, resets=40, redo_period=redo_period, sam_radius=0.05)

    model = make().learn(60, checkpoint=tmp_path / "a", checkpoint_freq=100)
    assert model.plasticity.n_done == 1
    make().learn(33, checkpoint=tmp_path / "b", checkpoint_freq=100)
    resumed = make().learn(60, checkpoint=tmp_path / "b", checkpoint_freq=100)
    assert not differing(state(model), state(resumed))
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec(), trusted_modules=[__name__])
    assert not differing(state(model), state(loaded))
    buffers = dict(loaded.critic.trunk.named_buffers())
    assert all(each is buffers[name] for name, each in loaded.critic.at_rest.trunk.named_buffers())
    assert bool(buffers) == (cls is not Stacked)


def test_in_the_actor_too() -> None:
    """The action of a TD target then comes from running statistics, and the actor's own step moves them."""
    model = bro(model_size=None, policy_kwargs={"actor_network": CrossQ, "critic_network": CrossQ})
    model.learner.update(random_batch(model, 16))
    assert model.actor.trunk.norm.num_batches_tracked >= 1
    model.policy.set_training_mode(True)
    n = int(model.actor.trunk.norm.num_batches_tracked)
    model.learner.next_actions(random_batch(model).observations)
    assert model.actor.trunk.norm.num_batches_tracked == n


@COMPILES
@pytest.mark.slow
def test_compiled_as_eager() -> None:
    models = [crossq(compile=compile, learning_rate=1e-3) for compile in (False, True)]
    for model in models:
        for i in range(4):
            model.learner.update(random_batch(model, 16, seed=i), drawn())
    assert models[1].compiled and models[1].learner.seconds_compiling > 0
    for (name, a), b in zip(models[0].policy.state_dict().items(), models[1].policy.state_dict().values(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5, msg=name)


def test_refused() -> None:
    with pytest.raises(ValueError, match="stacks_rows of a network must be None, 'online' or 'target', not 'both'"):
        crossq(Wrong)
