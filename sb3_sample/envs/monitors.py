"""Monitors that go on where those of an earlier process ended, in the same files."""

import contextlib
import json
import os
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
from stable_baselines3.common import monitor
from stable_baselines3.common.monitor import Monitor, ResultsWriter

from sb3_sample.run_logs import monitor_head


class _Appending(ResultsWriter):
    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{**kwargs, "override_existing": False})


@contextlib.contextmanager
def appending() -> Iterator[None]:
    """
    Make the Monitors that are made meanwhile append to their files. :func:`go_on` belongs to it.
    """
    theirs, monitor.ResultsWriter = monitor.ResultsWriter, _Appending  # type: ignore[misc]
    try:
        yield
    finally:
        monitor.ResultsWriter = theirs  # type: ignore[misc]


def go_on(env: gym.Env) -> None:
    """
    Let Monitors that append to their files go on there: seconds count from the beginning in the file's head. A file
    that is empty gets its head.

    :param env: an environment, with Monitors anywhere among its wrappers
    :raises BadFile: (a ``ValueError``) if a file that is appended to is none of Monitor's
    """
    while isinstance(env, gym.Wrapper):
        if isinstance(env, Monitor) and env.results_writer is not None:
            _go_on(env, env.results_writer)
        env = env.env


def _go_on(env: Monitor, writer: ResultsWriter) -> None:
    if os.path.getsize(writer.file_handler.name):
        env.t_start = monitor_head(writer.file_handler.name)["t_start"]
        return
    writer.file_handler.write(f"#{json.dumps({'t_start': env.t_start, 'env_id': str(env.spec and env.spec.id)})}\n")
    writer.logger.writeheader()
    writer.file_handler.flush()
