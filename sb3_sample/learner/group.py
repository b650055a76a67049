"""
Many learners in one gradient step: their networks, moments and statistics are stacked along a leading axis S, and the
gradient step of one is mapped over it by ``torch.vmap``.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from typing import Any

import torch
from torch import nn

from sb3_sample.learner.batch import Batch
from sb3_sample.learner.descent import StackedDescent
from sb3_sample.learner.execution import (
    Acting,
    CapturedActing,
    Execution,
    Metrics,
    Settings,
    captures,
    cuda_graph,
    inputs_like,
    tensors_of,
    why_not_compiled,
)
from sb3_sample.learner.learner import Learner
from sb3_sample.lockstep import are_real
from sb3_sample.optim import AdamW
from sb3_sample.warn import warn

#: Numbers of a learner that its gradient step does not read, or reads from its inputs.
_NOT_READ = {"learning_starts", "verbose", "compile", "learning_rate"}
#: Optional parts of a learner (None if absent), which each learner uses by itself, around its gradient step.
_AROUND = {"redo", "reward_scaler", "schedule"}


class _Networks(nn.Module):
    """
    One module of all that a learner's gradient step reads and writes; it runs that step or another of its methods.

    :param learner: the learner
    """

    def __init__(self, learner: Learner):
        super().__init__()
        self.parts = nn.ModuleList(learner.step_modules())
        self._run = lambda method, inputs: getattr(type(learner), method)(learner, *inputs)

    def forward(self, method: str, inputs: tuple[Any, ...]) -> Metrics:
        result: Metrics = self._run(method, inputs)
        return result

    def tensors(self) -> dict[str, torch.Tensor]:
        """
        :return: parameters and buffers by name, each once
        """
        return {**dict(self.named_parameters()), **dict(self.named_buffers())}


class _Stacks(nn.Module):
    """Parameters and buffers of S learners, (S, ...) each, by the names that they have in each learner."""

    def __init__(self, tensors: dict[str, Sequence[torch.Tensor]]):
        super().__init__()
        self.names = {name: f"t{i}" for i, name in enumerate(tensors)}
        for name, of in tensors.items():
            stack = torch.stack([t.detach() for t in of])
            if isinstance(of[0], nn.Parameter):
                self.register_parameter(self.names[name], nn.Parameter(stack, requires_grad=of[0].requires_grad))
            else:
                self.register_buffer(self.names[name], stack)

    def by_name(self) -> dict[str, torch.Tensor]:
        """
        :return: the stacks by the names that their parts have in a learner
        """
        return {name: getattr(self, own) for name, own in self.names.items()}


class LearnerGroup:
    """
    S learners whose gradient steps and actions are computed as one. Each learner's tensors become its rows of the
    stacks, so that operations on a single learner (acting, resets, saving, loading in place) work as before.

    :param learners: learners of the same networks, parts and settings; learning rates and other numbers may differ
    :raises ValueError: if they differ in more, or cannot be stacked; the message names the reason
    """

    def __init__(self, learners: Sequence[Learner]):
        self.learners = list(learners)
        self._first = self.learners[0]
        self.device, self.verbose, self.compile = self._first.device, self._first.verbose, self._first.compile
        #: Whether the gradient step is compiled.
        self.compiled = bool(self._first.compiled)
        _check_alike(self.learners)
        self._networks = [_Networks(learner) for learner in self.learners]
        self._stacks = _Stacks(_by_name([networks.tensors() for networks in self._networks]))
        #: Optimizers of the stacked parameters, and those of each learner, by the optimizers' names.
        self._optimizers = self._stacked_optimizers()
        self._of_each: dict[str, list[Any]] = {
            path: [learner.optimizers()[path] for learner in self.learners] for path in self._optimizers
        }
        self._descent = StackedDescent(
            {id(self._first.optimizers()[name]): optimizer for name, optimizer in self._optimizers.items()},
            self._parameters_by_network(),
        )
        # Discount factors, one or (S,).
        self._discounts: float | torch.Tensor = 0.0
        #: Numbers that differ between learners: object of the first learner, attribute, (S,).
        self._differing: list[tuple[dict[str, Any], str, torch.Tensor]] = []
        # Cached, as numbers that differ between the inputs mostly stay the same, and a GPU waits for those of the host.
        self._row = functools.lru_cache(maxsize=8)(self._made_row)
        self._settings = [_settings_of(learner) for learner in self.learners]
        self._versions: list[int] = []
        #: Whether the learners' optimizers have taken different numbers of steps, as after a reset of one.
        self.counts_differ = False
        # Each learner's count of gradient steps at the last one taken here.
        self._n_updates: list[int] = []
        self._execution: Execution | None = None
        self._drawing: Execution | None = None
        self._acting: Acting | None = None
        stacks = self._stacks.by_name()
        self._take_settings()
        for s, networks in enumerate(self._networks):
            for name, tensor in networks.tensors().items():
                tensor.data = stacks[name].data[s]

    # ---------------------------------------------------------------- as an execution sees it

    def step_modules(self) -> tuple[nn.Module, ...]:
        """
        List the modules of the gradient step.

        :return: the one that holds the stacked tensors
        """
        return (self._stacks,)

    def identities(self) -> tuple[int, ...]:
        """
        Identify what the gradient step is made for.

        :return: the identities of each learner, one after the other
        """
        return tuple(number for learner in self.learners for number in learner.identities())

    def optimizers(self) -> dict[str, AdamW]:
        """
        List the optimizers of the stacked parameters.

        :return: the optimizers by the names of each learner's
        """
        return self._optimizers

    # ---------------------------------------------------------------- the step

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling the gradient step."""
        return sum(each.seconds_compiling for each in (self._execution, self._drawing) if each is not None)

    def step(self, inputs: Sequence[tuple[Any, ...]]) -> list[Metrics]:
        """
        Take one gradient step of each learner.

        :param inputs: the arguments of each learner's ``gradient_step`` or ``drawn_step``, in the learners' order
        :return: each learner's result, valid until the next step
        """
        self._prepare()
        if isinstance(inputs[0][0], Batch):
            self._execution = self._execution or self._made("mapped_step")
            execution = self._execution
        else:
            self._drawing = self._drawing or self._made("mapped_drawn_step")
            execution = self._drawing
        execution.prepare(self)
        return self._of_each_learner(execution(self, *_stacked(inputs, self._row)))

    def act(self, inputs: Sequence[tuple[Any, ...]]) -> list[Metrics]:
        """
        Compute the explorers' actions.

        :param inputs: the arguments of each learner's ``action_step``, in the learners' order
        :return: each learner's result, valid until the next call
        """
        self._take_changes()
        if self._acting is None:
            of_group = CapturedActing(self, "mapped_actions", cuda_graph) if captures(self, self._first) else None
            self._acting = of_group or (lambda group, stacked: group.mapped_actions(*stacked))
        # This may run in another thread than those that act.
        with torch.inference_mode():
            return self._of_each_learner(self._acting(self, _stacked(inputs, self._row)))

    def _of_each_learner(self, metrics: Metrics) -> list[Metrics]:
        rows = {name: values.unbind() for name, values in metrics.items()}
        return [{name: of[s] for name, of in rows.items()} for s in range(len(self.learners))]

    def release(self) -> None:
        """Give each learner its own tensors again. The group cannot be used any more."""
        for learner, networks in zip(self.learners, self._networks, strict=True):
            for tensor in networks.tensors().values():
                tensor.data = tensor.data.clone()
            for optimizer in learner.optimizers().values():
                for state in optimizer.state.values():
                    state.update({name: value.clone() for name, value in state.items()})
                # Its vectors are made anew from the state.
                optimizer.__setstate__(optimizer.__dict__)

    def _made_row(self, values: tuple[float, ...]) -> torch.Tensor:
        """One number for each learner, as a tensor, (S,)."""
        # Actions are computed in inference mode, whose tensors no gradient step can read.
        with torch.inference_mode(False):
            return torch.tensor(values, dtype=torch.float32, device=self.device)

    def _prepare(self) -> None:
        """Update the stacks with the changes of the learners since the last step."""
        optimizers = [optimizer for of_each in self._of_each.values() for optimizer in of_each]
        for optimizer in optimizers:
            optimizer.prepare()
        versions = [optimizer.version for optimizer in optimizers]
        n_updates = [learner.n_updates for learner in self.learners]
        is_next = n_updates in (self._n_updates, [n + 1 for n in self._n_updates])
        self._n_updates = n_updates
        if versions != self._versions:
            # Moments were cleared, or loaded.
            self._take_moments()
            self._versions = versions
            is_next = False
        if not is_next:
            # A learner has stepped alone. Only then, as the comparison waits for a GPU.
            self._compare_counts()
        self._take_rates()
        self._take_changes()

    def _take_changes(self) -> None:
        """Take over settings that were changed in the learners."""
        # Every learner is checked, even after a change was found: each check updates the values that it holds.
        changed = [settings.have_changed() for settings in self._settings]
        if any(changed):
            self._take_settings()
            self._execution = self._drawing = self._acting = None

    def _made(self, method: str) -> Execution:
        if self.compiled:
            reason = why_not_compiled(self)
            if reason is not None:
                warn(f"The gradient step is not compiled: {reason}")
                self.compiled = False
        recorder = cuda_graph if captures(self, self._first) else None
        return Execution(self, self.compiled, self.compile == "auto", recorder, method)

    def mapped_step(self, *inputs: Any) -> Metrics:
        """
        Compute the gradient step of all learners, on tensors only: this function is compiled or captured.

        :param inputs: the arguments of ``gradient_step``, tensors with an axis S in front
        :return: each learner's result, by name, (S, ...)
        """
        return self._mapped("gradient_step", inputs)

    def mapped_drawn_step(self, batch_size: int, n_further: int, moves_targets: bool, moves_actor: bool) -> Metrics:
        """
        Draw batches and compute the gradient step of all learners: this function is compiled or captured.

        :param batch_size: B, for each learner
        :param n_further: as in ``drawn_step``, for each learner
        :param moves_targets: as in ``gradient_step``
        :param moves_actor: as in ``gradient_step``
        :return: each learner's result, by name, (S, ...)
        """
        inputs = []
        for learner in self.learners:
            batch, noise, extra = learner.drawn_inputs(batch_size, n_further)
            if extra is not None:
                extra = extra._replace(batch=extra.batch._replace(discounts=None))
            inputs.append((batch._replace(discounts=None), noise, extra))
        batch, noise, extra = _stacked(inputs, self._row)
        batch = batch._replace(discounts=self._discounts)
        if extra is not None:
            extra = extra._replace(batch=extra.batch._replace(discounts=self._discounts))
        return self._mapped("gradient_step", (batch, noise, extra, moves_targets, moves_actor))

    def mapped_actions(self, *inputs: Any) -> Metrics:
        """
        Compute the actions of all learners, on tensors only: this function is captured.

        :param inputs: the arguments of ``action_step``, tensors with an axis S in front
        :return: each learner's result, by name, (S, ...)
        """
        return self._mapped("action_step", inputs)

    def _mapped(self, method: str, inputs: tuple[Any, ...]) -> Metrics:
        def one(stacks: dict[str, torch.Tensor], numbers: list[torch.Tensor], values: list[torch.Tensor]) -> Metrics:
            given = iter(values)
            with self._in_force(numbers):
                own = inputs_like(inputs, lambda _: next(given))
                result: Metrics = torch.func.functional_call(self._networks[0], stacks, (method, own))
                return result

        numbers = [number for _, _, number in self._differing]
        mapped: Callable[..., Metrics] = torch.vmap(one)
        try:
            return mapped(self._stacks.by_name(), numbers, tensors_of(inputs))
        except RuntimeError as error:
            # Of a network or part of one's own, perhaps, that needs a number where it finds a tensor.
            if numbers:
                names = sorted({name for _, name, _ in self._differing})
                error.add_note(f"in the step of learners that differ in {', '.join(names)}")
            raise

    @contextmanager
    def _in_force(self, numbers: Sequence[torch.Tensor]) -> Iterator[None]:
        """Make the first learner's step that of all learners."""
        before = [(values, name, values[name]) for values, name, _ in self._differing]
        first = vars(self._first)
        first.update(minimize=self._descent.minimize, follow=self._descent.follow)
        try:
            for (values, name, _), number in zip(self._differing, numbers, strict=True):
                values[name] = number
            yield
        finally:
            del first["minimize"], first["follow"]
            for values, name, value in before:
                values[name] = value

    # ---------------------------------------------------------------- what is stacked

    def _stacked_optimizers(self) -> dict[str, AdamW]:
        stacks = self._stacks.by_name()
        names = {id(tensor): name for name, tensor in self._networks[0].tensors().items()}
        made = {}
        for path, optimizer in self._first.optimizers().items():
            groups = [{**g, "params": [stacks[names[id(p)]] for p in g["params"]]} for g in optimizer.param_groups]
            made[path] = AdamW([{"params": group["params"]} for group in groups])
            for ours, theirs in zip(made[path].param_groups, groups, strict=True):
                ours.update({name: value for name, value in theirs.items() if name != "params"})
        return made

    def _parameters_by_network(self) -> dict[int, list[torch.Tensor]]:
        stacks = self._stacks.by_name()
        names = {id(tensor): name for name, tensor in self._networks[0].tensors().items()}
        modules = [module for part in self._first.step_modules() for module in part.modules()]
        return {id(module): [stacks[names[id(p)]] for p in module.parameters()] for module in modules}

    def _take_moments(self) -> None:
        """Make each learner's moments and counts of steps rows of stacks."""
        for path, stacked in self._optimizers.items():
            theirs = self._of_each[path]
            stacked.state.clear()
            stacked._steps = []
            for i, group in enumerate(stacked.param_groups):
                of_each = [optimizer.param_groups[i]["params"] for optimizer in theirs]
                counts = torch.stack([optimizer._steps[i] for optimizer in theirs])  # type: ignore[attr-defined]
                stacked._steps.append(counts)
                for j, p in enumerate(group["params"]):
                    for name in ("exp_avg", "exp_avg_sq"):
                        states = [o.state[params[j]] for o, params in zip(theirs, of_each, strict=True)]
                        stack = torch.stack([state[name] for state in states])
                        stacked.state[p][name] = stack
                        stacked.state[p]["step"] = counts[:, j]
                        for s, state in enumerate(states):
                            state[name] = stack[s]
                for s, (optimizer, params) in enumerate(zip(theirs, of_each, strict=True)):
                    optimizer._steps[i] = counts[s]  # type: ignore[attr-defined]
                    for j, p in enumerate(params):
                        optimizer.state[p]["step"] = counts[s, j]
            stacked._n_prepared = len(stacked.state)
            stacked.version += 1

    def _compare_counts(self) -> None:
        """Check whether the learners have equal counts of steps for each parameter, as Adam's step is then quicker."""
        counts = [steps for stacked in self._optimizers.values() for steps in stacked._steps]
        self.counts_differ = any(not torch.equal(steps, steps[:1].expand_as(steps)) for steps in counts)
        for stacked in self._optimizers.values():
            stacked.counts_differ = self.counts_differ

    def _take_rates(self) -> None:
        """Pass the learning rates on: one for all where they are the same, else one for each."""
        for path, stacked in self._optimizers.items():
            rates = [[g["lr"] for g in optimizer.param_groups] for optimizer in self._of_each[path]]
            same = all(of == rates[0] for of in rates)
            for i, group in enumerate(stacked.param_groups):
                group["lr"] = rates[0][i] if same else tuple(of[i] for of in rates)

    def _take_settings(self) -> None:
        """
        Find the numbers in which the learners differ, as tensors.

        :raises ValueError: if they differ in something else
        """
        self._differing = []
        self._descent.tau = self._first.tau
        # For batches that a step draws itself, where no tensor can come from the host.
        gammas = [learner.gamma for learner in self.learners]
        same = all(gamma == gammas[0] for gamma in gammas)
        self._discounts = gammas[0] if same else self._made_row(tuple(gammas))
        # The stacked optimizers' groups, by those of the first learner.
        groups = {
            id(theirs): ours
            for path, optimizer in self._optimizers.items()
            for ours, theirs in zip(optimizer.param_groups, self._of_each[path][0].param_groups, strict=True)
        }
        for rows in zip(*(settings.held for settings in self._settings), strict=True):
            values, name, first = rows[0]
            of_each = [value for _, _, value in rows]
            if any(other != name for _, other, _ in rows):
                raise ValueError(f"learners must have the same settings, and not each has {name}")
            if any(isinstance(value, torch.Tensor) for value in of_each):
                if not all(_are_equal(value, first) for value in of_each):
                    raise ValueError(f"learners must agree in {name} where each task has its own, not {of_each}")
                continue
            group = groups.get(id(values))
            differ = any(value != first for value in of_each)
            may_differ = group is None or name == "weight_decay"
            if differ and not (may_differ and are_real(of_each)):
                raise ValueError(f"learners must agree in {name}, not {of_each!r}")
            held = self._made_row(tuple(of_each)) if differ else first
            if group is not None:
                group[name] = held
            elif differ:
                self._differing.append((values, name, held))
                if values is vars(self._first) and name == "tau":
                    self._descent.tau = held


