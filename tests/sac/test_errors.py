"""Every wrong argument is a ValueError where it comes in; nothing that is not finite reaches the buffer."""

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_sample import CompactNStepReplayBuffer, DeviceReplayBuffer, FadedReplayBuffer, WindowReplayBuffer
from sb3_sample.sac import BRO, BROTD3, DAC, GPLSAC, OAC, SAC, TOPSAC, VPLSAC, RegularizedSAC
from tests.sac.common import MAKERS, WRONG_ARGUMENTS, WRONG_ARGUMENTS_OF_LEARN, Toy, bro, sac, vec

NAN, INF = float("nan"), float("inf")


def refused(make: Callable[[], Any], *words: Any) -> None:
    """It raises a ValueError whose message holds every word."""
    with pytest.raises(ValueError) as caught:
        make()
    message = str(caught.value)
    for word in words:
        assert re.search(str(word), message), f"{word!r} is not in: {message}"


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("replay_ratio", -1, "at least 0"),
        ("replay_ratio", NAN, "at least 0"),
        ("replay_ratio", INF, ""),
        ("replay_ratio", "10", "at least 0"),
        ("tau", 0.0, r"\(0, 1\]"),
        ("tau", 1.5, r"\(0, 1\]"),
        ("tau", -0.1, r"\(0, 1\]"),
        ("tau", NAN, r"\(0, 1\]"),
        ("gamma", -0.1, r"\[0, 1\]"),
        ("gamma", 1.01, r"\[0, 1\]"),
        ("gamma", NAN, r"\[0, 1\]"),
        ("batch_size", 0, "at least 1"),
        ("batch_size", -3, "at least 1"),
        ("learning_starts", -1, "at least 0"),
        ("buffer_size", 0, "at least 1"),
        ("target_update_interval", 0, "at least 1"),
        ("n_steps", 0, "at least 1"),
        ("n_quantiles", 0, "at least 1"),
        ("n_quantiles", -5, "at least 1"),
        ("pessimism", -1.0, "at least 0"),
        ("ent_coef", "foo", "auto"),
        ("ent_coef", "auto_-1", "auto|above 0"),
        ("ent_coef", "auto_0", "auto|above 0"),
        ("ent_coef", "auto_foo", "auto"),
        ("ent_coef", "auto_nan", "auto"),
        ("ent_coef", "auto_inf", "auto"),
        ("ent_coef", -0.1, "at least 0"),
        ("ent_coef", NAN, "at least 0"),
        ("ent_coef", INF, ""),
        ("target_entropy", "foo", "auto"),
        ("target_entropy", NAN, ""),
        ("exploration", "foo", "optimistic_shift"),
        ("exploration", "sde", "actor"),
        ("resets", (20, 10), "ascending"),
        ("resets", (-5,), "at least 1"),
        ("train_freq", 0, ""),
        ("train_freq", -3, ""),
        ("train_freq", (1, "foo"), "episode"),
        ("learning_rate", -1e-3, ""),
        ("learning_rate", NAN, ""),
        ("learning_rate", "lin", "schedule"),
    ],
)
@pytest.mark.parametrize("maker", ["SAC", "BRO"])
def test_values_out_of_range(maker: str, name: str, value: Any, allowed: str) -> None:
    """Caught at construction, with the argument's name, the value, and what is allowed."""
    value_in_message = re.escape(str(value)) if not isinstance(value, tuple) else re.escape(str(value[-1]))
    refused(lambda: MAKERS[maker](**{name: value}), name, value_in_message, allowed)


