"""
Parity of DR.Q with updates and replay of the authors' own code, from stored parameters, moments, batches and noise.

The files ``tests/golden/dr_q_*.npz`` were made with the published code (layer sizes shrunk). Another folder of files of
the same format is tested instead if ``SB3_SAMPLE_GOLDEN`` names it. Everything is taken from the file.
"""

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample import DebiasedRQ
from sb3_sample.learner.batch import SLOTS, Batch, Noise, Windows
from sb3_sample.learner.debiased_rq import DebiasedRQLearner
from sb3_sample.learner.embedding_losses import infonce, reward_cross_entropy, symexp_atoms, two_hot
from sb3_sample.learner.execution import Execution
from sb3_sample.replay.weights import DrawWeights
from tests.sac.common import COMPILES
from tests.sac.test_execution import Recorder, captured

OWN_FOLDER = Path(__file__).parents[1] / "golden"
FOLDER = Path(os.environ.get("SB3_SAMPLE_GOLDEN") or OWN_FOLDER)


def meta_of(path: Path) -> dict[str, Any]:
    with np.load(path) as data:
        return json.loads(str(data["meta"]))  # type: ignore[no-any-return]


#: Files of updates, and of the replay alone.
FILES = sorted(FOLDER.glob("dr_q_*.npz"))
REPLAYS = [path for path in FILES if "capacity" in meta_of(path)]
UPDATES = [path for path in FILES if path not in REPLAYS]


def replays_with(group: str) -> list[Path]:
    """Files of the replay that have a group of keys."""
    return [path for path in REPLAYS if any(key.startswith(group) for key in np.load(path))]


class Limits(NamedTuple):
    """Largest differences: info relative to max(1, its size), gradients and moments to the array's largest element."""

    info: float = 2e-5
    parameters: float = 1e-6
    gradients: float = 1e-4
    actions: float = 1e-5


def limits(path: Path) -> Limits:
    if meta_of(path)["dtype"].startswith("float64"):
        return Limits(1e-10, 1e-10, 1e-9, 1e-9)
    with np.load(path) as data:
        largest = max(np.abs(data[key]).max() for key in data if key.endswith("/rewards"))
    # Losses and gradients of large rewards are sums of large numbers.
    return Limits(1e-4, 2e-5) if "edge" in path.stem or largest > 1_000 else Limits()


class Shapes(gym.Env):
    """An environment that has only shapes, and episodes of a length."""

    def __init__(self, obs_dim: int, act_dim: int, max_action: float = 1.0, length: int = 1_000):
        self.observation_space = spaces.Box(-np.inf, np.inf, (obs_dim,), np.float32)
        self.action_space = spaces.Box(-max_action, max_action, (act_dim,), np.float32)
        self.length, self.t = length, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.normal(size=self.observation_space.shape).astype(np.float32), {}

    def step(self, action: np.ndarray) -> Any:
        self.t += 1
        observation = self.np_random.normal(size=self.observation_space.shape).astype(np.float32)
        return observation, 0.0, False, self.t >= self.length, {}


def build(meta: dict[str, Any], compile: bool = False) -> DebiasedRQ:
    dims, hp = meta["dims"], meta["hyperparameters"]
    assert (hp["encoder_activation"], hp["critic_activation"], hp["actor_activation"]) == ("elu", "elu", "relu")
    assert hp["layer_norm_eps"] == 1e-5
    model = DebiasedRQ(
        "MlpPolicy",
        Shapes(dims["obs_dim"], dims["act_dim"], hp["max_action"]),
        learning_rate=hp["learning_rate"],
        gamma=hp["discount"],
        n_steps=hp["n_step"],
        target_update_interval=hp["target_update_freq"],
        exploration_noise=hp["exploration_noise"],
        target_noise=hp["target_noise"],
        target_noise_clip=hp["target_noise_clip"],
        weight_decay=hp["weight_decay"],
        encoder_horizon=hp["encoder_horizon"],
        dynamics_weight=hp["dynamics_weight"],
        reward_weight=hp["reward_weight"],
        infonce_weight=hp["infonce_weight"],
        infonce_temperature=hp["infonce_temperature"],
        reward_range=(hp["reward_lower"], hp["reward_upper"]),
        replay_buffer_kwargs={
            "priority_exponent": hp["priority_exponent"],
            "smallest_error": hp["min_priority"],
        },
        policy_kwargs={
            "net_arch": {"pi": [dims["actor_hidden"]] * 2, "qf": [dims["critic_hidden"]] * 3},
            "encoder_width": dims["encoder_hidden"],
            "state_embedding": dims["state_embedding"],
            "action_embedding": dims["action_embedding"],
            "pair_embedding": dims["pair_embedding"],
            "n_reward_atoms": dims["reward_atoms"],
            "n_critics": dims["n_critics"],
            "optimizer_kwargs": {"betas": (hp["adam_b1"], hp["adam_b2"]), "eps": hp["adam_eps"]},
        },
        buffer_size=max(dims["batch"], 2 * max(hp["encoder_horizon"], hp["n_step"]) + 2),
        device="cpu",
        compile=compile,
    )
    if meta["dtype"].startswith("float64"):
        model.policy.double()
    return model