def _settings_of(learner: Learner) -> Settings:
    """The settings in which a learner's gradient step may differ from another's."""
    settings = Settings(learner, private=False)
    settings.held = [
        (values, name, value)
        for values, name, value in settings.held
        if name not in _NOT_READ and not (name in _AROUND and values is vars(learner))
    ]
    return settings


def _by_name(rows: Sequence[dict[str, torch.Tensor]]) -> dict[str, Sequence[torch.Tensor]]:
    return {name: [row[name] for row in rows] for name in rows[0]}


def _stacked(inputs: Sequence[tuple[Any, ...]], row: Callable[[tuple[float, ...]], torch.Tensor]) -> tuple[Any, ...]:
    """Inputs of S learners as one, tensors with an axis S in front; numbers that differ become a tensor (S,), a row."""

    def stack(values: Sequence[Any]) -> Any:
        first = values[0]
        if isinstance(first, torch.Tensor):
            return torch.stack(list(values))
        if isinstance(first, dict):
            return {key: stack([value[key] for value in values]) for key in first}
        if isinstance(first, tuple):
            fields = [stack(column) for column in zip(*values, strict=True)]
            return type(first)(*fields) if hasattr(first, "_fields") else tuple(fields)
        if all(value == first for value in values):
            return first
        if not are_real(values):
            raise ValueError(f"the learners' gradient steps must be of one kind, not {list(values)!r}")
        return row(tuple(values))

    result: tuple[Any, ...] = stack([tuple(each) for each in inputs])
    return result


