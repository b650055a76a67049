"""SR-SPR as a user has it: acting, when it learns, resets, files, runs that go on, errors."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_sample import SRSPR
from sb3_sample.srspr.networks import FRESH
from tests.sac.common import COMPILES
from tests.sac.test_execution import TOLERANCE, captured, largest_difference, pair, updates
from tests.srspr.common import SIZE, TINY, Frames, tiny, venv


def parameters(model: SRSPR) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


# ---------------------------------------------------------------- acting


def test_exploration_falls_after_the_warm_up() -> None:
    model = tiny(learning_starts=2_000, exploration_steps=2_001)
    rates = []
    for model.num_transitions in (0, 1_999, 2_000, 2_000 + 667, 4_000, 4_001, 10**6):
        rates.append(model.exploration_rate)
    assert rates == pytest.approx([1, 1, 1, 1 - 667 / 2001, 1 / 2001, 0, 0])
    floor = tiny(exploration_initial_eps=0.8, exploration_final_eps=0.1, exploration_steps=0, learning_starts=5)
    assert floor.exploration_rate == pytest.approx(0.8)
    floor.num_transitions = 5
    assert floor.exploration_rate == pytest.approx(0.1)


def test_the_target_network_acts() -> None:
    model = tiny(evaluation_eps=0.5)
    with torch.no_grad():
        for p in model.policy.q_net_target.parameters():
            p.add_(0.5 * torch.randn_like(p))
    observations = np.stack([Frames().reset(seed=seed)[0] for seed in range(40)])
    with torch.no_grad():
        x = torch.as_tensor(observations).float() / 255
        values = (model.policy.q_net_target(x).softmax(dim=-1) * model.policy.atoms).sum(dim=-1)
    actions = model.predict(observations, deterministic=True)[0]
    assert actions.tolist() == values.argmax(dim=1).tolist()
    differ = model.predict(observations)[0] != actions
    assert 0.05 < differ.mean() < 0.6  # half at random, of which a third the same
    assert model.predict(observations[0], deterministic=True)[0].shape == ()


@pytest.mark.parametrize(
    ("kwargs", "n_updates"),
    [
        ({}, 2 * 20),
        ({"replay_ratio": 0.25}, 5),
        ({"train_freq": 4, "gradient_steps": 1}, 6),
        ({"train_freq": 2, "gradient_steps": -1}, 20),
    ],
)
def test_when_it_learns(kwargs: dict[str, Any], n_updates: int) -> None:
    model = tiny(**kwargs).learn(50)
    assert model._n_updates == n_updates


def test_several_environments_and_a_pass_over_the_buffers_end() -> None:
    model = tiny(venv(2), buffer_size=60).learn(100)
    assert model._n_updates == 2 * 70 and model.replay_buffer is not None and model.replay_buffer.full


class Order(BaseCallback):
    """What has happened when a step is reported."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[int, int, int]] = []

    def _on_step(self) -> bool:
        assert isinstance(self.model, SRSPR)
        self.seen.append((self.num_timesteps, self.model._n_updates, self.model.n_resets))
        return True


def test_updates_then_the_reset_then_the_next_decision() -> None:
    order = Order()
    model = tiny(reset_interval=20, learning_starts=10).learn(90, callback=order)
    at = {step: (updates, resets) for step, updates, resets in order.seen}
    # The reset of decision 20 follows its updates, and comes before decision 21.
    assert at[20] == (2 * 9, 0) and at[21] == (2 * 10, 1)
    # Of 90 decisions: 20, 40, 60; after 80, no whole interval is left.
    assert [at[step][1] for step in (41, 61, 81, 90)] == [2, 3, 3, 3] and model.n_resets == 3
    assert tiny(reset_interval=20, replay_ratio=0).learn(100).n_resets == 4


def test_a_reset_makes_heads_anew_and_shrinks_the_rest() -> None:
    model = tiny(network="bronet", shrink=0.8).learn(40)
    before, buffer = parameters(model), copy.deepcopy(model.replay_buffer.state_dict())
    torch.manual_seed(7)
    draws = [model.policy.make_network().state_dict() for _ in range(2)]
    torch.manual_seed(7)
    model.learner.reset(0.8)
    after = parameters(model)
    for network, draw in zip(("q_net", "q_net_target"), draws, strict=True):
        for name, fresh in draw.items():
            now, old = after[f"{network}.{name}"], before[f"{network}.{name}"]
            if name.partition(".")[0] in FRESH:
                assert torch.equal(now, fresh), name
            else:
                expected = 0.8 * old.double() + (1 - 0.8) * fresh.double()
                ulp = torch.finfo(torch.float32).eps * (0.8 * old.abs() + 0.2 * fresh.abs())
                assert ((now.double() - expected).abs() <= ulp).all(), name
    assert not torch.equal(draws[0]["head.advantage.weight"], draws[1]["head.advantage.weight"])
    # All of Adam starts anew, the encoder's too; replay and priorities stay.
    assert len(model.policy.optimizer.state) == 0
    now_in_buffer = model.replay_buffer.state_dict()
    assert all(np.array_equal(now_in_buffer[key], value) for key, value in buffer.items())
    model.train(2)


