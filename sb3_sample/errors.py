"""Errors that several rooms of the package raise."""


class ParametersDoNotFit(ValueError, RuntimeError):
    """
    Parameters that are loaded are not those of this model. Also a ``RuntimeError``, as torch's own, since
    Stable-Baselines3's ``load`` takes a mere ``ValueError`` for a file of an old version of its own.
    """
