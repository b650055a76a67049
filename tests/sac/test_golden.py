"""
Exact agreement with the authors' code: recorded updates replayed from the same parameters, batches and noise, and the
recorded sequences of their normalisers.

The files under ``tests/golden`` were made with the published code (layer sizes shrunk). Another folder of files of
the same format is tested instead if ``SB3_SAMPLE_GOLDEN`` names it. A file's method is the beginning of its name, in
``METHODS``; everything else (sizes, settings, number of updates) stands in the file.
"""

import copy
import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch import nn

from sb3_sample import BRC, BRO, DAC, SimbaV2
from sb3_sample.learner.batch import Batch, Encoded, Noise
from sb3_sample.learner.execution import why_not_compiled
from sb3_sample.learner.target import values
from sb3_sample.networks import MLP, BroNet, SimbaV2Net
from sb3_sample.networks.ensemble import EnsembleLayerNorm, EnsembleLinear
from sb3_sample.networks.simbav2 import HyperHead
from sb3_sample.sac import SAC
from tests.sac import golden_batch_norm
from tests.sac.common import COMPILES
from tests.sac.test_execution import captured

OWN_FOLDER = Path(__file__).parents[1] / "golden"
FOLDER = Path(os.environ.get("SB3_SAMPLE_GOLDEN") or OWN_FOLDER)

INFO_TOLERANCE = 3e-5
SCALAR_TOLERANCE = 2e-7
DECAY_TOLERANCE = 3e-5


def parameter_tolerance(n_updates: int) -> float:
    return 1e-6 if n_updates < 20 else 2e-6


class Shapes(gym.Env):
    """An environment that has only shapes; of one task, or one that tells which of several it is."""

    def __init__(self, obs_dim: int, act_dim: int, n_tasks: int | None = None):
        self.observation_space: spaces.Space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        if n_tasks is not None:
            self.observation_space = spaces.Dict(
                {"observation": self.observation_space, "task": spaces.Discrete(n_tasks)}
            )
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


def kernel(layer: Any) -> torch.Tensor:
    """A dense layer's kernel, (in, out), or (E, in, out)."""
    return layer.weight if isinstance(layer, EnsembleLinear) else layer.weight.T


def vector(parameter: torch.Tensor) -> torch.Tensor:
    """A bias, a scale or the like, (features,), or (E, features)."""
    return parameter if parameter.dim() == 1 else parameter[:, 0]


def named_parameters(model: SAC) -> dict[str, torch.Tensor]:
    """Views of every parameter of BRO or DAC by its name and in its layout in the files."""
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


#: Names of the reported numbers in BRO's and DAC's files, and in ours.
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


#: Where the models compute.
DEVICE = "cpu"


