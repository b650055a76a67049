"""Saving and loading of whole models, for both families, in files that run no code."""

import io
import pathlib
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info
from stable_baselines3.her import HerReplayBuffer

from sb3_sample.saving import container, paths
from sb3_sample.saving.budget import Budget
from sb3_sample.saving.classes import check_trusted, path_of
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.replay import MAX_TRANSITIONS

KIND = "model"
#: Environments and, of a HerReplayBuffer, which makes an object for each, transitions that a file can ask for.
MAX_ENVS, MAX_HER_TRANSITIONS = 100_000, 20_000_000
#: The largest width, depth or number of networks that a file can ask for. Python makes lists of such lengths.
MAX_WIDTH = 1_000_000
#: What the common optimizers keep of each parameter, in its shape. torch's fused kernels do not check it.
_MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer", "square_avg", "grad_avg")
Self = TypeVar("Self", bound="SafeFiles")


class SafeFiles(BaseAlgorithm):
    """
    What an algorithm's class gains that stands before Stable-Baselines3's among its bases: ``save``, ``load`` and
    ``set_parameters`` with files that hold JSON and tensors, and run no code. See docs/saving.md.
    """

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
    ) -> None:
        """
        Save the model, as in Stable-Baselines3, but to a file that runs no code when it is loaded. What is there is
        replaced at once, and only when the new file is complete.

        :param path: path, to which ".zip" is added if it has no suffix, or a binary file open for writing
        :param exclude: attributes to leave out, besides those that always are
        :param include: attributes to save that would be left out
        :param allow_pickle: whether to write Stable-Baselines3's own, pickled format instead, which can hold anything
        :param trusted_modules: modules, or packages of modules, whose classes and functions the file may name; to be
            named again when it is loaded
        :raises NotPortable: (a ``ValueError``) if an attribute cannot be in such a file; nothing is written then
        :raises ValueError: if a parameter is not finite
        :raises OSError: if the file cannot be written
        """
        trusted = check_trusted(trusted_modules)
        if allow_pickle:
            super().save(path, exclude, include)
            return
        names, variables = self._get_torch_save_params()
        if variables:
            raise ValueError(
                f"{type(self).__name__} holds tensors of its own, {variables}: allow_pickle=True saves them"
            )
        left_out = {*self._excluded_save_params(), *(exclude or ())} - set(include or ())
        left_out |= {name.split(".")[0] for name in names}
        tensors: dict[str, torch.Tensor] = {}
        attributes = {
            name: encode(value, name, tensors, trusted) for name, value in vars(self).items() if name not in left_out
        }
        parameters = self.get_parameters()
        for name, state in parameters.items():
            _check_finite(recursive_getattr(self, name), state, name, "cannot be saved, since it", ValueError)
        metadata = {name: getattr(state, "_metadata", None) for name, state in parameters.items()}
        classes = [path_of(cls) for cls in type(self).__mro__ if issubclass(cls, SafeFiles)]
        tree = {
            "classes": classes,
            "attributes": attributes,
            "parameters": {name: encode(state, name, tensors, trusted) for name, state in parameters.items()},
            # What torch's modules know of the version of their own parameters.
            "metadata": {name: encode(value, name, tensors, trusted) for name, value in metadata.items()},
        }
        container.write(paths.to_write(path, "zip"), KIND, tree, tensors)

    @classmethod
    def load(
        cls: type[Self],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: torch.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
        **kwargs: Any,
    ) -> Self:
        """
        Load a model, as in Stable-Baselines3. Nothing in the file is run, whoever wrote it.

        :param path: file, or where ``save`` wrote it
        :param env: environment to go on with; none is needed for prediction
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: objects that replace what the file holds under their names
        :param print_system_info: whether to print the saved and the present versions
        :param force_reset: whether the environment is reset before training goes on
        :param allow_pickle: whether a file in Stable-Baselines3's own, pickled format is loaded too, which can run any
            code that its author wanted
        :param trusted_modules: modules, or packages of modules, whose classes and functions the file may name
        :param kwargs: arguments of the constructor that shall differ from the saved ones
        :return: the model
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile, pickled, or of another class
        """
        trusted = check_trusted(trusted_modules)
        try:
            with paths.opened(path, "zip") as file:
                content = _Content(file, cls, trusted)
        except PickledFile:
            if not allow_pickle:
                raise
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
            print("== SAVED MODEL SYSTEM INFO ==")
            print("\n".join(f"- {name}: {version}" for name, version in content.versions.items()))
        attributes = content.attributes(custom_objects or {})
        if "replay_buffer_kwargs" not in kwargs:
            _forget_folder(attributes, warn=env is not None)
        given = kwargs.get("policy_kwargs")
        if "policy_kwargs" in kwargs and given != attributes["policy_kwargs"]:
            raise ValueError(
                f"policy_kwargs must be those of the file, {attributes['policy_kwargs']}, or be left out, not {given}"
            )
        if env is not None:
            env = cls._wrap_env(env, attributes["verbose"])
            check_for_correct_spaces(env, attributes["observation_space"], attributes["action_space"])
            attributes["n_envs"] = env.num_envs
            if force_reset:
                attributes["_last_obs"] = None
        try:
            with Budget(content.tensors, content.name):
                model = cls(policy=attributes["policy_class"], env=env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
                _check_names(model, attributes, content.name)
                vars(model).update(attributes)
                vars(model).update(kwargs)
                _check_sizes(model, content.name)
                model._setup_model()
            content.check_parameters(model)
            model.set_parameters(content.parameters(), exact_match=True, device=device)
            if model.use_sde:
                model.policy.reset_noise()  # type: ignore[operator]
        except Exception as error:
            # With arguments that the file does not have, its content need not be to blame.
            if isinstance(error, ValueError) or kwargs or custom_objects:
                raise
            raise BadFile(
                f"{content.name}: no {cls.__name__} can be made of what it holds: {type(error).__name__}: {error}"
            ) from error
        return model

    def set_parameters(
        self,
        load_path_or_dict: str | pathlib.Path | io.BufferedIOBase | dict[str, Any],
        exact_match: bool = True,
        device: torch.device | str = "auto",
        *,
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
    ) -> None:
        """
        Load parameters, as in Stable-Baselines3. The optimizers' moments are loaded, their settings (learning rate,
        weight decay, ...) stay this model's, so that ``load`` with other ones has them in force.

        :param load_path_or_dict: a file, or parameters as ``get_parameters`` gives them
        :param exact_match: whether parameters for every module must be there, and no others
        :param device: "auto", "cpu", "cuda", ...
        :param allow_pickle: see ``load``
        :param trusted_modules: see ``load``
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile, pickled, or of another class
        """
        parameters: Any = load_path_or_dict
        if not isinstance(load_path_or_dict, dict):
            try:
                with paths.opened(load_path_or_dict, "zip") as file:
                    content = _Content(file, type(self), check_trusted(trusted_modules))
                content.check_parameters(self)
                parameters = content.parameters()
            except PickledFile:
                if not allow_pickle:
                    raise
        named = {name: recursive_getattr(self, name) for name in self._get_torch_save_params()[0]}
        optimizers = [value for value in named.values() if isinstance(value, torch.optim.Optimizer)]
        settings = [
            [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
            for optimizer in optimizers
        ]
        super().set_parameters(parameters, exact_match, device)
        for optimizer, own_groups in zip(optimizers, settings, strict=True):
            for group, own in zip(optimizer.param_groups, own_groups, strict=True):
                group.update(own)


class _Content:
    """
    What a model's file holds.

    :param file: the file
    :param cls: the class that is to be loaded
    :param trusted: modules that the file may name
    :raises BadFile: if it is no such file
    """

    def __init__(self, file: Any, cls: type[SafeFiles], trusted: tuple[str, ...]):
        self.name = str(getattr(file, "name", "the file"))
        self.trusted = trusted
        self.tree, self._stored, self.versions = container.read_with_versions(file, KIND)
        #: Of which the budget is made.
        self.tensors = dict(self._stored)
        tree = self.tree
        if not isinstance(tree, dict) or tree.keys() != {"classes", "attributes", "parameters", "metadata"}:
            raise BadFile(f"{self.name} is damaged: it does not hold what a model consists of")
        classes = tree["classes"]
        if not isinstance(classes, list) or not classes or not all(isinstance(path, str) for path in classes):
            raise BadFile(f"{self.name} is damaged: it does not say of which class the model is")
        if not all(isinstance(tree[key], dict) for key in ("attributes", "parameters", "metadata")):
            raise BadFile(f"{self.name} is damaged: it does not hold what a model consists of")
        if path_of(cls) not in classes and classes[0] not in map(path_of, cls.__mro__):
            raise BadFile(
                f"{self.name} holds a model of {classes[0]}, which is neither {cls.__name__} nor above or below it: "
                "load it with its own class"
            )
        self._parameters: dict[str, Any] | None = None

    def attributes(self, custom_objects: dict[str, Any]) -> dict[str, Any]:
        """
        :param custom_objects: what replaces the file's
        :return: the values of the attributes
        """
        described = self.tree["attributes"]
        attributes = {
            name: custom_objects[name] if name in custom_objects else self._decoded(tree, name)
            for name, tree in described.items()
        }
        for name, kind in (("policy_kwargs", dict), ("verbose", int), ("policy_class", type)):
            if not isinstance(attributes.get(name), kind):
                raise BadFile(f"{self.name} is damaged: {name} is {attributes.get(name)!r:.100}")
        for name in ("observation_space", "action_space"):
            if name not in attributes:
                raise BadFile(f"{self.name} is damaged: it has no {name}")
        attributes["policy_kwargs"].pop("device", None)
        return attributes

    def _decoded(self, tree: Any, name: str) -> Any:
        try:
            return decode(tree, self._stored, name, self.trusted)
        except BadFile as error:
            raise BadFile(f"{self.name}: {error}") from error

    def parameters(self) -> dict[str, Any]:
        """
        :return: what ``get_parameters`` gave, once
        """
        if self._parameters is None:
            self._parameters = {name: self._decoded(tree, name) for name, tree in self.tree["parameters"].items()}
            for name, tree in self.tree["metadata"].items():
                if isinstance(state := self._parameters.get(name), OrderedDict):
                    vars(state)["_metadata"] = self._decoded(tree, name)
        return self._parameters

    def check_parameters(self, model: SafeFiles) -> None:
        """
        :param model: for which they are
        :raises BadFile: if one is not finite, or what an optimizer keeps of one is not of its shape
        """
        known = model._get_torch_save_params()[0]
        for name, state in self.parameters().items():
            # Others are refused by ``set_parameters``.
            owner = recursive_getattr(model, name) if name in known else None
            _check_finite(owner, state, f"{self.name}: {name}", "", BadFile)
            if isinstance(owner, torch.optim.Optimizer):
                _check_moments(owner, state, f"{self.name}: {name}")


def _tensors_in(value: Any, name: str) -> Iterator[tuple[str, torch.Tensor]]:
    if isinstance(value, torch.Tensor):
        yield name, value
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _tensors_in(item, f"{name}.{key}")
    elif isinstance(value, (list, tuple)):
        for i, item in enumerate(value):
            yield from _tensors_in(item, f"{name}.{i}")


def _check_finite(owner: Any, state: Any, name: str, words: str, error: type[ValueError]) -> None:
    """Parameters and what optimizers keep must be finite; a buffer, such as a mask, may hold infinity, but not NaN."""
    learned = None
    if isinstance(owner, torch.nn.Module):
        learned = {f"{name}.{key}" for key, _ in owner.named_parameters(remove_duplicate=False)}
    for key, tensor in _tensors_in(state, name):
        if not (tensor.is_floating_point() or tensor.is_complex()):
            continue
        bad = tensor.float().isnan() if learned is not None and key not in learned else ~tensor.float().isfinite()
        if bad.any():
            raise error(f"{key} {words + ' ' if words else ''}holds {int(bad.sum())} numbers that are not finite")


def _check_moments(optimizer: torch.optim.Optimizer, state: Any, name: str) -> None:
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    moments = state.get("state") if isinstance(state, dict) else None
    groups = state.get("param_groups") if isinstance(state, dict) else None
    if not isinstance(moments, dict) or not isinstance(groups, list):
        raise BadFile(f"{name} is no state of an optimizer")
    order = [i for group in groups if isinstance(group, dict) for i in group.get("params", ())]
    for index, kept in moments.items():
        if index not in order or order.index(index) >= len(parameters) or not isinstance(kept, dict):
            raise BadFile(f"{name} keeps something of a parameter {index!r:.50} that is not there")
        shape = parameters[order.index(index)].shape
        for key, value in kept.items():
            wanted = shape if key in _MOMENTS else torch.Size(()) if key == "step" else None
            if wanted is not None and (not isinstance(value, torch.Tensor) or value.shape != wanted):
                raise BadFile(f"{name}: {key} of parameter {index} must be a tensor of shape {tuple(wanted)}")


def _forget_folder(attributes: dict[str, Any], warn: bool) -> None:
    """A file does not choose where this computer writes, nor does a loaded model write over the buffer of its run."""
    buffer_kwargs = attributes.get("replay_buffer_kwargs")
    folder = buffer_kwargs.pop("memory_map", None) if isinstance(buffer_kwargs, dict) else None
    if folder is not None and warn:
        warnings.warn(
            f"the replay buffer was in the folder {folder!r:.200}, the loaded model's is in memory: pass "
            "replay_buffer_kwargs={'memory_map': <folder>} to load for another folder",
            stacklevel=4,
        )


def _check_names(model: SafeFiles, attributes: dict[str, Any], name: str) -> None:
    """A file sets attributes, but never in the place of a method or of what belongs to the class."""
    own = vars(model)
    for key in attributes:
        if not key.isidentifier() or key.startswith("__") or (hasattr(type(model), key) and key not in own):
            raise BadFile(f"{name} is damaged or hostile: it sets {key!r:.100}, which is no attribute of a model")


def _check_sizes(model: Any, name: str) -> None:
    """What is allocated without torch, or object by object, and so out of the budget's sight."""
    if type(model.n_envs) is not int or not 1 <= model.n_envs <= MAX_ENVS:
        raise BadFile(f"{name}: n_envs must lie in [1, {MAX_ENVS}], not be {model.n_envs!r:.100}")
    for key, value in vars(model).items():
        if key.endswith("_kwargs") and key not in ("replay_buffer_kwargs", "rollout_buffer_kwargs"):
            _check_widths(value, f"{name}: {key}")
    buffer_class, size = getattr(model, "replay_buffer_class", None), getattr(model, "buffer_size", 1)
    most = MAX_TRANSITIONS
    if isinstance(buffer_class, type) and issubclass(buffer_class, HerReplayBuffer):
        most = MAX_HER_TRANSITIONS
    if type(size) is not int or not 1 <= size <= most:
        raise BadFile(f"{name}: buffer_size must lie in [1, {most}], not be {size!r:.100}: pass another one to load")


def _check_widths(value: Any, name: str) -> None:
    if isinstance(value, int) and abs(value) > MAX_WIDTH:
        raise BadFile(f"{name} holds {value!r:.100}, but sizes of networks are at most {MAX_WIDTH}")
    if isinstance(value, dict):
        for key, item in value.items():
            _check_widths(item, f"{name}.{key}")
    elif isinstance(value, (list, tuple)):
        for item in value:
            _check_widths(item, name)
