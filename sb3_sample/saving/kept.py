"""Where the attributes of an algorithm are kept: in a model's file, in a checkpoint, in both, or in neither."""

import enum


class Kept(enum.Flag):
    """
    Where an attribute is kept by itself. An algorithm declares it in the class attribute ``_kept``, by name, for its
    own attributes. Others are kept everywhere, but arguments of the constructor only in a model's file:
    the program that goes on from a checkpoint gives them anew.
    """

    #: It follows from the arguments, from what is kept besides, or from the present ``learn``; or has files of its own.
    NOWHERE = 0
    IN_FILES = enum.auto()
    IN_CHECKPOINTS = enum.auto()
    EVERYWHERE = IN_FILES | IN_CHECKPOINTS


def declared(cls: type) -> dict[str, Kept]:
    """
    :param cls: class of an algorithm
    :return: what it and its bases declare, by attribute; the class nearest to it decides
    """
    return {name: where for base in reversed(cls.__mro__) for name, where in vars(base).get("_kept", {}).items()}