class Updates:
    """
    The updates of one file, and a model that replays them. A method is a subclass: how its model is built from the
    file, how the file names parameters, and what it reports.
    """

    #: Relative to max(1, |reference|).
    info_tolerance: ClassVar[float] = INFO_TOLERANCE
    aux_tolerance: ClassVar[float] = 5e-5
    #: Of learned numbers, absolute: after fewer than 10 updates, and after more.
    scalar_tolerances: ClassVar[tuple[float, float]] = (SCALAR_TOLERANCE, SCALAR_TOLERANCE)
    #: Groups of ``aux`` that are compared; ``grad``: gradients of the update.
    aux: ClassVar[tuple[str, ...]] = ()
    #: Whether a file may begin within a training, and be of float64.
    takes_moments: ClassVar[bool] = False
    #: Modules of one learned number.
    learned_numbers: ClassVar[tuple[str, ...]] = ("temp/", "optimism/", "regularizer/")

    def __init__(self, data: dict[str, np.ndarray], execution: str = "eager"):
        self.data, self.execution = data, execution
        self.meta = json.loads(str(data["meta"]))
        # Not compared is not equal: of these methods no file has moments or another precision.
        if not self.takes_moments:
            assert not any(key.startswith("adam/") for key in data), "moments of optimizers are not taken over"
            assert not str(self.meta.get("dtype")).startswith("float64"), "updates are replayed in float32 alone"
        self.dims, self.hyperparameters = self.meta["dims"], self.meta["hyperparameters"]
        self.model = self.build(compile=execution == "compiled")
        self.model._set_training_mode(True)
        self.named = self.parameters()
        #: What the updates reported, ``<update>/<name>``.
        self.info: dict[str, float] = {}

    # ---------------------------------------------------------------- of a method

    def build(self, compile: bool) -> Any:
        """The model that the file's updates are for."""
        raise NotImplementedError

    def parameters(self) -> dict[str, torch.Tensor]:
        """Views of every parameter by its name and in its layout in the files."""
        raise NotImplementedError

    def prepare(self, i: int) -> None:
        """Called before an update is looked at: what the learner is told of the environment."""

    def transitions(self, i: int) -> tuple[Batch, Noise]:
        """The batch of an update, and its noise."""
        raise NotImplementedError

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        """Numbers of the files, as ``info/<name>`` and ``aux/<name>``, that follow from the state before the update."""
        return {}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        """The same for what follows from the state after it, and from its metrics."""
        return {}

    def arranged(self, name: str, value: np.ndarray) -> np.ndarray:
        """A parameter of the file in the order that the model's network has its inputs in."""
        return value

    def check_more(self, prefix: str, n_updates: int) -> None:
        """Further checks of the parameters."""

    # ---------------------------------------------------------------- of all

    def tensor(self, key: str) -> torch.Tensor:
        return torch.as_tensor(self.data[key]).to(DEVICE)

    def load(self) -> None:
        stored = {key.removeprefix("init/"): value for key, value in self.data.items() if key.startswith("init/")}
        assert self.named.keys() == stored.keys()
        with torch.no_grad():
            for name, value in stored.items():
                assert self.named[name].shape == value.shape, name
                self.named[name].copy_(torch.as_tensor(self.arranged(name, value)).to(DEVICE))

    def run(self) -> int:
        """Replay the updates and compare; gives how many numbers were compared."""
        recorder = captured(self.model, warm_up=0) if self.execution == "captured" else None
        self.load()
        n_compared, n_updates = 0, self.dims["n_updates"]
        for i in range(n_updates):
            self.prepare(i)
            batch, noise = self.transitions(i)
            found = self.before(i, batch, noise)
            self.model.learner.prepared_execution()
            metrics = {name: value.item() for name, value in self.model._update(batch, noise).items()}
            found.update(self.after(i, batch, noise, metrics))
            self.info.update({f"{i}/{name.removeprefix('info/')}": found[name] for name in found if "info/" in name})
            n_compared += self.compare(i, found)
            prefix = f"after/{i}/" if i < n_updates - 1 else "final/"
            if any(key.startswith(prefix) for key in self.data):
                self.check_parameters(prefix, i + 1)
        execution = self.model.learner._execution
        assert self.execution != "compiled" or (execution is not None and execution.seconds_compiling > 0)
        assert recorder is None or recorder.n_repetitions == n_updates
        return n_compared

    def compare(self, i: int, found: dict[str, Any]) -> int:
        n_compared = 0
        for key, theirs in self.data.items():
            group, _, rest = key.partition("/")
            number, _, name = rest.partition("/")
            if number != str(i) or group not in ("info", "aux"):
                continue
            if group == "aux" and name.split("/")[0] not in self.aux:
                continue
            # A compiled step leaves no gradients.
            if self.execution == "compiled" and (name.startswith("grad/") or name.endswith("_gnorm")):
                continue
            if name.startswith("grad/"):
                ours = self.gradients()[name.removeprefix("grad/")]
                theirs = self.arranged(name.removeprefix("grad/"), theirs)
            else:
                ours = found[f"{group}/{name}"]
            self.check_numbers(key, ours, theirs, self.info_tolerance if group == "info" else self.aux_tolerance)
            n_compared += 1
        return n_compared

    @staticmethod
    def check_numbers(key: str, ours: Any, theirs: Any, tolerance: float) -> None:
        ours = ours.detach().cpu().numpy() if isinstance(ours, torch.Tensor) else np.asarray(ours)
        assert ours.shape == theirs.shape, f"{key}: shape {ours.shape} instead of {theirs.shape}"
        ours, theirs = ours.astype(np.float64), theirs.astype(np.float64)
        with np.errstate(invalid="ignore"):
            errors = np.abs(ours - theirs) / np.maximum(1, np.abs(theirs))
        # Infinities may be equal, too.
        worst = float(np.where(ours == theirs, 0, errors).max(initial=0))
        assert worst <= tolerance, f"{key}: off by {worst:.2e} of max(1, |reference|), allowed {tolerance:.0e}"

    def gradients(self) -> dict[str, torch.Tensor]:
        """Views of the gradients of the last update, like those of the parameters."""
        learned: dict[int, torch.Tensor] = {}
        modules = (self.model.policy, self.model.temperature, self.model.explorer)
        parameters = [p for module in modules for p in module.parameters() if p.grad is not None]
        try:
            for p in parameters:
                learned[id(p)], p.data = p.data, p.grad
            return {name: value.detach().clone() for name, value in self.parameters().items()}
        finally:
            for p in parameters:
                p.data = learned[id(p)]

    def check_parameters(self, prefix: str, n_updates: int) -> None:
        for name, value in self.named.items():
            theirs = self.arranged(name, self.data[prefix + name]).astype(np.float64)
            limit = parameter_tolerance(n_updates)
            if name.startswith(self.learned_numbers):
                limit = self.scalar_tolerances[n_updates >= 10]
            error = np.abs(value.detach().double().cpu().numpy() - theirs).max()
            assert error <= limit, f"{prefix}{name}: off by {error:.2e}, allowed {limit:.0e}"
        self.check_more(prefix, n_updates)

    def excess_decay(self, prefix: str, n_updates: int, among: Callable[[str], bool]) -> float:
        """Estimate of the error in the effective weight decay."""
        dot = square = 0.0
        for name, value in self.named.items():
            if among(name):
                theirs = self.arranged(name, self.data[prefix + name]).astype(np.float64)
                dot += ((value.detach().double().cpu().numpy() - theirs) * theirs).sum()
                square += (theirs**2).sum()
        return dot / square / (n_updates * self.model.learning_rate)


