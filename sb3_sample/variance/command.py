"""``sb3-sample variance``: the variance of a policy's gradient and ways to lower it, as tables and a picture."""

import argparse
import ast
import dataclasses
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_sample.envs import make_env
from sb3_sample.envs.states import check_restorable
from sb3_sample.exits import refuse
from sb3_sample.extras import needing_matplotlib
from sb3_sample.ppo import MBMAPPO, MBPOPPO, QMAPPO
from sb3_sample.saving import load_vec_normalize
from sb3_sample.saving.classes import path_of
from sb3_sample.saving.container import PickledFile
from sb3_sample.saving.model import SafeFiles, class_of
from sb3_sample.variance.bias import GradientSamples, check_spaces, compare_gradients
from sb3_sample.variance.decomposition import Components, at_equal_cost, relative_cost
from sb3_sample.variance.estimate import Estimate, Interval, check_arguments, check_counts, estimate_components
from sb3_sample.variance.returns import Agent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {
    "ppo": PPO,
    "a2c": A2C,
    "mbma_ppo": MBMAPPO,
    "qma_ppo": QMAPPO,
    "mbpo_ppo": MBPOPPO,
}
#: Training steps of a model if none is given.
TRAIN_STEPS = 10_240
#: States of each gradient whose bias is measured.
BIAS_STEPS = 2_048
#: Largest number of actions in the comparison at equal cost.
MAX_ACTIONS = 16


@dataclasses.dataclass(frozen=True)
class Question:
    """
    Trajectory and costs for which the variance is evaluated.

    :param n_steps: T, states of the trajectory
    :param n_actions: N, actions at each of them
    :param action_cost: cost of an additional action at a state, in units of the cost of a state with one action
    """

    n_steps: int
    n_actions: int
    action_cost: float

    @property
    def delta(self) -> float:
        """Lemma 3.2's relative cost."""
        return relative_cost(self.action_cost, self.n_actions)

    def gain_of_action(self, c: Components) -> np.ndarray:
        """Lemma 3.2's Delta_N."""
        return c.gain_of_action(self.n_steps, self.n_actions)

    def gain_of_steps(self, c: Components) -> np.ndarray:
        """Lemma 3.2's Delta_T."""
        return c.gain_of_steps(self.n_steps, self.delta, self.n_actions)

    def margin(self, c: Components) -> np.ndarray:
        """How much more an additional action lowers the variance than a longer trajectory of the same cost."""
        return self.gain_of_steps(c) - self.gain_of_action(c)


def verdict(estimate: Estimate, question: Question, confidence: float = 0.95) -> str:
    """
    :param estimate: estimated components
    :param question: for which T, N and cost
    :param confidence: of the interval that has to lie on one side of 0
    :return: "actions" (one more lowers the variance more), "steps" (a longer trajectory does) or "undecided"
    """
    margin = estimate.interval(question.margin, confidence)
    return "actions" if margin.low > 0 else "steps" if margin.high < 0 else "undecided"


# ---------------------------------------------------------------- tables