@pytest.mark.parametrize("maker", ["SAC", "BRO"])
@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *WRONG_ARGUMENTS,
        ("buffer_size", 1e6, "buffer_size must be an integer of at least 1, not 1000000.0"),
        ("learning_starts", 100.0, "learning_starts must be an integer of at least 0, not 100.0"),
        ("learning_starts", "100", "learning_starts must be an integer of at least 0, not '100'"),
        ("tau", "0.1", r"tau must lie in \(0, 1\], not '0.1'"),
        ("gradient_steps", -2, "gradient_steps must be an integer of at least 0, or -1 for .*, not -2"),
        ("gradient_steps", 1.5, "gradient_steps must be .*, not 1.5"),
        ("train_freq", "1", "train_freq must be .*, not '1'"),
        ("action_noise", 0.1, "action_noise must be of ActionNoise, or None, not 0.1"),
        (
            "replay_buffer_class",
            dict,
            "replay_buffer_class must be ReplayBuffer or derived from it, or None, not <class",
        ),
        ("replay_buffer_class", "her", "replay_buffer_class must be .*, not 'her'"),
        ("replay_buffer_class", HerReplayBuffer, r"replay_buffer_class=HerReplayBuffer needs a Dict .* not Box\("),
        ("replay_buffer_kwargs", [1], r"replay_buffer_kwargs must be a dict, or None, not \[1\]"),
        ("target_update_interval", 1.5, "target_update_interval must be an integer of at least 1, or None .*, not 1.5"),
        ("replay_ratio", [1], r"replay_ratio must be at least 0 and finite, .*, not \[1\]"),
        ("n_quantiles", 2.5, "n_quantiles must be an integer of at least 1, or None for scalar critics, not 2.5"),
        ("pessimism", [1], r"pessimism must be .*, not \[1\]"),
        ("pessimism_kwargs", 3, "pessimism_kwargs must be a dict, or None, not 3"),
        ("target_subset", "2", "target_subset must lie between 1 and .* not '2'"),
        ("validation_proportion", "0.1", r"validation_proportion must lie in \[0, 1\), not '0.1'"),
        ("exploration", ["actor"], r"exploration must be one of .*, not \['actor'\]"),
        ("policy_delay", 1.5, "policy_delay must be an integer of at least 1, not 1.5"),
        ("reset_shrink", "0.1", r"reset_shrink must lie in \[0, 1\), not '0.1'"),
        ("redo_period", 1.5, "redo_period must be an integer of at least 1, or None for no recycling, not 1.5"),
        ("redo_threshold", "0.1", "redo_threshold must be at least 0, not '0.1'"),
        ("sam_radius", "0.1", "sam_radius must be above 0 and finite, or None for no SAM, not '0.1'"),
        ("policy_kwargs", {"n_critics": 2.5}, "n_critics must be an integer of at least 1, not 2.5"),
        ("policy_kwargs", {"net_arch": {"pi": [8], "vf": [8]}}, "net_arch must be .*'qf' for the critic, not .*'vf'"),
        ("backbone", ["td3"], r"backbone must be one of .*, not \['td3'\]"),
        ("compile", 1, "compile must be True, False or 'auto', not 1"),
    ],
)
def test_arguments_of_another_kind(maker: str, name: str, value: Any, words: str) -> None:
    # Networks of its own, which BRO takes with model_size=None.
    mlp = {"critic_network": "mlp", "actor_network": "mlp"} if maker == "BRO" else {}
    if name == "policy_kwargs" and isinstance(value, dict) and mlp:
        refused(lambda: MAKERS[maker](model_size=None, policy_kwargs={**mlp, **value}), words)
    else:
        refused(lambda: MAKERS[maker](**{name: value}), words)


@pytest.mark.parametrize(("kwargs", "words"), WRONG_ARGUMENTS_OF_LEARN)
def test_arguments_of_learn(kwargs: dict[str, Any], words: str) -> None:
    model = sac()
    refused(lambda: model.learn(**{"total_timesteps": 10, **kwargs}), words)
    assert model.num_timesteps == 0


def test_buffers_of_other_observations() -> None:
    refused(lambda: sac(vec(obs_space=OBS_DICT), policy="MultiInputPolicy", replay_buffer_class=ReplayBuffer),
            "replay_buffer_class=ReplayBuffer cannot hold the observations of Dict")  # fmt: skip
    refused(lambda: sac(vec(obs_space=OBS_DICT), policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer),
            "replay_buffer_class=HerReplayBuffer needs an observation space with .*'desired_goal'")  # fmt: skip
    refused(lambda: sac(vec(obs_space=OBS_DICT), policy="MultiInputPolicy", n_steps=3), "n_steps=3 is not supported")


