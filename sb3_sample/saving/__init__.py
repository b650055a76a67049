"""Files of models and replay buffers, which run no code, and checkpoints of trainings."""

from sb3_sample.saving.container import BadFile
from sb3_sample.saving.encoding import NotPortable
from sb3_sample.saving.normalization import load_vec_normalize, save_vec_normalize

__all__ = ["BadFile", "NotPortable", "load_vec_normalize", "save_vec_normalize"]
