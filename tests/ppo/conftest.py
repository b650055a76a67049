"""What tests of the on-policy family are run under."""

import pytest
import torch


@pytest.fixture(params=[True, False], ids=["checked", "unchecked"])
def checks_of_distributions(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both states of torch: its first ``torch.compile`` in a process ends the checks of distributions' parameters."""
    monkeypatch.setattr(torch.distributions.Distribution, "_validate_args", request.param)
