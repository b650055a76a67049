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
def needing_matplotlib() -> Iterator[None]:
    """
    Context for imports of matplotlib.

    :raises ImportError: it is not installed; says of which extra it is
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ImportError(f"plots need matplotlib ({error}). Install it with: {install('plots')}") from error
