"""Write and read the tree of a model's file."""

import collections.abc
import functools
import itertools
import json
import typing
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import recursive_getattr, recursive_setattr

from sb3_sample.own_classes import names_in
from sb3_sample.saving import container, notice, unsaved
from sb3_sample.saving.checks import (
    NEVER,
    ParametersDoNotFit,
    check_extra,
    check_finite,
    check_metadata,
    hints_of,
    library_class,
)
from sb3_sample.saving.classes import PACKAGES, NotPortable, has_state, may_be_set, path_of, within
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.decoding import NotTrusted, decode
from sb3_sample.saving.encoding import LEFT_OUT, Encoder, Lenient, is_left_out
from sb3_sample.saving.moments import check_moments
from sb3_sample.saving.training_state import argument_names

KIND = "model"
#: Attributes that follow from the rest, or that the caller of ``load`` decides.
_NOT_READ = ("device", "lr_schedule")
_SECTIONS = ("classes", "attributes", "parameters", "metadata")


class Description:
    """
    The content of a model's file, to be written.

    :param model: the algorithm
    :param exclude: attributes to leave out, besides those that always are
    :param include: attributes to write that would be left out
    """

    def __init__(self, model: BaseAlgorithm, exclude: Iterable[str] = (), include: Iterable[str] = ()):
        self._model = model
        #: Holds the tensors, and the notes for warnings about the file.
        self.encoder = Lenient({})
        included, always = set(include), set(model._excluded_save_params())
        modules = {name.split(".")[0] for names in model._get_torch_save_params() for name in names}
        skipped = (always | set(exclude)) - included | modules
        schedules = schedule_names(library_class(type(model)))
        values = {name: value for name, value in vars(model).items() if name not in skipped}
        #: A subclass's own modules and the like, which are written by their states.
        self._own = {name: value for name, value in values.items() if name not in always and has_state(type(value))}
        self.attributes: dict[str, Any] = {}
        self._tensors: dict[str, list[str]] = {}
        for name, value in values.items():
            if name not in self._own:
                n_before = len(self.encoder.tensors)
                self.attributes[name] = self._attribute(value, name, name in schedules, name in always)
                self._tensors[name] = list(itertools.islice(self.encoder.tensors, n_before, None))
        self._keep_small()
        self.encoder.left_out.update(unsaved.changed(model, vars(model).get("_plain_attributes", {})))

    def _attribute(self, value: Any, name: str, is_schedule: bool, is_derived: bool) -> Any:
        if name in NEVER:
            return self.encoder.leave_out(name, "it belongs to the program that trains")
        if not may_be_set(type(self._model), name):
            return self.encoder.leave_out(name, "it takes the place of what the class does")
        if is_derived and not isinstance(value, (bool, int, float, str, list, dict)):
            return self.encoder.leave_out(name, "it follows from the rest")
        return self.encoder.attempt(value, name, is_schedule)

    def _keep_small(self) -> None:
        """Leave out the largest attributes of a model that a reader would otherwise refuse as too large."""
        texts = {name: json.dumps(tree).encode() for name, tree in self.attributes.items()}
        for most, measure in (
            (container.MAX_JSON_OF[KIND], lambda name: len(texts[name])),
            (container.MAX_VALUES, lambda name: container.n_values(texts[name])),
            (container.MAX_TENSORS, lambda name: len(self._tensors[name])),
        ):
            sizes = {name: measure(name) for name in texts}
            for name in sorted(sizes, key=lambda name: -sizes[name]):
                if sum(sizes.values()) <= most // 2:
                    break
                del sizes[name]
                reason = f"it takes {len(texts.pop(name))} bytes of JSON"
                reason += f" and {len(self._tensors[name])} arrays" if self._tensors[name] else ""
                self.attributes[name] = self.encoder.leave_out(name, reason)
                for key in self._tensors[name]:
                    del self.encoder.tensors[key]

    def tree(self, family: type) -> dict[str, Any]:
        """
        :param family: base of the algorithms whose files this class reads
        :return: the whole tree, with the parameters
        :raises ValueError: if a parameter is not finite
        """
        model, parameters = self._model, self._model.get_parameters()
        variables = {name: recursive_getattr(model, name) for name in model._get_torch_save_params()[1]}
        own = {name: value.detach() for name, value in variables.items() if isinstance(value, torch.Tensor)}
        own |= {name: value.state_dict() for name, value in self._own.items()}
        for name, state in {**parameters, **own}.items():
            owner = recursive_getattr(model, name)
            check_finite(getattr(owner, "_orig_mod", owner), state, name, "cannot be saved, since it", ValueError)
        metadata = {name: getattr(state, "_metadata", None) for name, state in parameters.items()}
        tree = {
            "classes": [path_of(cls) for cls in type(model).__mro__ if issubclass(cls, family)],
            "attributes": self.attributes,
            "parameters": {name: self._state(state, name) for name, state in parameters.items()},
            # Versions that torch's modules record for their parameters.
            "metadata": {name: self.encoder.attempt(value, name) for name, value in metadata.items()},
        }
        # Further attributes of a subclass: files of this package's own classes have no such section.
        return tree | ({"own": {name: self.encoder.attempt(state, name) for name, state in own.items()}} if own else {})

    def _state(self, state: Any, name: str) -> Any:
        """Write a state entry by entry, so that an entry that cannot be written does not cost the rest."""
        if type(state) not in (dict, OrderedDict) or not all(type(key) is str for key in state):
            return self.encoder.attempt(state, name)
        entries = {key: self.encoder.attempt(value, f"{name}.{key}") for key, value in state.items()}
        return {"dict" if type(state) is dict else "ordered_dict": entries}