def test_another_number_of_environments() -> None:
    model = sac(vec(2))
    for env in (vec(3), Toy()):
        refused(lambda env=env: model.set_env(env), r"env has [13] environments, .* made with, 2: use SAC.load")
    model.set_env(vec(2))


def test_numbers_of_numpy_will_do(tmp_path: Path) -> None:
    """As in Stable-Baselines3, and in places where it does not take them; a file has Python's numbers."""
    model = sac(
        seed=np.int64(3), batch_size=np.int64(8), buffer_size=np.int32(100), learning_starts=np.int64(5),
        learning_rate=np.float32(1e-3), gamma=np.float32(0.9), tau=np.float64(0.01), n_quantiles=np.int64(3),
        replay_ratio=np.float32(0.5), verbose=np.int64(0), stats_window_size=np.int64(5),
    )  # fmt: skip
    assert model.learn(np.int64(20)).num_timesteps == 20
    assert model.learn(20.0).num_timesteps == 20
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec())
    assert (loaded.seed, loaded.buffer_size, type(loaded.gamma)) == (3, 100, float)


def test_a_schedule_is_asked_for_its_first_value() -> None:
    words = (
        "^learning_rate must be a function of the remaining progress, from 1 to 0, that returns a number, but at 1.0"
    )
    refused(
        lambda: sac(learning_rate=lambda: 1e-3), words, "TypeError: .* takes 0 positional arguments but 1 was given"
    )
    refused(lambda: sac(learning_rate=lambda progress: None), words, "TypeError: float")
    refused(lambda: sac(learning_rate=dict), words)
    refused(
        lambda: sac(learning_rate=lambda progress: -progress), "^learning_rate, .*, at the begin must be at least 0"
    )
    refused(lambda: sac(learning_rate=lambda progress: NAN), "^learning_rate, .*, at the begin must be .* not nan")
    assert sac(learning_rate=lambda progress: np.float32(1e-3) * progress).lr_schedule(0.5) == pytest.approx(5e-4)


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        ({"device": "gpu"}, "^device must be .*, not 'gpu'"),
        ({"verbose": "info"}, "^verbose must be .*, not 'info'"),
        ({"learning_rate": lambda: 3e-4}, "^learning_rate must be a function of the remaining progress"),
        ({"learning_rate": "3e-4"}, "^learning_rate must be .*, not '3e-4'"),
        ({"buffer_size": 1e6}, "^buffer_size must be .*, not 1000000.0"),
        ({"action_noise": 0.1}, "^action_noise must be .*, not 0.1"),
        ({"stats_window_size": 0}, "^stats_window_size must be an integer of at least 1, not 0"),
        ({"policy": TD3Policy}, "^policy must be one of .*, not stable_baselines3.td3.policies.TD3Policy"),
        ({"policy_kwargs": {"net_arch": [9], "n_critics": 3}}, r"^policy_kwargs must be those of the file.*; in the "
         r"file, net_arch is \[8, 8\] and here \[9\]; n_critics is not there and here 3$"),
        ({"policy_kwargs": None}, r"in the file, net_arch is \[8, 8\] and here left out$"),
        ({"policy_kwargs": [8]}, r"^policy_kwargs must be those of the file, or be left out, not \[8\]"),
    ],
)  # fmt: skip
def test_arguments_of_another_kind_to_load(kwargs: dict[str, Any], words: str, tmp_path: Path) -> None:
    sac().save(tmp_path / "m")
    refused(lambda: SAC.load(tmp_path / "m", env=vec(), **kwargs), words)


def test_load_with_another_window(tmp_path: Path) -> None:
    sac().save(tmp_path / "m")
    model = SAC.load(tmp_path / "m", env=vec(), stats_window_size=3).learn(40)
    assert model.ep_info_buffer.maxlen == 3