class Named(NamedTuple):
    """A parameter, and the view of it, or of a tensor like it, in the layout of the files."""

    parameter: torch.Tensor
    view: Callable[[torch.Tensor], torch.Tensor]


def named_parameters(model: DebiasedRQ) -> dict[str, Named]:
    """Every parameter by its name in the files."""
    policy: Any = model.policy
    named: dict[str, Named] = {}

    def add(name: str, layer: Any) -> None:
        if layer.weight.dim() == 3:
            named[f"{name}/weight"] = Named(layer.weight, lambda value: value.transpose(1, 2))
            named[f"{name}/bias"] = Named(layer.bias, lambda value: value[:, 0])
        else:
            named[f"{name}/weight"] = Named(layer.weight, lambda value: value)
            named[f"{name}/bias"] = Named(layer.bias, lambda value: value)

    for prefix, encoder, critic, actor in (
        ("", policy.encoder, policy.critic, policy.actor),
        ("target_", policy.encoder_target, policy.critic_target, policy.actor_target),
    ):
        layers = {
            "encoder/state": encoder.state.layers,
            "encoder/pair": [*encoder.pair_hidden.layers, encoder.pair_output],
            "critic": critic.trunk.layers,
            "actor": [*actor.trunk.layers, actor.mean],
        }
        for name, stack in layers.items():
            for i, layer in enumerate(stack, 1):
                add(f"{prefix}{name}/layer_{i}", layer)
        single = {"encoder/action": encoder.action, "encoder/model": encoder.model, "critic/output": critic.head}
        for name, layer in single.items():
            add(f"{prefix}{name}", layer)
    return named


