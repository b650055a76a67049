"""The one warning about what a model's files lack, and what reading them needs."""

from collections.abc import Sequence
from typing import Any

from sb3_sample.saving.classes import within
from sb3_sample.saving.encoding import Lenient
from sb3_sample.saving.training_state import argument_names
from sb3_sample.warn import warn


def argument_for(cls: type, name: str) -> str | None:
    """
    :param cls: class of an algorithm
    :param name: an attribute, or something in one: ``policy_kwargs.activation_fn``
    :return: the argument of ``load`` that replaces the file's value; None for values in the replay buffer's file
    """
    attribute = name.split(".")[0].split("[")[0]
    others = {"policy_class": "policy=", "observation_space": "env=", "action_space": "env=", "replay_buffer": None}
    if attribute in others:
        return others[attribute]
    return f"{attribute}=" if attribute in argument_names(cls) else f"custom_objects={{{attribute!r}: ...}}"


def need(cls: type, name: str, path: str, trusted: Sequence[str] = ()) -> str:
    """
    :param cls: class of an algorithm
    :param name: the part that is a class or function, or an object of a class, that other programs may not know
    :param path: of the class or function
    :param trusted: modules that somebody vouches for, so that trust is not what is missing
    :return: what reading the file needs for this part
    """
    argument = argument_for(cls, name)
    module = path.partition(":")[0]
    # Another program has another ``__main__``, or none with this name.
    is_named = "<locals>" not in path and module != "__main__"
    wanted = [f"trusted_modules=[{module!r:.200}]"] if is_named and not within(module, trusted) else []
    if argument is None:
        return f"load_replay_buffer needs {' or '.join([*wanted, 'a model that has it as its replay_buffer_class'])}"
    return f"load needs {' or '.join([*wanted, argument])}"


def say_once(model: Any, encoder: Lenient, trusted: Sequence[str] = ()) -> None:
    """
    Warn about everything that no earlier warning has named.

    :param model: an algorithm
    :param encoder: the encoder that writes its file, or would
    :param trusted: modules that the caller vouches for anyway
    """
    cls, vouched = type(model), (*model._trusted_modules, *trusted)
    said: dict[str, str] = {}
    for name, path in encoder.foreign.items():
        if "<locals>" in path or not within(path.partition(":")[0], vouched):
            # Several objects of one argument, such as the noise of each environment, need the same, which is named
            # once.
            wanted = need(cls, name, path)
            said.setdefault(f"{path} {wanted}", f"{name} is {path}, for which {wanted}")
    for name, reason in encoder.left_out.items():
        argument = argument_for(cls, name)
        wanted = "" if argument is None or argument.startswith("custom_objects") else f", and load needs {argument}"
        said[name] = f"{name} is left out ({reason}){wanted}"
    new = "; ".join(text for key, text in said.items() if key not in model._told)
    model._told = frozenset({*model._told, *said})
    if new:
        warn(f"What is saved of this {cls.__name__} (docs/saving.md): {new}")
