"""
The tables of runs that the stock zoo pickles, in a file of the same name that runs no code when it is read; and the
errors and options of the commands that read a run's files.
"""

import argparse
import pickle
from typing import IO, Any

import numpy as np
import torch

from sb3_sample.saving import container
from sb3_sample.saving.container import BadFile, PickledFile
from sb3_sample.saving.encoding import decode, encode
from sb3_sample.saving.untrusted import open_regular

_PLOT_KIND = "plotted runs"


class Refused(Exception):
    """
    A refusal while the zoo runs. The zoo would answer a ``ValueError`` by downloading a model from a hub.
    """


class RunError(ValueError):
    """A run that cannot be started or resumed as the command says."""


def add_trust(parser: argparse._ActionsContainer) -> None:
    """
    :param parser: the parser, to which the options for the content of a saved run are added
    """
    parser.add_argument(
        "--allow-pickle",
        action="store_true",
        help="Read pickled files and settings that are Python too, as the stock zoo does: they can run any code that "
        "their author wanted",
    )
    parser.add_argument(
        "--trusted-modules",
        nargs="+",
        default=[],
        metavar="MODULE",
        help="Modules, or packages of modules, whose classes and functions the run's files may name",
    )


# ---------------------------------------------------------------- what all_plots saves


class PlottedRuns:
    """
    Replaces ``pickle`` in the zoo's modules that save and draw tables of runs.

    :param allow_pickle: whether pickled files are read too
    """

    def __init__(self, allow_pickle: bool = False):
        self._allow_pickle = allow_pickle

    @staticmethod
    def open(path: str, mode: str) -> IO[Any]:
        """
        Open a file as the built-in function does, but refuse to read pipes and devices.

        :param path: of a file
        :param mode: see the built-in function
        :return: the file
        """
        return open_regular(path) if mode == "rb" else open(path, mode)

    def dump(self, value: Any, file: IO[bytes]) -> None:
        """
        :param value: what ``all_plots`` gathered
        :param file: file to write to
        """
        tensors: dict[str, torch.Tensor] = {}
        container.write(file, _PLOT_KIND, encode(value, "runs", tensors), tensors)  # type: ignore[arg-type]

    def load(self, file: IO[bytes]) -> Any:
        """
        :param file: file to read
        :return: what ``all_plots`` gathered
        :raises BadFile: if it is damaged, or pickled and not allowed to be
        """
        try:
            runs = decode(*container.read(file, _PLOT_KIND), "runs")  # type: ignore[arg-type]
        except PickledFile:
            if not self._allow_pickle:
                raise
            file.seek(0)
            return pickle.load(file)
        _check_runs(runs, str(getattr(file, "name", "the file")))
        return runs


def _check_runs(runs: Any, name: str) -> None:
    """
    :param runs: tables by name of the task and of the curve, and one for the terminal
    :param name: the file, for messages
    :raises BadFile: if they hold other values than numbers and words
    """
    if not _is_table(runs):
        raise BadFile(f"{name} does not hold what all_plots has gathered")
    for task, curves in runs.items():
        if task == "results_table":
            fits = _is_table(curves) and all(map(_are_words, (curves.get("headers"), *_rows(curves))))
        else:
            fits = _is_table(curves) and all(
                _is_table(curve) and all(map(_are_numbers, curve.values())) for curve in curves.values()
            )
        if not fits:
            raise BadFile(f"{name}: {task} is not what all_plots has gathered")


def _is_table(value: Any) -> bool:
    return isinstance(value, dict) and _are_words(list(value))


def _rows(table: dict[str, Any]) -> list[Any]:
    rows = table.get("value_matrix")
    return rows if isinstance(rows, list) else [None]


def _are_words(value: Any) -> bool:
    # Characters that are not printable could control a terminal.
    return isinstance(value, list) and all(isinstance(word, str) and word.isprintable() for word in value)


def _are_numbers(value: Any) -> bool:
    array = np.asarray(value) if isinstance(value, (np.ndarray, np.generic, float, int, list)) else None
    return array is not None and array.dtype.kind in "biuf"
