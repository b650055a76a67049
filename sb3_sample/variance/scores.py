"""
Gradients of log-probabilities, one for every state and action, never stored explicitly.

The gradient of a linear layer's weight is the outer product of its input and of the gradient of its output. Inner
products and sums of such gradients follow from the two factors, so that the memory for T states of a policy with P
parameters is T times the width of its layers (and T times T for all inner products), not T times P.

Shapes: T states, K actions of each, O observation, A action, P parameters of the policy that its actions depend on.
"""

from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import nn


class Factor(NamedTuple):
    """
    Gradients with respect to the parameters of one layer.

    :param inputs: input of the layer at each state, (T, in), which is the same for all actions; None for parameters
        that belong to no layer
    :param has_bias: whether the layer has a bias
    :param outputs: gradients with respect to the layer's output (to the parameters themselves if there is no input),
        (T, K, out) or, for weighted sums over the actions, (T, out)
    """

    inputs: torch.Tensor | None
    has_bias: bool
    outputs: torch.Tensor

    def input_products(self) -> torch.Tensor:
        """Inner products of the inputs, where the bias's input is 1: (T, T)."""
        assert self.inputs is not None
        return self.inputs @ self.inputs.T + float(self.has_bias)


class StateGradients:
    """
    One gradient for every state.

    :param factors: factors of all layers, with outputs (T, out)
    """

    def __init__(self, factors: list[Factor]):
        self.factors = factors

    def mean(self) -> np.ndarray:
        """
        :return: the mean gradient over the states, layer by layer, weights before biases, (P,)
        """
        n_states, parts = len(self.factors[0].outputs), []
        for factor in self.factors:
            if factor.inputs is not None:
                parts.append((factor.outputs.T @ factor.inputs).flatten())
            if factor.inputs is None or factor.has_bias:
                parts.append(factor.outputs.sum(dim=0))
        return torch.cat(parts).numpy() / n_states

    def lagged_products(self, other: "StateGradients", max_lag: int) -> np.ndarray:
        """
        :param other: gradients at the same states, (T, P) as well
        :param max_lag: largest distance between two states, below T
        :return: means over i of the inner products of this gradient at state i with the other at state i + t, for t =
            1, ..., ``max_lag``, (max_lag,)
        """
        n_states = len(self.factors[0].outputs)
        products = torch.zeros(n_states, n_states, dtype=torch.float64)
        for mine, theirs in zip(self.factors, other.factors, strict=True):
            of_outputs = mine.outputs @ theirs.outputs.T
            products += of_outputs if mine.inputs is None else of_outputs * mine.input_products()
        matrix = products.numpy()
        return np.array([np.diagonal(matrix, lag).mean() for lag in range(1, max_lag + 1)])

    def squared_norms(self) -> np.ndarray:
        """
        :return: squared length of each state's gradient, (T,)
        """
        return _squared_norms(self.factors)


class Scores:
    """
    Scores, the gradients of log pi(a | s), of K actions at each of T states.

    :param policy: policy of a ``PPO`` or ``A2C``; see :func:`check_policy`
    :param observations: as the policy gets them, (T, ...)
    :param actions: as the policy samples them, not clipped, (T, K, ...)
    """

    def __init__(self, policy: ActorCriticPolicy, observations: np.ndarray, actions: np.ndarray):
        n_states, self.n_actions = actions.shape[:2]
        rows = np.repeat(observations, self.n_actions, axis=0)
        flat = torch.as_tensor(actions.reshape(n_states * self.n_actions, *actions.shape[2:]), device=policy.device)
        self.factors = []
        tensor: Any = policy.obs_to_tensor(rows)[0]
        for inputs, has_bias, outputs in _factors(policy, tensor, flat):
            outputs = outputs.reshape(n_states, self.n_actions, -1)
            if inputs is not None:
                inputs = inputs.reshape(n_states, self.n_actions, -1)[:, 0]
            self.factors.append(Factor(inputs, has_bias, outputs))

    def weighted(self, weights: np.ndarray) -> StateGradients:
        """
        :param weights: one for every score, (T, K)
        :return: the sum of weight times score over the actions of each state
        """
        w = torch.as_tensor(weights, dtype=torch.float64)
        return StateGradients(
            [factor._replace(outputs=torch.einsum("tk,tko->to", w, factor.outputs)) for factor in self.factors]
        )

    def squared_norms(self) -> np.ndarray:
        """
        :return: squared length of each score, (T, K)
        """
        return _squared_norms(self.factors)


