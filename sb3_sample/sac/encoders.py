"""Encoders of images, as features extractors of Stable-Baselines3."""

import math
from collections.abc import Sequence

import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_sample.kinds import FINITE, Kind, check_value, integer, is_integer, one_of

_SIZES = Kind(
    "be integers of at least 1, one for each layer",
    lambda value: (
        isinstance(value, Sequence) and len(value) > 0 and all(is_integer(each) and each >= 1 for each in value)
    ),
)


class ConvEncoder(BaseFeaturesExtractor):
    """
    Convolutions with a ReLU after each, flattened: by default the encoder of DrQ and DrQ-v2 (Kostrikov et al. 2021,
    Yarats et al. 2022); with ``filters=(32, 64, 128, 256)``, ``strides=(2, 2, 2, 2)`` and ``padding="same"``, that of
    the JAX code behind the primacy bias (Nikishin et al. 2022). Kernels are orthogonal with a gain of √2, biases zero.

    :param observation_space: space of images, channels first
    :param filters: channels of each convolution
    :param strides: stride of each convolution
    :param kernel_size: kernel size of all convolutions, in pixels
    :param padding: "valid" for none, or "same": enough zeros for an output of 1 / stride of the input's pixels, the odd
        one at the lower right
    :param offset: subtracted from the images, which Stable-Baselines3 divides by 255 (DrQ-v2: 0.5)
    :raises ValueError: if an argument is out of range, or images are too small
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        filters: Sequence[int] = (32, 32, 32, 32),
        strides: Sequence[int] = (2, 1, 1, 1),
        kernel_size: int = 3,
        padding: str = "valid",
        offset: float = 0.0,
    ):
        check_value("filters", filters, _SIZES)
        check_value("strides", strides, _SIZES)
        check_value("kernel_size", kernel_size, integer(1))
        check_value("padding", padding, one_of(("valid", "same")))
        self_offset = check_value("offset", offset, FINITE)
        if len(filters) != len(strides):
            raise ValueError(f"strides must be as many as filters, {len(filters)}, not {len(strides)}")
        shape = observation_space.shape
        if not isinstance(observation_space, spaces.Box) or shape is None or len(shape) != 3:
            raise ValueError(
                f"ConvEncoder needs images, a Box of shape (channels, height, width), not {observation_space}"
            )
        channels, height, width = shape
        layers: list[nn.Module] = []
        for n_filters, stride in zip(filters, strides, strict=True):
            if padding == "same":
                pads = [_same(size, stride, kernel_size) for size in (width, height)]
                layers.append(nn.ZeroPad2d((*pads[0], *pads[1])))
                height, width = math.ceil(height / stride), math.ceil(width / stride)
            else:
                height, width = ((size - kernel_size) // stride + 1 for size in (height, width))
            if min(height, width) < 1:
                raise ValueError(
                    f"images of shape {shape} are too small for {len(filters)} convolutions: pass fewer filters"
                )
            layers += [nn.Conv2d(channels, n_filters, kernel_size, stride), nn.ReLU()]
            channels = n_filters
        super().__init__(observation_space, channels * height * width)
        self.offset = self_offset
        self.layers = nn.Sequential(*layers)
        for layer in self.layers:
            if isinstance(layer, nn.Conv2d):
                nn.init.orthogonal_(layer.weight, math.sqrt(2))
                assert layer.bias is not None
                nn.init.zeros_(layer.bias)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """
        :param observations: images as Stable-Baselines3 preprocesses them, (B, C, H, W)
        :return: features, (B, F)
        """
        # A tensor where it differs between the learners of a group, whose value cannot be asked for.
        has_offset = isinstance(self.offset, torch.Tensor) or self.offset != 0
        x = observations - self.offset if has_offset else observations
        if x.device.type == "cpu":
            # On a CPU, convolutions are faster with the channels last in memory, forward and backward; all their
            # outputs keep it. Within the step of several learners torch.channels_last is refused.
            x = x.movedim(1, -1).contiguous().movedim(-1, 1)
        return self.layers(x).flatten(start_dim=1)  # type: ignore[no-any-return]


def _same(size: int, stride: int, kernel_size: int) -> tuple[int, int]:
    """Zeros before and after an axis."""
    total = max((math.ceil(size / stride) - 1) * stride + kernel_size - size, 0)
    return total // 2, total - total // 2
