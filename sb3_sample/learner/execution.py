"""
Execution of the gradient step: operation by operation, compiled by ``torch.compile``, or captured as a CUDA graph.

All three run the same function, ``Learner.gradient_step``, which is independent of them: it takes the batch and all the
noise as tensors, does not branch on the value of a tensor, and counts nothing outside of tensors.
"""

import re
import time
import types
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch

from sb3_sample.console import say
from sb3_sample.optim import AdamW

#: With ``compile="auto"``, gradient steps in one ``learn`` from which on compiling pays: it takes the time of some
#: thousand steps (docs/performance.md). A number of steps, not a measurement, so that a seed fixes the whole run.
PAYS_FROM = 20_000
#: The first torch that a gradient step is compiled with.
COMPILES_FROM = (2, 13)

Metrics = dict[str, torch.Tensor]
#: Runs a function without its effects taking place, and gives back what repeats them, and its result, whose tensors
#: each repetition fills anew.
Recorder = Callable[[Callable[[], Metrics]], tuple[Callable[[], None], Metrics]]


def _compilation_errors() -> tuple[type[Exception], ...]:
    """
    Errors of torch where it cannot compile: the first is raised where the tracing of gradients is switched off, the
    last where the same was compiled for too many settings. Imported when needed, since it takes a second.
    """
    from torch._dynamo.exc import FailOnRecompileLimitHit, TorchDynamoException, Unsupported
    from torch._inductor.exc import InductorError

    return Unsupported, TorchDynamoException, InductorError, FailOnRecompileLimitHit


def old_torch() -> str | None:
    """
    Check that this torch can compile a whole gradient step.

    :return: the reason, in words, if it is too old; None if it is not
    """
    if tuple(int(number) for number in re.findall(r"\d+", str(torch.__version__))[:2]) >= COMPILES_FROM:
        return None
    needed = ".".join(map(str, COMPILES_FROM))
    return f"that needs torch {needed} or newer, and this is {torch.__version__}. It is run eagerly, on a GPU captured"


#: Ways to ask for compiling (values of ``compile``) that have been answered with a torch that is too old.
_told: set[bool | str] = set()


