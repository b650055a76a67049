"""
Recorded updates of XQC, CrossQ+WN and FlashSAC, for the tests of ``test_golden.py``: what is compared, and how closely.

The classes here are mixed into ``Updates`` there. Weights are in the files as ``torch.nn.Linear`` has them, everything
of the critics with a leading axis of the critics.
"""

import copy
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn

from sb3_sample import XQC, CrossQ, FlashSAC
from sb3_sample.learner import losses
from sb3_sample.learner.batch import Batch, Noise
from sb3_sample.learner.target import values
from sb3_sample.networks import BatchNorm, EnsembleLinear, FlashNet


class Limits(NamedTuple):
    """Largest errors: of gradients relative to an array's largest element, of ``info`` to max(1, |reference|)."""

    info: float
    parameters: float
    statistics: float
    gradients: float
    actions: float
    #: Of the shift of the input's norm; None: it moves by rounding alone, see ``BatchNormUpdates.check_parameters``.
    input_shift: float | None
    log_alpha: float = 5e-7


#: By the kind of a file.
XQC_LIMITS = {
    "start": Limits(5e-4, 3e-5, 3e-4, 5e-3, 1e-2, None),
    "midtraining": Limits(5e-6, 1e-6, 3e-6, 2e-4, 2e-5, 1e-6),
    "float64": Limits(1e-7, 2e-9, 1e-9, 5e-8, 5e-8, 1e-9, 1e-9),
    "rawinit": Limits(1e-4, 1e-5, 3e-4, 5e-3, 1e-3, None),
}
WEIGHT_NORM_LIMITS = {
    **dict.fromkeys(XQC_LIMITS, Limits(1e-5, 1e-6, 3e-6, 1e-4, 2e-5, 1e-6)),
    "float64": XQC_LIMITS["float64"],
}
FLASH_LIMITS = {
    "start": Limits(1e-5, 3e-5, 3e-6, 1e-3, 2e-5, 3e-5),
    "midtraining": Limits(1e-5, 2e-6, 3e-6, 1e-3, 2e-5, 2e-6),
    "float64": XQC_LIMITS["float64"],
    "rawinit": Limits(5e-5, 5e-6, 3e-6, 1e-3, 2e-5, 5e-6),
}


def vector(parameter: torch.Tensor) -> torch.Tensor:
    """A bias, a scale or the like, (features,), or (E, features)."""
    return parameter if parameter.dim() == 1 else parameter[:, 0]


def views(layers: Mapping[str, Any]) -> dict[str, torch.Tensor]:
    """Views of the tensors of layers by the names of the files."""
    named: dict[str, torch.Tensor] = {}
    for name, layer in layers.items():
        if isinstance(layer, (nn.Linear, EnsembleLinear)):
            named[f"{name}/weight"] = layer.weight.mT if isinstance(layer, EnsembleLinear) else layer.weight
            if layer.bias is not None:
                named[f"{name}/bias"] = vector(layer.bias)
            continue
        named[f"{name}/scale"] = vector(layer.weight)
        if isinstance(layer, BatchNorm):
            named[f"{name}/shift"] = vector(layer.bias)
            named[f"{name}/running_mean"], named[f"{name}/running_var"] = map(
                vector, (layer.running_mean, layer.running_var)
            )
    return named


def layers_of(trunk: Any) -> dict[str, Any]:
    """A trunk's layers by the names of the files."""
    if not isinstance(trunk, FlashNet):
        layers = {"input_norm": trunk.input_norm}
        layers |= {f"hidden_{k}": layer for k, layer in enumerate(trunk.dense)}
        return layers | {f"norm_{k}": layer for k, layer in enumerate(trunk.norms)}
    layers = {"input_norm": trunk.input_norm, "input": trunk.dense, "final_norm": trunk.norm}
    for k, block in enumerate(trunk.blocks):
        layers |= {f"block_{k}/expand": block.dense1, f"block_{k}/expand_norm": block.norm1}
        layers |= {f"block_{k}/contract": block.dense2, f"block_{k}/contract_norm": block.norm2}
    return layers


def to_double(model: Any) -> None:
    """Have a model compute in float64, whose observations Stable-Baselines3 would round on their way."""
    model.policy.double()
    model.temperature.double()
    head = model.head
    if head.n_outputs > 1:
        head.support = torch.linspace(head.v_min, head.v_max, head.n_outputs, dtype=torch.float64)
    for network in (model.actor, model.critic, model.critic_target):
        for each in (network, network.at_rest):
            vars(each)["extract_features"] = _as_they_are


