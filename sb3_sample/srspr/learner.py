"""Learner of SR-SPR: the gradient step, the target network's update, and resets."""

from typing import Any, NamedTuple

import torch
from torch import nn

from sb3_sample.learner.descent import follow, minimize, parameters_of
from sb3_sample.learner.executable import Executable
from sb3_sample.srspr.augmentation import SHIFT, augmented
from sb3_sample.srspr.losses import alive_after, n_step_return, project, spr_loss
from sb3_sample.srspr.networks import FRESH, SPRNetwork
from sb3_sample.srspr.replay import StateWindows

#: Name of the batch's TD losses among a gradient step's results; they are not a metric.
_TD_LOSSES = "td_losses"


class AugmentationNoise(NamedTuple):
    """
    Random numbers of a gradient step.

    :param offsets: of the shifts, in [0, 8], (N, 2)
    :param brightness: standard normal, (N,)
    """

    offsets: torch.Tensor
    brightness: torch.Tensor

    @classmethod
    def draw(cls, n: int, device: torch.device) -> "AugmentationNoise":
        """
        Draw the noise.

        :param n: N, observations
        :param device: device of the noise
        :return: the noise
        """
        offsets = torch.randint(2 * SHIFT + 1, (n, 2), device=device)
        return cls(offsets, torch.randn(n, device=device))


