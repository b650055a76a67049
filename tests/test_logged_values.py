"""Metrics in the logger that stay on the device until somebody reads them."""

import copy
import csv
import json
import pickle
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from stable_baselines3.common.logger import KVWriter, Logger, configure
from torch.overrides import TorchFunctionMode

from sb3_sample.logged_values import LoggedValues

#: What takes a number from a device to the host.
FETCHES = (torch.Tensor.item, torch.Tensor.tolist, torch.Tensor.cpu, torch.Tensor.__bool__,
           torch.Tensor.__float__, torch.Tensor.__int__)  # fmt: skip


class Fetches(TorchFunctionMode):
    """Counts how often the host asked for what is in a tensor, as it would have to wait for on a GPU."""

    def __init__(self) -> None:
        super().__init__()
        self.n = 0

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.n += function in FETCHES
        return function(*args, **(kwargs or {}))


def waiting() -> Logger:
    """A logger with a number and two values that are still on the device."""
    logger = Logger(None, [])
    logger.record("number", 3)
    LoggedValues.record_later(logger, {"a": torch.tensor(1.5), "b": torch.tensor(2.5)})
    return logger


ALL = {"number": 3, "a": 1.5, "b": 2.5}


def plainly(values: Any) -> dict[str, Any]:
    assert type(values) in (dict, defaultdict)
    # What C code reads, whatever a subclass makes of it.
    assert all(type(value) in (int, float) for value in dict.values(values))
    return dict(values)


READS: dict[str, tuple[Callable[[Any], Any], Any]] = {
    "[]": (lambda values: values["a"], 1.5),
    "get": (lambda values: values.get("b"), 2.5),
    "items": (lambda values: list(values.items()), [("number", 3), ("a", 1.5), ("b", 2.5)]),
    "sorted items": (lambda values: sorted(values.items()), [("a", 1.5), ("b", 2.5), ("number", 3)]),
    "values": (lambda values: list(values.values()), [3, 1.5, 2.5]),
    "loop": (lambda values: [values[name] for name in values], [3, 1.5, 2.5]),
    "dict": (lambda values: plainly(dict(values)), ALL),
    "{**}": (lambda values: plainly({**values}), ALL),
    "update": (lambda values: (lambda new: new.update(values) or plainly(new))({}), ALL),
    "|": (lambda values: plainly(values | {}), ALL),
    "other |": (lambda values: plainly({} | values), ALL),
    "copy": (lambda values: plainly(values.copy()), ALL),
    "copy.copy": (lambda values: plainly(copy.copy(values)), ALL),
    "deepcopy": (lambda values: plainly(copy.deepcopy(values)), ALL),
    "pickle": (lambda values: plainly(pickle.loads(pickle.dumps(values))), ALL),
    "json": (lambda values: json.loads(json.dumps(values)), ALL),
    "repr": (lambda values: "'a': 1.5" in repr(values) and "tensor" not in repr(values), True),
    "format": (lambda values: "{a} {b}".format(**values), "1.5 2.5"),
    "%": (lambda values: "%(a)s" % values, "1.5"),  # noqa: UP031
    "==": (lambda values: (values == ALL, values != ALL, ALL == values), (True, False, True)),  # noqa: SIM300
    "pop": (lambda values: (values.pop("a"), values.pop("none", 7), "a" in values), (1.5, 7, False)),
    "popitem": (lambda values: values.popitem(), ("b", 2.5)),
    "setdefault": (lambda values: (values.setdefault("a", 9), values.setdefault("c", 9), values["c"]), (1.5, 9, 9)),
}


@pytest.mark.parametrize("how", READS)
def test_whoever_reads_gets_floats(how: str) -> None:
    read, expected = READS[how]
    values = waiting().name_to_value
    assert isinstance(values, defaultdict)
    assert read(values) == expected
    assert read is not READS["[]"][0] or type(values["a"]) is float


