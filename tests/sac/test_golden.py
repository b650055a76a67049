"""
Parity with gradient updates of the authors' own code, from stored parameters, batches and noise.

The files under ``tests/golden`` were made with the published code (layer sizes shrunk). Another folder of files of
the same format is tested instead if ``SB3_SAMPLE_GOLDEN`` names it.
"""

import json
import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from sb3_sample import BRO
from sb3_sample.networks import BroNet
from sb3_sample.sac.batch import Batch, Noise

OWN_FOLDER = Path(__file__).parents[1] / "golden"
FOLDER = Path(os.environ.get("SB3_SAMPLE_GOLDEN") or OWN_FOLDER)
FILES = sorted(path for path in FOLDER.glob("*.npz") if not path.stem.startswith("dac"))

INFO_TOLERANCE = 3e-5
SCALAR_TOLERANCE = 2e-7
DECAY_TOLERANCE = 3e-5


def parameter_tolerance(n_updates: int) -> float:
    return 1e-6 if n_updates < 20 else 2e-6


class Shapes(gym.Env):
    """An environment that has only shapes."""

    def __init__(self, obs_dim: int, act_dim: int):
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = spaces.Box(-1, 1, (act_dim,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> Any:
        return self.observation_space.sample(), 0.0, False, False, {}


def trunk_layers(trunk: BroNet, path: str) -> dict[str, nn.Module]:
    """The trunk's layers by the names of the files."""
    layers: dict[str, nn.Module] = {f"{path}/Dense_0": trunk.dense, f"{path}/LayerNorm_0": trunk.norm}
    for k, block in enumerate(trunk.blocks):
        layers[f"{path}/Dense_{2 * k + 1}"], layers[f"{path}/LayerNorm_{2 * k + 1}"] = block.dense1, block.norm1
        layers[f"{path}/Dense_{2 * k + 2}"], layers[f"{path}/LayerNorm_{2 * k + 2}"] = block.dense2, block.norm2
    return layers


def named_parameters(model: BRO) -> dict[str, torch.Tensor]:
    """Views of every parameter of the model by its name and in its layout in the files."""
    single = {"actor/Dense_0": model.actor.mean, "actor/Dense_1": model.actor.log_std}
    single.update(trunk_layers(model.actor.trunk, "actor/BroNet_0"))
    single.update(trunk_layers(model.explorer.trunk, "actor_o/BroNet_0"))
    single["actor_o/Dense_0"] = model.explorer.shift
    named: dict[str, torch.Tensor] = {}
    for name, layer in single.items():
        is_norm = isinstance(layer, nn.LayerNorm)
        named[f"{name}/{'scale' if is_norm else 'kernel'}"] = layer.weight if is_norm else layer.weight.T
        if layer.bias is not None:
            named[f"{name}/bias"] = layer.bias
    for module, critic in (("critic", model.critic), ("target_critic", model.critic_target)):
        n_blocks = len(critic.trunk.blocks)
        layers = {**trunk_layers(critic.trunk, "BroNet_0"), f"BroNet_0/Dense_{2 * n_blocks + 1}": critic.head}
        for name, layer in layers.items():
            for e in range(2):
                norm = "LayerNorm" in name
                weight = layer.weight[e, 0] if norm else layer.weight[e]
                named[f"{module}/Critic_{e}/{name}/{'scale' if norm else 'kernel'}"] = weight
                named[f"{module}/Critic_{e}/{name}/bias"] = layer.bias[e, 0]
    named["temp/log_temp"] = model.temperature.log_value
    named["optimism/log_value"] = model.explorer.optimism.raw_value
    named["regularizer/log_value"] = model.explorer.kl_weight.raw_value
    return named


def norm(tensors: list[torch.Tensor]) -> float:
    return float(torch.stack([t.detach().double().square().sum() for t in tensors]).sum().sqrt())


def mean_std(model: BRO, observations: torch.Tensor) -> float:
    with torch.no_grad():
        return float(model.actor.gaussian(model.actor.features(observations))[1].exp().mean())


def build(meta: dict[str, Any]) -> BRO:
    dims, hp = meta["dims"], meta["hyperparameters"]
    return BRO(
        "MlpPolicy",
        Shapes(dims["obs_dim"], dims["act_dim"]),
        gamma=hp["discount"],
        tau=hp["tau"],
        model_size=(dims["critic_depth"], dims["critic_hidden"]),
        n_quantiles=dims["n_quantiles"] if hp["distributional"] else None,
        pessimism=hp["pessimism"],
        kl_target=hp["kl_target"],
        std_multiplier=hp["std_multiplier"],
        target_entropy=hp["target_entropy"],
        weight_decay=meta["optimizers"]["critic"]["weight_decay"],
        learning_rate=meta["optimizers"]["critic"]["lr"],
        adjustment_learning_rate=meta["optimizers"]["optimism"]["lr"],
        policy_kwargs={"actor_network_kwargs": {"width": dims["actor_hidden"], "n_blocks": dims["actor_depth"]}},
        exploration_kwargs={"network_kwargs": {"width": dims["actor_o_hidden"], "n_blocks": dims["actor_o_depth"]}},
        buffer_size=1,
        device="cpu",
    )


def replay(path: Path) -> tuple[BRO, dict[str, np.ndarray], dict[int, dict[str, float]]]:
    """Run the file's updates; return the model, the file, and what the updates reported."""
    data = dict(np.load(path))
    meta = json.loads(str(data["meta"]))
    model = build(meta)
    named = named_parameters(model)
    stored = {key.removeprefix("init/"): value for key, value in data.items() if key.startswith("init/")}
    assert named.keys() == stored.keys()
    with torch.no_grad():
        for name, value in stored.items():
            named[name].copy_(torch.as_tensor(value))

    info: dict[int, dict[str, float]] = {}
    for i in range(meta["dims"]["n_updates"]):
        observations, actions, rewards, masks, next_observations = (
            torch.as_tensor(data[f"batch/{i}/{key}"])
            for key in ("observations", "actions", "rewards", "masks", "next_observations")
        )
        batch = Batch(observations, actions, next_observations, 1 - masks[:, None], rewards[:, None], model.gamma)
        noise = Noise(*(torch.as_tensor(data[f"noise/{i}/{key}"]) for key in ("critic", "actor", "actor_o")))
        groups = {
            "critic": list(model.critic.parameters()),
            "actor": list(model.actor.parameters()),
            "actor_o": model.explorer.actor_optimizer.param_groups[0]["params"],
        }
        reported = {f"{name}_pnorm": norm(parameters) for name, parameters in groups.items()}
        a = actions.clone().requires_grad_()
        q = model.critic(observations, a)
        q1, q2 = q.mean(dim=(1, 2))
        reported["critic_agnorm"] = float(torch.autograd.grad(0.5 * (q1 + q2), a)[0].norm(dim=1).mean())
        reported.update(q1=q1.item(), q2=q2.item(), r=rewards.mean().item(), std=mean_std(model, observations))

        metrics = {name: value.item() for name, value in model._update(batch, noise).items()}
        for theirs, ours in {
            "critic_loss": "train/critic_loss",
            "actor_loss": "train/actor_loss",
            "entropy": "train/entropy",
            "temperature": "train/ent_coef",
            "temp_loss": "train/ent_coef_loss",
            "actor_o_loss": "exploration/actor_loss",
            "optimism": "exploration/optimism",
            "optimism_loss": "exploration/optimism_loss",
            "kl_weight": "exploration/kl_weight",
            "regularizer_loss": "exploration/kl_weight_loss",
            "Q_mean": "exploration/q_mean",
            "Q_std": "exploration/q_std",
        }.items():
            reported[theirs] = metrics[ours]
        reported["kl"] = metrics["exploration/kl"] * meta["dims"]["act_dim"]
        reported.update({f"{name}_gnorm": norm([p.grad for p in ps]) for name, ps in groups.items()})
        # The optimistic actor started from the new actor's standard deviation.
        reported["std_c"] = mean_std(model, observations)
        reported["std_o"] = reported["std_c"] * model.explorer.std_multiplier
        info[i] = reported

        if i < meta["dims"]["n_updates"] - 1 and f"after/{i}/temp/log_temp" in data:
            check_parameters(named, data, f"after/{i}/", i + 1, model)
    return model, data, info


def check_parameters(
    named: dict[str, torch.Tensor], data: dict[str, np.ndarray], prefix: str, n_updates: int, model: BRO
) -> None:
    learned_numbers = {"temp/log_temp", "optimism/log_value", "regularizer/log_value"}
    dot = square = 0.0
    for name, value in named.items():
        ours, theirs = value.detach().double().numpy(), data[prefix + name].astype(np.float64)
        limit = SCALAR_TOLERANCE if name in learned_numbers else parameter_tolerance(n_updates)
        error = np.abs(ours - theirs).max()
        assert error <= limit, f"{prefix}{name}: off by {error:.2e}, allowed {limit:.0e}"
        if name.split("/")[0] in {"actor", "actor_o", "critic"}:
            dot += ((ours - theirs) * theirs).sum()
            square += (theirs**2).sum()
    excess_decay = dot / square / (n_updates * model.learning_rate)
    assert abs(excess_decay) <= DECAY_TOLERANCE, f"{prefix}: weight decay is off by {-excess_decay:.2e}"


def test_files_are_there() -> None:
    assert FILES, f"no file of BRO's updates in {FOLDER}"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_golden_bro(path: Path) -> None:
    model, data, info = replay(path)
    n_updates = len(info)
    check_parameters(named_parameters(model), data, "final/", n_updates, model)
    compared = 0
    for key, value in data.items():
        if not key.startswith("info/"):
            continue
        _, i, name = key.split("/")
        theirs = float(value)
        ours = info[int(i)][name]
        assert abs(ours - theirs) <= INFO_TOLERANCE * max(1, abs(theirs)), f"{key}: {ours} instead of {theirs}"
        compared += 1
    assert compared, "the file reports nothing to compare with"


def test_torch_adamw_would_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check of the weight decay can tell torch's rounding from the published rule."""
    monkeypatch.setattr("sb3_sample.sac.policies.SACPolicy.make_optimizer", _torch_adamw)
    with pytest.raises(AssertionError, match="weight decay is off"):
        replay(OWN_FOLDER / "bro_quantile_public.npz")


def _torch_adamw(policy: Any, parameters: Any, lr_schedule: Any) -> torch.optim.Optimizer:
    return torch.optim.AdamW(parameters, lr=lr_schedule(1), weight_decay=policy.optimizer_kwargs["weight_decay"])
