"""Measurement of published curves, as in ``data/README.md``, and its differences from the user's own runs."""

from collections.abc import Iterable, Sequence

from sb3_sample.envs.suites import published_key
from sb3_sample.plots import (
    COLUMNS,
    PUBLISHED,
    Curve,
    all_published_curves,
    named_algorithms,
    published_curves,
)

#: Number of seeds below which a legend says that there are few.
FEW = 5
#: Action repeat by algorithm and beginning of ``suite/task``; "" stands for all. Without a match it is not stated. For
#: BRO see :func:`action_repeat`.
_REPEATS: dict[str, dict[str, int]] = {
    "BRC (single task)": {"": 1},
    "BRC (multi-task)": {"": 1},
    "SimbaV2 (RR=1)": {"gymnasium": 1, "": 2},
    "SimbaV2 (RR=2)": {"gymnasium": 1, "": 2},
    "SimbaV2 (RR=4)": {"gymnasium": 1, "": 2},
    "SimbaV2 (RR=8)": {"gymnasium": 1, "": 2},
    "SimBa (RR=2)": {"": 2},
    "SAC": {"dmc/dog": 2, "dmc/humanoid": 2, "humanoidbench": 2, "myosuite": 2},
    "SAC (SimBa authors)": {"": 2},
    "SAC (TD-MPC2 authors)": {"myosuite": 1, "": 2},
    "TD-MPC2": {"myosuite": 1, "humanoidbench": 1, "": 2},
    "DreamerV3 (TD-MPC2 authors)": {"myosuite": 1, "": 2},
    "CrossQ": {"": 1},
    "DroQ (RR=20)": {"": 1},
    "REDQ (RR=20)": {"": 1},
    "XQC": {"gymnasium": 1, "": 2},
    "FlashSAC": {"": 1},
    "DR.Q": {"gymnasium": 1, "": 2},
}
#: How success is counted, unless at any step of the episode.
_SUCCESS = {
    "TD-MPC2": "success at the last step",
    "SAC (TD-MPC2 authors)": "success at the last step",
    "DreamerV3 (TD-MPC2 authors)": "success at the last step",
    "FlashSAC": "success at any or the last step: not stated",
}
#: Versions of the published tasks.
_VERSIONS = {"metaworld": "v2", "gymnasium": "v4"}


def action_repeat(algorithm: str, suite: str, task: str, n_seeds: int) -> int:
    """
    :param algorithm: as in the published curves
    :param suite: likewise
    :param task: likewise
    :param n_seeds: number of seeds of the curve. BRO's authors have ten; reruns by others, whose action repeat is not
        stated, five
    :return: simulator steps per decision; 0 if not stated
    """
    if algorithm in ("BRO (RR=10)", "BRO Fast (RR=2)"):
        return 1 if n_seeds >= 10 else 0
    repeats = _REPEATS.get(algorithm, {})
    return next((repeat for start, repeat in repeats.items() if f"{suite}/{task}".startswith(start)), 0)


def differences(curve: Curve, task: str, metric: str, own_repeats: Iterable[int]) -> list[str]:
    """
    :param curve: a published curve on a task
    :param task: id of the environment
    :param metric: "return" or "success_rate"
    :param own_repeats: action repeats of the runs shown beside it
    :return: differences that limit the comparison, in words
    """
    n_seeds = int(curve.data["n_seeds"].min())
    found = [f"{n_seeds} seeds only"] if n_seeds < FEW else []
    names = named_algorithms(curve.label, list(all_published_curves()["algorithm"].unique()))
    try:
        suite, name = published_key(task)
    except ValueError:  # the suite is not in the package
        names = []
    if len(names) != 1:
        return [*found, "how it was measured is not known"]
    repeat = action_repeat(names[0], suite, name, n_seeds)
    if not repeat:
        found.append("action repeat not stated")
    elif any(repeat != own for own in own_repeats):
        found.append(f"action repeat {repeat}")
    if metric == "success_rate" and names[0] in _SUCCESS:
        found.append(_SUCCESS[names[0]])
    version = _VERSIONS.get(suite)
    if version is not None and not task.endswith(f"-{version}"):
        found.append(f"of the {version} task")
    if names[0] == "TD7":
        found.append("its steps look one evaluation late")
    if names[0] == "XQC" and name == "cartpole-swingup_sparse":
        found.append("0 throughout")
    return found


def chosen_curves(names: Sequence[str] | None, covered: Sequence[str], task: str, metric: str) -> list[Curve]:
    """
    :param names: of published algorithms, as for ``sb3-sample plot --published``; None for its default
    :param covered: names without brackets that are not drawn by default, since all their seeds are shown as runs
    :param task: id of an environment
    :param metric: "return" or "success_rate"
    :return: their curves of that task, as far as they exist
    :raises ValueError: a name has no curves on any task
    """
    known = list(all_published_curves()["algorithm"].unique())
    for name in names or ():
        if not named_algorithms(name, known):
            raise ValueError(f"curves must be of {', '.join(known)} (or without the brackets), not {name!r}")
    wanted = [name for name in PUBLISHED if name not in covered] if names is None else names
    data = published_curves(task)
    data = data[data["metric"] == metric]
    available = list(data["algorithm"].unique())
    chosen = dict.fromkeys(each for name in wanted for each in named_algorithms(name, available))
    return [
        Curve(algorithm, data.loc[data["algorithm"] == algorithm, COLUMNS].sort_values("env_step"), published=True)
        for algorithm in chosen
    ]
