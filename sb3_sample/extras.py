"""How optional dependencies are installed."""


def install(*extras: str) -> str:
    """
    :param extras: names of this package's extras
    :return: what is to be typed to install them. The package is on no index, so that pip needs its checkout
    """
    return f'pip install -e ".[{",".join(extras)}]" in the checkout of sb3_sample'
