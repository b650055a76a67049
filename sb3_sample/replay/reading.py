"""Data sets by name, as commands take them."""

import os
from pathlib import Path
from typing import Any

import gymnasium as gym

from sb3_sample.replay.dataset import Dataset

#: Endings of files in D4RL's layout.
HDF5 = (".hdf5", ".h5")


def read_dataset(
    source: str,
    env_id: str | None = None,
    env_kwargs: dict[str, Any] | None = None,
    memory_map: str | os.PathLike[str] | None = None,
) -> Dataset:
    """
    Read a data set from this computer. Needs the extra ``[offline]``.

    :param source: a folder or an id of Minari's, or an HDF5 file in D4RL's layout
    :param env_id: for an HDF5 file, which stores no spaces: id of the environment whose spaces the data have
    :param env_kwargs: arguments of the environment
    :param memory_map: as in ``Dataset.from_arrays``
    :return: the data set
    :raises ValueError: if there is none, or its content is invalid
    """
    if Path(source).suffix not in HDF5:
        return Dataset.from_minari(source, memory_map=memory_map)
    spaces: dict[str, Any] = {}
    if env_id is not None:
        env = gym.make(env_id, **(env_kwargs or {}))
        spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
        env.close()
    return Dataset.from_hdf5(source, memory_map=memory_map, **spaces)
