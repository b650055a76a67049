"""
Tracing of a gradient step: a run that records tensor operations as a graph, gradients and optimizers' steps included.

Traced code is compiled. Code that is fast as it stands and slow in a compiled graph, or the reverse, chooses between
two equal forms by :func:`is_tracing`.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
from torch.fx import GraphModule
from torch.fx.experimental.proxy_tensor import make_fx
from torch.overrides import TorchFunctionMode

_local = threading.local()
_compiling = threading.Lock()


def is_tracing() -> bool:
    """
    Check whether a gradient step is being traced by this thread.

    :return: whether operations are recorded, to be compiled
    """
    return getattr(_local, "on", False)


class ReadsOnTheHost(RuntimeError):
    """Error of a traced function that reads the value of a tensor: the graph would repeat this one value."""


class _HostReads(TorchFunctionMode):
    """Mode that refuses everything that reads numbers from tensors."""

    NAMES = (
        "item", "tolist", "numpy", "__array__", "__bool__", "__float__", "__int__", "__index__", "__complex__",
        "__contains__", "data_ptr", "storage", "untyped_storage", "nonzero",
    )  # fmt: skip

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", "")
        if name in self.NAMES:
            raise ReadsOnTheHost(f"it reads the value of a tensor on the host (Tensor.{name})")
        return func(*args, **(kwargs or {}))


@contextmanager
def undone(state: Sequence[torch.Tensor], device: torch.device) -> Iterator[None]:
    """Undo changes to tensors and to torch's generators."""
    saved = [tensor.detach().clone() for tensor in state]
    devices = [device] if device.type == "cuda" else []
    try:
        with torch.random.fork_rng(devices):
            yield
    finally:
        with torch.no_grad():
            for tensor, value in zip(state, saved, strict=True):
                tensor.copy_(value)


def trace(
    run: Callable[..., Sequence[torch.Tensor]], state: Sequence[torch.Tensor], inputs: Sequence[torch.Tensor]
) -> GraphModule:
    """
    Trace a function that changes tensors in place. It is run once, and its changes to them are undone.

    :param run: function of the inputs that returns tensors
    :param state: further tensors that it reads and changes, each once
    :param inputs: its inputs, no two the same tensor
    :return: the function as a graph of tensor operations, which takes the state and then the inputs
    :raises ReadsOnTheHost: if it asks for the value of a tensor
    """
    with undone(state, state[0].device):
        _local.on = True
        try:
            # The backward pass is recorded too, which another thread would otherwise run.
            with torch.autograd.set_multithreading_enabled(False), _HostReads():
                graph: GraphModule = make_fx(lambda *tensors: tuple(run(*tensors[len(state) :])))(*state, *inputs)
        finally:
            _local.on = False
    return graph


def compile_graph(graph: GraphModule, inputs: Sequence[torch.Tensor]) -> Callable[..., Sequence[torch.Tensor]]:
    """
    Compile a graph by Inductor.

    :param graph: from :func:`trace`
    :param inputs: the state and the inputs
    :return: function of these tensors, which changes the state in place
    """
    from torch._inductor.compile_fx import compile_fx

    # In torch 2.11 this pass fails on the optimizers' steps, which take many tensors at once.
    patches = {"loop_ordering_after_fusion": False}
    with _users_that_read_nothing():
        compiled: Any = compile_fx(graph, list(inputs), config_patches=patches)
    return compiled  # type: ignore[no-any-return]


@contextmanager
def _users_that_read_nothing() -> Iterator[None]:
    """
    Let Inductor query how loops read a buffer that they do not read. Its C++ backend queries all users of a buffer that
    could stay within fused loops, including those that only have to wait for it, such as the write to a parameter from
    whose old value it was computed, and fails with a KeyError (pytorch/pytorch#196570, open in torch 2.14). If the
    answer is None, it keeps the buffer where it is.
    """
    from torch._inductor.loop_body import LoopBody

    read = LoopBody.get_read_expr

    def read_or_none(self: Any, name: str) -> Any:
        try:
            return read(self, name)
        except KeyError:
            return None

    with _compiling, mock.patch.object(LoopBody, "get_read_expr", read_or_none):
        yield
