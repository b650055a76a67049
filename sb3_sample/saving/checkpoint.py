"""
Checkpoints of a training, from which it resumes as if it had never been interrupted.

``learn`` calls three methods of a :class:`Checkpointer`: ``resume`` before the callbacks' ``on_training_start``,
``start`` after it, and ``after_turn`` at the end of each turn of its loop, after the gradient steps. Only at that
moment is the state consistent: between the environment's step and ``train`` a transition is in no buffer, or has no
update yet.
"""

import contextlib
import json
import os
import sys
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.console import LossyLog
from sb3_sample.envs.no_environment import NoEnvironment
from sb3_sample.envs.workers import EnvironmentDied, watch_workers
from sb3_sample.faults import HoldBack, check_finite_parameters
from sb3_sample.lockstep import Seat, seat_of
from sb3_sample.saving import container, run_folder, training_state, vec_envs
from sb3_sample.saving.attributes import DoesNotFit
from sb3_sample.saving.callbacks import CallbackStates, environments, walk, without_progress_bar
from sb3_sample.saving.checks import ParametersDoNotFit, check_counts, check_last_observations
from sb3_sample.saving.classes import importing_nothing
from sb3_sample.saving.container import BadFile
from sb3_sample.saving.encoding import NotPortable, decode, encode
from sb3_sample.saving.identity import identity_of
from sb3_sample.saving.interrupts import Interrupts
from sb3_sample.saving.progress import ProgressFile
from sb3_sample.saving.rings import Ring
from sb3_sample.saving.run_folder import MODEL, STATE, RunFolder, Segment
from sb3_sample.warn import warn

#: Environment steps between two checkpoints, by default.
CHECKPOINT_FREQ = 10_000
KIND, SEGMENT_KIND = "checkpoint", "replay rows"
#: The parts of a checkpoint's state, and their types.
_PARTS: dict[str, type] = {
    "identity": dict, "attributes": dict, "elapsed_ns": int, "rings": dict, "env": dict, "callbacks": dict,
    "progress": dict, "logger": dict, "generators": dict,
}  # fmt: skip
#: The folders into which a model has been trained in this process, by calls of ``learn`` that have ended.
_TRAINED: weakref.WeakKeyDictionary[Any, set[str]] = weakref.WeakKeyDictionary()


def refuse_second_call(model: BaseAlgorithm, folder: str | Path | None) -> None:
    """
    Refuse a folder that an earlier ``learn`` of the same model has trained into. The program, started again after a
    kill, would resume its first call from a checkpoint of the second one, and end elsewhere.

    :param model: the algorithm, before the call has changed it
    :param folder: the run's folder; None for no checkpoints
    :raises ValueError: it is no path, or an earlier call of ``learn`` of this model has ended with the folder
    """
    if folder is not None and not isinstance(folder, (str, os.PathLike)):
        raise ValueError(f"checkpoint must name a folder, by a text or a path, or be None, not {folder!r:.100}")
    if folder is not None and os.path.realpath(folder) in _TRAINED.get(model, ()):
        raise ValueError(
            f"checkpoint={str(folder)!r} must be another folder for each call of learn: an earlier call has trained "
            "this model there, and the program, started again, could not tell whose checkpoints they are. Pass "
            "another folder, or ask for all the steps in one call. Nothing was changed."
        )