@pytest.mark.parametrize(("made", "loaded"), [("SAC", BRO), ("BRO", SAC), ("SAC", BROTD3)])
def test_files_of_another_class(made: str, loaded: Any, tmp_path: Path) -> None:
    MAKERS[made]().save(tmp_path / "m")
    words = f"holds a model of {made}, not of {loaded.__name__}: load it with {made}.load"
    refused(lambda: loaded.load(tmp_path / "m"), words)
    refused(lambda: loaded.load(tmp_path / "m", env=vec(), learning_rate=1e-3), words)


def test_a_run_of_another_class(tmp_path: Path) -> None:
    sac().learn(20, checkpoint=tmp_path)
    refused(lambda: bro().learn(20, checkpoint=tmp_path), "^class='.*BRO': .* was made with class='.*SAC'")


# ---------------------------------------------------------------- a training without a gradient step


class Stops(BaseCallback):
    def _on_step(self) -> bool:
        return self.num_timesteps < 5


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_training_within_the_warm_up_says_so(n_envs: int, tmp_path: Path) -> None:
    words = "learning_starts=20 transitions come before the first, .* has {0} of the {0} of this model's life.* pass a "
    with pytest.warns(UserWarning, match=words.format(10)) as caught:
        sac(vec(n_envs), learning_starts=20).learn(10).save(tmp_path / "m")
    assert len(caught) == 1 and caught[0].filename == __file__
    model = SAC.load(tmp_path / "m", env=vec(n_envs))
    with pytest.warns(UserWarning, match="has 6 of the 16 of"):
        model.learn(6)
    # Its buffer is not in the file, and is filled first.
    with pytest.warns(UserWarning, match="has 18 of the 28 of"):
        model.learn(12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert model.learn(12)._n_updates > 0


@pytest.mark.parametrize(
    ("kwargs", "learn"),
    [
        ({}, {"total_timesteps": 0}),
        ({"replay_ratio": 0}, {}),
        ({"gradient_steps": 0, "replay_ratio": None}, {}),
        ({}, {"callback": Stops()}),
        ({"learning_starts": 9}, {}),
        ({"learning_starts": 0, "replay_ratio": 0.01}, {}),
    ],
)
def test_a_training_without_gradient_steps_that_is_meant(kwargs: dict[str, Any], learn: dict[str, Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sac(**{"learning_starts": 20, **kwargs}).learn(**{"total_timesteps": 10, **learn})


@pytest.mark.parametrize(
    ("kwargs", "words"),
    [
        (dict(model_size="5M"), ["model_size", "5M", "4.92M", "blocks"]),
        (dict(model_size=(1,)), ["model_size", r"\(1,\)", "blocks"]),
        (dict(model_size=(1, 2, 3)), ["model_size"]),
        (dict(model_size=(1.5, 8)), ["model_size", "1.5"]),
        (dict(model_size=(-1, 8)), ["n_blocks|model_size", "-1"]),
        (dict(model_size=(1, 0)), ["width|model_size", "0"]),
        (dict(model_size=5), ["model_size", "5"]),
        (dict(policy_kwargs={"critic_network_kwargs": {"width": 8}}), ["model_size", "critic_network_kwargs", "None"]),
        (dict(policy_kwargs={"critic_network": "mlp"}), ["model_size", "critic_network", "None"]),
        (dict(policy_kwargs={"net_arch": [8]}), ["net_arch", "bronet", "network_kwargs"]),
        (dict(policy_kwargs={"n_quantiles": 3}), ["n_quantiles", "policy_kwargs"]),
        (dict(policy_kwargs={"optimizer_kwargs": {"weight_decay": 0.1}}), ["weight_decay"]),
        (dict(weight_decay=-1.0), ["weight_decay", "-1.0"]),
        (dict(kl_target=0.0), ["kl_target", "0"]),
        (dict(std_multiplier=-1.0), ["std_multiplier", "-1"]),
        *(
            ({name: "1"}, [f"{name} must .*, not '1'"])
            for name in (
                "weight_decay",
                "kl_target",
                "std_multiplier",
                "initial_optimism",
                "initial_kl_weight",
                "adjustment_learning_rate",
            )
        ),
    ],
)
def test_bro_arguments(kwargs: dict[str, Any], words: list[str]) -> None:
    refused(lambda: bro(**kwargs), *words)


@pytest.mark.parametrize(
    ("policy_kwargs", "words"),
    [
        ({"critic_network": "foo"}, ["critic_network", "foo", "bronet"]),
        ({"actor_network": "foo"}, ["actor_network", "foo", "mlp"]),
        ({"actor_network": ["mlp"]}, ["actor_network", r"\['mlp'\]", "bronet"]),
        ({"critic_network_kwargs": [1]}, [r"critic_network_kwargs must be a dict, or None, not \[1\]"]),
        ({"actor_kwargs": 3}, ["actor_kwargs must be a dict, or None, not 3"]),
        ({"critic_optimizer_kwargs": 3}, ["critic_optimizer_kwargs must be a dict, or None, not 3"]),
        ({"n_critics": 0}, ["n_critics", "0", "at least 1"]),
        ({"net_arch": [8, 0]}, ["hidden_sizes|net_arch", "0"]),
        ({"net_arch": [8], "critic_network": "bronet"}, ["net_arch", "bronet"]),
        ({"net_arch": [8], "critic_network_kwargs": {"hidden_sizes": [9]}}, ["net_arch", "hidden_sizes"]),
    ],
)
def test_policy_arguments(policy_kwargs: dict[str, Any], words: list[str]) -> None:
    refused(lambda: sac(policy_kwargs=policy_kwargs), *words)


@pytest.mark.parametrize(
    ("maker", "name"),
    [
        *(("DAC", name) for name in ("kl_target", "initial_optimism", "initial_kl_weight", "reinitialize_every")),
        *(("OAC", name) for name in ("optimism", "kl_radius")),
        *(("BROTD3", name) for name in ("exploration_noise", "target_noise", "target_noise_clip")),
        *(("RegularizedSAC", name) for name in ("weight_decay", "network_regularization", "pessimism_kwargs")),
        *((name, "policy_kwargs") for name in MAKERS),
    ],
)
def test_arguments_of_one_class_of_another_kind(maker: str, name: str) -> None:
    refused(lambda: MAKERS[maker](**{name: [1]}), rf"{name} must .*, not \[1\]")


def test_no_environment(tmp_path: Path) -> None:
    without = "env: the model was made or loaded without one: pass env= to it, or call set_env"
    refused(lambda: SAC("MlpPolicy", None).learn(10), without)
    refused(lambda: SAC("MlpPolicy", 1), "env must be an environment, .* not 1")
    sac().save(tmp_path / "m")
    refused(lambda: SAC.load(tmp_path / "m", env=1), "env must be an environment, .* not 1")
    refused(lambda: SAC.load(tmp_path / "m").learn(10), without)


def test_use_sde() -> None:
    for make in MAKERS.values():
        refused(lambda make=make: make(use_sde=True), "use_sde", "True", "action_noise|exploration")


def test_wrong_policy() -> None:
    dict_env = Toy(spaces.Dict({"a": spaces.Box(-1, 1, (2,))}))
    refused(lambda: sac(dict_env, policy="MlpPolicy"), "MultiInputPolicy")


def test_episodes_of_several_environments() -> None:
    """Stable-Baselines3 trains by episodes with one environment only: known at construction."""
    refused(lambda: sac(vec(2), train_freq=(1, "episode")), "train_freq", "episode")


# ---------------------------------------------------------------- action spaces


@pytest.mark.parametrize(
    ("space", "words"),
    [
        (spaces.Discrete(3), ["action space", "Box", r"Discrete\(3\)"]),
        (spaces.MultiBinary(3), ["action space", "Box", "MultiBinary"]),
        (spaces.MultiDiscrete([2, 3]), ["action space", "Box", "MultiDiscrete"]),
        (spaces.Box(-INF, INF, (2,)), ["action space", "bound", "inf"]),
        (spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, INF], np.float32)), ["action space", "bound"]),
    ],
)
def test_action_spaces(space: spaces.Space, words: list[str]) -> None:
    for env in (Toy(action_space=space), vec(2, action_space=space)):
        refused(lambda env=env: sac(env), *words)
        refused(lambda env=env: bro(env), *words)


