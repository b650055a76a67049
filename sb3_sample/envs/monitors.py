"""Monitors that go on where those of an earlier process ended, in the same files."""

import json
import os
from collections.abc import Callable
from typing import Any

import gymnasium as gym
from stable_baselines3.common import monitor
from stable_baselines3.common.monitor import Monitor, ResultsWriter

from sb3_sample.run_logs import MAX_LINE, monitor_head
from sb3_sample.saving.untrusted import BadFile
from sb3_sample.warn import warn


class _Appending(ResultsWriter):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{**kwargs, "override_existing": False})


def made_again(make: Callable[[], gym.Env]) -> gym.Env:
    """
    Make an environment whose Monitors continue the files of those of an earlier one. A file that cannot be continued is
    warned of, and appended to as it is.

    :param make: makes the environment, as it made the earlier one
    :return: the environment
    """
    # Monitors have no way to be told from outside.
    theirs, monitor.ResultsWriter = monitor.ResultsWriter, _Appending  # type: ignore[misc]
    try:
        env = make()
    finally:
        monitor.ResultsWriter = theirs  # type: ignore[misc]
    try:
        go_on(env)
    except (BadFile, OSError) as error:
        warn(f"a Monitor's file cannot be continued: {error}")
    return env


def go_on(env: gym.Env) -> None:
    """
    Continue the files of Monitors that append: time counts from the start recorded in the head, an incomplete last
    line, of a process that was killed, is removed, and an empty file gets a head.

    :param env: an environment, with Monitors anywhere among its wrappers
    :raises BadFile: (a ``ValueError``) if a file is not a Monitor file
    :raises OSError: if one cannot be read
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor) and env.results_writer is not None:
            _go_on(env, env.results_writer)
        env = env.env


def _go_on(env: Monitor, writer: ResultsWriter) -> None:
    path = writer.file_handler.name
    if os.path.getsize(path):
        env.t_start = monitor_head(path)["t_start"]
        _remove_incomplete_line(path)
        return
    writer.file_handler.write(f"#{json.dumps({'t_start': env.t_start, 'env_id': str(env.spec and env.spec.id)})}\n")
    writer.logger.writeheader()
    writer.file_handler.flush()


def _remove_incomplete_line(path: str) -> None:
    with open(path, "rb+") as file:
        start = max(0, file.seek(0, os.SEEK_END) - MAX_LINE)
        file.seek(start)
        end = file.read()
        if not end.endswith(b"\n") and b"\n" in end:
            file.truncate(start + end.rindex(b"\n") + 1)