class Content:
    """
    The content of a model's file, as read.

    :param file: the file
    :param cls: the class that is to be loaded
    :param family: base of the algorithms whose files it reads
    :param trusted: modules that the file may name
    :raises BadFile: if it is no such file
    """

    def __init__(self, file: Any, cls: type, family: type, trusted: tuple[str, ...]):
        self.name = str(getattr(file, "name", "the file"))
        self._cls, self._trusted = cls, trusted
        self.tree, self._stored, self.versions = container.read_with_versions(file, KIND)
        #: Tensors to which the budget is proportional.
        self.tensors = dict(self._stored)
        tree = self.tree
        if not isinstance(tree, dict) or tree.keys() - {"own"} != set(_SECTIONS):
            raise BadFile(f"{self.name} is damaged: it does not hold what a model consists of")
        classes = tree["classes"]
        if not isinstance(classes, list) or not classes or not all(isinstance(path, str) for path in classes):
            raise BadFile(f"{self.name} is damaged: it does not say of which class the model is")
        if not all(isinstance(tree.get(key, {}), dict) for key in ("attributes", "parameters", "metadata", "own")):
            raise BadFile(f"{self.name} is damaged: it does not hold what a model consists of")
        self._check_class([path_of(base) for base in cls.__mro__ if issubclass(base, family)])
        #: Attributes that the file was written without, and that the caller has not given, with the reason.
        self.left_out: dict[str, str] = {}
        self._parameters: dict[str, Any] | None = None
        self._anew: set[str] = set()

    def _check_class(self, ours: list[str]) -> None:
        """Check the class; if a program has moved its own class, the nearest class of this package above it counts."""
        theirs = self.tree["classes"]
        starts = {classes[0] for classes in (ours, theirs)}
        starts |= {next((path for path in classes if within(path, PACKAGES)), classes[0]) for classes in (ours, theirs)}
        if not starts & set(ours) & set(theirs):
            raise BadFile(
                f"{self.name} holds a model of {theirs[0]}, which is neither {self._cls.__name__} nor above or below "
                "it: load it with its own class"
            )

    def another_class(self) -> str:
        """
        :return: text for the message if the file turns out not to fit because it is of another class than is loaded;
            empty if it is of the same class
        """
        theirs = self.tree["classes"][0]
        if theirs == path_of(self._cls):
            return ""
        name = theirs.rpartition(":")[2]
        return f"{self.name} holds a model of {name}, not of {self._cls.__name__}: load it with {name}.load. "

    def without_place(self) -> list[str]:
        """
        :return: for a file of a subclass of the loaded class, the arguments that the subclass adds; if this program
            does not have the subclass, the attributes that the methods of the loaded class do not use
        """
        path = self.tree["classes"][0]
        if path_of(self._cls) not in self.tree["classes"][1:]:
            return []
        known, theirs = argument_names(self._cls), next((c for c in _below(self._cls) if path_of(c) == path), None)
        if theirs is None:
            methods = (value for base in self._cls.__mro__ for value in vars(base).values())
            known |= {name for method in methods for name in names_in(method)}
            return [name for name in self.tree["attributes"] if name not in known]
        return [name for name in self.tree["attributes"] if name in argument_names(theirs) - known]

    def attributes(self, given: Collection[str], custom_objects: dict[str, Any]) -> dict[str, Any]:
        """
        :param given: attributes that the caller passes, so that the file's are not read
        :param custom_objects: values that replace the file's
        :return: the values of the others
        :raises BadFile: if one is damaged, names something that is not trusted, or is left out and needed
        """
        attributes, refused = {}, []
        for name, tree in self.tree["attributes"].items():
            if name in given or name in _NOT_READ:
                continue
            if name in custom_objects:
                attributes[name] = custom_objects[name]
            elif is_left_out(tree):
                self.left_out[name] = reason = tree[LEFT_OUT]
                if name.endswith("_kwargs"):
                    refused.append(f"{name} was left out ({reason:.200}), so that load needs {name}=")
            else:
                try:
                    attributes[name] = self._decoded(tree, name)
                except NotTrusted as error:
                    refused.append(f"{error}: {notice.need(self._cls, name, error.path, self._trusted)}")
        if refused:
            raise BadFile(f"{self.name}: {'; '.join(refused)}")
        for name, kind in (("policy_kwargs", dict), ("verbose", int), ("policy_class", type)):
            if name in attributes and not isinstance(attributes[name], kind):
                raise BadFile(f"{self.name} is damaged: {name} is {attributes[name]!r:.100}")
        attributes.get("policy_kwargs", {}).pop("device", None)
        return attributes

    def _decoded(self, tree: Any, name: str) -> Any:
        try:
            return decode(tree, self._stored, name, self._trusted)
        except NotTrusted:
            raise
        except BadFile as error:
            raise BadFile(f"{self.name}: {error}") from error

    def classes_in(self, name: str) -> list[tuple[str, Callable[[], Any]]] | None:
        """
        Read a sequence of classes, or of pairs of a class and its arguments, without requiring trust in the classes.

        :param name: the attribute
        :return: the qualified names of the classes, with functions that read their arguments (and raise ``BadFile`` if
            they are damaged, or name something that is not trusted); None if the file has no such sequence
        """
        listed = _items(self.tree["attributes"].get(name))
        entries = [_items(each) or [each] for each in listed or ()]
        paths = [entry[0].get("import") if isinstance(entry[0], dict) else None for entry in entries]
        if listed is None or not all(isinstance(path, str) for path in paths):
            return None
        reads = [functools.partial(self._arguments, entry, name) for entry in entries]
        return [(str(path).rpartition(":")[2], read) for path, read in zip(paths, reads, strict=True)]

    def _arguments(self, entry: list[Any], name: str) -> Any:
        """Arguments in a pair of a class and its arguments."""
        try:
            return self._decoded(entry[1], name) if len(entry) == 2 else {}
        except NotTrusted as error:
            raise BadFile(f"{self.name}: {error}: {notice.need(self._cls, name, error.path, self._trusted)}") from error

    def check_policy_kwargs(self, given: Any) -> None:
        """
        :param given: policy_kwargs that take the place of the file's
        :raises ValueError: if they differ, as far as can be decided without requiring trust
        """
        theirs = self.tree["attributes"].get("policy_kwargs")
        if theirs is None or is_left_out(theirs) or _agree(theirs, given, "policy_kwargs"):
            return
        entries = theirs.get("dict") if isinstance(theirs, dict) else None
        if not isinstance(entries, dict) or not isinstance(given, dict):
            raise ValueError(f"policy_kwargs must be those of the file, or be left out, not {given!r}")
        differences = []
        for key in [*entries, *(key for key in given if key not in entries)]:
            if key in entries and key in given and _agree(entries[key], given[key], key):
                continue
            in_file = f"is {self._shown(entries[key], key)}" if key in entries else "is not there"
            differences.append(f"{key} {in_file} and {f'here {given[key]!r}' if key in given else 'here left out'}")
        raise ValueError(
            f"policy_kwargs must be those of the file, or be left out; in the file, {'; '.join(differences)}"
        )

    def _shown(self, tree: Any, name: str) -> str:
        """A value of the file in words, for a message; a class that is not trusted is shown by its path."""
        try:
            return repr(self._decoded(tree, name))
        except NotTrusted as error:
            return error.path

    def parameters(self, model: BaseAlgorithm) -> dict[str, Any]:
        """
        :param model: the model that they are for, whose own parameters replace those that the file was written without
        :return: the parameters that ``get_parameters`` gave when the file was written
        :raises BadFile: if they are damaged
        """
        if self._parameters is None:
            try:
                kept = (name for name in self.tree["parameters"] if name not in self._anew)
                self._parameters = {name: self._state(model, name) for name in kept}
                for name in self._anew.intersection(model._get_torch_save_params()[0]):
                    self._parameters[name] = recursive_getattr(model, name).state_dict()
                for name, tree in self.tree["metadata"].items():
                    if isinstance(state := self._parameters.get(name), OrderedDict) and not is_left_out(tree):
                        metadata = vars(state)["_metadata"] = self._decoded(tree, name)
                        check_metadata(metadata, f"{self.name}: {name}")
            except NotTrusted as error:
                raise BadFile(f"{self.name}: {error}: trusted_modules=[...] takes it") from error
        return self._parameters

    def start_anew(self, name: str) -> None:
        """
        Take parameters that the caller replaces from the new model, whether the file has them or not.

        :param name: name of the parameters
        """
        self._anew.add(name)

    def _state(self, model: BaseAlgorithm, name: str) -> Any:
        tree = self.tree["parameters"][name]
        entries: Any = next(iter(tree.values()), None) if isinstance(tree, dict) else None
        lacking = [key for key, entry in entries.items() if is_left_out(entry)] if isinstance(entries, dict) else []
        if not (is_left_out(tree) or lacking):
            return self._decoded(tree, name)
        self._check_known(model, name)
        own = recursive_getattr(model, name).state_dict()
        if is_left_out(tree):
            self.left_out[name] = tree[LEFT_OUT]
            return own
        self.left_out.update({f"{name}.{key}": entries[key][LEFT_OUT] for key in lacking})
        kept = {key: entry for key, entry in entries.items() if key not in lacking}
        return self._decoded({next(iter(tree)): kept}, name) | {key: own[key] for key in lacking if key in own}

    def _check_known(self, model: BaseAlgorithm, name: str) -> None:
        if name not in model._get_torch_save_params()[0]:
            raise BadFile(f"{self.name} has parameters of {name!r:.100}, which a {self._cls.__name__} has not")

    def check_shapes(self, model: BaseAlgorithm) -> None:
        """
        Check names and shapes before everything else in which the file must fit: with arguments of the caller's own, a
        mismatch is not the file's fault.

        :param model: the model that the parameters are for
        :raises ParametersDoNotFit: if a tensor has another shape there, or is only there or only here
        """
        for name in model._get_torch_save_params()[0]:
            owner, state = recursive_getattr(model, name), self.parameters(model).get(name)
            if not isinstance(owner, torch.nn.Module) or not isinstance(state, dict):
                continue
            owned = owner.state_dict()
            for key, own in owned.items():
                theirs = state.get(key)
                if isinstance(own, torch.Tensor) and isinstance(theirs, torch.Tensor) and own.shape != theirs.shape:
                    raise ParametersDoNotFit(
                        f"{name}.{key} has the shape {tuple(theirs.shape)} in the file and {tuple(own.shape)} here"
                    )
            if others := sorted(map(str, owned.keys() ^ state.keys())):
                where = "here and not in the file" if others[0] in owned else "in the file and not here"
                raise ParametersDoNotFit(f"{name}.{others[0]:.200} is {where}")

    def check_parameters(self, model: BaseAlgorithm) -> None:
        """
        :param model: the model that they are for
        :raises BadFile: if one is not finite, or an optimizer's state for one is not of its shape
        """
        known = model._get_torch_save_params()[0]
        for name, state in self.parameters(model).items():
            # Others are refused by ``set_parameters``.
            owner = recursive_getattr(model, name) if name in known else None
            check_finite(owner, state, f"{self.name}: {name}", "", BadFile)
            if isinstance(owner, torch.nn.Module):
                check_extra(owner, state, f"{self.name}: {name}")
            if isinstance(owner, torch.optim.Optimizer):
                check_moments(owner, state, f"{self.name}: {name}")

    def set_own(self, model: BaseAlgorithm, given: Collection[str] = (), only_variables: bool = False) -> None:
        """
        Restore the state that a subclass has besides parameters: tensors without a module, as Stable-Baselines3's
        ``load`` does, and the states of modules and the like that are not named as parameters.

        :param model: the model, set up
        :param given: names of the values that the caller passes
        :param only_variables: whether to leave the latter alone
        :raises BadFile: if something does not belong to the model, or is not finite
        """
        names, variables = model._get_torch_save_params()
        taken = {name.split(".")[0] for name in names} | set(model._excluded_save_params())
        for name, tree in self.tree.get("own", {}).items():
            if name in given or (only_variables and name not in variables):
                continue
            if is_left_out(tree):
                self.left_out[name] = tree[LEFT_OUT]
                continue
            own = recursive_getattr(model, name, None) if name in variables else vars(model).get(name)
            if name not in variables and (name in taken or not may_be_set(type(model), name)):
                raise BadFile(f"{self.name} is damaged or hostile: {name!r:.100} is nothing of a subclass's own")
            if own is None:
                self.left_out[name] = "a state of something that this model has not"
                continue
            value = self._decoded(tree, name)
            check_finite(own, value, f"{self.name}: {name}", "", BadFile)
            if isinstance(own, torch.Tensor) and isinstance(value, torch.Tensor) and own.shape == value.shape:
                recursive_setattr(model, f"{name}.data", value.to(own))
            elif has_state(type(own)) and isinstance(value, dict):
                if isinstance(own, torch.optim.Optimizer):
                    check_moments(own, value, f"{self.name}: {name}")
                own.load_state_dict(value)
            else:
                raise BadFile(f"{self.name}: {name!r:.100} is no state of what the model has there")

    def lacking(self, model: BaseAlgorithm, given: Collection[str]) -> str:
        """
        :param model: an algorithm with the defaults of its constructor
        :param given: names of the values that the caller passes
        :return: text for the message if the file turns out not to fit: the arguments that it lacks, if any
        """
        names = (argument_names(type(model)) & vars(model).keys()) - self.tree["attributes"].keys()
        names -= {"env", "device", *given, *model._excluded_save_params()}
        # A model has its spaces from the file or from the environment, and never by default.
        names -= {"observation_space", "action_space"}
        if not names:
            return ""
        wanted = " or ".join(f"{name}=" for name in sorted(names))
        return f"{self.name} lacks {', '.join(sorted(names))}, for which the defaults stand (load takes {wanted}): "


