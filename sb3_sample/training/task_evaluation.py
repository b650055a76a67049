"""Evaluation of a model of several tasks, task by task."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_sample.console import say
from sb3_sample.kinds import TRUE_OR_FALSE, check_value, integer
from sb3_sample.run_logs import EVALUATIONS
from sb3_sample.saving.callbacks import CallbackStates
from sb3_sample.saving.temporary import becoming


class TaskEvaluation(NamedTuple):
    """
    Evaluation of one task; each list has one value per episode.

    :param returns: undiscounted returns
    :param lengths: in steps
    :param successes: whether the episode was a success; empty if the environment does not report it
    """

    returns: list[float]
    lengths: list[int]
    successes: list[bool]

    @property
    def mean_return(self) -> float:
        """Mean return over the episodes."""
        return float(np.mean(self.returns))

    @property
    def success_rate(self) -> float | None:
        """Share of the episodes that were a success; None if the environment does not report it."""
        return float(np.mean(self.successes)) if self.successes else None


def evaluate_tasks(
    model: Any,
    env: VecEnv,
    n_eval_episodes: int = 5,
    deterministic: bool = True,
    render: bool = False,
    warn: bool = True,
) -> dict[str, TaskEvaluation]:
    """
    Evaluate a model on each task, by Stable-Baselines3's ``evaluate_policy``.

    :param model: the model, or any object with its ``predict``
    :param env: environment of :func:`~sb3_sample.envs.multi_task.multi_task_env`, wrapped or not
    :param n_eval_episodes: episodes per task
    :param deterministic: whether to take mean actions
    :param render: whether the environments are drawn
    :param warn: whether to warn of a missing ``Monitor``
    :return: evaluations by the task's id, in the order of the tasks
    :raises ValueError: if ``env`` is not of several tasks, a task has another number than the model has learned, or
        another argument is out of range
    """
    check_value("n_eval_episodes", n_eval_episodes, integer(1))
    ids = task_ids("env", env)
    check_tasks(getattr(model, "task_ids", None), ids)
    found = {task_id: TaskEvaluation([], [], []) for task_id in ids}
    of_env = list(found.values())

    def take(local: dict[str, Any], _: dict[str, Any]) -> None:
        if not local["done"]:
            return
        i, info = local["i"], local["info"]
        task = of_env[i]
        # Monitor's episode, or what evaluate_policy has counted without a Monitor.
        episode = info.get("episode", {"r": local["current_rewards"][i], "l": local["current_lengths"][i]})
        task.returns.append(float(episode["r"]))
        task.lengths.append(int(episode["l"]))
        if info.get("is_success") is not None:
            task.successes.append(bool(info["is_success"]))

    evaluate_policy(
        model,
        env,
        n_eval_episodes=n_eval_episodes * env.num_envs,
        deterministic=deterministic,
        render=render,
        callback=take,
        warn=warn,
    )
    return found


def task_ids(name: str, env: Any) -> list[str]:
    """
    :param name: name of the argument, for the error
    :param env: environment of :func:`~sb3_sample.envs.multi_task.multi_task_env`, wrapped or not
    :return: ids of its tasks, in their order
    :raises ValueError: if it is not of several tasks
    """
    ids = tasks_of(env)
    if ids is None:
        raise ValueError(f"{name} must be of multi_task_env, whose environments have a task_id, not {env!r}")
    return ids


def tasks_of(env: Any) -> list[str] | None:
    """
    :param env: an environment
    :return: ids of its tasks, in their order; None if it is not of several tasks
    """
    # has_attr comes first, since a worker of SubprocVecEnv dies if asked for an attribute that does not exist.
    if not (hasattr(env, "has_attr") and env.has_attr("task_id")):
        return None
    return [str(task_id) for task_id in env.get_attr("task_id")]


def check_tasks(before: Any, now: Sequence[str] | None, name: str = "env") -> None:
    """
    Check that tasks of an environment have the numbers by which a model has learned them. Other tasks may have any.

    :param before: ids of the model's, in the order of their numbers, perhaps a file's; None if it has none
    :param now: likewise, of the environment
    :param name: name of the argument that has the environment, for the error
    :raises ValueError: if a task had another number
    """
    if before is None or before == now:
        return
    if not isinstance(before, list) or not all(isinstance(each, str) for each in before):
        raise ValueError(f"task_ids cannot be {before!r:.100}")
    if now is None or len({*now}) < len(now):  # several environments of a task, put together by hand
        return
    if moved := [each for i, each in enumerate(now) if each in before and before.index(each) != i]:
        raise ValueError(
            f"{name} must have the model's tasks in their order, {before}, not {now}: a task's number tells the model "
            f"which it is, and that of {moved[0]!r} was {before.index(moved[0])}"
        )


class MultiTaskEvalCallback(EvalCallback):
    """
    Stable-Baselines3's ``EvalCallback`` by task.

    The log has, besides the means over all tasks ("eval/mean_reward", "eval/success_rate"), each task's mean return as
    "eval_return/<id>" and its success rate as "eval_success/<id>", for all outputs but the terminal. Each task has its
    folder in ``log_path``, ``<log_path>/<id>``, with an ``evaluations.npz`` as Stable-Baselines3 writes it, whose
    ``timesteps`` are those of this task, and a ``run.json``: ``sb3_sample.study.read(log_path)`` has a run for each
    task. The best model is that of the highest mean return over all tasks.

    :param eval_env: environment of ``multi_task_env``, separate from the training's and with the same spaces
    :param callback_on_new_best: called when there is a new best mean return
    :param callback_after_eval: called after each evaluation
    :param n_eval_episodes: episodes per task
    :param eval_freq: steps that all tasks take together between two evaluations, which is also the number of steps of
        each task
    :param log_path: folder of the results; None for none
    :param best_model_save_path: folder of the best model; None for none
    :param deterministic: whether to take mean actions
    :param render: whether the environments are drawn
    :param verbose: 0 nothing, 1 a line for each task
    :param warn: whether to warn of a missing ``Monitor``
    :param at_start: whether there is an evaluation before the first step
    :raises ValueError: if ``eval_env`` is not of several tasks, or another argument is out of range
    """

    def __init__(
        self,
        eval_env: VecEnv,
        callback_on_new_best: BaseCallback | None = None,
        callback_after_eval: BaseCallback | None = None,
        n_eval_episodes: int = 5,
        eval_freq: int = 10_000,
        log_path: str | os.PathLike[str] | None = None,
        best_model_save_path: str | os.PathLike[str] | None = None,
        deterministic: bool = True,
        render: bool = False,
        verbose: int = 1,
        warn: bool = True,
        at_start: bool = True,
    ):
        check_value("n_eval_episodes", n_eval_episodes, integer(1))
        check_value("eval_freq", eval_freq, integer(1))
        check_value("at_start", at_start, TRUE_OR_FALSE)
        #: Ids of the tasks, in their order.
        self.task_ids = task_ids("eval_env", eval_env)
        super().__init__(
            eval_env,
            callback_on_new_best,
            callback_after_eval,
            n_eval_episodes,
            eval_freq,
            None,
            None if best_model_save_path is None else os.fspath(best_model_save_path),
            deterministic,
            render,
            verbose,
            warn,
        )
        self.task_log_path = None if log_path is None else os.fspath(log_path)
        self.at_start = at_start
        #: Steps per task at the evaluations, and the values of all episodes, (T, tasks, episodes).
        self.evaluations_timesteps: list[int] = []
        self.evaluations_results: list[list[list[float]]] = []  # type: ignore[assignment]
        self.evaluations_length: list[list[list[int]]] = []  # type: ignore[assignment]
        self.evaluations_successes: list[list[list[bool]]] = []  # type: ignore[assignment]

    @property
    def last_results(self) -> dict[str, TaskEvaluation]:
        """The latest evaluation, by the task's id; empty before the first."""
        if not self.evaluations_timesteps:
            return {}
        returns, lengths, successes = (
            values[-1] for values in (self.evaluations_results, self.evaluations_length, self.evaluations_successes)
        )
        return {
            task_id: TaskEvaluation(returns[k], lengths[k], successes[k])  # type: ignore[arg-type]
            for k, task_id in enumerate(self.task_ids)
        }

    def _init_callback(self) -> None:
        for name in ("observation_space", "action_space"):
            ours, theirs = getattr(self.model, name), getattr(self.eval_env, name)
            if ours != theirs:
                raise ValueError(f"eval_env has the {name} {theirs}, but the model has {ours}")
        check_tasks(getattr(self.model, "task_ids", None), self.task_ids, "eval_env")
        super()._init_callback()

    def _on_training_start(self) -> None:
        super()._on_training_start()
        if self.at_start and self.num_timesteps == 0 and not self.evaluations_timesteps:
            states = CallbackStates(self)
            self._evaluate()
            # A resumed run does not evaluate here again, and needs the results of its checkpoint.
            states.note_changes()

    def _on_step(self) -> bool:
        return self._evaluate() if self.n_calls % self.eval_freq == 0 else True

    def _evaluate(self) -> bool:
        """Evaluate all tasks, log and write the results; return whether the training continues."""
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        found = evaluate_tasks(
            self.model, self.eval_env, self.n_eval_episodes, self.deterministic, self.render, self.warn
        )
        # Gradient steps, not those of all tasks together, where the model learns from a data set.
        offline = getattr(self.model, "_learns_from", None) is not None
        steps = self.num_timesteps if offline else self.num_timesteps // len(found)
        self.last_mean_reward = float(np.mean([task.mean_return for task in found.values()]))
        self._log(found, steps)
        self.evaluations_timesteps.append(steps)
        self.evaluations_results.append([task.returns for task in found.values()])
        self.evaluations_length.append([task.lengths for task in found.values()])
        self.evaluations_successes.append([task.successes for task in found.values()])
        if self.task_log_path is not None:
            self._write(Path(self.task_log_path))
        goes_on = True
        if self.last_mean_reward > self.best_mean_reward:
            self.best_mean_reward = self.last_mean_reward
            if self.best_model_save_path is not None:
                self.model.save(os.path.join(self.best_model_save_path, "best_model"))
            if self.callback_on_new_best is not None:
                goes_on = self.callback_on_new_best.on_step()
        if self.callback is not None:
            goes_on = goes_on and self._on_event()
        return goes_on

    def _log(self, found: dict[str, TaskEvaluation], steps: int) -> None:
        if self.verbose >= 1:
            say(f"Evaluation after {steps:,} steps a task: mean return {self.last_mean_reward:.2f}")
        for task_id, task in found.items():
            self.logger.record(f"eval_return/{task_id}", task.mean_return, exclude="stdout")
            if task.success_rate is not None:
                self.logger.record(f"eval_success/{task_id}", task.success_rate, exclude="stdout")
            if self.verbose >= 1:
                rate = "" if task.success_rate is None else f", success {100 * task.success_rate:.0f}%"
                say(f"  {task_id}: return {task.mean_return:.2f}{rate}")
        self.logger.record("eval/mean_reward", self.last_mean_reward)
        self.logger.record("eval/mean_ep_length", float(np.mean([np.mean(task.lengths) for task in found.values()])))
        rates = [task.success_rate for task in found.values() if task.success_rate is not None]
        if rates:
            self.logger.record("eval/success_rate", float(np.mean(rates)))
        # Written at once, so that the values stand at the step at which they were measured.
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _write(self, folder: Path) -> None:
        for number, task_id in enumerate(self.task_ids):
            own = folder / task_id.replace(":", "_")
            own.mkdir(parents=True, exist_ok=True)
            # Anew for every training: an earlier one in the same folder may have had another seed.
            record, path = json.dumps(self._record(task_id), indent=1), own / "run.json"
            if not path.exists() or path.read_text() != record:
                path.write_text(record)
            arrays: dict[str, Any] = {
                "timesteps": self.evaluations_timesteps,
                "results": [each[number] for each in self.evaluations_results],
                "ep_lengths": [each[number] for each in self.evaluations_length],
            }
            if self.evaluations_successes[-1][number]:
                arrays["successes"] = [each[number] for each in self.evaluations_successes]
            with becoming(own / EVALUATIONS) as file:  # others may read it meanwhile
                np.savez(file, **arrays)

    def _record(self, task_id: str) -> dict[str, Any]:
        """Record of a task's folder, as the table of runs reads it."""
        model: BaseAlgorithm = self.model
        settings = {"n_tasks": repr(len(self.task_ids))}
        env: Any = self.eval_env
        # has_attr first, since get_attr of a missing attribute kills a worker of SubprocVecEnv.
        repeats = env.get_attr("action_repeat") if env.has_attr("action_repeat") else [1]
        # Those of multi_task_env have one for all.
        if all(type(each) is int and each == repeats[0] for each in repeats) and repeats[0] > 1:
            settings["env_kwargs"] = repr({"action_repeat": repeats[0]})
        return {"algo": type(model).__name__, "env": task_id, "seed": model.seed, "settings": settings}
