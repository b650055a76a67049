"""Adam with decoupled weight decay that is exact in float32, and sharpness-aware gradients around any optimizer."""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import torch
from torch.optim import Optimizer

from sb3_sample.tracing import is_tracing

# With weight decay the step takes three passes over the parameters. On a CPU they run over pieces that fit the
# cache, all passes on one piece before the next: 2**18 floats are 1 MiB of parameters.
CHUNK = 2**18


class AdamW(Optimizer):
    """
    Adam with decoupled weight decay: ``p <- p - lr * (m_hat / (sqrt(v_hat) + eps) + weight_decay * p)``.

    ``torch.optim.AdamW`` multiplies by ``1 - lr * weight_decay`` instead. With BRO's settings
    (3e-4 * 1e-4) float32 cannot tell that factor apart from ``1 - 2**-24``, and the decay comes out 2.6 times too
    strong. Here decay and Adam's direction are added first and subtracted at once, as in the published code. With
    ``weight_decay=0`` this is plain Adam. The arithmetic is that of torch's fused kernel.

    :param params: parameters, or groups of them
    :param lr: learning rate
    :param betas: decay rates of the first and second moment
    :param eps: added to the root of the second moment
    :param weight_decay: coefficient of the decay, which every parameter of the group receives
    :raises ValueError: if a hyperparameter is out of range
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float = 3e-4,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        weight_decay: float = 0.0,
    ):
        if not lr >= 0:
            raise ValueError(f"lr must be at least 0, not {lr}")
        if not all(0 <= beta < 1 for beta in betas):
            raise ValueError(f"betas must lie in [0, 1), not {betas}")
        if not eps > 0:
            raise ValueError(f"eps must be above 0, not {eps}")
        if not weight_decay >= 0:
            raise ValueError(f"weight_decay must be at least 0, not {weight_decay}")
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps, "weight_decay": weight_decay})
        #: Whether steps read the learning rates from tensors, as a captured step must; numbers are faster.
        self.capturable = False
        # The groups' learning rates as a tensor, and the numbers that it holds.
        self._rates: torch.Tensor | None = None
        self._rates_held: list[float | tuple[float, ...]] = []
        # By group, how many steps each parameter has taken.
        self._steps: list[torch.Tensor] = []
        # Number of parameters whose moments exist; the state has another number if moments were cleared.
        self._n_prepared = -1
        #: Whether the learners whose parameters are stacked have taken different numbers of steps.
        self.counts_differ = False
        #: Number of times that :meth:`prepare` has made tensors.
        self.version = 0

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """
        Take one step with the gradients in ``.grad``; parameters without one are left alone.

        :param closure: evaluates the loss anew, as in torch
        :return: what the closure returned, or None
        """
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        self.prepare()
        self.apply([p.grad for group in self.param_groups for p in group["params"]])
        return loss

    @torch.no_grad()
    def prepare(self) -> None:
        """
        Update everything that :meth:`apply` reads: the moments are made, and the groups' learning rates put into
        tensors. Compiled and captured steps, which know only tensors, then find both.
        """
        self.prepare_rates()
        if len(self.state) == self._n_prepared == sum(len(group["params"]) for group in self.param_groups):
            return
        device = self.param_groups[0]["params"][0].device
        for i, group in enumerate(self.param_groups):
            params = group["params"]
            if i < len(self._steps) and all("step" in self.state[p] for p in params):
                continue
            # The parameters' numbers of steps are elements of one vector, so that all are counted at once.
            steps = torch.tensor(
                [float(self.state[p].get("step", 0)) for p in params], dtype=torch.float32, device=device
            )
            self._steps[i:] = [steps, *self._steps[i + 1 :]]
            for p, step in zip(params, steps.unbind(), strict=True):
                self.state[p]["step"] = step
                for name in ("exp_avg", "exp_avg_sq"):
                    if name not in self.state[p]:
                        self.state[p][name] = torch.zeros_like(p)
        # A compiled step finds a parameter's state by its place in the dict.
        parameters = [p for group in self.param_groups for p in group["params"]]
        if any(p is not q for p, q in zip(self.state, parameters, strict=False)):
            ordered = {p: self.state.pop(p) for p in parameters if p in self.state}
            self.state.update(ordered)
        self._n_prepared = len(self.state)
        self.version += 1

    @torch.no_grad()
    def prepare_rates(self) -> None:
        """Update the tensors with the learning rates, which change with the steps in a schedule."""
        # With stacked parameters of several learners, a group may have a rate for each learner.
        rates = [lr if isinstance(lr := group["lr"], tuple) else float(lr) for group in self.param_groups]
        first = self.param_groups[0]["params"][0]
        device = first.device
        # torch's fused kernel reads a float32 on a GPU.
        dtype = torch.float64 if first.dtype is torch.float64 and device.type == "cpu" else torch.float32
        is_held = self._rates is not None and self._rates.device == device and self._rates.dtype is dtype
        if is_held and self._rates_held == rates:
            return
        shapes = [[len(r) if isinstance(r, tuple) else 0 for r in of] for of in (rates, self._rates_held)]
        if self._rates is None or not is_held or shapes[0] != shapes[1]:
            self._rates = torch.tensor(rates, dtype=dtype, device=device)
        else:
            for i, (rate, held) in enumerate(zip(rates, self._rates_held, strict=True)):
                # fill_, since a copy from the host would wait for a GPU.
                for j, value in enumerate(rate if isinstance(rate, tuple) else (rate,)):
                    if rate != held:
                        (self._rates[i, j] if isinstance(rate, tuple) else self._rates[i]).fill_(value)
        self._rates_held = rates

    def read_tensors(self) -> list[torch.Tensor]:
        """
        :return: tensors that a step reads besides parameters, gradients and state: learning rates and numbers of steps
        """
        return [*([] if self._rates is None else [self._rates]), *self._steps]

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Called by load_state_dict, copy and pickle: what follows from the state is made anew by prepare.
        super().__setstate__(state)
        self.capturable, self._rates, self._rates_held, self._steps = False, None, [], []
        self._n_prepared, self.version, self.counts_differ = -1, getattr(self, "version", 0), False

    @torch.no_grad()
    def apply(self, gradients: Sequence[torch.Tensor | None]) -> None:
        """
        Take one step with the given gradients; ``prepare`` comes first.

        :param gradients: in the order of the parameters, group by group; a parameter without one is left alone
        """
        assert self._rates is not None
        of_parameter = iter(gradients)
        for i, group in enumerate(self.param_groups):
            params, steps = group["params"], self._steps[i]
            used = [(j, p, g) for j, (p, g) in enumerate(zip(params, of_parameter, strict=False)) if g is not None]
            if not used:
                continue
            if len(used) == len(params):
                steps.add_(1)
            else:
                # One by one, since indices would come from the host, for which a GPU waits, and a capture cannot.
                for j, _, _ in used:
                    steps[..., j].add_(1)
            rows: list[tuple[torch.Tensor, ...]] = [
                (p, _laid_out_like(p, g), self.state[p]["exp_avg"], self.state[p]["exp_avg_sq"]) for _, p, g in used
            ]
            places = [j for j, _, _ in used]
            differ = self._rates.dim() > 1 or self.counts_differ or isinstance(group["weight_decay"], torch.Tensor)
            if is_tracing() or differ:
                _plain_adamw(group, rows, self._rates[i], steps, places)
                continue
            # Stacked learners have taken the same number of steps.
            counts = steps[0] if steps.dim() > 1 else steps
            rows = [(*tensors, counts[j]) for tensors, j in zip(rows, places, strict=True)]
            rate = self._rates[i] if self.capturable else group["lr"]
            if group["weight_decay"] == 0:
                _adam(group, rate, *zip(*rows, strict=True))
                continue
            for p, *others in _cache_sized(rows):
                # Start from the decay, let Adam add its direction, then change the parameters once.
                change = torch._foreach_mul(list(p), -rate * group["weight_decay"])
                _adam(group, rate, change, *others)
                torch._foreach_add_(list(p), change)


def _plain_adamw(
    group: dict[str, Any],
    rows: list[tuple[torch.Tensor, ...]],
    rate: torch.Tensor,
    steps: torch.Tensor,
    places: Sequence[int],
) -> None:
    """
    AdamW's step written out for all parameters at once, which a compiler fuses. The corrections, 1 minus nearly 1, need
    float64. Counts of steps, rates and decays may be those of S learners, whose parameters are stacked.

    :param rows: parameter, gradient, moments
    :param rate: the group's learning rate, or (S,)
    :param steps: steps taken by each of the group's parameters, (P,) or (S, P)
    :param places: places of the rows' parameters among the P
    """
    beta1, beta2 = group["betas"]
    p, grad, exp_avg, exp_avg_sq = map(list, zip(*rows, strict=True))
    dtype = functools.reduce(torch.promote_types, (of.dtype for of in p))
    steps = steps.double()
    sizes = _columns((rate.unsqueeze(-1) / (1 - beta1**steps)).to(dtype), places, p)
    roots = _columns((1 - beta2**steps).rsqrt().to(dtype), places, p)
    torch._foreach_lerp_(exp_avg, grad, 1 - beta1)
    torch._foreach_lerp_(exp_avg_sq, torch._foreach_mul(grad, grad), 1 - beta2)
    change = torch._foreach_mul(torch._foreach_sqrt(exp_avg_sq), roots)
    change = torch._foreach_div(exp_avg, torch._foreach_add(change, group["eps"]))
    change = torch._foreach_mul(change, sizes)
    decay = group["weight_decay"]
    if isinstance(decay, torch.Tensor) or decay != 0:
        decays = [_by_learner(rate * decay, of) for of in p]
        change = torch._foreach_add(change, torch._foreach_mul(p, decays))
    torch._foreach_sub_(p, change)


def _columns(table: torch.Tensor, places: Sequence[int], p: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """
    Read columns of a table that has one for each parameter, (P,) or (S, P), as views of memory, since Inductor inlines
    an index: it would then repeat the powers for every eight elements of each parameter.
    """
    table = table.contiguous()
    columns = [table.as_strided(table.shape[:-1], table.stride()[:-1], place) for place in places]
    return [_by_learner(column, of) for column, of in zip(columns, p, strict=True)]


def _by_learner(values: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """A number, or one for each of S learners, (S,), in the shape and type in which a parameter takes it."""
    values = values.to(p.dtype)
    return values.view(-1, *[1] * (p.dim() - 1)) if values.dim() == 1 else values


def _laid_out_like(p: torch.Tensor, grad: torch.Tensor) -> torch.Tensor:
    """The gradient in the parameter's memory layout, which the fused kernel assumes."""
    return grad if grad.stride() == p.stride() else torch.empty_like(p).copy_(grad)


