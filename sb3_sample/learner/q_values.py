"""Values of critics, in the form of Stable-Baselines3 and in that of this package."""

from collections.abc import Callable
from typing import Any

import torch


class QValues(tuple[torch.Tensor, ...]):
    """
    Values of E critics: Stable-Baselines3's tuple of E tensors, (B, K) each (K = 1 if they are scalar), and, where a
    tensor is needed, the one tensor (E, B, K). ``torch.cat(q, dim=1)``, ``q1, q2 = q`` and loops over it use the tuple;
    arithmetic, torch's other functions, tensors' methods and indices the tensor.

    :param tensor: (E, B, K)
    """

    #: The values as one tensor, (E, B, K).
    tensor: torch.Tensor

    def __new__(cls, tensor: torch.Tensor) -> "QValues":
        self = super().__new__(cls, tensor.unbind())
        self.tensor = tensor
        return self

    def __reduce__(self) -> Any:
        return QValues, (self.tensor,)

    def __getattr__(self, name: str) -> Any:
        # Special methods, such as those of copying and printing, are not delegated to the tensor.
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.tensor, name)

    def __getitem__(self, index: Any) -> Any:
        found = self.tensor[index]
        return QValues(found) if isinstance(index, slice) else found

    @classmethod
    def __torch_function__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return function(*_with_tensors(args), **_with_tensors(kwargs or {}))

    def __repr__(self) -> str:
        return f"QValues({self.tensor!r})"

    def __hash__(self) -> int:
        return id(self)


def evaluate(critics: Callable[..., Any], observations: Any, actions: torch.Tensor) -> torch.Tensor:
    """
    Values of critics as one tensor, whether they return :class:`QValues` or a tensor: stand-ins, modules with hooks and
    networks from outside of this package are called like any other.

    :param critics: (B, O) and (B, A) to values
    :param observations: (B, O), or a dict of them
    :param actions: actions in [-1, 1], (B, A)
    :return: (E, B, K)
    """
    q = critics(observations, actions)
    return q.tensor if isinstance(q, QValues) else q  # type: ignore[no-any-return]


def _with_tensors(values: Any) -> Any:
    """Copy of nested lists, tuples and dicts, with tensors in place of the values of critics."""
    if isinstance(values, QValues):
        return values.tensor
    if isinstance(values, dict):
        return {key: _with_tensors(value) for key, value in values.items()}
    return type(values)(map(_with_tensors, values)) if type(values) in (list, tuple) else values


def _of_the_tensor(name: str) -> Callable[..., Any]:
    def operator(self: QValues, *others: Any) -> Any:
        return getattr(self.tensor, name)(*_with_tensors(others))

    return operator


for _name in (
    *("add", "radd", "sub", "rsub", "mul", "rmul", "truediv", "rtruediv", "floordiv", "mod", "pow", "rpow", "matmul"),
    *("neg", "pos", "abs", "eq", "ne", "lt", "le", "gt", "ge"),
):
    setattr(QValues, f"__{_name}__", _of_the_tensor(f"__{_name}__"))
