"""
The algorithms of this package, as the zoo needs them.

A new algorithm is one entry of ``ALGORITHMS`` and one file ``hyperparams/<name>.yml``.
"""

from pathlib import Path
from typing import Any, NamedTuple

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO, RewoundPPO
from sb3_sample.replay.buffers import DeviceReplayBuffer
from sb3_sample.replay.compact import CompactDictReplayBuffer, CompactNStepReplayBuffer, CompactReplayBuffer
from sb3_sample.replay.weighted import (
    FadedDictReplayBuffer,
    FadedReplayBuffer,
    PrioritizedDictReplayBuffer,
    PrioritizedReplayBuffer,
    WindowDictReplayBuffer,
    WindowReplayBuffer,
)
from sb3_sample.sac import (
    BC,
    BRC,
    BRO,
    BROTD3,
    DAC,
    GPLSAC,
    IQL,
    OAC,
    OPLSAC,
    SAC,
    SRSAC,
    TD3BC,
    TOPSAC,
    VPLSAC,
    XQC,
    BROFast,
    CrossQ,
    DebiasedRQ,
    DrQ,
    DrQv2,
    FlashSAC,
    RegularizedSAC,
    SimBa,
    SimbaV2,
)
from sb3_sample.saving.untrusted import BadFile
from sb3_sample.srspr import SRSPR
from sb3_sample.zoo import search
from sb3_sample.zoo.trials import check_params

#: The files ``<algorithm>.yml``, read when ``--conf-file`` is not given.
HYPERPARAMS = Path(__file__).parents[1] / "hyperparams"


#: Replay buffers of this package that a file of hyperparameters, ``-params`` or a plan may name as
#: ``replay_buffer_class``, as the zoo allows for ``HerReplayBuffer``.
BUFFERS: dict[str, type[ReplayBuffer]] = {
    cls.__name__: cls
    for cls in (
        CompactDictReplayBuffer,
        CompactNStepReplayBuffer,
        CompactReplayBuffer,
        DeviceReplayBuffer,
        FadedDictReplayBuffer,
        FadedReplayBuffer,
        PrioritizedDictReplayBuffer,
        PrioritizedReplayBuffer,
        WindowDictReplayBuffer,
        WindowReplayBuffer,
    )
}


class ZooAlgorithm(NamedTuple):
    """
    An algorithm as the zoo needs it.

    :param algorithm: the class
    :param space: its search space
    :param convert: turns suggested parameters, of a trial under way or a stored one, into arguments
    """

    algorithm: type[BaseAlgorithm]
    space: search.Space
    convert: search.Converter = search.decode


#: The algorithms by their names in the zoo (``--algo``, log folders, ``hyperparams/<name>.yml``). "sac" is the zoo's
#: own, Stable-Baselines3's.
ALGORITHMS: dict[str, ZooAlgorithm] = {
    "bc": ZooAlgorithm(BC, search.BC_SPACE),
    "brc": ZooAlgorithm(BRC, search.BRC_SPACE),
    "bro": ZooAlgorithm(BRO, search.BRO_SPACE),
    "bro_fast": ZooAlgorithm(BROFast, search.BRO_FAST_SPACE),
    "bro_td3": ZooAlgorithm(BROTD3, search.BRO_TD3_SPACE),
    "crossq": ZooAlgorithm(CrossQ, search.CROSSQ_SPACE),
    "dac": ZooAlgorithm(DAC, search.DAC_SPACE),
    "dr_q": ZooAlgorithm(DebiasedRQ, search.DR_Q_SPACE),
    "drq": ZooAlgorithm(DrQ, search.DRQ_SPACE),
    "drqv2": ZooAlgorithm(DrQv2, search.DRQV2_SPACE),
    "flash_sac": ZooAlgorithm(FlashSAC, search.FLASH_SPACE),
    "gpl_sac": ZooAlgorithm(GPLSAC, search.GPL_SPACE),
    "iql": ZooAlgorithm(IQL, search.IQL_SPACE),
    "mbma_ppo": ZooAlgorithm(MBMAPPO, search.MBMA_SPACE),
    "mbpo_ppo": ZooAlgorithm(MBPOPPO, search.MBPO_SPACE),
    "oac": ZooAlgorithm(OAC, search.OAC_SPACE),
    "opl_sac": ZooAlgorithm(OPLSAC, search.OPL_SPACE),
    "qma_ppo": ZooAlgorithm(QMAPPO, search.ON_POLICY_SPACE),
    "regularized_sac": ZooAlgorithm(RegularizedSAC, search.REGULARIZED_SPACE, search.decode_regularized),
    "rewound_ppo": ZooAlgorithm(RewoundPPO, search.REWOUND_SPACE),
    "sac_sample": ZooAlgorithm(SAC, search.SAC_SPACE),
    "simba": ZooAlgorithm(SimBa, search.SIMBA_SPACE),
    "simbav2": ZooAlgorithm(SimbaV2, search.SIMBAV2_SPACE),
    "sr_sac": ZooAlgorithm(SRSAC, search.SR_SAC_SPACE),
    "srspr": ZooAlgorithm(SRSPR, search.SRSPR_SPACE),
    "td3bc": ZooAlgorithm(TD3BC, search.TD3BC_SPACE),
    "top_sac": ZooAlgorithm(TOPSAC, search.TOP_SPACE),
    "vpl_sac": ZooAlgorithm(VPLSAC, search.VPL_SPACE),
    "xqc": ZooAlgorithm(XQC, search.XQC_SPACE),
}


def stored_arguments(algo: str, params: dict[str, Any], where: str) -> dict[str, Any]:
    """
    :param algo: name of an algorithm of ours
    :param params: parameters of a stored trial, which anybody may have written
    :param where: whose they are, for messages
    :return: arguments of the constructor
    :raises BadFile: (a ``ValueError``) if they are not what a search of the algorithm stores
    """
    entry = ALGORITHMS[algo]
    check_params(params, {**entry.space, **search.HER_SPACE}, where)
    try:
        return entry.convert(params)
    except KeyError as error:
        raise BadFile(f"{where} has no {error}, which a search of {algo} stores") from error
