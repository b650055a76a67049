"""Saving and loading of whole models, for both families, in files that run no code."""

import io
import pathlib
from collections.abc import Collection, Iterable, Sequence
from typing import Any, ClassVar, TypeVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info

from sb3_sample.arguments import NoPolicy, check_load, check_policy_class, naming_changes
from sb3_sample.saving import container, notice, paths
from sb3_sample.saving.budget import Budget
from sb3_sample.saving.checks import (
    ParametersDoNotFit,
    check_counts,
    check_environment,
    check_kinds,
    check_names,
    check_sizes,
    library_class,
)
from sb3_sample.saving.classes import check_trusted
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.kept import Kept, declared
from sb3_sample.saving.model_tree import KIND, Content, Description
from sb3_sample.warn import warn

Self = TypeVar("Self", bound="SafeFiles")


class SafeFiles(BaseAlgorithm):
    """
    Base of the algorithms, before Stable-Baselines3's, with ``save``, ``load`` and ``set_parameters`` for files that
    hold JSON and tensors, and run no code. See docs/saving.md.
    """

    _kept: ClassVar[dict[str, Kept]] = {
        "_trusted_modules": Kept.NOWHERE,
        "_told": Kept.NOWHERE,
        # Stable-Baselines3's. Rollouts are filled anew before they are used.
        "device": Kept.NOWHERE,
        "replay_buffer": Kept.NOWHERE,
        "rollout_buffer": Kept.NOWHERE,
        "lr_schedule": Kept.NOWHERE,
        "env": Kept.NOWHERE,
        "_vec_normalize_env": Kept.NOWHERE,
        "_logger": Kept.NOWHERE,
        "_custom_logger": Kept.NOWHERE,
        # Of the present ``learn``: its clock, and how far it goes.
        "start_time": Kept.IN_FILES,
        "_total_timesteps": Kept.IN_FILES,
    }
    #: The class from which the policies of these algorithms are derived.
    policy_base: ClassVar[type] = BasePolicy
    #: Modules that the caller who loaded the model vouches for. A file never sets them.
    _trusted_modules: tuple[str, ...] = ()
    #: Warnings given about the model's files.
    _told: frozenset[str] = frozenset()

    def _excluded_save_params(self) -> list[str]:
        left_out = [name for name, places in declared(type(self)).items() if Kept.IN_FILES not in places]
        return [*super()._excluded_save_params(), *left_out]

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
        Save the model, as in Stable-Baselines3, but to a file that runs no code when it is loaded. An existing file is
        replaced in one step, and only when the new one is complete.

        Classes and functions are written by their names, and a schedule without a name as a table. Attributes that no
        file can hold are left out, with one warning for a model (``learn`` gives it when the training starts).

        :param path: path, to which ".zip" is added if it has no suffix, or a binary file open for writing
        :param exclude: attributes to leave out, besides those that always are
        :param include: attributes to save that would be left out
        :param allow_pickle: whether to write Stable-Baselines3's own, pickled format instead, which can hold anything
        :param trusted_modules: modules, or packages of modules, that will be passed to ``load`` as trusted, so that no
            warning is needed
        :raises ValueError: if a parameter is not finite
        :raises OSError: if the file cannot be written
        """
        trusted = check_trusted(trusted_modules)
        if allow_pickle:
            super().save(path, exclude, include)
            return
        described = Description(self, exclude or (), include or ())
        tree = described.tree(SafeFiles)
        notice.say_once(self, described.encoder, trusted)
        container.write(paths.to_write(path, "zip"), KIND, tree, described.encoder.tensors)

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
        Load a model, as in Stable-Baselines3. Nothing in the file is run, whoever wrote it. The file has everything
        that was learned: networks, numbers, optimizers; of the on-policy family also the models of the environment and
        the transitions that they learn from.

        :param path: file, or where ``save`` wrote it
        :param env: environment for further training, or its id; none is needed for prediction
        :param device: "auto", "cpu", "cuda", ...
        :param custom_objects: objects that replace what the file holds under their names
        :param print_system_info: whether to print the saved and the present versions
        :param force_reset: whether the environment is reset before training continues
        :param allow_pickle: whether a file in Stable-Baselines3's own, pickled format is loaded too, which can run any
            code that its author wanted
        :param trusted_modules: modules, or packages of modules, whose classes and functions may be named by the file,
            and by files that the model reads later
        :param kwargs: arguments of the constructor that replace the file's, which are then not read: ``policy`` (a
            class), ``policy_kwargs``, ``action_noise``, ``learning_rate``, ... The initial value of a learned number
            (``initial_...``, ``ent_coef="auto_..."``) applies from the next reset on: its present value comes from the
            file
        :return: the model
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile, pickled, of another class, or names
            something that is not trusted; or lacks something that must then be passed
        :raises ParametersDoNotFit: (a ``ValueError``) if its parameters are not those of the model that it describes
        :raises ValueError: if ``kwargs`` holds anything else, values that are not allowed, or values that the file's
            parameters do not fit
        """
        check_load(cls, SafeFiles, env, device, kwargs)
        given, kwargs = kwargs, {**cls._implied(kwargs), **kwargs}
        with naming_changes(given):
            trusted, custom_objects = check_trusted(trusted_modules), custom_objects or {}
            for name in {"policy", "policy_class"} & kwargs.keys():
                kwargs["policy_class"] = cls._policy_class(kwargs.pop(name))
            if "stats_window_size" in kwargs:
                kwargs["_stats_window_size"] = kwargs.pop("stats_window_size")
            for name in {"policy_kwargs", "replay_buffer_kwargs"} & kwargs.keys():
                kwargs[name] = kwargs[name] or {}
            try:
                with paths.opened(path, "zip") as file:
                    content = Content(file, cls, SafeFiles, trusted)
            except PickledFile:
                if not allow_pickle:
                    raise
                try:
                    made = None if env is None else maybe_make_env(env, 0)
                    model = super().load(path, made, device, custom_objects, print_system_info, force_reset, **kwargs)
                except (TypeError, NoPolicy) as error:
                    raise ValueError(
                        f"{path} holds no model of {cls.__name__} ({error}): a model of one of Stable-Baselines3's own "
                        "algorithms has other networks, and is loaded by its own class"
                    ) from error
                model._trusted_modules = trusted
                return model
            kwargs = cls._completed(content, kwargs)
            if print_system_info:
                print("== CURRENT SYSTEM INFO ==")
                get_system_info()
                print("== SAVED MODEL SYSTEM INFO ==")
                print("\n".join(f"- {name}: {version}" for name, version in content.versions.items()))
            attributes = content.attributes(kwargs.keys(), custom_objects)
            if "policy_kwargs" in kwargs:
                content.check_policy_kwargs(kwargs["policy_kwargs"])
            _forget_folder(attributes, say_so=env is not None)
            model = cls._made(content, attributes, kwargs, custom_objects, env, device, force_reset)
            model._trusted_modules = trusted
            dropped = [name for name in content.without_place() if name not in custom_objects]
            if dropped:
                warn(f"{content.another_class()}A {cls.__name__} makes no use of {', '.join(dropped)}")
            if content.left_out:
                shown = ", ".join(f"{name} ({reason:.200})" for name, reason in content.left_out.items())
                warn(f"{content.name} was saved without {shown}: the model has its defaults there")
            return model

    @classmethod
    def _implied(cls, kwargs: dict[str, Any]) -> dict[str, Any]:
        """
        :param kwargs: arguments that the caller of ``load`` has given
        :return: further attributes of the file that these replace, with their values
        """
        return {}

    @classmethod
    def _completed(cls, content: Content, kwargs: dict[str, Any]) -> dict[str, Any]:
        """
        :param content: of the file
        :param kwargs: arguments that the caller of ``load`` has given
        :return: the same, completed from the file
        :raises ValueError: if they cannot belong to the model in the file
        """
        return kwargs

    @classmethod
    def _made(
        cls: type[Self],
        content: Content,
        attributes: dict[str, Any],
        kwargs: dict[str, Any],
        custom_objects: dict[str, Any],
        env: GymEnv | str | None,
        device: torch.device | str,
        force_reset: bool,
    ) -> Self:
        """The model of a file: ``attributes`` are the file's, ``kwargs`` the caller's, the rest as in ``load``."""
        policy_class = kwargs.get("policy_class", attributes.get("policy_class"))
        if policy_class is None:
            raise BadFile(f"{content.name} lacks policy_class: pass policy= to load")
        given, lacks = {*kwargs, *custom_objects}, ""
        if env is not None:
            verbose = kwargs.get("verbose", attributes.get("verbose", 0))
            env = cls._wrap_env(maybe_make_env(env, verbose), verbose)
            spaces = [attributes.get(name, getattr(env, name)) for name in ("observation_space", "action_space")]
            check_environment(env, *spaces)
            noise = attributes.get("action_noise")
            if isinstance(noise, VectorizedActionNoise) and noise.n_envs != env.num_envs:
                # ``learn`` makes one for each environment again.
                attributes["action_noise"] = noise.base_noise
            attributes["n_envs"] = env.num_envs
            if force_reset:
                attributes["_last_obs"] = None
        elif missing := [name for name in ("observation_space", "action_space") if name not in attributes]:
            raise BadFile(f"{content.name} lacks {' and '.join(missing)}: pass env= to load")
        try:
            with Budget(content.tensors, content.name):
                model = cls(policy=policy_class, env=env, device=device, _init_setup_model=False)  # type: ignore[call-arg]
                lacks = content.another_class() or content.lacking(model, given)
                check_names(model, attributes, content.name)
                library: Any = library_class(cls)
                plain = model if library is cls else library(policy_class, None, device=device, _init_setup_model=False)
                check_kinds(plain, {k: v for k, v in attributes.items() if k not in given}, content.name)
                vars(model).update({"n_envs": 1, **attributes, **kwargs})
                check_sizes(model, content.name, given)
                check_counts(model, content.name)
                model._setup_model()
            if kwargs:
                content.check_shapes(model)
            content.check_parameters(model)
            model._take_parameters(content.parameters(model), device=device, given=given)
            content.set_own(model, given)
            if model.use_sde:
                model.policy.reset_noise()  # type: ignore[operator]
        except (BadFile, ParametersDoNotFit) as error:
            if not lacks:
                raise
            kind = BadFile if isinstance(error, BadFile) else ParametersDoNotFit
            raise kind(f"{lacks}{error}") from error
        except Exception as error:
            # With the caller's arguments, the file's content need not be at fault; content of another class is.
            if given and not content.another_class():
                raise
            why = f"{type(error).__name__}: {error}"
            if isinstance(error, MemoryError):
                why = f"{why} (pass a smaller buffer_size= or n_steps= to load)"
            raise BadFile(f"{lacks}{content.name}: no {cls.__name__} can be made of what it holds: {why}") from error
        return model

    def _arguments_in_parameters(self, given: Collection[str] | None) -> list[torch.Tensor]:
        """
        :param given: names of arguments; None: all of the constructor's
        :return: tensors among the parameters that are nothing but values of these arguments
        """
        return []

    @classmethod
    def _policy_class(cls, policy: Any) -> Any:
        check_policy_class(cls, policy)
        return cls.policy_aliases.get(policy, policy)

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
        Load parameters, as in Stable-Baselines3. The optimizers' moments are loaded, but their settings (learning rate,
        weight decay, ...) and a fixed temperature stay this model's, so that other settings passed to ``load`` take
        effect.

        :param load_path_or_dict: a file, or parameters as ``get_parameters`` gives them
        :param exact_match: whether parameters for every module must be there, and no others
        :param device: "auto", "cpu", "cuda", ...
        :param allow_pickle: see ``load``
        :param trusted_modules: see ``load``; besides those that the model was loaded with
        :raises BadFile: (a ``ValueError``) if the file is damaged, hostile, pickled, or of another class
        :raises ParametersDoNotFit: (a ``ValueError``) if the parameters are of other networks or parts
        """
        self._take_parameters(load_path_or_dict, exact_match, device, allow_pickle, trusted_modules, given=None)

    def _take_parameters(
        self,
        source: Any,
        exact_match: bool = True,
        device: torch.device | str = "auto",
        allow_pickle: bool = False,
        trusted_modules: Sequence[str] = (),
        given: Collection[str] | None = (),
    ) -> None:
        """
        Load parameters of this very model, with the numbers among them that stand for arguments.

        :param source: as in :meth:`set_parameters`
        :param exact_match: likewise
        :param device: likewise
        :param allow_pickle: likewise
        :param trusted_modules: likewise
        :param given: names of arguments whose numbers stay this model's; None: all of the constructor's
        """
        parameters: Any = source
        content = None
        if not isinstance(source, dict):
            try:
                trusted = (*self._trusted_modules, *check_trusted(trusted_modules))
                with paths.opened(source, "zip") as file:
                    content = Content(file, type(self), SafeFiles, trusted)
                content.check_parameters(self)
                parameters = content.parameters(self)
            except PickledFile:
                if not allow_pickle:
                    raise
        named = {name: recursive_getattr(self, name) for name in self._get_torch_save_params()[0]}
        optimizers = [value for value in named.values() if isinstance(value, torch.optim.Optimizer)]
        settings = [
            [{key: value for key, value in group.items() if key != "params"} for group in optimizer.param_groups]
            for optimizer in optimizers
        ]
        kept = [(tensor, tensor.clone()) for tensor in self._arguments_in_parameters(given)]
        try:
            super().set_parameters(parameters, exact_match, device)
        except Exception as error:
            if isinstance(error, (BadFile, ParametersDoNotFit)) or (
                content is None and not isinstance(error, ValueError)
            ):
                raise
            where = "" if content is None else f"{content.name}: "
            raise ParametersDoNotFit(f"{where}{error}") from error
        with torch.no_grad():
            for tensor, value in kept:
                tensor.copy_(value)
        for optimizer, own_groups in zip(optimizers, settings, strict=True):
            for group, own in zip(optimizer.param_groups, own_groups, strict=True):
                for key in group.keys() - own.keys() - {"params"}:
                    del group[key]
                group.update(own)
        if content is not None:
            content.set_own(self, only_variables=True)


def class_of(path: str | pathlib.Path) -> str:
    """
    :param path: file of a model, or where ``save`` wrote it
    :return: the class that the file says the model is of, as "module:name"
    :raises PickledFile: (a ``BadFile``) if it is in Stable-Baselines3's own format
    :raises BadFile: (a ``ValueError``) if it is damaged
    """
    anything: Any = SafeFiles
    with paths.opened(path, "zip") as file:
        return Content(file, anything, SafeFiles, ()).tree["classes"][0]


def _forget_folder(attributes: dict[str, Any], say_so: bool) -> None:
    """
    Forget the buffer's folder: a file must not choose where this computer writes, and a loaded model must not overwrite
    the buffer of its run.
    """
    buffer_kwargs = attributes.get("replay_buffer_kwargs")
    folder = buffer_kwargs.pop("memory_map", None) if isinstance(buffer_kwargs, dict) else None
    if folder is not None and say_so:
        warn(
            f"the replay buffer was in the folder {folder!r:.200}, the loaded model's is in memory: pass "
            "replay_buffer_kwargs={'memory_map': <folder>} to load for another folder"
        )
