"""
Names of files among restored values. The program alone decides where it writes: checkpoints are passed around, and any
file that one names would be overwritten.
"""

import collections
import os
import re
from collections.abc import Iterator, Mapping
from typing import Any

#: Words in an attribute's name that tell that its value names files, whatever the value is.
_WORDS = {"path", "paths", "dir", "directory", "folder", "file", "files", "filename", "prefix", "root"}
_SEPARATOR = re.compile(r"[/\\]")
#: Levels of containers that are searched; a program's values may refer to themselves.
_DEPTH = 20


def names_place(attribute: str) -> bool:
    """
    :param attribute: name of an attribute
    :return: whether the attribute's name tells that a text in it is the name of a file
    """
    return not _WORDS.isdisjoint(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", attribute))


def brings_text(node: dict[str, Any], present: Any) -> bool:
    """
    :param node: the description of a value in a checkpoint
    :param present: the program's value
    :return: whether the checkpoint has a text there that the program does not
    """
    texts = set(_described(node))
    return bool(texts) and not texts <= set(_texts(present))


def is_elsewhere(attribute: str, node: dict[str, Any], present: Any) -> bool:
    """
    :param attribute: name of an attribute
    :param node: the description of its value in a checkpoint
    :param present: the program's value
    :return: whether the checkpoint names a file that the program does not
    """
    if not brings_text(node, present):
        return False
    texts = (*_described(node), *_texts(present))
    return names_place(attribute) or isinstance(present, os.PathLike) or any(map(_SEPARATOR.search, texts))


def is_moved(node: dict[str, Any], present: Any) -> bool:
    """
    :param node: as in :func:`is_elsewhere`
    :param present: as in :func:`is_elsewhere`
    :return: whether the files have the same names and only lie elsewhere, like those of a package on another machine
    """
    return {_last(text) for text in _described(node)} == {_last(text) for text in _texts(present)}


def _last(text: str) -> str:
    return _SEPARATOR.split(text)[-1]


def _described(node: dict[str, Any]) -> Iterator[str]:
    """
    The texts in a described value; not those of an object's attributes, which are checked by name, nor the keys of a
    dict, which name measurements (``eval/mean_reward``) more often than files.
    """
    if "value" in node:
        yield from _texts(node["value"])
    for kind in ("list", "tuple", "deque"):
        for item in node.get(kind, ()):
            yield from _described(item)
    for _, item in node.get("dict", ()):
        yield from _described(item)
    if "state_dict" in node:
        yield from _described(node["state_dict"])


def _texts(value: Any, depth: int = 0) -> Iterator[str]:
    if isinstance(value, (bytes, os.PathLike)):
        value = os.fsdecode(value)
    if isinstance(value, str):
        yield value
    elif depth < _DEPTH and isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item, depth + 1)
    elif depth < _DEPTH and isinstance(value, (list, tuple, set, frozenset, collections.deque)):
        for item in value:
            yield from _texts(item, depth + 1)