def test_action_space_without_width() -> None:
    """Such a dimension cannot be scaled to [-1, 1]: every stored action would be NaN."""
    space = spaces.Box(np.array([-1.0, 2.0], np.float32), np.array([1.0, 2.0], np.float32))
    refused(lambda: sac(Toy(action_space=space)), "action space", "2")


# ---------------------------------------------------------------- observations and rewards that are not finite

OBS_DICT = spaces.Dict({"a": spaces.Box(-10, 10, (3,), np.float32), "b": spaces.Box(-10, 10, (2,), np.float32)})


def poison(at: int, what: str, value: float) -> Callable[[int, Any, float], tuple[Any, float]]:
    """Spoil observation or reward at one step of an environment's life."""

    def spoil(total: int, observation: Any, reward: float) -> tuple[Any, float]:
        if total != at:
            return observation, reward
        if what == "reward":
            return observation, value
        bad = observation["b"] if isinstance(observation, dict) else observation
        bad[1] = value
        return observation, reward

    return spoil


def buffer_is_finite(model: SAC) -> bool:
    buffer = model.replay_buffer
    arrays = []
    for name in ("observations", "next_observations", "actions", "rewards"):
        value = getattr(buffer, name)
        arrays += list(value.values()) if isinstance(value, dict) else [value]
    return all(np.isfinite(array).all() for array in arrays)


