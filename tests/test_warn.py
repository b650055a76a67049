"""Warnings name the line of the user's program."""

import threading
import warnings
from typing import Any

import pytest
import torch
from stable_baselines3.common.callbacks import CheckpointCallback

from sb3_sample import SAC, BROFast
from sb3_sample.warn import warn
from tests.sac.common import Toy, sac

needs_no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="with a GPU, device='cuda' is what it says")


def only(caught: list[warnings.WarningMessage]) -> warnings.WarningMessage:
    """The one warning that there was."""
    assert len(caught) == 1, [str(each.message) for each in caught]
    return caught[0]


@needs_no_gpu
@pytest.mark.parametrize("make", [sac, lambda **kwargs: BROFast("MlpPolicy", Toy(), **kwargs)])
def test_a_gpu_that_is_not_there(make: Any) -> None:
    with pytest.warns(UserWarning, match="^device='cuda': torch finds no such device here, so cpu is used$") as caught:
        model = make(device="cuda")
    assert model.device == torch.device("cpu")
    # The call is in this file, or in that of the helper.
    assert "/tests/" in only(list(caught)).filename


def test_a_device_that_is_there_is_not_warned_of() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sac(device="auto")
        sac(device="cpu")
        sac(device=torch.device("cpu"))


@needs_no_gpu
def test_load_to_a_gpu_that_is_not_there(tmp_path: Any) -> None:
    sac().save(tmp_path / "m")
    with pytest.warns(UserWarning, match="^device='cuda:0': ") as caught:
        SAC.load(tmp_path / "m", device="cuda:0")
    assert {each.filename for each in caught} == {__file__}


def test_through_callbacks_of_stable_baselines(tmp_path: Any) -> None:
    """However deep in the packages it comes up, it is the call of ``learn`` that is named."""
    (tmp_path / "m_4_steps.zip").mkdir()
    with pytest.warns(UserWarning, match="is a folder, written is") as caught:
        sac().learn(4, callback=CheckpointCallback(4, str(tmp_path), "m"))
    assert {each.filename for each in caught} == {__file__}


def test_a_thread_of_ones_own_has_no_such_line() -> None:
    thread = threading.Thread(target=warn, args=("said",))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        thread.start()
        thread.join()
    assert (str(only(caught).message), only(caught).filename) == ("said", threading.__file__)