def _as_they_are(observations: torch.Tensor, extractor: Any = None) -> torch.Tensor:
    return observations


class BatchNormUpdates:
    """Common to the three; to be mixed into ``Updates``."""

    data: dict[str, np.ndarray]
    meta: dict[str, Any]
    dims: dict[str, Any]
    hyperparameters: dict[str, Any]
    model: Any
    named: dict[str, torch.Tensor]
    execution: str
    limits_of_kind: Mapping[str, Limits]
    takes_moments = True

    # ---------------------------------------------------------------- the model

    @property
    def is_double(self) -> bool:
        return "float64" in self.meta["dtype"]

    @property
    def limits(self) -> Limits:
        has_moments = any(key.startswith("adam/") for key in self.data)
        kind = "midtraining" if has_moments else "start" if "conditioned" in self._initial_values else "rawinit"
        return self.limits_of_kind["float64" if self.is_double else kind]

    @property
    def _initial_values(self) -> str:
        return str(self.meta["start"]["initial_values"])

    @property
    def info_tolerance(self) -> float:
        return self.limits.info

    def settings(self, compile: bool) -> dict[str, Any]:
        hp = self.hyperparameters
        return dict(
            gamma=hp["discount"],
            tau=hp["tau"],
            target_entropy=hp["target_entropy"],
            final_learning_rate=hp["lr_end"],
            schedule_steps=hp["schedule_steps"],
            batch_size=self.dims["batch"],
            buffer_size=1,
            device="cpu",
            compile=compile,
        )

    def make(self, cls: Any, **kwargs: Any) -> Any:
        from tests.sac.test_golden import Shapes

        model = cls("MlpPolicy", Shapes(self.dims["obs_dim"], self.dims["act_dim"]), **kwargs)
        if self.is_double:
            to_double(model)
        return model

    def parameters(self) -> dict[str, torch.Tensor]:
        model = self.model
        heads = {"mean_head": model.actor.mean, "log_std_head": model.actor.log_std}
        networks = {"actor": {**layers_of(model.actor.trunk), **heads}}
        for name, critic in (("critic", model.critic), ("target_critic", model.critic_target)):
            networks[name] = {**layers_of(critic.trunk), "output": critic.head}
        named = {f"{of}/{name}": view for of, layers in networks.items() for name, view in views(layers).items()}
        return {**named, "temperature/log_alpha": model.temperature.log_value}

    def load(self) -> None:
        super().load()  # type: ignore[misc]
        start = self.meta["start"]
        self.model._n_updates = start["critic_updates_done"]
        owners = {
            "actor": (self.model.actor, self.model.actor.optimizer, start["actor_updates_done"]),
            "critic": (self.model.critic, self.model.critic.optimizer, start["critic_updates_done"]),
            "temperature": (self.model.temperature, self.model.temperature_optimizer, start["actor_updates_done"]),
        }
        if not any(key.startswith("adam/") for key in self.data):
            return
        for of, (module, optimizer, n_taken) in owners.items():
            for moment, name in (("first_moment", "exp_avg"), ("second_moment", "exp_avg_sq")):
                for p, value in self._as_parameters(of, module, moment).items():
                    optimizer.state[p][name] = value
                    optimizer.state[p]["step"] = torch.tensor(float(n_taken))

    def _as_parameters(self, of: str, module: nn.Module, moment: str) -> dict[nn.Parameter, torch.Tensor]:
        """The file's moments in the layout of the parameters."""
        learned = {p: p.data for p in module.parameters()}
        try:
            for p in learned:
                p.data = torch.full_like(p, torch.nan)
            found = self.parameters()
            for name, view in found.items():
                if f"adam/{name}/{moment}" in self.data and name.startswith(f"{of}/"):
                    view.detach().copy_(torch.as_tensor(self.data[f"adam/{name}/{moment}"]))
            moments = {p: p.data for p in learned}
        finally:
            for p, data in learned.items():
                p.data = data
        assert not any(value.isnan().any() for value in moments.values()), f"{of}: moments are missing"
        return moments

    # ---------------------------------------------------------------- an update

    def transitions(self, i: int) -> tuple[Batch, Noise]:
        get = lambda key: torch.as_tensor(self.data[f"batch/{i}/{key}"])  # noqa: E731
        keys = self.data.keys()
        dones = get("terminated") if f"batch/{i}/terminated" in keys else 1 - get("masks")
        discounts: Any = get("discount")[:, None] if f"batch/{i}/discount" in keys else self.model.gamma
        dtype = torch.float64 if self.is_double else torch.float32
        batch = Batch(
            get("observations"),
            get("actions"),
            get("next_observations"),
            dones.to(dtype)[:, None],
            get("raw_rewards").to(dtype)[:, None],
            discounts,
        )
        scaler = self.model.reward_scaler
        if scaler is not None:
            scaler.moments.var.fill_(torch.as_tensor(self.data[f"batch/{i}/reward_variance"]))
            if f"batch/{i}/largest_return" in keys:
                scaler.largest.fill_(torch.as_tensor(self.data[f"batch/{i}/largest_return"]))
        scaled, theirs = self._scaled(batch).rewards[:, 0].numpy(), self.data[f"batch/{i}/rewards"]
        np.testing.assert_allclose(scaled, theirs, rtol=1e-6, atol=0, err_msg=f"batch/{i}/rewards")
        noise = {"critic": torch.as_tensor(self.data[f"noise/{i}/critic"])}
        if f"noise/{i}/actor" in keys:
            # Beyond these rows it is that of next observations, whose actions nobody asks for.
            noise["actor"] = torch.as_tensor(self.data[f"noise/{i}/actor"])[: len(batch.actions)]
        return batch, Noise(**noise)

    def _scaled(self, batch: Batch) -> Batch:
        scaler = self.model.reward_scaler
        return batch if scaler is None else scaler.transform(batch, None)

    def moves_actor(self, i: int) -> bool:
        return i in self.meta["actor_moves_at_updates"]

    def compare(self, i: int, found: dict[str, Any]) -> int:
        n_compared: int = super().compare(i, found)  # type: ignore[misc]
        if self.execution != "eager":
            # A compiled step leaves no gradients, a captured one those of its kind.
            return n_compared
        ours = self.gradients() | self.more_gradients  # type: ignore[attr-defined]
        for key, theirs in self.data.items():
            if key.startswith(f"gradient/{i}/"):
                error = np.abs(ours[key.removeprefix(f"gradient/{i}/")].numpy() - theirs).max()
                # XQC's shift of the input has none but rounding; then of the size of its scale's.
                like = key.replace("shift", "scale") if key.endswith("/input_norm/shift") else key
                limit = self.limits.gradients * np.abs(self.data[like]).max()
                assert error <= limit, f"{key}: off by {error:.2e}, allowed {limit:.0e}"
                n_compared += 1
        return n_compared

    #: Gradients that a step does not take, and the file has.
    more_gradients: Mapping[str, torch.Tensor] = {}

    # ---------------------------------------------------------------- after it

    def check_parameters(self, prefix: str, n_updates: int) -> None:
        """
        In XQC's training passes the next norm takes a shift of the input out again: its gradient is rounding, which
        Adam turns into steps of up to the learning rate while its moments are nothing else. In evaluation mode it
        counts. It is therefore taken over from the file after every update, so that all else can be compared closely.
        """
        limits, rate = self.limits, self.model.learning_rate
        n_alone = n_updates - self._n_synchronised
        for name, value in self.named.items():
            if name.startswith("target_critic/") and "/running_" in name:
                continue  # Never read there.
            limit = limits.statistics if "/running_" in name else limits.parameters
            limit = limits.log_alpha if name == "temperature/log_alpha" else limit
            is_shift = name.endswith("/input_norm/shift")
            if is_shift:
                # Both may have gone as far, in opposite directions.
                limit = 2 * rate * n_alone if limits.input_shift is None else limits.input_shift
            theirs = torch.as_tensor(self.data[prefix + name])
            error = float((value.detach().double() - theirs.double()).abs().max())
            assert error <= limit, f"{prefix}{name}: off by {error:.2e}, allowed {limit:.0e}"
            if is_shift and limits.input_shift is None:
                value.detach().copy_(theirs)
        self._n_synchronised = n_updates

    #: Updates after which the file's shifts were last taken over.
    _n_synchronised = 0

    def run(self) -> int:
        n_compared: int = super().run()  # type: ignore[misc]
        groups = {
            "acting": self.check_acting,
            "discount_rule": self.check_discounts,
            "exploration": self.check_exploration,
            "reward_sequence": self.check_rewards,
            "schedule": self.check_schedule,
        }
        there = {key.split("/")[0] for key in self.data}
        for group in there & groups.keys():
            groups[group]()
        return n_compared + len(there & groups.keys())

    def group(self, name: str) -> dict[str, np.ndarray]:
        return {key.removeprefix(f"{name}/"): value for key, value in self.data.items() if key.startswith(f"{name}/")}

    def check_acting(self) -> None:
        group, limit = self.group("acting"), self.limits.actions
        observations, noise = (torch.as_tensor(group[key]) for key in ("observations", "noise"))
        self.model._set_training_mode(False)
        with torch.no_grad():
            actions, log_prob = self.model.actor.sample(observations, noise)
            found = {
                "actions": actions.clamp(-1, 1),
                "deterministic_actions": self.model.actor(observations, deterministic=True),
                "log_probabilities": log_prob[:, 0],
            }
        for name, value in found.items():
            error = np.abs(value.numpy() - group[name]).max()
            allowed = limit * (10 if name == "log_probabilities" else 1)
            assert error <= allowed, f"acting/{name}: off by {error:.2e}, allowed {allowed:.0e}"

    def check_discounts(self) -> None:
        group = self.group("discount_rule")
        found = [
            XQC.discount(int(steps), int(repeat))
            for steps, repeat in zip(group["episode_steps"], group["action_repeat"], strict=True)
        ]
        np.testing.assert_allclose(found, group["discount"], rtol=1e-12)

    def check_schedule(self) -> None:
        group, schedule = self.group("schedule"), self.model.learner.schedule
        # Of a million planned updates.
        found = [schedule.rate(int(step), 1_000_000) for step in group["step"]]
        np.testing.assert_allclose(found, group["learning_rate"], rtol=2e-7)

    def check_rewards(self) -> None:
        """The reward scale over a sequence of steps, the state after every one."""
        group, fresh = self.group("reward_sequence"), self.model.make_reward_scaler(self.model.learner)
        for t, reward in enumerate(group["reward"]):
            done = group["terminated"][t] | group["truncated"][t]
            fresh.feed(np.array([reward]), np.array([done]), self.hyperparameters["discount"])
            found = {
                "G": fresh._returns[0],
                "G_max": fresh.largest,
                "mean": fresh.moments.mean,
                "var": fresh.moments.var,
                "count": fresh.moments.count,
                "divisor": fresh.divisor(None),
                "scaled_reward": reward / fresh.divisor(None),
            }
            # Statistics in float32 agree to its last bits.
            limit = 1e-12 if fresh.largest.dtype == torch.float64 else 1e-5
            for name in found.keys() & group.keys():
                ours, theirs = float(found[name]), float(group[name][t])
                error = abs(ours - theirs) / max(1.0, abs(theirs))
                assert error <= limit, f"reward_sequence/{name}[{t}]: off by {error:.2e}, allowed {limit:.0e}"

    def check_exploration(self) -> None:
        raise NotImplementedError


