"""Learner of DR.Q: TD3's (or SAC's) gradient step on fixed embeddings, with blocks of encoder steps in between."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch

from sb3_sample.learner.batch import Batch, Extra, Noise, Windows, for_each
from sb3_sample.learner.embedding_losses import infonce, reward_cross_entropy, symexp_atoms, two_hot
from sb3_sample.learner.execution import Execution
from sb3_sample.learner.learner import Learner


class EmbeddingLoss(NamedTuple):
    """
    Settings of the embeddings' loss, the sum of three terms over a window's steps: weights of the squared error of the
    predicted next embedding, of the reward's cross-entropy and of InfoNCE; the temperature of InfoNCE; and the range of
    the reward's atoms, from symexp of the first to symexp of the second number in ``reward_range``.
    """

    dynamics_weight: float = 1.0
    reward_weight: float = 0.1
    infonce_weight: float = 0.1
    infonce_temperature: float = 0.1
    reward_range: tuple[float, float] = (-10.0, 10.0)


class DebiasedRQLearner(Learner):
    """
    Learner of DR.Q ("Debiased model-based Representations for Q-learning", https://arxiv.org/abs/2605.11711), built
    from a specification of the update.

    The gradient step of values and policy is the family's; its networks read embeddings and pass no gradient to the
    encoder. Before every ``target_update_interval``-th of these steps, and before the first one after the start and
    after each reset, all targets become copies of their networks, and the encoder takes as many steps on windows,
    towards the embeddings of the target encoder just copied. Nothing else changes encoder and targets.

    :param args: as in :class:`Learner`
    :param embedding_loss: settings of the encoder's loss
    :param kwargs: as in :class:`Learner`
    """

    def __init__(self, *args: Any, embedding_loss: EmbeddingLoss | None = None, **kwargs: Any):
        self.embedding_loss = EmbeddingLoss() if embedding_loss is None else embedding_loss
        self._encoder_execution: Execution | None = None
        super().__init__(*args, **kwargs)

    @property
    def encoder(self) -> Any:
        """Encoder of states and actions, with the model of dynamics and rewards."""
        return self.networks.encoder

    @property
    def encoder_target(self) -> Any:
        """Target encoder."""
        return self.networks.encoder_target

    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """
        List the optimizers.

        :return: every optimizer by its path from the learner
        """
        return {"encoder.optimizer": self.encoder.optimizer, **super().optimizers()}

    def _what_moves(self) -> tuple[bool, bool]:
        return False, super()._what_moves()[1]

    def move_target(self, target: Any, online: Any) -> None:
        """
        Leave a target as it is: targets are copies, made by :meth:`learn_embeddings`.

        :param target: target network
        :param online: its online network
        """

    # ---------------------------------------------------------------- how steps are run

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling both steps."""
        return super().seconds_compiling + getattr(self._encoder_execution, "seconds_compiling", 0.0)

    def forget_execution(self) -> None:
        """Drop the executions: how the steps are run is decided anew before the next one."""
        super().forget_execution()
        self._encoder_execution = None

    def prepared_execution(self) -> Execution:
        """
        Prepare the gradient steps that follow.

        :return: runner of the gradient steps of values and policy
        """
        execution = super().prepared_execution()
        if self._encoder_execution is None or not self._encoder_execution.serves(self):
            self._encoder_execution = self.make_execution(self, "encoder_step")
        self._encoder_execution.prepare(self)
        return execution

    # ---------------------------------------------------------------- the embeddings

    @property
    def n_encoder_steps_due(self) -> int:
        """
        Number of encoder steps, on a batch of windows each, that are due before the next gradient step, after the reset
        that :meth:`update` may begin with.
        """
        period = self.target_update_interval or self.policy_delay
        # After a reset the encoder has learned nothing.
        is_due = self.n_updates % period == 0 or self.n_updates == self._counts._began_at or self._resets_next
        return period if is_due else 0

    @property
    def _resets_next(self) -> bool:
        """Whether :meth:`update` resets before its gradient step: its windows are counted, and drawn, before that."""
        resets = self.plasticity
        return resets.follows_gradient_steps(self) or (self._heard and resets.follows_environment_steps(self))

    def update(
        self,
        batch: Batch,
        noise: Noise | None = None,
        extra: Extra | None = None,
        windows: Iterable[Windows] | None = None,
    ) -> dict[str, torch.Tensor]:
        """
        Take a gradient step, preceded by the encoder's steps if they are due.

        :param batch: transitions
        :param noise: random numbers of the step; drawn where it is None
        :param extra: without meaning here
        :param windows: ``n_encoder_steps_due`` batches of windows, if that is not 0
        :return: what to log, by name, scalars on the learner's device
        :raises ValueError: if ``batch`` is not a batch or has too few transitions for batch norm, or the number of
            batches of windows is another
        """
        self._check_batch(batch)
        given, due = list(windows or ()), self.n_encoder_steps_due
        if len(given) != due:
            raise ValueError(
                f"windows must be {due} batches before gradient step {self.n_updates + 1}, one for each step of the "
                f"encoder (n_encoder_steps_due), not {len(given)}"
            )
        with self._updating():
            metrics = self.learn_embeddings(given) if due > 0 else {}
            return {**metrics, **self.step(batch, noise, extra)}

    def learn_embeddings(self, windows: Iterable[Windows]) -> dict[str, torch.Tensor]:
        """
        Copy the networks to their targets, and take steps of the encoder.

        :param windows: one batch for each step
        :return: what to log of the last step, by name, scalars on the learner's device
        """
        self.copy_targets()
        metrics: dict[str, torch.Tensor] = {}
        for batch in windows:
            metrics = self.update_encoder(batch)
        return metrics

    def update_encoder(self, batch: Windows) -> dict[str, torch.Tensor]:
        """
        Take one step of the encoder.

        :param batch: windows
        :return: what to log, by name, scalars on the learner's device
        """
        if self._encoder_execution is None:
            self.prepared_execution()
        assert self._encoder_execution is not None
        return self._encoder_execution(self, batch)

    @torch.no_grad()
    def copy_targets(self) -> None:
        """Copy policy, values and encoder to their targets."""
        networks = self.networks
        for target, online in (
            (networks.actor_target, networks.actor),
            (networks.critic_target, networks.critic),
            (networks.encoder_target, networks.encoder),
        ):
            if target is None:
                continue  # A tanh-Gaussian actor has no target.
            for ours, theirs in zip(target.state_dict().values(), online.state_dict().values(), strict=True):
                ours.copy_(theirs)

    def encoder_step(self, batch: Windows) -> dict[str, torch.Tensor]:
        """
        Compute one step of the encoder, on tensors only: this function is compiled or captured.

        :param batch: windows of H steps
        :return: what to log, by name, scalars
        """
        settings, networks, encoder = self.embedding_loss, self.networks, self.encoder
        n, horizon = batch.rewards.shape
        with torch.no_grad():
            following = for_each(lambda part: part.flatten(0, 1), batch.next_observations)
            targets = networks.embedded(following, target=True).unflatten(0, (n, horizon))
            # Steps count up to and including a termination.
            alive = (1 - batch.dones).cumprod(dim=1)
            masks = torch.cat((torch.ones_like(alive[:, :1]), alive[:, :-1]), dim=1).to(targets.dtype)
            atoms = symexp_atoms(*settings.reward_range, encoder.n_reward_atoms, like=targets)
            codes = two_hot(batch.rewards.flatten().to(targets.dtype), atoms).unflatten(0, (n, horizon))
        embedding = networks.embedded(batch.observations)
        terms = []
        for t in range(horizon):
            mask = masks[:, t]
            embedding, logits = encoder.predict(encoder.pair(embedding, batch.actions[:, t]))
            error = (embedding - targets[:, t]).square().mean(dim=1)
            terms.append(
                torch.stack(
                    (
                        (mask * error).mean(),
                        (mask * reward_cross_entropy(logits, codes[:, t])).mean(),
                        # As published: the mean over the whole batch times the share of windows that have not ended.
                        infonce(embedding, targets[:, t], settings.infonce_temperature).mean() * mask.mean(),
                    )
                )
            )
        dynamics, reward, contrast = torch.stack(terms).sum(dim=0).unbind()
        loss = settings.dynamics_weight * dynamics + settings.reward_weight * reward
        loss = loss + settings.infonce_weight * contrast
        self.minimize(encoder.optimizer, loss)
        metrics = {"loss": loss, "dynamics_loss": dynamics, "reward_loss": reward, "infonce_loss": contrast}
        return {f"encoder/{name}": value.detach() for name, value in metrics.items()}
