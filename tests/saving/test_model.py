"""Whole models in files that run no code: nothing is lost, nothing is unpickled, and nothing hostile gets far."""

import importlib
import io
import json
import os
import pickle
import time
import warnings
from pathlib import Path
from typing import Any

import cloudpickle
import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sample import BRO, MBMAPPO, BROFast
from sb3_sample.parts import Pessimism, argument
from sb3_sample.sac import DAC, SAC
from sb3_sample.saving import BadFile, container, load_vec_normalize, model_tree, save_vec_normalize
from sb3_sample.saving.container import PickledFile
from tests.agents import OFF_POLICY, env_of
from tests.ppo.common import ALGORITHMS, tiny
from tests.sac.common import REPRESENTATIVE, bro, differing, sac, sampled, state, vec

OBSERVATIONS = np.random.default_rng(0).normal(size=(16, 3)).astype(np.float32)
ON_POLICY = {cls.__name__: lambda cls=cls, **kwargs: tiny(cls, **kwargs) for cls in ALGORITHMS}
MAKE: dict[str, Any] = {**OFF_POLICY, **ON_POLICY}
SAMPLE = (*REPRESENTATIVE, "MBMAPPO", "SRSPR")


@pytest.fixture
def no_pickle(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever pickles or unpickles raises."""

    def raising(name: str, original: Any) -> Any:
        def touch(*args: Any, **kwargs: Any) -> Any:
            raise AssertionError(f"{name} was called")

        # A class stays one, for those who inherit from it.
        return type(original.__name__, (original,), {"__init__": touch}) if isinstance(original, type) else touch

    for module, names in {
        pickle: ("load", "loads", "dump", "dumps", "Pickler", "Unpickler", "_Pickler", "_Unpickler"),
        cloudpickle: ("load", "loads", "dump", "dumps"), torch: ("load", "save"),
        importlib.import_module("_pickle"): ("load", "loads", "dump", "dumps", "Pickler", "Unpickler"),
        importlib.import_module("torch.serialization"): ("load", "save"), np: ("load", "save"),
    }.items():  # fmt: skip
        for name in names:
            monkeypatch.setattr(module, name, raising(f"{module.__name__}.{name}", getattr(module, name)))


@pytest.mark.parametrize("maker", sampled(MAKE, SAMPLE))
def test_no_pickle_is_touched(maker: str, tmp_path: Path, no_pickle: None) -> None:
    model = MAKE[maker]().learn(32)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=env_of(maker), device="cpu")
    loaded.set_parameters(tmp_path / "m")
    assert not differing(state(model), state(loaded))
    if hasattr(model, "replay_buffer"):
        model.save_replay_buffer(tmp_path / "b")
        loaded.load_replay_buffer(tmp_path / "b")
        for _ in range(2):
            for agent in (model, loaded):
                torch.manual_seed(0)
                np.random.seed(0)
                agent.train(1, 8)
            assert not differing(state(model), state(loaded))


@pytest.mark.parametrize("maker", MAKE)
def test_nothing_of_this_packages_own_is_left_out_or_apart(maker: str, tmp_path: Path) -> None:
    """What has a state is named among the parameters, and what is no parameter is plain."""
    model = MAKE[maker]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.save(tmp_path / "m")
    tree, _ = container.read(tmp_path / "m.zip", "model")
    assert tree.keys() == {"classes", "attributes", "parameters", "metadata"}
    assert "left_out" not in json.dumps(tree)


def test_a_file_of_before_is_read(files: dict[str, Path]) -> None:
    """It has the schedule that follows from the learning rate."""
    schedule = {"object": "stable_baselines3.common.utils:FloatSchedule", "attributes": {"value_schedule": {
        "object": "stable_baselines3.common.utils:ConstantSchedule", "attributes": {"val": 0.5}}}}  # fmt: skip
    assert SAC.load(changed(files["SAC"], attribute("lr_schedule", schedule))).lr_schedule(0.5) == 3e-4


def test_the_fixture_catches_pickles(tmp_path: Path, no_pickle: None) -> None:
    with pytest.raises(AssertionError, match="was called"):
        sac().save(tmp_path / "m", allow_pickle=True)


@pytest.mark.parametrize("maker", ["BRO", "VPLSAC", "DrQv2", "SRSPR", "MBMAPPO"])
def test_every_attribute_comes_back(maker: str, tmp_path: Path) -> None:
    model = MAKE[maker]().learn(32)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m")
    left_out = {*model._excluded_save_params(), "replay_buffer"}
    for name, value in vars(model).items():
        if name in left_out or isinstance(value, (nn.Module, torch.optim.Optimizer)):
            continue
        other = vars(loaded)[name]
        assert type(other) is type(value), name
        if isinstance(value, np.ndarray):
            assert np.array_equal(value, other) and value.dtype == other.dtype, name
        elif type(value).__eq__ is not object.__eq__:
            assert value == other, name


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(learning_rate=LinearSchedule(1e-3, 0, 0.5)),
        dict(action_noise=NormalActionNoise(np.zeros(2), 0.1 * np.ones(2))),
        dict(action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(2), 0.1 * np.ones(2))),
        dict(train_freq=(1, "episode"), gradient_steps=-1), dict(resets=7, reset_shrink=0.5), dict(n_steps=3),
        dict(policy_kwargs=dict(net_arch=[8], activation_fn=nn.Tanh, optimizer_class=torch.optim.RMSprop)),
        dict(policy_kwargs=dict(net_arch=dict(pi=[4], qf=[6, 6]), optimizer_kwargs=dict(betas=(0.5, 0.9)))),
    ],
)  # fmt: skip
def test_arguments_of_every_kind(kwargs: dict[str, Any], tmp_path: Path) -> None:
    model = sac(**kwargs).learn(20)
    model.save(tmp_path / "m")
    model.save_replay_buffer(tmp_path / "b")
    loaded = SAC.load(tmp_path / "m", env=vec(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "b")
    for agent in (model, loaded):
        agent.set_env(vec())
        agent.set_random_seed(1)
        agent.learn(20, reset_num_timesteps=False)
    assert not differing(state(model), state(loaded))


def test_the_zoos_linear_schedule(tmp_path: Path) -> None:
    utils = pytest.importorskip("rl_zoo3.utils")
    for cls in (SAC, MBMAPPO):
        model = tiny(cls, learning_rate=utils.linear_schedule("3e-4")) if cls is MBMAPPO else sac(
            learning_rate=utils.linear_schedule("3e-4"))  # fmt: skip
        model.save(tmp_path / "m")
        assert cls.load(tmp_path / "m").lr_schedule(0.5) == 1.5e-4  # type: ignore[attr-defined]


def test_images_and_dicts(tmp_path: Path) -> None:
    image = spaces.Box(0, 255, (36, 36, 3), np.uint8)
    mixed = spaces.Dict({"image": image, "vector": spaces.Box(-10, 10, (2,), np.float32), "n": spaces.Discrete(4)})
    for policy, space in (("CnnPolicy", image), ("MultiInputPolicy", mixed)):
        model = sac(vec(obs_space=space), policy=policy, buffer_size=40, policy_kwargs={"net_arch": [4]}).learn(14)
        model.save(tmp_path / "m")
        model.save_replay_buffer(tmp_path / "b")
        loaded = SAC.load(tmp_path / "m", env=vec(obs_space=space), device="cpu")
        loaded.load_replay_buffer(tmp_path / "b")
        for agent in (model, loaded):
            torch.manual_seed(0)
            np.random.seed(0)
            agent.train(2, 4)
        assert not differing(state(model), state(loaded))


def test_a_file_does_not_choose_a_folder_to_write_to(tmp_path: Path) -> None:
    sac(replay_buffer_kwargs={"memory_map": str(tmp_path / "rows")}).save(tmp_path / "m")
    (tmp_path / "rows").rmdir()
    SAC.load(tmp_path / "m")
    with pytest.warns(UserWarning, match="the replay buffer was in the folder .*rows'.*to load for another folder"):
        assert SAC.load(tmp_path / "m", env=vec()).replay_buffer.memory_map is None  # type: ignore[union-attr]
    assert not (tmp_path / "rows").exists()
    other = SAC.load(tmp_path / "m", env=vec(), replay_buffer_kwargs={"memory_map": str(tmp_path / "other")})
    assert other.replay_buffer.memory_map == str(tmp_path / "other")  # type: ignore[union-attr]


# ---------------------------------------------------------------- what has no place in a file


class OwnExtractorActivation(nn.Tanh):
    pass


def own_schedule(progress: float) -> float:
    return 1e-3 * progress


def test_trusted_modules(tmp_path: Path) -> None:
    model = sac(learning_rate=own_schedule, policy_kwargs=dict(net_arch=[8], activation_fn=OwnExtractorActivation))
    model.save(tmp_path / "m", trusted_modules=[__name__])
    with pytest.raises(
        BadFile, match=r"kwargs.activation_fn: .*Activation' is of a module that is not trusted.*; learning_"
    ):
        SAC.load(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", trusted_modules=[__name__])
    assert loaded.learning_rate is own_schedule and not differing(state(model), state(loaded))
    model.set_parameters(tmp_path / "m")
    with pytest.raises(ValueError, match=r"trusted_modules must be a list of names of modules, not 'tests'"):
        SAC.load(tmp_path / "m", trusted_modules="tests")
    custom = SAC.load(
        tmp_path / "m",
        custom_objects={"learning_rate": 1.0, "lr_schedule": None, "policy_kwargs": {"net_arch": [8]}},
    )
    assert custom.lr_schedule(0.5) == 1.0


def test_exclude_and_include(tmp_path: Path) -> None:
    model = sac()
    model.note = 3
    model._metrics = {"x": torch.tensor(2.0)}
    model.save(tmp_path / "m", exclude=["note"], include=["_metrics"])
    tree, _ = container.read(tmp_path / "m.zip", "model")
    assert "_metrics" in tree["attributes"] and not {"note", "lr_schedule"} & tree["attributes"].keys()
    loaded = SAC.load(tmp_path / "m")
    assert loaded._metrics == {"x": 2.0} and not hasattr(loaded, "note")


# ---------------------------------------------------------------- names of files, classes, pickles


def test_names_of_files(tmp_path: Path) -> None:
    model = sac()
    model.save(str(tmp_path / "a" / "b" / "m"))
    model.save(tmp_path / "other.model")
    (tmp_path / "folder.zip").mkdir()
    with pytest.warns(UserWarning, match="is a folder"):
        model.save(tmp_path / "folder")
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*") if p.is_file()} == {
        "a/b/m.zip", "other.model", "folder.zip_2",
    }  # fmt: skip
    for path in (tmp_path / "a/b/m", tmp_path / "a/b/m.zip", tmp_path / "other.model"):
        assert not differing(state(SAC.load(path)), state(model))
    with (tmp_path / "opened").open("wb") as file:
        model.save(file)
    with (tmp_path / "opened").open("rb") as file:
        assert not differing(state(SAC.load(file)), state(model))
    with pytest.raises(FileNotFoundError):
        SAC.load(tmp_path / "nowhere")


def test_which_class_loads_which(tmp_path: Path) -> None:
    bro().save(tmp_path / "bro")
    assert type(BROFast.load(tmp_path / "bro")) is BROFast
    bro(cls=BROFast).save(tmp_path / "fast")
    assert type(BRO.load(tmp_path / "fast")) is BRO

    class Own(BRO):
        pass

    bro(cls=Own).save(tmp_path / "own")
    assert type(BRO.load(tmp_path / "own")) is BRO
    for other in (DAC, MBMAPPO):
        with pytest.raises(BadFile, match=rf"a model of sb3_sample.sac.bro:BRO, which is neither {other.__name__} nor"):
            other.load(tmp_path / "bro")
    tiny().save(tmp_path / "ppo")
    with pytest.raises(BadFile, match="which is neither SAC nor above"):
        SAC.load(tmp_path / "ppo")


@pytest.mark.parametrize("maker", ["SAC", "BRO", "MBMAPPO"])
def test_pickled_files_need_allow_pickle(maker: str, tmp_path: Path) -> None:
    model = MAKE[maker](learning_rate=lambda progress: 1e-3 * progress).learn(32)
    model.save(tmp_path / "m", allow_pickle=True)
    for refusing in (type(model).load, MAKE[maker]().set_parameters):
        with pytest.raises(PickledFile, match=r"m\.zip.*allow_pickle=True"):
            refusing(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m", env=vec(), allow_pickle=True)
    # The learning rate is that of the start of the schedule again.
    assert not [name for name in differing(state(model), state(loaded)) if not name.endswith("/lr")]
    assert loaded.lr_schedule(0.5) == 5e-4
    other = MAKE[maker](seed=3)
    other.set_parameters(tmp_path / "m", allow_pickle=True)
    assert not [name for name in differing(state(model), state(other)) if not name.endswith("/lr")]
    # Moved over, by saving it again; and either is read.
    moved = type(model).load(tmp_path / "m", allow_pickle=True, learning_rate=1e-3)
    moved.save(tmp_path / "safe")
    assert not differing(state(type(model).load(tmp_path / "safe", allow_pickle=True)), state(moved))


def test_a_payload_does_not_run(tmp_path: Path) -> None:
    class Payload:
        def __reduce__(self) -> Any:
            return os.mkdir, (str(tmp_path / "ran"),)

    model = sac()
    model.payload = Payload()
    model.save(tmp_path / "m", allow_pickle=True)
    (tmp_path / "b.pkl").write_bytes(pickle.dumps(Payload()))
    with pytest.raises(PickledFile):
        SAC.load(tmp_path / "m")
    for path in ("b.pkl", "b"):
        with pytest.raises(PickledFile, match="allow_pickle=True"):
            model.load_replay_buffer(tmp_path / path)
    with pytest.raises(PickledFile):
        load_vec_normalize(tmp_path / "b.pkl", vec())
    assert not (tmp_path / "ran").exists()


def test_print_system_info(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sac().save(tmp_path / "m")
    SAC.load(tmp_path / "m", print_system_info=True)
    printed = capsys.readouterr().out
    assert "CURRENT SYSTEM INFO" in printed and f"- torch: {torch.__version__}" in printed.split("SAVED")[1]


# ---------------------------------------------------------------- hostile files


def changed(path: Path, change: Any) -> io.BytesIO:
    """The model's file with its tree and tensors changed, and the checksums right."""
    tree, tensors = container.read(path, "model")
    change(tree, tensors)
    file = io.BytesIO()
    container.write(file, "model", json.loads(json.dumps(tree)), tensors)
    file.seek(0)
    return file


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("models")
    for name, model in {"SAC": sac(), "BRO": bro(), "MBMAPPO": tiny()}.items():
        model.learn(16).save(folder / f"{name}.zip")
    return {path.stem: path for path in folder.iterdir()}


def attribute(name: str, value: Any) -> Any:
    return lambda tree, tensors: tree["attributes"].update({name: value})


HUGE = 10**9


@pytest.mark.parametrize(
    ("maker", "change"),
    [
        ("SAC", attribute("policy_kwargs", {"dict": {"net_arch": [HUGE, HUGE]}})),
        ("SAC", attribute("policy_kwargs", {"dict": {"net_arch": [6000, 6000]}})),
        ("SAC", attribute("policy_kwargs", {"dict": {"net_arch": [8] * 100_000}})),
        ("SAC", attribute("policy_kwargs", {"dict": {"n_critics": HUGE}})), ("SAC", attribute("n_quantiles", HUGE)),
        ("SAC", attribute("policy_kwargs", {"dict": {"critic_network": "bronet", "critic_network_kwargs": {"dict": {
            "width": 8, "n_blocks": HUGE}}}})),
        ("SAC", attribute("policy_kwargs", {"dict": {"features_extractor_class": {
            "import": "torch.nn.modules.transformer:Transformer"}}})),
        ("SAC", attribute("policy_kwargs", {"dict": {"activation_fn": {"import": "torch.nn.modules.linear:Linear"}}})),
        ("SAC", attribute("policy_class", {"import": "torch.nn.modules.activation:ReLU"})),
        ("SAC", attribute("policy_class", {"import": "stable_baselines3.common.policies:BasePolicy"})),
        ("SAC", attribute("buffer_size", 10**18)), ("SAC", attribute("buffer_size", -1)),
        ("SAC", attribute("buffer_size", 10**8 + 1)), ("SAC", attribute("n_envs", HUGE)),
        ("SAC", attribute("n_envs", "x")),
        ("SAC", attribute("replay_buffer_class", {"import": "sb3_sample.sac.policies:SACPolicy"})),
        ("SAC", attribute("replay_buffer_class", {
            "import": "stable_baselines3.her.her_replay_buffer:HerReplayBuffer"})),
        ("SAC", attribute("replay_buffer_kwargs", {"dict": {"a": 1}})), ("SAC", attribute("learning_rate", "x")),
        ("SAC", attribute("observation_space", 3)), ("SAC", attribute("action_space", None)),
        ("SAC", attribute("policy_kwargs", [1])), ("SAC", attribute("seed", "x")), ("SAC", attribute("verbose", [])),
        ("SAC", attribute("predict", 3)), ("SAC", attribute("_setup_model", None)), ("SAC", attribute("__class__", 1)),
        ("SAC", attribute("temperature_beta1", 1)), ("SAC", attribute("a.b", 1)),
        ("SAC", attribute("temperature_beta1", "x")), ("SAC", attribute("policy_aliases", 3)),
        ("SAC", attribute("_trusted_modules", ["os"])), ("SAC", attribute("_told", [])),
        ("SAC", attribute("logger", 3)), ("SAC", attribute("_metrics", 3)),
        ("SAC", attribute("_logger", {"left_out": 3})),
        ("SAC", attribute("policy_kwargs", {"left_out": "x"})), ("SAC", attribute("policy_class", {"left_out": "x"})),
        ("SAC", attribute("action_noise", {"instance": "os:_Environ", "attributes": {}})),
        ("SAC", lambda tree, tensors: tree.update(own=3)), ("SAC", lambda tree, tensors: tree.update(more={})),
        *(("SAC", lambda tree, tensors, name=name: tree.update(own={name: {"dict": {}}}))
          for name in ("gamma", "critic", "policy", "actor.optimizer", "train", "replay_buffer", "lr_schedule")),
        ("SAC", lambda tree, tensors: tree["parameters"].update({"x": {"left_out": "x"}})),
        ("SAC", attribute("learning_rate", {"import": "os:system"})), ("SAC", attribute("env", "cpu")),
        ("SAC", lambda tree, tensors: tree["attributes"].clear()),
        ("SAC", lambda tree, tensors: tree["parameters"].clear()),
        ("SAC", lambda tree, tensors: tree["parameters"].update(policy=3)),
        ("SAC", lambda tree, tensors: tree["parameters"].update({"policy.load_state_dict": {"dict": {}}})),
        ("SAC", lambda tree, tensors: tree["parameters"].update({"actor.optimizer": {"dict": {}}})),
        ("SAC", lambda tree, tensors: tree["metadata"].update(policy=3)),
        ("SAC", lambda tree, tensors: tree.pop("metadata")), ("SAC", lambda tree, tensors: tree.update(classes=3)),
        ("SAC", lambda tree, tensors: tree.update(classes=[])),
        ("SAC", lambda tree, tensors: tree.update(classes=["x"])),
        ("SAC", lambda tree, tensors: tensors.clear()),
        ("BRO", attribute("model_size", {"tuple": [1, HUGE]})), ("BRO", attribute("model_size", {"tuple": [HUGE, 8]})),
        ("BRO", attribute("model_size", 3)), ("BRO", attribute("exploration_kwargs", {"dict": {"network_kwargs": 1}})),
        ("MBMAPPO", attribute("dynamics_kwargs", {"dict": {"width": HUGE}})),
        ("MBMAPPO", attribute("dynamics_kwargs", {"dict": {"depth": HUGE}})),
        ("MBMAPPO", attribute("n_steps", 10**17)), ("MBMAPPO", attribute("dynamics_buffer_size", 10**17)),
        ("MBMAPPO", attribute("policy_kwargs", {"dict": {"net_arch": {"dict": {"pi": [HUGE], "vf": [1]}}}})),
    ],
)  # fmt: skip
def test_hostile_files(maker: str, change: Any, files: dict[str, Path]) -> None:
    """A clean error, soon, and without the memory that the file asks for."""
    file = changed(files[maker], change)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.process_time()
        with pytest.raises(ValueError):
            type(MAKE[maker]()).load(file, device="cpu")
        assert time.process_time() - start < 10  # a slow processor, beside others


@pytest.mark.parametrize("device", [{"device": "meta"}, "x"])
def test_a_file_does_not_choose_the_device(device: Any, files: dict[str, Path]) -> None:
    assert SAC.load(changed(files["SAC"], attribute("device", device)), device="cpu").device == torch.device("cpu")


def tensor_of(name: str, value: Any) -> Any:
    def change(tree: Any, tensors: dict[str, torch.Tensor]) -> None:
        key = next(key for key in tensors if name in key)
        tensors[key] = value(tensors[key])

    return change


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", ["policy.actor", "exp_avg_sq", "log_"])
def test_numbers_that_are_not_finite(bad: float, name: str, files: dict[str, Path]) -> None:
    file = changed(files["SAC"], tensor_of(name, lambda tensor: torch.full_like(tensor, bad)))
    with pytest.raises(BadFile, match=f"{name}.* holds .* numbers that are not finite"):
        SAC.load(file)
    file.seek(0)
    with pytest.raises(BadFile, match="not finite"):
        sac().set_parameters(file)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("exp_avg", lambda tensor: tensor.flatten()[:1]), ("exp_avg_sq", lambda tensor: tensor.new_zeros(1000)),
        ("step", lambda tensor: torch.zeros(3)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("maker", ["SAC", "MBMAPPO"])
def test_moments_of_another_shape(maker: str, name: str, value: Any, files: dict[str, Path]) -> None:
    """torch loads them, and its fused kernels then write beside them."""
    with pytest.raises(BadFile, match=f"{name} of parameter .* must be a tensor of shape"):
        type(MAKE[maker]()).load(changed(files[maker], tensor_of(name, value)))


def test_a_model_that_is_not_finite_is_not_saved_over_one_that_is(tmp_path: Path) -> None:
    model = sac()
    model.save(tmp_path / "m")
    with torch.no_grad():
        next(model.actor.parameters())[0, 0] = float("nan")
    with pytest.raises(ValueError, match=r"policy\.actor.* cannot be saved, since it holds 1 numbers"):
        model.save(tmp_path / "m")
    SAC.load(tmp_path / "m")


def test_masks_may_hold_infinity(tmp_path: Path) -> None:
    model = sac()
    model.policy.register_buffer("mask", torch.tensor([0.0, -float("inf")]))
    model.save(tmp_path / "m")


@pytest.mark.slow
@pytest.mark.parametrize("model_size", [(1, 128), (2, 512)])
def test_models_of_all_sizes_load_unhindered(model_size: tuple[int, int], tmp_path: Path) -> None:
    for compact in (True, False):
        model = BRO("MlpPolicy", vec(), model_size=model_size, buffer_size=1000, device="cpu", seed=0)
        if compact:
            model.learn(10)
        model.save(tmp_path / "m")
        start = time.process_time()
        BRO("MlpPolicy", vec(), model_size=model_size, buffer_size=1000, device="cpu")
        building = time.process_time() - start
        start = time.process_time()
        loaded = BRO.load(tmp_path / "m", device="cpu")
        assert time.process_time() - start < 3 * building + 1
        assert not differing(state(model), state(loaded))


# ---------------------------------------------------------------- VecNormalize


@pytest.mark.parametrize("dicts", [False, True])
def test_vec_normalize(dicts: bool, tmp_path: Path) -> None:
    space = spaces.Dict({"a": spaces.Box(-10, 10, (3,)), "b": spaces.Discrete(3)}) if dicts else None
    keys = ["a"] if dicts else None
    env = VecNormalize(vec(2, obs_space=space), clip_obs=3.0, gamma=0.9, norm_obs_keys=keys)
    env.reset()
    for _ in range(9):
        env.step(np.zeros((2, 2)))
    env.training = False
    save_vec_normalize(env, tmp_path / "v.pkl")
    env.save(str(tmp_path / "pickled"))
    theirs = VecNormalize.load(str(tmp_path / "pickled"), vec(2, obs_space=space))
    for ours in (
        load_vec_normalize(tmp_path / "v.pkl", vec(2, obs_space=space)),
        load_vec_normalize(tmp_path / "pickled", vec(2, obs_space=space), allow_pickle=True),
    ):
        assert vars(ours)["clip_obs"] == 3.0 and not ours.training
        first, second = ours.reset(), theirs.reset()
        for _ in range(9):
            for a, b in zip(first.values() if dicts else [first], second.values() if dicts else [second], strict=True):
                np.testing.assert_array_equal(a, b)
            (first, reward, _, _), (second, other, _, _) = ours.step(np.zeros((2, 2))), theirs.step(np.zeros((2, 2)))
            np.testing.assert_array_equal(reward, other)
    with pytest.raises(ValueError, match=r"obs_rms is of shape|spaces"):
        load_vec_normalize(tmp_path / "v.pkl", vec(2, obs_space=spaces.Box(-1, 1, (4,))))
    with pytest.raises(ValueError, match="venv must be a VecNormalize, not a DummyVecEnv"):
        save_vec_normalize(vec(), tmp_path / "w")


def test_a_real_environment(tmp_path: Path) -> None:
    model = sac(make_vec_env("Pendulum-v1", 2)).learn(20)
    model.save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=make_vec_env("Pendulum-v1", 2))
    assert not differing(state(model), state(loaded))
    loaded.learn(10)


def test_an_environment_by_its_id(tmp_path: Path) -> None:
    model = sac("Pendulum-v1").learn(12)
    model.save(tmp_path / "m")
    assert SAC.load(tmp_path / "m", env="Pendulum-v1").learn(5).num_timesteps == 5


def test_a_model_of_stable_baselines3_is_refused_by_its_reason(tmp_path: Path) -> None:
    import stable_baselines3

    stable_baselines3.SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, device="cpu").save(tmp_path / "m")
    with pytest.raises(BadFile, match="allow_pickle=True"):
        SAC.load(tmp_path / "m")
    with pytest.raises(ValueError, match="no model of SAC.*loaded by its own class"):
        SAC.load(tmp_path / "m", allow_pickle=True)