class Checkpointer:
    """
    Saves and resumes a training. Used as a context manager, which releases the signals and the folder at its end;
    without a folder it does nothing.

    :param model: the algorithm, set up for ``learn``
    :param callback: its callback
    :param folder: the run's folder; None for no checkpoints
    :param every: environment steps between two checkpoints, each at the end of the first turn at or after a multiple
    :param learns_from: name of the source that is learned from instead of the environment; its steps are gradient
        steps, and the environment's state, which they do not change, is not saved
    :raises ValueError: ``every`` is out of range, the folder cannot be used, or the model cannot be saved
    """

    def __init__(
        self,
        model: BaseAlgorithm,
        callback: BaseCallback,
        folder: str | Path | None,
        every: int,
        learns_from: str = "",
    ):
        if isinstance(every, bool) or not isinstance(every, (int, np.integer)) or every < 1:
            raise ValueError(f"checkpoint_freq must be an integer of at least 1, in environment steps, not {every!r}")
        if folder is None and every != CHECKPOINT_FREQ:
            raise ValueError(
                f"checkpoint_freq={every} means nothing without checkpoint, the folder of the run: pass it too, or "
                "leave checkpoint_freq out"
            )
        self._model, self._callback, self._every = model, callback, int(every)
        self._name, self._learns_from = folder, learns_from
        self._held: HoldBack | None = None
        if folder is not None:
            self._held = HoldBack(callback)
            self._held.model = model
        self._folder: RunFolder | None = None
        #: Its place among trainings in lockstep, if it has one.
        self._seat = seat_of(model)
        #: State of the checkpoint from which the run resumes, with its path.
        self._resumed: dict[str, Any] | None = None
        self._manifest: dict[str, Any] = {"segments": {}}
        self._saved_at: int | None = None
        #: Names of the parts left out of a checkpoint, with a warning.
        self._left_out: set[str] = set()
        self._whole_at: int | None = None
        self._interrupts: Interrupts | None = None
        self._states: CallbackStates | None = None
        self._progress: ProgressFile | None = None
        # Completed periods of ``every`` steps at the end of the last turn.
        self._period = 0

    @property
    def callback(self) -> BaseCallback:
        """
        :return: the callback to call at every step, whose exceptions are kept until the turn is saved
        """
        return self._callback if self._held is None else self._held

    def __enter__(self) -> "Checkpointer":
        if self._name is None:
            return self
        try:
            self._folder = RunFolder(self._name)
        except OSError as error:
            raise ValueError(f"checkpoint={str(self._name)!r} cannot be used: {error}") from error
        try:
            self._open()
        except BaseException:
            self._folder.close()
            raise
        return self

    def _open(self) -> None:
        assert self._folder is not None
        model = self._model
        assert model.env is not None
        self._env: VecEnv = model.env
        if self._learns_from:
            self._env = NoEnvironment(model.observation_space, model.action_space)
        self._rings = {"model": _ring_of(model)} if getattr(model, "replay_buffer", None) is not None else {}
        for path, each in self._callbacks():
            for name, ring in getattr(each, "checkpoint_rings", dict)().items():
                self._rings[f"{path}.{name}"] = ring
        # The step count at which this call begins is part of the run's identity: a further call begins at another one.
        begin = str(model.num_timesteps)
        self._identity = {**identity_of(model, self._env), "num_timesteps": [begin, begin]}
        if self._learns_from:
            self._identity["dataset"] = [self._learns_from] * 2
        found = self._folder.newest_good() if self._seat is None else self._start_of(self._seat)
        if found is not None:
            folder, self._manifest = found
            self._resumed = self._read(f"{folder.name}/{STATE}", KIND)
            _check_parts(self._resumed, folder / STATE)
            self._check_identity(self._resumed["identity"])
            self._resumed["path"] = folder

    def _start_of(self, seat: Seat) -> tuple[Path, dict[str, Any]] | None:
        """Where a run of a group resumes: all runs at the newest step of which each has a checkpoint."""
        assert self._folder is not None
        seat.folder = self._folder.path
        if not seat.aligned:
            return self._folder.newest_good()
        group = seat.group
        if group.starts is None:
            folders = [each.folder for each in group.seats if each.aligned and each.folder is not None]
            group.starts = run_folder.common_starts(folders)
        if self._folder.path in group.starts.paths:
            path = group.starts.paths[self._folder.path]
            return path, self._folder.manifest_of(path)
        found = self._folder.newest_good()
        seat.alone = found is not None or group.starts.steps > 0
        return found

    def _callbacks(self) -> Iterator[tuple[str, BaseCallback]]:
        return walk(without_progress_bar(self._callback))

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        if self._folder is None:
            return
        try:
            is_early = self._model.num_timesteps < self._model._total_timesteps
            has_left = is_early if kind is None else issubclass(kind, Exception)
            if self._seat is not None and self._seat.began and has_left:
                self._folder.set_left(True)
            if kind is not None and self._states is not None:
                # The call may be repeated with the same callbacks, from a checkpoint before these changes. What cannot
                # be described must not hide the error.
                with contextlib.suppress(Exception):
                    self._states.note_changes()
            if kind is None:
                self._save_if_whole()
                _TRAINED.setdefault(self._model, set()).add(os.path.realpath(self._folder.path))
        finally:
            self._close(orderly=kind is None)
        if kind is None and self._interrupts is not None and self._interrupts.received is not None:
            # The signal came when no further turn followed.
            self._interrupts.leave(saved_at=self._saved_at)

    def _save_if_whole(self) -> None:
        # A callback that ends the training does so in the middle of a turn, when nothing can be saved.
        if self._whole_at == self._model.num_timesteps != self._saved_at:
            self._try_to_save()

    def _close(self, orderly: bool) -> None:
        assert self._folder is not None
        if self._interrupts is not None:
            self._interrupts.restore(orderly)
            self._console.close()
        if self._progress is not None:
            logger = self._model.logger
            logger.output_formats = [each for each in logger.output_formats if each is not self._progress]
            self._progress.close()
        self._folder.close()

    # ---------------------------------------------------------------- resuming

    def _check_identity(self, theirs: dict[str, list[str]]) -> None:
        ours = self._identity
        if ("dataset" in ours) != ("dataset" in theirs):
            which = {True: "on a data set (learn_offline)", False: "in an environment (learn)"}
            raise ValueError(
                f"checkpoint={str(self._name)!r} is the folder of a training {which['dataset' in theirs]}, and this is "
                f"one {which['dataset' in ours]}. Nothing was changed. Name another folder."
            )
        # The class comes first: arguments of another class have other defaults. An argument that only one of the two
        # has comes from another version, which the circumstances report.
        for name in sorted(ours.keys() & theirs.keys(), key=lambda name: (name != "class", name)):
            present, saved = ours[name], theirs[name]
            if present[0] != saved[0]:
                raise ValueError(
                    f"{name}={present[1]}: the run of checkpoint={str(self._name)!r} was made with {name}={saved[1]}. "
                    f"Nothing was changed. Train as then, or name another folder."
                )

    def resume(self, total_timesteps: int) -> None:
        """
        Restore the algorithm, if there is something to restore.

        :param total_timesteps: steps that the training is to have at its end; a warning is given if it has them already
        """
        if self._resumed is None:
            if self._folder is not None:
                # Lines that callbacks log before the first turn belong to the run's log too.
                self._open_log({"size": 0, "pending": []})
            return
        if self._manifest["steps"] >= total_timesteps:
            warn(
                f"Nothing is left to train: the run in checkpoint={str(self._name)!r} has {self._manifest['steps']} "
                f"steps already, of {total_timesteps}. The model is as it was saved. For more steps pass a larger "
                "total_timesteps, for a new run another folder"
            )
        state, model = self._resumed, self._model
        safe_files: Any = model
        theirs, ours = self._manifest["circumstances"], training_state.circumstances(model.device)
        changed = [
            f"{name} {theirs.get(name)} (now {value})" for name, value in ours.items() if theirs.get(name) != value
        ]
        if changed:
            warn(
                f"The run goes on under other circumstances, so that it need not be the same to the last bit: the "
                f"checkpoint was made with {', '.join(changed)}"
            )
        assert self._folder is not None
        segments = self._folder.segments(self._manifest)
        with self._restoring(state):
            with self._folder.opened(f"{state['path'].name}/{MODEL}") as file, importing_nothing():
                safe_files._take_parameters(file, trusted_modules=_own_modules(model))
            training_state.restore_attributes(model, state["attributes"])
            check_counts(model, "the checkpoint")
            if model.num_timesteps != self._manifest["steps"]:
                raise BadFile(f"its state is of step {model.num_timesteps}, its manifest of {self._manifest['steps']}")
            check_last_observations(model, may_be_none=bool(self._learns_from))
            model.start_time = time.time_ns() - state["elapsed_ns"]
            for name, ring in self._rings.items():
                if name in state["rings"]:
                    rows = [s for s in segments if s.ring == _file_name(name)]
                    ring.restore(state["rings"][name], self._pieces(rows))
        if self._seat is not None:
            # Some trainings of a group may have been a checkpoint ahead.
            self._folder.go_back_to(model.num_timesteps)
        self._saved_at = self._whole_at = model.num_timesteps

    @contextlib.contextmanager
    def _restoring(self, state: dict[str, Any]) -> Iterator[None]:
        """Turn errors that the content of a checkpoint raises into ``BadFile``, which names it."""
        try:
            yield
        except (ParametersDoNotFit, EnvironmentDied, OSError):
            raise
        except BadFile as error:
            where = str(state["path"])
            raise error if where in str(error) else BadFile(f"{where}: {error}") from error
        except Exception as error:
            raise BadFile(
                f"{state['path']} is damaged or hostile, or was not made by this program: {type(error).__name__}: "
                f"{error!s:.500}"
            ) from error

    def _pieces(self, segments: list[Segment]) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        for segment in segments:
            yield segment.first, self._read(segment.path, SEGMENT_KIND)

    def _read(self, path: str, kind: str) -> Any:
        """Content of a file in the run's folder."""
        assert self._folder is not None
        with self._folder.opened(path) as file:
            tree, tensors = container.read(file, kind)
        try:
            with importing_nothing():
                return decode(tree, tensors, kind)
        except BadFile as error:
            raise BadFile(f"{self._folder.path / path}: {error}") from error

    def start(self) -> None:
        """
        Restore what the start of a training changes: environments, callbacks, logger and generators; or, in a new run,
        save its beginning, so that parts that cannot be saved are known at once.

        :raises ValueError: the beginning cannot be saved
        """
        if self._folder is None:
            return
        model = self._model
        self._states = CallbackStates(self._callback)
        for env in self._environments()[1:]:
            watch_workers(env)
        self._interrupts = Interrupts(self._environments(), self._folder.path, self._seat)
        if self._progress is not None and self._progress not in model.logger.output_formats:
            # A callback has set another logger.
            model.logger.output_formats.append(self._progress)
        self._console = LossyLog(model.logger)
        self._period = model.num_timesteps // self._every
        self._warn_of_losses()
        if self._seat is not None:
            self._seat.saves, self._folder.beside = True, self._seat.folders_beside
        # Alone, a run goes on from where it has left.
        if self._resumed is None or (self._seat is not None and not self._seat.alone):
            self._folder.set_left(False)
        if self._resumed is not None:
            self._restore_rest(self._resumed)
            self._resumed = None
            return
        try:
            self._save()
        except OSError as error:
            raise ValueError(f"checkpoint={str(self._name)!r} cannot be written to: {error}") from error

    def _open_log(self, state: dict[str, Any]) -> None:
        assert self._folder is not None
        self._progress = ProgressFile(self._folder.path)
        self._progress.restore(state)
        self._model.logger.output_formats.append(self._progress)

    def _warn_of_losses(self) -> None:
        missing = self._missing = vec_envs.save(self._env)[1]
        # If the checkpoint lacks the episodes in progress, ``_restore_rest`` warns that they start anew.
        if missing and (self._resumed is None or self._resumed["env"].get("environments") is not None):
            warn(
                "The state of the environment cannot be saved, so that the episodes in progress start anew when the "
                f"run goes on: {'; '.join(missing)}"
            )
        assert self._states is not None
        lost = self._states.lost()
        if lost:
            warn(f"A checkpoint does not hold all of the callbacks' state: {'; '.join(lost)}")

    def _restore_rest(self, state: dict[str, Any]) -> None:
        assert self._states is not None
        with self._restoring(state):
            try:
                reasons = vec_envs.restore(self._env, state["env"])
            except DoesNotFit as error:
                raise ValueError(f"env: {error}") from error
        if reasons:
            missing = self._missing if state["env"]["environments"] is None else []
            self._start_episodes_anew([*reasons, *missing])
        with self._restoring(state):
            self._states.restore(state["callbacks"])
            self._open_log(state["progress"])
            training_state.restore_logger(self._model.logger, state["logger"])
            training_state.restore_generators(state["generators"], self._model.device)

    def _start_episodes_anew(self, reasons: list[str]) -> None:
        model: Any = self._model
        warn(f"The episodes in progress start anew: {'; '.join(reasons)}")
        if model.seed is not None:
            # Otherwise the episodes of the run's beginning would come again.
            self._env.seed(model.seed + model.num_timesteps)
        model._last_obs = self._env.reset()
        model._last_episode_starts = np.ones((self._env.num_envs,), dtype=bool)
        normalize = model.get_vec_normalize_env()
        model._last_original_obs = None if normalize is None else normalize.get_original_obs()
        if model.action_noise is not None:
            model.action_noise.reset()
        if "model" in self._rings:
            self._rings["model"].interrupt()
        model._on_environment_reset()

    # ---------------------------------------------------------------- saving

    def is_due(self) -> bool:
        """
        :return: whether a checkpoint is to be made after the turn
        """
        if self._folder is None:
            return False
        assert self._interrupts is not None and self._held is not None
        due = self._model.num_timesteps // self._every > self._period
        return due or self._interrupts.received is not None or self._held.has_raised()

    def after_turn(self, is_due: bool) -> None:
        """
        Save if a checkpoint is due, and leave if the process was asked to.

        :param is_due: answer of :meth:`is_due`. After a signal that came since then, what runs beside the turns is not
            paused: the training ends after the next turn
        :raises Exception: what a callback raised during the turn
        :raises TrainingDiverged: something that would be saved is not finite
        :raises KeyboardInterrupt: after SIGINT
        :raises SystemExit: after SIGTERM
        :raises LeftWithTheOthers: after the failure of another training in its group
        """
        if self._folder is None:
            return
        assert self._interrupts is not None and self._held is not None
        now = self._whole_at = self._model.num_timesteps
        leaves = self._interrupts.leaves(now) and (is_due or self._seat is not None)
        due = now // self._every > self._period
        self._period = now // self._every
        try:
            if (due or leaves or self._held.has_raised()) and now != self._saved_at:
                self._try_to_save()
        finally:
            self._held.raise_kept()
        if leaves:
            self._interrupts.leave(saved_at=self._saved_at)

    def finish(self) -> None:
        """
        Call the callback's ``on_training_end``. An error that it raises does not cost the turns since the last
        checkpoint.

        :raises Exception: the callback's error, from this call or from a turn that it ended
        """
        if self._held is not None:
            self._held.raise_kept()
        try:
            self._callback.on_training_end()
        except Exception:
            if self._folder is not None:
                self._save_if_whole()
            raise

    def _try_to_save(self) -> None:
        try:
            self._save()
        except (OSError, NotPortable, container.TooLarge) as error:
            last = "there is none yet" if self._saved_at is None else f"the last one is of {self._saved_at} steps"
            warn(
                f"No checkpoint at {self._model.num_timesteps} steps, {last}: {self._name} cannot be written to "
                f"({error}). The training goes on, and it is tried again after {self._every} steps."
            )

    def _save(self) -> None:
        """
        :raises OSError: it cannot be written
        :raises TrainingDiverged: it would hold numbers that are not finite
        """
        check_finite_parameters(self._model)
        known = self._manifest["segments"]
        segments = dict(known)
        try:
            for name, ring in self._rings.items():
                segments = self._save_rows(_file_name(name), ring, segments)
            self._save_rest(segments)
        except BaseException:
            assert self._folder is not None
            self._folder.remove_segments(segments.keys() - known.keys())
            raise
        self._manifest = {"segments": segments}
        self._saved_at = self._model.num_timesteps
        for ring in self._rings.values():
            ring.n_written = ring.n_rows

    def _save_rest(self, segments: dict[str, Any]) -> None:
        assert self._folder is not None and self._progress is not None and self._states is not None
        model = self._model
        state = {
            "identity": self._identity,
            "attributes": training_state.save_attributes(model),
            "elapsed_ns": time.time_ns() - model.start_time,
            "rings": {name: ring.small() for name, ring in self._rings.items()},
            "env": self._save_env(),
            "callbacks": self._states.save(),
            "progress": self._progress.state(),
            "logger": training_state.save_logger(model.logger),
            "generators": training_state.save_generators(model.device),
        }
        files: dict[str, Callable[[IO[bytes]], Any]] = {
            MODEL: lambda file: model.save(file),  # type: ignore[arg-type]
            STATE: lambda file: _write(file, KIND, state),
        }
        about = {"circumstances": training_state.circumstances(model.device)}
        try:
            self._folder.write(model.num_timesteps, files, segments, about)
        except (NotPortable, container.TooLarge):
            if not self._leave_out(state):
                raise
            self._folder.write(model.num_timesteps, files, segments, about)

    def _save_env(self) -> dict[str, Any]:
        state, missing = vec_envs.save(self._env)
        if missing and not self._missing:
            self._warn_of_missing("env", "episodes in progress", "; ".join(missing))
        return state

    def _warn_of_missing(self, name: str, what: str, why: str) -> None:
        """Warn once that a checkpoint lacks something."""
        if name not in self._left_out:
            self._left_out.add(name)
            warn(f"A checkpoint does not hold the {what}: {why}. They start anew when the run goes on")

    def _leave_out(self, state: dict[str, Any]) -> bool:
        """
        Remove from a state the episodes in progress and the callbacks that no file can hold, with one warning: a
        checkpoint without them is better than none. Return whether anything was removed.
        """
        reasons = {path: reason for path, each in state["callbacks"].items() if (reason := _refusal(each, path))}
        for path in reasons:
            del state["callbacks"][path]
        if reason := _refusal(state["env"]["environments"], "env"):
            reasons["env"] = reason
            state["env"]["environments"] = None
        for name, reason in reasons.items():
            self._warn_of_missing(name, "episodes in progress" if name == "env" else f"state of {name}", reason)
        return bool(reasons)

    def _save_rows(self, name: str, ring: Ring, known: dict[str, Any]) -> dict[str, Any]:
        """Write the rows that the files lack, and return the manifest's entries for all rows that are then needed."""
        assert self._folder is not None
        first, last = ring.advance()
        oldest = last - ring.size()
        needed = {k: facts for k, facts in known.items() if facts["ring"] != name or facts["last"] > oldest}
        others = {k: facts for k, facts in needed.items() if facts["ring"] != name}
        if len(needed) - len(others) >= run_folder.MAX_SEGMENTS:
            # Once in a while write all rows in one piece, so that a manifest stays short.
            first, needed = oldest, others
        if first < last:
            segment = Segment(name, first, last)
            needed[segment.path] = self._folder.write_segment(
                segment, lambda file: _write(file, SEGMENT_KIND, ring.rows(first))
            )
        return needed

    def _environments(self) -> list[VecEnv]:
        """The training's environments first, then the callbacks'."""
        theirs = [env for _, each in self._callbacks() for _, env in environments(each)]
        assert self._model.env is not None
        return [self._model.env, *(env for env in theirs if isinstance(env, VecEnv))]