def warn_not_compiled(learner: Any, reason: str) -> None:
    """
    Warn that the gradient step is not compiled. A torch that is too old is warned of once for each value of ``compile``
    in a process, since it concerns every model.

    :param learner: the learner
    :param reason: what keeps it from being compiled
    """
    if reason == old_torch():
        if learner.compile in _told:
            return
        _told.add(learner.compile)
    warnings.warn(f"The gradient step is not compiled: {reason}", stacklevel=3)


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
    Look for code from outside of this package that may not be fit to be compiled.

    :param learner: the learner
    :return: its parts, networks and gradient step from outside of this package without the declaration ``compilable =
        True``, as "argument=class": a number that changes at every step, for example, causes a compilation at every
        step
    """
    objects = {
        "exploration": learner.explorer,
        "pessimism": learner.pessimism_rule,
        "value_head": learner.head,
        "actor_network": learner.actor.trunk,
        "critic_network": learner.critic.trunk,
    }
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
    :param fall_back: whether what cannot be compiled is run uncompiled, with a warning, instead of an error
    :param recorder: what captures; a CUDA graph on a GPU, None elsewhere: no capture
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
        self.compiled, self.fall_back, self._method = compiled, fall_back, method
        #: Seconds spent on compiling, over all inputs and settings that the step was compiled for.
        self.seconds_compiling = 0.0
        self._step: Callable[..., Metrics] = getattr(type(learner), method)
        if compiled:
            # The compiler keeps what it made by the code object. With one for each model, models neither use each
            # other's nor reach the limit of compilations together.
            step: Any = self._step
            own = types.FunctionType(
                step.__code__.replace(), step.__globals__, step.__name__, step.__defaults__, step.__closure__
            )
            self._step = torch.compile(
                own, fullgraph=True, dynamic=False, options={"guard_filter_fn": _settings_and_inputs}
            )
        self._captured = None if recorder is None else Captured(recorder)
        self._modules = _modules(learner)

    def serves(self, learner: Any) -> bool:
        """
        Check that a compiled or captured step still belongs to the learner.

        :param learner: the learner
        :return: whether it still has the networks, parts, optimizers and loss that this was made for
        """
        return self._modules == _modules(learner)

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
        # Parts of one's own may look at values on the host: captured only when asked for.
        asked = learner.compile is True or (learner.compile == "auto" and not foreign_parts(learner))
        captures = learner.device.type == "cuda" and asked and not _foreign_optimizers(learner)
        return cls(learner, bool(learner.compiled), learner.compile == "auto", cuda_graph if captures else None, method)

    @property
    def leaves_gradients(self) -> bool:
        """Whether a gradient step that is not asked to be eager leaves its gradients in ``.grad``."""
        return not self.compiled and self._captured is None

    def prepare(self, learner: Any) -> None:
        """
        Prepare optimizers and captured steps; called last before the gradient steps that follow an environment step.

        :param learner: the learner
        """
        for optimizer in learner.optimizers().values():
            if isinstance(optimizer, AdamW):
                optimizer.capturable = self._captured is not None
                optimizer.prepare()
        if self._captured is not None:
            self._captured.forget_if_stale(learner)

    def __call__(self, learner: Any, *inputs: Any, eager: bool = False) -> Metrics:
        """
        Run one gradient step.

        :param learner: the learner
        :param inputs: the arguments of ``Learner.gradient_step``
        :param eager: neither compiled nor captured this time, which leaves the gradients in ``.grad``
        :return: its result; that of a captured step is valid until the next one
        """
        if eager:
            return getattr(type(learner), self._method)(learner, *inputs)  # type: ignore[no-any-return]
        if self._captured is not None:
            return self._captured(self._run, learner, inputs)
        return self._run(learner, *inputs)

    def _run(self, learner: Any, *inputs: Any) -> Metrics:
        if not self.compiled:
            return self._step(learner, *inputs)
        try:
            try:
                return self._step(learner, *inputs)
            except _compilation_errors()[0]:
                # Not compiled yet for these inputs or settings: to trace gradients needs a switch.
                return self._compile(learner, *inputs)
        except _compilation_errors() as error:
            # Raised before anything of the step has been run.
            reason = str(error).strip().splitlines()[0]
            if raised := re.search(r"raised exception (\w+\(.*\))", str(error)):
                reason = f"it raises {raised[1]}"
            if "RecompileLimit" in type(error).__name__:
                reason = "a setting that it reads changes again and again, and each change has it compiled anew"
            if not self.fall_back:
                if raised:
                    # Eagerly it is raised as it is, from its place.
                    getattr(type(learner), self._method)(learner, *inputs)
                raise RuntimeError(
                    f"compile=True, but the gradient step cannot be compiled: {reason}. Pass compile=False, or 'auto'"
                ) from error
            warnings.warn(f"The gradient step is not compiled, as it cannot be: {reason}", stacklevel=2)
            self.compiled = learner.compiled = False
            self._step = getattr(type(learner), self._method)
            return self._step(learner, *inputs)

    def _compile(self, learner: Any, *inputs: Any) -> Metrics:
        if learner.verbose >= 1:
            say("Compiling the gradient step ...")
        start = time.perf_counter()
        with torch._dynamo.config.patch(trace_autograd_ops=True):
            metrics = self._step(learner, *inputs)
        seconds = time.perf_counter() - start
        self.seconds_compiling += seconds
        if learner.verbose >= 1:
            say(f"Compiled in {seconds:.1f} s")
        return metrics


def _settings_and_inputs(guards: Sequence[Any]) -> list[bool]:
    """
    Select the conditions of a compiled step that are checked before each step.

    Most conditions are on parameters, modules and functions, and checking them takes as long as a small network's
    forward pass. :meth:`Execution.serves` checks them instead. A learning rate may change: it is read from a tensor.
    """
    settings = ("CONSTANT_MATCH", "EQUALS_MATCH", "GRAD_MODE", "GLOBAL_STATE", "DETERMINISTIC_ALGORITHMS")
    inputs = ("batch", "noise", "extra", "moves_targets", "moves_actor")

    def matters(guard: Any) -> bool:
        of_input = guard.name.removeprefix("L['").startswith(inputs)
        return of_input or (guard.guard_type in settings and not guard.name.endswith("['lr']"))

    return [matters(guard) for guard in guards]


def _tensors(inputs: Any) -> list[torch.Tensor]:
    """Tensors of nested tuples and dicts, in a fixed order."""
    if isinstance(inputs, torch.Tensor):
        return [inputs]
    values = inputs.values() if isinstance(inputs, dict) else inputs if isinstance(inputs, tuple) else ()
    return [tensor for value in values for tensor in _tensors(value)]


def _kind(inputs: Any) -> Any:
    """Structure and contents of nested tuples and dicts but the tensors' values; hashable."""
    if isinstance(inputs, torch.Tensor):
        return tuple(inputs.shape), inputs.dtype, inputs.device
    if isinstance(inputs, dict):
        return tuple((key, _kind(value)) for key, value in inputs.items())
    return tuple(map(_kind, inputs)) if isinstance(inputs, tuple) else inputs


