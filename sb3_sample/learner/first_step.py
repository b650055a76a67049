"""
Checks before the first gradient step: wrong shapes of a custom part would broadcast, and train nonsense.

They run once, eagerly and before anything is compiled. Networks, value head and rule of pessimism are called as in a
gradient step, on a few of its transitions, as many as give the batch a size that nothing else has. The checks leave no
trace: random numbers, statistics and attributes are as before.
"""

import math
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn

from sb3_sample.kinds import is_number
from sb3_sample.learner.batch import Batch, Extra, for_each
from sb3_sample.learner.heads import ValueHead
from sb3_sample.learner.q_values import evaluate
from sb3_sample.learner.target import bootstrap

#: Smallest batch that is tried.
_MIN_ROWS = 5


def check_batch(who: str, batch: Any, like: Batch | None = None) -> None:
    """
    Check the shapes of a batch.

    :param who: origin of the batch, for the error
    :param batch: transitions
    :param like: the batch from which it was made, whose shapes it must have; None: any shapes of a batch
    :raises ValueError: if it is not a batch, or one of its entries has another shape
    """
    if not isinstance(batch, Batch):
        raise ValueError(f"{who} must be a Batch, not {_shown(batch)}: batch._replace(...) makes one")
    alone = like is None
    if like is None:
        if not isinstance(batch.actions, torch.Tensor) or batch.actions.dim() != 2 or len(batch.actions) == 0:
            raise ValueError(f"{who} must have actions of shape (B, A), not {_shown(batch.actions)}")
        like = batch
    for name in ("observations", "next_observations"):
        stored, found = getattr(like, name), getattr(batch, name)
        # The TD target may have another number of copies of each transition than the rest.
        n = len(like.actions) if alone or name == "observations" else len(like.rewards)
        if isinstance(stored, dict):
            if not isinstance(found, dict) or found.keys() != stored.keys():
                words = sorted(found) if isinstance(found, dict) else _shown(found)
                raise ValueError(f"{who} must have {name} with the keys {sorted(stored)}, not {words}")
            for key, value in stored.items():
                _check_entry(who, f"{name}[{key!r}]", found[key], _like(value, n))
        else:
            _check_entry(who, name, found, _like(stored, n))
    _check_entry(who, "actions", batch.actions, tuple(like.actions.shape))
    for name in ("dones", "rewards"):
        _check_entry(who, name, getattr(batch, name), (n, 1))
    discounts: Any = batch.discounts
    if not (discounts is None or is_number(discounts) or (_is_tensor(discounts) and discounts.dim() == 0)):
        _check_entry(who, "discounts", discounts, (n, 1), "a number, or ")


def check_actions(learner: Any, observations: Any, actions: Any) -> None:
    """
    Check an explorer's actions.

    :param learner: the learner
    :param observations: observations that the actions are for, (B, O), or a dict of them
    :param actions: the explorer's actions
    :raises ValueError: if they are not (B, A) in [-1, 1]; or not finite, though the learner's actor is
    """
    first = next(iter(observations.values())) if isinstance(observations, dict) else observations
    shape = (len(first), learner.actor.action_dim)
    _check(learner.explorer, "act", actions, "actions in [-1, 1]", shape, "(n_envs, A)")
    if actions.isfinite().all():
        if actions.abs().max() > 1 + 1e-5:
            raise ValueError(
                f"{_name(learner.explorer)}.act must return actions in [-1, 1], whatever the bounds of the action "
                f"space, not in [{actions.min():.4g}, {actions.max():.4g}]"
            )
    elif all(p.isfinite().all() for p in (*learner.actor.parameters(), *learner.explorer.parameters())):
        raise ValueError(f"{_name(learner.explorer)}.act must return finite actions, not NaN or infinite ones")


def check(learner: Any, batch: Batch, extra: Extra | None) -> None:
    """
    Check networks, value head and rule of pessimism against the needs of a gradient step.

    :param learner: the learner, before its first gradient step
    :param batch: the step's transitions, checked
    :param extra: further transitions for the rule of pessimism
    :raises ValueError: if a result has a wrong shape; the message names class and method
    """
    if extra is not None:
        check_batch("extra.batch", extra.batch)
    roots = (learner.networks, learner.head, learner.pessimism_rule)
    devices = [learner.device] if learner.device.type == "cuda" else []
    with torch.random.fork_rng(devices), _untouched([module for root in roots for module in root.modules()]):
        _try(learner, _rows(batch, _new_size(roots, batch)))


