"""Augmentation of stacked frames: a random shift, and a random brightness."""

import torch

from sb3_sample.learner.augmentation import shifted

#: Largest shift in pixels, and spread of the brightness.
SHIFT, BRIGHTNESS = 4, 0.05


def augmented(pictures: torch.Tensor, offsets: torch.Tensor, brightness: torch.Tensor) -> torch.Tensor:
    """
    Augment observations: each is shifted by its own offsets and multiplied by ``1 + 0.05 * clip(brightness, -2, 2)``.

    :param pictures: uint8, (N, C, height, width)
    :param offsets: in [0, 8], see :func:`~sb3_sample.learner.augmentation.shifted`, (N, 2)
    :param brightness: standard normal numbers, (N,)
    :return: floats, in [0, 1] before the brightness, (N, C, height, width)
    """
    factors = (1 + BRIGHTNESS * brightness.clamp(-2, 2)) / 255
    return shifted(pictures, offsets, SHIFT).float() * factors[:, None, None, None]
