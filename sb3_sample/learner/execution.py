"""
Execution of the gradient step: operation by operation, compiled by Inductor, or captured as a CUDA graph.

All three run the same function, ``Learner.gradient_step``, which is independent of them: it takes the batch and all the
noise as tensors, does not branch on the value of a tensor, and counts nothing outside of tensors.
"""

import functools
import operator
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import torch

from sb3_sample.console import say
from sb3_sample.learner.exploration import Exploration
from sb3_sample.optim import AdamW
from sb3_sample.tracing import compile_graph, trace, undone
from sb3_sample.warn import warn

#: With ``compile="auto"``, gradient steps in one ``learn`` from which compiling pays: compiling takes the time of some
#: thousand steps (docs/performance.md). A fixed number, not a measurement, so that a seed determines the whole run.
PAYS_FROM = 20_000
#: The same of gradient steps on images on a CPU, each of which takes tens of times as long.
PAYS_FROM_IMAGES = 2_000
#: The oldest torch with which a gradient step is compiled.
COMPILES_FROM = (2, 11)

Metrics = dict[str, torch.Tensor]
#: Runs a function without its effects taking place. Returns a function that repeats it with its effects, and its
#: result, whose tensors each repetition fills anew.
Recorder = Callable[[Callable[[], Metrics]], tuple[Callable[[], None], Metrics]]


def old_torch() -> str | None:
    """
    Check that this torch can compile a whole gradient step.

    :return: the reason, in words, if it is too old; None if it is not
    """
    if tuple(int(number) for number in re.findall(r"\d+", str(torch.__version__))[:2]) >= COMPILES_FROM:
        return None
    needed = ".".join(map(str, COMPILES_FROM))
    return f"that needs torch {needed} or newer, and this is {torch.__version__}. It is run eagerly, on a GPU captured"


#: Values of ``compile`` for which a warning of a torch that is too old has been given.
_told: set[bool | str] = set()


def warn_not_compiled(learner: Any, reason: str) -> None:
    """
    Warn that the gradient step is not compiled. The warning of a torch that is too old comes once for each value of
    ``compile`` in a process, since it concerns every model.

    :param learner: the learner
    :param reason: what keeps it from being compiled
    """
    if reason == old_torch():
        if learner.compile in _told:
            return
        _told.add(learner.compile)
    warn(f"The gradient step is not compiled: {reason}")


def why_not_compiled(learner: Any) -> str | None:
    """
    Check whether the gradient step can be compiled here.

    :param learner: the learner
    :return: what keeps its gradient step from being compiled here; None if nothing does
    """
    foreign = _foreign_optimizers(learner)
    if foreign:
        return f"it knows the steps of sb3_sample.optim.AdamW only, not of {foreign}"
    if learner.device.type not in ("cpu", "cuda"):
        return f"it is not supported on the device {str(learner.device)!r}"
    old = old_torch()
    if old is not None:
        return old
    if learner.device.type == "cpu":
        moved = [p for each in learner.optimizers().values() for group in each.param_groups for p in group["params"]]
        if any(p.dim() == 0 and p.dtype is torch.float64 for p in moved):
            return "torch's compiled code loses changes of float64 numbers without axes on a CPU"
        from torch._inductor.cpp_builder import get_cpp_compiler
        from torch._inductor.exc import InvalidCxxCompiler

        try:
            get_cpp_compiler()
        except InvalidCxxCompiler:
            return "there is no C++ compiler (install g++ or clang, or name one in the environment variable CXX)"
    else:
        from torch.utils._triton import has_triton

        if not has_triton():
            return "there is no Triton for this GPU"
    return None


def foreign_parts(learner: Any) -> list[str]:
    """
    Look for code from outside of this package that may be unfit for compiling.

    :param learner: the learner
    :return: its parts, networks and gradient step from outside of this package without the declaration ``compilable =
        True``, as "argument=class": a number in them that changes at every step, for example, causes a compilation at
        every step
    """
    objects = learner.exchangeable()
    if not _is_ours(type(learner).gradient_step):
        objects["learner_class"] = learner
    return [f"{name}={type(one).__name__}" for name, one in objects.items() if not _is_compilable(type(one))]