def test_nothing_is_fetched_before_and_all_at_once_then() -> None:
    logger = waiting()
    values = logger.name_to_value
    with Fetches() as fetches:
        # Names are no values; nor are other values.
        assert list(values) == list(values.keys()) == ["number", "a", "b"]
        assert "a" in values and len(values) == 3 and values["number"] == 3 and values["none"] == 0.0
        logger.record("number", 4)
        logger.record_mean("mean", 1.0)
        logger.record_mean("mean", 2.0)
        LoggedValues.record_later(logger, {"a": torch.tensor(5.0), "b": torch.tensor(6.0)})
        assert fetches.n == 0
        assert values["a"] == 5.0
        assert fetches.n == 1
        assert dict(values) == {"number": 4, "mean": 1.5, "a": 5.0, "b": 6.0}
        assert fetches.n == 1
    assert logger.name_to_excluded.keys() == {"number", "mean", "a", "b"}


def test_what_is_written_replaces_what_waits() -> None:
    logger = waiting()
    values = logger.name_to_value
    values["a"] = 7
    values.update(b=8)
    assert dict(values) == {"number": 3, "a": 7, "b": 8}
    LoggedValues.record_later(logger, {"a": torch.tensor(1.5), "b": torch.tensor(2.5)})
    del values["a"]
    values |= {"b": 9}
    assert dict(values) == {"number": 3, "b": 9}
    LoggedValues.record_later(logger, {"a": torch.tensor(1.5)})
    values.clear()
    assert values["a"] == 0.0 and not values and dict(values) == {}


def test_means_with_what_waits() -> None:
    logger = waiting()
    logger.record_mean("a", 10.0)
    assert logger.name_to_value["a"] == 10.0
    LoggedValues.record_later(logger, {"a": torch.tensor(1.5)})
    logger.record_mean("a", 10.0)
    # As in Stable-Baselines3: the old value counts as the mean of those before.
    assert logger.name_to_value["a"] == (1.5 + 10.0) / 2


class Keeps(KVWriter):
    """A format of one's own."""

    def __init__(self) -> None:
        self.written: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        assert key_values.keys() == key_excluded.keys()
        self.written.append(dict(key_values.items()))

    def close(self) -> None:
        pass


def test_formats_write_floats(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tensorboard")
    logger = configure(str(tmp_path), ["csv", "json", "log", "stdout", "tensorboard"])
    keeps = Keeps()
    logger.output_formats.append(keeps)
    LoggedValues.record_later(logger, {"a": torch.tensor(1.5), "b": torch.tensor(2.5)})
    logger.dump(7)
    LoggedValues.record_later(logger, {"a": torch.tensor(0.25), "b": torch.tensor(0.5)})
    logger.dump(8)
    logger.close()
    with (tmp_path / "progress.csv").open() as file:
        assert list(csv.DictReader(file)) == [{"a": "1.5", "b": "2.5"}, {"a": "0.25", "b": "0.5"}]
    assert json.loads((tmp_path / "progress.json").read_text().splitlines()[0]) == {"a": 1.5, "b": 2.5}
    for text in ((tmp_path / "log.txt").read_text(), capsys.readouterr().out):
        assert "| a | 1.5  " in text and "tensor" not in text
    assert keeps.written == [{"a": 1.5, "b": 2.5}, {"a": 0.25, "b": 0.5}]
    assert all(type(value) is float for line in keeps.written for value in line.values())
    assert not logger.name_to_value


def test_a_name_that_is_only_read_ends_no_training(tmp_path: Path) -> None:
    """With a plain ``defaultdict``, reading stores 0.0, and two of the formats fail at the next dump."""
    logger = configure(str(tmp_path), ["log"])
    assert LoggedValues.of(logger)["train/loss"] == 0.0
    logger.record("x", 1)
    logger.dump(1)
    logger.close()
    assert "train/loss" not in (tmp_path / "log.txt").read_text()


def test_a_logger_with_a_record_of_its_own_gets_no_tensors() -> None:
    class Sends(Logger):
        def record(self, key: str, value: Any, exclude: Any = None) -> None:
            raise AssertionError(f"{key}={value} was sent")

    LoggedValues.record_later(Sends(None, []), {"a": torch.tensor(1.5)})
