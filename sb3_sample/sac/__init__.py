"""The off-policy family."""

from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.bro import BRO, BROFast
from sb3_sample.sac.dac import DAC
from sb3_sample.sac.rivals import GPLSAC, OAC, OPLSAC, SRSAC, TOPSAC
from sb3_sample.sac.vpl_sac import VPLSAC

__all__ = ["BRO", "DAC", "GPLSAC", "OAC", "OPLSAC", "SAC", "SRSAC", "TOPSAC", "VPLSAC", "BROFast"]
