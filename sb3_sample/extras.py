"""How optional dependencies are installed."""


def install(*extras: str) -> str:
    """
    :param extras: names of this package's extras
    :return: how to install them, in words. The package is on no index, so pip needs its checkout
    """
    return f'pip install -e ".[{",".join(extras)}]" in the checkout of sb3_sample'