class BROUpdates(Updates):
    """BRO's: critics of quantiles or scalars, and the optimistic actor."""

    def settings(self, compile: bool) -> dict[str, Any]:
        hp, optimizers = self.hyperparameters, self.meta["optimizers"]
        return dict(
            gamma=hp["discount"],
            tau=hp["tau"],
            kl_target=hp["kl_target"],
            std_multiplier=hp["std_multiplier"],
            target_entropy=hp["target_entropy"],
            learning_rate=optimizers["critic"]["lr"],
            adjustment_learning_rate=optimizers["optimism"]["lr"],
            buffer_size=1,
            device=DEVICE,
            compile=compile,
        )

    def build(self, compile: bool) -> Any:
        dims, hp = self.dims, self.hyperparameters
        return BRO(
            "MlpPolicy",
            Shapes(dims["obs_dim"], dims["act_dim"]),
            model_size=(dims["critic_depth"], dims["critic_hidden"]),
            n_quantiles=dims["n_quantiles"] if hp["distributional"] else None,
            pessimism=hp["pessimism"],
            weight_decay=self.meta["optimizers"]["critic"]["weight_decay"],
            policy_kwargs={"actor_network_kwargs": {"width": dims["actor_hidden"], "n_blocks": dims["actor_depth"]}},
            exploration_kwargs={"network_kwargs": {"width": dims["actor_o_hidden"], "n_blocks": dims["actor_o_depth"]}},
            **self.settings(compile),
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        return named_parameters(self.model)

    def transitions(self, i: int) -> tuple[Batch, Noise]:
        observations, actions, rewards, masks, next_observations = (
            self.tensor(f"batch/{i}/{key}")
            for key in ("observations", "actions", "rewards", "masks", "next_observations")
        )
        noise = Noise(*(self.tensor(f"noise/{i}/{key}") for key in ("critic", "actor", "actor_o")))
        gamma = self.model.gamma
        return Batch(observations, actions, next_observations, 1 - masks[:, None], rewards[:, None], gamma), noise

    @property
    def groups(self) -> dict[str, list[torch.Tensor]]:
        explorer: Any = self.model.explorer
        return {
            "critic": list(self.model.critic.parameters()),
            "actor": list(self.model.actor.parameters()),
            "actor_o": explorer.actor_optimizer.param_groups[0]["params"],
        }

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        model = self.model
        reported = {f"{name}_pnorm": norm(parameters) for name, parameters in self.groups.items()}
        a = batch.actions.clone().requires_grad_()
        q1, q2 = model.critic(batch.observations, a).mean(dim=(1, 2))
        reported["critic_agnorm"] = float(torch.autograd.grad(0.5 * (q1 + q2), a)[0].norm(dim=1).mean())
        reported.update(q1=q1.item(), q2=q2.item(), r=batch.rewards.mean().item())
        reported["std"] = mean_std(model.actor, batch.observations)
        with torch.no_grad():
            reported["actor_action"] = model.actor.sample(batch.observations, noise.actor)[0].abs().mean().item()
        return {f"info/{name}": value for name, value in reported.items()}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        reported = {theirs: metrics[ours] for theirs, ours in SHARED_NAMES.items()}
        if self.execution != "compiled":
            reported |= {f"{name}_gnorm": norm([p.grad for p in ps]) for name, ps in self.groups.items()}  # type: ignore[misc]
        return {f"info/{name}": value for name, value in {**reported, **self.own(batch, metrics)}.items()}

    def own(self, batch: Batch, metrics: dict[str, float]) -> dict[str, float]:
        explorer: Any = self.model.explorer
        # The optimistic actor started from the new actor's standard deviation.
        std = mean_std(self.model.actor, batch.observations)
        return {
            "optimism": metrics["exploration/optimism"],
            "kl": metrics["exploration/kl"] * self.dims["act_dim"],
            "std_c": std,
            "std_o": std * explorer.std_multiplier,
        }

    def check_more(self, prefix: str, n_updates: int) -> None:
        check_decay(self, prefix, n_updates, ("actor", "actor_o", "critic"))


def check_decay(updates: Updates, prefix: str, n_updates: int, modules: tuple[str, ...]) -> None:
    excess = updates.excess_decay(prefix, n_updates, lambda name: name.split("/")[0] in modules)
    assert abs(excess) <= DECAY_TOLERANCE, f"{prefix}: weight decay is off by {-excess:.2e}"


class DACUpdates(BROUpdates):
    """DAC's: scalar critics, and an optimistic actor of its own."""

    def build(self, compile: bool) -> Any:
        dims, hp = self.dims, self.hyperparameters
        assert hp["beta_lb"] == hp["beta_critic"], "one pessimism for critics and actor"
        return DAC(
            "MlpPolicy",
            Shapes(dims["obs_dim"], dims["act_dim"]),
            pessimism=hp["beta_lb"],
            policy_kwargs={
                "net_arch": {"pi": dims["actor_hidden"], "qf": dims["critic_hidden"]},
                "critic_network_kwargs": {"layer_norm": True},
            },
            **self.settings(compile),
        )

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        explorer: Any = self.model.explorer
        with torch.no_grad():
            self._optimistic_mean = torch.tanh(explorer.actor.gaussian(explorer.actor.features(batch.observations))[0])
        std = mean_std(explorer.actor, batch.observations)
        return {**super().before(i, batch, noise), "info/std_e": std}

    def own(self, batch: Batch, metrics: dict[str, float]) -> dict[str, float]:
        actor = self.model.actor
        with torch.no_grad():
            mean = torch.tanh(actor.gaussian(actor.features(batch.observations))[0])
        q_mean, q_std, optimism = (metrics[f"exploration/{name}"] for name in ("q_mean", "q_std", "optimism"))
        reported = {
            "beta_ub": optimism,
            "kl": metrics["exploration/kl"],
            "KLoss": metrics["exploration/kl"] * self.dims["act_dim"],
            "Qloss": -(q_mean + optimism * q_std),
            # The optimistic actor was compared with the new actor.
            "std": mean_std(actor, batch.observations),
            "actor_mu_diff": (mean - self._optimistic_mean).abs().mean().item(),
        }
        if self.execution != "compiled":
            reported["actor_c_gnorm"] = norm([p.grad for p in self.groups["actor"]])  # type: ignore[misc]
        return reported


def policy_numbers(actor: Any, observations: torch.Tensor, noise: torch.Tensor) -> dict[str, torch.Tensor]:
    """An actor's Gaussian and sample, by the names of ``aux``."""
    with torch.no_grad():
        mean, log_std = actor.gaussian(actor.features(observations))
        action, log_prob = actor.sample(observations, noise)
    return {"mean": mean, "std": log_std.exp(), "action": action, "log_prob": log_prob[:, 0]}


def feed(model: Any, observations: np.ndarray | None, rewards: np.ndarray, terminated: Any, truncated: Any) -> None:
    """Tell a model's learner of one step of all environments, and of the observations that are acted on next."""
    infos = [{"TimeLimit.truncated": bool(t), "task": k} for k, t in enumerate(truncated)]
    model.learner.on_step(rewards, terminated | truncated, infos)
    if observations is not None:
        model.learner.on_observations(observations)


class SimbaV2Updates(Updates):
    """SimbaV2's: what the replay hands out goes through the normalisers, which are fed with the steps of the stream."""

    info_tolerance = 1e-5
    scalar_tolerances = (2.5e-7, 5e-7)
    aux = ("actor", "critic", "grad")

    def build(self, compile: bool) -> Any:
        dims, hp = self.dims, self.hyperparameters
        return simbav2(
            dims["obs_dim"],
            dims["act_dim"],
            gamma=hp["discount"],
            tau=hp["tau"],
            n_critics=dims["critics"],
            target_entropy=hp["target_entropy"],
            learning_rate=hp["lr_init"],
            final_learning_rate=hp["lr_end"],
            schedule_steps=hp["lr_decay_updates"],
            value_head_kwargs={"n_atoms": dims["atoms"], "v_min": hp["v_min"], "v_max": hp["v_max"]},
            reward_scale_kwargs={"max_return": hp["normalized_g_max"]},
            policy_kwargs={
                f"{who}_network_kwargs": {
                    "width": dims[f"{who}_hidden"],
                    "n_blocks": dims[f"{who}_blocks"],
                    "expansion": dims["expansion"],
                    "shift": hp[f"{who}_shift"],
                }
                for who in ("actor", "critic")
            },
            compile=compile,
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        model, several = self.model, self.dims["critics"] > 1
        named = self._trunk("actor", model.actor.trunk)
        named.update(self._head("actor/predictor/mean_", model.actor.mean, "bias"))
        named.update(self._head("actor/predictor/std_", model.actor.log_std, "bias"))
        for module, critic in (("critic", model.critic), ("target_critic", model.critic_target)):
            path = f"{module}/VmapSimbaV2Critic_0" if several else module
            of_critics = self._trunk(path, critic.trunk)
            of_critics.update(self._head(f"{path}/predictor/", critic.head, "value_bias"))
            named.update({name: value if several else value[0] for name, value in of_critics.items()})
        return {**named, "temp/log_temp": model.temperature.log_value}

    @staticmethod
    def _trunk(path: str, trunk: SimbaV2Net) -> dict[str, torch.Tensor]:
        named = {
            f"{path}/embedder/w/hyper_dense/kernel": kernel(trunk.dense),
            f"{path}/embedder/scaler/scaler": vector(trunk.scaler.scaler),
        }
        for k, block in enumerate(trunk.blocks):
            here = f"{path}/encoder/layers_{k}"
            named[f"{here}/alpha_scaler/scaler"] = vector(block.alpha.scaler)
            named[f"{here}/mlp/scaler/scaler"] = vector(block.scaler.scaler)
            named[f"{here}/mlp/w1/hyper_dense/kernel"] = kernel(block.dense1)
            named[f"{here}/mlp/w2/hyper_dense/kernel"] = kernel(block.dense2)
        return named

    @staticmethod
    def _head(path: str, head: HyperHead, bias: str) -> dict[str, torch.Tensor]:
        return {
            f"{path}w1/hyper_dense/kernel": kernel(head.dense1),
            f"{path}scaler/scaler": vector(head.scaler.scaler),
            f"{path}w2/hyper_dense/kernel": kernel(head.dense2),
            f"{path}{bias}": vector(head.dense2.bias),
        }

    def load(self) -> None:
        super().load()
        self._n_fed = 0
        if "support" in self.data:
            self.check_numbers("support", self.model.head.support, self.data["support"], 1e-6)

    def prepare(self, i: int) -> None:
        while self._n_fed < self.data[f"statistics/{i}/steps_fed"]:
            step = [self.data[f"stream/{key}"][self._n_fed] for key in ("reward", "terminated", "truncated")]
            feed(self.model, self.data["stream/next_observation"][self._n_fed], *step)
            self._n_fed += 1
        for key, value in normalizer_state(self.model).items():
            theirs = self.data[f"statistics/{i}/{key}"].reshape(np.shape(value))
            self.check_numbers(f"statistics/{i}/{key}", value, theirs, 1e-9)

    def transitions(self, i: int) -> tuple[Batch, Noise]:
        raw = {
            key: self.tensor(f"raw/{i}/{key}")
            for key in ("observation", "action", "reward", "terminated", "next_observation")
        }
        batch = Batch(
            raw["observation"],
            raw["action"],
            raw["next_observation"],
            raw["terminated"][:, None],
            raw["reward"][:, None],
            self.model.gamma,
        )
        normalized = {
            "observation": self.model.policy.observation_norm(batch.observations),
            "next_observation": self.model.policy.observation_norm(batch.next_observations),
            "reward": self.model.reward_scaler.transform(batch, None).rewards[:, 0],
        }
        for key, value in normalized.items():
            self.check_numbers(f"batch/{i}/{key}", value, self.data[f"batch/{i}/{key}"], 1e-6)
        return batch, Noise(critic=self.tensor(f"noise/{i}/critic"), actor=self.tensor(f"noise/{i}/actor"))

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        model = self.model
        rewards = model.reward_scaler.transform(batch, None).rewards
        sampled = policy_numbers(model.actor, batch.observations, noise.actor)  # type: ignore[arg-type]
        with torch.no_grad():
            q = values(model.learner, model.critic, batch.observations, sampled["action"])
            predicted = values(model.learner, model.critic, batch.observations, batch.actions)
        # The critics' step has the new actor and temperature, and these targets.
        self._targets = copy.deepcopy(model.critic_target)
        found = {
            "info/critic/batch_rew_min": rewards.min(),
            "info/critic/batch_rew_mean": rewards.mean(),
            "info/critic/batch_rew_max": rewards.max(),
            "info/actor/mean_action": sampled["action"].mean(),
            "aux/actor/q": self._by_critic(q),
            "aux/critic/q": self._by_critic(predicted),
        }
        return found | {f"aux/actor/{name}": value for name, value in sampled.items()}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        model = self.model
        sampled = policy_numbers(model.actor, batch.next_observations, noise.critic)  # type: ignore[arg-type]
        with torch.no_grad():
            logits = self._targets.q_values(batch.next_observations, sampled["action"])
            next_q = model.head.values(logits)
            scaled = model.reward_scaler.transform(batch, None)
            bonus = -model.temperature() * sampled["log_prob"][:, None]
            target = model.head.target(scaled, logits, model.pessimism_rule.value, bonus)
        found = {
            "info/actor/loss": metrics["train/actor_loss"],
            "info/actor/entropy": metrics["train/entropy"],
            "info/critic/loss": metrics["train/critic_loss"],
            "info/temperature/value": metrics["train/ent_coef"],
            "info/temperature/loss": metrics["train/ent_coef_loss"],
            "aux/critic/next_q": self._by_critic(next_q),
            "aux/critic/next_log_prob": self._by_critic(logits.log_softmax(-1), 3),
            "aux/critic/next_chosen": next_q.argmin(dim=0)[:, 0],
            "aux/critic/target_probs": target,
        }
        return found | {f"aux/critic/{name}": value for name, value in sampled.items()}

    def _by_critic(self, of_critics: torch.Tensor, n_axes: int = 2) -> torch.Tensor:
        """In the files' layout, without the axis of one critic."""
        of_critics = of_critics if n_axes == 3 else of_critics[:, :, 0]
        return of_critics if self.dims["critics"] > 1 else of_critics[0]


def simbav2(obs_dim: int, act_dim: int, **kwargs: Any) -> SimbaV2:
    return SimbaV2("MlpPolicy", Shapes(obs_dim, act_dim), buffer_size=1, device=DEVICE, **kwargs)


def normalizer_state(model: Any) -> dict[str, Any]:
    """The state of SimbaV2's normalisers by the names of the files."""
    norm, scaler = model.policy.observation_norm, model.reward_scaler
    return {
        "obs_mean": norm.mean,
        "obs_var": norm.var,
        "obs_count": norm.count,
        "return_G": scaler._returns or [0.0] * model.n_envs,
        "return_mean": scaler.moments.mean,
        "return_var": scaler.moments.var,
        "return_count": scaler.moments.count,
        "return_max": scaler.largest,
        "reward_divisor": scaler.divisor(None),
    }


def simbav2_sequence(data: dict[str, np.ndarray], name: str, meta: dict[str, Any]) -> None:
    """SimbaV2's normalisers over one sequence of steps, the state after every one, and what they make of queries."""
    get = lambda key: data[f"{name}/{key}"]  # noqa: E731
    model: Any = simbav2(get("next_observation").shape[-1], 1, gamma=meta["discount"])
    model.n_envs, norm = get("reward").shape[1], model.policy.observation_norm
    loose = meta["dtype"] == "float32"
    dtype = torch.float32 if loose else torch.float64
    # With float32 observations the authors' statistics are float32 too, ours are not: here, so that they compare.
    norm.mean, norm.var = norm.mean.to(dtype), norm.var.to(dtype)
    queries = {step: k for k, step in enumerate(meta["query_at"])}
    for t in range(len(get("reward")) + 1):
        if t > 0 and get("training")[t - 1]:
            feed(model, get("next_observation")[t - 1], *(get(k)[t - 1] for k in ("reward", "terminated", "truncated")))
        for key, value in normalizer_state(model).items():
            theirs = get(f"state/{key}")[t].reshape(np.shape(value))
            # The first entry is float32 arithmetic of the start values.
            tolerance = 1e-7 if t == 0 else 1e-6 if loose and key.startswith("obs_") else 1e-9
            Updates.check_numbers(f"{name}/state/{key}[{t}]", value, theirs, tolerance)
        tolerance = 1e-6 if loose else 1e-7
        if t > 0:
            seen = norm(torch.as_tensor(get("next_observation")[t - 1]))
            Updates.check_numbers(f"{name}/seen[{t}]", seen, get("state/seen_observation")[t], tolerance)
        if t in queries:
            o, r = (torch.as_tensor(get(f"query_{what}")).to(dtype) for what in ("observation", "reward"))
            batch = Batch(o, o[:, :1], o, r[:, None], r[:, None].double())
            scaled = model.reward_scaler.transform(batch, None).rewards[:, 0]
            theirs = get("state/query_observation_out")[queries[t]]
            Updates.check_numbers(f"{name}/query_observation[{t}]", norm(o), theirs, tolerance)
            Updates.check_numbers(f"{name}/query_reward[{t}]", scaled, get("state/query_reward_out")[queries[t]], 1e-7)


class BRCUpdates(Updates):
    """BRC's, for one task and for several, whose numbers are in the observations; rewards go through the normaliser."""

    info_tolerance = 1e-5
    scalar_tolerances = (2e-7, 5e-7)
    aux = ("actor", "critic", "embedding", "embedding_after", "grad")

    @property
    def is_multi_task(self) -> bool:
        return bool(self.dims["embedding"])

    def build(self, compile: bool) -> Any:
        dims, hp, optimizers = self.dims, self.hyperparameters, self.meta["optimizers"]
        sizes = {who: {"width": dims[f"{who}_hidden"], "n_blocks": dims[f"{who}_depth"]} for who in ("actor", "critic")}
        BRC_of = type("BRC", (BRC,), {"temperature_beta1": optimizers["temp"]["b1"]})
        return BRC_of(
            "MultiInputPolicy" if self.is_multi_task else "MlpPolicy",
            Shapes(dims["obs_dim"], dims["act_dim"], dims["tasks"] if self.is_multi_task else None),
            gamma=hp["discount"],
            tau=hp["tau"],
            target_entropy=hp["target_entropy"],
            learning_rate=optimizers["critic"]["lr"],
            weight_decay=optimizers["critic"]["weight_decay"],
            value_head_kwargs={"n_atoms": dims["atoms"], "v_min": -hp["v_max"], "v_max": hp["v_max"]},
            embedding_size=dims["embedding"] or 32,
            critic_width=None,
            policy_kwargs={
                "critic_network_kwargs": sizes["critic"],
                "actor_network_kwargs": sizes["actor"],
                "n_critics": dims["critics"],
            },
            buffer_size=1,
            device=DEVICE,
            compile=compile,
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        model = self.model
        layers = self._bronet("actor/BroNet_0", model.actor.trunk)
        layers.update({"actor/Dense_0": model.actor.mean, "actor/Dense_1": model.actor.log_std})
        tables = {}
        for module, critic in (("critic", model.critic), ("target_critic", model.critic_target)):
            path = f"{module}/q_value_ensemble/q_value_ensemble/critic"
            layers.update({**self._bronet(path, critic.trunk), f"{path}/Dense_1": critic.head})
            if self.is_multi_task:
                tables[f"{module}/task_embedding/embeddings/embedding"] = critic.features_extractor.table
        named = {**tables, "temp/log_temp": model.temperature.log_value}
        for name, layer in layers.items():
            is_norm = "LayerNorm" in name
            named[f"{name}/{'scale' if is_norm else 'kernel'}"] = vector(layer.weight) if is_norm else kernel(layer)
            named[f"{name}/bias"] = vector(layer.bias)
        return named

    @staticmethod
    def _bronet(path: str, trunk: BroNet) -> dict[str, Any]:
        layers = {f"{path}/Dense_0": trunk.dense, f"{path}/LayerNorm_0": trunk.norm}
        for k, block in enumerate(trunk.blocks):
            here = f"{path}/BronetBlock_{k}"
            layers.update({f"{here}/Dense_0": block.dense1, f"{here}/LayerNorm_0": block.norm1})
            layers.update({f"{here}/Dense_1": block.dense2, f"{here}/LayerNorm_1": block.norm2})
        return layers

    def arranged(self, name: str, value: np.ndarray) -> np.ndarray:
        # The critics' inputs: observation, action, embedding there; observation, embedding, action here.
        if not self.is_multi_task or not name.endswith("q_value_ensemble/critic/Dense_0/kernel"):
            return value
        n, a = self.dims["obs_dim"], self.dims["act_dim"]
        return np.concatenate((value[:, :n], value[:, n + a :], value[:, n : n + a]), axis=1)

    def load(self) -> None:
        super().load()
        self._n_fed = 0

    def prepare(self, i: int) -> None:
        while self._n_fed < self.data[f"statistics/{i}/steps_fed"]:
            feed(
                self.model,
                None,
                *(self.data[f"stream/{k}"][self._n_fed] for k in ("reward", "terminated", "truncated")),
            )
            self._n_fed += 1
        if i % self.dims.get("updates_per_step", 1) == 0:
            self.model.learner.before_updates()
        for key, value in brc_state(self.model).items():
            self.check_numbers(f"statistics/{i}/{key}", value, self.data[f"statistics/{i}/{key}"], 1e-6)

    def transitions(self, i: int) -> tuple[Batch, Noise]:
        def seen(key: str) -> Any:
            observations = self.tensor(f"batch/{i}/{key}")
            if not self.is_multi_task:
                return observations
            return {"observation": observations, "task": self.tensor(f"batch/{i}/task_ids")[:, None]}

        rewards, masks = self.tensor(f"raw/{i}/rewards")[:, None], self.tensor(f"batch/{i}/masks")[:, None]
        actions = self.tensor(f"batch/{i}/actions")
        batch = Batch(seen("observations"), actions, seen("next_observations"), 1 - masks, rewards, self.model.gamma)
        scaled = self.model.reward_scaler.transform(batch, None).rewards[:, 0].numpy()
        theirs = self.data[f"batch/{i}/rewards"]
        assert np.abs(scaled - theirs).max() <= 1e-6 * np.abs(theirs).max() and (scaled[theirs == 0] == 0).all()
        return batch, Noise(critic=self.tensor(f"noise/{i}/critic"), actor=self.tensor(f"noise/{i}/actor"))

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        model = self.model
        self._actor = copy.deepcopy(model.actor)
        sampled = policy_numbers(model.actor, batch.next_observations, noise.critic)  # type: ignore[arg-type]
        scaled = model.reward_scaler.transform(batch, None)
        with torch.no_grad():
            logits = model.critic.q_values(batch.observations, batch.actions)
            next_logits = model.critic_target.q_values(batch.next_observations, sampled["action"])
            bonus = -model.temperature() * sampled["log_prob"][:, None]
            target = model.head.target(scaled, next_logits, model.pessimism_rule.value, bonus)
        q = model.head.mean_target(target)
        found = {
            "info/r": scaled.rewards.mean(),
            "info/q_mean": q.mean(),
            "info/q_min": q.min(),
            "info/q_max": q.max(),
            "info/critic_pnorm": norm(list(model.critic.parameters())),
            "info/actor_pnorm": norm(list(model.actor.parameters())),
            "aux/critic/logits": logits,
            "aux/critic/next_logits": next_logits,
            "aux/critic/target_probs": target,
            **self._embedding("aux/embedding", batch),
        }
        return found | {f"aux/critic/{name}": value for name, value in sampled.items()}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        model = self.model
        found = {f"info/{theirs}": metrics[SHARED_NAMES[theirs]] for theirs in self.reported}
        if self.execution != "compiled":
            for who, module in (("critic", model.critic), ("actor", model.actor)):
                found[f"info/{who}_gnorm"] = norm([p.grad for p in module.parameters()])
        # The actor's loss was that of the old actor on the new critics and their embeddings.
        with torch.no_grad():
            features = model.actor.features(batch.observations)
            sampled = policy_numbers(self._actor, Encoded(features), noise.actor)  # type: ignore[arg-type]
            logits = model.critic.q_values(batch.observations, sampled["action"])
        found.update({"aux/actor/logits": logits, **self._embedding("aux/embedding_after", batch)})
        return found | {f"aux/actor/{name}": value for name, value in sampled.items()}

    reported: ClassVar[tuple[str, ...]] = ("critic_loss", "actor_loss", "entropy", "temperature", "temp_loss")

    def _embedding(self, name: str, batch: Batch) -> dict[str, torch.Tensor]:
        if not self.is_multi_task:
            return {}
        with torch.no_grad():
            return {name: self.model.actor.features(batch.observations)[:, self.dims["obs_dim"] :]}

    def check_more(self, prefix: str, n_updates: int) -> None:
        def is_of(name: str) -> bool:
            return name.startswith(("actor/", "critic/"))

        groups: dict[str, tuple[Callable[[str], bool], float]] = {
            "all": (is_of, DECAY_TOLERANCE),
            "scales and biases": (lambda name: is_of(name) and not name.endswith("kernel"), DECAY_TOLERANCE),
        }
        if self.is_multi_task:
            groups["embeddings"] = (lambda name: name.startswith("critic/task_embedding"), 5e-5)
        for group, (among, limit) in groups.items():
            excess = self.excess_decay(prefix, n_updates, among)
            assert abs(excess) <= limit, f"{prefix}: weight decay of {group} is off by {-excess:.2e}"


def brc_state(model: Any) -> dict[str, Any]:
    """The state of BRC's normaliser by the names of the files."""
    scaler = model.reward_scaler
    return {"returns_min": scaler.smallest, "returns_max": scaler.largest, "reward_divisor": scaler.divisors}


def brc_sequence(data: dict[str, np.ndarray], name: str, meta: dict[str, Any]) -> None:
    """BRC's normaliser over one sequence of steps, and what it makes of rewards."""
    n_tasks = meta["tasks"]
    model = BRC(
        "MultiInputPolicy" if n_tasks > 1 else "MlpPolicy",
        Shapes(1, meta["act_dim"], n_tasks if n_tasks > 1 else None),
        gamma=meta["discount"],
        target_entropy=meta["target_entropy"],
        value_head_kwargs={"v_min": -meta["v_max"], "v_max": meta["v_max"]},
        critic_width=4,
        buffer_size=1,
        device=DEVICE,
    )
    get = lambda key: data[f"{name}/{key}"]  # noqa: E731
    rewards, tasks = torch.as_tensor(get("query_reward"))[:, None], torch.as_tensor(get("query_task"))[:, None]
    for t in range(len(get("reward")) + 1):
        if t > 0:
            feed(model, None, *(get(k)[t - 1] for k in ("reward", "terminated", "truncated")))
        with torch.no_grad():
            model.temperature.log_value.fill_(float(np.log(np.float64(get("temperature")[t]))))
        model.learner.before_updates()
        batch = Batch(rewards, rewards, rewards, rewards, rewards, columns={"task": tasks})
        scaled = model.reward_scaler.transform(batch, None).rewards[:, 0]
        for key, value in {**brc_state(model), "query_reward_out": scaled}.items():
            ours, theirs = np.asarray(value), get(f"state/{key}")[t]
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=0, err_msg=f"{name}/state/{key}[{t}]")


class XQCUpdates(golden_batch_norm.XQCUpdates, Updates):
    """XQC's."""


class WeightNormUpdates(golden_batch_norm.WeightNormUpdates, Updates):
    """CrossQ+WN's."""


class FlashSACUpdates(golden_batch_norm.FlashSACUpdates, Updates):
    """FlashSAC's."""


#: By the beginning of a file's name, of which the longest counts: the updates of a method, and its sequences.
METHODS: dict[str, type[Updates]] = {
    "brc_": BRCUpdates,
    "bro_": BROUpdates,
    "dac_": DACUpdates,
    "flashsac_": FlashSACUpdates,
    "simbav2_": SimbaV2Updates,
    "xqc_": XQCUpdates,
    "xqc_crossq_wn_": WeightNormUpdates,
}
SEQUENCES: dict[str, Callable[[dict[str, np.ndarray], str, dict[str, Any]], None]] = {
    "brc_": brc_sequence,
    "simbav2_": simbav2_sequence,
}


def method_of(path: Path, table: dict[str, Any]) -> Any:
    """The entry of a file; None for a method that there is not."""
    fits = [name for name in METHODS.keys() | SEQUENCES.keys() if path.stem.startswith(name)]
    return table.get(max(fits, key=len)) if fits else None


def load_file(path: Path) -> dict[str, np.ndarray]:
    return dict(np.load(path))


def sequences_of(path: Path) -> Iterator[str]:
    """Names of the sequences in a file of a normaliser; none in one of updates."""
    with np.load(path) as file:
        yield from json.loads(str(file["meta"])).get("sequences", {})


#: Files of normalisers have sequences in place of updates.
ALL_FILES = sorted(path for path in FOLDER.glob("*.npz") if method_of(path, METHODS | SEQUENCES))
FILES = [path for path in ALL_FILES if not list(sequences_of(path))]
OF_SEQUENCES = [(path, name) for path in ALL_FILES for name in sequences_of(path)]

#: How the gradient step is run.
EXECUTIONS = ("eager", "compiled", "captured")


def replay(path: Path, execution: str = "eager") -> Updates:
    """Run the file's updates and compare them."""
    updates = method_of(path, METHODS)(load_file(path), execution)
    if execution == "compiled" and (reason := why_not_compiled(updates.model.learner)):
        assert "float64" in reason
        pytest.skip(reason)
    assert updates.run() > 0, "the file reports nothing to compare with"
    return updates  # type: ignore[no-any-return]


def check_parameters(
    named: dict[str, torch.Tensor], data: dict[str, np.ndarray], prefix: str, n_updates: int, model: Any
) -> None:
    """Compare parameters of BRO by their names in the files, and their weight decay."""
    updates = object.__new__(BROUpdates)
    updates.named, updates.data, updates.model = named, data, model
    updates.check_parameters(prefix, n_updates)


def test_files_are_there() -> None:
    # A folder of SB3_SAMPLE_GOLDEN may lack any method's.
    assert ALL_FILES or any(FOLDER.glob("dr_q_*.npz")), f"no file of a method's in {FOLDER}"
    here = {path.stem for path in OWN_FOLDER.glob("*.npz")}
    assert {name for name in METHODS if any(stem.startswith(name) for stem in here)} == METHODS.keys()
    others = [path for path in OWN_FOLDER.glob("*.npz") if not method_of(path, METHODS | SEQUENCES)]
    assert all(path.stem.startswith("dr_q_") for path in others)  # test_golden_dr_q.py has them


@pytest.mark.parametrize(
    ("path", "execution"),
    [
        pytest.param(
            path,
            execution,
            id=f"{path.stem}-{execution}",
            marks=[COMPILES, pytest.mark.slow] if execution == "compiled" else [],
        )
        for path in FILES
        for execution in EXECUTIONS
        # Compiled, a file of the initial values as they are is the public one's step.
        if (execution, path.stem.partition("_rawinit")[1]) != ("compiled", "_rawinit")
    ],
)
def test_golden(path: Path, execution: str) -> None:
    replay(path, execution)


@pytest.mark.parametrize(
    ("path", "name"), [pytest.param(*each, id=f"{each[0].stem}-{each[1]}") for each in OF_SEQUENCES]
)
def test_golden_sequences(path: Path, name: str) -> None:
    data = load_file(path)
    method_of(path, SEQUENCES)(data, name, json.loads(str(data["meta"]))["sequences"][name])


def test_torch_adamw_would_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The check of the weight decay can tell torch's rounding from the published rule."""
    monkeypatch.setattr("sb3_sample.sac.policies.SACPolicy.make_optimizer", _torch_adamw)
    with pytest.raises(AssertionError, match="weight decay is off"):
        replay(OWN_FOLDER / "bro_quantile_public.npz")


def _torch_adamw(policy: Any, parameters: Any, learning_rate: float) -> torch.optim.Optimizer:
    return torch.optim.AdamW(parameters, lr=learning_rate, weight_decay=policy.optimizer_kwargs["weight_decay"])


def test_layer_norm_epsilon_of_dac(monkeypatch: pytest.MonkeyPatch) -> None:
    """torch's default epsilon, 1e-5 instead of 1e-6, lies within the tolerance above, but not within this one."""
    monkeypatch.setattr(DACUpdates, "info_tolerance", 4e-6)
    replay(OWN_FOLDER / "dac_public.npz")
