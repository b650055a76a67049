"""Files of data sets: Minari's folders, and D4RL's layout of HDF5."""

import contextlib
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_sample.envs.numbers import check_numbers
from sb3_sample.extras import install
from sb3_sample.replay import steps as sets
from sb3_sample.replay.memory_map import check_folder, n_bytes, zeros
from sb3_sample.replay.steps import Steps
from sb3_sample.warn import warn

#: A Minari id: namespaces, a name, a version.
_ID = re.compile(r"[\w-]+(/[\w-]+)*-v\d+")
#: D4RL's names, by those of ``Dataset.from_arrays``.
_D4RL = {
    "observations": "observations",
    "actions": "actions",
    "rewards": "rewards",
    "terminations": "terminals",
    "truncations": "timeouts",
}


def _minari() -> Any:
    try:
        import h5py  # noqa: F401
        import minari
        import minari.data_collector.episode_buffer
        import minari.dataset.minari_storage
    except ImportError as error:
        raise ImportError(f"Minari's data sets need minari and h5py ({error}): {install('offline')}") from error
    return minari


@contextlib.contextmanager
def opened_hdf5(path: str | os.PathLike[str]) -> Iterator[dict[str, Any]]:
    """
    Open a file in D4RL's layout.

    :param path: the file
    :return: the arrays by the names of ``Dataset.from_arrays``, large ones unread
    :raises ValueError: if it is not such a file
    """
    try:
        import h5py
    except ImportError as error:
        raise ImportError(f"HDF5 needs h5py: {install('offline')}") from error
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"path={os.fspath(path)!r} must be an HDF5 file: {error}") from error
    with file:
        missing = [name for name in _D4RL.values() if name not in file]
        if missing:
            raise ValueError(
                f"path={os.fspath(path)!r} must have {', '.join(_D4RL.values())}, as D4RL's files: it lacks "
                f"{', '.join(missing)}"
            )
        given = {name: _entries(file[theirs]) for name, theirs in _D4RL.items()}
        if "next_observations" in file:
            given["next_observations"] = _entries(file["next_observations"])
        yield given


def _entries(entry: Any) -> Any:
    return {key: _entries(value) for key, value in entry.items()} if hasattr(entry, "items") else entry


def _is_id(id_or_path: Any) -> bool:
    return isinstance(id_or_path, str) and _ID.fullmatch(id_or_path) is not None


def read_minari(id_or_path: Any, memory_map: Any) -> tuple[Steps, spaces.Space, spaces.Box]:
    """
    Read one of Minari's data sets.

    :param id_or_path: its folder, or its id
    :param memory_map: folder whose disk holds observations and actions; None: memory
    :return: the steps, and the spaces
    :raises ValueError: if there is none, its spaces are not supported, or its episodes are invalid
    """
    minari = _minari()
    folder = _found(id_or_path, minari)
    metadata = minari.dataset.minari_storage.MinariStorage.read_raw_metadata(folder)
    if not {"observation_space", "action_space"} <= metadata.keys():
        # Minari would make the environment that the file names, which can run any code.
        raise ValueError(f"{folder} has no spaces: write it anew by a newer version of Minari")
    data = minari.MinariDataset(folder)
    observation_space, action_space = data.observation_space, data.action_space
    n, n_episodes = int(data.total_steps), int(data.total_episodes)
    if n < 1 or not isinstance(action_space, spaces.Box):
        raise ValueError(f"{folder} must have steps with actions of a Box, not {n} of {action_space}")
    sets.check_action_space(action_space.shape, action_space)
    layout, of_actions = _layout(observation_space, folder), sets.action_dtype(action_space)
    if memory_map is not None:
        needed = sum(n_bytes((n + n_episodes, *shape), dtype) for shape, dtype in layout.values())
        memory_map = check_folder(memory_map, needed + n_bytes((n, *action_space.shape), of_actions))
    stored = {key: zeros(memory_map, (n + n_episodes, *shape), dtype) for key, (shape, dtype) in layout.items()}
    is_dict = isinstance(observation_space, spaces.Dict)
    steps = sets.Steps(
        stored if is_dict else stored[""],
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        None,
        zeros(memory_map, (n, *action_space.shape), of_actions),
        np.zeros(n, np.float32),
        np.zeros(n, bool),
        np.zeros(n, bool),
        {},
    )
    first = 0
    for number, episode in enumerate(data.iterate_episodes()):
        where, length = f"episode {episode.id} of {folder}", len(episode.rewards)
        rows, at = slice(first, first + length), first + number
        if length < 1 or first + length > n:
            raise ValueError(f"{where} has {length} steps, which are none or more than the {n} of all")
        given = episode.observations if is_dict else {"": episode.observations}
        for key, array in stored.items():
            part = np.asarray(given[key]) if key in given else np.empty(0)
            part = part[:, None] if part.ndim == 1 else part
            if part.shape != (length + 1, *array.shape[1:]):
                which = f"observations[{key!r}]" if key else "observations"
                raise ValueError(
                    f"{where}: {which} must be one more than its {length} steps, of shape {array.shape[1:]}, not "
                    f"{part.shape}"
                )
            sets.put(f"{where}: observations", part, array[at : at + length + 1])
        for name, array in (("actions", steps.actions), ("rewards", steps.rewards)):
            values = np.asarray(getattr(episode, name))
            if values.shape != (length, *array.shape[1:]):
                raise ValueError(f"{where}: {name} must be of shape {(length, *array.shape[1:])}, not {values.shape}")
            sets.put(name if name == "actions" else f"{where}: {name}", values, array[rows])
        ended, cut = (np.asarray(getattr(episode, name)) for name in ("terminations", "truncations"))
        is_one_a_step = ended.shape == cut.shape == (length,) and np.isin((ended, cut), (0, 1)).all()
        if not is_one_a_step or (ended[:-1] != 0).any() or (cut[:-1] != 0).any():
            raise ValueError(
                f"{where}: terminations and truncations must be one a step, 0 or 1, and none before the last step"
            )
        steps.terminations[rows], steps.truncations[rows] = ended, cut
        # An episode that has no end in the data was cut off.
        steps.truncations[first + length - 1] |= not ended[-1]
        steps.at[rows] = np.arange(at, at + length)
        steps.next_at[rows] = np.arange(at + 1, at + length + 1)
        first += length
    if first != n:
        raise ValueError(f"{folder} must have {n} steps, as it says, not {first}")
    sets.check_actions(steps.actions, action_space)
    check_numbers("observations", observation_space, steps.observations)
    return steps, observation_space, action_space


