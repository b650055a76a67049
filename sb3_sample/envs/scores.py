"""
Scores on a common scale, for averages over tasks: the measure of each task, and the meaning of 0 and 1.

* DeepMind Control: the return divided by 1,000, its maximum (BRO, section 3).
* Meta-World, MyoSuite and Fetch: the success rate as it is.
* MuJoCo: the return divided by the value in table 1 of "Value-Based Deep RL Scales Predictably" (Rybkin et al. 2025).
* Atari: the return of a game, scaled so that random play has 0 and a human 1.
"""

from typing import Any, NamedTuple

from sb3_sample.envs.registration import PACKAGE


class Score(NamedTuple):
    """
    How a score follows from a measured value, ``(value - low) / (high - low)``. Nothing is clipped.

    :param metric: "return" or "success_rate"
    :param high: value whose score is 1
    :param low: value whose score is 0
    """

    metric: str
    high: float = 1.0
    low: float = 0.0

    def of(self, values: Any) -> Any:
        """
        :param values: measured values, of any shape
        :return: the scores, of the same shape
        """
        return (values - self.low) / (self.high - self.low)


#: MuJoCo's tasks, by their names without version.
_GYMNASIUM = {"HalfCheetah": 8_500.0, "Walker2d": 4_500.0, "Ant": 6_625.0, "Humanoid": 6_125.0}
#: Returns of random play and of a human in the 26 games of Atari-100k, as in google-research/google-research,
#: bigger_better_faster/bbf/eval_run_experiment.py (Apache-2.0).
ATARI_100K: dict[str, tuple[float, float]] = {
    "Alien": (227.8, 7_127.7),
    "Amidar": (5.8, 1_719.5),
    "Assault": (222.4, 742.0),
    "Asterix": (210.0, 8_503.3),
    "BankHeist": (14.2, 753.1),
    "BattleZone": (2_360.0, 37_187.5),
    "Boxing": (0.1, 12.1),
    "Breakout": (1.7, 30.5),
    "ChopperCommand": (811.0, 7_387.8),
    "CrazyClimber": (10_780.5, 35_829.4),
    "DemonAttack": (152.1, 1_971.0),
    "Freeway": (0.0, 29.6),
    "Frostbite": (65.2, 4_334.7),
    "Gopher": (257.6, 2_412.5),
    "Hero": (1_027.0, 30_826.4),
    "Jamesbond": (29.0, 302.8),
    "Kangaroo": (52.0, 3_035.0),
    "Krull": (1_598.0, 2_665.5),
    "KungFuMaster": (258.5, 22_736.3),
    "MsPacman": (307.3, 6_951.6),
    "Pong": (-20.7, 14.6),
    "PrivateEye": (24.9, 69_571.3),
    "Qbert": (163.9, 13_455.0),
    "RoadRunner": (11.5, 7_845.0),
    "Seaquest": (68.4, 42_054.7),
    "UpNDown": (533.4, 11_693.2),
}
_DMC_RETURN = 1_000.0
_SUCCESS = ("metaworld/", "myosuite/", "Fetch")
#: The tasks that have a score, in words.
SCORED = (
    "the tasks of dmc/ (returns), of metaworld/, myosuite/ and Fetch (success rates) and for "
    f"{', '.join(_GYMNASIUM)} and the 26 games of Atari-100k (returns)"
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
    if separator and version.isdigit() and task.removeprefix("ALE/") in ATARI_100K and task.startswith("ALE/"):
        low, high = ATARI_100K[task.removeprefix("ALE/")]
        return Score("return", high, low)
    if separator and version.isdigit() and task in _GYMNASIUM:
        return Score("return", _GYMNASIUM[task])
    return None
