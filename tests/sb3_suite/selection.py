"""
Pytest plugin of the copied suites: of their tests, those that use the replaced class.

Its two options name the class in Stable-Baselines3 (``SAC``) and ours among the replacements (``BRO``).
"""

from types import CodeType
from typing import Any

import pytest

from tests.sb3_suite import replacements

#: Parameters that say which algorithm a test is about. ``model_name`` is a key of ``MODEL_DICT``.
PARAMETERS = ("model_class", "algo", "model_name")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--replaced", help="the class's name in Stable-Baselines3")
    parser.addoption("--replacement", help="the class that takes its place, of tests.sb3_suite.replacements")


def pytest_collection_modifyitems(config: pytest.Config, items: list[Any]) -> None:
    name, cls = config.getoption("--replaced"), getattr(replacements, config.getoption("--replacement"))
    kept = [item for item in items if uses(item, name, cls)]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


def uses(item: Any, name: str, cls: type) -> bool:
    """
    :param item: a test
    :param name: what its module calls the class
    :param cls: the class
    :return: whether the test is about the class: by its parameter, or without one by what its code names
    """
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    for parameter in PARAMETERS:
        if parameter in parameters:
            value = parameters[parameter]
            if isinstance(value, str) and hasattr(item.module, "MODEL_DICT"):
                value = item.module.MODEL_DICT[value][0]
            return value is cls
    return name in _names(item.function.__code__)


def _names(code: CodeType) -> set[str]:
    """Global names in a function and in the functions within it."""
    names = set(code.co_names)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            names |= _names(constant)
    return names