def _below(cls: type) -> Iterator[type]:
    classes: list[type] = cls.__subclasses__()
    for each in classes:
        yield each
        yield from _below(each)


def _items(tree: Any) -> list[Any] | None:
    """Entries of a list or a tuple in a file; None if it is neither."""
    inside = tree.get("tuple") if isinstance(tree, dict) else tree
    return inside if isinstance(inside, list) else None


def _agree(theirs: Any, given: Any, name: str) -> bool:
    """Whether a value can be the one that a file describes; any value matches a description that requires trust."""
    tag, inside = next(iter(theirs.items())) if isinstance(theirs, dict) and theirs else ("", theirs)
    if tag == "dict":
        alike = isinstance(inside, dict) and isinstance(given, dict) and inside.keys() == given.keys()
        return alike and all(_agree(entry, given[key], f"{name}.{key}") for key, entry in inside.items())
    if tag in ("instance", "enum") or (tag == "import" and not within(str(inside), PACKAGES)):
        return True
    if isinstance(theirs, list) and isinstance(given, list):
        pairs = enumerate(zip(theirs, given, strict=False))
        return len(theirs) == len(given) and all(_agree(entry, item, f"{name}[{i}]") for i, (entry, item) in pairs)
    try:
        return bool(Encoder({}).encode(given, name) == theirs)
    except NotPortable:
        return False


@functools.cache
def schedule_names(cls: type) -> frozenset[str]:
    """
    :param cls: class of an algorithm
    :return: the arguments of its constructor, and of those of its bases, that take a schedule
    """
    kinds = {
        name: {typing.get_origin(part) for part in (hint, *typing.get_args(hint))}
        for name, hint in hints_of(cls).items()
    }
    return frozenset(name for name, origins in kinds.items() if collections.abc.Callable in origins)