def format_components(estimate: Estimate, question: Question, confidence: float = 0.95) -> str:
    """
    :param estimate: estimated components
    :param question: for which T, N and cost
    :param confidence: of the intervals
    :return: Markdown table of the components (T times the variance, equation 6), the changes and the two sides of
        equation 14
    """
    t, n = question.n_steps, question.n_actions
    point = estimate.components
    total = point.variance(t, 1) * t
    components: list[tuple[str, Callable[[Components], np.ndarray]]] = [
        ("variance over states, Var_s", lambda c: c.marginal_variance),
        ("its covariances, 2 sum (T-t)/T Cov", lambda c: c.marginal_covariance_sum(t)),
        ("**marginalized-policy variance**", lambda c: c.marginalized_policy_variance(t)),
        ("variance over actions, E_s Var_a", lambda c: c.policy_variance),
        ("its covariances, 2 sum (T-t)/T E_s Cov", lambda c: c.policy_covariance_sum(t)),
        ("**policy-dependent variance**", lambda c: c.policy_dependent_variance(t)),
    ]
    percent = f"{100 * confidence:g} %"
    lines = [
        f"| component | estimate | {percent} interval | per parameter | share |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name, quantity in components:
        interval = estimate.interval(quantity, confidence)
        lines.append(
            f"| {name} | {interval.value:.4g} | {_range(interval)} | {interval.value / estimate.n_parameters:.3g} "
            f"| {100 * interval.value / total:.0f} % |"
        )
    sides = [partial(_side, question=question, index=index) for index in (0, 1)]
    rows: list[tuple[str, Callable[[Components], np.ndarray]]] = [
        (f"variance V of T = {t}, N = {n}", lambda c: c.variance(t, n)),
        (f"Delta_N, N = {n} to {n + 1}", question.gain_of_action),
        (f"Delta_T, T = {t} to {t * (1 + question.delta):g} (delta = {question.delta:.3g})", question.gain_of_steps),
        ("Delta_T - Delta_N, above 0: one more action", question.margin),
        ("equation 14, left side", sides[0]),
        ("equation 14, right side", sides[1]),
    ]
    lines += ["", f"| change | estimate | {percent} interval |", "| --- | ---: | ---: |"]
    for name, quantity in rows:
        interval = estimate.interval(quantity, confidence)
        lines.append(f"| {name} | {interval.value:.4g} | {_range(interval)} |")
    return "\n".join(lines)


def format_choices(estimate: Estimate, question: Question, confidence: float = 0.95) -> str:
    """
    :param estimate: estimated components
    :param question: for which T and cost
    :param confidence: of the intervals
    :return: Markdown table of numbers of actions at the cost of T states with one action
    """
    lines = [
        f"| actions | states at equal cost | variance | relative to 1 action, {100 * confidence:g} % interval |",
        "| ---: | ---: | ---: | ---: |",
    ]
    choices = at_equal_cost(estimate.components, question.n_steps, question.action_cost, MAX_ACTIONS)
    for choice in choices:
        if choice.n_actions not in (1, 2, 3, 4, 6, 8, 12, 16):
            continue
        ratio = estimate.interval(partial(_ratio, question=question, n_actions=choice.n_actions), confidence)
        lines.append(
            f"| {choice.n_actions} | {choice.n_steps:.4g} | {float(choice.variance):.4g} "
            f"| {ratio.value:.2f} ({_range(ratio)}) |"
        )
    return "\n".join(lines)


def format_gradients(samples: GradientSamples, confidence: float = 0.95) -> str:
    """
    :param samples: gradients of several methods
    :param confidence: of the intervals
    :return: Markdown table of bias and variance, by MBMA's definitions (appendix B) and by those for the whole gradient
    """
    lines = [
        "| method | relative bias (MBMA, B) | relative variance (MBMA, B) | squared bias | variance |",
        "| --- | ---: | ---: | ---: | ---: |",
    ]
    for name in samples.gradients:
        bias, variance = samples.bias(name, confidence), samples.variance(name, confidence)
        squared_bias = "0" if name == samples.oracle else f"{bias.value:.3g} ({_range(bias)})"
        lines.append(
            f"| {name} | {samples.relative_bias(name):.3g} | {samples.relative_variance(name):.3g} "
            f"| {squared_bias} | {variance.value:.3g} ({_range(variance)}) |"
        )
    return "\n".join(lines)


def _ratio(components: Components, question: Question, n_actions: int) -> np.ndarray:
    choices = at_equal_cost(components, question.n_steps, question.action_cost, n_actions)
    return choices[-1].variance / choices[0].variance


def _side(components: Components, question: Question, index: int) -> np.ndarray:
    return components.theorem_3_3(question.n_steps, question.delta, question.n_actions)[index]


def _range(interval: Interval) -> str:
    return f"{interval.low:.3g} to {interval.high:.3g}"


# ---------------------------------------------------------------- picture


def draw(title: str, estimate: Estimate, question: Question, confidence: float = 0.95) -> "Figure":
    """
    :param title: of the picture
    :param estimate: estimated components
    :param question: for which T, N and cost
    :param confidence: of the intervals
    :return: the components, the covariances by distance, and the variance of more actions at equal cost
    :raises ImportError: matplotlib is not installed
    """
    with needing_matplotlib():
        from matplotlib.figure import Figure

    t = question.n_steps
    figure = Figure(figsize=(12, 4), layout="constrained", dpi=150)
    parts, lags, costs = figure.subplots(1, 3)
    bars: list[tuple[str, str, Callable[[Components], np.ndarray]]] = [
        ("variance\nover states", "tab:blue", lambda c: c.marginal_variance),
        ("its co-\nvariances", "tab:blue", lambda c: c.marginal_covariance_sum(t)),
        ("variance\nover actions", "tab:orange", lambda c: c.policy_variance),
        ("its co-\nvariances", "tab:orange", lambda c: c.policy_covariance_sum(t)),
    ]
    for position, (_, color, quantity) in enumerate(bars):
        value, low, high = estimate.interval(quantity, confidence)
        parts.bar(position, value, color=color, yerr=[[value - low], [high - value]], capsize=3)
    parts.set_xticks(range(len(bars)), [name for name, _, _ in bars], fontsize=8)
    parts.set_title("T · variance: marginalized, policy-dependent", fontsize=10)

    distances = np.arange(1, estimate.components.max_lag + 1)
    for label, color, name in (
        ("marginalized", "tab:blue", "marginal_covariance"),
        ("policy-dependent", "tab:orange", "policy_covariance"),
    ):
        bands = [
            estimate.interval(lambda c, i=i, name=name: getattr(c, name)[..., i], confidence)  # type: ignore[misc]
            for i in range(len(distances))
        ]
        lags.fill_between(distances, [b.low for b in bands], [b.high for b in bands], color=color, alpha=0.25, lw=0)
        lags.plot(distances, [b.value for b in bands], color=color, label=label)
    lags.legend(frameon=False, fontsize=8)
    lags.set_title("covariance at two states", fontsize=10)
    lags.set_xlabel("steps apart")

    numbers = range(1, MAX_ACTIONS + 1)
    ratios = [estimate.interval(partial(_ratio, question=question, n_actions=n), confidence) for n in numbers]
    costs.fill_between(numbers, [r.low for r in ratios], [r.high for r in ratios], color="tab:green", alpha=0.25, lw=0)
    costs.plot(numbers, [r.value for r in ratios], color="tab:green", marker="o", markersize=3)
    costs.axhline(1.0, color="grey", linewidth=0.8)
    costs.set_title(f"variance at equal cost, an action costing {question.action_cost:g}", fontsize=10)
    costs.set_xlabel("actions at each state")
    costs.set_xticks([1, *range(2, MAX_ACTIONS + 1, 2)])
    for axes in (parts, lags, costs):
        axes.axhline(0.0, color="black", linewidth=0.6)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{title}, T = {t}, {100 * confidence:g} % intervals of {estimate.n_rollouts} rollouts")
    return figure


# ---------------------------------------------------------------- command


def main(arguments: Sequence[str] | None = None) -> None:
    """
    ``sb3-sample variance``.

    :param arguments: the command line after the command's name; the process's own if None
    """
    parser = argparse.ArgumentParser(
        "sb3-sample variance",
        description="Estimate the variance of a policy's gradient, what part of it more actions at each state and what "
        "part a longer trajectory would lower, and which of the two lowers it further at the same cost.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
        allow_abbrev=False,
    )
    suites = "dmc/, metaworld/, myosuite/, Gymnasium's MuJoCo, classic control"
    parser.add_argument("--env", required=True, help=f"id of the environment: {suites}")
    parser.add_argument("--env-kwargs", nargs="+", default=[], metavar="NAME=VALUE", help="such as action_repeat=4")
    parser.add_argument("--model", type=Path, help="saved model; without one a model is trained")
    parser.add_argument(
        "--algo",
        choices=list(ALGORITHMS),
        help="what is trained without a model, or what saved the model, if it is pickled: ppo; other files say it",
    )
    parser.add_argument("--vecnormalize", type=Path, help="saved VecNormalize of the model")
    parser.add_argument("--allow-pickle", action="store_true", help="load pickled files too, which may run any code")
    parser.add_argument(
        "--train-steps", type=int, help=f"steps that a model is trained without --model, 0 for none; {TRAIN_STEPS:,}"
    )
    parser.add_argument("--n-steps", type=int, default=128, help="T of the measured rollouts")
    parser.add_argument("--n-rollouts", type=int, default=16, help="independent rollouts")
    parser.add_argument("--n-actions", type=int, default=2, help="actions tried at each state")
    parser.add_argument("--n-returns", type=int, default=2, help="returns sampled for each action")
    parser.add_argument("--horizon", type=int, default=12, help="steps of a return before the critic's value ends it")
    parser.add_argument("--max-lag", type=int, help="distance up to which covariances are counted; default: all")
    parser.add_argument("--burn-in", type=int, help="least steps before a rollout; default: an episode")
    parser.add_argument("--no-baseline", action="store_true", help="do not subtract the critic's value (MBMA, table 1)")
    parser.add_argument("--trajectory", type=int, help="T of the comparison; default: that of the rollouts")
    parser.add_argument("--now", type=int, default=1, metavar="N", help="actions at each state before one more")
    parser.add_argument(
        "--action-cost", type=float, default=1.0, help="cost of an additional action at a state, one state being 1"
    )
    parser.add_argument("--confidence", type=float, default=0.95, help="of the intervals")
    parser.add_argument(
        "--bias", type=int, default=0, metavar="M", help="also compare M gradients of PPO, MBMA, QMA and MBPO"
    )
    parser.add_argument(
        "--bias-steps", type=int, metavar="T", help=f"states of each of these gradients; {BIAS_STEPS:,}"
    )
    parser.add_argument("--seed", type=int, default=0, help="of everything that is random")
    parser.add_argument("-o", "--output", type=Path, help="picture to write; default: the id, as -variance.png")
    args = parser.parse_args(arguments)
    try:
        _run(args)
    except (ValueError, TypeError, ImportError, OSError, NotImplementedError, gym.error.Error) as error:
        # Spaces without a policy in Stable-Baselines3 are among these errors.
        refuse("variance", error)


def _run(args: argparse.Namespace) -> None:
    settings = {
        name: getattr(args, name)
        for name in ("n_steps", "n_rollouts", "n_actions", "n_returns", "horizon", "max_lag", "burn_in")
    }
    # Checked before training and rollouts, which take minutes.
    check_arguments(**settings, n_envs=1)
    trajectory = args.n_steps if args.trajectory is None else args.trajectory
    train_steps = TRAIN_STEPS if args.train_steps is None else args.train_steps
    bias_steps = BIAS_STEPS if args.bias_steps is None else args.bias_steps
    check_counts(
        {
            "train_steps": (train_steps, 0),
            "trajectory": (trajectory, 1),
            "now": (args.now, 1),
            "seed": (args.seed, 0),
            "bias_steps": (bias_steps, 2),
        }
    )
    if args.bias:
        check_counts({"bias": (args.bias, 4)})
    elif args.bias_steps is not None:
        raise ValueError(f"bias_steps={args.bias_steps} means nothing without --bias: leave it out")
    if args.model is not None and args.train_steps is not None:
        raise ValueError(f"train_steps={args.train_steps} means nothing with --model: leave it out")
    output = args.output or Path(args.env.replace("/", "-") + "-variance.png")
    _check_picture(output)
    if not 0 < args.action_cost < np.inf:
        raise ValueError(f"action_cost must be above 0 and finite, not {args.action_cost}")
    if not 0 < args.confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, not {args.confidence}")
    if args.vecnormalize is not None and args.model is None:
        raise ValueError("vecnormalize must come with the model that it belongs to: give --model")
    make = partial(make_env, args.env, **_keyword_arguments(args.env_kwargs))
    env = make()
    if args.bias:
        check_spaces(env.observation_space, env.action_space)
    check_restorable(env, make())
    model = _model(args, make, train_steps)
    Agent(model)

    question = Question(trajectory, args.now, args.action_cost)
    estimate = estimate_components(
        model,
        make,
        **settings,
        baseline=not args.no_baseline,
        seed=args.seed,
        on_rollout=partial(_tell, "rollout", args.n_rollouts),
    )
    decided = {
        "actions": f"One more action at each state (N = {args.now + 1}) lowers the variance further",
        "steps": f"A longer trajectory (T = {trajectory * (1 + question.delta):g}) lowers the variance further",
        "undecided": "Undecided: the interval of Delta_T - Delta_N contains 0; more rollouts make it narrower",
    }[verdict(estimate, question, args.confidence)]
    print(
        f"{args.env}, gradient of {estimate.n_parameters:,} parameters, {args.n_rollouts} rollouts of "
        f"{args.n_steps} steps, squared length {estimate.squared_gradient:.4g}\n\n"
        f"{format_components(estimate, question, args.confidence)}\n\n{decided}.\n\n"
        f"{format_choices(estimate, question, args.confidence)}"
    )
    if args.bias:
        samples = compare_gradients(
            model,
            make,
            n_estimates=args.bias,
            n_steps=bias_steps,
            seed=args.seed,
            on_estimate=partial(_tell, "gradient", args.bias),
        )
        print(
            f"\nGradients of {bias_steps} states, {args.bias} of each method; relative bias of PPO's halves "
            f"{samples.noise_floor():.3g}\n\n{format_gradients(samples, args.confidence)}"
        )
    figure = draw(args.env, estimate, question, args.confidence)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(output)
    print(f"\nSaved to {output}")


def _check_picture(output: Path) -> None:
    """
    :raises ValueError: it is not a picture format that can be written
    :raises ImportError: matplotlib is not installed
    """
    with needing_matplotlib():
        from matplotlib.backend_bases import FigureCanvasBase

    allowed = FigureCanvasBase.get_supported_filetypes()
    if output.suffix[1:].lower() not in allowed:
        raise ValueError(f"output must end in one of .{', .'.join(sorted(allowed))}, not be {output}")


def _model(args: argparse.Namespace, make: Callable[[], gym.Env], train_steps: int) -> OnPolicyAlgorithm:
    cls: Any
    if args.model is None:
        cls = ALGORITHMS[args.algo or "ppo"]
        fresh: OnPolicyAlgorithm = cls("MlpPolicy", make(), seed=args.seed, device="cpu", normalize_advantage=False)
        return fresh.learn(train_steps) if train_steps else fresh
    for name, path in (("model", args.model), ("vecnormalize", args.vecnormalize)):
        if path is not None and not path.is_file():
            raise ValueError(f"{name} must be a file, not {path}")
    try:
        name = class_of(args.model)
    except PickledFile:
        cls = ALGORITHMS[args.algo or "ppo"]
    else:
        algo = next((algo for algo, kind in ALGORITHMS.items() if path_of(kind) == name), None)
        if algo is None or args.algo not in (None, algo):
            wanted = args.algo or f"one of {', '.join(ALGORITHMS)}"
            raise ValueError(f"model {args.model} holds a model of {name}, but algo is {wanted}")
        cls = ALGORITHMS[algo]
    is_safe = issubclass(cls, SafeFiles)
    if not is_safe and not args.allow_pickle:
        raise ValueError(
            f"model {args.model} is pickled, as those of {cls.__name__} are, and may run any code: pass --allow-pickle "
            "if you trust its author"
        )
    venv = None
    if args.vecnormalize is not None:
        venv = load_vec_normalize(args.vecnormalize, DummyVecEnv([make]), allow_pickle=args.allow_pickle)
        venv.training = False
    # The model may have learned in another number of environments, which set_env would reject.
    return cls.load(args.model, env=venv, device="cpu", **({"allow_pickle": args.allow_pickle} if is_safe else {}))


def _keyword_arguments(given: list[str]) -> dict[str, Any]:
    values = {}
    for entry in given:
        name, equals, text = entry.partition("=")
        if not equals or not name.isidentifier():
            raise ValueError(f"env_kwargs must be of the form NAME=VALUE, not {entry!r}")
        try:
            values[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            values[name] = text
    return values


def _tell(what: str, total: int, number: int) -> None:
    if sys.stderr.isatty():
        print(f"\r{what} {number} of {total}", end="\n" if number == total else "", file=sys.stderr, flush=True)
