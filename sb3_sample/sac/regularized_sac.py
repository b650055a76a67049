"""The regularized agents of the study of overestimation, overfitting and plasticity (2403.00514)."""

from collections.abc import Sequence
from typing import Any

from sb3_sample.constructor import Given, argument
from sb3_sample.kinds import AT_LEAST_0, DICT, check_value
from sb3_sample.learner.pessimism import Pessimism
from sb3_sample.networks import CReLU
from sb3_sample.sac import checks
from sb3_sample.sac.algorithm import SAC

#: The groups of the regularization study, section 3, each with its choices.
CRITIC_REGULARIZATIONS = ("none", "cdq", "gpl", "top")
NETWORK_REGULARIZATIONS = ("none", "layer_norm", "spectral_norm", "weight_decay")
PLASTICITY_REGULARIZATIONS = ("none", "crelu", "redo", "resets", "sam")


class RegularizedSAC(SAC):
    """
    The regularized soft actor-critic agents of the regularization study (Nauman et al. 2024, "Overestimation,
    overfitting, and plasticity in actor-critic", https://arxiv.org/abs/2403.00514, section 3): one choice from each of
    three groups makes the 64 agents of the paper, and the last two groups take any mixture, ReDo included.

    The network regularizations apply to the critics alone, and CReLU is the activation of actor and critics (appendix B
    of the paper); resets apply to everything; SAM and ReDo act on the critics. The settings are the paper's where it
    gives them: layer norm on every hidden layer, spectral norm on the last one, weight decay on every parameter, CReLU
    with twice the width, GPL's learning rate of 1e-5. Where it refers to the original papers, their values are the
    defaults of arguments here: SAM's radius 0.05 (Foret et al. 2021), resets every 160,000 environment steps (as in the
    validation-buffer paper), ReDo every 1,000 gradient steps at a threshold of 0.025 (Sokar et al. 2023).

    No text states the coefficient of the weight decay. Here it is 0.01, the default of torch's AdamW; the default of
    optax, the library of the authors' later code, is 1e-4, as in BRO. A gradient step takes away the share
    ``learning_rate * weight_decay`` of a parameter: over the two million steps of the low replay regime, at a learning
    rate of 3e-4, 1e-4 shrinks it by 6 % in all, which is hardly a regularization, and 0.01 shrinks it to a
    four-hundredth. ``weight_decay=1e-4`` chooses the other coefficient.

    The low replay regime is the default; ``replay_ratio=16`` is the high one.

    :raises ValueError: if an argument is out of range or contradicts another
    """

    critic_regularization: str = argument(default="cdq")
    """"none" (the mean of the critics), "cdq" (their minimum), "gpl" or "top"; it replaces ``pessimism``"""
    network_regularization: str | Sequence[str] = argument(default="none")
    """"none", or any of "layer_norm", "spectral_norm", "weight_decay", one or several"""
    plasticity_regularization: str | Sequence[str] = argument(default="none")
    """"none", or any of "crelu", "redo", "resets", "sam", one or several"""
    weight_decay: float | None = argument(default=None, kind=AT_LEAST_0.or_none())
    """for "weight_decay", its coefficient; None: 0.01, torch's default (optax's: 1e-4)"""
    sam_radius: float | None = argument(default=None)
    """for "sam", its radius; None: 0.05"""
    resets: Sequence[int] | int | None = argument(default=None)  # type: ignore[assignment]  # None until it is stored
    """for "resets", environment steps between two resets, or the steps of all resets; None: 160,000, or none with
    ``reset_gradient_steps``"""
    reset_gradient_steps: int | None = argument(default=None)
    """for "resets", gradient steps between two resets instead"""
    resets_to: str = argument(default="start")
    """for "resets", parameters after a reset: "start", those that the model began with, as in the study's code, or
    "fresh", newly drawn ones"""
    redo_period: int | None = argument(default=None)
    """for "redo", gradient steps between two recyclings; None: 1,000"""
    pessimism: float | str | type[Pessimism] | None = argument(  # type: ignore[assignment]  # None until it is stored
        default=None
    )
    """chosen by ``critic_regularization``"""
    pessimism_kwargs: dict[str, Any] | None = argument(default=None)
    """for "gpl" and "top", arguments of the rule"""

    def _construct(self, given: Given) -> None:
        critics, kwargs = given["critic_regularization"], given["pessimism_kwargs"]
        if given["pessimism"] is not None:
            raise ValueError("pessimism is what critic_regularization chooses: pass that alone, or use SAC")
        network = _check_group("network_regularization", given["network_regularization"], NETWORK_REGULARIZATIONS)
        chosen = _check_group(
            "plasticity_regularization", given["plasticity_regularization"], PLASTICITY_REGULARIZATIONS
        )

        def set_default(name: str, default: Any, of: str, group: tuple[str, ...]) -> None:
            if of in group:
                given[name] = default if given[name] is None else given[name]
            elif given[name] is not None:
                raise ValueError(
                    f"{name}={given[name]!r} is a setting of {of!r}, which is not among the regularizations"
                )

        check_value("pessimism_kwargs", kwargs, DICT)
        gpl = {"learning_rate": 1e-5} if critics == "gpl" else {}
        set_default("weight_decay", 0.01, "weight_decay", network)
        set_default("reset_gradient_steps", None, "resets", chosen)
        set_default("resets", 160_000 if given["reset_gradient_steps"] is None else (), "resets", chosen)
        set_default("sam_radius", 0.05, "sam", chosen)
        set_default("redo_period", 1_000, "redo", chosen)
        given["resets"] = () if given["resets"] is None else given["resets"]
        given["pessimism"], given["pessimism_kwargs"] = _pessimism(critics), {**gpl, **(kwargs or {})} or None
        super()._construct(given)

    def _check_arguments(self) -> None:
        network = _check_group("network_regularization", self.network_regularization, NETWORK_REGULARIZATIONS)
        chosen = _check_group("plasticity_regularization", self.plasticity_regularization, PLASTICITY_REGULARIZATIONS)
        # The groups as the constructor read them; load may have changed one of the two.
        in_force = {
            "critic_regularization": self.pessimism == _pessimism(self.critic_regularization),
            "network_regularization": (self.weight_decay is not None) == ("weight_decay" in network),
            "plasticity_regularization": (
                (self.sam_radius is not None) == ("sam" in chosen)
                and (self.redo_period is not None) == ("redo" in chosen)
                and (self.reset_gradient_steps is not None or checks.has_resets(self.resets)) == ("resets" in chosen)
            ),
        }
        for name, agrees in in_force.items():
            if not agrees:
                raise ValueError(
                    f"{name}={getattr(self, name)!r} is not what the other arguments say: load cannot change the "
                    "regularizations of a model, and an argument of one needs its name among them"
                )
        if "crelu" in chosen and "activation_fn" in self.policy_kwargs:
            raise ValueError(
                "plasticity_regularization names 'crelu', the activation of actor and critics, and policy_kwargs have "
                f"activation_fn={self.policy_kwargs['activation_fn']!r}: leave one of them out"
            )
        super()._check_arguments()

    def _full_policy_kwargs(self) -> dict[str, Any]:
        network = _check_group("network_regularization", self.network_regularization, NETWORK_REGULARIZATIONS)
        plasticity = _check_group(
            "plasticity_regularization", self.plasticity_regularization, PLASTICITY_REGULARIZATIONS
        )
        kwargs = super()._full_policy_kwargs()
        actor: dict[str, Any] = {"activation_fn": CReLU} if "crelu" in plasticity else {}
        critic = {name: True for name in ("layer_norm", "spectral_norm") if name in network} | actor
        for who, regularized in (("actor_network", actor), ("critic_network", critic)):
            if regularized and kwargs.get(who, "mlp") != "mlp":
                raise ValueError(
                    f"network_regularization={self.network_regularization!r} and plasticity_regularization="
                    f"{self.plasticity_regularization!r} regularize an MLP, not {who}={kwargs[who]!r}"
                )
        optimizer = {"weight_decay": self.weight_decay} if "weight_decay" in network else {}
        for name, own in (
            ("actor_network_kwargs", actor),
            ("critic_network_kwargs", critic),
            ("critic_optimizer_kwargs", optimizer),
        ):
            given = dict(kwargs.get(name) or {})
            for key in own.keys() & given.keys():
                raise ValueError(f"policy_kwargs[{name!r}] has {key!r}, which the regularizations choose: leave it out")
            if own:
                kwargs[name] = {**own, **given}
        return kwargs


def _pessimism(critic_regularization: str) -> float | str:
    """Value of ``pessimism`` for a choice."""
    if critic_regularization not in CRITIC_REGULARIZATIONS:
        raise ValueError(
            f"critic_regularization must be one of {list(CRITIC_REGULARIZATIONS)}, not {critic_regularization!r}"
        )
    return {"none": 0.0, "cdq": 1.0}.get(critic_regularization, critic_regularization)


def _check_group(name: str, chosen: str | Sequence[str], allowed: Sequence[str]) -> tuple[str, ...]:
    """The members chosen from a group, "none" left out."""
    members = tuple(chosen) if isinstance(chosen, Sequence) and not isinstance(chosen, str) else (chosen,)
    if (
        not all(isinstance(member, str) for member in members)
        or len(set(members)) != len(members)
        or not set(members) <= set(allowed)
    ):
        raise ValueError(f"{name} must be of {list(allowed)}, each at most once, not {chosen!r}")
    if "none" in members and len(members) > 1:
        raise ValueError(f"{name}={chosen!r} names 'none' beside others")
    return tuple(member for member in members if member != "none")
