"""The projection of C51, in both forms."""

from collections.abc import Callable

import pytest
import torch

from sb3_sample.learner.projection import by_distance, by_index, project

Projection = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
FORMS = pytest.mark.parametrize("form", [by_index, by_distance])


@FORMS
def test_by_hand(form: Projection) -> None:
    probabilities = torch.tensor([[0.1, 0.2, 0.3, 0.4], [0.25, 0.25, 0.25, 0.25]])
    # Between atoms, on an atom, at both ends; and all in one place.
    places = torch.tensor([[0.0, 0.75, 2.0, 3.0], [2.5, 2.5, 2.5, 2.5]])
    expected = torch.tensor([[0.1 + 0.05, 0.15, 0.3, 0.4], [0.0, 0.0, 0.5, 0.5]])
    torch.testing.assert_close(form(probabilities, places), expected)


@pytest.mark.parametrize("n_atoms", [2, 3, 101])
def test_both_forms_are_one_projection(n_atoms: int) -> None:
    generator = torch.Generator().manual_seed(n_atoms)
    probabilities = torch.rand(64, n_atoms, generator=generator, dtype=torch.float64).softmax(dim=-1)
    places = torch.rand(64, n_atoms, generator=generator, dtype=torch.float64) * (n_atoms - 1)
    found = by_index(probabilities, places)
    torch.testing.assert_close(found, by_distance(probabilities, places), rtol=0, atol=1e-14)
    assert torch.equal(project(probabilities, places), found)
    # Learners of a group go through it together.
    stacked = torch.stack((probabilities, probabilities.flip(0))), torch.stack((places, places.flip(0)))
    assert torch.equal(torch.vmap(by_index)(*stacked)[0], found)
    assert torch.equal(torch.vmap(by_index)(*stacked)[1], found.flip(0))


@FORMS
def test_what_is_no_number_is_passed_on(form: Projection) -> None:
    places = torch.tensor([[0.0, float("nan"), 2.0], [0.0, 1.0, 2.0]])
    moved = form(torch.full((2, 3), 1 / 3), places)
    assert moved[0].isnan().any() and not moved[1].isnan().any()