def test_a_reset_leaves_a_frozen_encoder_and_its_target() -> None:
    model = tiny().learn(40)
    model.policy.q_net.encoder.requires_grad_(False)
    before = parameters(model)
    model.learner.reset(0.8)
    for name, now in parameters(model).items():
        kept = name.partition(".")[2].startswith("encoder.")
        assert torch.equal(now, before[name]) == kept, name


@pytest.mark.slow
def test_it_learns_the_small_world() -> None:
    torch.manual_seed(0)
    model = tiny(learning_rate=3e-3, learning_starts=60, replay_ratio=2, batch_size=16, gamma=0.5, tau=0.05,
                 policy_kwargs={"channels": (8, 8, 8), "width": 32}, v_min=-2.0, v_max=2.0).learn(260)  # fmt: skip
    env, right = Frames(), 0
    for seed in range(60):
        observation, _ = env.reset(seed=1000 + seed)
        right += int(model.predict(observation, deterministic=True)[0]) == 1 + env.right
    assert right > 45  # of 60; at random 20


def test_noisy_layers_are_silent_in_evaluation() -> None:
    model = tiny(noisy=True).learn(40)
    observation = Frames().reset(seed=0)[0]
    layers = list(model.policy.q_net_target.noisy_layers())
    assert len(layers) == 3 and all((layer.noise_in != 0).any() for layer in layers)
    first = [model.predict(observation, deterministic=True)[0] for _ in range(3)]
    assert len(set(map(int, first))) == 1 and all((layer.noise_in == 0).all() for layer in layers)


def test_the_policy_alone_is_silent_and_training_is_not() -> None:
    model = noisy()
    observations = np.stack([Frames().reset(seed=seed)[0] for seed in range(40)])
    expected = model.predict(observations, deterministic=True)[0]
    model._last_obs = observations
    explored = set()
    for _ in range(10):
        explored.add(tuple(model._sample_action(0)[0]))
        assert np.array_equal(model.policy.predict(observations)[0], expected)
    assert len(explored) > 3


@pytest.mark.slow
def test_noisy_layers_are_silent_in_exported_files(tmp_path: Path) -> None:
    pytest.importorskip("onnxscript")
    model = noisy()
    observations = np.stack([Frames().reset(seed=seed)[0] for seed in range(40)])
    expected = model.predict(observations, deterministic=True)[0]
    model._last_obs = observations
    # Until the noise shows.
    while np.array_equal(model._sample_action(0)[0], expected):
        pass
    _, script = model.export(tmp_path / "policy")
    assert np.array_equal(torch.jit.load(script)(torch.as_tensor(observations)).numpy(), expected)


def noisy() -> SRSPR:
    """A model without random actions, whose noise is loud."""
    model = tiny(noisy=True, exploration_initial_eps=0.0, exploration_final_eps=0.0).learn(40)
    with torch.no_grad():
        for layer in model.policy.q_net_target.noisy_layers():
            layer.weight_scale.fill_(2.0)
            layer.bias_scale.fill_(2.0)
    return model


# ---------------------------------------------------------------- ways to run, files


@COMPILES
@pytest.mark.slow
@pytest.mark.parametrize("kwargs", [{"network": "bronet", "noisy": True}, {"network": "bronet_after_projection"}])
def test_compiled_is_eager(kwargs: dict[str, Any]) -> None:
    """The same windows, noise and draws of noisy layers, across a reset; the regular network: test_execution.py."""
    model, compiled = pair("SRSPR", compile=True, **kwargs)
    for seed in range(2):
        for each in (model, compiled):
            updates(each, 5, seed)
            torch.manual_seed(9)
            each.learner.reset(0.5)
    assert compiled.learner._execution.compiled and compiled.learner.seconds_compiling > 0
    assert largest_difference(model, compiled) < 10 * TOLERANCE  # convolutions: test_execution.py