def spoilt_env(n_envs: int, index: int, at: int, what: str, value: float, obs_space: Any = None) -> Any:
    env = vec(n_envs, obs_space=obs_space)
    env.envs[index].unwrapped.poison = poison(at, what, value)
    return env


# Episodes of seven steps: 7 and 21 are last steps, whose observation is the terminal one.
@pytest.mark.parametrize("at", [3, 7, 16, 21])
@pytest.mark.parametrize(("what", "value"), [("observation", NAN), ("observation", -INF), ("reward", NAN),
                                             ("reward", INF)])  # fmt: skip
@pytest.mark.parametrize(("n_envs", "index"), [(1, 0), (3, 2)])
@pytest.mark.parametrize("normalized", [False, True])
@pytest.mark.parametrize("obs_space", [None, OBS_DICT], ids=["box", "dict"])
def test_training_stops(
    n_envs: int, index: int, at: int, what: str, value: float, normalized: bool, obs_space: Any
) -> None:
    env = spoilt_env(n_envs, index, at, what, value, obs_space)
    if normalized:
        env = VecNormalize(env)
    model = bro(env, policy="MlpPolicy" if obs_space is None else "MultiInputPolicy", replay_ratio=0.2)
    with pytest.raises(ValueError) as caught:
        model.learn(120)
    message = str(caught.value)
    assert f"environment {index} " in message, message
    assert re.search(rf"\bstep {at}\b", message), message
    assert what in message and "not finite" in message, message
    if obs_space is not None and what == "observation":
        assert "'b'" in message, message
    assert buffer_is_finite(model)
    assert model.num_transitions == (at - 1) * n_envs
    if normalized:
        statistics = env.obs_rms.values() if isinstance(env.obs_rms, dict) else [env.obs_rms]
        assert all(np.isfinite(s.mean).all() and np.isfinite(s.var).all() for s in [*statistics, env.ret_rms])
    assert all(np.isfinite(p.detach().numpy()).all() for p in model.policy.parameters())


@pytest.mark.parametrize("normalized", [False, True])
def test_first_observation(normalized: bool) -> None:
    class Bad(Toy):
        def reset(self, **kwargs: Any) -> Any:
            observation, info = super().reset(**kwargs)
            return observation * NAN, info

    env = vec(2)
    env.envs[1] = Bad()
    with pytest.raises(ValueError, match=r"environment 1 .*observation.*not finite.*reset"):
        bro(VecNormalize(env) if normalized else env).learn(20)


def test_observation_after_an_automatic_reset() -> None:
    """The first observation of a later episode comes with the last step of the one before."""

    class Bad(Toy):
        n_resets = 0

        def reset(self, **kwargs: Any) -> Any:
            observation, info = super().reset(**kwargs)
            self.n_resets += 1
            return observation * (NAN if self.n_resets == 2 else 1), info

    env = vec(2)
    env.envs[1] = Bad()
    model = bro(env)
    with pytest.raises(ValueError, match=r"environment 1 .*observation.*not finite"):
        model.learn(40)
    assert buffer_is_finite(model)


