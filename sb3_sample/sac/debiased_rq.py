"""DR.Q, under the name ``DebiasedRQ``."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_sample.arguments import check_unused
from sb3_sample.constructor import Given, argument
from sb3_sample.kinds import ABOVE_0, AT_LEAST_0, Kind, integer, is_number
from sb3_sample.learner.debiased_rq import DebiasedRQLearner, EmbeddingLoss
from sb3_sample.learner.heads import HuberHead, ValueHead
from sb3_sample.learner.learner import Learner
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.replay.sources import WindowSource
from sb3_sample.replay.weighted import WindowDictReplayBuffer, WindowReplay, WindowReplayBuffer
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC
from sb3_sample.sac.embeddings import DebiasedRQCnnPolicy, DebiasedRQMultiInputPolicy, DebiasedRQPolicy, Encoder
from sb3_sample.sac.model_learner import OfLearner
from sb3_sample.sac.policies import SACPolicy
from sb3_sample.sac.policy_kwargs import with_weight_decay
from sb3_sample.warn import warn

_RANGE = Kind(
    "be two finite numbers, the smaller first",
    lambda value: (
        isinstance(value, Sequence)
        and len(value) == 2
        and all(is_number(x) and math.isfinite(x) for x in value)
        and value[0] < value[1]
    ),
)
#: Arguments of the actor's noise.
_NOISE = ("exploration_noise", "target_noise", "target_noise_clip")
#: Arguments of the encoder's loss.
_EMBEDDING_LOSS = EmbeddingLoss._fields
#: Arguments of the family that are fixed: their values, and why.
_FIXED: dict[str, tuple[Any, str]] = {
    "tau": (1.0, "its targets are copies, made every target_update_interval gradient steps"),
    "exploration": ("actor", "it explores with its actor"),
    "validation_proportion": (0.0, "its windows of several steps would carry held-out transitions into training"),
    "batch_transforms": ((), "they would change single transitions, and not the windows of the encoder"),
    "augmentation": (None, "it would change single transitions, and not the windows of the encoder"),
    "resets_keep": ((), "its resets concern the encoder of states and actions too"),
    "reward_scale": (None, "it would change the rewards of single transitions, and not those of the encoder's windows"),
    "normalize_observations": (False, "its encoder learns from observations as they are"),
    "learning_rate_schedule": (None, "its encoder takes gradient steps of its own, which no schedule counts"),
    "actor_first": (False, "its actor learns on the new critics"),
    "prior_data": (None, "its encoder learns from windows of several steps, and a data set has single ones"),
    "redo_period": (None, "new weights in place of dormant ones are drawn as those of the other agents"),
}


class DebiasedRQ(SAC):
    """
    DR.Q ("Debiased model-based Representations for Q-learning", https://arxiv.org/abs/2605.11711), called
    ``DebiasedRQ`` so that it is not taken for DrQ, the method for pixels: TD3 on learned embeddings of states and
    actions. The embeddings predict the next embedding and the reward over windows of several steps, and InfoNCE
    distinguishes them from others; they are fixed between blocks of their updates. The replay is prioritised and fades
    with age.

    The defaults are those of the published code, one set for all tasks; on the tasks of DeepMind Control and
    HumanoidBench, that code's steps are those of environments with ``action_repeat=2``. The class is built from a
    specification of the update; docs/dr_q.md names it, and the difference: if a transition ends an episode by
    termination, its next observation is the episode's last one, also within the windows.

    With ``backbone="sac"``, which is not published, the actor on these embeddings is SAC's. Only then do ``ent_coef``
    and ``target_entropy`` have a meaning.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": DebiasedRQPolicy,
        "CnnPolicy": DebiasedRQCnnPolicy,
        "MultiInputPolicy": DebiasedRQMultiInputPolicy,
    }
    policy_base: ClassVar[type[SACPolicy]] = DebiasedRQPolicy
    learner_class: ClassVar[type[Learner]] = DebiasedRQLearner
    draws_windows: ClassVar[bool] = True
    learns_from_data: ClassVar[bool] = False
    encoder = OfLearner[Encoder]()
    """encoder of states and actions, with the model of dynamics and rewards"""
    encoder_target = OfLearner[Encoder]()
    """target encoder"""

    learning_rate: float | Schedule = argument(default=3e-4, kw_only=False)
    """learning rate of encoder, critics and actor; a number or a function of the remaining progress (from 1 to 0)"""
    learning_starts: int = argument(default=10_000, kw_only=False)
    """transitions and ends of episodes with uniformly random actions before the first gradient step, counted over the
    model's life"""
    tau: float = argument(default=1.0, kw_only=False)
    """1: the targets are copies"""
    replay_buffer_class: type[ReplayBuffer] | None = argument(default=None, kw_only=False)
    """``WindowReplayBuffer``, ``WindowDictReplayBuffer``, or a class derived from one; chosen by the observation space
    if None. ``replay_buffer_kwargs`` has ``fade``, ``fade_floor``, ``priority_exponent``, ``smallest_error``"""
    n_steps: int = argument(default=3, kw_only=False)
    """n-step returns of the critics' targets"""
    target_update_interval: int | None = argument(default=250, kw_only=False)
    """gradient steps between two updates of the targets, which are copies, and steps of the encoder at each update;
    None: ``policy_delay``"""
    replay_ratio: float | None = argument(default=1)
    """gradient steps of critics and actor per environment transition after the warm-up, whatever the number of
    environments; may be below 1. The encoder takes as many, in blocks"""
    pessimism: float | str | type[Pessimism] = argument(default=1.0)
    """weight of the critics' spread that is subtracted from their mean in the target, at least 0; 1 is the minimum of
    two critics. Rules that move it are not supported"""
    actor_pessimism: float | None = argument(default=0.0)
    """weight of the spread in the actor's objective; None: as in the target"""
    exploration_noise: float = argument(default=0.2, kind=ABOVE_0)
    """with ``backbone="td3"``, standard deviation of the noise while exploring, in actions of [-1, 1]"""
    target_noise: float = argument(default=0.2, kind=AT_LEAST_0)
    """with ``backbone="td3"``, standard deviation of the noise on the target's action"""
    target_noise_clip: float = argument(default=0.3, kind=AT_LEAST_0)
    """with ``backbone="td3"``, bound of the noise on the target's action"""
    weight_decay: float = argument(default=0.01, kind=AT_LEAST_0)
    """decoupled weight decay of encoder, critics and actor"""
    encoder_horizon: int = argument(default=5, kind=integer(1))
    """steps over which the encoder's predictions are unrolled"""
    dynamics_weight: float = argument(default=1.0, kind=AT_LEAST_0)
    """weight of the squared error of predicted embeddings in the encoder's loss"""
    reward_weight: float = argument(default=0.1, kind=AT_LEAST_0)
    """weight of the cross-entropy of predicted rewards"""
    infonce_weight: float = argument(default=0.1, kind=AT_LEAST_0)
    """weight of InfoNCE between predicted and target embeddings"""
    infonce_temperature: float = argument(default=0.1, kind=ABOVE_0)
    """temperature of InfoNCE"""
    reward_range: Sequence[float] = argument(default=(-10.0, 10.0), kind=_RANGE)
    """ends of the predicted rewards on the scale of symlog; (-10, 10) is ±22,025"""
    backbone: str = argument(default="td3")
    """"td3", or "sac": a tanh-Gaussian actor with a temperature, without the three kinds of noise and without a target
    actor: TD targets sample its actions, on the encoder's embeddings, and take the target encoder's for the values"""

    def _construct(self, given: Given) -> None:
        #: Transitions and ends of episodes that were stored over the model's life, each in a slot of the buffer.
        self.num_slots = 0
        # Ends of episodes at the latest step, which count with the next step.
        self._ends = 0
        super()._construct(given)

    def _setup_model(self) -> None:
        super()._setup_model()
        self._source: WindowSource = WindowSource(self)

    def _check_arguments(self) -> None:
        for name, (value, why) in _FIXED.items():
            given = getattr(self, name)
            if given != value and not (value == () and isinstance(given, Sequence) and len(given) == 0):
                raise ValueError(f"DebiasedRQ has {name}={value!r}, not {given!r}: {why}")
        if isinstance(self.pessimism, (str, type)):
            raise ValueError(f"DebiasedRQ has a fixed pessimism, a number, not {self.pessimism!r}")
        is_dict = isinstance(getattr(self, "observation_space", None), spaces.Dict)
        base: Any = WindowDictReplayBuffer if is_dict else WindowReplayBuffer
        if self.replay_buffer_class is None:
            self.replay_buffer_class = base
        elif not (isinstance(self.replay_buffer_class, type) and issubclass(self.replay_buffer_class, base)):
            raise ValueError(
                f"DebiasedRQ learns from windows of several steps: replay_buffer_class must be {base.__name__} or "
                f"derived from it, not {getattr(self.replay_buffer_class, '__name__', self.replay_buffer_class)}"
            )
        super()._check_arguments()
        if self.backbone == "sac":
            check_unused(self, _NOISE, "backbone='sac', whose actor has its own standard deviation")
        else:
            noise = {name: name for name in _NOISE}
            checks.check_once("policy_kwargs['actor_kwargs']", self.policy_kwargs.get("actor_kwargs"), noise)
        checks.check_once("replay_buffer_kwargs", self.replay_buffer_kwargs, {"horizon": "encoder_horizon, or n_steps"})
        checks.check_weight_decay(self)

    def _complete_arguments(self) -> None:
        super()._complete_arguments()
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "horizon": self._horizon}

    @property
    def _horizon(self) -> int:
        """Steps of the longest window."""
        return max(self.encoder_horizon, self.n_steps)

    def _full_policy_kwargs(self) -> dict[str, Any]:
        kwargs = with_weight_decay(super()._full_policy_kwargs(), self.weight_decay)
        noise = {name: getattr(self, name) for name in _NOISE} if self.backbone == "td3" else {}
        return {**kwargs, "actor_kwargs": {**noise, **(kwargs.get("actor_kwargs") or {})}}

    def _make_head(self) -> ValueHead:
        return HuberHead() if self.n_quantiles is None and self.value_head is None else super()._make_head()

    def _make_learner(self, **kwargs: Any) -> Learner:
        loss = EmbeddingLoss(**{name: getattr(self, name) for name in _EMBEDDING_LOSS})
        return super()._make_learner(embedding_loss=loss, **kwargs)

    # ---------------------------------------------------------------- acting and storing

    def _store_transition(
        self, replay_buffer: ReplayBuffer, buffer_action: np.ndarray, new_obs: Any, reward: np.ndarray,
        dones: np.ndarray, infos: list[dict[str, Any]],
    ) -> None:  # fmt: skip
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self.num_slots += self._ends + len(dones)
        self._ends = int(np.sum(dones))

    def _on_environment_reset(self) -> None:
        super()._on_environment_reset()
        if isinstance(self.replay_buffer, WindowReplay):
            self.replay_buffer.cut_episodes()

    @property
    def _n_of_warm_up(self) -> int:
        # As published, where the end of an episode takes a slot of the buffer.
        return self.num_slots

    @property
    def _n_in_buffer(self) -> int:
        assert isinstance(self.replay_buffer, WindowReplay)
        weights = self.replay_buffer.weights
        return min(weights.n_taken, weights.n_slots)

    def _check_replay_buffer(self, buffer: ReplayBuffer, path: Any) -> None:
        super()._check_replay_buffer(buffer, path)
        horizon = getattr(buffer, "horizon", None)
        if horizon != self._horizon:
            raise ValueError(
                f"the replay buffer of {path} holds windows of {horizon} steps, but this model needs {self._horizon}, "
                "the larger of encoder_horizon and n_steps"
            )

    # ---------------------------------------------------------------- learning

    def learn_offline(self, *args: Any, **kwargs: Any) -> Any:
        """
        :raises ValueError: always
        """
        raise ValueError(
            "learn_offline: DebiasedRQ learns from windows of several steps, and a data set has single ones: call learn"
        )

    def _before_batches(self, batch_size: int) -> None:
        n_steps = self.learner.n_encoder_steps_due
        if n_steps > 0:
            metrics = self.learner.learn_embeddings(self._source.windows(n_steps, batch_size))
            self._watch.note(metrics, self._n_updates, self.num_timesteps)
            self._metrics.update(metrics)

    def _after_turns(self) -> None:
        super()._after_turns()
        assert isinstance(self.replay_buffer, WindowReplay)
        if self._n_updates == 0 and not self._is_warming_up() and self.replay_buffer.n_drawable == 0:
            warn(
                "learn ended without a single gradient step: a window of encoder_horizon and n_steps needs more than "
                f"{self._horizon} steps of an episode, or a termination, which no episode has had. Train for more "
                "steps, or pass a smaller encoder_horizon and n_steps"
            )