class XQCUpdates(BatchNormUpdates):
    """XQC's: the actor's numbers are reported for every update, also where it does not learn."""

    limits_of_kind = XQC_LIMITS

    def build(self, compile: bool) -> Any:
        dims, hp = self.dims, self.hyperparameters
        return self.make(
            XQC,
            learning_rate=hp["critic_lr"],
            policy_delay=hp["policy_delay"],
            value_head_kwargs={"n_atoms": dims["atoms"], "v_min": hp["v_min"], "v_max": hp["v_max"]},
            policy_kwargs=self.policy_kwargs(),
            **self.settings(compile),
        )

    def policy_kwargs(self) -> dict[str, Any]:
        dims, hp = self.dims, self.hyperparameters
        norm = {"eps": hp["batch_norm_eps"], "momentum": 1 - hp["batch_norm_keep"]}
        return {
            "net_arch": {"pi": dims["actor_hidden"], "qf": dims["critic_hidden"]},
            "critic_network_kwargs": norm,
            "actor_network_kwargs": norm,
            "actor_kwargs": {"log_std_min": hp["log_std_min"], "log_std_max": hp["log_std_max"]},
            "optimizer_kwargs": {"betas": (hp["adam_b1"], hp["adam_b2"]), "eps": hp["adam_eps"]},
            "n_critics": dims["n_critics"],
        }

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        model = self.model
        self._actor, self._alpha = copy.deepcopy(model.actor), model.temperature().detach()
        with torch.no_grad():
            actions, log_prob = model.policy.next_actions(batch.next_observations, noise.critic)
        return {"info/r": self._scaled(batch).rewards.mean(), **self.of_target(batch, actions, -self._alpha * log_prob)}

    def of_target(self, batch: Batch, next_actions: torch.Tensor, bonus: torch.Tensor) -> dict[str, Any]:
        head, scaled = self.model.head, self._scaled(batch)
        positions = losses.td_target(scaled.rewards, scaled.dones, scaled.discounts, head.support, bonus)  # type: ignore[arg-type]
        ends = (positions <= head.v_min) | (positions >= head.v_max)
        return {"info/clip_percentage": ends.double().mean()}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        model, actor = self.model, self._actor
        actions, log_prob = actor.sample(batch.observations, noise.actor)
        q = values(model.learner, model.critic, batch.observations, actions).amin(dim=0)
        loss = losses.actor_loss(log_prob, q, self._alpha)
        entropy = -log_prob.mean()
        found = {
            "info/critic_loss": metrics["train/critic_loss"],
            "info/actor_q": q.mean(),
            "info/actor_loss": loss,
            "info/entropy": entropy,
            "info/temperature": self._alpha,
            "info/temp_loss": self._alpha * (entropy - self.hyperparameters["target_entropy"]),
        }
        moved = {
            "train/actor_loss": "actor_loss",
            "train/entropy": "entropy",
            "train/ent_coef": "temperature",
            "train/ent_coef_loss": "temp_loss",
        }
        assert (moved.keys() <= metrics.keys()) == self.moves_actor(i)
        if self.moves_actor(i):
            found |= {f"info/{theirs}": metrics[ours] for ours, theirs in moved.items()}
        self.more_gradients = {} if self.moves_actor(i) else self._gradients_of(loss)
        return found

    def _gradients_of(self, loss: torch.Tensor) -> dict[str, torch.Tensor]:
        """Gradients of a loss of the actor from before the update, by the names of the files."""
        parameters = list(self._actor.parameters())
        for p, gradient in zip(parameters, torch.autograd.grad(loss, parameters), strict=True):
            p.data = gradient
        heads = {"mean_head": self._actor.mean, "log_std_head": self._actor.log_std}
        layers = {**layers_of(self._actor.trunk), **heads}
        return {f"actor/{name}": view.detach() for name, view in views(layers).items()}


