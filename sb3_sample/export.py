"""The deterministic policy as ONNX and TorchScript, from the environment's observation to the environment's action."""

import contextlib
import copy
import importlib.util
import inspect
import io
import json
import logging
import os
import pickle
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sample.extras import install
from sb3_sample.faults import check_finite_parameters
from sb3_sample.saving.container import replacing
from sb3_sample.saving.normalization import lacks_vec_normalize
from sb3_sample.version import __version__
from sb3_sample.warn import warn

#: The ONNX operator set of exported files; onnxruntime has had it since 1.14.
OPSET = 18
#: The names of input and output; a dict observation's inputs have the names of its keys.
INPUT, OUTPUT = "observation", "action"
#: Rows of observations with which the policy is traced (not 1, which the tracer takes for a constant), and checked.
_TRACED_ROWS, _CHECKED_ROWS = 2, 3

_FIXED_BATCH = (
    "the policy cannot be exported for batches of any length: what it computes depends on Python's view of one batch, "
    "as len(tensor) does, where tensor.shape[0] would not"
)


class Exportable:
    """Base of the algorithms whose policies can be exported."""

    def export(self, path: str | os.PathLike[str], vec_normalize: VecNormalize | None = None) -> tuple[Path, Path]:
        """
        Write the deterministic policy as ONNX and as TorchScript, for use without this package. Both take observations
        as the environment gives them (images with the channels first) and return the same as ``predict(observation,
        deterministic=True)``. The batch is the first axis, of any length. Needs the extra ``[export]``.

        :param path: where to write; ``.onnx`` and ``.pt`` are appended
        :param vec_normalize: its normalisation of the observations is included; None: that of the model's own
            environment, if there is one; a warning is given if the environment lacks the normalisation that the model
            learned with
        :return: the two files
        :raises ImportError: if the extra is missing, or torch is too old
        :raises TrainingDiverged: if a parameter is not finite
        :raises ValueError: if the observation space is not supported, the normalisation is not this model's or missing,
            or a policy of the user's own computes differently for another length of the batch
        :raises OSError: if a file cannot be written; what was there is still there
        """
        assert isinstance(self, BaseAlgorithm)
        for package in ("onnx", "onnxscript"):
            if importlib.util.find_spec(package) is None:
                raise ImportError(f"export needs {package}. Install it with: {install('export')}")
        if "dynamic_shapes" not in inspect.signature(torch.onnx.export).parameters:
            raise ImportError(
                f"export needs a newer torch than {torch.__version__}, one whose torch.onnx.export has dynamic_shapes"
            )
        if vec_normalize is not None and not isinstance(vec_normalize, VecNormalize):
            raise ValueError(f"vec_normalize must be a VecNormalize, or None, not {vec_normalize!r}")
        if vec_normalize is None and lacks_vec_normalize(self):
            message = (
                "vec_normalize must be given, such as load_vec_normalize(file, venv): this model learned from "
                "normalised observations, and without their statistics its policy sees other numbers than it knows"
            )
            if self.env is None:
                raise ValueError(message)
            # It may have been trained further in an environment without one.
            warn(message)
        check_finite_parameters(self)
        path = Path(path)
        if path.suffix in (".onnx", ".pt"):
            path = path.with_suffix("")
        onnx_path, script_path = (path.with_name(path.name + suffix) for suffix in (".onnx", ".pt"))
        policy = _RawPolicy(self.policy, self.get_vec_normalize_env() if vec_normalize is None else vec_normalize)
        metadata = _metadata(self, policy)
        with _quiet(), _without_checks_of_values(), torch.no_grad():
            importlib.import_module("onnxscript")
            onnx_bytes, script_bytes = _apart(lambda: (_as_onnx(policy, metadata), _as_torchscript(policy, metadata)))
        path.parent.mkdir(parents=True, exist_ok=True)
        for target, content in ((onnx_path, onnx_bytes), (script_path, script_bytes)):
            with replacing(target) as file:
                file.write(content)
        return onnx_path, script_path