def test_captured_survives_a_reset() -> None:
    models = [tiny(learning_starts=20, compile=False) for _ in range(2)]
    recorder = captured(models[1])
    for model in models:
        model.set_random_seed(0)
        model.learn(30)
        model.learner.reset(0.5)
        model.learn(5, reset_num_timesteps=False)
    assert recorder.n_repetitions == 2 * 15 - 3 and recorder.n_recordings == 2
    first, second = map(parameters, models)
    for name in first:
        # Learning rates are float32 there.
        assert torch.allclose(first[name], second[name], atol=3e-5), name


@pytest.mark.parametrize("kwargs", [{"network": "bronet", "reset_interval": 20}, {"noisy": True}])
def test_saved_and_loaded(kwargs: dict[str, Any], tmp_path: Path) -> None:
    model = tiny(**kwargs).learn(50)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = SRSPR.load(tmp_path / "model", Frames(), device="cpu")
    assert same(parameters(model), parameters(loaded)) and loaded.n_resets == model.n_resets
    assert (loaded.num_transitions, loaded._n_updates, loaded.n_steps) == (50, model._n_updates, 3)
    loaded.load_replay_buffer(tmp_path / "buffer")
    for each in (model, loaded):
        each.set_random_seed(3)
        each.train(3)
    assert same(parameters(model), parameters(loaded))
    other = SRSPR.load(tmp_path / "model", device="cpu", spr_weight=1.0)
    assert other.spr_weight == 1 and other.env is None
    observations = np.stack([Frames().reset(seed=seed)[0] for seed in range(5)])
    expected = model.predict(observations, deterministic=True)[0]
    assert np.array_equal(other.predict(observations, deterministic=True)[0], expected)


class Stop(BaseCallback):
    """Ends a run as Ctrl-C does."""

    def __init__(self, at: int):
        super().__init__()
        self.at = at

    def _on_step(self) -> bool:
        if self.num_timesteps == self.at:
            raise KeyboardInterrupt
        return True


@pytest.mark.parametrize("at", [pytest.param(33, marks=pytest.mark.slow), 52])
def test_a_run_that_goes_on_ends_as_one_without_interruption(at: int, tmp_path: Path) -> None:
    """Also after a reset, which it does not repeat, and with a buffer that is full."""
    kwargs: dict[str, Any] = {"reset_interval": 25, "learning_starts": 15, "buffer_size": 50}
    whole = tiny(venv(1), **kwargs).learn(80, Stop(-1), checkpoint=tmp_path / "whole", checkpoint_freq=10)
    with pytest.raises(KeyboardInterrupt):
        tiny(venv(1), **kwargs).learn(80, Stop(at), checkpoint=tmp_path / "run", checkpoint_freq=10)
    resumed = tiny(venv(1), **kwargs).learn(80, Stop(-1), checkpoint=tmp_path / "run", checkpoint_freq=10)
    assert resumed.n_resets == whole.n_resets == 2 and resumed._n_updates == whole._n_updates
    assert same(parameters(whole), parameters(resumed))
    first, second = whole.replay_buffer, resumed.replay_buffer
    assert np.array_equal(np.asarray(first.observations), np.asarray(second.observations))
    assert np.array_equal(first.weights.priority, second.weights.priority)


# ---------------------------------------------------------------- errors


def boxed(shape: tuple[int, ...], dtype: Any = np.uint8, high: float = 255, actions: Any = None) -> gym.Env:
    env = Frames()
    env.observation_space = spaces.Box(0, high, shape, dtype)
    if actions is not None:
        env.action_space = actions
    return env


