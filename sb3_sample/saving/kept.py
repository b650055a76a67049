"""Where the attributes of an algorithm are kept: in a model's file, in a checkpoint, in both, or in neither."""

import enum


class Kept(enum.Flag):
    """
    Where an attribute is kept by itself. An algorithm declares this for its own attributes, by name, in the class
    attribute ``_kept``. All others are kept everywhere, except arguments of the constructor, which are kept only in a
    model's file: a program that resumes from a checkpoint passes them anew.
    """

    #: It follows from the arguments, from other kept attributes, or from the present ``learn``; or it has its own
    #: files.
    NOWHERE = 0
    IN_FILES = enum.auto()
    IN_CHECKPOINTS = enum.auto()
    EVERYWHERE = IN_FILES | IN_CHECKPOINTS


def declared(cls: type) -> dict[str, Kept]:
    """
    :param cls: class of an algorithm
    :return: the declarations of the class and its bases, by attribute; the nearest class decides
    """
    return {name: where for base in reversed(cls.__mro__) for name, where in vars(base).get("_kept", {}).items()}