def test_environment_set_later() -> None:
    model = bro(vec(2))
    model.set_env(spoilt_env(2, 1, 5, "observation", NAN))
    with pytest.raises(ValueError, match=r"environment 1 .*step 5\b"):
        model.learn(40)


def test_infinite_bounds_are_not_infinite_values() -> None:
    space = spaces.Box(-INF, INF, (3,), np.float32)
    assert bro(vec(2, obs_space=space)).learn(30)._n_updates > 0
    assert isinstance(bro("Pendulum-v1").env.action_space, gym.spaces.Box)


@pytest.mark.parametrize(
    ("cls", "kwargs", "named"),
    [
        (DAC, {"exploration": "actor", "kl_target": 0.3}, "kl_target=0.3"),
        (DAC, {"exploration": "oac", "reinitialize_every": None}, "reinitialize_every=None"),
        (OAC, {"exploration": "actor", "optimism": 1.0}, "optimism=1.0"),
        (SAC, {"reset_shrink": 0.5}, "reset_shrink=0.5"),
        (SAC, {"redo_threshold": 0.1}, "redo_threshold=0.1"),
        (VPLSAC, {"pessimism": 1.0, "pessimism_learning_rate": 1.0}, "pessimism_learning_rate=1.0"),
    ],
)
def test_settings_that_would_do_nothing(cls: Any, kwargs: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=f"{named} means nothing with"):
        sac(cls=cls, **kwargs)