def _like(inputs: Any, make: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """Copy of nested tuples and dicts with other tensors."""
    if isinstance(inputs, torch.Tensor):
        return make(inputs)
    if isinstance(inputs, dict):
        return {key: _like(value, make) for key, value in inputs.items()}
    if isinstance(inputs, tuple):
        values = [_like(value, make) for value in inputs]
        return type(inputs)(*values) if hasattr(inputs, "_fields") else tuple(values)
    return inputs


def cuda_graph(run: Callable[[], Metrics]) -> tuple[Callable[[], None], Metrics]:
    """
    Capture as a CUDA graph.

    :param run: what to capture
    :return: function that repeats it, and its result
    """
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        metrics = run()
    return graph.replay, metrics


class Captured:
    """
    Gradient steps captured once and then repeated: one launch instead of some thousand.

    A captured step reads and writes fixed places in memory. Its inputs are copied to theirs before each repetition;
    parameters, moments, step counts and learning rates are changed in place by all that changes them, resets included.
    If one of them moves to another place (loading, a reinitialised optimizer), or a number outside of tensors changes,
    :meth:`forget_if_stale` drops the captured steps, and they are captured anew.

    :param recorder: what captures
    """

    #: Steps of each kind that are run as they are before one is captured, as CUDA's libraries set themselves up.
    WARM_UP = 3

    def __init__(self, recorder: Recorder):
        self._recorder = recorder
        self._runs: dict[Any, int] = {}
        self._recorded: dict[Any, tuple[Any, Callable[[], None], Metrics]] = {}
        self._held: Any = None

    def forget_if_stale(self, learner: Any) -> None:
        """
        Drop the captured steps if the model has other tensors or other settings than at their capture.

        :param learner: the learner
        """
        now = _places(learner), _settings(learner)
        if now != self._held:
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
            return _aside(lambda: step(learner, *inputs)) if learner.device.type == "cuda" else step(learner, *inputs)
        if kind not in self._recorded:
            own = _like(inputs, torch.clone)
            self._recorded[kind] = (own, *self._recorder(lambda: step(learner, *own)))
        own, repeat, metrics = self._recorded[kind]
        torch._foreach_copy_(_tensors(own), _tensors(inputs))
        repeat()
        # The caller adds to what it is given.
        return dict(metrics)


def _aside(run: Callable[[], Metrics]) -> Metrics:
    """Run on a stream of its own, as CUDA requires of the last steps before a capture."""
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        metrics = run()
    torch.cuda.current_stream().wait_stream(stream)
    return metrics


def _modules(learner: Any) -> tuple[Any, ...]:
    """Identities of the objects that a compiled or captured step was made for."""
    critics = (learner.critic, learner.critic.trunk, learner.critic_target, learner.critic_target.trunk)
    networks = (learner.actor, learner.actor.trunk, *critics, learner.temperature)
    parts = (learner.explorer, learner.pessimism_rule, learner.objective, *learner.optimizers().values())
    groups = [len(group["params"]) for optimizer in learner.optimizers().values() for group in optimizer.param_groups]
    return (*map(id, (*networks, *parts, learner.head)), *groups)


def _places(learner: Any) -> tuple[int, ...]:
    """Addresses of all tensors that a gradient step reads or writes, without its inputs."""
    parts = (learner.explorer, learner.pessimism_rule, learner.objective)
    modules = (learner.networks, learner.head, learner.temperature, *parts)
    tensors = [t for module in modules for t in (*module.parameters(), *module.buffers())]
    for optimizer in learner.optimizers().values():
        tensors += [t for state in optimizer.state.values() for t in state.values() if isinstance(t, torch.Tensor)]
        if isinstance(optimizer, AdamW):
            tensors += optimizer.read_tensors()
    return tuple(t.data_ptr() for t in tensors)


#: Public numbers of a part or of the learner that are no settings: they move with the run, and the gradient step does
#: not read them.
NO_SETTINGS = {"arm", "training", "gradients_are_stale"}


def _settings(learner: Any) -> list[Any]:
    """Numbers and words that a gradient step may read: the learner's own, its modules' and its optimizers'."""

    def plain(values: Iterable[tuple[str, Any]]) -> dict[str, Any]:
        return {name: value for name, value in values if isinstance(value, (int, float, str, type(None)))}

    roots = (learner.networks, learner.head, learner.explorer, learner.pessimism_rule, learner.objective)
    modules = [module for root in roots for module in root.modules()]
    settings: list[Any] = []
    for owner in (learner, *modules):
        public = ((k, v) for k, v in vars(owner).items() if not k.startswith("_") and k not in NO_SETTINGS)
        settings.append(plain(public))
    for optimizer in learner.optimizers().values():
        for group in optimizer.param_groups:
            settings.append({k: v for k, v in group.items() if k not in ("params", "lr")})
    return settings
