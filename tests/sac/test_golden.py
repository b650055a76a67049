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

from sb3_sample import BRO, DAC
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.networks import MLP, BroNet
from sb3_sample.networks.ensemble import EnsembleLayerNorm, EnsembleLinear
from sb3_sample.sac import SAC
from tests.sac.common import COMPILES
from tests.sac.test_execution import captured

OWN_FOLDER = Path(__file__).parents[1] / "golden"
FOLDER = Path(os.environ.get("SB3_SAMPLE_GOLDEN") or OWN_FOLDER)
#: Those of BRO and DAC; others have tests of their own.
FILES = sorted(path for path in FOLDER.glob("*.npz") if path.stem.startswith(("bro_", "dac_")))

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


def trunk_layers(trunk: BroNet | MLP, path: str) -> dict[str, nn.Module]:
    """The trunk's layers by the names of the files."""
    if isinstance(trunk, BroNet):
        layers: dict[str, nn.Module] = {f"{path}/Dense_0": trunk.dense, f"{path}/LayerNorm_0": trunk.norm}
        for k, block in enumerate(trunk.blocks):
            layers[f"{path}/Dense_{2 * k + 1}"], layers[f"{path}/LayerNorm_{2 * k + 1}"] = block.dense1, block.norm1
            layers[f"{path}/Dense_{2 * k + 2}"], layers[f"{path}/LayerNorm_{2 * k + 2}"] = block.dense2, block.norm2
        return layers
    dense = [layer for layer in trunk.modules() if isinstance(layer, (nn.Linear, EnsembleLinear))]
    norms = [layer for layer in trunk.modules() if isinstance(layer, (nn.LayerNorm, EnsembleLayerNorm))]
    return {f"{path}/Dense_{k}": layer for k, layer in enumerate(dense)} | {
        f"{path}/LayerNorm_{k}": layer for k, layer in enumerate(norms)
    }


def named_parameters(model: SAC) -> dict[str, torch.Tensor]:
    """Views of every parameter of the model by its name and in its layout in the files."""
    is_bro = isinstance(model, BRO)
    network = "BroNet_0" if is_bro else "MLP_0"
    single = {"actor/Dense_0": model.actor.mean, "actor/Dense_1": model.actor.log_std}
    single.update(trunk_layers(model.actor.trunk, f"actor/{network}"))
    explorer: Any = model.explorer
    if is_bro:
        single.update(trunk_layers(explorer.trunk, f"actor_o/{network}"))
        single["actor_o/Dense_0"] = explorer.shift
    else:
        single.update(trunk_layers(explorer.actor.trunk, f"actor_o/{network}"))
        single["actor_o/Dense_0"], single["actor_o/Dense_1"] = explorer.actor.mean, explorer.actor.log_std
    named: dict[str, torch.Tensor] = {}
    for name, layer in single.items():
        is_norm = isinstance(layer, nn.LayerNorm)
        named[f"{name}/{'scale' if is_norm else 'kernel'}"] = layer.weight if is_norm else layer.weight.T
        if layer.bias is not None:
            named[f"{name}/bias"] = layer.bias
    path = "Critic_{}/BroNet_0" if is_bro else "CriticLN_{}/MLPLN_0"
    for module, critic in (("critic", model.critic), ("target_critic", model.critic_target)):
        layers = trunk_layers(critic.trunk, path)
        n_dense = sum("Dense" in name for name in layers)
        layers[f"{path}/Dense_{n_dense}"] = critic.head
        for name, layer in layers.items():
            for e in range(2):
                is_norm = "LayerNorm" in name
                weight = layer.weight[e, 0] if is_norm else layer.weight[e]
                named[f"{module}/{name.format(e)}/{'scale' if is_norm else 'kernel'}"] = weight
                named[f"{module}/{name.format(e)}/bias"] = layer.bias[e, 0]
    named["temp/log_temp"] = model.temperature.log_value
    if is_bro:
        named["optimism/log_value"] = explorer.optimism.raw_value
        named["regularizer/log_value"] = explorer.kl_weight.raw_value
    else:
        named["optimism/log_temp"] = explorer.optimism_distance.log_value
        named["regularizer/log_temp"] = explorer.kl_weight.log_value
    return named


def norm(tensors: list[torch.Tensor]) -> float:
    return float(torch.stack([t.detach().double().square().sum() for t in tensors]).sum().sqrt())