def _is_ours(thing: Any) -> bool:
    return bool(thing.__module__.split(".")[0] == __name__.split(".")[0])


def _is_compilable(cls: type) -> bool:
    """Whether a class is of this package, or declared ``compilable`` by itself or its nearest base from outside."""
    if _is_ours(cls):
        return True
    said = [vars(base)["compilable"] for base in cls.__mro__ if not _is_ours(base) and "compilable" in vars(base)]
    return bool(said and said[0])


def _foreign_optimizers(learner: Any) -> str:
    return ", ".join(sorted({type(o).__name__ for o in learner.optimizers().values() if type(o) is not AdamW}))


class Execution:
    """
    Runner of the gradient steps of one model.

    :param learner: the learner, its networks and parts built
    :param compiled: whether to compile
    :param fall_back: whether a step that cannot be compiled runs uncompiled, with a warning, instead of raising
    :param recorder: captures the step, as a CUDA graph on a GPU; None, elsewhere: no capture
    :param method: name of the learner's method that is run
    """

    def __init__(
        self,
        learner: Any,
        compiled: bool,
        fall_back: bool,
        recorder: Recorder | None = None,
        method: str = "gradient_step",
    ):
        self.fall_back = fall_back
        self._step: Callable[..., Metrics] = getattr(type(learner), method)
        self._compiled = Compiled(learner) if compiled else None
        self._captured = None if recorder is None else Captured(learner, recorder)
        self._modules = learner.identities()
        self._optimizers = [o for o in learner.optimizers().values() if isinstance(o, AdamW)]

    @property
    def compiled(self) -> bool:
        """Whether the gradient step is compiled."""
        return self._compiled is not None

    @property
    def seconds_compiling(self) -> float:
        """Seconds spent on compiling, over all inputs and settings that the step was compiled for."""
        return 0.0 if self._compiled is None else self._compiled.seconds

    def serves(self, learner: Any) -> bool:
        """
        Check that a compiled or captured step still belongs to the learner.

        :param learner: the learner
        :return: whether it still has the networks, parts, optimizers and loss that this was made for
        """
        return self._modules == learner.identities()

    @classmethod
    def of(cls, learner: Any, method: str = "gradient_step") -> "Execution":
        """
        Choose how the gradient steps are run.

        :param learner: a learner whose ``compiled`` is decided
        :param method: name of the learner's method that is run
        :return: what runs its gradient steps
        """
        if learner.compiled:
            reason = why_not_compiled(learner)
            if reason is not None:
                warn_not_compiled(learner, reason)
                learner.compiled = False
        recorder = cuda_graph if captures(learner) and not _foreign_optimizers(learner) else None
        return cls(learner, bool(learner.compiled), learner.compile == "auto", recorder, method)

    @property
    def leaves_gradients(self) -> bool:
        """Whether a gradient step that is run without ``eager`` leaves its gradients in ``.grad``."""
        return not self.compiled and self._captured is None

    def prepare(self, learner: Any) -> None:
        """
        Prepare optimizers and captured steps; called last before the gradient steps that follow an environment step.

        :param learner: the learner
        """
        for optimizer in self._optimizers:
            optimizer.capturable = self._captured is not None
            optimizer.prepare()
        if self._compiled is not None:
            self._compiled.prepare(learner)
        if self._captured is not None:
            self._captured.forget_if_stale(learner, None if self._compiled is None else self._compiled.version)

    def __call__(self, learner: Any, *inputs: Any, eager: bool = False) -> Metrics:
        """
        Run one gradient step.

        :param learner: the learner
        :param inputs: the arguments of ``Learner.gradient_step``
        :param eager: run this step neither compiled nor captured, which leaves the gradients in ``.grad``
        :return: its result; that of a captured step is valid until the next one
        """
        if eager:
            return self._step(learner, *inputs)
        if self._captured is not None:
            return self._captured(self._run, learner, inputs)
        return self._run(learner, *inputs)

    def _run(self, learner: Any, *inputs: Any) -> Metrics:
        if self._compiled is None:
            return self._step(learner, *inputs)
        try:
            return self._compiled(self._step, learner, inputs)
        except CannotCompile as error:
            # Raised before any effect of the step.
            if not self.fall_back:
                raise RuntimeError(
                    f"compile=True, but the gradient step cannot be compiled: {error}. Pass compile=False, or 'auto'"
                ) from error
            warn(f"The gradient step is not compiled, as it cannot be: {error}")
            self._compiled, learner.compiled = None, False
            return self._step(learner, *inputs)