class WeightNormUpdates(XQCUpdates):
    """CrossQ+WN's: scalar critics, weight decay, no reward scale."""

    limits_of_kind = WEIGHT_NORM_LIMITS

    def build(self, compile: bool) -> Any:
        hp = self.hyperparameters
        return self.make(
            CrossQ,
            weight_norm=True,
            learning_rate=hp["critic_lr"],
            policy_delay=hp["policy_delay"],
            weight_decay=hp["weight_decay"],
            policy_kwargs=self.policy_kwargs(),
            **self.settings(compile),
        )

    def of_target(self, batch: Batch, next_actions: torch.Tensor, bonus: torch.Tensor) -> dict[str, Any]:
        model = copy.deepcopy(self.model.policy)
        rows = torch.cat((batch.observations, batch.next_observations)), torch.cat((batch.actions, next_actions))
        with torch.no_grad():
            q, next_q = (critic.q_values(*rows) for critic in (model.critic, model.critic_target))
            n, v = len(bonus), next_q.amin(dim=0)
            target = losses.td_target(batch.rewards, batch.dones, batch.discounts, v[n:], bonus)  # type: ignore[arg-type]
        return {
            "info/q_values": q[:, :n].mean(),
            "info/target_q": target.mean(),
            "info/min_target_q": target.min(),
            "info/max_target_q": target.max(),
        }


