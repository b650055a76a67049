"""
Arrays that share memory, as a view and its base do: one block of bytes, and the place of each array in it, so that they
share memory again afterwards.
"""

from typing import Any

import numpy as np
import torch

#: Kinds of NumPy dtypes for which any bytes are valid.
_KINDS = "biufc"
#: Dtypes of torch that NumPy has.
_TORCH = (
    torch.bool, torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.float16, torch.float32,
    torch.float64, torch.complex64, torch.complex128,
)  # fmt: skip
#: Bytes; numbers of these kinds are aligned to their size, up to this.
_ALIGNMENT = 16


def as_array(value: Any) -> np.ndarray | None:
    """
    :param value: any value
    :return: an array with its memory, if it is a NumPy array or a CPU tensor
    """
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, torch.Tensor) or value.device.type != "cpu" or value.layout != torch.strided:
        return None
    plain = value.detach()
    if plain.dtype == torch.bfloat16:
        plain = plain.view(torch.int16)
    return None if plain.dtype not in _TORCH or plain.is_conj() or plain.is_neg() else plain.numpy()


def _bounds(array: np.ndarray) -> tuple[int, int]:
    """Addresses of the first byte of a non-empty array, and of the byte after its last."""
    steps = [(n - 1) * stride for n, stride in zip(array.shape, array.strides, strict=True)]
    address = array.__array_interface__["data"][0]
    return address + sum(s for s in steps if s < 0), address + sum(s for s in steps if s > 0) + array.itemsize


def group(arrays: list[np.ndarray]) -> list[list[int]]:
    """
    :param arrays: arrays
    :return: for each stretch of memory with more than one array, the indices of these arrays, in order
    """
    bounds = [_bounds(array) for array in arrays]
    groups: list[list[int]] = []
    end = -1
    for index in sorted((i for i, array in enumerate(arrays) if array.size), key=lambda i: bounds[i]):
        first, last = bounds[index]
        if first < end:
            groups[-1].append(index)
        else:
            groups.append([index])
        end = max(end, last)
    return [sorted(indices) for indices in groups if len(indices) > 1]


def block_of(arrays: list[np.ndarray]) -> tuple[np.ndarray, list[list[Any]]] | None:
    """
    :param arrays: arrays in one stretch of memory
    :return: bytes, and the place of each array in them: offset, shape, strides and type; None if an array is larger
        than its memory (a broadcast one), holds anything but numbers, or is of a subclass
    """
    bounds = [_bounds(array) for array in arrays]
    first = min(low for low, _ in bounds) // _ALIGNMENT * _ALIGNMENT
    block = np.zeros(max(high for _, high in bounds) - first, np.uint8)
    places: list[list[Any]] = []
    for array in arrays:
        if type(array) not in (np.ndarray, np.memmap) or array.dtype.kind not in _KINDS or array.nbytes > len(block):
            return None
        address = array.__array_interface__["data"][0]
        places.append([address - first, list(array.shape), list(array.strides), array.dtype.str])
        view_at(block, places[-1])[...] = array
    return block, places


def view_at(block: np.ndarray, place: Any) -> np.ndarray:
    """
    :param block: from :func:`block_of`
    :param place: from there
    :return: the array at the place, in the memory of ``block``
    :raises ValueError: there is no such place
    """
    try:
        offset, shape, strides, kind = place
        dtype = np.dtype(kind) if isinstance(kind, str) and len(kind) < 8 else np.dtype("O")
        if dtype.kind not in _KINDS or not all(type(n) is int and n >= 0 for n in (offset, *shape)):
            raise ValueError(f"{place!r:.200} is no place of an array")
        view: np.ndarray = np.ndarray(tuple(shape), dtype, block, offset, tuple(strides))
        if view.nbytes > len(block):
            raise ValueError(f"{place!r:.200} is more than the {len(block)} bytes that there are")
    except (TypeError, OverflowError) as error:
        raise ValueError(f"{place!r:.200} is no place of an array: {error}") from error
    return view