class Replay:
    """A file's updates, repeated by the model's own learner, and compared on the way."""

    def __init__(self, path: Path, execution: str):
        with np.load(path) as stored:
            self.data = dict(stored)
        self.meta, self.execution, self.limits = meta_of(path), execution, limits(path)
        self.model = build(self.meta, compile=execution == "compiled")
        self.learner: DebiasedRQLearner = self.model.learner
        self.recorders: list[Recorder] = []
        if execution == "captured":
            self.recorders = [captured(self.model, warm_up=0), Recorder(self.model.learner)]
            encoder = self.learner._encoder_execution = Execution(
                self.learner, False, False, self.recorders[1], "encoder_step"
            )
            assert encoder._captured is not None
            encoder._captured.WARM_UP = 0
        self.named = named_parameters(self.model)
        self.dtype = self.named["critic/output/weight"].parameter.dtype
        #: How many arrays of each group of keys were compared.
        self.compared: dict[str, int] = {}
        self._start()

    def _start(self) -> None:
        stored = {key.removeprefix("init/") for key in self.data if key.startswith("init/")}
        assert stored == self.named.keys()
        start = self.meta.get("start", {})
        optimizers = self.learner.optimizers()
        with torch.no_grad():
            for name, (parameter, view) in self.named.items():
                view(parameter).copy_(self.tensor(f"init/{name}"))
                key = f"adam/{name}"
                if f"{key}/first_moment" in self.data:
                    module = name.split("/")[0]
                    state = optimizers[f"{module}.optimizer"].state[parameter]
                    state["step"] = torch.tensor(float(start.get(module, 0)))
                    for ours, theirs in (("exp_avg", "first_moment"), ("exp_avg_sq", "second_moment")):
                        state[ours] = torch.zeros_like(parameter)
                        view(state[ours]).copy_(self.tensor(f"{key}/{theirs}"))
        self.model._n_updates = start.get("training_steps_done", 0)
        self.weights.max_priority = start.get("max_priority", 1.0)

    @property
    def weights(self) -> DrawWeights:
        return self.model.replay_buffer.weights  # type: ignore[no-any-return, union-attr]

    def tensor(self, key: str) -> torch.Tensor:
        return torch.as_tensor(self.data[key]).to(self.dtype)

    # ---------------------------------------------------------------- comparing

    def compare(self, key: str, ours: Any, limit: float, unit: str = "info") -> None:
        """Compare with the file if it has the key."""
        if key not in self.data:
            return
        theirs = self.data[key].astype(np.float64)
        if isinstance(ours, torch.Tensor):
            ours = ours.detach().double().numpy()
        ours = np.asarray(ours, np.float64)
        assert ours.shape == theirs.shape, f"{key}: {ours.shape}, not {theirs.shape}"
        size = {
            "info": np.maximum(1, np.abs(theirs)),
            "absolute": 1.0,
            "largest": max(float(np.abs(theirs).max()), 1e-12),
        }[unit]
        error = float((np.abs(ours - theirs) / size).max())
        assert error <= limit, f"{key}: off by {error:.2e}, allowed {limit:.0e}"
        group = key.split("/")[0]
        self.compared[group] = self.compared.get(group, 0) + 1

    def info(self, i: int, name: str, ours: Any) -> None:
        self.compare(f"info/{i}/{name}", ours, self.limits.info)

    def gradients(self, prefix: str, modules: tuple[str, ...]) -> None:
        """Raw gradients, which only an eager step leaves."""
        if self.execution != "eager":
            return
        for name, (parameter, view) in self.named.items():
            if name.split("/")[0] in modules and f"{prefix}/{name}" in self.data:
                assert parameter.grad is not None
                self.compare(f"{prefix}/{name}", view(parameter.grad), self.limits.gradients, "largest")

    def parameters(self, i: int) -> None:
        for name, (parameter, view) in self.named.items():
            self.compare(f"after/{i}/{name}", view(parameter), self.limits.parameters, "absolute")

    # ---------------------------------------------------------------- the updates

    def run(self) -> None:
        n = self.meta["dims"]["n_updates"]
        for i in range(n):
            self.learner.prepared_execution()
            due = self.learner.n_encoder_steps_due
            assert (due > 0) == (i in self.meta["boundaries_at_updates"])
            if due > 0:
                self.encode(i, due)
            self.update(i)
            self.parameters(i)
        done = self.meta.get("updates_done_at_end", {})
        for name, (parameter, view) in self.named.items():
            module = name.split("/")[0]
            if module.startswith("target_"):
                continue
            state = self.learner.optimizers()[f"{module}.optimizer"].state.get(parameter, {})
            if state and module in done:
                assert state["step"].item() == done[module]
            for ours, theirs in (("exp_avg", "first_moment"), ("exp_avg_sq", "second_moment")):
                key = f"final_adam/{name}/{theirs}"
                # An encoder that no step was taken of has no moments but those that it was given.
                if key in self.data and state:
                    self.compare(key, view(state[ours]), self.limits.gradients, "largest")
        self.acting()

    def encode(self, i: int, n: int) -> None:
        """The encoder's updates before a step, as the learner makes them."""
        metrics: list[dict[str, torch.Tensor]] = []
        plain = self.learner.update_encoder

        def update(batch: Windows) -> dict[str, torch.Tensor]:
            metrics.append(plain(batch))
            return metrics[-1]

        self.learner.update_encoder = update  # type: ignore[method-assign]
        self.learner.learn_embeddings(self.windows(i, n, metrics))
        del self.learner.update_encoder
        assert len(metrics) == n

    def windows(self, i: int, n: int, metrics: list[dict[str, torch.Tensor]]) -> Iterator[Windows]:
        """The encoder's batches of a step; what became of each is compared when the next one is asked for."""
        for j in range(n):
            key = f"encoder_batch/{i}/{j}"
            batch = Windows(
                self.tensor(f"{key}/observations")[:, 0],
                self.tensor(f"{key}/actions"),
                self.tensor(f"{key}/next_observations"),
                1 - self.tensor(f"{key}/not_done"),
                self.tensor(f"{key}/rewards"),
            )
            self.predictions(i, j, batch)
            yield batch
            self.compare(f"encoder_info/{i}/{j}/loss", metrics[j]["encoder/loss"], self.limits.info)
            if f"encoder_info/{i}/{j}/dynamics_loss" in self.data:
                total = self.data[f"encoder_info/{i}/{j}/dynamics_loss"].astype(np.float64).sum()
                assert abs(metrics[j]["encoder/dynamics_loss"].item() - total) <= self.limits.info * max(1, total)
            self.gradients(f"gradient/{i}/{j}", ("encoder",))

    @torch.no_grad()
    def predictions(self, i: int, j: int, batch: Windows) -> None:
        """Step by step, what the encoder predicts before its update."""
        networks, settings = self.learner.networks, self.learner.embedding_loss
        horizon = batch.rewards.shape[1]
        targets = [networks.embedded(batch.next_observations[:, t], target=True) for t in range(horizon)]
        atoms = symexp_atoms(*settings.reward_range, networks.encoder.n_reward_atoms, like=targets[0])
        embedding, alive = networks.embedded(batch.observations), torch.ones(len(batch.actions), dtype=self.dtype)
        errors, contrasts, rewards = [], [], []
        for t in range(horizon):
            embedding, logits = networks.encoder.predict(networks.encoder.pair(embedding, batch.actions[:, t]))
            errors.append((alive[:, None] * (embedding - targets[t]).square()).mean())
            contrasts.append(infonce(embedding, targets[t], settings.infonce_temperature))
            rewards.append(reward_cross_entropy(logits, two_hot(batch.rewards[:, t], atoms)))
            alive = alive * (1 - batch.dones[:, t])
        for name, values in (
            ("dynamics_loss", errors),
            ("infonce_per_sample", contrasts),
            ("reward_cross_entropy_per_sample", rewards),
        ):
            self.compare(f"encoder_info/{i}/{j}/{name}", torch.stack(values), self.limits.info)

    def batch(self, i: int) -> Batch:
        """The transitions of a step, made of its windows as in the training."""
        rewards = self.tensor(f"batch/{i}/rewards")
        n = rewards.shape[1]
        actions, following = (self.tensor(f"batch/{i}/{name}") for name in ("actions", "next_observations"))
        windows = Windows(
            self.tensor(f"batch/{i}/observations"),
            actions[:, None].expand(-1, n, -1),
            following[:, None].expand(-1, n, -1),
            1 - self.tensor(f"batch/{i}/not_done"),
            rewards,
            {SLOTS: torch.arange(len(rewards))[:, None]},
        )
        return windows.n_step(self.model.gamma)

    def update(self, i: int) -> None:
        learner, batch = self.learner, self.batch(i)
        noise = self.tensor(f"noise/{i}/target_action")
        unused = torch.full_like(noise, float("nan"))
        self.info(i, "n_step_reward", batch.rewards)
        self.info(i, "bootstrap_discount", batch.discounts * (1 - batch.dones))
        with torch.no_grad():
            next_actions, _ = learner.next_actions(batch.next_observations, noise)
            next_q = learner.critic_target.q_values(batch.next_observations, next_actions)
            target = learner.head.target(batch, next_q, learner.pessimism_rule.value, torch.zeros_like(batch.rewards))
            q = learner.critic.q_values(batch.observations, batch.actions)
            before = learner.actor.mean(learner.actor.trunk(learner.actor.features(batch.observations)))
            self.compare(f"info/{i}/next_action", next_actions, self.limits.actions, "absolute")
            self.info(i, "target_q", target)
            self.info(i, "q", q[:, :, 0].T)
            self.info(i, "policy_pre_activation", before)
            self.compare(
                f"info/{i}/policy_action", learner.actor.sample(batch.observations)[0], self.limits.actions, "absolute"
            )
        learner.set_training_mode(True)
        metrics = self.model._update(batch, Noise(noise, unused, unused))
        learner.set_training_mode(False)
        self.info(i, "critic_loss", metrics["train/critic_loss"])
        self.info(i, "actor_loss", metrics["train/actor_loss"])
        errors = learner.td_errors
        assert errors is not None
        self.info(i, "priority", self.weights.priorities(errors.numpy()))
        if f"info/{i}/priority" in self.data:
            stored = self.weights.priority[: len(errors)]
            np.testing.assert_allclose(stored, self.data[f"info/{i}/priority"], rtol=max(self.limits.info, 1e-7))
        self.info(i, "max_priority", self.weights.max_priority)
        self.gradients(f"gradient/{i}", ("critic", "actor"))

    def acting(self) -> None:
        if "acting/observations" not in self.data:
            return
        observations, actor = self.tensor("acting/observations"), self.learner.actor
        with torch.no_grad():
            mean, log_std = actor.gaussian(actor.features(observations))
            explored = actor.act(mean, log_std.exp(), self.tensor("acting/noise")).numpy()
            best = self.learner.act(observations, deterministic=True).numpy()  # type: ignore[union-attr]
        for key, scaled in (("acting/action", explored), ("acting/deterministic", best)):
            self.compare(key, self.model.policy.unscale_action(scaled), self.limits.actions, "absolute")