def _adam(group: dict[str, Any], rate: Any, params: Any, grads: Any, m: Any, v: Any, steps: Any) -> None:
    """Adam's step for matching lists of tensors, in place, by one fused kernel."""
    beta1, beta2 = group["betas"]
    torch._fused_adam_(
        list(params), list(grads), list(m), list(v), [], list(steps),
        lr=rate, beta1=beta1, beta2=beta2, weight_decay=0.0, eps=group["eps"], amsgrad=False, maximize=False,
    )  # fmt: skip


def _cache_sized(rows: list[tuple[torch.Tensor, ...]]) -> Iterator[Iterable[tuple[torch.Tensor, ...]]]:
    """
    Cut rows of (parameter, gradient, moments, step) into groups of at most ``CHUNK`` parameters, given as columns.
    On a GPU there is one group.
    """
    if rows[0][0].is_cuda:
        yield zip(*rows, strict=True)
        return
    group: list[tuple[torch.Tensor, ...]] = []
    size = 0
    for *tensors, step in rows:
        whole = tensors[0].numel() <= CHUNK or not all(x.is_contiguous() for x in tensors)
        pieces = [tensors] if whole else zip(*(x.view(-1).split(CHUNK) for x in tensors), strict=True)
        for piece in pieces:
            if group and size + piece[0].numel() > CHUNK:
                yield zip(*group, strict=True)
                group, size = [], 0
            group.append((*piece, step))
            size += piece[0].numel()
    yield zip(*group, strict=True)


