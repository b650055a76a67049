"""Sets and dicts from files: many values of one hash make them as slow as looking through all of them each time."""

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Any

from sb3_sample.saving.untrusted import BadFile

#: Different values of one hash: -1 and -2 have one, and numbers that differ by multiples of 2**61 - 1.
MAX_SAME = 50


def distinct_hashes(values: Iterable[Hashable], name: str) -> list[Any]:
    """
    :param values: what a set or the keys of a dict are to be made of
    :param name: what it is, for messages
    :return: the values
    :raises BadFile: if so many have one hash that making it would not be linear in their number
    """
    kept = list(values)
    if len(kept) > MAX_SAME and max(Counter(map(hash, kept)).values()) > MAX_SAME:
        raise BadFile(f"{name} holds more than {MAX_SAME} values of one hash")
    return kept


def part_name(name: str, key: Any) -> str:
    """
    :param name: of a container, for messages
    :param key: of a part of it
    :return: what the part is called, of a length that does not grow with what a file says
    """
    return name if len(name) > 300 else f"{name}{key:.100}"
