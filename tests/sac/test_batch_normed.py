"""CrossQ, XQC and FlashSAC: against sb3_contrib, by hand, and what they refuse."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import CrossQ as ContribCrossQ
from sb3_contrib.common.torch_layers import BatchRenorm1d
from stable_baselines3.common.logger import configure
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_sample import SAC, XQC, CrossQ, FlashSAC
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.target import values
from sb3_sample.networks import (
    BatchNorm,
    BatchRenorm,
    CrossQNet,
    EnsembleLinear,
    FlashNet,
    UnitEnsembleLinear,
    UnitLinear,
    XQCNet,
)
from sb3_sample.networks.flash import UnitBatchNorm, UnitRMSNorm
from sb3_sample.networks.unit_norm import UnitNorm
from tests.learner.test_group import together
from tests.sac.common import MAKERS, differing, random_batch, sac, state, vec
from tests.sac.golden_batch_norm import to_double

AGENTS = ["CrossQ", "CrossQ+WN", "XQC", "FlashSAC"]


# ---------------------------------------------------------------- batch norm


@pytest.mark.parametrize("unbiased", [False, True])
@pytest.mark.parametrize("n_copies", [None, 3])
def test_batch_norm_is_torchs(n_copies: int | None, unbiased: bool) -> None:
    """Outputs, gradients and running moments, in training and evaluation mode; each copy its own."""
    torch.manual_seed(0)
    ours = BatchNorm(5, n_copies, eps=1e-3, momentum=0.1, running_unbiased=unbiased).double()
    theirs = [nn.BatchNorm1d(5, eps=1e-3, momentum=0.1).double() for _ in range(n_copies or 1)]
    with torch.no_grad():
        ours.weight.normal_()
        ours.bias.normal_()
    for e, norm in enumerate(theirs):
        norm.load_state_dict({
            "weight": ours.weight.reshape(-1, 5)[e],
            "bias": ours.bias.reshape(-1, 5)[e],
            "running_mean": torch.zeros(5),
            "running_var": torch.ones(5),
            "num_batches_tracked": torch.tensor(0),
        })  # fmt: skip
    for step in range(4):
        # torch remembers the unbiased variance.
        for module in (ours, *theirs):
            module.train(step < 3 or not unbiased)
        x = torch.randn(*([n_copies] if n_copies else []), 6, 5, dtype=torch.float64, requires_grad=True)
        y = torch.stack([norm(each) for norm, each in zip(theirs, x.reshape(-1, 6, 5), strict=True)])
        found, factor = ours(x).reshape(y.shape), torch.randn_like(y)
        torch.testing.assert_close(found, y)
        gradients = [torch.autograd.grad((each * factor).sum(), x)[0] for each in (found, y)]
        torch.testing.assert_close(*gradients)
    for e, norm in enumerate(theirs):
        torch.testing.assert_close(ours.running_mean.reshape(-1, 5)[e], norm.running_mean)
        if unbiased:
            torch.testing.assert_close(ours.running_var.reshape(-1, 5)[e], norm.running_var)
        else:
            assert (ours.running_var.reshape(-1, 5)[e] < norm.running_var).all()


def test_rows_that_copies_share() -> None:
    norm = BatchNorm(3, 2)
    with torch.no_grad():
        norm.weight[1] = 2.0
    x = torch.randn(7, 3)
    y = norm(x)
    assert y.shape == (2, 7, 3)
    torch.testing.assert_close(y[1], 2 * y[0])
    torch.testing.assert_close(norm.running_mean[1, 0], 0.01 * x.mean(0))


def test_renormalisation_is_sb3_contribs() -> None:
    """Before and after the warm-up, on batches that are far from the running moments."""
    torch.manual_seed(0)
    ours, theirs = BatchRenorm(4, unbiased=True, warm_up=2).double(), BatchRenorm1d(4, warmup_steps=2).double()
    for step in range(8):
        x = (torch.randn(6, 4, dtype=torch.float64) * 0.1 + 3 * step).requires_grad_()
        factor = torch.randn(6, 4, dtype=torch.float64)
        found = [(norm(x), norm) for norm in (ours, theirs)]
        torch.testing.assert_close(found[0][0], found[1][0])
        gradients = [torch.autograd.grad((y * factor).sum(), x)[0] for y, _ in found]
        torch.testing.assert_close(*gradients)
        torch.testing.assert_close(ours.running_mean, theirs.ra_mean)
        torch.testing.assert_close(ours.running_var, theirs.ra_var)
    ours.eval(), theirs.eval()
    torch.testing.assert_close(ours(x), theirs(x))
    plain = BatchRenorm(4, unbiased=True, warm_up=100).double()
    plain.load_state_dict({**ours.state_dict(), "n_passes": torch.tensor(0)})
    assert not torch.allclose(plain(x), ours.train()(x))


def test_renormalisation_of_a_dead_neuron_has_finite_gradients() -> None:
    norm = BatchRenorm(2, warm_up=0)
    x = torch.stack((torch.zeros(5), torch.arange(5.0)), dim=1).requires_grad_()
    for _ in range(3):
        gradient = torch.autograd.grad(norm(x).square().sum(), x)[0]
        assert gradient.isfinite().all()


@pytest.mark.parametrize("agent", ["CrossQ", "XQC", "FlashSAC"])
@pytest.mark.parametrize("exploration", ["optimistic_shift", "optimistic_actor"])
def test_an_explorer_that_learns_leaves_the_actors_statistics(agent: str, exploration: str) -> None:
    statistics = []
    for chosen in "actor", exploration:
        model = MAKERS[agent](exploration=chosen, exploration_kwargs=None)
        generator = torch.Generator().manual_seed(0)
        for i in range(6):
            drawn = [torch.randn(16, model.actor.action_dim, generator=generator) for _ in range(3)]
            model.learner.update(random_batch(model, 16, seed=i), Noise(*drawn))
        statistics.append([b.clone() for b in model.actor.trunk.buffers()])
    assert len(statistics[0]) > 0 and all(map(torch.equal, *statistics))


# ---------------------------------------------------------------- unit norm


def of_unit_norm(**networks: nn.Module) -> list[tuple[str, nn.Module]]:
    found = [(f"{of}.{name}", m) for of, network in networks.items() for name, m in network.named_modules()]
    return [(name, module) for name, module in found if isinstance(module, UnitNorm)]


def assert_unit_norm(layers: list[tuple[str, Any]]) -> None:
    for name, layer in layers:
        if isinstance(layer, UnitBatchNorm):
            size = (layer.weight.square() + layer.bias.square()).sum(-1) / layer.n_features
        elif isinstance(layer, UnitRMSNorm):
            size = layer.weight.square().mean(-1)
        else:
            size = layer.weight.square().sum(1)
            if layer.joint_bias:
                assert layer.bias.abs().max() > 0
                size = size + layer.bias.square().reshape(size.shape)
        torch.testing.assert_close(size.sqrt(), torch.ones_like(size), rtol=0, atol=1e-6, msg=name)


@pytest.mark.parametrize("agent", ["CrossQ+WN", "XQC", "FlashSAC"])
def test_projection_keeps_norms_at_one(agent: str) -> None:
    model = MAKERS[agent](learning_rate=0.1)
    for i in range(7):
        model.learner.update(random_batch(model, 16, seed=i))
        layers = of_unit_norm(actor=model.actor, critic=model.critic)
        heads = {"CrossQ+WN": 2 + 2 + 3, "XQC": 2 + 2 + 3, "FlashSAC": 1}[agent]
        assert len(layers) >= heads
        for name, layer in layers:
            if isinstance(layer, (UnitLinear, UnitEnsembleLinear)):
                assert layer.joint_bias == (agent == "CrossQ+WN" and ".dense." in name)
        assert_unit_norm(layers)


@pytest.mark.parametrize(
    ("agent", "exploration", "kwargs", "n_layers"),
    [
        # Two hidden layers, mean and log standard deviation.
        ("CrossQ+WN", "optimistic_actor", None, 4),
        ("XQC", "optimistic_actor", None, 4),
        ("FlashSAC", "optimistic_actor", None, 1),
        ("SimbaV2", "optimistic_actor", None, 1),
        ("SAC", "optimistic_shift", {"network": "simbav2", "network_kwargs": {"width": 8, "n_blocks": 1}}, 1),
        ("SAC", "optimistic_shift", {"network": "xqc", "network_kwargs": {"hidden_sizes": (8, 8)}}, 2),
    ],
)
def test_optimistic_actors_are_projected_too(
    agent: str, exploration: str, kwargs: dict[str, Any] | None, n_layers: int
) -> None:
    """Output layers included, also where many learners take their gradient steps as one."""
    for n_models in 1, 2:
        models = [
            MAKERS[agent](learning_rate=0.1, exploration=exploration, exploration_kwargs=kwargs, seed=seed)
            for seed in range(n_models)
        ]
        before = state(models[0])

        def learn(i: int, models: list[Any] = models) -> None:
            for step in range(5):
                models[i].learner.update(random_batch(models[i], 16, seed=step))

        if n_models == 1:
            learn(0)
        else:
            together([model.learner for model in models], learn)
        for model in models:
            layers = of_unit_norm(explorer=model.explorer)
            assert len(layers) >= n_layers
            assert_unit_norm(layers)
        assert [name for name in differing(before, state(models[0])) if "explorer" in name and "weight" in name]


def test_joint_projection_by_hand() -> None:
    layer = UnitLinear(2, 1)
    with torch.no_grad():
        layer.weight.copy_(torch.tensor([[2.0, 3.0]]))
        layer.bias.copy_(torch.tensor([6.0]))
    layer.joint_bias = True
    layer.project()
    torch.testing.assert_close(layer.weight, torch.tensor([[2 / 7, 3 / 7]]))
    torch.testing.assert_close(layer.bias, torch.tensor([6 / 7]))


def test_initial_networks_are_projected() -> None:
    for make in (lambda n: XQCNet(4, (6, 7), n_copies=n), lambda n: FlashNet(4, 6, 1, n_copies=n)):
        for n in (None, 2):
            for layer in make(n).modules():  # type: ignore[no-untyped-call]
                if isinstance(layer, (nn.Linear, EnsembleLinear)):
                    torch.testing.assert_close(layer.weight.norm(dim=1), torch.ones_like(layer.weight[:, 0]))
                    assert layer.bias is None


# ---------------------------------------------------------------- CrossQ against sb3_contrib


class Boxes(gym.Env):
    def __init__(self) -> None:
        self.observation_space = spaces.Box(-10, 10, (5,), np.float32)
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)

    def reset(self, *, seed: Any = None, options: Any = None) -> Any:
        return np.zeros(5, np.float32), {}

    def step(self, action: Any) -> Any:
        return np.zeros(5, np.float32), 0.0, False, False, {}


def pair(renorm_warm_up: int = 100_000) -> tuple[Any, Any]:
    """
    Our CrossQ and sb3_contrib's in float64, with the same parameters, and running moments that are not those of the
    start. Theirs has log(1 - a² + 1e-6) in log π; the number is taken out.
    """
    torch.manual_seed(0)
    arch = {"pi": [12, 10], "qf": [16, 14]}
    sizes = {f"{who}_network_kwargs": {"renorm_warm_up": renorm_warm_up} for who in ("actor", "critic")}
    ours = CrossQ("MlpPolicy", Boxes(), policy_kwargs={"net_arch": arch, **sizes}, ent_coef="auto_0.3", device="cpu")
    theirs = ContribCrossQ(
        "MlpPolicy",
        Boxes(),
        policy_kwargs={"net_arch": arch, "renorm_warmup_steps": renorm_warm_up},
        ent_coef="auto_0.3",
        device="cpu",
        learning_starts=0,
    )
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for p in theirs.policy.parameters():
            p.add_(0.1 * torch.randn(p.shape, generator=generator))
        # Actions whose tanh is far from its ends, where rounding would be magnified.
        for head, level in ((theirs.actor.mu, 0.0), (theirs.actor.log_std, -1.0)):
            head.weight.mul_(0.3)
            head.bias.fill_(level)
        for module in theirs.policy.modules():
            if isinstance(module, BatchRenorm1d):
                module.ra_mean.normal_(generator=generator)
                module.ra_var.uniform_(0.5, 2, generator=generator)
                module.steps.fill_(10)
        for e, network in enumerate(theirs.critic.q_networks):
            copy_layers(network, ours.critic.trunk, ours.critic.head, e)
        copy_layers(theirs.actor.latent_pi, ours.actor.trunk, None, None)
        for head, of in ((ours.actor.mean, theirs.actor.mu), (ours.actor.log_std, theirs.actor.log_std)):
            head.load_state_dict(of.state_dict())
    to_double(ours)
    theirs.policy.double()
    assert theirs.log_ent_coef is not None
    theirs.log_ent_coef.data = ours.temperature.log_value.data.reshape(1).clone()
    for network in (theirs.actor, theirs.critic):
        vars(network)["extract_features"] = lambda observations, extractor=None: observations
    theirs.actor.action_dist.epsilon = 0.0
    return ours, theirs


def close(ours: Any, theirs: Any) -> None:
    """Of float64, to rounding beside the array's largest element."""
    ours, theirs = (torch.as_tensor(each, dtype=torch.float64).detach() for each in (ours, theirs))
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-9 * max(float(theirs.abs().max()), 1e-3))


