"""
Stored trials of a search (``--storage``, ``--trial-id``). The zoo accepts anything stored as hyperparameters, some of
which it evaluates as Python or imports. Here a trial has parameters of the algorithm's search space, with values that
could have been suggested, and nothing else.
"""

import contextlib
import re
import sqlite3
import urllib.parse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy.engine
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from sb3_sample.saving.untrusted import BadFile, open_regular

#: Largest size of a line of a journal, in bytes.
MAX_LINE = 2**20
#: States of trials with which further ones are compared.
_COMPARED = (TrialState.COMPLETE, TrialState.PRUNED, TrialState.RUNNING)
#: Name under which a study has the settings of its search.
_SETTINGS = "sb3_sample"
#: Words in the definition of a table that computes something when it is read; none of Optuna's tables does.
_COMPUTES = re.compile(r"\b(virtual|generated|as)\b", re.IGNORECASE)


def stored_params(storage: str, study_name: str, trial_id: int | None) -> dict[str, Any]:
    """
    :param storage: address of a database, or a journal, a file whose name ends in ".log"
    :param study_name: name of the study in it
    :param trial_id: number of the trial; the best one if None
    :return: its parameters, as they are stored
    :raises BadFile: (a ``ValueError``) if there is no such trial, or nothing that Optuna has written
    """
    check_storage(storage)
    with _reading(storage, f"trial {trial_id} of study {study_name!r}"):
        study = optuna.load_study(storage=_opened(storage), study_name=study_name)
        return dict(study.best_trial.params if trial_id is None else study.trials[trial_id].params)


def check_storage(storage: str) -> None:
    """
    :param storage: as in :func:`stored_params`
    :raises BadFile: (a ``ValueError``) if it is an existing file that Optuna has not written
    """
    file = _file_of(storage)
    if file is None or not file.exists():
        return
    with _reading(storage, "its studies"):
        if storage.endswith(".log"):
            _check_lines(file)
        else:
            open_regular(file).close()
            _check_tables(file)
        optuna.get_all_study_names(_opened(storage))


def check_search(storage: str, study_name: str, settings: Mapping[str, str]) -> None:
    """
    Record the settings of a search in its study, or compare them with those of the search that has begun it, since
    their trials would be compared with each other. A study whose trials another program has begun is not checked.

    :param storage: as in :func:`stored_params`
    :param study_name: name of the study, made if it is not there
    :param settings: as text, by name
    :raises BadFile: (a ``ValueError``) if they differ, or Optuna has not written the storage
    """
    check_storage(storage)
    if storage.endswith(".log"):
        Path(storage).parent.mkdir(parents=True, exist_ok=True)
    with _reading(storage, f"study {study_name!r}"):
        study = optuna.create_study(
            storage=_opened(storage), study_name=study_name, load_if_exists=True, direction="maximize"
        )
        before = study.user_attrs.get(_SETTINGS)
        compared = study.get_trials(deepcopy=False, states=_COMPARED)
        if not compared and before != settings:
            study.set_user_attr(_SETTINGS, dict(settings))
            return
    if not isinstance(before, dict):
        return
    differences = [
        f"{name} {before.get(name, 'not given')!s:.200} (now {settings.get(name, 'not given')})"
        for name in sorted(before.keys() | settings.keys())
        if before.get(name) != settings.get(name)
    ]
    if differences:
        raise BadFile(
            f"--study-name {study_name}: the search in {storage} was begun with {', '.join(differences)}, and its "
            "trials cannot be compared with those of this one: search as then, or name another --study-name"
        )


def _opened(storage: str) -> Any:
    if storage.endswith(".log"):
        return JournalStorage(JournalFileBackend(storage))
    return storage


def _file_of(storage: str) -> Path | None:
    """The file of the storage, if it is one file of this machine."""
    if storage.endswith(".log"):
        return Path(storage)
    with _reading(storage, "this address"):
        url = sqlalchemy.engine.make_url(storage)
    is_file = url.get_backend_name() == "sqlite" and url.database and not url.database.startswith((":", "file:"))
    return Path(str(url.database)) if is_file else None


@contextlib.contextmanager
def _reading(storage: str, what: str) -> Iterator[None]:
    try:
        yield
    except BadFile:
        raise
    except Exception as error:  # Optuna and the database can raise any error
        raise BadFile(f"--storage {storage}: {what} cannot be read: {type(error).__name__}: {error}") from error


def _check_lines(file: Path) -> None:
    """Limit the length of lines: Optuna takes a line of any length into memory."""
    with open_regular(file) as lines:
        while line := lines.readline(MAX_LINE + 1):
            if len(line) > MAX_LINE:
                raise BadFile(f"{file} is no journal of Optuna's: it has a line of more than {MAX_LINE:,} bytes")


def _check_tables(file: Path) -> None:
    """Refuse views and computed columns, which could make the database compute for ever."""
    address = f"file:{urllib.parse.quote(str(file.resolve()))}?mode=ro"
    with contextlib.closing(sqlite3.connect(address, uri=True)) as database:
        for kind, name, text in database.execute("SELECT type, name, sql FROM sqlite_master"):
            if kind not in ("table", "index") or _COMPUTES.search(text or ""):
                raise BadFile(f"{file} is no database of Optuna's: it has the {kind} {name!r:.100}, {text!r:.100}")


class _Stored:
    """
    Replaces the trial of a search space, to check whether a stored value is one that the space could suggest.

    :param value: the stored value
    :param what: its name, for messages
    """

    def __init__(self, value: Any, what: str):
        self._value, self._what = value, what

    def suggest_float(self, name: str, low: float, high: float, *, log: bool = False) -> None:
        """As in ``optuna.Trial``."""
        self._check(type(self._value) in (int, float) and low <= self._value <= high, f"a number of {low} to {high}")

    def suggest_int(self, name: str, low: int, high: int, *, log: bool = False) -> None:
        """As in ``optuna.Trial``."""
        self._check(type(self._value) is int and low <= self._value <= high, f"a whole number of {low} to {high}")

    def suggest_categorical(self, name: str, choices: Any) -> None:
        """As in ``optuna.Trial``."""
        fits = any(type(choice) is type(self._value) and choice == self._value for choice in choices)
        self._check(fits, f"one of {', '.join(map(str, choices))}")

    def _check(self, fits: bool, wanted: str) -> None:
        if not fits:
            raise BadFile(f"{self._what} must be {wanted}, not {self._value!r:.100}")


def check_params(params: Mapping[str, Any], space: Mapping[str, Any], where: str) -> None:
    """
    :param params: a trial's parameters
    :param space: what may be suggested: functions of trial and name, by name
    :param where: whose they are, for messages
    :raises BadFile: (a ``ValueError``) if one is not in the space, or has a value that is never suggested
    """
    for name, value in params.items():
        if name not in space:
            raise BadFile(
                f"{where} has {name!r:.100}, which is not in the algorithm's search space ({', '.join(space)}): the "
                "parameters of another algorithm's trial, or others, can be given with -params"
            )
        space[name](_Stored(value, f"{where}: {name}"), name)