class Decaying(Pessimism):
    def __init__(self, learner: Any, rate: float = 0.99):
        super().__init__(1.0)
        self.rate = rate


class DecayAgent(SAC):
    """An agent with an argument of its own, and an attribute that is none."""

    pessimism: Any = argument(default=Decaying)
    decay_rate: float = argument(default=0.5)

    def _full_pessimism_kwargs(self) -> dict[str, Any]:
        return {"rate": self.decay_rate}


@pytest.mark.parametrize("is_known", [True, False])
def test_a_base_class_says_which_arguments_it_drops(
    is_known: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sac(cls=DecayAgent, decay_rate=0.9).learn(20).save(tmp_path / "m")
    if not is_known:
        # As in a program that has no such class.
        monkeypatch.setattr(model_tree, "_below", lambda cls: iter(()))
    words = "holds a model of DecayAgent, not of SAC: load it with DecayAgent.load. A SAC makes no use of decay_rate$"
    with pytest.warns(UserWarning, match=words):
        loaded = SAC.load(tmp_path / "m", pessimism=Decaying)
    assert loaded.pessimism_rule.rate == 0.99
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert DecayAgent.load(tmp_path / "m", pessimism=Decaying).pessimism_rule.rate == 0.9


@pytest.mark.parametrize("maker", sampled(MAKE, SAMPLE))
def test_models_of_one_class_lose_no_arguments(maker: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor does the guess where a file's class is not known take something for lost that is not."""
    model = MAKE[maker]().learn(20)
    model.save(tmp_path / "m")

    class Same(type(model)):  # type: ignore[misc]
        pass

    other = Same(next(iter(model.policy_aliases)), None, _init_setup_model=False)
    vars(other).update(vars(model))
    other.save(tmp_path / "other")
    monkeypatch.setattr(model_tree, "_below", lambda cls: iter(()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        type(model).load(tmp_path / "m")
        type(model).load(tmp_path / "other")
