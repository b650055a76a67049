"""Errors that several folders of the package raise."""


class ParametersDoNotFit(ValueError, RuntimeError):
    """
    Loaded parameters are not those of this model. Also a ``RuntimeError``, like torch's own, since Stable-Baselines3's
    ``load`` takes a mere ``ValueError`` as the sign of a file from one of its old versions.
    """