def mean_std(actor: Any, observations: torch.Tensor) -> float:
    with torch.no_grad():
        return float(actor.gaussian(actor.features(observations))[1].exp().mean())


def build(meta: dict[str, Any], compile: bool = False) -> SAC:
    dims, hp, optimizers = meta["dims"], meta["hyperparameters"], meta["optimizers"]
    shared: dict[str, Any] = dict(
        gamma=hp["discount"],
        tau=hp["tau"],
        kl_target=hp["kl_target"],
        std_multiplier=hp["std_multiplier"],
        target_entropy=hp["target_entropy"],
        learning_rate=optimizers["critic"]["lr"],
        adjustment_learning_rate=optimizers["optimism"]["lr"],
        buffer_size=1,
        device="cpu",
        compile=compile,
    )
    env = Shapes(dims["obs_dim"], dims["act_dim"])
    if "beta_lb" in hp:
        assert hp["beta_lb"] == hp["beta_critic"], "one pessimism for critics and actor"
        return DAC(
            "MlpPolicy",
            env,
            pessimism=hp["beta_lb"],
            policy_kwargs={
                "net_arch": {"pi": dims["actor_hidden"], "qf": dims["critic_hidden"]},
                "critic_network_kwargs": {"layer_norm": True},
            },
            **shared,
        )
    return BRO(
        "MlpPolicy",
        env,
        model_size=(dims["critic_depth"], dims["critic_hidden"]),
        n_quantiles=dims["n_quantiles"] if hp["distributional"] else None,
        pessimism=hp["pessimism"],
        weight_decay=optimizers["critic"]["weight_decay"],
        policy_kwargs={"actor_network_kwargs": {"width": dims["actor_hidden"], "n_blocks": dims["actor_depth"]}},
        exploration_kwargs={"network_kwargs": {"width": dims["actor_o_hidden"], "n_blocks": dims["actor_o_depth"]}},
        **shared,
    )


#: Names of the reported numbers in both kinds of file, and in ours.
SHARED_NAMES = {
    "critic_loss": "train/critic_loss",
    "actor_loss": "train/actor_loss",
    "entropy": "train/entropy",
    "temperature": "train/ent_coef",
    "temp_loss": "train/ent_coef_loss",
    "actor_o_loss": "exploration/actor_loss",
    "optimism_loss": "exploration/optimism_loss",
    "kl_weight": "exploration/kl_weight",
    "regularizer_loss": "exploration/kl_weight_loss",
    "Q_mean": "exploration/q_mean",
    "Q_std": "exploration/q_std",
}


#: How the gradient step is run.
EXECUTIONS = ("eager", "compiled", "captured")


def replay(path: Path, execution: str = "eager") -> tuple[SAC, dict[str, np.ndarray], dict[int, dict[str, float]]]:
    """Run the file's updates; return the model, the file, and what the updates reported."""
    data = dict(np.load(path))
    meta = json.loads(str(data["meta"]))
    model = build(meta, compile=execution == "compiled")
    recorder = captured(model, warm_up=0) if execution == "captured" else None
    is_bro = isinstance(model, BRO)
    explorer: Any = model.explorer
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
            "actor_o": explorer.actor_optimizer.param_groups[0]["params"],
        }
        reported = {f"{name}_pnorm": norm(parameters) for name, parameters in groups.items()}
        a = actions.clone().requires_grad_()
        q = model.critic(observations, a)
        q1, q2 = q.mean(dim=(1, 2))
        reported["critic_agnorm"] = float(torch.autograd.grad(0.5 * (q1 + q2), a)[0].norm(dim=1).mean())
        reported.update(q1=q1.item(), q2=q2.item(), r=rewards.mean().item(), std=mean_std(model.actor, observations))
        with torch.no_grad():
            reported["actor_action"] = model.actor.sample(observations, noise.actor)[0].abs().mean().item()
            if not is_bro:
                reported["std_e"] = mean_std(explorer.actor, observations)
                optimistic_mean = torch.tanh(explorer.actor.gaussian(explorer.actor.features(observations))[0])

        model.learner.prepared_execution()
        metrics = {name: value.item() for name, value in model._update(batch, noise).items()}
        reported.update({theirs: metrics[ours] for theirs, ours in SHARED_NAMES.items()})
        # A compiled step leaves no gradients.
        left = {} if execution == "compiled" else groups
        gradient_norms = {f"{name}_gnorm": norm([p.grad for p in ps]) for name, ps in left.items()}
        if is_bro:
            reported["optimism"] = metrics["exploration/optimism"]
            reported["kl"] = metrics["exploration/kl"] * meta["dims"]["act_dim"]
            # The optimistic actor started from the new actor's standard deviation.
            reported["std_c"] = mean_std(model.actor, observations)
            reported["std_o"] = reported["std_c"] * explorer.std_multiplier
        else:
            reported["beta_ub"] = metrics["exploration/optimism"]
            reported["kl"] = metrics["exploration/kl"]
            reported["KLoss"] = reported["kl"] * meta["dims"]["act_dim"]
            reported["Qloss"] = -(metrics["exploration/q_mean"] + reported["beta_ub"] * metrics["exploration/q_std"])
            if left:
                gradient_norms["actor_c_gnorm"] = gradient_norms.pop("actor_gnorm")
            # The optimistic actor was compared with the new actor.
            reported["std"] = mean_std(model.actor, observations)
            with torch.no_grad():
                mean = torch.tanh(model.actor.gaussian(model.actor.features(observations))[0])
            reported["actor_mu_diff"] = (mean - optimistic_mean).abs().mean().item()
        info[i] = {**reported, **gradient_norms}

        if i < meta["dims"]["n_updates"] - 1 and f"after/{i}/temp/log_temp" in data:
            check_parameters(named, data, f"after/{i}/", i + 1, model)
    if execution == "compiled":
        assert model.learner._execution is not None and model.learner._execution.seconds_compiling > 0
    if recorder is not None:
        assert recorder.n_repetitions == len(info)
    return model, data, info


