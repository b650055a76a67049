"""The user's arguments of a policy, completed by those of an agent and of its published networks."""

from collections.abc import Mapping, Sequence
from typing import Any


def with_networks(kwargs: Mapping[str, Any], network: str, settings: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """
    :param kwargs: arguments of the policy
    :param network: name of the network of critics and actor
    :param settings: arguments of the network, for "critic" and "actor"
    :return: the policy's arguments, completed by ``settings`` where the network is ``network``
    """
    kwargs = dict(kwargs)
    for who, published in settings.items():
        kwargs.setdefault(f"{who}_network", network)
        if kwargs[f"{who}_network"] == network:
            kwargs[f"{who}_network_kwargs"] = {**published, **(kwargs.get(f"{who}_network_kwargs") or {})}
    return kwargs


def with_hidden_sizes(
    kwargs: Mapping[str, Any],
    network: str,
    hidden_sizes: Mapping[str, Sequence[int]],
    more: Mapping[str, Any],
    actor: Mapping[str, Any],
) -> dict[str, Any]:
    """
    :param kwargs: arguments of the policy
    :param network: name of the network of critics and actor
    :param hidden_sizes: widths of its hidden layers, for "critic" and "actor", unless there is a ``net_arch``
    :param more: further arguments of the network
    :param actor: arguments of a Gaussian actor
    :return: the arguments
    """
    settings = {who: dict(more) for who in hidden_sizes}
    if kwargs.get("net_arch") is None:
        settings = {who: {**more, "hidden_sizes": list(sizes)} for who, sizes in hidden_sizes.items()}
    completed = with_networks(kwargs, network, settings)
    if completed["backbone"] == "sac":
        completed["actor_kwargs"] = {**actor, **(completed.get("actor_kwargs") or {})}
    return completed


def with_weight_decay(kwargs: Mapping[str, Any], weight_decay: float) -> dict[str, Any]:
    """
    :param kwargs: arguments of the policy
    :param weight_decay: weight decay of the optimizers of all networks
    :return: the arguments with the weight decay
    """
    optimizer = {**(kwargs.get("optimizer_kwargs") or {}), "weight_decay": weight_decay}
    return {**kwargs, "optimizer_kwargs": optimizer}
