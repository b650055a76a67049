"""The bare SAC that ``benchmarks/gpu.py`` measures beside ours takes the same updates."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import torch

from sb3_sample.learner.batch import Batch, Noise
from tests.sac.common import random_batch, sac

FILE = Path(__file__).parents[1] / "benchmarks" / "lean_sac.py"
WIDTH = 16


def load() -> Any:
    spec = importlib.util.spec_from_file_location("lean_sac", FILE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["lean_sac"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_its_updates_are_ours() -> None:
    kwargs = {"net_arch": [WIDTH, WIDTH]}
    model = sac(policy_kwargs=kwargs, compile=False, seed=0, gamma=0.99, tau=0.005, learning_rate=3e-4)
    learner, (o, a) = model.learner, (3, 2)
    lean = load().LeanSAC(o, a, width=WIDTH, batch_size=8)
    ours, theirs = parameters_of(learner), [*lean.critics, *lean.targets, *lean.actor.parameters(), lean.log_alpha]
    with torch.no_grad():
        for own, other in zip(ours, theirs, strict=True):
            other.copy_(own)
        # Equal at the start, they could hide one in the place of the other.
        for own, other in zip(ours[6:12], theirs[6:12], strict=True):
            own.mul_(0.9)
            other.mul_(0.9)
    before = [each.clone() for each in theirs]
    lean.target_entropy = learner.target_entropy
    learner.set_training_mode(True)
    for i in range(5):
        batch: Batch = random_batch(model, seed=i)
        dones = (torch.arange(8) % 3 == 0).float().unsqueeze(1)
        noise = torch.randn(2, 8, a, generator=torch.Generator().manual_seed(i))
        batch = batch._replace(dones=dones, discounts=0.99)
        learner.step(batch, Noise(noise[0], noise[1]))
        lean.update(batch.observations, batch.actions, batch.next_observations, dones, batch.rewards, noise)
    for own, other, old in zip(parameters_of(learner), theirs, before, strict=True):
        assert torch.allclose(own, other, atol=1e-5)
        assert not torch.allclose(other, old, atol=1e-5)


def parameters_of(learner: Any) -> list[torch.Tensor]:
    """Those of ours, in the lean one's order; the actor's two heads are one there."""
    actor = learner.actor
    heads = [torch.cat([getattr(head, name) for head in (actor.mean, actor.log_std)]) for name in ("weight", "bias")]
    critics = [*learner.critic.parameters(), *learner.critic_target.parameters()]
    return [*critics, *actor.trunk.parameters(), *heads, learner.temperature.log_value]


def test_it_draws_its_batch_of_the_store() -> None:
    lean = load().LeanSAC(3, 2, width=WIDTH, batch_size=8)
    store = [torch.rand(20, n) for n in (3, 2, 3, 1, 1)]
    lean.capture()  # which is of GPUs alone
    before = lean.log_alpha.item()
    lean.step(store)
    drawn = [
        [bool((column == row).all(dim=1).any()) for row in own] for own, column in zip(lean.inputs, store, strict=True)
    ]
    assert all(map(all, drawn)) and lean.log_alpha.item() != before
