"""Saving and loading of whole models, for both families, in files that run no code."""

import io
import pathlib
import warnings
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from typing import Any, TypeVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info

from sb3_sample.saving import container, paths
from sb3_sample.saving.budget import Budget
from sb3_sample.saving.checks import (
    ParametersDoNotFit,
    check_extra,
    check_finite,
    check_kinds,
    check_metadata,
    check_moments,
    check_names,
    check_sizes,
)
from sb3_sample.saving.classes import check_trusted, path_of
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode

KIND = "model"
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
            check_finite(recursive_getattr(self, name), state, name, "cannot be saved, since it", ValueError)
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
        env: GymEnv | str | None = None,
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
        :param env: environment to go on with, or its id; none is needed for prediction
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
        :raises ParametersDoNotFit: (a ``ValueError``) if its parameters are not those of the model that it describes
        """
        trusted = check_trusted(trusted_modules)
        try:
            with paths.opened(path, "zip") as file:
                content = _Content(file, cls, trusted)
        except PickledFile:
            if not allow_pickle:
                raise
            try:
                made = None if env is None else maybe_make_env(env, 0)
                return super().load(path, made, device, custom_objects, print_system_info, force_reset, **kwargs)
            except TypeError as error:
                raise ValueError(
                    f"{path} holds no model of {cls.__name__} ({error}): a model of one of Stable-Baselines3's own "
                    "algorithms has other networks, and is loaded by its own class"
                ) from error
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
            env = cls._wrap_env(maybe_make_env(env, attributes["verbose"]), attributes["verbose"])
            check_for_correct_spaces(env, attributes["observation_space"], attributes["action_space"])
            attributes["n_envs"] = env.num_envs
            if force_reset:
                attributes["_last_obs"] = None
        try:
            with Budget(content.tensors, content.name):
                model = cls(policy=attributes["policy_class"], env=env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
                check_names(model, attributes, content.name)
                given = {*kwargs, *(custom_objects or ())}
                check_kinds(model, {k: v for k, v in attributes.items() if k not in given}, content.name)
                vars(model).update(attributes)
                vars(model).update(kwargs)
                check_sizes(model, content.name, "buffer_size" in kwargs)
                model._setup_model()
            if kwargs:
                content.check_shapes(model)
            content.check_parameters(model)
            model.set_parameters(content.parameters(), exact_match=True, device=device)
            if model.use_sde:
                model.policy.reset_noise()  # type: ignore[operator]
        except (BadFile, ParametersDoNotFit):
            raise
        except Exception as error:
            # With arguments that the file does not have, its content need not be to blame.
            if kwargs or custom_objects:
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
        :raises ParametersDoNotFit: (a ``ValueError``) if the file's parameters are not those of this model
        """
        parameters: Any = load_path_or_dict
        content = None
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
        try:
            super().set_parameters(parameters, exact_match, device)
        except Exception as error:
            if content is None or isinstance(error, (BadFile, ParametersDoNotFit)):
                raise
            raise ParametersDoNotFit(f"{content.name}: {error}") from error
        for optimizer, own_groups in zip(optimizers, settings, strict=True):
            for group, own in zip(optimizer.param_groups, own_groups, strict=True):
                for key in group.keys() - own.keys() - {"params"}:
                    del group[key]
                group.update(own)


def class_of(path: str | pathlib.Path) -> str:
    """
    :param path: file of a model, or where ``save`` wrote it
    :return: the class that the file says the model is of, as "module:name"
    :raises PickledFile: (a ``BadFile``) if it is in Stable-Baselines3's own format
    :raises BadFile: (a ``ValueError``) if it is damaged
    """
    anything: Any = SafeFiles
    with paths.opened(path, "zip") as file:
        return _Content(file, anything, ()).tree["classes"][0]


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
        # Where the model is to be says the one who loads it.
        attributes.pop("device", None)
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
                    metadata = vars(state)["_metadata"] = self._decoded(tree, name)
                    check_metadata(metadata, f"{self.name}: {name}")
        return self._parameters

    def check_shapes(self, model: SafeFiles) -> None:
        """
        Before the file is asked whether it fits in every other respect: with arguments of the caller's own it is not to
        blame if it does not.

        :param model: for which the parameters are
        :raises ParametersDoNotFit: if a tensor has another shape there
        """
        for name in model._get_torch_save_params()[0]:
            owner, state = recursive_getattr(model, name), self.parameters().get(name)
            if not isinstance(owner, torch.nn.Module) or not isinstance(state, dict):
                continue
            for key, own in owner.state_dict().items():
                theirs = state.get(key)
                if isinstance(own, torch.Tensor) and isinstance(theirs, torch.Tensor) and own.shape != theirs.shape:
                    raise ParametersDoNotFit(
                        f"{name}.{key} has the shape {tuple(theirs.shape)} in the file and {tuple(own.shape)} here"
                    )

    def check_parameters(self, model: SafeFiles) -> None:
        """
        :param model: for which they are
        :raises BadFile: if one is not finite, or what an optimizer keeps of one is not of its shape
        """
        known = model._get_torch_save_params()[0]
        for name, state in self.parameters().items():
            # Others are refused by ``set_parameters``.
            owner = recursive_getattr(model, name) if name in known else None
            check_finite(owner, state, f"{self.name}: {name}", "", BadFile)
            if isinstance(owner, torch.nn.Module):
                check_extra(owner, state, f"{self.name}: {name}")
            if isinstance(owner, torch.optim.Optimizer):
                check_moments(owner, state, f"{self.name}: {name}")


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
