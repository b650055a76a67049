"""The off-policy family."""

from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.brc import BRC
from sb3_sample.sac.bro import BRO, BROTD3, BROFast
from sb3_sample.sac.crossq import CrossQ
from sb3_sample.sac.dac import DAC
from sb3_sample.sac.debiased_rq import DebiasedRQ
from sb3_sample.sac.drq import DrQ, DrQv2
from sb3_sample.sac.flash_sac import FlashSAC
from sb3_sample.sac.offline import BC, IQL, TD3BC
from sb3_sample.sac.regularized_sac import RegularizedSAC
from sb3_sample.sac.rivals import GPLSAC, OAC, OPLSAC, SRSAC, TOPSAC
from sb3_sample.sac.simba import SimBa, SimbaV2
from sb3_sample.sac.vpl_sac import VPLSAC
from sb3_sample.sac.xqc import XQC

__all__ = [
    "BC",
    "BRC",
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
    "XQC",
    "BROFast",
    "CrossQ",
    "DebiasedRQ",
    "DrQ",
    "DrQv2",
    "FlashSAC",
    "RegularizedSAC",
    "SimBa",
    "SimbaV2",
]
