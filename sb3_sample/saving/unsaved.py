"""Plain attributes of a user's own parts and networks, which no ``state_dict`` holds."""

import functools
import hashlib
import inspect
import json
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from stable_baselines3.common.save_util import recursive_getattr
from torch import nn
from torch.optim import Optimizer

from sb3_sample.own_classes import names_in
from sb3_sample.saving.classes import PACKAGES, within
from sb3_sample.saving.encoding import Encoder, NotPortable, bytes_of

#: Attributes of every torch module.
_OF_EVERY_MODULE = frozenset(vars(nn.Module()))


def plain_attributes(model: Any) -> dict[str, str]:
    """
    Record the attributes of a user's own parts and networks that are plain data and are not saved.

    :param model: an algorithm, set up
    :return: a digest of each value, by the path of the module and the attribute's name
    """
    found = {}
    for path, module in _foreign_modules(model):
        cls: Any = type(module)
        of_libraries = _of_libraries(cls)
        listed = {id(optimizer) for optimizer in _listed(module)}
        for name, value in vars(module).items():
            if name in _OF_EVERY_MODULE or name in of_libraries or id(value) in listed:
                continue
            digest = _digest(value)
            if digest is not None:
                found[f"{path}.{name}"] = digest
    return found


def _listed(module: Any) -> Iterable[Optimizer]:
    return module.optimizers().values() if hasattr(module, "optimizers") else ()


def changed(model: Any, before: dict[str, str]) -> dict[str, str]:
    """
    :param model: an algorithm
    :param before: its :func:`plain_attributes` when it was made
    :return: the attributes that have changed since and are in no file, with the reason
    """
    reasons, named = {}, set()
    for place, digest in plain_attributes(model).items():
        path, _, name = place.rpartition(".")
        what = f"{type(recursive_getattr(model, path)).__name__}.{name}"
        # Networks and their targets have the same attribute, which is named once.
        if before.get(place) != digest and what not in named:
            named.add(what)
            reasons[place] = (
                f"{what} changes and is no buffer: use register_buffer, with persistent=False if it need not be saved, "
                "or get_extra_state and set_extra_state"
            )
    return reasons


#: Libraries whose classes save their own state.
_LIBRARIES = (*PACKAGES, "torch", "builtins", "abc", "typing")


def _foreign_modules(model: Any) -> Iterator[tuple[str, nn.Module]]:
    """Modules of classes from outside the libraries that do not define themselves what is saved of them."""
    roots = [name for name in model._get_torch_save_params()[0] if "." not in name or name.startswith("transforms.")]
    for root in (*roots, "head"):
        module = recursive_getattr(model, root, None)
        for path, each in module.named_modules(prefix=root) if isinstance(module, nn.Module) else ():
            own = [cls for cls in type(each).__mro__ if not within(cls.__module__, _LIBRARIES)]
            if own and not any("get_extra_state" in vars(cls) for cls in own):
                yield path, each


@functools.cache
def _of_libraries(cls: type) -> frozenset[str]:
    """Names that a class's bases from the libraries use; saving these attributes is up to the libraries."""
    return frozenset(
        name
        for base in cls.__mro__
        if within(base.__module__, _LIBRARIES) and base not in (nn.Module, object)
        for value in vars(base).values()
        if inspect.isroutine(value) or isinstance(value, property)
        for name in names_in(value)
    )


def _digest(value: Any) -> str | None:
    """
    Digest of plain data: numbers, texts, arrays, tensors, generators, containers and objects of these; otherwise None.
    """
    if isinstance(value, Optimizer):
        return str(bool(value.state))
    tensors: dict[str, torch.Tensor] = {}
    try:
        tree = Encoder(tensors).encode(value, "value")
    except NotPortable:
        return None
    digest = hashlib.sha256(json.dumps(tree).encode())
    for tensor in tensors.values():
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(bytes_of(tensor))
    return digest.hexdigest()