EXECUTIONS = ("eager", "compiled", "captured")
#: Compiled they are the steps of other files, by other numbers.
NOT_COMPILED = {"dr_q_rawinit", "dr_q_float64"}


@pytest.mark.parametrize(
    ("path", "execution"),
    [
        pytest.param(
            path,
            execution,
            id=f"{path.stem}-{execution}",
            marks=[COMPILES, pytest.mark.slow] if execution == "compiled" else [],
        )
        for path in UPDATES
        for execution in EXECUTIONS
        if execution != "compiled" or path.stem not in NOT_COMPILED
    ],
)
def test_golden(path: Path, execution: str) -> None:
    replay = Replay(path, execution)
    replay.run()
    n, boundaries = replay.meta["dims"]["n_updates"], len(replay.meta["boundaries_at_updates"])
    # All that the file has was compared, but for inputs and for gradients that are not left behind.
    groups = {key.split("/")[0] for key in replay.data} - {"init", "adam", "batch", "encoder_batch", "noise", "meta"}
    for group in groups - ({"gradient"} if execution != "eager" else set()):
        keys = [key for key in replay.data if key.startswith(f"{group}/")]
        inputs = {"acting/observations", "acting/noise"}
        assert replay.compared.get(group) == len(set(keys) - inputs), group
    if execution == "compiled":
        assert replay.learner.seconds_compiling > 0
    if execution == "captured":
        of_values, of_encoder = (recorder.n_repetitions for recorder in replay.recorders)
        assert (of_values, of_encoder) == (n, boundaries * replay.meta["hyperparameters"]["target_update_freq"])


