"""
Scaling laws of value-based reinforcement learning: the best batch size, learning rate and replay ratio for a budget
("Value-Based Deep RL Scales Predictably", Rybkin et al. 2025). Pure functions of the table of
:func:`sb3_sample.study.read`; the command is ``sb3-sample scaling``.
"""

from sb3_sample.diagnostics.measures import noise_scale
from sb3_sample.study.scaling.best import best_hyperparameters
from sb3_sample.study.scaling.budget import BudgetLaw, ComputeLaw, Point, fit_budget
from sb3_sample.study.scaling.crossings import crossings, default_levels, isotonic
from sb3_sample.study.scaling.files import read_laws, summary, write_laws
from sb3_sample.study.scaling.fitting import fit, normalize
from sb3_sample.study.scaling.laws import (
    DataLaw,
    HyperparameterLaw,
    SizeLaw,
    fit_data,
    fit_hyperparameter,
    fit_model_size,
    shared_alpha,
)
from sb3_sample.study.scaling.result import Estimate, Laws, Prediction, rounded_batch_size

__all__ = [
    "BudgetLaw",
    "ComputeLaw",
    "DataLaw",
    "Estimate",
    "HyperparameterLaw",
    "Laws",
    "Point",
    "Prediction",
    "SizeLaw",
    "best_hyperparameters",
    "crossings",
    "default_levels",
    "fit",
    "fit_budget",
    "fit_data",
    "fit_hyperparameter",
    "fit_model_size",
    "isotonic",
    "noise_scale",
    "normalize",
    "read_laws",
    "rounded_batch_size",
    "shared_alpha",
    "summary",
    "write_laws",
]
