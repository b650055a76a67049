"""
SimBa's and SimbaV2's networks: SimBa's beside SBX's, weights of unit norm, ReDo's and the compiler's needs.

``simba_sbx.npz`` has parameters, inputs, outputs and gradients of the networks of SBX 0.28 (``SimbaVectorCritic`` with
two critics of two blocks, ``SimbaSquashedGaussianActor`` with one), computed by flax 0.12.8 on a CPU in float32;
``make_simba_sbx.py`` made it. The parameters are SBX's initial ones with biases, scales and the kernel of the log
standard deviation moved.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sb3_sample.networks import NETWORKS, SimbaNet, SimbaV2Net, UnitNorm, linear
from sb3_sample.networks.ensemble import EnsembleLinear
from sb3_sample.sac import SAC, SimBa, SimbaV2
from tests.sac.common import MAKERS, TINY_RESIDUAL, sac, vec

SBX = np.load(Path(__file__).with_name("simba_sbx.npz"))


def layers(trunk: SimbaNet, heads: list[nn.Module]) -> dict[str, nn.Module]:
    """The layers by SBX's names."""
    named: dict[str, nn.Module] = {"Dense_0": trunk.dense, "LayerNorm_0": trunk.norm}
    named.update({f"Dense_{k}": head for k, head in enumerate(heads, 1)})
    for k, block in enumerate(trunk.blocks):
        here = f"SimbaResidualBlock_{k}"
        named.update({f"{here}/LayerNorm_0": block.norm, f"{here}/Dense_0": block.dense1})
        named[f"{here}/Dense_1"] = block.dense2
    return named


def places(named: dict[str, Any]) -> dict[str, tuple[nn.Parameter, Any]]:
    """Parameters by SBX's names, and what brings a tensor of theirs into the file's layout."""
    found: dict[str, tuple[nn.Parameter, Any]] = {}
    for name, layer in named.items():
        stacked = layer.weight.dim() == 3

        def of_vector(t: torch.Tensor, stacked: bool = stacked) -> torch.Tensor:
            return t[:, 0] if stacked else t

        if "LayerNorm" in name:
            found[f"{name}/scale"] = (layer.weight, of_vector)
        else:
            found[f"{name}/kernel"] = (layer.weight, (lambda t: t) if isinstance(layer, EnsembleLinear) else torch.t)
        found[f"{name}/bias"] = (layer.bias, of_vector)
    return found


def load(prefix: str, named: dict[str, Any]) -> dict[str, tuple[nn.Parameter, Any]]:
    found = places(named)
    stored = {k.removeprefix(f"{prefix}/parameter/"): SBX[k] for k in SBX if k.startswith(f"{prefix}/parameter/")}
    path = "VmapSimbaContinuousCritic_0/"
    stored = {name.removeprefix(path): value for name, value in stored.items()}
    assert found.keys() == stored.keys()
    with torch.no_grad():
        for name, (parameter, view) in found.items():
            view(parameter).copy_(torch.as_tensor(stored[name]))
    return found


def check_gradients(prefix: str, found: dict[str, tuple[nn.Parameter, Any]], loss: torch.Tensor) -> None:
    loss.backward()
    path = "VmapSimbaContinuousCritic_0/" if prefix == "critic" else ""
    for name, (parameter, view) in found.items():
        theirs = SBX[f"{prefix}/gradient/{path}{name}"]
        scale = float(np.abs(theirs).max())
        assert parameter.grad is not None
        np.testing.assert_allclose(view(parameter.grad), theirs, rtol=1e-4, atol=2e-6 * max(scale, 1), err_msg=name)


def test_critics_are_sbxs() -> None:
    o, a = (torch.as_tensor(SBX[name]) for name in ("observations", "actions"))
    trunk = SimbaNet(o.shape[1] + a.shape[1], width=12, n_blocks=2, n_copies=2)
    head = trunk.make_head(1, 2)
    found = load("critic", layers(trunk, [head]))
    q = head(trunk(torch.cat((o, a), dim=1)))
    np.testing.assert_allclose(q.detach(), SBX["critic/output"], rtol=1e-5, atol=2e-6)
    check_gradients("critic", found, (q * torch.as_tensor(SBX["critic/weight"])).sum())


