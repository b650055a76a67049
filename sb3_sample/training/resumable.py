"""Life cycle of an algorithm, the same for both families: environments, networks, ``learn`` with checkpoints."""

import inspect
import os
import pathlib
from typing import Any, TypeVar

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sample.arguments import OF_BUFFER, check_kwargs, check_learn, check_n_envs
from sb3_sample.constructor import Constructed, argument
from sb3_sample.envs.finite_check import FiniteCheck
from sb3_sample.envs.workers import watch_workers
from sb3_sample.export import Exportable
from sb3_sample.faults import check_finite_parameters
from sb3_sample.kinds import DICT, SEED, VERBOSE, Kind, integer
from sb3_sample.saving.checkpoint import Checkpointer, refuse_second_call
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.model_tree import Description
from sb3_sample.saving.notice import say_once
from sb3_sample.training.seats import begin, seated

Self = TypeVar("Self", bound="Resumable")


class Resumable(Constructed, Exportable, BaseAlgorithm):
    """
    Base of both families, before ``SafeFiles`` and Stable-Baselines3's class: ``learn`` is a sequence of turns; after
    each of them the training can be saved, and continued with the same result as without interruption. A family defines
    the turn (:meth:`_turn`) and the steps before and after the turns.
    """

    _stats_window_size: int = argument(alias="stats_window_size", default=100, kind=integer(1), of_training=True)
    """episodes over which the logged return is averaged"""
    tensorboard_log: str | None = argument(
        default=None,
        kind=Kind("be the path of a folder", lambda value: isinstance(value, (str, os.PathLike))).or_none(),
        of_training=True,
    )
    """folder of the TensorBoard log; none if None"""
    _policy_kwargs: dict[str, Any] | None = argument(alias="policy_kwargs", default=None, kind=DICT)
    """arguments of the policy"""
    verbose: int = argument(default=0, kind=VERBOSE)
    """0 nothing, 1 info, 2 debug"""
    seed: int | None = argument(default=None, kind=SEED.or_none())
    """seed of everything random"""
    _device: torch.device | str = argument(alias="device", default="auto")
    """"auto", "cpu", "cuda", ..."""
    _init_setup_model: bool = argument(default=True, of_training=True)
    """whether to build the networks at once"""

    # ---------------------------------------------------------------- construction

    def _store(self, given: dict[str, Any], of: type[BaseAlgorithm]) -> dict[str, Any]:
        """
        Store the arguments that Stable-Baselines3's class does not know.

        :param given: arguments by name; those of Stable-Baselines3's class are removed
        :param of: Stable-Baselines3's class
        :return: the arguments that its constructor takes
        """
        theirs = {name: given.pop(name) for name in inspect.signature(of).parameters.keys() & given.keys()}
        vars(self).update(given)
        return theirs

    @classmethod
    def place_of(cls, name: str) -> str:
        of_policy = inspect.signature(next(iter(cls.policy_aliases.values()))).parameters.get(name)
        is_choice = of_policy is not None and of_policy.default is not inspect.Parameter.empty
        if is_choice:
            return f"policy_kwargs=dict({name}=...)"
        of_learn = inspect.signature(cls.learn).parameters
        return f"learn({name}=...)" if name in of_learn and name != "self" else ""

    def _setup_model(self) -> None:
        self._check_arguments()
        names = "policy_kwargs", "replay_buffer_kwargs"
        given: dict[str, Any] = {name: vars(self)[name] for name in names if name in vars(self)}
        # Policy and buffer are built with more than the user's own arguments, and only the latter are saved.
        self._complete_arguments()
        if isinstance(buffer := vars(self).get("replay_buffer_class"), type):
            check_kwargs("replay_buffer_kwargs", given["replay_buffer_kwargs"] or {}, buffer, OF_BUFFER)
        try:
            super()._setup_model()  # type: ignore[safe-super]  # of Stable-Baselines3's algorithm
        finally:
            vars(self).update(given)
        if self.device.type == "cpu":
            # glibc returns freed blocks above a threshold to the system. At first the threshold is below the size of
            # one gradient or of one block of a simulation, and every use then pays for page faults; it follows the
            # largest block freed so far.
            torch.empty(31 * 2**20, dtype=torch.uint8)

    def _check_arguments(self) -> None:
        """
        Check the arguments.

        :raises ValueError: if an argument is out of range or contradicts another
        """
        raise NotImplementedError

    def _complete_arguments(self) -> None:
        """Add the algorithm's arguments to those of policy and buffer, while policy and buffer are built."""
        self.policy_kwargs = self._full_policy_kwargs()

    def _full_policy_kwargs(self) -> dict[str, Any]:
        """
        Complete the policy's arguments.

        :return: the policy's arguments: the user's and the algorithm's
        """
        raise NotImplementedError

    # ---------------------------------------------------------------- environments

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        venv = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        FiniteCheck.install(venv)
        watch_workers(venv)
        return venv

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Set another environment, as in Stable-Baselines3.

        :param env: the environment, with the spaces and the number of environments that the model was made with
        :param force_reset: whether it is reset before training continues
        :raises ValueError: if its spaces or its number of environments differ
        """
        check_n_envs(self, env)
        super().set_env(env, force_reset)

    def _on_environment_reset(self) -> None:
        """Called when the environments were reset in the middle of their episodes."""

    # ---------------------------------------------------------------- training

    def _learn(
        self: Self,
        total_timesteps: int,
        callback: MaybeCallback,
        log_interval: int,
        tb_log_name: str | None,
        reset_num_timesteps: bool,
        progress_bar: bool,
        checkpoint: str | pathlib.Path | None,
        checkpoint_freq: int,
        learns_from: str = "",
    ) -> Self:
        """
        Train. The arguments are those of ``learn``, by the same names, since callbacks read them among its local
        variables.

        :param learns_from: source of learning instead of the environment, which is left alone; empty for the
            environment
        """
        total_timesteps = check_learn(self, locals())
        refuse_second_call(self, checkpoint)
        total_timesteps, callback = self._set_up_training(
            total_timesteps, callback, reset_num_timesteps, tb_log_name or type(self).__name__, progress_bar
        )
        self._before_training()
        say_once(self, self._described())
        with (
            seated(self) as seat,
            Checkpointer(self, callback, checkpoint, checkpoint_freq, learns_from) as checkpointer,
        ):
            checkpointer.resume(total_timesteps)
            self._before_turns()
            callback.on_training_start(locals(), globals())
            checkpointer.start()
            begin(seat)
            while self.num_timesteps < total_timesteps:
                if not self._whole_turn(checkpointer.callback, log_interval, not learns_from):
                    break
                is_due = checkpointer.is_due()
                if is_due and not self._rest(checkpointer.callback, log_interval):
                    break
                checkpointer.after_turn(is_due)
            else:
                self._after_turns()
            check_finite_parameters(self)
            checkpointer.finish()
        return self

    def _set_up_training(
        self, total_timesteps: int, callback: MaybeCallback, reset_num_timesteps: bool, name: str, progress_bar: bool
    ) -> tuple[int, BaseCallback]:
        """
        Set up counters, log and callbacks, and reset the environments where Stable-Baselines3 does.

        :return: steps at the end of the training, and the callback
        """
        resets_environment = reset_num_timesteps or self._last_obs is None
        set_up = self._setup_learn(total_timesteps, callback, reset_num_timesteps, name, progress_bar)
        if resets_environment:
            self._on_environment_reset()
        return set_up

    def _described(self) -> Lenient:
        """
        Describe the model's files.

        :return: encoder of the model's description, with what to warn of
        """
        return Description(self).encoder

    def _before_training(self) -> None:
        """Prepare the training, before a checkpoint is read."""

    def _before_turns(self) -> None:
        """Prepare the turns, after a checkpoint, if any, was read."""

    def _turn(self, callback: BaseCallback, log_interval: int) -> bool:
        """
        Collect, and learn from it.

        :param callback: called at every step
        :param log_interval: the argument of ``learn``
        :return: False if the callback ended the training, in which case nothing is learned
        """
        raise NotImplementedError

    def _whole_turn(self, callback: BaseCallback, log_interval: int, in_environment: bool) -> bool:
        """Take a turn. An interrupted turn leaves the environment ahead of the stored transitions."""
        goes_on = False
        try:
            goes_on = self._turn(callback, log_interval)
        finally:
            if not goes_on and in_environment:
                # A later ``learn`` begins with a reset, since the episode cannot be continued.
                self._last_obs = None
        return goes_on

    def _rest(self, callback: BaseCallback, log_interval: int) -> bool:
        """
        Pause everything that runs beside the turns, before a checkpoint.

        :param callback: as in :meth:`_turn`
        :param log_interval: as in :meth:`_turn`
        :return: False if the callback ended the training
        """
        return True

    def _after_turns(self) -> None:
        """Finish a training that no callback has ended."""