class _RawPolicy(nn.Module):
    """
    Map observations as the environment gives them to actions as it takes them.

    :param policy: the model's policy
    :param vec_normalize: normalises the observations; None for no normalisation
    :raises ValueError: if one of them cannot be exported
    """

    low: torch.Tensor
    high: torch.Tensor

    def __init__(self, policy: BasePolicy, vec_normalize: VecNormalize | None):
        super().__init__()
        self.spaces = _inputs(policy.observation_space)
        self.is_dict = isinstance(policy.observation_space, spaces.Dict)
        policy.set_training_mode(False)
        self.acting = policy if policy.device.type == "cpu" else self._copied(policy)
        self.action_space, self.squashed = policy.action_space, policy.squash_output
        if isinstance(self.action_space, spaces.Box):
            # Bounds of integers as floats, in the type of the actions that ``predict`` gives.
            dtype = _action_dtype(self.action_space)
            self.register_buffer("low", torch.as_tensor(self.action_space.low.astype(dtype)))
            self.register_buffer("high", torch.as_tensor(self.action_space.high.astype(dtype)))
        #: Names of the inputs that are normalised.
        self.normalized: list[str] = []
        if vec_normalize is not None and vec_normalize.norm_obs:
            self._take_statistics(vec_normalize)

    def _copied(self, policy: BasePolicy) -> BasePolicy:
        """Copy of a policy on the CPU."""
        zeros = self.example(1)
        here = {name: x.to(policy.device) for name, x in zeros.items()} if self.is_dict else zeros.to(policy.device)
        with torch.no_grad():
            # An actor-critic's distribution after a gradient step has tensors of its graph, which cannot be copied.
            policy._predict(here, deterministic=True)
        try:
            return copy.deepcopy(policy).cpu()
        except RuntimeError as error:
            raise ValueError(
                f"the policy cannot be copied from {policy.device} ({error}): load the model with device='cpu'"
            ) from error

    def _take_statistics(self, vec_normalize: VecNormalize) -> None:
        statistics = vec_normalize.obs_rms
        by_input = statistics if isinstance(statistics, dict) else {INPUT: statistics}
        self.clip_obs = float(vec_normalize.clip_obs)
        for name, rms in cast(dict[str, RunningMeanStd], by_input).items():
            space = self.spaces.get(name)
            if space is None or isinstance(statistics, dict) != self.is_dict:
                raise ValueError(f"vec_normalize normalises {name!r}, but the model's inputs are {list(self.spaces)}")
            # In float64, as VecNormalize computes.
            mean, scale = np.asarray(rms.mean), np.sqrt(np.asarray(rms.var) + vec_normalize.epsilon)
            if mean.ndim == 3 and mean.shape != space.shape:
                # The environment's images have the channels last.
                mean, scale = mean.transpose(2, 0, 1), scale.transpose(2, 0, 1)
            if mean.shape != space.shape:
                raise ValueError(
                    f"vec_normalize has statistics of shape {mean.shape} for {name!r}, but the model's observations "
                    f"are {space.shape}"
                )
            self.register_buffer(f"mean_{len(self.normalized)}", torch.as_tensor(mean, dtype=torch.float64).clone())
            self.register_buffer(f"scale_{len(self.normalized)}", torch.as_tensor(scale, dtype=torch.float64).clone())
            self.normalized.append(name)

    def _normalize(self, name: str, observation: torch.Tensor) -> torch.Tensor:
        if name not in self.normalized:
            return observation
        i = self.normalized.index(name)
        mean, scale = getattr(self, f"mean_{i}"), getattr(self, f"scale_{i}")
        return ((observation.double() - mean) / scale).clamp(-self.clip_obs, self.clip_obs).float()

    def forward(self, observation: Any) -> torch.Tensor:
        """
        :param observation: (B, O), or a dict of them
        :return: actions, (B, A)
        """
        given = observation if self.is_dict else {INPUT: observation}
        seen = {name: self._normalize(name, given[name]) for name in self.spaces}
        actions = self.acting._predict(seen if self.is_dict else seen[INPUT], deterministic=True)
        if not isinstance(self.action_space, spaces.Box):
            return actions
        actions = actions.reshape(-1, *self.action_space.shape)
        if self.squashed:
            # As Stable-Baselines3 computes it, and inside the bounds even if that rounds.
            actions = self.low + 0.5 * (actions + 1.0) * (self.high - self.low)
        return torch.minimum(torch.maximum(actions, self.low), self.high)

    def example(self, n: int) -> Any:
        """
        :param n: how many
        :return: observations of zeros
        """
        made = {
            name: torch.as_tensor(np.zeros((n, *(space.shape or ())), space.dtype))
            for name, space in self.spaces.items()
        }
        return made if self.is_dict else made[INPUT]


class _Positional(nn.Module):
    """``_RawPolicy`` with one argument for each input, as in ONNX."""

    def __init__(self, policy: _RawPolicy):
        super().__init__()
        self.policy = policy

    def forward(self, *observations: torch.Tensor) -> torch.Tensor:
        if not self.policy.is_dict:
            return self.policy(observations[0])
        return self.policy(dict(zip(self.policy.spaces, observations, strict=True)))