def test_actor_is_sbxs() -> None:
    o = torch.as_tensor(SBX["observations"])
    trunk = SimbaNet(o.shape[1], width=8, n_blocks=1)
    heads = [trunk.make_head(2), trunk.make_head(2)]
    found = load("actor", layers(trunk, heads))
    h = trunk(o)
    mean, log_std = (head(h) for head in heads)
    np.testing.assert_allclose(mean.detach(), SBX["actor/mean"], rtol=1e-5, atol=2e-6)
    np.testing.assert_allclose(log_std.detach(), SBX["actor/log_std"], rtol=1e-5, atol=2e-6)
    weighted = (mean * torch.as_tensor(SBX["actor/weight_mean"])).sum()
    check_gradients("actor", found, weighted + (log_std * torch.as_tensor(SBX["actor/weight_log_std"])).sum())


def test_initial_values() -> None:
    torch.manual_seed(0)
    net = SimbaNet(30, width=64, n_blocks=1, n_copies=2)
    for kernel in (*net.dense.weight, *net.make_head(64, 2).weight):  # type: ignore[union-attr]
        small = kernel if kernel.shape[0] <= kernel.shape[1] else kernel.T
        torch.testing.assert_close(small @ small.T, torch.eye(len(small)), atol=1e-5, rtol=0)
    for layer in (net.blocks[0].dense1, net.blocks[0].dense2):  # type: ignore[union-attr]
        assert isinstance(layer, EnsembleLinear)
        std = math.sqrt(2 / layer.in_features)
        assert layer.weight.std().item() == pytest.approx(std, rel=0.03)
        assert layer.weight.abs().max() <= 2 * std / 0.8796 + 1e-6
        assert not layer.bias.any()  # type: ignore[union-attr]
    single = linear(50, 3000, None, kernels="he_normal")
    assert single.weight.std().item() == pytest.approx(0.2, rel=0.03)


# ---------------------------------------------------------------- unit norm


def lengths(module: nn.Module) -> torch.Tensor:
    found = [
        torch.linalg.vector_norm(layer.weight.double(), dim=1).flatten()
        for layer in module.modules()
        if isinstance(layer, UnitNorm)
    ]
    return torch.cat(found)


def is_unit(module: nn.Module) -> bool:
    return bool((lengths(module) - 1).abs().max() <= 1e-6)


def test_weights_have_unit_norm_through_training() -> None:
    """Of actor and critics, heads included; the targets are averages, whose weights are shorter."""
    model = MAKERS["SimbaV2"](learning_rate=1e-2, tau=0.1)
    layers_of_critics = [layer for layer in model.critic.modules() if isinstance(layer, UnitNorm)]
    assert len(layers_of_critics) == 1 + 2 + 2
    assert is_unit(model.actor) and is_unit(model.critic) and is_unit(model.critic_target)
    before = model.actor.trunk.dense.weight.clone()
    model.learn(60)
    assert not torch.equal(before, model.actor.trunk.dense.weight)
    assert is_unit(model.actor) and is_unit(model.critic)
    assert (lengths(model.critic_target) - 1).abs().max() > 1e-4
    assert lengths(model.critic_target).max() < 1 + 1e-6


def test_after_shrink_and_perturb() -> None:
    model = MAKERS["SimbaV2"](learning_rate=1e-2).learn(30)
    model.reinitialize(0.8)
    assert is_unit(model.actor) and is_unit(model.critic)


def test_features_have_length_1() -> None:
    torch.manual_seed(0)
    net = SimbaV2Net(3, width=16, n_copies=2)
    # Zeros too, since a constant is appended; the input's scale counts beside it.
    h = net(torch.stack([torch.zeros(3), torch.ones(3), 10 * torch.ones(3)]))
    torch.testing.assert_close(h.norm(dim=-1), torch.ones(2, 3))
    assert not torch.allclose(h[:, 1], h[:, 2])