#: Computes the actions of a training: takes the learner and the arguments of ``Learner.action_step``.
Acting = Callable[[Any, tuple[Any, ...]], Metrics]


def acting_of(learner: Any) -> Acting | None:
    """
    Choose how actions of the training are computed.

    :param learner: the learner
    :return: captured computation of the actions; None where they are computed without capture: on a CPU, and for an
        explorer that overrides ``act``
    """
    if type(learner.explorer).act is not Exploration.act or not captures(learner):
        return None
    return CapturedActing(learner, "action_step", cuda_graph)


def captures(learner: Any, of: Any = None) -> bool:
    """
    Decide whether the computations of a learner are captured.

    :param learner: the learner, or a group of learners
    :param of: learner whose parts count; None: ``learner`` itself
    :return: True on a GPU, unless capture is declined or custom parts may read values on the host
    """
    if learner.device.type != "cuda":
        return False
    return learner.compile is True or (learner.compile == "auto" and not foreign_parts(of or learner))


class CannotCompile(Exception):
    """Error of a gradient step that can be run but not compiled."""


class _Program(NamedTuple):
    """A compiled gradient step, for one kind of inputs."""

    #: Code of the trace, and the tensors that it reads besides the state.
    code: str
    further: list[torch.Tensor]
    function: Callable[..., Sequence[torch.Tensor]]
    #: Names of its results.
    names: list[str]


class Compiled:
    """
    Compiled gradient steps of a learner, one for each kind of inputs.

    A compiled step contains all numbers and strings that it read when it was traced, as constants. If one that it may
    have read changes, the step is traced again, in about a second, and compiled again if the trace differs. Parameters,
    moments, counts of steps and learning rates are tensors, which are passed to it.

    :param learner: the learner
    """

    #: Largest number of programs; more mean that a setting changes all the time.
    MAX_PROGRAMS = 8

    def __init__(self, learner: Any):
        #: Seconds spent on tracing and compiling.
        self.seconds = 0.0
        #: Number of changes of settings found so far.
        self.version = 0
        self._programs: dict[Any, tuple[int, _Program]] = {}
        self._n_made = 0
        self._tensors = _Tensors(learner)
        self._settings = Settings(learner, private=True)

    def prepare(self, learner: Any) -> None:
        """
        Look for changed settings and new tensors.

        :param learner: the learner
        """
        self._tensors.renew()
        if self._settings.have_changed():
            self.version += 1

    def __call__(self, step: Callable[..., Metrics], learner: Any, inputs: tuple[Any, ...]) -> Metrics:
        """
        Run one gradient step, compiled for its kind of inputs and for the settings in force.

        :param step: the step
        :param learner: its first argument
        :param inputs: its other arguments
        :return: its result
        :raises CannotCompile: if it cannot be compiled; nothing has taken effect
        """
        kind = _kind(inputs)
        version, program = self._programs.get(kind, (-1, None))
        if program is None or version != self.version:
            program = self._made(step, learner, inputs, program)
            self._programs[kind] = self.version, program
            if all(version == self.version for version, _ in self._programs.values()):
                self._settings.did_not_change_the_step()
        with torch.no_grad():
            given = (x.contiguous() for x in tensors_of(inputs))
            results = program.function(*self._tensors.all, *program.further, *given)
        return dict(zip(program.names, results, strict=True))

    def _made(
        self, step: Callable[..., Metrics], learner: Any, inputs: tuple[Any, ...], old: _Program | None
    ) -> _Program:
        """A program for the inputs: the old one if a new one would be the same."""
        start = time.perf_counter()
        own = inputs_like(inputs, lambda x: x.clone(memory_format=torch.contiguous_format))
        names: list[str] = []

        def run(*tensors: torch.Tensor) -> list[torch.Tensor]:
            given = iter(tensors)
            metrics = step(learner, *inputs_like(own, lambda _: next(given)))
            names[:] = metrics
            return list(metrics.values())

        further: list[torch.Tensor] = []
        try:
            graph = trace(run, self._tensors.all, tensors_of(own))
            # Tensors that are neither state nor input become inputs, so that their current values are read.
            further = [getattr(graph, str(node.target)) for node in graph.graph.nodes if node.op == "get_attr"]
            if further:
                graph = trace(run, [*self._tensors.all, *further], tensors_of(own))
        except Exception as error:
            # An error of the step itself is raised unchanged, from where it occurs.
            with undone(self._tensors.all, learner.device):
                step(learner, *inputs)
            raise CannotCompile(str(error).strip().splitlines()[0]) from error
        if old is not None and graph.code == old.code and _are_same(further, old.further):
            return old
        self._settings.changed_the_step()
        self._n_made += 1
        if self._n_made > self.MAX_PROGRAMS:
            raise CannotCompile("a setting that it reads changes again and again, and each change has it compiled anew")
        if learner.verbose >= 1:
            say("Compiling the gradient step ...")
        code = graph.code
        try:
            with torch.no_grad():
                function = compile_graph(graph, [*self._tensors.all, *further, *tensors_of(own)])
        except Exception as error:
            raise CannotCompile(f"{type(error).__name__}: {error}".strip().splitlines()[0]) from error
        self.seconds += time.perf_counter() - start
        if learner.verbose >= 1:
            say(f"Compiled in {time.perf_counter() - start:.1f} s")
        return _Program(code, further, function, names)