@pytest.mark.parametrize(
    ("env", "match"),
    [
        (boxed((7,), np.float32, 1), "stacks of frames, uint8"),
        (boxed((4, 12, 12), np.float32, 1), "stacks of frames, uint8"),
        (boxed((3, 4, 12, 12)), "stacks of frames, uint8"),
        (boxed((3, 12, 12)), "frame_stack=4 frames"),
        (boxed((4, 5, 12)), "at least 8 pixels|frame_stack"),
        (boxed((4, 12, 12), actions=spaces.Box(-1, 1, (2,))), "Discrete actions"),
        (boxed((4, 12, 12), actions=spaces.Discrete(3, start=1)), "Discrete actions"),
    ],
)
def test_environments_that_it_is_not_for(env: gym.Env, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        tiny(env)


def test_dict_observations_are_refused() -> None:
    env: Any = Frames()
    env.observation_space = spaces.Dict({"picture": env.observation_space})
    with pytest.raises(ValueError, match="stacks of frames"):
        tiny(env)


def test_channels_last_are_turned_and_single_pictures_are_told_how_to_be_stacked() -> None:
    class Single(Frames):
        def __init__(self) -> None:
            super().__init__()
            self.observation_space = spaces.Box(0, 255, (SIZE, SIZE, 1), np.uint8)

        def _see(self) -> np.ndarray:
            return super()._see()[-1][..., None]

    model = tiny(VecFrameStack(DummyVecEnv([Single]), 4)).learn(35)
    assert model.observation_space.shape == (4, SIZE, SIZE) and model._n_updates == 10
    with pytest.raises(ValueError, match="VecFrameStack|frame_stack"):
        tiny(Single())


@pytest.mark.parametrize(
    ("kwargs", "match"),
    [
        ({"network": "impala"}, r"network must be one of \['nature', 'bronet', 'bronet_after_projection'\], not"),
        ({"n_steps": 0}, "n_steps must be an integer of at least 1, not 0"),
        ({"n_predictions": 0}, "n_predictions must be"),
        ({"shrink": 1.5}, r"shrink must lie in \[0, 1\], not 1.5"),
        ({"reset_interval": 0}, "reset_interval must be"),
        ({"v_min": 3.0, "v_max": 3.0}, "v_min must be below v_max"),
        ({"n_atoms": 1}, "n_atoms must be"),
        ({"spr_weight": -1}, "spr_weight must be"),
        ({"exploration_steps": -1}, "exploration_steps must be"),
        ({"frame_stack": 3}, "frame_stack=3"),
        ({"buffer_size": 7}, "buffer_size must be at least 8"),
        ({"compile": "yes"}, "compile must be"),
        ({"replay_buffer_kwargs": {"horizon": 3}}, "horizon"),
        ({"replay_buffer_kwargs": {"fade": 0.99}}, "replay_buffer_kwargs has .'fade'.*leave them out"),
        ({"replay_buffer_kwargs": {"priority_exponent": 0.4}}, "replay_buffer_kwargs has .'priority_exponent'"),
        ({"policy_kwargs": {"channels": (1, 2)}}, "channels"),
        ({"policy_kwargs": {"features_extractor_class": None}}, "features_extractor_class"),
        ({"policy_kwargs": {"net_arch": [3]}}, "net_arch"),
        ({"replay_ratio": -1}, "replay_ratio must be"),
    ],
)
def test_arguments_out_of_range(kwargs: dict[str, Any], match: str) -> None:
    if "policy_kwargs" in kwargs:
        kwargs = {"policy_kwargs": {**TINY, **kwargs["policy_kwargs"]}}
    with pytest.raises(ValueError, match=match):
        tiny(**kwargs)


@pytest.mark.parametrize(
    ("kwargs", "where"),
    [
        ({"n_atoms": 21}, r"policy\.q_net\.head\..* has the shape \(51, 8\) in the file and \(21, 8\) here"),
        ({"network": "bronet"}, r"policy\..* (here and not in the file|in the file and not here)"),
        ({"noisy": True}, r"policy\.q_net\.head\..* (here and not in the file|in the file and not here)"),
    ],
)
def test_a_file_of_other_networks_is_not_called_damaged(kwargs: dict[str, Any], where: str, tmp_path: Path) -> None:
    tiny().save(tmp_path / "model")
    (name,) = kwargs
    with pytest.raises(ValueError, match=f"^{name}: with these arguments the model has other networks .*{where}"):
        SRSPR.load(tmp_path / "model", **kwargs)


def test_other_arguments_of_the_optimizer_leave_the_published_epsilon() -> None:
    model = tiny(policy_kwargs={**TINY, "optimizer_kwargs": {"weight_decay": 0.1}})
    (group,) = model.policy.optimizer.param_groups
    assert group["eps"] == 1.5e-4 and group["weight_decay"] == 0.1


def test_other_policies_and_a_training_that_is_too_short() -> None:
    with pytest.raises(ValueError, match="policy must be one of \\['CnnPolicy'\\]"):
        SRSPR("MlpPolicy", Frames())
    with pytest.raises(TypeError, match="Did you mean 'spr_weight'"):
        SRSPR("CnnPolicy", Frames(), spr_wait=3)  # type: ignore[call-arg]
    with pytest.warns(UserWarning, match="without a single gradient step: learning_starts=30"):
        tiny().learn(20)
    with pytest.warns(UserWarning, match="a window .* needs 3 decisions of an episode, and one more"):
        tiny(Frames(length=3, terminates=False)).learn(60)
    model = tiny(Frames(length=4, terminates=False)).learn(60)
    assert model._n_updates > 0