def check_policy(policy: Any) -> None:
    """
    :param policy: anything
    :raises TypeError: it is not a policy of ``PPO`` or ``A2C``, or depends on more than the observation
    :raises ValueError: actions depend on something other than linear layers, each used once, and a Gaussian's
        ``log_std``; or the policy uses generalised state-dependent exploration
    """
    if not isinstance(policy, ActorCriticPolicy):
        raise TypeError(f"policy must be an ActorCriticPolicy, as of PPO and A2C, not {type(policy).__name__}")
    if policy.use_sde:
        raise ValueError("policy must sample its actions independently of each other: use_sde must be False")
    space = policy.observation_space
    if space.__class__.__name__ == "Dict":
        raise ValueError(f"policy must take observations that are one array, not {space}")
    assert space.shape is not None
    observations: Any = policy.obs_to_tensor(np.zeros((2, *space.shape), space.dtype))[0]
    try:
        with torch.no_grad():
            actions = policy.get_distribution(observations).mode()
    except TypeError as error:
        raise TypeError(
            f"policy must depend on the observation alone, and {type(policy).__name__} does not ({error})"
        ) from error
    counted = sum(
        (0 if inputs is None else inputs.shape[-1] * outputs.shape[-1])
        + (outputs.shape[-1] if inputs is None or has_bias else 0)
        for inputs, has_bias, outputs in _factors(policy, observations, actions)
    )
    log_prob = policy.get_distribution(observations).log_prob(actions)
    named = {name: parameter for name, parameter in policy.named_parameters() if parameter.requires_grad}
    gradients = torch.autograd.grad(log_prob.sum(), [*named.values()], allow_unused=True)
    used = {name: named[name] for name, gradient in zip(named, gradients, strict=True) if gradient is not None}
    n_used = sum(parameter.numel() for parameter in used.values())
    if counted != n_used:
        shapes = ", ".join(f"{name} {tuple(parameter.shape)}" for name, parameter in used.items())
        raise ValueError(
            "policy must be of linear layers, each used once, and log_std, whose parameters alone decide its actions: "
            f"those have {counted} parameters, but its actions depend on {n_used} ({shapes})"
        )


def _factors(
    policy: ActorCriticPolicy, observations: torch.Tensor, actions: torch.Tensor
) -> list[tuple[torch.Tensor | None, bool, torch.Tensor]]:
    """Input, whether there is a bias, and gradient of the output for every layer that the actions depend on."""
    seen: list[tuple[nn.Linear, torch.Tensor, torch.Tensor]] = []

    def remember(module: nn.Module, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        assert isinstance(module, nn.Linear)
        seen.append((module, inputs[0].detach(), output))

    hooks = [module.register_forward_hook(remember) for module in policy.modules() if isinstance(module, nn.Linear)]
    try:
        with torch.enable_grad():
            distribution: Any = policy.get_distribution(observations)
            log_prob = distribution.log_prob(actions)
    finally:
        for hook in hooks:
            hook.remove()
    leaves = [output for _, _, output in seen]
    gaussian = isinstance(distribution, DiagGaussianDistribution)
    if gaussian:
        leaves.append(distribution.distribution.scale)
    gradients = torch.autograd.grad(log_prob.sum(), leaves)
    # Sums of many terms that cancel each other need float64, on the CPU since not every device has it.
    factors: list[tuple[torch.Tensor | None, bool, torch.Tensor]] = [
        (_double(inputs), layer.bias is not None, _double(gradient))
        for (layer, inputs, _), gradient in zip(seen, gradients, strict=False)
    ]
    if gaussian:
        scale = distribution.distribution.scale.detach()
        factors.append((None, False, _double(gradients[-1] * scale)))  # of log_std
    return factors


def _squared_norms(factors: list[Factor]) -> np.ndarray:
    total: Any = 0.0
    for factor in factors:
        of_outputs = factor.outputs.square().sum(dim=-1)
        if factor.inputs is not None:
            of_inputs = factor.inputs.square().sum(dim=-1) + float(factor.has_bias)
            of_outputs = of_outputs * (of_inputs[:, None] if of_outputs.ndim == 2 else of_inputs)
        total = total + of_outputs
    return total.numpy()


def _double(tensor: torch.Tensor) -> torch.Tensor:
    return tensor.detach().cpu().double()