def _inputs(space: spaces.Space) -> dict[str, spaces.Space]:
    """The inputs by name, in their order."""
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else {INPUT: space}
    for name, part in parts.items():
        if not isinstance(part, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            raise ValueError(
                f"an observation space of Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of them, can be "
                f"exported, not {part} ({name!r})"
            )
        if name == OUTPUT:
            raise ValueError(f"the key {OUTPUT!r} of the observation is the name of the output: rename it")
    return parts


def _metadata(model: BaseAlgorithm, policy: _RawPolicy) -> dict[str, str]:
    """Metadata of the files; the values are text, and JSON if they have several parts."""
    action = policy.action_space
    return {
        "exported_by": f"sb3_sample {__version__}",
        "algorithm": type(model).__name__,
        "policy": type(model.policy).__name__,
        "inputs": json.dumps([_described(name, space) for name, space in policy.spaces.items()]),
        "outputs": json.dumps([{**_described(OUTPUT, action), "dtype": str(_action_dtype(action))}]),
        "observation_space": str(model.observation_space),
        "action_space": str(action),
        "normalized_inputs": json.dumps(policy.normalized),
        "deterministic": "true",
    }


def _described(name: str, space: spaces.Space) -> dict[str, Any]:
    channels = {"layout": "channels first"} if is_image_space(space) else {}
    return {"name": name, "shape": ["batch", *(space.shape or ())], "dtype": str(space.dtype), **channels}


def _action_dtype(space: spaces.Space) -> Any:
    """
    Type of the actions that ``predict`` gives: that of the policy's numbers, whatever the space's type, scaled to the
    bounds of a Box.
    """
    if isinstance(space, spaces.Box):
        return np.result_type(np.float32, space.dtype)
    # The mode of Bernoulli distributions is a float.
    return np.dtype(np.float32 if isinstance(space, spaces.MultiBinary) else np.int64)


def _apart(work: Callable[[], Any]) -> Any:
    """
    Run work in a forked process, if one can be forked: torch keeps the types and functions of everything that it ever
    traced, a megabyte for each export. A process that has used a GPU is not forked.

    :param work: function without side effects; its result and its exceptions can be pickled
    :return: what it returns
    :raises Exception: what it raises
    """
    if not sys.platform.startswith("linux") or torch.cuda.is_initialized():
        return work()
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            os.close(ours)
            # OpenMP's threads do not exist after a fork.
            torch.set_num_threads(1)
            with open(theirs, "wb") as file:
                file.write(_answer(work))
        finally:
            os._exit(0)
    os.close(theirs)
    try:
        with open(ours, "rb") as file:
            data = file.read()
    finally:
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    if not data:
        raise RuntimeError(f"the process that exports has ended without an answer (exit code {status})")
    # Safe to unpickle: this program itself has written it.
    value, trace = pickle.loads(data)
    if trace is not None:
        raise value from RuntimeError(f"in the process that exports:\n{trace}")
    return value


def _answer(work: Callable[[], Any]) -> bytes:
    """Pickle the result, or the exception with its traceback."""
    try:
        return pickle.dumps((work(), None))
    except Exception as error:
        trace = traceback.format_exc()
        try:
            return pickle.dumps((error, trace))
        except Exception:  # of a class that cannot be pickled
            return pickle.dumps((RuntimeError(f"{type(error).__name__}: {error}"), trace))


def _as_onnx(policy: _RawPolicy, metadata: dict[str, str]) -> bytes:
    import onnx

    example = policy.example(_TRACED_ROWS)
    args = tuple(example.values()) if policy.is_dict else (example,)
    batch = torch.export.Dim("batch")
    program = torch.onnx.export(
        _Positional(policy).eval(),
        args,
        input_names=list(policy.spaces),
        output_names=[OUTPUT],
        opset_version=OPSET,
        dynamic_shapes={"observations": tuple({0: batch} for _ in args)},
        dynamo=True,
        external_data=False,
        verbose=False,
    )
    assert program is not None
    model = program.model_proto
    for value in (*model.graph.input, *model.graph.output):
        if not value.type.tensor_type.shape.dim[0].dim_param:
            raise ValueError(_FIXED_BATCH)
    onnx.helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def _as_torchscript(policy: _RawPolicy, metadata: dict[str, str]) -> bytes:
    # Freezing makes the weights constants: nothing in the file requires a gradient.
    traced = torch.jit.freeze(torch.jit.trace(policy.eval(), (policy.example(_TRACED_ROWS),), check_trace=False))
    more = policy.example(_CHECKED_ROWS)
    try:
        differs = not torch.allclose(traced(more), policy(more), rtol=1e-4, atol=1e-4)
    except RuntimeError as error:
        raise ValueError(_FIXED_BATCH) from error
    if differs:
        raise ValueError(_FIXED_BATCH)
    file = io.BytesIO()
    torch.jit.save(traced, file, _extra_files={"metadata.json": json.dumps(metadata).encode()})
    return file.getvalue()


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporters' messages about packages that they could use, their deprecation and constants."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def _without_checks_of_values() -> Iterator[None]:
    """Keep distributions from checking the values of their arguments, which a tracer does not know."""
    before = torch.distributions.Distribution._validate_args
    torch.distributions.Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        torch.distributions.Distribution.set_default_validate_args(before)
