"""Sets and dicts from files: if many values have the same hash, each access is a search through all of them."""

from collections import Counter
from collections.abc import Hashable, Iterable
from typing import Any

from sb3_sample.saving.untrusted import BadFile

#: Largest number of values with the same hash, as -1 and -2 have, and numbers that differ by multiples of 2**61 - 1.
MAX_SAME = 50


def distinct_hashes(values: Iterable[Hashable], name: str) -> list[Any]:
    """
    :param values: members of a set, or keys of a dict, that is to be made
    :param name: what it is, for messages
    :return: the values
    :raises BadFile: if so many have the same hash that making it would not take linear time
    """
    kept = list(values)
    if len(kept) > MAX_SAME and max(Counter(map(hash, kept)).values()) > MAX_SAME:
        raise BadFile(f"{name} holds more than {MAX_SAME} values of one hash")
    return kept


def part_name(name: str, key: Any) -> str:
    """
    :param name: of a container, for messages
    :param key: of a part of it
    :return: the name of the part, whose length does not grow with the content of a file
    """
    return name if len(name) > 300 else f"{name}{key:.100}"
