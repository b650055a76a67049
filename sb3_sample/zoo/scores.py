"""
Normalised scores for ``plot_from_file --rliable``, which averages over tasks and draws them as "Normalized Score". The
stock zoo has reference scores for six tasks and draws the scores of all others unnormalised, under the same name.
"""

import argparse
import contextlib
import warnings
from collections.abc import Collection, Iterator, Sequence
from typing import IO, Any

import numpy as np

from sb3_sample.envs.scores import SCORED, Score, score_of
from sb3_sample.zoo.files import PlottedRuns, RunError

#: Tasks, by their names in the zoo's tables, that its command normalises itself.
ZOO_REFERENCES = frozenset({"LunarLanderContinuous", "BipedalWalker"})
#: Parts of names that the zoo normalises by the scores of PyBullet's tasks, whichever task the runs are of.
PYBULLET = frozenset({"Half", "Ant", "Hopper", "Walker"})
#: Command that averages other tasks.
_OURS = "sb3-sample study aggregate averages runs of any tasks (--score TASK=HIGH)"


def rliable_options(arguments: Sequence[str]) -> tuple[bool, list[str], list[str]]:
    """
    :param arguments: of ``plot_from_file``
    :return: whether it is to draw rliable's plots, the tasks to skip, the tasks to keep (all if none is named)
    """
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("-r", "--rliable", action="store_true")
    parser.add_argument("-skip", "--skip-envs", nargs="+", default=[])
    parser.add_argument("--keep-envs", nargs="+", default=[])
    options, _ = parser.parse_known_args(arguments)
    return options.rliable, options.skip_envs, options.keep_envs


class NormalizedRuns(PlottedRuns):
    """
    Tables of runs with scores between 0 and 1.

    :param allow_pickle: whether pickled files are read too
    :param skip: tasks that are not drawn
    :param keep: the only ones that are; all if empty
    """

    def __init__(self, allow_pickle: bool, skip: Collection[str] = (), keep: Collection[str] = ()):
        super().__init__(allow_pickle)
        self._skip, self._keep = skip, keep

    def load(self, file: IO[bytes]) -> Any:
        """
        :param file: file to read
        :return: what ``all_plots`` gathered, with the scores of the drawn tasks normalised
        :raises BadFile: if it is damaged, or pickled and not allowed to be
        :raises RunError: if a task has no scale to normalise by
        """
        results = super().load(file)
        for task, runs_by_label in results.items():
            if task == "results_table" or task in self._skip or (self._keep and task not in self._keep):
                continue
            for runs in runs_by_label.values():
                score = _score(task, runs)
                for name in runs.keys() - {"timesteps"}:
                    is_error = name.startswith("std_error")
                    runs[name] = runs[name] / (score.high - score.low) if is_error else score.of(runs[name])
        return results


def _score(task: str, runs: dict[str, Any]) -> Score:
    """Scale of a task's scores."""
    score = score_of(_env_id(task))
    if score is not None and score.metric == "success_rate":
        scores = np.concatenate([np.ravel(runs["mean"]), np.ravel(runs["last_evals"])])
        if not ((scores >= 0) & (scores <= 1)).all():
            raise RunError(
                f"--rliable draws scores between 0 and 1, and those of {task} are returns, which have no common scale "
                "there: gather success rates, with all_plots --key successes"
            )
    if score is not None:
        return score
    if task in ZOO_REFERENCES:
        return Score("return")
    if task in PYBULLET:
        raise RunError(
            f"--rliable draws scores between 0 and 1, and the zoo's for {task!r} are those of PyBullet's task. Give "
            f"all_plots the whole id, as HalfCheetah-v5. There are scores for {SCORED}; {_OURS}"
        )
    raise RunError(
        f"--rliable draws scores between 0 and 1, and for {task} there is no score to normalise by. There is one for "
        f"{SCORED}, by their whole ids, and for the zoo's own {', '.join(sorted(ZOO_REFERENCES))}: leave {task} out "
        f"with --skip-envs, or draw without --rliable; {_OURS}"
    )


def _env_id(task: str) -> str:
    """The id of a task of the zoo's tables, in which a dash stands for the slash."""
    suite, dash, name = task.partition("-")
    return f"{suite}/{name}" if dash and suite in ("dmc", "metaworld", "myosuite", "ALE") else task


@contextlib.contextmanager
def saying_so() -> Iterator[None]:
    """
    Print how scores are normalised, and suppress the zoo's warning that it does not know the scale of tasks that are
    normalised already.
    """
    print(
        "Scores are normalised: returns of DeepMind Control over 1,000, success rates as they are, returns of MuJoCo's "
        "HalfCheetah, Walker2d, Ant and Humanoid over 8,500, 4,500, 6,625 and 6,125, those of the games of "
        "Atari-100k between random play and a human"
    )
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* not found for normalizing scores")
        yield