def test_settings_of_a_shift_that_is_not_there() -> None:
    with pytest.raises(ValueError, match="kl_target=0.3 means nothing with exploration='actor'"):
        bro(exploration="actor", exploration_kwargs=None, kl_target=0.3)
    # The default of the class itself is none that was given.
    assert bro(cls=BROTD3, exploration="actor", exploration_kwargs=None).std_multiplier == 1


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: sac(cls=DAC, kl_target=0.1, exploration_kwargs={"kl_target": 0.9}), "argument kl_target here"),
        (lambda: sac(cls=OAC, exploration_kwargs={"kl_radius": 0.9}), "argument kl_radius here"),
        (lambda: bro(exploration_kwargs={"kl_target": 0.9}), "argument kl_target here"),
        (lambda: sac(cls=GPLSAC, pessimism_kwargs={"learning_rate": 0.9}), "argument pessimism_learning_rate here"),
        (lambda: sac(cls=TOPSAC, pessimism_kwargs={"arms": (0, 2)}), "argument arms here"),
        (lambda: sac(cls=VPLSAC, pessimism_kwargs={"source": "replay"}), "argument pessimism_source here"),
        (
            lambda: bro(cls=BROTD3, policy_kwargs={"actor_kwargs": {"exploration_noise": 0.3}}),
            "argument exploration_noise here",
        ),
    ],
)
def test_the_same_setting_twice(make: Callable[[], Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        make()


@pytest.mark.parametrize(
    ("kwargs", "named"),
    [
        ({"network_regularization": "layer_norm", "critic_network_kwargs": {"layer_norm": False}}, "layer_norm"),
        ({"plasticity_regularization": "crelu", "critic_network_kwargs": {"activation_fn": nn.Tanh}}, "activation_fn"),
        ({"network_regularization": "weight_decay", "critic_optimizer_kwargs": {"weight_decay": 0}}, "weight_decay"),
        ({"network_regularization": "spectral_norm", "critic_network": "bronet"}, "critic_network='bronet'"),
    ],
)
def test_a_regularization_is_not_switched_off(kwargs: dict[str, Any], named: str) -> None:
    policy_kwargs = {key: kwargs.pop(key) for key in list(kwargs) if key.startswith("critic_")}
    with pytest.raises(ValueError, match=named):
        sac(cls=RegularizedSAC, policy_kwargs=policy_kwargs, **kwargs)


def test_exploration_by_the_spread_of_one_critic() -> None:
    with pytest.raises(ValueError, match="exploration='oac' .* pass n_critics=2, or another exploration"):
        MAKERS["SimBa"](n_critics=1, pessimism=0, exploration="oac")


@pytest.mark.parametrize("kwargs", [{"cls": GPLSAC}, {"cls": OAC}, {"pessimism": "top"}])
def test_no_spread_of_one_critic(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="n_critics=1"):
        sac(policy_kwargs={"net_arch": [8], "n_critics": 1}, **kwargs)


def test_pessimism_of_one_critic() -> None:
    """A number that would have no effect is refused, the class's own and 0 are not."""
    one: Any = {"net_arch": [8], "n_critics": 1}
    for name in "pessimism", "actor_pessimism":
        with pytest.raises(ValueError, match=f"{name}=0.5 weighs the critics' spread, which n_critics=1 has not"):
            sac(policy_kwargs=one, **{name: 0.5})
    sac(policy_kwargs=one, pessimism=0.0, actor_pessimism=0)
    with pytest.raises(ValueError, match="pessimism=0.5 weighs"):
        MAKERS["SimBa"](n_critics=1, pessimism=0.5)
    MAKERS["SimBa"](n_critics=1)


def test_no_spread_of_one_target() -> None:
    with pytest.raises(ValueError, match="target_subset=1 leaves none"):
        sac(pessimism="gpl", target_subset=1)


def test_dac_starts_above_the_bound_also_when_loaded(tmp_path: Path) -> None:
    sac(cls=DAC).learn(30).save(tmp_path / "m")
    with pytest.raises(ValueError, match="initial_optimism must be above"):
        DAC.load(tmp_path / "m", initial_optimism=-5.0)


def test_dac_starts_above_the_bound_of_every_arm() -> None:
    """Whichever arm the bandit draws first."""
    for seed in range(6):
        with pytest.raises(ValueError, match=r"initial_optimism must be above minus the pessimism, 0.0, not -0.5"):
            sac(cls=DAC, pessimism="top", initial_optimism=-0.5, seed=seed)
        model = sac(cls=DAC, pessimism="top", pessimism_kwargs={"arms": (0.6, 1.0)}, initial_optimism=-0.5, seed=seed)
        optimism = model.explorer.optimism_distance() - model.learner.pessimism_rule.beta()
        assert optimism.item() == pytest.approx(-0.5, abs=1e-6)


@pytest.mark.parametrize("cls", [DeviceReplayBuffer, CompactNStepReplayBuffer])
def test_buffers_of_single_observations(cls: Any) -> None:
    class Mine(cls):
        pass

    for each in (cls, Mine):
        with pytest.raises(
            ValueError, match=f"replay_buffer_class={each.__name__} cannot hold the observations of Dict"
        ):
            sac(vec(obs_space=OBS_DICT), policy="MultiInputPolicy", replay_buffer_class=each)


@pytest.mark.parametrize("cls", [WindowReplayBuffer, FadedReplayBuffer])
def test_returns_of_several_steps_need_a_buffer_that_makes_them(cls: Any) -> None:
    """Only DebiasedRQ draws windows."""
    with pytest.raises(
        ValueError, match=f"n_steps=3 needs a buffer that makes .* not replay_buffer_class={cls.__name__}"
    ):
        sac(n_steps=3, replay_buffer_class=cls)


def test_what_load_does_not_take(tmp_path: Path) -> None:
    sac().save(tmp_path / "m")
    with pytest.raises(ValueError, match="kwargs: not an argument"):
        SAC.load(tmp_path / "m", kwargs=1)
    with pytest.raises(ValueError, match="policy must be one of .*, not 1"):
        SAC.load(tmp_path / "m", policy=1)


def test_vpl_default_at_loading(tmp_path: Path) -> None:
    sac(cls=VPLSAC).save(tmp_path / "m")
    assert VPLSAC.load(tmp_path / "m", env=vec(), validation_proportion=None).validation_proportion == 1 / 32
    assert sac(cls=VPLSAC, pessimism_source="replay").validation_proportion == 0
