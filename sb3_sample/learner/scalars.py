"""Positive numbers that are learned by gradient descent: temperature, optimism, weight of a divergence."""

import math

import torch
from torch import nn

from sb3_sample.kinds import check_value, number


class LogScalar(nn.Module):
    """
    Positive number, the exponential of its parameter.

    :param initial: initial value, above 0
    """

    def __init__(self, initial: float):
        super().__init__()
        self.log_value = nn.Parameter(torch.tensor(math.log(initial)))

    def forward(self) -> torch.Tensor:
        """
        Compute the value.

        :return: the value, a scalar with gradient
        """
        return self.log_value.exp()


class TaskLogScalar(LogScalar):
    """
    A positive number for each task, the exponential of its parameter.

    :param initial: initial value of all, above 0
    :param n_tasks: how many
    """

    def __init__(self, initial: float, n_tasks: int):
        super().__init__(initial)
        self.log_value = nn.Parameter(torch.full((n_tasks,), math.log(initial)))


class BoundedLogScalar(nn.Module):
    """
    Positive number whose logarithm is kept in an interval by a tanh (BRO's published code):
    ``log(value) = low + (high - low) / 2 * (1 + tanh(parameter))``.

    :param name: name of the argument that gives the initial value, for the error
    :param initial: initial value, its logarithm strictly inside the interval
    :param low: lower bound of the logarithm
    :param high: upper bound of the logarithm
    :raises ValueError: if the initial value is not strictly inside the bounds
    """

    def __init__(self, name: str, initial: float, low: float = -10.0, high: float = 7.5):
        super().__init__()
        words = f"lie between exp({low}) and exp({high}), exclusive"
        check_value(name, initial, number(words, lambda value: math.exp(low) < value < math.exp(high)))
        self.low, self.half_range = low, (high - low) / 2
        self.raw_value = nn.Parameter(torch.tensor(math.atanh((math.log(initial) - low) / self.half_range - 1)))

    def forward(self) -> torch.Tensor:
        """
        Compute the value.

        :return: the value, a scalar with gradient
        """
        return torch.exp(self.low + self.half_range * (1 + torch.tanh(self.raw_value)))


class FixedScalar(nn.Module):
    """
    Number that is not learned, with the interface of one that is.

    :param value: the value
    """

    value: torch.Tensor

    def __init__(self, value: float):
        super().__init__()
        self.register_buffer("value", torch.tensor(float(value)))

    def forward(self) -> torch.Tensor:
        """
        Return the value.

        :return: the value, a scalar without gradient
        """
        return self.value