def tensors(module: Any) -> list[torch.Tensor]:
    """Of a norm of either kind, or a dense layer."""
    if isinstance(module, BatchRenorm1d):
        return [module.scale, module.bias, module.ra_mean, module.ra_var]
    if isinstance(module, BatchNorm):
        return [module.weight, module.bias, module.running_mean, module.running_var]
    return [module.weight, module.bias]


def matching(sequence: Any, trunk: CrossQNet, head: Any, e: int | None) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Tensors of theirs and views of ours, in their order."""
    layers = [layer for layer in sequence if isinstance(layer, (nn.Linear, BatchRenorm1d))]
    mine = [trunk.input_norm]
    for dense, norm in zip(trunk.dense, trunk.norms, strict=True):
        mine += [dense, norm]  # type: ignore[list-item]
    mine += [] if head is None else [head]
    pairs = []
    for theirs, ours in zip(layers, mine, strict=True):
        for a, b in zip(tensors(theirs), tensors(ours), strict=True):
            view = b if e is None else b[e].mT if a.dim() == 2 else b[e, 0]
            pairs.append((a, view))
    return pairs


def copy_layers(sequence: Any, trunk: CrossQNet, head: Any, e: int | None) -> None:
    for theirs, ours in matching(sequence, trunk, head, e):
        ours.copy_(theirs)
    for norm in trunk.modules():
        if isinstance(norm, BatchRenorm):
            norm.n_passes.fill_(10)


def matching_critics(ours: Any, theirs: Any) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Tensors of their critics and views of ours."""
    critics = enumerate(theirs.critic.q_networks)
    return [each for e, net in critics for each in matching(net, ours.critic.trunk, ours.critic.head, e)]