def _check_alike(learners: Sequence[Learner]) -> None:
    """
    Check that learners can take their gradient steps as one.

    :param learners: the learners
    :raises ValueError: if they cannot, with the reason
    """
    first = learners[0]
    for learner in learners:
        if type(learner) is not type(first):
            raise ValueError(f"learners must be of one class, not {type(first).__name__} and {type(learner).__name__}")
        if learner.sam_radius is not None:
            raise ValueError(f"learners with sam_radius={learner.sam_radius!r} cannot be batched")
        foreign = {type(o).__name__ for o in learner.optimizers().values() if type(o) is not AdamW}
        if foreign:
            raise ValueError(f"learners with optimizers other than sb3_sample.optim.AdamW cannot be batched: {foreign}")
        for ours, theirs in zip_longest(_classes(first), _classes(learner)):
            if ours is not theirs:
                names = [None if cls is None else cls.__name__ for cls in (ours, theirs)]
                raise ValueError(f"learners must have parts and networks of the same classes, not {names}")
        if _shapes(learner) != _shapes(first):
            raise ValueError("learners must have networks of the same shapes")
        if _trained(learner) != _trained(first):
            raise ValueError("learners must have the same parameters frozen")
        noisy = [m for part in learner.step_modules() for m in part.modules() if isinstance(m, nn.Dropout) and m.p > 0]
        if noisy:
            raise ValueError("learners whose networks have dropout cannot be batched: their noise is not given")


def _classes(learner: Learner) -> list[type[nn.Module]]:
    return [type(module) for part in learner.step_modules() for module in part.modules()]


def _are_equal(ours: Any, theirs: Any) -> bool:
    return all(isinstance(value, torch.Tensor) for value in (ours, theirs)) and torch.equal(ours, theirs)


def _trained(learner: Learner) -> list[bool]:
    return [p.requires_grad for part in learner.step_modules() for p in part.parameters()]


def _shapes(learner: Learner) -> list[torch.Size]:
    return [t.shape for part in learner.step_modules() for t in (*part.parameters(), *part.buffers())]