def _layout(space: spaces.Space, folder: Path) -> dict[str, tuple[tuple[int, ...], Any]]:
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    for part in parts.values():
        if not isinstance(part, (spaces.Box, spaces.Discrete, spaces.MultiBinary, spaces.MultiDiscrete)):
            raise ValueError(f"{folder} must have arrays as observations, alone or in one dict, not {space}")
    return {key: (part.shape or (1,), sets.observation_dtypes(part)) for key, part in parts.items()}


def _found(id_or_path: Any, minari: Any) -> Path:
    """The folder with the data of a data set."""
    tried = [Path(id_or_path).expanduser().absolute()]
    if _is_id(id_or_path):
        tried.append(Path(minari.storage.get_dataset_path(id_or_path)))
    for folder in (inside for each in tried for inside in (each, each / "data")):
        if (folder / "metadata.json").is_file():
            return folder
    places = " or ".join(map(str, tried))
    raise ValueError(f"id_or_path={os.fspath(id_or_path)!r} must be a data set of Minari's: there is none in {places}")


def minari_target(id_or_path: Any) -> tuple[str, Path]:
    """
    Find where a data set is to be written in Minari's format; nothing is made.

    :param id_or_path: new folder, or an id
    :return: the id, and the new folder of the data, inside that of the data set
    :raises ValueError: if the target exists already or cannot be made, or an id is also the path of a folder here
    :raises ImportError: if Minari is not installed
    """
    minari = _minari()
    if _is_id(id_or_path):
        name, folder = str(id_or_path), Path(minari.storage.get_dataset_path(id_or_path)) / "data"
        as_path = Path(id_or_path)
        if as_path.exists() or ("/" in name and as_path.parent.exists()):
            # Reading prefers a folder of this name here, if there is one.
            raise ValueError(
                f"id_or_path={name!r} is an id of Minari's, of {folder.parent}, and a path here too, since "
                f"{as_path if as_path.exists() else as_path.parent} is there: pass './{name}' for a folder, or another "
                "id"
            )
    else:
        # Minari looks for the files of a relative folder below that folder once more.
        folder = Path(id_or_path).expanduser().absolute() / "data"
        name = re.sub(r"[^\w-]", "-", folder.parent.name)
        name = name if _is_id(name) else f"{name}-v0"
    if folder.exists():
        raise ValueError(f"id_or_path={os.fspath(id_or_path)!r} must be new, but {folder} is there")
    above = next(path for path in folder.parents if path.exists())
    if not (above.is_dir() and os.access(above, os.W_OK | os.X_OK)):
        raise ValueError(
            f"id_or_path={os.fspath(id_or_path)!r} must be in a folder that can be written to, and {above} is none"
        )
    return name, folder


def write_minari(data: Any, id_or_path: Any, metadata: dict[str, Any]) -> Path:
    """
    Write a data set in Minari's format.

    :param data: the data set
    :param id_or_path: new folder, or an id
    :param metadata: further entries that Minari keeps
    :return: the folder
    :raises ValueError: if the target exists already, or an id is also the path of a folder here
    """
    name, target = minari_target(id_or_path)
    minari = _minari()
    if data.column_names:
        warn(f"Minari's format has no place for columns={data.column_names}: they are not among what is written")
    for key in {"author", "author_email"} & metadata.keys():
        metadata[key] = {metadata[key]} if isinstance(metadata[key], str) else set(metadata[key])
    if n_repeated := data.n_without_last:
        warn(
            f"no last observation is known of {n_repeated} terminated episode{'s' if n_repeated > 1 else ''}, as no "
            "next_observations were given: Minari's format has one, and the one before it is written in its place"
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    # Under another name until it is whole.
    folder = target.with_name(f".{target.name}-{secrets.token_hex(8)}")
    try:
        storage = minari.dataset.minari_storage.MinariStorage.new(
            folder, observation_space=data.observation_space, action_space=data.action_space, jpeg_encoding=False
        )
        storage.update_metadata({**metadata, "dataset_id": name, "minari_version": minari.__version__})
        storage.update_episodes(_episodes(data, minari.data_collector.episode_buffer.EpisodeBuffer))
        folder.rename(target)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return target.parent


def _episodes(data: Any, buffer_class: Any) -> Iterator[Any]:
    for rows in data.episodes():
        found = data.rows(rows)
        now, following, space = found["observations"], found["next_observations"], data.observation_space
        # The numbers of a Discrete space have no axis in Minari's files.
        if isinstance(now, dict):
            observations: Any = {
                key: np.concatenate((now[key], following[key][-1:])).reshape(-1, *space[key].shape) for key in now
            }
        else:
            observations = np.concatenate((now, following[-1:])).reshape(-1, *space.shape)
        yield buffer_class(
            observations=observations,
            actions=found["actions"],
            rewards=found["rewards"],
            terminations=found["terminations"],
            truncations=found["truncations"],
        )