def matching_actors(ours: Any, theirs: Any) -> list[tuple[torch.Tensor, torch.Tensor]]:
    pairs = matching(theirs.actor.latent_pi, ours.actor.trunk, None, None)
    for head, of in ((ours.actor.mean, theirs.actor.mu), (ours.actor.log_std, theirs.actor.log_std)):
        pairs += list(zip(of.parameters(), head.parameters(), strict=True))
    return pairs


@pytest.mark.parametrize("learns", [False, True])
@pytest.mark.parametrize("renorm_warm_up", [100_000, 0])
def test_crossq_is_sb3_contribs(renorm_warm_up: int, learns: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """
    One update, with the actor or without, before and after the warm-up: losses, gradients, parameters, running moments.
    """
    ours, theirs = pair(renorm_warm_up)
    n, g = 64, torch.Generator().manual_seed(1)
    batch = Batch(*(x.double() if isinstance(x, torch.Tensor) else x for x in random_batch(ours, n)))
    noise = Noise(*(torch.randn(n, 3, generator=g, dtype=torch.float64) for _ in range(2)))
    samples = ReplayBufferSamples(
        batch.observations, batch.actions, batch.next_observations, batch.dones, batch.rewards, None
    )
    assert theirs.replay_buffer is not None
    monkeypatch.setattr(theirs.replay_buffer, "sample", lambda *_, **__: samples)
    drawn = iter((noise.critic, noise.actor))
    monkeypatch.setattr(torch.distributions.normal, "_standard_normal", lambda *_, **__: next(drawn))
    theirs.set_logger(configure(None, []))
    temperature = float(ours.temperature().detach())
    # The third update is the actor's, in both.
    theirs._n_updates = ours._n_updates = 2 if learns else 0
    theirs.train(1, n)
    metrics = ours.learner.update(batch, noise)
    assert ("train/actor_loss" in metrics) == learns
    assert ours.target_entropy == theirs.target_entropy
    of_critics = matching_critics(ours, theirs)
    of_actor = matching_actors(ours, theirs)
    assert len(of_critics) == 2 * (3 * 4 + 3 * 2) and len(of_actor) == (3 * 4 + 2 * 2) + 4
    for a, b in of_critics + of_actor:
        close(b, a)
    close(ours.temperature.log_value, theirs.log_ent_coef[0])
    # Gradients of ours in the place of the parameters, of which the views are.
    for p in (*ours.critic.parameters(), *ours.actor.parameters()):
        p.data = p.grad if p.grad is not None else torch.full_like(p, torch.nan)
    if not learns:
        # Theirs also holds those of the actor's loss, where there is one.
        for a, b in matching_critics(ours, theirs):
            if a.grad is not None:
                close(b, a.grad)
        return
    reported = theirs.logger.name_to_value
    for a, b in matching_actors(ours, theirs):
        if a.grad is not None:
            close(b, a.grad)
    assert abs(metrics["train/actor_loss"] - reported["train/actor_loss"]) < 1e-5
    # Our gradient is through the temperature, theirs through its logarithm.
    close(ours.temperature.log_value.grad, temperature * theirs.log_ent_coef.grad[0])


def test_joint_forward_against_two_in_evaluation_mode() -> None:
    """With the running moments at those of the stacked rows, both passes apart give what the joint one gave."""
    model = CrossQ("MlpPolicy", Boxes(), policy_kwargs={"net_arch": [12]}, device="cpu")
    batch, n = random_batch(model, 32), 32
    g = torch.Generator().manual_seed(0)
    next_actions = torch.rand(n, 3, generator=g) * 2 - 1
    critic = copy.deepcopy(model.critic)
    for norm in critic.modules():
        if isinstance(norm, BatchNorm):
            norm.momentum = 1.0
    critic.train()
    rows = torch.cat((batch.observations, batch.next_observations)), torch.cat((batch.actions, next_actions))
    with torch.no_grad():
        joint = critic.q_values(*rows)
        critic.eval()
        now = critic.q_values(batch.observations, batch.actions)
        following = critic.q_values(batch.next_observations, next_actions)
    torch.testing.assert_close(joint, torch.cat((now, following), dim=1))
    # Apart in training mode is something else.
    critic.train()
    with torch.no_grad():
        assert not torch.allclose(critic.q_values(batch.observations, batch.actions), now, atol=1e-3)


# ---------------------------------------------------------------- statistics, and when they move


def running(network: Any) -> torch.Tensor:
    return torch.cat([m.running_mean.flatten() for m in network.modules() if isinstance(m, BatchNorm)])


@pytest.mark.parametrize(
    ("agent", "learns", "moves"),
    [
        ("CrossQ", [False, False, True], [False, False, True]),
        ("CrossQ+WN", [True, False, False], [True, True, True]),
        ("XQC", [True, False, False], [True, True, True]),
        ("FlashSAC", [True, False, True], [True, False, True]),
    ],
)
def test_when_the_actor_moves(agent: str, learns: list[bool], moves: list[bool]) -> None:
    """Its parameters, and its running moments, which acting, TD targets and evaluation leave alone."""
    model = MAKERS[agent]()
    for i in range(3):
        before, moments = copy.deepcopy(model.actor), running(model.actor)
        critics = running(model.critic)
        metrics = model.learner.update(random_batch(model, 16, seed=i))
        has_moved = any(
            not torch.equal(a, b) for a, b in zip(before.parameters(), model.actor.parameters(), strict=True)
        )
        assert has_moved == learns[i] == ("train/actor_loss" in metrics)
        assert torch.equal(moments, running(model.actor)) != moves[i]
        assert not torch.equal(critics, running(model.critic))
    at_rest = state(model)
    for deterministic in (True, False):
        model.predict(np.zeros((4, 3), np.float32), deterministic=deterministic)
    model.learner.act(torch.zeros(4, 3))
    values(model.learner, model.critic, torch.zeros(4, 3), torch.zeros(4, 2))
    assert not [name for name in differing(at_rest, state(model)) if name.startswith("policy")]


def test_flash_sacs_actor_sees_both_halves() -> None:
    """Batch statistics of current and next observations; the loss is of the current ones."""
    model: Any = MAKERS["FlashSAC"]()
    batch, noise = random_batch(model, 16), torch.randn(16, 2)
    actor = copy.deepcopy(model.actor)
    actor.train()
    norm = actor.trunk.input_norm
    actor.sample(batch.observations, noise, batch.next_observations)
    rows = torch.cat((batch.observations, batch.next_observations))
    torch.testing.assert_close(norm.running_mean, 0.01 * rows.mean(0))
    torch.testing.assert_close(norm.running_var, 0.99 + 0.01 * rows.var(0))
    model.learner.update(batch, Noise(actor=noise))
    torch.testing.assert_close(model.actor.trunk.input_norm.running_mean, norm.running_mean)


@pytest.mark.parametrize("agent", ["CrossQ", "CrossQ+WN", "XQC"])
def test_a_batch_of_one_is_refused(agent: str) -> None:
    with pytest.raises(ValueError, match="batch_size must be at least 2 with batch norm, .* not 1"):
        MAKERS[agent](batch_size=1)
    model = MAKERS[agent]()
    model.learn(20)
    before = (model._n_updates, {name: value.clone() for name, value in model.policy.state_dict().items()})
    with pytest.raises(ValueError, match="transitions of a batch must be at least 2 with batch norm, .* not 1"):
        model.learner.update(random_batch(model, 1))
    model.batch_size = 1
    with pytest.raises(ValueError, match="batch_size must be at least 2 with batch norm, .* not 1"):
        model.train(1)
    # Nothing has learned from it, the critics neither, which would have two rows.
    assert model._n_updates == before[0] > 0
    assert all(torch.equal(value, before[1][name]) for name, value in model.policy.state_dict().items())


def test_initial_kernels_of_crossq_are_lecun_normal() -> None:
    model = CrossQ("MlpPolicy", vec(), seed=0, device="cpu")
    layers = [*model.critic.trunk.dense, model.critic.head, *model.actor.trunk.dense, model.actor.mean]
    for layer in layers:
        std, n = layer.in_features**-0.5, layer.weight.numel()
        # The standard error of a normal sample's; the truncated one's is smaller.
        assert abs(layer.weight.std().item() / std - 1) < 4 / (2 * n) ** 0.5
        assert 1.5 * std < layer.weight.abs().max() <= 2 * std / 0.8796 + 1e-6
        assert not layer.bias.any()
    # Units of CrossQ+WN have length 1 instead.
    assert CrossQ("MlpPolicy", vec(), weight_norm=True, device="cpu").actor.trunk.kernels == "orthogonal"
    own = CrossQ("MlpPolicy", vec(), device="cpu", policy_kwargs={"critic_network_kwargs": {"kernels": "orthogonal"}})
    assert (own.critic.trunk.kernels, own.actor.trunk.kernels) == ("orthogonal", "lecun_normal")
    with pytest.raises(ValueError, match="kernels must be one of .'lecun_normal', 'orthogonal'., not 'he_normal'"):
        CrossQ("MlpPolicy", vec(), device="cpu", policy_kwargs={"critic_network_kwargs": {"kernels": "he_normal"}})


def test_a_batch_of_one_is_refused_for_an_explorer() -> None:
    network = {"network": "xqc", "network_kwargs": {"hidden_sizes": [8]}}
    model = sac(exploration="optimistic_shift", exploration_kwargs=network).learn(20)
    before = copy.deepcopy(model.policy.state_dict())
    with pytest.raises(ValueError, match="batch_size must be at least 2 with batch norm"):
        model.train(1, batch_size=1)
    assert all(torch.equal(value, before[name]) for name, value in model.policy.state_dict().items())


def test_a_batch_of_one_of_flash_sac() -> None:
    """Two rows of current and next state are a batch."""
    model = MAKERS["FlashSAC"](batch_size=1).learn(30)
    assert all(p.isfinite().all() for p in model.policy.state_dict().values())


# ---------------------------------------------------------------- arguments


def test_defaults_with_weight_norm() -> None:
    make = MAKERS["CrossQ"]
    plain, normed = make(replay_ratio=1), CrossQ("MlpPolicy", vec(), weight_norm=True, device="cpu")
    assert (plain.learning_rate, plain.target_entropy, plain.learning_rate_schedule) == (1e-3, -2.0, None)
    assert (normed.learning_rate, normed.target_entropy, normed.replay_ratio) == (3e-4, -1.0, 2)
    assert (normed.learning_rate_schedule, normed.final_learning_rate) == ("linear", 3e-5)
    assert normed.actor_at_once and normed.weight_decay == 0.01 and normed.ent_coef == "auto_0.01"
    assert normed.critic.trunk.out_features == 512 and normed.critic.trunk.stacks_rows == "target"
    assert plain.critic.optimizer.param_groups[0]["betas"] == (0.5, 0.999)
    assert normed.critic.optimizer.param_groups[0]["betas"] == (0.9, 0.999)
    assert CrossQ("MlpPolicy", vec(), device="cpu").critic.trunk.out_features == 2048
    # What is passed stays, also at the other default's value.
    own = CrossQ(
        "MlpPolicy", vec(), 1e-3, weight_norm=True, ent_coef="auto", replay_ratio=1, learning_rate_schedule=None
    )
    assert (own.learning_rate, own.ent_coef, own.replay_ratio, own.final_learning_rate) == (1e-3, "auto", 1, 0)

    class Mine(CrossQ):
        learning_rate: float = 7e-4

    assert Mine("MlpPolicy", vec(), weight_norm=True, device="cpu").learning_rate == 7e-4
    numpys: Any = np.True_
    same = CrossQ("MlpPolicy", vec(), weight_norm=numpys, device="cpu")
    names = (*CrossQ.WITH_WEIGHT_NORM, "weight_norm")
    assert [getattr(same, name) for name in names] == [getattr(normed, name) for name in names]


@pytest.mark.parametrize(
    ("agent", "kwargs", "words"),
    [
        ("CrossQ", {"weight_norm": 1}, "weight_norm must be True or False, not 1"),
        (
            "CrossQ",
            {"weight_norm": True, "policy_kwargs": {"critic_network": "mlp"}},
            "weight_norm=True is of the networks 'crossq', not of critic_network='mlp'",
        ),
        ("CrossQ", {"weight_decay": -1}, "weight_decay must be at least 0"),
        (
            "CrossQ",
            {"policy_kwargs": {"critic_network_kwargs": {"weight_norm": True}}},
            "weight_norm is an argument of the algorithm",
        ),
        (
            "CrossQ",
            {"policy_kwargs": {"optimizer_kwargs": {"weight_decay": 0.1}}},
            "weight_decay is an argument of the algorithm",
        ),
        ("CrossQ", {"policy_kwargs": {"critic_network_kwargs": {"renorm_warm_up": -1}}}, "renorm_warm_up must be"),
        ("XQC", {"policy_kwargs": {"net_arch": [0]}}, "net_arch must be"),
        ("XQC", {"policy_kwargs": {"critic_network_kwargs": {"hidden_sizes": (8, 0)}}}, "hidden_sizes that are integ"),
        ("XQC", {"policy_kwargs": {"critic_network_kwargs": {"momentum": 0}}}, r"momentum must lie in \(0, 1\], not 0"),
        ("XQC", {"policy_kwargs": {"actor_kwargs": {"log_std_min": 3}}}, "log_std_min must lie below log_std_max=2"),
        ("XQC", {"policy_kwargs": {"actor_kwargs": {"target_noise": 3}}}, "actor_kwargs has 'target_noise', but"),
        ("XQC", {"redo_period": 5}, "recycles hidden neurons"),
        (
            "FlashSAC",
            {"policy_kwargs": {"net_arch": [8]}},
            r"net_arch describes an MLP.* and actor_network_kwargs \(its own are width, n_blocks, expansion\)",
        ),
        ("FlashSAC", {"policy_kwargs": {"critic_network_kwargs": {"width": 0}}}, "FlashNet needs width >= 1"),
        ("FlashSAC", {"exploration_kwargs": {"longest": 0}}, "longest must be an integer of at least 1, not 0"),
        ("FlashSAC", {"exploration_kwargs": {"exponent": -1}}, "exponent must be at least 0"),
        ("FlashSAC", {"target_std": 0.5, "target_entropy": -3}, "target_std=0.5 means nothing with target_entropy=-3"),
        ("FlashSAC", {"target_std": 0}, "target_std must be above 0"),
    ],
)
def test_refused(agent: str, kwargs: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MAKERS[agent](**kwargs)


def test_target_std_of_a_loaded_model(tmp_path: Path) -> None:
    made, other = MAKERS["FlashSAC"](target_std=0.3), MAKERS["FlashSAC"](target_std=0.5)
    made.save(tmp_path / "model")
    as_it_was = FlashSAC.load(tmp_path / "model")
    assert (as_it_was.target_std, as_it_was.target_entropy) == (0.3, made.target_entropy)
    assert FlashSAC.load(tmp_path / "model", target_std=0.5).target_entropy == other.target_entropy
    with pytest.raises(ValueError, match=r"target_std=0\.15 means nothing with target_entropy=-3"):
        FlashSAC.load(tmp_path / "model", target_std=0.15, target_entropy=-3)
    assert FlashSAC.load(tmp_path / "model", target_entropy=-3).target_entropy == -3


def test_discount() -> None:
    assert XQC.discount(1_000, action_repeat=2) == XQC.discount(500) == 0.99
    assert (XQC.discount(20), XQC.discount(1_000), XQC.discount(10**6)) == (0.95, 0.995, 0.995)
    with pytest.raises(ValueError, match="episode_steps must be above 0"):
        XQC.discount(0)


def test_networks_by_name_in_other_agents() -> None:
    """A part for any agent: learned with, saved and loaded."""
    for name, kwargs in (("xqc", {"hidden_sizes": [8]}), ("crossq", {"hidden_sizes": [8]}), ("flash", {"width": 8})):
        networks = {f"{who}_network{k}": v for who in ("critic", "actor") for k, v in (("", name), ("_kwargs", kwargs))}
        model = SAC(
            "MlpPolicy", vec(), policy_kwargs=networks, learning_starts=10, batch_size=8, buffer_size=100, device="cpu"
        ).learn(30)
        assert all(p.isfinite().all() for p in model.policy.state_dict().values())


@pytest.mark.parametrize("agent", AGENTS)
def test_batch_statistics_are_saved(agent: str, tmp_path: Path) -> None:
    model = MAKERS[agent]().learn(40)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model")
    assert running(model.actor).abs().max() > 0
    assert torch.equal(running(model.actor), running(loaded.actor))
    assert torch.equal(running(model.critic), running(loaded.critic))
    observation = np.ones((1, 3), np.float32)
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
    assert np.array_equal(*actions)


def test_weight_decay_is_of_all_parameters() -> None:
    """With a gradient of zero, scale and shift of the norms and the output layer shrink by the rate times the decay."""
    model: Any = MAKERS["CrossQ+WN"](learning_rate=0.5, learning_rate_schedule=None)
    optimizer = model.critic.optimizer
    assert optimizer.param_groups[0]["weight_decay"] == 0.01
    before = [p.detach().clone() for p in model.critic.parameters()]
    for p in model.critic.parameters():
        p.grad = torch.zeros_like(p)
    optimizer.step()
    for p, old in zip(model.critic.parameters(), before, strict=True):
        torch.testing.assert_close(p.detach(), old * (1 - 0.5 * 0.01))


def batch_of(model: Any, observations: torch.Tensor) -> Batch:
    return random_batch(model, len(observations))._replace(observations=observations)


def test_constant_features_do_no_harm() -> None:
    """A feature that never moves, as in batches of one state, is 0 after the norm, and no parameter is NaN."""
    for agent in AGENTS:
        model = MAKERS[agent]()
        for _ in range(4):
            model.learner.update(batch_of(model, torch.ones(8, 3))._replace(next_observations=torch.ones(8, 3)))
        assert all(p.isfinite().all() for p in model.policy.state_dict().values()), agent