def gradients_of(loss: torch.Tensor, parameters: Sequence[torch.Tensor]) -> list[torch.Tensor | None]:
    """
    Gradients of a loss.

    :param loss: scalar
    :param parameters: what to derive by
    :return: the gradient for each parameter; None if it is frozen (``requires_grad`` is False), or the loss does not
        depend on it
    """
    trained = [p for p in parameters if p.requires_grad]
    found = iter(torch.autograd.grad(loss, trained, allow_unused=True) if trained else ())
    return [next(found) if p.requires_grad else None for p in parameters]


def sharpness_aware_gradients(
    loss: torch.Tensor,
    evaluate: Callable[[], torch.Tensor],
    parameters: Sequence[torch.Tensor],
    radius: float,
    n_copies: Sequence[int | None],
) -> list[torch.Tensor | None]:
    """
    Gradients of sharpness-aware minimisation (Foret et al. 2021, eq. 2 and 3): those of the loss at ``p + radius * g /
    |g|``, where g is the gradient at p. The parameters are afterwards as they were, bit for bit.

    Networks that are stacked along a leading axis are each moved by the radius, as if each stood alone.

    :param loss: the loss at p, a scalar with its graph
    :param evaluate: computes the loss anew
    :param parameters: parameters over which it is minimised
    :param radius: length of the step uphill
    :param n_copies: for each parameter, the number of networks stacked in its leading axis, or None if it is not
        stacked; those of the same number belong together
    :return: the gradient for each parameter; None for one that is frozen
    """
    gradients = gradients_of(loss, parameters)
    moved = [(p, g, copies) for p, g, copies in zip(parameters, gradients, n_copies, strict=True) if g is not None]
    if not moved:
        return gradients
    with torch.no_grad():
        squares: dict[int | None, torch.Tensor] = {}
        for _, gradient, copies in moved:
            flat = gradient.reshape(1 if copies is None else copies, -1)
            square = flat.square().sum(dim=1)
            squares[copies] = squares[copies] + square if copies in squares else square
        # The floor keeps a gradient of zero from being divided by zero.
        scales = {copies: radius / square.sqrt().clamp_min(1e-12) for copies, square in squares.items()}
        saved = [p.detach().clone() for p, _, _ in moved]
        for p, gradient, copies in moved:
            scale = scales[copies]
            p.add_(gradient * (scale[0] if copies is None else scale.view(-1, *[1] * (p.dim() - 1))))
    try:
        return gradients_of(evaluate(), parameters)
    finally:
        with torch.no_grad():
            torch._foreach_copy_([p for p, _, _ in moved], saved)