def _are_same(ours: Sequence[torch.Tensor], theirs: Sequence[torch.Tensor]) -> bool:
    return len(ours) == len(theirs) and all(a is b for a, b in zip(ours, theirs, strict=True))


def tensors_of(inputs: Any) -> list[torch.Tensor]:
    """
    List the tensors of nested tuples and dicts.

    :param inputs: the tuples and dicts
    :return: their tensors, in a fixed order
    """
    if isinstance(inputs, torch.Tensor):
        return [inputs]
    values = inputs.values() if isinstance(inputs, dict) else inputs if isinstance(inputs, tuple) else ()
    return [tensor for value in values for tensor in tensors_of(value)]


def _kind(inputs: Any) -> Any:
    """Structure and contents of nested tuples and dicts, without the tensors' values; hashable."""
    if isinstance(inputs, torch.Tensor):
        return tuple(inputs.shape), inputs.dtype, inputs.device
    if isinstance(inputs, dict):
        return tuple((key, _kind(value)) for key, value in inputs.items())
    return tuple(map(_kind, inputs)) if isinstance(inputs, tuple) else inputs


def inputs_like(inputs: Any, make: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """
    Copy nested tuples and dicts with other tensors.

    :param inputs: the tuples and dicts
    :param make: makes the new tensor from each, in the order of :func:`tensors_of`
    :return: the same with the new tensors
    """
    if isinstance(inputs, torch.Tensor):
        return make(inputs)
    if isinstance(inputs, dict):
        return {key: inputs_like(value, make) for key, value in inputs.items()}
    if isinstance(inputs, tuple):
        values = [inputs_like(value, make) for value in inputs]
        return type(inputs)(*values) if hasattr(inputs, "_fields") else tuple(values)
    return inputs


#: Held during a capture, when no other thread may use the GPU, and by any thread that uses the GPU beside a training.
CAPTURING = threading.Lock()


def cuda_graph(run: Callable[[], Metrics]) -> tuple[Callable[[], None], Metrics]:
    """
    Capture as a CUDA graph.

    :param run: function to capture, on the current device
    :return: function that repeats it, and its result
    """
    graph = torch.cuda.CUDAGraph()
    with CAPTURING, torch.cuda.graph(graph, stream=_capture_stream(torch.cuda.current_device())):
        metrics = run()
    return graph.replay, metrics


@functools.cache
def _capture_stream(device: int) -> torch.cuda.Stream:
    """Stream of a GPU's captures. torch's own capture stream belongs to the GPU of the process's first capture."""
    return torch.cuda.Stream(device)


def _current(device: torch.device) -> AbstractContextManager[Any]:
    """Make a GPU the current one, to which streams and captures belong: a capture of another GPU's work is empty."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


class Captured:
    """
    Gradient steps captured once and then repeated: one launch instead of some thousand.

    A captured step reads and writes fixed places in memory. Its inputs are copied there before each repetition;
    parameters, moments, step counts and learning rates always change in place, in resets too. If one of them moves to
    another place (loading, a reinitialised optimizer), or a number outside of tensors changes, :meth:`forget_if_stale`
    drops the captured steps, and they are captured anew.

    :param learner: the learner
    :param recorder: captures a step
    :param optimizers: whether the captured function reads the optimizers' tensors
    """

    #: Steps of each kind that run uncaptured before one is captured, while CUDA's libraries initialise.
    WARM_UP = 3

    def __init__(self, learner: Any, recorder: Recorder, optimizers: bool = True):
        self._recorder = recorder
        self._tensors = _Tensors(learner, optimizers)
        self._settings = Settings(learner, private=False)
        self._runs: dict[Any, int] = {}
        self._recorded: dict[Any, tuple[Any, Callable[[], None], Metrics]] = {}
        self._held: Any = None

    def forget_if_stale(self, learner: Any, program: int | None = None) -> None:
        """
        Drop the captured steps if the model has other tensors or other settings than at their capture.

        :param learner: the learner
        :param program: version of the compiled steps that are captured, if they are compiled
        """
        self._tensors.renew()
        now = [program, *(t.data_ptr() for t in self._tensors.all)]
        if self._settings.have_changed() or now != self._held:
            if self._held is not None and self._held[0] != program:
                # The next steps are traced and compiled, which is never done within a capture.
                self._runs.clear()
            self._recorded.clear()
            self._held = now

    def __call__(self, step: Callable[..., Metrics], learner: Any, inputs: tuple[Any, ...]) -> Metrics:
        """
        Run one gradient step: the captured one of its kind if there is one.

        :param step: the step
        :param learner: its first argument
        :param inputs: its other arguments
        :return: its result, valid until the next step
        """
        kind = _kind(inputs)
        runs = self._runs[kind] = self._runs.get(kind, 0) + 1
        if runs <= self.WARM_UP:
            if learner.device.type != "cuda":
                return step(learner, *inputs)
            with _current(learner.device):
                return _aside(lambda: step(learner, *inputs))
        if kind not in self._recorded:
            own = inputs_like(inputs, torch.clone)
            with _current(learner.device):
                self._recorded[kind] = (own, *self._recorder(lambda: step(learner, *own)))
        own, repeat, metrics = self._recorded[kind]
        if given := tensors_of(inputs):
            torch._foreach_copy_(tensors_of(own), given)
        repeat()
        # The caller adds entries to the dict.
        return dict(metrics)


def _aside(run: Callable[[], Metrics]) -> Metrics:
    """Run on a separate stream, as CUDA requires of the last steps before a capture."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        metrics = run()
    torch.cuda.current_stream().wait_stream(stream)
    return metrics


class CapturedActing:
    """
    Computation of actions, captured like gradient steps.

    :param learner: the learner, or a group of learners
    :param method: name of the method that computes the actions
    :param recorder: captures a step
    """

    def __init__(self, learner: Any, method: str, recorder: Recorder):
        self.captured, self._step = Captured(learner, recorder, optimizers=False), getattr(type(learner), method)

    def __call__(self, learner: Any, inputs: tuple[Any, ...]) -> Metrics:
        """
        Compute actions.

        :param learner: the learner, or the group
        :param inputs: the method's arguments
        :return: its result, valid until the next call
        """
        self.captured.forget_if_stale(learner)
        return self.captured(self._step, learner, inputs)


class _Tensors:
    """
    Tensors that a gradient step reads or writes besides its inputs, each once: parameters and buffers, moments, counts
    of steps and learning rates.

    :param learner: the learner
    :param optimizers: whether its optimizers' tensors are included
    """

    def __init__(self, learner: Any, optimizers: bool = True):
        tensors = (t for module in learner.step_modules() for t in (*module.parameters(), *module.buffers()))
        self._of_modules = list({id(t): t for t in tensors}.values())
        self._optimizers = list(learner.optimizers().values()) if optimizers else []
        self._versions: list[Any] = []
        #: The tensors.
        self.all: list[torch.Tensor] = self._of_modules

    def renew(self) -> None:
        """Look for tensors that optimizers have made since the last call."""
        versions = [(getattr(o, "version", None), len(o.state)) for o in self._optimizers]
        rates = [getattr(o, "_rates", None) for o in self._optimizers]
        if self._versions and versions == self._versions[0] and all(map(operator.is_, rates, self._versions[1])):
            return
        self._versions = [versions, rates]
        self.all = list(self._of_modules)
        for optimizer in self._optimizers:
            # An AdamW's counts of steps are elements of one vector, which is added after them.
            own = isinstance(optimizer, AdamW)
            for state in optimizer.state.values():
                tensors = {k: t for k, t in state.items() if isinstance(t, torch.Tensor) and not (own and k == "step")}
                self.all += tensors.values()
            if own:
                self.all += optimizer.read_tensors()


#: Public numbers of a part or of the learner that are not settings: they change during the run, and the gradient step
#: does not read them.
NO_SETTINGS = {"arm", "training", "gradients_are_stale"}


class Settings:
    """
    Numbers and strings that a gradient step may read: the learner's own, its modules' and its optimizers'; and the
    learner's own tensors, in whose place a number may be set.

    :param learner: the learner
    :param private: whether private attributes of classes from outside of this package count too; settings of this
        package's own classes have public names
    """

    def __init__(self, learner: Any, private: bool):
        modules = [module for root in learner.step_modules() for module in root.modules()]
        # A view in evaluation mode shares its owner's tensors, and has its numbers for itself.
        views = [view for module in modules if isinstance(view := getattr(module, "at_rest", None), torch.nn.Module)]
        modules += [module for view in views for module in view.modules()]
        #: Attributes of the owner, or an optimizer's group; name; value at the last call of :meth:`have_changed`.
        self.held: list[tuple[dict[str, Any], str, Any]] = []
        for owner in (learner, *modules):
            of_torch = type(owner).__module__.split(".")[0] == "torch"
            every = private and not of_torch and not _is_ours(type(owner))
            for name, value in vars(owner).items():
                is_held = isinstance(value, (int, float, str, type(None)))
                is_held |= owner is learner and isinstance(value, torch.Tensor)
                if is_held and (every or not name.startswith("_")) and name not in NO_SETTINGS:
                    self.held.append((vars(owner), name, value))
        for optimizer in learner.optimizers().values():
            for group in optimizer.param_groups:
                self.held += [(group, name, value) for name, value in group.items() if name not in ("params", "lr")]
        #: Indices of settings whose change left the step the same.
        self._unread: set[int] = set()
        self._changed: set[int] = set()

    def have_changed(self) -> bool:
        """
        :return: whether a setting that the step may read has another value than at the last call
        """
        changed = [
            (i, values[name])
            for i, (values, name, value) in enumerate(self.held)
            if _has_changed(value, values.get(name))
        ]
        for i, value in changed:
            self.held[i] = (*self.held[i][:2], value)
        self._changed.update({i for i, _ in changed} - self._unread)
        return any(i not in self._unread for i, _ in changed)

    def changed_the_step(self) -> None:
        """Record that the changes so far made another step."""
        self._changed, self._unread = set(), set()

    def did_not_change_the_step(self) -> None:
        """Record that the changes since the last call of :meth:`changed_the_step` left the step the same."""
        self._unread |= self._changed
        self._changed = set()


def _has_changed(before: Any, now: Any) -> bool:
    """
    Compare a setting with what it was. A tensor in the place of a number, or of another tensor, is a change, whatever
    the values; one that changes in place is read there by compiled and captured steps.
    """
    if now is before:
        return False
    if isinstance(before, torch.Tensor) or isinstance(now, torch.Tensor):
        return True
    return bool(now != before)
