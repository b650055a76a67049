"""Projection of a categorical distribution onto the atoms of its support."""

import torch


def project(probabilities: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """
    Project probabilities onto K evenly spaced atoms, each onto the two nearest atoms in proportion to their closeness
    (C51, Bellemare et al. 2017).

    :param probabilities: (B, K), K at least 2
    :param places: their positions in units of the spacing, counted from the first atom, in [0, K - 1], (B, K); NaN is
        passed on to probabilities of its row
    :return: probabilities of the atoms, (B, K)
    """
    return (by_index if places.device.type == "cpu" else by_distance)(probabilities, places)


def by_index(probabilities: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """
    Add each probability to two atoms. See :func:`project`.

    A GPU would sum in an order that differs from call to call.
    """
    # An index of NaN would be refused: its place is atom 0, its shares are NaN.
    lower = places.nan_to_num().floor().clamp(max=probabilities.shape[-1] - 2)
    upper_share = places - lower
    index = lower.long()
    moved = torch.zeros_like(probabilities).scatter_add(-1, index, probabilities * (1 - upper_share))
    return moved.scatter_add(-1, index + 1, probabilities * upper_share)


def by_distance(probabilities: torch.Tensor, places: torch.Tensor) -> torch.Tensor:
    """
    Share each probability among all atoms, most shares being 0. See :func:`project`.

    This is K times the arithmetic, little on a GPU, in a fixed order.
    """
    atoms = torch.arange(probabilities.shape[-1], device=places.device, dtype=places.dtype)
    shares = (1 - (places.unsqueeze(-1) - atoms).abs()).clamp(min=0)
    return (probabilities.unsqueeze(-1) * shares).sum(dim=-2)
