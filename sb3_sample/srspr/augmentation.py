"""Augmentation of stacked frames: a random shift, and a random brightness."""

import torch

#: Pixels by which pictures are shifted at most, and spread of their brightness.
SHIFT, BRIGHTNESS = 4, 0.05


def shifted(pictures: torch.Tensor, offsets: torch.Tensor, shift: int = SHIFT) -> torch.Tensor:
    """
    Pad pictures with their borders' pixels and cut them out again, somewhere else. All channels of a picture move
    together.

    :param pictures: of any type, (N, C, height, width)
    :param offsets: rows and columns where each is cut out, in [0, 2 * shift]; ``shift`` is the picture itself, (N, 2)
    :param shift: pixels added to each border
    :return: the shifted pictures, of the same type and shape
    """
    n, channels, height, width = pictures.shape
    rows, columns = (
        (torch.arange(size, device=pictures.device) + offsets[:, axis, None] - shift).clamp(0, size - 1)
        for axis, size in enumerate((height, width))
    )
    places = (rows[:, :, None] * width + columns[:, None, :]).view(n, 1, -1)
    return pictures.flatten(2).gather(2, places.expand(-1, channels, -1)).view_as(pictures)


def augmented(pictures: torch.Tensor, offsets: torch.Tensor, brightness: torch.Tensor) -> torch.Tensor:
    """
    Augment observations: each is shifted by its own offsets and multiplied by ``1 + 0.05 * clip(brightness, -2, 2)``.

    :param pictures: uint8, (N, C, height, width)
    :param offsets: in [0, 8], see :func:`shifted`, (N, 2)
    :param brightness: standard normal numbers, (N,)
    :return: floats, of [0, 1] before the brightness, (N, C, height, width)
    """
    factors = (1 + BRIGHTNESS * brightness.clamp(-2, 2)) / 255
    return shifted(pictures, offsets).float() * factors[:, None, None, None]