@pytest.mark.parametrize("network", ["simba", "simbav2"])
def test_for_any_agent(network: str) -> None:
    """As the networks of a plain SAC, for one and for many, with diagnostics of its neurons."""
    net = NETWORKS[network](4, width=8, n_blocks=3)
    assert net(torch.zeros(5, 4)).shape == (5, 8)
    assert [units.name for units in net.hidden_units(None)] == [f"blocks.{k}.dense1" for k in range(3)]
    both = {"critic_network": network, "actor_network": network, **TINY_RESIDUAL}
    model = sac(policy_kwargs=both).learn(20)
    assert model.critic(torch.zeros(4, 3), torch.zeros(4, 2)).shape == (2, 4, 1)
    kwargs: Any = {"policy_kwargs": both, "redo_period": 5}
    if network == "simba":
        sac(**kwargs).learn(20)
    else:
        with pytest.raises(
            ValueError, match="redo_period=5 recycles hidden neurons, and no neuron of SimbaV2Net can be recycled"
        ):
            sac(**kwargs)


@pytest.mark.parametrize(
    ("network", "kwargs"),
    [("simba", {"width": 0}), ("simba", {"expansion": 0}), ("simbav2", {"n_blocks": -1}), ("simbav2", {"shift": 0.0})],
)
def test_sizes_are_checked(network: str, kwargs: dict[str, Any]) -> None:
    (name,) = kwargs
    with pytest.raises(ValueError, match=f"needs width >= 1.*{name}={kwargs[name]}"):
        NETWORKS[network](3, **kwargs)


def test_defaults_of_simba() -> None:
    """The published sizes and numbers, read from the model."""
    model = SimBa("MlpPolicy", vec(), buffer_size=10, device="cpu")
    for trunk, width, n_blocks in ((model.critic.trunk, 512, 2), (model.actor.trunk, 128, 1)):
        assert isinstance(trunk, SimbaNet) and (trunk.out_features, len(trunk.blocks)) == (width, n_blocks)
        assert trunk.blocks[0].dense1.out_features == 4 * width
    assert model.critic.n_critics == 1 and model.policy.observation_norm is not None
    assert model.critic(torch.zeros(4, 3), torch.zeros(4, 2)).shape == (1, 4, 1)
    assert (model.temperature().item(), model._target_entropy) == (pytest.approx(0.01), -1.0)
    assert (model.replay_ratio, model.learning_starts, model.batch_size, model.gamma) == (2, 5_000, 256, 0.99)
    decays = {name: o.param_groups[0]["weight_decay"] for name, o in model.learner.optimizers().items()}
    assert decays == {"actor.optimizer": 0.01, "critic.optimizer": 0.01, "temperature_optimizer": 0}
    assert all(o.param_groups[0]["lr"] == 1e-4 for o in model.learner.optimizers().values())


def test_defaults_of_simbav2() -> None:
    """The published sizes and numbers, read from the model."""
    model = SimbaV2("MlpPolicy", vec(), buffer_size=10, device="cpu")
    assert model.critic.trunk.out_features == 512 and len(model.critic.trunk.blocks) == 2
    assert model.actor.trunk.out_features == 128 and len(model.actor.trunk.blocks) == 1
    assert (model.critic.n_critics, model.head.n_outputs, model.head.v_min, model.head.v_max) == (1, 101, -5, 5)
    assert model.temperature().item() == pytest.approx(0.01)
    assert (model.replay_ratio, model.learning_starts, model.batch_size, model.gamma) == (2, 5_000, 256, 0.99)
    assert (model.learning_rate, model.final_learning_rate, model.tau) == (1e-4, 5e-5, 0.005)
    block, d = model.critic.trunk.blocks[0], 512
    assert model.critic.trunk.scaler.scaler.unique().item() == pytest.approx(math.sqrt(2 / d))
    assert block.scaler.scaler.unique().item() == pytest.approx(math.sqrt(2 / d) / 2)
    assert (block.alpha.scaler * block.alpha.factor).unique().item() == pytest.approx(1 / 3)
    assert block.alpha.scaler.unique().item() == pytest.approx(1 / math.sqrt(d))
    assert isinstance(model, SAC)
    groups = [group for optimizer in model.learner.optimizers().values() for group in optimizer.param_groups]
    assert {group["weight_decay"] for group in groups} == {0}
