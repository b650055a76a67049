"""The algorithms of this package in the commands of the RL Zoo (``rl_zoo3``)."""

from sb3_sample.extras import install

try:
    import optuna  # noqa: F401
    import rl_zoo3.hyperparams_opt
    import rl_zoo3.utils  # noqa: F401
except ModuleNotFoundError as error:
    raise ImportError(f"The zoo's commands need rl_zoo3 ({error}). Install it with: {install('zoo')}") from error

from sb3_sample.zoo.algorithms import ALGORITHMS, HYPERPARAMS
from sb3_sample.zoo.patches import register
from sb3_sample.zoo.search import decode, decode_regularized

__all__ = ["ALGORITHMS", "HYPERPARAMS", "decode", "decode_regularized", "register"]
