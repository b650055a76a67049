"""Limit the work and memory that numbers in a file, such as the width of a network, can demand."""

import math
import os
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sb3_sample.saving.container import BadFile

#: Building the algorithms of this package takes 4 to 8 times the bytes of their parameters (initial values are
#: drawn, made orthogonal and copied), and up to 13 operations a tensor.
BYTES, BYTES_PER_BYTE = 128 * 2**20, 20
OPERATIONS, OPERATIONS_PER_TENSOR = 5000, 50
_SIZED = ("empty", "zeros", "ones", "full", "rand", "randn", "empty_strided")
_SIZED_LIKE = ("new_empty", "new_zeros", "new_ones", "new_full", "new_empty_strided")
_COUNTED = ("arange", "linspace", "logspace", "randperm", "eye")


class Budget(TorchDispatchMode):
    """
    Counts, inside its ``with`` block, the tensors that are made and the operations on tensors, before they take memory
    or time.

    :param tensors: the tensors of the file; the budget is proportional to them
    :param name: the file, for messages
    """

    def __init__(self, tensors: dict[str, torch.Tensor], name: str):
        super().__init__()
        size = sum(tensor.nbytes for tensor in tensors.values())
        self.name = name
        self.bytes_left = BYTES + BYTES_PER_BYTE * size
        self.operations_left = OPERATIONS + OPERATIONS_PER_TENSOR * len(tensors)
        # The size of a replay buffer in the device's memory does not follow from the file's parameters.
        self.zeros_left = self.bytes_left + _memory() // 2

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        name = func.overloadpacket.__name__
        self.operations_left -= 1
        known = {t.untyped_storage().data_ptr() for t in tree_leaves((args, kwargs)) if isinstance(t, torch.Tensor)}
        self._check(name, _asked_for(name, args, kwargs))
        result = func(*args, **kwargs)
        made = (t.untyped_storage() for t in tree_leaves(result) if isinstance(t, torch.Tensor))
        self._spend(name, sum(s.nbytes() for s in made if s.data_ptr() not in known))
        return result

    def _check(self, name: str, n_bytes: int) -> None:
        left = self.zeros_left if name == "new_zeros" else self.bytes_left
        if n_bytes > left or self.operations_left < 0:
            raise BadFile(
                f"{self.name} is damaged or hostile: the model that it describes is far larger than the parameters "
                "that it holds"
            )

    def _spend(self, name: str, n_bytes: int) -> None:
        if name == "new_zeros":
            self.zeros_left -= n_bytes
        else:
            self.bytes_left -= n_bytes
        self._check(name, 0)


def _memory() -> int:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # not available on this system
        return 2**34


def _asked_for(name: str, args: Any, kwargs: Any) -> int:
    """Bytes that an operation is about to allocate, where its arguments tell; its result is counted in any case."""
    numel = 0
    if name in _SIZED:
        numel = math.prod(args[0])
    elif name in _SIZED_LIKE:
        numel = math.prod(args[1])
    elif name in _COUNTED:
        numel = max((int(abs(n)) for n in args if isinstance(n, (int, float)) and math.isfinite(n)), default=0)
        numel = numel**2 if name == "eye" else numel
    elif name == "repeat":
        numel = args[0].numel() * math.prod(args[1])
    elif name in ("clone", "_to_copy"):
        numel = args[0].numel()  # for an expanded tensor more than it takes itself
    dtype = kwargs.get("dtype") or torch.get_default_dtype()
    return numel * dtype.itemsize