def test_files_are_there() -> None:
    assert {path.stem for path in OWN_FOLDER.glob("dr_q_*.npz")} >= {"dr_q_float64", "dr_q_replay"}


# ---------------------------------------------------------------- the replay


def replay_model(meta: dict[str, Any], capacity: int, **kwargs: Any) -> DebiasedRQ:
    env = Shapes(meta["obs_dim"], meta["act_dim"], meta["max_action"], kwargs.pop("length", 1_000))
    return DebiasedRQ(
        "MlpPolicy",
        DummyVecEnv([lambda: env]),
        buffer_size=capacity,
        batch_size=meta["batch"],
        n_steps=meta["n_step"],
        encoder_horizon=meta["encoder_horizon"],
        replay_buffer_kwargs={"fade": meta["forget_decay"], "fade_floor": meta["forget_floor"]},
        policy_kwargs=TINY_POLICY,
        device="cpu",
        **kwargs,
    )


TINY_POLICY: dict[str, Any] = {
    "net_arch": [8, 8], "encoder_width": 8, "state_embedding": 4, "action_embedding": 4, "pair_embedding": 4,
    "n_reward_atoms": 5,
}  # fmt: skip


def check_windows(ours: Windows, data: dict[str, np.ndarray], steps: np.ndarray, key: str, max_action: float) -> None:
    """Up to a termination all is equal but the published next observation there, which is not that of the episode."""
    n, length = ours.rewards.shape
    followed = np.minimum(steps[:, None] + np.arange(length), len(data["stream/rewards"]) - 1)
    alive = np.cumprod(data[f"{key}/not_done"], axis=1).astype(bool)
    counts = np.concatenate((np.ones((n, 1), bool), alive[:, :-1]), axis=1)
    np.testing.assert_array_equal(ours.observations, data["stream/observations"][steps])
    np.testing.assert_array_equal(ours.rewards.numpy()[counts], data[f"{key}/rewards"][counts])
    np.testing.assert_array_equal(1 - ours.dones.numpy()[counts], data[f"{key}/not_done"][counts])
    # The episode's own next observations, at its end too.
    np.testing.assert_array_equal(
        ours.next_observations.numpy()[counts], data["stream/next_observations"][followed][counts]
    )
    np.testing.assert_allclose(
        ours.actions.numpy()[counts], data["stream/actions"][followed][counts] / max_action, rtol=1e-6, atol=1e-7
    )
    theirs = data[f"{key}/next_observations"]
    if theirs.ndim == 3:
        is_right = counts & (alive | (np.arange(length) == length - 1))
        np.testing.assert_array_equal(ours.next_observations.numpy()[is_right], theirs[is_right])
        np.testing.assert_array_equal(ours.observations, data[f"{key}/observations"][:, 0])
        np.testing.assert_allclose(ours.actions.numpy()[counts], data[f"{key}/actions"][counts], rtol=1e-6, atol=1e-7)
    else:
        is_right = counts[:, -1]
        np.testing.assert_array_equal(ours.next_observations[:, -1].numpy()[is_right], theirs[is_right])
        np.testing.assert_array_equal(ours.observations, data[f"{key}/observations"])
        np.testing.assert_allclose(ours.actions[:, 0], data[f"{key}/actions"], rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("path", REPLAYS, ids=lambda path: path.stem)
def test_golden_replay(path: Path) -> None:
    """Slots, masks, priorities, ageing, draws and windows, transition by transition."""
    data, meta = dict(np.load(path)), meta_of(path)
    model = replay_model(meta, meta["capacity"])
    buffer: Any = model.replay_buffer
    weights, fade, floor = buffer.weights, meta["forget_decay"], meta["forget_floor"]
    assert buffer.horizon == meta["horizon"] and (weights.fade, weights.fade_floor) == (fade, floor)
    # Where the file replaces the weights that fade, the ages that belong to them.
    more = np.zeros(meta["capacity"])

    def faded() -> np.ndarray:
        ages = weights.n_stored - 1 - weights.ordinal + more
        return np.maximum(fade ** ages[: weights.size], floor)

    n_windows = n_over_ends = 0
    for t in range(meta["steps"]):
        action = model.policy.scale_action(data["stream/actions"][t][None])
        terminated, truncated = data["stream/terminated"][t], data["stream/truncated"][t]
        buffer.add(
            data["stream/observations"][t][None], data["stream/next_observations"][t][None], action,
            data["stream/rewards"][t][None], np.array([terminated | truncated]),
            [{"TimeLimit.truncated": bool(truncated)}],
        )  # fmt: skip
        slot_step = data["state/slot_step"][t]
        more[slot_step == t] = 0
        holds = slot_step >= 0
        if t in meta.get("override_at", ()):
            forget = data[f"override/{t}/forget_weight"].astype(np.float64)
            more = np.where(holds, np.log(np.maximum(forget, 1e-30)) / np.log(fade), 0)
            more -= np.where(holds, weights.n_stored - 1 - weights.ordinal, 0)
            weights.faded, weights._sums = faded, None
        np.testing.assert_array_equal(weights.ordinal, slot_step)
        np.testing.assert_array_equal(weights.ready, data["state/mask"][t])
        assert weights.n_taken % meta["capacity"] == data["state/write_index"][t]
        assert weights.size == data["state/size"][t]
        used = holds[: weights.size]
        np.testing.assert_allclose(
            weights.faded()[used],
            np.maximum(data["state/forget_weight"][t][: weights.size][used], floor),
            rtol=1e-3,
        )
        if t in meta["sample_at"]:
            uniform, index = data[f"sample/{t}/uniform"], data[f"sample/{t}/index"]
            for row, length, name in ((0, meta["encoder_horizon"], "encoder"), (1, meta["n_step"], "n_step")):
                slots = weights.draw(uniform[row].astype(np.float64))
                np.testing.assert_array_equal(slots, index[row])
                windows = buffer.windows_of(slots, length)
                check_windows(windows, data, slot_step[slots], f"sample/{t}/{name}", meta["max_action"])
                n_windows += len(slots)
                n_over_ends += int((windows.dones[:, :-1].sum(dim=1) > 0).sum())
            weights.set_priorities(index[1], data[f"sample/{t}/new_priority"])
        np.testing.assert_array_equal(weights.priority[holds], data["state/priority"][t][holds])
        assert weights.max_priority == pytest.approx(data["state/max_priority"][t], rel=1e-7)
    assert n_windows or not meta["sample_at"]
    assert n_over_ends or path.parent != OWN_FOLDER


@pytest.mark.parametrize("path", replays_with("ageing/"), ids=lambda path: path.stem)
def test_golden_ageing(path: Path) -> None:
    data, meta = dict(np.load(path)), meta_of(path)
    weights = DrawWeights(2, meta["forget_decay"], meta["forget_floor"], 0.4, 1.0)
    weights.put(1)
    for age, plain, clamped in zip(data["ageing/age"], data["ageing/weight"], data["ageing/clamped"], strict=True):
        weights.n_stored = int(age) + 1
        assert weights.faded()[0] == pytest.approx(max(plain, meta["forget_floor"]), rel=1e-3)
        assert weights.faded()[0] == pytest.approx(clamped, rel=1e-3)


@pytest.mark.parametrize("path", replays_with("warm_up/"), ids=lambda path: path.stem)
def test_golden_warm_up(path: Path) -> None:
    """When actions stop to be random, when training begins, and when targets are copied."""
    data, meta = dict(np.load(path)), meta_of(path)
    settings = meta["warm_up"]
    model = replay_model(
        meta, 1_000, learning_starts=settings["buffer_size_before_training"], length=settings["episode_length"],
        target_update_interval=settings["target_update_freq"], compile=False,
    )  # fmt: skip
    seen: dict[str, list[Any]] = {name.removeprefix("warm_up/"): [] for name in data if name.startswith("warm_up/")}
    counts = {"explored": 0, "encoder": 0, "copies": 0}

    def counted(name: str, plain: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            counts[name] += 1
            return plain(*args)

        return call

    learner: Any = model.learner
    learner.explore = counted("explored", learner.explore)
    learner.update_encoder = counted("encoder", learner.update_encoder)
    learner.copy_targets = counted("copies", learner.copy_targets)
    plain_turn = model._turn

    def turn(*args: Any) -> bool:
        before = dict(counts)
        goes_on = plain_turn(*args)
        buffer: Any = model.replay_buffer
        now = {
            "random_action": counts["explored"] == before["explored"],
            "size_after_add": buffer.weights.size,
            "training_steps": model._n_updates,
            "encoder_updates_total": counts["encoder"],
            "targets_copied": counts["copies"] > before["copies"],
            "episode_end": buffer.dones[buffer.pos - 1, 0] == 1,
        }
        for name, values in seen.items():
            values.append(now[name])
        return goes_on

    model._turn = turn  # type: ignore[method-assign]
    model.learn(len(data["warm_up/random_action"]))
    for name, values in seen.items():
        np.testing.assert_array_equal(np.array(values), data[f"warm_up/{name}"], err_msg=name)


@pytest.mark.parametrize("path", replays_with("two_hot/"), ids=lambda path: path.stem)
def test_golden_two_hot(path: Path) -> None:
    data, meta = dict(np.load(path)), meta_of(path)
    rewards, logits = (torch.as_tensor(data[f"two_hot/{name}"]) for name in ("reward", "logits"))
    atoms = symexp_atoms(meta["reward_lower"], meta["reward_upper"], len(data["two_hot/atoms"]), like=rewards)
    np.testing.assert_allclose(atoms, data["two_hot/atoms"], rtol=1e-6)
    code = two_hot(rewards, atoms)
    np.testing.assert_allclose(code, data["two_hot/code"], atol=1e-6)
    np.testing.assert_allclose(reward_cross_entropy(logits, code), data["two_hot/cross_entropy"], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(torch.softmax(logits, 1) @ atoms, data["two_hot/decoded"], rtol=5e-5, atol=5e-5)