def _try(learner: Any, batch: Batch) -> None:
    head, rule, critic, n = learner.head, learner.pessimism_rule, learner.critic, len(batch.actions)
    n_critics = critic.n_critics
    # Networks: a dense layer reads their outputs, and would also accept one output for all copies.
    trunk, inputs = critic.trunk, critic.inputs(batch.observations, batch.actions)
    # A network without weights, such as an MLP without hidden layers, is the same for all critics.
    has_copies = any(True for _ in trunk.parameters())
    shape = (n_critics, n, trunk.out_features) if has_copies else (n, trunk.out_features)
    letters = "(E, B, out_features)" if has_copies else "(B, out_features)"
    outputs = _called(trunk, "forward", inputs, letters=f"n_copies={n_critics} and x (B, in_features)")
    _check(trunk, "forward", outputs, "outputs of critics", shape, letters)
    actor = learner.actor
    features = actor.features(batch.observations)
    outputs = _called(actor.trunk, "forward", features, letters="x (B, in_features)")
    _check(actor.trunk, "forward", outputs, "outputs of an actor", (n, actor.trunk.out_features), "(B, out_features)")

    beta = _called(rule, "beta")
    value = beta.item() if _is_tensor(beta) and beta.dim() == 0 else beta
    if not is_number(value):
        raise ValueError(f"{_name(rule)}.beta must return a number or a tensor of shape (), not {_shown(beta)}")
    if not 0 <= value < math.inf:
        raise ValueError(f"{_name(rule)}.beta must return a number of at least 0 and finite, not {value}")

    q = evaluate(critic, batch.observations, batch.actions)
    values = _called(head, "values", q, letters="outputs (E, B, n_outputs)")
    if not _is_tensor(values) or values.dim() != 3 or values.shape[:2] != (n_critics, n):
        raise ValueError(
            f"{_name(head)}.values must return values of shape (E, B, K) = ({n_critics}, {n}, K), not {_shown(values)}"
        )
    value = _called(rule, "value", values, letters="q (E, B, K)")
    _check(rule, "value", value, "the ensemble's value", (n, values.shape[2]), "(B, K)")

    next_q, entropy_bonus = bootstrap(learner, batch, learner.temperature_of(batch), torch.zeros_like(batch.actions))
    with torch.no_grad():
        target = _called(
            head, "target", batch, next_q, rule.value, entropy_bonus, letters="next_q (E, B, n_outputs), bonus (B, 1)"
        )
    if not _is_tensor(target) or n not in target.shape[:2]:
        raise ValueError(f"{_name(head)}.target must return a target with B = {n} rows, not {_shown(target)}")
    if type(head).loss is ValueHead.loss:
        # A squared error accepts any shape that broadcasts.
        _check(head, "target", target, "a target", (n, q.shape[2]), "(B, n_outputs)")
    loss = _called(head, "loss", q, target, letters="q (E, B, n_outputs), target (B, n_outputs)")
    _check(head, "loss", loss, "a loss", (), "()")
    if not loss.requires_grad:
        raise ValueError(f"{_name(head)}.loss must return a loss through which a gradient goes, not a constant")


def _called(part: Any, method: str, *arguments: Any, letters: str = "") -> Any:
    """Call a method; add a note to its errors: where they occurred, and the shapes that it was called with."""
    try:
        return part(*arguments) if method == "forward" else getattr(part, method)(*arguments)
    except Exception as error:
        shapes = ", ".join(str(tuple(each.shape)) for each in arguments if _is_tensor(each))
        words = f", called with {letters} = {shapes}" if shapes else ""
        error.add_note(f"in {_name(part)}.{method}{words}, before the first gradient step")
        raise


def _new_size(roots: Iterable[nn.Module], batch: Batch) -> int:
    """A number of rows that is the size of nothing else."""
    sizes = {size for root in roots for tensor in (*root.parameters(), *root.buffers()) for size in tensor.shape}
    for observations in (batch.observations, batch.next_observations):
        each = observations.values() if isinstance(observations, dict) else [observations]
        sizes |= {size for tensor in each for size in tensor.shape[1:]}
    return next(n for n in range(_MIN_ROWS, len(sizes) + _MIN_ROWS + 1) if n not in sizes)


def _rows(batch: Batch, n: int) -> Batch:
    """The first n transitions of a batch, repeated from the first on if there are fewer."""
    rows = torch.arange(n, device=batch.actions.device) % len(batch.actions)

    def take(value: Any) -> Any:
        return value[rows] if _is_tensor(value) and value.dim() > 0 else value

    return Batch(*(for_each(take, value) for value in batch))


@contextmanager
def _untouched(modules: list[nn.Module]) -> Iterator[None]:
    """Put modules in evaluation mode, without the hooks that others have registered, and restore them afterwards."""
    scripts = {module: module.training for module in modules if isinstance(module, torch.jit.ScriptModule)}
    plain = [module for module in modules if not isinstance(module, torch.jit.ScriptModule)]
    attributes = [(module, dict(vars(module)), dict(module._buffers)) for module in plain]
    buffers = [(buffer, buffer.clone()) for module in modules for buffer in module.buffers(recurse=False)]
    try:
        for script in scripts:
            script.eval()
        for module in plain:
            vars(module).update(training=False, _forward_hooks=OrderedDict())
        yield
    finally:
        for module, own, held in attributes:
            _replace(vars(module), own)
            _replace(module._buffers, held)
        for script, mode in scripts.items():
            script.train(mode)
        with torch.no_grad():
            for buffer, before in buffers:
                if not torch.equal(buffer, before):
                    buffer.copy_(before)


def _is_tensor(value: Any) -> bool:
    return isinstance(value, torch.Tensor)


def _like(stored: Any, n: int) -> tuple[int, ...]:
    return (n, *stored.shape[1:]) if _is_tensor(stored) else (n,)


def _name(part: Any) -> str:
    return type(part).__name__


def _shown(value: Any) -> str:
    """A value in an error: a tensor by its shape."""
    return f"a tensor of shape {tuple(value.shape)}" if _is_tensor(value) else f"{value!r:.100}"


def _check(part: Any, method: str, got: Any, what: str, shape: tuple[int, ...], letters: str) -> None:
    if not _is_tensor(got) or tuple(got.shape) != shape:
        wanted = letters if letters == str(shape) else f"{letters} = {shape}"
        raise ValueError(f"{_name(part)}.{method} must return {what} of shape {wanted}, not {_shown(got)}")


def _check_entry(who: str, name: str, got: Any, shape: tuple[int, ...], otherwise: str = "") -> None:
    if not _is_tensor(got) or tuple(got.shape) != shape:
        raise ValueError(f"{who} must have {name} that are {otherwise}a tensor of shape {shape}, not {_shown(got)}")


def _replace(content: dict[str, Any], earlier: dict[str, Any]) -> None:
    """Restore a dict's earlier content. Keys of both contents are never missing: another thread may act meanwhile."""
    content.update(earlier)
    for name in content.keys() - earlier.keys():
        del content[name]