def check_parameters(
    named: dict[str, torch.Tensor], data: dict[str, np.ndarray], prefix: str, n_updates: int, model: SAC
) -> None:
    learned_numbers = ("temp/", "optimism/", "regularizer/")
    dot = square = 0.0
    for name, value in named.items():
        ours, theirs = value.detach().double().numpy(), data[prefix + name].astype(np.float64)
        limit = SCALAR_TOLERANCE if name.startswith(learned_numbers) else parameter_tolerance(n_updates)
        error = np.abs(ours - theirs).max()
        assert error <= limit, f"{prefix}{name}: off by {error:.2e}, allowed {limit:.0e}"
        if name.split("/")[0] in {"actor", "actor_o", "critic"}:
            dot += ((ours - theirs) * theirs).sum()
            square += (theirs**2).sum()
    excess_decay = dot / square / (n_updates * model.learning_rate)
    assert abs(excess_decay) <= DECAY_TOLERANCE, f"{prefix}: weight decay is off by {-excess_decay:.2e}"


def test_files_are_there() -> None:
    kinds = {path.stem.split("_")[0] for path in OWN_FOLDER.glob("*.npz")}
    assert kinds >= {"bro", "dac"}
    assert any(FOLDER.glob("*.npz")), f"no file of updates in {FOLDER}"


#: Compiled here in the short tests too; the other files in the long ones.
COMPILED_IN_SHORT = {"bro_quantile_public", "dac_edge"}


@pytest.mark.parametrize(
    ("path", "execution"),
    [
        pytest.param(
            path,
            execution,
            id=f"{path.stem}-{execution}",
            marks=[]
            if execution != "compiled"
            else [COMPILES]
            if path.stem in COMPILED_IN_SHORT
            else [COMPILES, pytest.mark.slow],
        )
        for path in FILES
        for execution in EXECUTIONS
    ],
)
def test_golden(path: Path, execution: str) -> None:
    model, data, info = replay(path, execution)
    n_updates = len(info)
    check_parameters(named_parameters(model), data, "final/", n_updates, model)
    compared = 0
    for key, value in data.items():
        if not key.startswith("info/"):
            continue
        _, i, name = key.split("/")
        if execution == "compiled" and name.endswith("_gnorm"):
            continue
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


def _torch_adamw(policy: Any, parameters: Any, learning_rate: float) -> torch.optim.Optimizer:
    return torch.optim.AdamW(parameters, lr=learning_rate, weight_decay=policy.optimizer_kwargs["weight_decay"])


def test_layer_norm_epsilon_of_dac() -> None:
    """torch's default epsilon, 1e-5 instead of 1e-6, lies within the tolerance above, but not within this one."""
    _, data, info = replay(OWN_FOLDER / "dac_public.npz")
    for key, value in data.items():
        if key.startswith("info/"):
            _, i, name = key.split("/")
            assert abs(info[int(i)][name] - float(value)) <= 4e-6 * max(1, abs(float(value))), key
