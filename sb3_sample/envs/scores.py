"""
Scores on a common scale, by which tasks are averaged: what is measured of a task, and what 0 and 1 stand for.

* DeepMind Control: the return over 1,000, its largest (BRO, section 3).
* Meta-World, MyoSuite and Fetch: the success rate as it is.
* MuJoCo: the return over the value of table 1 of "Value-Based Deep RL Scales Predictably" (Rybkin et al. 2025).
"""

from typing import Any, NamedTuple

from sb3_sample.envs.registration import PACKAGE


class Score(NamedTuple):
    """
    How a score is made of what was measured, ``(value - low) / (high - low)``. Nothing is clipped.

    :param metric: "return" or "success_rate"
    :param high: value whose score is 1
    :param low: value whose score is 0
    """

    metric: str
    high: float = 1.0
    low: float = 0.0

    def of(self, values: Any) -> Any:
        """
        :param values: what was measured, of any shape
        :return: the scores, of the same shape
        """
        return (values - self.low) / (self.high - self.low)


#: MuJoCo's tasks, by their names without version.
_GYMNASIUM = {"HalfCheetah": 8_500.0, "Walker2d": 4_500.0, "Ant": 6_625.0, "Humanoid": 6_125.0}
_DMC_RETURN = 1_000.0
_SUCCESS = ("metaworld/", "myosuite/", "Fetch")
#: The tasks that have one, in words.
SCORED = (
    "the tasks of dmc/ (returns), of metaworld/, myosuite/ and Fetch (success rates) and for "
    f"{', '.join(_GYMNASIUM)} (returns)"
)


def score_of(env_id: str) -> Score | None:
    """
    :param env_id: id of an environment, e.g. ``"dmc/cheetah-run-v0"`` or ``"HalfCheetah-v5"``
    :return: its score; None if there is no common one
    """
    name = env_id.removeprefix(f"{PACKAGE}:")
    if name.startswith("dmc/"):
        return Score("return", _DMC_RETURN)
    if name.startswith(_SUCCESS):
        return Score("success_rate")
    task, separator, version = name.rpartition("-v")
    if separator and version.isdigit() and task in _GYMNASIUM:
        return Score("return", _GYMNASIUM[task])
    return None
