"""The off-policy family."""

from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.bro import BRO, BROTD3, BROFast
from sb3_sample.sac.dac import DAC
from sb3_sample.sac.offline import BC, IQL, TD3BC
from sb3_sample.sac.regularized_sac import RegularizedSAC
from sb3_sample.sac.rivals import GPLSAC, OAC, OPLSAC, SRSAC, TOPSAC
from sb3_sample.sac.vpl_sac import VPLSAC

__all__ = [
    "BC",
    "BRO",
    "BROTD3",
    "DAC",
    "GPLSAC",
    "IQL",
    "OAC",
    "OPLSAC",
    "SAC",
    "SRSAC",
    "TD3BC",
    "TOPSAC",
    "VPLSAC",
    "BROFast",
    "RegularizedSAC",
]
