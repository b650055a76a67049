"""Metrics in Stable-Baselines3's logger that stay on the device until they are read."""

from collections import defaultdict
from collections.abc import ItemsView, Iterator, Mapping, ValuesView
from typing import Any

import torch
from stable_baselines3.common.logger import Logger


class LoggedValues(defaultdict[str, Any]):
    """
    ``Logger.name_to_value``, some values of which may still be on the device. Reading one of those, or all values,
    gives floats, and only then does the host wait. A copy is a plain ``defaultdict``.

    A missing name reads as 0.0, as in Stable-Baselines3, but reading does not add it: without an entry in
    ``name_to_excluded``, it would make some of the formats end the training at the next dump.

    :param values: values by name
    """

    def __init__(self, values: Mapping[str, Any]):
        super().__init__(float, values)
        # Names whose values are tensors on the device.
        self._waiting: set[str] = set()

    @classmethod
    def of(cls, logger: Logger) -> "LoggedValues":
        """
        :param logger: a logger
        :return: its values, which are of this class from now on
        """
        if not isinstance(logger.name_to_value, cls):
            logger.name_to_value = cls(logger.name_to_value)
        return logger.name_to_value

    @classmethod
    def record_later(cls, logger: Logger, metrics: Mapping[str, torch.Tensor]) -> None:
        """
        Record metrics without waiting for the device; not in a logger with its own ``record``, which needs numbers.

        :param logger: the logger
        :param metrics: scalars by name, all on one device
        """
        if getattr(logger.record, "__func__", None) is not Logger.record:
            return
        values = cls.of(logger)
        for name, metric in metrics.items():
            logger.record(name, metric)
            values._waiting.add(name)

    def _fetch(self) -> None:
        """Fetch all values that are still on the device, at once."""
        names = list(self._waiting)
        fetched = torch.stack([super(LoggedValues, self).__getitem__(name) for name in names]).tolist()
        for name, value in zip(names, fetched, strict=True):
            self[name] = value

    def __missing__(self, name: str) -> float:
        return 0.0

    # ---------------------------------------------------------------- reading

    def __getitem__(self, name: str) -> Any:
        if name in self._waiting:
            self._fetch()
        return super().__getitem__(name)

    def get(self, name: str, default: Any = None) -> Any:
        if name in self._waiting:
            self._fetch()
        return super().get(name, default)

    def items(self) -> ItemsView[str, Any]:  # type: ignore[override]
        return ItemsView(self)

    def values(self) -> ValuesView[Any]:  # type: ignore[override]
        return ValuesView(self)

    def __iter__(self) -> Iterator[str]:
        # Since __iter__ is overridden, dict(...), {**...} and the like call __getitem__ for each value.
        return super().__iter__()

    def __eq__(self, other: object) -> bool:
        return self.copy() == other

    def __ne__(self, other: object) -> bool:
        return not self == other

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        return repr(self.copy())

    def copy(self) -> defaultdict[str, Any]:  # type: ignore[override]
        """
        :return: the values as a plain ``defaultdict``
        """
        return defaultdict(float, dict(self))

    __copy__ = copy  # type: ignore[assignment]

    def __reduce__(self) -> Any:
        return self.copy().__reduce__()

    def __or__(self, other: Any) -> Any:
        return self.copy() | other

    def __ror__(self, other: Any) -> Any:
        return other | self.copy()

    # ---------------------------------------------------------------- writing

    def __setitem__(self, name: str, value: Any) -> None:
        self._waiting.discard(name)
        super().__setitem__(name, value)

    def __delitem__(self, name: str) -> None:
        self._waiting.discard(name)
        super().__delitem__(name)

    def setdefault(self, name: str, default: Any = None) -> Any:
        if name not in self:
            self[name] = default
        return self[name]

    def update(self, *args: Any, **kwargs: Any) -> None:
        for name, value in dict(*args, **kwargs).items():
            self[name] = value

    def __ior__(self, other: Any) -> "LoggedValues":  # type: ignore[override, misc]
        self.update(other)
        return self

    def pop(self, name: str, *default: Any) -> Any:
        if name in self._waiting:
            self._fetch()
        return super().pop(name, *default)

    def popitem(self) -> tuple[str, Any]:
        if self._waiting:
            self._fetch()
        return super().popitem()

    def clear(self) -> None:
        self._waiting.clear()
        super().clear()
