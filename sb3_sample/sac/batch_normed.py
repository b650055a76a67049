"""What the agents with batch norm in their networks have in common."""

from collections.abc import Mapping, Sequence
from typing import Any


def check_batch_size(agent: Any) -> None:
    """
    :param agent: an algorithm whose actor takes the mean and variance of a batch
    :raises ValueError: if a batch has one transition
    """
    if agent.batch_size < 2:
        raise ValueError(
            f"batch_size must be at least 2 with batch norm, which takes mean and variance of the batch, not "
            f"{agent.batch_size}"
        )


def with_networks(
    kwargs: dict[str, Any],
    network: str,
    hidden_sizes: Mapping[str, Sequence[int]],
    more: Mapping[str, Any],
    actor: Mapping[str, Any],
) -> dict[str, Any]:
    """
    Complete arguments of a policy by those of the published networks, where the user's say nothing else.

    :param kwargs: arguments of the policy
    :param network: name of the network of critics and actor
    :param hidden_sizes: widths of its hidden layers, of "critic" and "actor"
    :param more: further arguments of it
    :param actor: arguments of a Gaussian actor
    :return: the arguments
    """
    kwargs = dict(kwargs)
    for who, sizes in hidden_sizes.items():
        kwargs.setdefault(f"{who}_network", network)
        if kwargs[f"{who}_network"] != network:
            continue
        own = {**more, **(kwargs.get(f"{who}_network_kwargs") or {})}
        if kwargs.get("net_arch") is None:
            own.setdefault("hidden_sizes", list(sizes))
        kwargs[f"{who}_network_kwargs"] = own
    if kwargs["backbone"] == "sac":
        kwargs["actor_kwargs"] = {**actor, **(kwargs.get("actor_kwargs") or {})}
    return kwargs