class FlashSACUpdates(BatchNormUpdates):
    """FlashSAC's: actor and temperature first, where they learn; the exploration over a sequence of steps."""

    limits_of_kind = FLASH_LIMITS

    def build(self, compile: bool) -> Any:
        dims, hp = self.dims, self.hyperparameters
        sizes = {
            f"{who}_network_kwargs": {
                "width": dims[f"{who}_hidden"],
                "n_blocks": dims[f"{who}_blocks"],
                "expansion": dims["expansion"],
            }
            for who in ("actor", "critic")
        }
        model = self.make(
            FlashSAC,
            learning_rate=hp["lr_peak"],
            warm_up_steps=hp["warmup_steps"],
            warm_up_learning_rate=hp["lr_start"],
            policy_delay=hp["actor_period"],
            value_head_kwargs={"n_atoms": dims["atoms"], "v_min": hp["v_min"], "v_max": hp["v_max"]},
            reward_scale_kwargs={"max_return": hp["reward_G_max"]},
            exploration_kwargs={"exponent": hp["zeta_exponent"], "longest": hp["zeta_longest"]},
            policy_kwargs={
                **sizes,
                "actor_kwargs": {"log_std_min": hp["log_std_min"], "log_std_max": hp["log_std_max"]},
                "optimizer_kwargs": {"betas": (hp["adam_b1"], hp["adam_b2"]), "eps": hp["adam_eps"]},
                "n_critics": dims["n_critics"],
            },
            **self.settings(compile),
        )
        by_default = FlashSAC("MlpPolicy", model.env, target_std=hp["target_sigma"], buffer_size=1, device="cpu")
        np.testing.assert_allclose(by_default.target_entropy, hp["target_entropy"], rtol=1e-12)
        return model

    def before(self, i: int, batch: Batch, noise: Noise) -> dict[str, Any]:
        if not self.moves_actor(i):
            return {}
        actor = copy.deepcopy(self.model.actor)
        with torch.no_grad():
            actions, _ = actor.sample(batch.observations, noise.actor, batch.next_observations)
        return {"info/actor_mean_action": actions.mean()}

    def after(self, i: int, batch: Batch, noise: Noise, metrics: dict[str, float]) -> dict[str, Any]:
        model = self.model
        # The critics' step had the new actor and temperature.
        with torch.no_grad():
            _, log_prob = model.policy.next_actions(batch.next_observations, noise.critic)
            penalty = model.temperature() * log_prob
        names = {
            "info/actor_loss": "train/actor_loss",
            "info/actor_entropy": "train/entropy",
            "info/critic_loss": "train/critic_loss",
            "info/temperature_value": "train/ent_coef",
            "info/temperature_loss": "train/ent_coef_loss",
        }
        rates = {who: getattr(model, who).optimizer.param_groups[0]["lr"] for who in ("actor", "critic")}
        for who, rate in rates.items():
            theirs = self.data.get(f"info/{i}/{who}_learning_rate")
            if theirs is not None:
                np.testing.assert_allclose(rate, theirs, rtol=2e-7)
        assert ("train/actor_loss" in metrics) == self.moves_actor(i)
        found = {theirs: metrics[ours] for theirs, ours in names.items() if ours in metrics}
        found |= {f"info/{who}_learning_rate": rate for who, rate in rates.items()}
        return found | {"info/critic_max_entropy_bonus": penalty.max()}

    def check_exploration(self) -> None:
        group, model = self.group("exploration"), self.model
        explorer = model.make_explorer(model.learner)
        theirs = group["cumulative_probability"]
        np.testing.assert_allclose(explorer._cumulative.numpy(), theirs, atol=1e-6, rtol=0)
        model._set_training_mode(False)
        for t, observation in enumerate(group["observations"]):
            observations = torch.as_tensor(observation)[None]
            with torch.no_grad():
                if group["evaluation"][t]:
                    action = model.actor(observations, deterministic=True)
                else:
                    fresh = torch.as_tensor(group["fresh_noise"][t])[None]
                    held = explorer.hold(fresh, float(group["uniform"][t]))
                    mean, log_std = model.actor.gaussian(model.actor.features(observations))
                    action = model.actor.act(mean, log_std.exp(), held)
            np.testing.assert_array_equal(explorer._held[0].numpy(), group["held_noise"][t], err_msg=f"step {t}")
            counts = (explorer._length, explorer._n_held)
            assert counts == (group["hold_length"][t], group["steps_held"][t]), f"step {t}"
            error = np.abs(action[0].numpy() - group["actions"][t]).max()
            assert error <= self.limits.actions, f"exploration/actions[{t}]: off by {error:.2e}"
