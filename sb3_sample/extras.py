"""How optional dependencies are installed."""

import contextlib
from collections.abc import Iterator


def install(*extras: str) -> str:
    """
    :param extras: names of this package's extras
    :return: how to install them, in words. The package is on no index, so pip needs its checkout
    """
    return f'pip install -e ".[{",".join(extras)}]" in the checkout of sb3_sample'


@contextlib.contextmanager
def needing(what: str, extra: str) -> Iterator[None]:
    """
    Context for imports of optional dependencies.

    :param what: what needs which of them, for the error
    :param extra: the extra that they are of
    :raises ImportError: one is not installed
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(f"{what} ({error}). Install it with: {install(extra)}") from error


def needing_matplotlib() -> contextlib.AbstractContextManager[None]:
    """
    :return: context for imports of matplotlib
    """
    return needing("plots need matplotlib", "plots")