class SPRLearner(Executable):
    """
    Value learner with self-predictive representations (SPR, Schwarzer et al. 2021): C51's loss of n-step double
    Q-learning, and the prediction of the following latent states.

    :param policy: with ``q_net``, ``q_net_target``, ``atoms`` and ``optimizer``
    :param counts: object that holds the learner's counts, ``_n_updates`` and ``compiled``
    :param gamma: discount factor
    :param tau: weight of the network in the target network's Polyak average
    :param n_steps: steps whose rewards are summed
    :param n_predictions: number of future steps whose latent states are predicted
    :param spr_weight: weight of the prediction loss
    :param compile: whether the gradient step is compiled; "auto": if ``counts.compiled`` is true
    :param device: where the learner computes
    :param verbose: 0 nothing, 1 info
    """

    #: Arguments that may be set between two gradient steps.
    SETTINGS = ("gamma", "tau", "n_steps", "n_predictions", "spr_weight", "verbose", "compile")

    def __init__(
        self,
        policy: Any,
        counts: Any,
        gamma: float,
        tau: float,
        n_steps: int,
        n_predictions: int,
        spr_weight: float,
        compile: bool | str,
        device: torch.device,
        verbose: int,
    ):
        super().__init__(counts)
        self.policy = policy
        self.gamma, self.tau, self.n_steps, self.n_predictions = gamma, tau, n_steps, n_predictions
        self.spr_weight, self.compile, self.device, self.verbose = spr_weight, compile, device, verbose

    # ---------------------------------------------------------------- parts

    @property
    def online(self) -> SPRNetwork:
        """The network that learns."""
        return self.policy.q_net  # type: ignore[no-any-return]

    @property
    def target(self) -> SPRNetwork:
        """The network that follows the online network and acts."""
        return self.policy.q_net_target  # type: ignore[no-any-return]

    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """
        List the optimizers.

        :return: the optimizer by its path from the policy
        """
        return {"optimizer": self.policy.optimizer}

    def step_modules(self) -> tuple[nn.Module, ...]:
        """
        List the modules of the gradient step.

        :return: modules that a gradient step reads or writes
        """
        return (self.policy,)

    def identities(self) -> tuple[int, ...]:
        """
        Identify the objects for which a compiled or captured gradient step is made.

        :return: identities of networks and optimizer, and which of its parameters are frozen
        """
        trained = (p.requires_grad for p in parameters_of(self.policy.optimizer))
        return (*map(id, (self.online, self.target, self.policy.optimizer)), *trained)

    def exchangeable(self) -> dict[str, Any]:
        # A user's policy class may have another network.
        return {"policy": self.online}

    # ---------------------------------------------------------------- the update

    def step(
        self, windows: StateWindows, noise: AugmentationNoise | None = None
    ) -> tuple[dict[str, torch.Tensor], torch.Tensor]:
        """
        Draw the noise, take one gradient step, and count it.

        :param windows: the batch
        :param noise: of the augmentation; drawn if None
        :return: scalars to log by name, on the learner's device; and the TD loss of each window, (B,)
        """
        execution = self._execution or self.prepared_execution()
        if noise is None:
            n_states, batch_size = windows.states.shape[:2]
            noise = AugmentationNoise.draw(n_states * batch_size, self.device)
        for network in (self.online, self.target):
            for layer in network.noisy_layers():
                layer.draw()
        self._counts._n_updates += 1
        metrics = execution(self, windows, noise)
        return metrics, metrics.pop(_TD_LOSSES)

    def gradient_step(self, windows: StateWindows, noise: AugmentationNoise) -> dict[str, torch.Tensor]:
        """
        Compute the gradient step with tensors only, since this function is compiled or captured.

        :param windows: the batch
        :param noise: of the augmentation
        :return: scalars to log, by name; and the TD loss of each window, (B,)
        """
        online, target, atoms, n = self.online, self.target, self.policy.atoms, self.n_predictions
        n_windows = windows.actions.shape[0]
        states = augmented(windows.states.flatten(0, 1), noise.offsets, noise.brightness)
        # Convolutions are faster in this layout.
        states = states.contiguous(memory_format=torch.channels_last)
        now, later = states[:n_windows], states[n_windows:]

        # Targets: the following latent states one by one, and the returns after n steps.
        with torch.no_grad():
            projected = target.project(target.encoder(later))
            future = projected[: n * n_windows].view(n, n_windows, -1)
            next_probabilities = target.head(projected[n * n_windows :]).softmax(dim=-1)
            next_values = (online(later[n * n_windows :]).softmax(dim=-1) * atoms).sum(dim=-1)
            rewards, discounts = n_step_return(
                windows.rewards[:, : self.n_steps], windows.terminated[:, : self.n_steps], self.gamma
            )
            best = of_action(next_probabilities, next_values.argmax(dim=1))
            wanted = project(best, rewards + discounts * atoms, atoms)

        # Distribution of the returns.
        latent = online.encoder(now)
        log_probabilities = of_action(online.logits(latent), windows.actions[:, 0]).log_softmax(dim=-1)
        td_losses = -(wanted * log_probabilities).sum(dim=-1)

        # Following latent states.
        predicted = []
        for k in range(n):
            latent = online.transition(latent, windows.actions[:, k])
            predicted.append(latent)
        predictions = online.predictor(online.project(torch.cat(predicted))).view(n, n_windows, -1)
        mask = alive_after(windows.terminated[:, :n])
        spr_losses = spr_loss(predictions.transpose(0, 1), future.transpose(0, 1), mask)

        loss = (windows.weights * (td_losses + self.spr_weight * spr_losses)).mean()
        minimize(self.policy.optimizer, loss)
        follow(target, online, self.tau)
        values = (log_probabilities.exp() * atoms).sum(dim=-1)
        metrics = {
            "train/loss": loss,
            "train/td_loss": td_losses.mean(),
            "train/spr_loss": spr_losses.mean(),
            "train/q_mean": values.mean(),
        }
        return {name: value.detach() for name, value in metrics.items()} | {_TD_LOSSES: td_losses.detach()}

    # ---------------------------------------------------------------- resets

    @torch.no_grad()
    def reset(self, shrink: float) -> None:
        """
        Shrink and perturb: projection, predictor and head are reinitialised; encoder and transition model keep a share
        of their parameters. The target network is reset likewise with a separate draw; Adam's state is cleared. Frozen
        parameters of the online network, and the target's of the same names, stay as they are.

        :param shrink: share of the old parameters that stays
        """
        frozen = {name for name, parameter in self.online.named_parameters() if not parameter.requires_grad}
        for network in (self.online, self.target):
            fresh = dict(self.policy.make_network().to(self.device).named_parameters())
            for name, parameter in network.named_parameters():
                if name in frozen:
                    continue
                if name.partition(".")[0] in FRESH:
                    parameter.copy_(fresh[name])
                else:
                    parameter.copy_(shrink * parameter + (1 - shrink) * fresh[name])
        self.policy.optimizer.state.clear()


def of_action(every: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """
    Select the entries of one action per row.

    :param every: entries of all actions, (B, A, K)
    :param actions: their numbers, (B,)
    :return: entries of the given action, (B, K)
    """
    return every.gather(1, actions.view(-1, 1, 1).expand(-1, 1, every.shape[-1])).squeeze(1)
