"""Exported policies give ``predict``'s actions without this package."""

import copy
import importlib.util
import json
import resource
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_sample import MBMAPPO, SAC, TrainingDiverged, export
from sb3_sample.export import OPSET, _RawPolicy
from tests.agents import OFF_POLICY
from tests.ppo.common import ALGORITHMS, tiny
from tests.sac.common import Toy, bro, sac, vec

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

DICT = spaces.Dict({"a": spaces.Box(-9, 9, (3,), np.float32), "b": spaces.Box(-9, 9, (2, 2), np.float32)})
IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)
WIDE = spaces.Box(np.array([-3, 0, 5], np.float32), np.array([-1, 100, 6], np.float32))


def ppo(env: Any, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    """Plain PPO, which takes more spaces than the simulation does."""
    own = dict(n_simulated=0, n_steps=16, batch_size=8, policy_kwargs={"net_arch": [8]}, seed=0, device="cpu")
    return MBMAPPO(policy, env, **{**own, **kwargs})


def observations(space: Any, n: int, seed: int = 0, scale: float = 1.0) -> Any:
    space.seed(seed)
    if isinstance(space, spaces.Dict):
        return {key: observations(sub, n, seed, scale) for key, sub in space.items()}
    drawn = np.stack([space.sample() for _ in range(n)])
    return (scale * drawn).astype(drawn.dtype) if drawn.dtype.kind == "f" else drawn


def shake(model: Any) -> Any:
    """The model with weights that no initialisation leaves at zero, far from the trivial action."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.policy.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=generator))
    return model


def check(model: Any, tmp_path: Path, vec_normalize: VecNormalize | None = None, given: Any = None) -> Any:
    """Exported and compared at several batch sizes; the ONNX model is returned."""
    onnx_path, script_path = model.export(tmp_path / "new" / "policy", vec_normalize=given)
    assert (onnx_path.name, script_path.name) == ("policy.onnx", "policy.pt")
    assert sorted(path.name for path in onnx_path.parent.iterdir()) == ["policy.onnx", "policy.pt"]
    session, script = onnxruntime.InferenceSession(onnx_path), torch.jit.load(script_path)
    space, seen = model.action_space, []
    # Actions in [-1, 1], and up to half the range where that is larger than 1, as float32 rounds.
    scale = np.maximum((space.high.astype(float) - space.low) / 2, 1) if isinstance(space, spaces.Box) else 1
    for n in (1, 2, 3, 17):
        raw = observations(model.observation_space, n, seed=n)
        expected, _ = model.predict(
            raw if vec_normalize is None else vec_normalize.normalize_obs(raw), deterministic=True
        )
        inputs = raw if isinstance(raw, dict) else {"observation": raw}
        (by_onnx,) = session.run(["action"], inputs)
        tensors = {name: torch.as_tensor(value) for name, value in inputs.items()}
        by_script = script(tensors if isinstance(raw, dict) else tensors["observation"]).numpy()
        for actions in (by_onnx, by_script):
            assert actions.shape == expected.shape
            np.testing.assert_allclose(actions / scale, expected / scale, rtol=0, atol=1e-5)
            assert actions.dtype == expected.dtype
        seen.append(expected)
    assert len(np.unique(np.concatenate(seen), axis=0)) > 1, (
        "actions that do not depend on the observation show nothing"
    )
    proto = onnx.load(onnx_path)
    assert [opset.version for opset in proto.opset_import if not opset.domain] == [OPSET]
    files = {"metadata.json": ""}
    torch.jit.load(script_path, _extra_files=files)
    assert json.loads(files["metadata.json"]) == {entry.key: entry.value for entry in proto.metadata_props}
    return proto


@pytest.mark.slow
@pytest.mark.parametrize("name", OFF_POLICY)
def test_every_off_policy_algorithm(name: str, tmp_path: Path) -> None:
    # SR-SPR chooses among actions, in a small world of its own.
    model = OFF_POLICY[name](None if name == "SRSPR" else vec(action_space=WIDE))
    model.learn(30)
    proto = check(shake(model), tmp_path)
    (described,) = json.loads(next(entry.value for entry in proto.metadata_props if entry.key == "inputs"))
    assert ("layout" in described) is (model.observation_space.dtype == np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"actor_network": "spectral", "actor_network_kwargs": {}},
        {"actor_network_kwargs": {"hidden_sizes": [8, 8], "layer_norm": True, "spectral_norm": True, "dropout": 0.5}},
        {"actor_network": "bronet", "actor_network_kwargs": {"width": 8, "n_blocks": 2, "first_layer_norm": False}},
    ],
)
def test_networks(policy_kwargs: dict[str, Any], tmp_path: Path) -> None:
    check(shake(sac(policy_kwargs=policy_kwargs)), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("cls", ALGORITHMS)
def test_every_on_policy_algorithm(cls: Any, tmp_path: Path) -> None:
    check(shake(tiny(cls, vec(action_space=WIDE))), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "action_space",
    [spaces.Discrete(4), spaces.MultiDiscrete([3, 2]), spaces.MultiBinary(3), spaces.Box(-5, 9, (2, 2), np.float64)],
    ids=str,
)
def test_action_spaces(action_space: spaces.Space, tmp_path: Path) -> None:
    """On-policy; the actions off-policy are bounded boxes."""
    proto = check(shake(ppo(vec(action_space=action_space))), tmp_path)
    (output,) = json.loads(next(entry.value for entry in proto.metadata_props if entry.key == "outputs"))
    assert output["shape"] == ["batch", *action_space.shape]
    (given,) = proto.graph.output
    assert output["dtype"] == str(onnx.helper.tensor_dtype_to_np_dtype(given.type.tensor_type.elem_type))


@pytest.mark.slow
@pytest.mark.parametrize("make", [sac, ppo])
@pytest.mark.parametrize("dtype", [np.int64, np.int8])
def test_actions_of_integers(dtype: Any, make: Any, tmp_path: Path) -> None:
    """The numbers are floats, as those of ``predict`` are."""
    proto = check(shake(make(vec(action_space=spaces.Box(-100, 100, (2,), dtype)))), tmp_path)
    (output,) = json.loads(next(entry.value for entry in proto.metadata_props if entry.key == "outputs"))
    assert output["dtype"] == ("float64" if dtype is np.int64 else "float32")


@pytest.mark.slow
def test_squashed_actions(tmp_path: Path) -> None:
    kwargs = {"net_arch": [8], "squash_output": True}
    check(shake(ppo(vec(action_space=WIDE), use_sde=True, policy_kwargs=kwargs)), tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-9, 9, (2, 3), np.float64),
        spaces.Discrete(5),
        spaces.MultiDiscrete([3, 4]),
        spaces.MultiBinary(6),
        DICT,
        spaces.Dict({"image": IMAGE, "n": spaces.Discrete(3), "x": spaces.Box(-9, 9, (3,), np.float32)}),
    ],
    ids=str,
)
@pytest.mark.parametrize("family", ["sac", "ppo"])
def test_observation_spaces(space: spaces.Space, family: str, tmp_path: Path) -> None:
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    model = (sac if family == "sac" else ppo)(space_env(space), policy=policy)
    check(shake(model), tmp_path)


class Drawn(Toy):
    """Observations drawn from the space."""

    def _observation(self, space: spaces.Space) -> Any:
        return space.sample()


def space_env(space: spaces.Space) -> Any:
    return DummyVecEnv([lambda: Drawn(space)])


@pytest.mark.slow
@pytest.mark.parametrize("family", ["sac", "ppo"])
@pytest.mark.parametrize("shape", [(3, 36, 36), (40, 36, 3)])
def test_images(family: str, shape: tuple[int, ...], tmp_path: Path) -> None:
    env = vec(obs_space=spaces.Box(0, 255, shape, np.uint8))
    model = (sac if family == "sac" else ppo)(env, policy="CnnPolicy")
    proto = check(model, tmp_path)
    (described,) = json.loads(next(entry.value for entry in proto.metadata_props if entry.key == "inputs"))
    assert described["layout"] == "channels first" and described["dtype"] == "uint8"


# ------------------------------------------------------------------ normalisation


def normalized(space: Any = None, **kwargs: Any) -> VecNormalize:
    """Far from standardised, so that float32 would not do, and clipped within reach."""
    env = VecNormalize(vec(obs_space=space), clip_obs=1.5, epsilon=1e-3, **kwargs)
    statistics = env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}
    rng = np.random.default_rng(0)
    for rms in statistics.values():
        rms.mean, rms.var = rng.normal(size=rms.mean.shape), rng.uniform(1e-4, 20, rms.var.shape)
    return env


@pytest.mark.parametrize("family", ["sac", pytest.param("ppo", marks=pytest.mark.slow)])
def test_normalisation_is_inside(family: str, tmp_path: Path) -> None:
    env = normalized()
    model = shake(sac(env) if family == "sac" else tiny(env=env))
    proto = check(model, tmp_path, env)
    facts = {entry.key: entry.value for entry in proto.metadata_props}
    assert json.loads(facts["normalized_inputs"]) == ["observation"]
    assert facts["algorithm"] == type(model).__name__ and facts["deterministic"] == "true"
    assert json.loads(facts["inputs"]) == [{"name": "observation", "shape": ["batch", 3], "dtype": "float32"}]
    assert [tensor.name for tensor in proto.graph.input] == ["observation"]


@pytest.mark.slow
@pytest.mark.parametrize("keys", [["a"], ["a", "b"]])
def test_normalised_keys(keys: list[str], tmp_path: Path) -> None:
    env = normalized(DICT, norm_obs_keys=keys)
    proto = check(shake(bro(env, policy="MultiInputPolicy")), tmp_path, env)
    facts = {entry.key: entry.value for entry in proto.metadata_props}
    assert json.loads(facts["normalized_inputs"]) == keys
    assert [tensor.name for tensor in proto.graph.input] == ["a", "b"]


@pytest.mark.slow
def test_statistics_can_be_given(tmp_path: Path) -> None:
    """To a model that was loaded without its environment."""
    env = normalized()
    shake(sac(env)).save(tmp_path / "model")
    model = type(sac()).load(tmp_path / "model")
    check(model, tmp_path, env, given=env)
    proto = check(model, tmp_path / "without")
    assert "[]" in [entry.value for entry in proto.metadata_props if entry.key == "normalized_inputs"]
    off = VecNormalize(vec(), norm_obs=False)
    check(model, tmp_path / "off", given=off)


@pytest.mark.slow
def test_no_state_is_touched(tmp_path: Path) -> None:
    model = shake(sac()).learn(15)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    torch.manual_seed(1)
    expected = torch.rand(3)
    torch.manual_seed(1)
    model.export(tmp_path / "policy.onnx")
    assert torch.equal(torch.rand(3), expected)
    assert all(torch.equal(before[name], value) for name, value in model.policy.state_dict().items())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.onnx", "policy.pt"]
    model.learn(20)


def test_a_copy_after_a_gradient_step(monkeypatch: pytest.MonkeyPatch) -> None:
    """A policy elsewhere than on the CPU is copied, also with a distribution of the last step's tensors."""
    model = tiny(MBMAPPO, vec()).learn(64)
    with pytest.raises(RuntimeError, match="deepcopy"):
        copy.deepcopy(model.policy)
    raw = _RawPolicy(model.policy, None)
    moved = raw._copied(model.policy)
    assert moved is not model.policy and moved.device.type == "cpu"
    expected = model.policy._predict(raw.example(3), deterministic=True)
    assert torch.equal(moved._predict(raw.example(3), deterministic=True), expected)


@pytest.mark.slow
def test_the_process_does_not_grow(tmp_path: Path) -> None:
    """torch keeps all that was ever traced in a process, a megabyte each time."""
    model = sac()
    model.export(tmp_path / "policy")
    functions = len(torch.jit._state._python_cu.get_functions())  # type: ignore[attr-defined]
    before = psutil.Process().memory_info().rss
    for _ in range(5):
        model.export(tmp_path / "policy")
    assert len(torch.jit._state._python_cu.get_functions()) == functions  # type: ignore[attr-defined]
    assert psutil.Process().memory_info().rss - before < 2 * 2**20


def test_a_full_disk_leaves_what_was_there_and_nothing_else(tmp_path: Path) -> None:
    for name in ("policy.onnx", "policy.pt"):
        (tmp_path / name).write_text("before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    try:
        with pytest.raises(OSError, match=r"could not be written.*policy\.onnx"):
            sac().export(tmp_path / "policy")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("policy.onnx", "policy.pt"), "before"
    )


@pytest.mark.slow
def test_a_real_environment(tmp_path: Path) -> None:
    from sb3_sample import SAC

    env = VecNormalize(make_vec_env("Pendulum-v1", seed=0))
    model = SAC("MlpPolicy", env, learning_starts=50, seed=0, device="cpu", replay_ratio=0.5).learn(200)
    check(model, tmp_path, env)


# ------------------------------------------------------------------ errors


@pytest.mark.parametrize("package", ["onnx", "onnxscript"])
def test_the_extra_is_named(package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find(name))
    with pytest.raises(ImportError, match=rf'export needs {package}.*pip install -e "\.\[export\]"'):
        sac().export(tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def test_a_torch_that_is_too_old(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.onnx, "export", lambda model, args, f=None, dynamo=False: None)
    with pytest.raises(ImportError, match="export needs a newer torch than .*, one whose .* has dynamic_shapes"):
        sac().export(tmp_path / "policy")
    assert not list(tmp_path.iterdir())


class Counted(nn.Module):
    """A layer whose result depends on how many rows Python sees."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x * float(len(x))


@pytest.mark.slow
def test_a_policy_that_fixes_the_batch_is_refused(tmp_path: Path) -> None:
    model = sac()
    model.actor.trunk = nn.Sequential(model.actor.trunk, Counted())
    with pytest.raises(ValueError, match="batches of any length"):
        model.export(tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def test_refused(tmp_path: Path) -> None:
    model = sac()
    with pytest.raises(ValueError, match="vec_normalize must be a VecNormalize"):
        model.export(tmp_path / "policy", vec_normalize=vec())
    with pytest.raises(ValueError, match=r"statistics of shape \(5,\)"):
        model.export(tmp_path / "policy", vec_normalize=normalized(spaces.Box(-9, 9, (5,))))
    with pytest.raises(ValueError, match="'a', but the model's inputs are"):
        model.export(tmp_path / "policy", vec_normalize=normalized(DICT))
    with pytest.raises(ValueError, match=r"can be exported, not Text"):
        export._inputs(spaces.Dict({"x": spaces.Text(3)}))
    with pytest.raises(ValueError, match="name of the output"):
        export._inputs(spaces.Dict({"action": spaces.Discrete(3)}))
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        model.export(tmp_path / "file" / "policy")


@pytest.mark.slow
@pytest.mark.parametrize("family", ["sac", "ppo"])
def test_statistics_that_are_missing_are_asked_for(family: str, tmp_path: Path) -> None:
    env = VecNormalize(vec())
    model = sac(env).learn(12) if family == "sac" else tiny(MBMAPPO, env).learn(16)
    model.save(tmp_path / "m")
    loaded = type(model).load(tmp_path / "m")
    with pytest.raises(ValueError, match="vec_normalize must be given"):
        loaded.export(tmp_path / "policy")
    loaded.export(tmp_path / "policy", vec_normalize=env)
    assert (tmp_path / "policy.onnx").exists()


@pytest.mark.slow
def test_statistics_that_a_plain_environment_lacks_are_warned_of(tmp_path: Path) -> None:
    sac(VecNormalize(vec())).learn(12).save(tmp_path / "m")
    loaded = SAC.load(tmp_path / "m", env=vec())
    with pytest.warns(UserWarning, match="vec_normalize must be given"):
        loaded.export(tmp_path / "policy")
    assert (tmp_path / "policy.onnx").exists()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded.export(tmp_path / "policy", vec_normalize=VecNormalize(vec()))
        sac().export(tmp_path / "policy")


@pytest.mark.slow
@pytest.mark.parametrize("family", ["sac", pytest.param("ppo", marks=pytest.mark.slow)])
def test_without_normalisation_no_statistics_are_asked_for(family: str, tmp_path: Path) -> None:
    model = sac().learn(12) if family == "sac" else tiny(MBMAPPO).learn(16)
    model.save(tmp_path / "m")
    type(model).load(tmp_path / "m").export(tmp_path / "policy")
    assert (tmp_path / "policy.onnx").exists()


def test_parameters_that_are_not_finite_are_not_exported(tmp_path: Path) -> None:
    model = sac()
    with torch.no_grad():
        next(model.actor.parameters()).fill_(torch.nan)
    with pytest.raises(TrainingDiverged, match="nan"):
        model.export(tmp_path / "policy")