def _ring_of(model: Any) -> Ring:
    buffer: ReplayBuffer = model.replay_buffer
    return Ring(buffer, lambda: model.num_transitions // buffer.n_envs)


def _file_name(ring: str) -> str:
    """A name for files, without the special characters that a callback's path may have."""
    return "".join(c if c.isalnum() else "_" for c in ring)


def _write(file: IO[bytes], kind: str, value: Any) -> None:
    tensors: dict[str, torch.Tensor] = {}
    container.write(file, kind, encode(value, kind, tensors), tensors)


def _refusal(value: Any, name: str) -> str:
    """Why a checkpoint cannot hold a value, or that it takes more than half of a limit; empty if it fits."""
    tensors: dict[str, torch.Tensor] = {}
    try:
        text = json.dumps(encode(value, name, tensors)).encode()
    except NotPortable as error:
        return str(error)
    for n, most, what in (
        (len(text), container.MAX_JSON, "bytes of JSON"),
        (container.n_values(text), container.MAX_VALUES, "values"),
        (len(tensors), container.MAX_TENSORS, "arrays"),
    ):
        if n > most // 2:
            return f"{name} takes {n:,} {what}"
    return ""


def _check_parts(state: Any, path: Path) -> None:
    parts = state if isinstance(state, dict) else {}
    wrong = [name for name, kind in _PARTS.items() if type(parts.get(name)) is not kind]
    if not wrong and not all(
        isinstance(pair, list) and len(pair) == 2 and all(isinstance(text, str) for text in pair)
        for pair in parts["identity"].values()
    ):
        wrong = ["identity"]
    if wrong or parts.keys() != _PARTS.keys():
        raise BadFile(f"{path} is damaged or hostile: {wrong or sorted(map(str, parts))!r:.200} is not what it must be")


def _own_modules(model: BaseAlgorithm) -> tuple[str, ...]:
    """
    Packages whose classes a checkpoint's parameters may name: those that the parts of the model come from. Not every
    package that the program has imported: for some classes, making or deleting an object does harm.
    """
    parts = [model, *vars(model).values(), *model.policy.modules()]
    packages = {cls.__module__.partition(".")[0] for part in parts for cls in type(part).__mro__}
    return tuple(sorted(packages - sys.stdlib_module_names))
