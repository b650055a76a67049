"""A learner without an algorithm around it: the same steps, state and random numbers of its own."""

import copy
import itertools
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces

from sb3_sample import BRO, DAC, SAC, TOPSAC, VPLSAC, Dataset
from sb3_sample.learner import Learner
from sb3_sample.learner.batch import Extra, Noise
from sb3_sample.learner.pessimism import Pessimism
from tests.sac.common import MAKERS, PIXEL_MAKERS, random_batch

OBSERVATIONS, ACTIONS = spaces.Box(-np.inf, np.inf, (3,), np.float32), spaces.Box(-2, 2, (2,), np.float32)
TINY: dict[Any, dict[str, Any]] = {
    SAC: {"policy_kwargs": {"net_arch": [8]}},
    DAC: {"policy_kwargs": {"net_arch": [8]}},
    BRO: {
        "model_size": (1, 8), "n_quantiles": 5,
        "policy_kwargs": {"actor_network_kwargs": {"width": 8, "n_blocks": 1}},
        "exploration_kwargs": {"network_kwargs": {"width": 8, "n_blocks": 1}},
    },
}  # fmt: skip


def data(n: int = 200, seed: int = 0) -> Dataset:
    rng = np.random.default_rng(seed)
    return Dataset.from_arrays(
        rng.normal(size=(n, 3)), rng.uniform(-2, 2, (n, 2)), rng.normal(size=n), rng.random(n) < 0.1, np.zeros(n),
        action_space=ACTIONS,
    )  # fmt: skip


def make(cls: Any = BRO, seed: int = 0, **kwargs: Any) -> Learner:
    return cls.learner(OBSERVATIONS, ACTIONS, seed, **{**TINY.get(cls, TINY[SAC]), **kwargs})  # type: ignore[no-any-return]


def train(learner: Learner, n: int = 5, **kwargs: Any) -> dict[str, torch.Tensor]:
    source = data(**kwargs)
    for _ in range(n):
        metrics = learner.update(source.sample(16))
    return metrics


def flat(state: Any) -> list[Any]:
    if isinstance(state, dict):
        return [leaf for key in state for leaf in flat(state[key])]
    if isinstance(state, (list, tuple)):
        return [leaf for item in state for leaf in flat(item)]
    return [state]


def same(first: Learner, second: Learner) -> bool:
    pairs = itertools.zip_longest(flat(first.state_dict()), flat(second.state_dict()))
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


# ---------------------------------------------------------------- the one inside a model


@pytest.mark.parametrize("maker", [*MAKERS, *PIXEL_MAKERS])
def test_a_models_steps_are_its_learners(maker: str) -> None:
    """The same batches and noise by ``model._update`` and by a copy of ``model.learner``."""
    make = {**MAKERS, **PIXEL_MAKERS}[maker]
    model, other = make(), make()
    assert isinstance(model.learner, Learner) and model.learner is not other.learner
    assert model.actor is model.learner.actor and model.critic_target is model.learner.critic_target
    for step in range(3):
        torch.manual_seed(step)
        mine = model._update(random_batch(model, seed=step))
        torch.manual_seed(step)
        theirs = other.learner.step(random_batch(other, seed=step), None, other.pessimism_rule.draw(other._source))
        assert mine.keys() == theirs.keys() and all(torch.equal(mine[name], theirs[name]) for name in mine)
    assert model._n_updates == other._n_updates == other.learner.n_updates == 3
    assert same(model.learner, other.learner)


def test_what_is_set_on_a_model_counts() -> None:
    model = MAKERS["SAC"]().learn(30)
    model.tau, model.gamma, model.target_entropy = 0.5, 0.9, -7.0
    model.train(1)
    learner = model.learner
    assert (learner.tau, learner.gamma, learner.target_entropy) == (0.5, 0.9, -7.0)


def test_no_learner_before_the_networks() -> None:
    model = SAC("MlpPolicy", "Pendulum-v1", _init_setup_model=False)
    with pytest.raises(AttributeError, match="SAC has no learner yet"):
        model.learner  # noqa: B018


# ---------------------------------------------------------------- one of one's own


@pytest.mark.parametrize("cls", [SAC, DAC, BRO])
def test_the_same_as_inside_a_model(cls: Any) -> None:
    """With the same parameters, batches and noise."""
    torch.manual_seed(0)
    model = cls("MlpPolicy", None, device="cpu", _init_setup_model=False, **TINY[cls])
    model.observation_space, model.action_space, model.n_envs = OBSERVATIONS, ACTIONS, 1
    model._setup_model()
    learner = make(cls)
    state = copy.deepcopy(model.learner.state_dict())
    learner.load_state_dict({**state, "generators": learner.state_dict()["generators"]})
    model.learner.set_training_mode(True)
    source = data()
    for seed in range(4):
        batch = source.sample(16)
        generator = torch.Generator().manual_seed(seed)
        noise = {name: torch.randn(16, 2, generator=generator) for name in ("critic", "actor", "exploration")}

        inside, alone = (
            model._update(batch._replace(discounts=0.99), Noise(**noise)),
            learner.update(batch, Noise(**noise)),
        )
        assert inside.keys() == alone.keys() and all(torch.equal(inside[name], alone[name]) for name in inside)
    ours, theirs = learner.state_dict(), model.learner.state_dict()
    assert all(torch.equal(a, b) for a, b in zip(flat(ours["networks"]), flat(theirs["networks"]), strict=True))


def test_a_seed_fixes_everything_and_nothing_global_moves() -> None:
    torch.manual_seed(3)
    np.random.seed(3)
    before, numpy_before = torch.get_rng_state(), np.random.get_state()[1].tolist()  # type: ignore[union-attr]
    first, second, other = make(seed=5), make(seed=5), make(seed=6)
    for learner in (first, second, other):
        train(learner)
        learner.act(torch.zeros(4, 3))
    assert torch.equal(before, torch.get_rng_state())
    assert np.random.get_state()[1].tolist() == numpy_before  # type: ignore[union-attr]
    assert same(first, second) and not same(first, other)
    # What others draw in between does not matter.
    torch.rand(100)
    train(first)
    torch.rand(3)
    train(second)
    assert same(first, second)


@pytest.mark.parametrize("cls", [SAC, DAC, BRO, TOPSAC])
def test_its_state_is_all_of_it(cls: Any) -> None:
    learner = make(cls, reset_gradient_steps=7, **({} if cls is BRO else {"redo_period": 3}))
    train(learner, 5)
    state = copy.deepcopy(learner.state_dict())
    metrics = train(learner, 6, seed=1)
    fresh = make(cls, seed=9, reset_gradient_steps=7, **({} if cls is BRO else {"redo_period": 3}))
    fresh.load_state_dict(state)
    again = train(fresh, 6, seed=1)
    assert same(learner, fresh) and learner.plasticity.n_done == 1
    assert all(torch.equal(metrics[name], again[name]) for name in metrics)


def test_a_state_of_other_parts_is_refused() -> None:
    with pytest.raises(ValueError, match="state must have the entries"):
        make(SAC).load_state_dict(make(DAC).state_dict())


def test_it_learns() -> None:
    """One step an episode: the best action is known."""
    rng = np.random.default_rng(0)
    observations, actions = rng.normal(size=(4_000, 3)), rng.uniform(-1, 1, (4_000, 1))
    rewards = -np.square(actions[:, 0] - np.tanh(observations[:, 0]))
    source = Dataset.from_arrays(observations, actions, rewards, np.ones(4_000), np.zeros(4_000))
    learner = SAC.learner(
        source.observation_space, source.action_space, learning_rate=3e-3, ent_coef=0.0,
        policy_kwargs={"net_arch": [32, 32]},
    )  # fmt: skip

    def distance() -> float:
        batch = source.sample(500)
        return (
            (learner.act(batch.observations, deterministic=True) - batch.observations[:, :1].tanh()).abs().mean().item()
        )

    before = distance()
    for _ in range(500):
        learner.update(source.sample(128))
    assert distance() < 0.12 < 0.3 < before


# ---------------------------------------------------------------- environment steps


def heard(learner: Learner, n: int = 1, **info: Any) -> None:
    for _ in range(n):
        learner.on_step(np.zeros(1), np.array([bool(info)]), [info])


def test_what_counts_environment_steps_waits_for_them() -> None:
    learner = make(SAC, resets=(10, 20))
    train(learner, 40)
    assert learner.plasticity.n_done == 0 and learner.num_transitions == 0
    heard(learner, 9)
    train(learner, 1)
    assert learner.plasticity.n_done == 0
    heard(learner, 3)
    train(learner, 2)
    assert learner.plasticity.n_done == 1 and learner.num_transitions == 12
    heard(learner, 20)
    train(learner, 3)
    assert learner.plasticity.n_done == 2


def test_episodes_move_a_bandit() -> None:
    learner = make(TOPSAC)
    rule: Any = learner.pessimism_rule
    for value in (1.0, 9.0):
        heard(learner, episode={"r": value})
    assert rule.log_weights != [0.0, 0.0]


def test_a_rule_that_needs_transitions_held_out_is_given_them() -> None:
    learner = make(VPLSAC)
    beta = learner.pessimism_rule.beta().item()  # type: ignore[union-attr]
    train(learner, 2)
    assert learner.pessimism_rule.beta().item() == beta  # type: ignore[union-attr]
    learner.update(data().sample(16), extra=Extra(data(seed=1).sample(4)._replace(discounts=0.99)))
    assert learner.pessimism_rule.beta().item() != beta  # type: ignore[union-attr]


class Drawing(Pessimism):
    """Draws a number at every event."""

    def __init__(self, learner: Any):
        super().__init__(1.0)
        self.drawn: list[float] = []

    def _draw(self, *_: Any) -> None:
        self.drawn.append(torch.rand(()).item())

    on_observations = on_step = on_environment_reset = before_updates = _draw


@pytest.mark.parametrize("pessimism", ["top", Drawing])
def test_events_and_restarts_draw_from_its_own_generators(pessimism: Any) -> None:
    found = []
    for global_seed in (1, 2):
        torch.manual_seed(global_seed)
        before = torch.get_rng_state()
        learner = make(SAC, seed=5, pessimism=pessimism, reset_gradient_steps=2)
        rule: Any = learner.pessimism_rule
        arms = []
        for _ in range(8):
            learner.on_observations(np.zeros((1, 3)))
            heard(learner, episode={"r": 0.0})
            arms.append(getattr(rule, "arm", None))
        learner.on_environment_reset()
        learner.before_updates()
        train(learner, 5)
        learner.reinitialize()
        assert torch.equal(before, torch.get_rng_state()) and learner.plasticity.n_done == 2
        found.append((learner, arms, getattr(rule, "drawn", None)))
    assert same(found[0][0], found[1][0]) and found[0][1:] == found[1][1:]


# ---------------------------------------------------------------- arguments


@pytest.mark.parametrize(
    "arguments",
    [{"replay_ratio": 2}, {"buffer_size": 10}, {"learning_starts": 0}, {"train_freq": 1}, {"tensorboard_log": "x"},
     {"replay_ratio": 2, "batch_size": 3}],
)  # fmt: skip
def test_arguments_of_training_are_refused_by_name(arguments: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"^{', '.join(sorted(arguments))}: a learner takes no arguments of training"):
        make(**arguments)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"tau": 2.0}, r"tau must lie in \(0, 1\], not 2.0"),
        ({"pessimism": "mean"}, "pessimism must be a number, or one of"),
        ({"reset_gradient_steps": 0}, "reset_gradient_steps must be an integer of at least 1"),
        ({"exploration": "random"}, "exploration must be one of"),
    ],
)
def test_other_arguments_are_checked_as_ever(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(SAC, **arguments)


def test_an_unknown_argument_is_an_error() -> None:
    with pytest.raises(TypeError, match="no_such"):
        make(SAC, no_such=1)


@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.Box(-np.inf, np.inf, (2,)), spaces.Box(1, 1, (2,))])
def test_action_spaces_are_checked(space: Any) -> None:
    with pytest.raises(ValueError, match="action_space must be"):
        SAC.learner(OBSERVATIONS, space)


def test_dict_observations() -> None:
    rng = np.random.default_rng(0)
    observations = {"a": rng.normal(size=(50, 2)), "b": rng.normal(size=(50, 1))}
    source = Dataset.from_arrays(observations, rng.uniform(-1, 1, (50, 1)), np.zeros(50), np.zeros(50), np.zeros(50))
    learner = SAC.learner(source.observation_space, source.action_space, **TINY[SAC])
    assert np.isfinite(learner.update(source.sample(8))["train/critic_loss"].item())


@pytest.mark.slow
def test_compiled() -> None:
    plain, compiled = make(compile=False), make(compile=True)
    for learner in (plain, compiled):
        train(learner, 20)
    pairs = zip(plain.networks.parameters(), compiled.networks.parameters(), strict=True)
    assert max((a - b).abs().max().item() for a, b in pairs) < 1e-4 and compiled.seconds_compiling > 0


@pytest.mark.slow
def test_the_example_runs(tmp_path: Path) -> None:
    """With fewer steps; at most fifteen lines, without the docstring and blank ones."""
    text = (Path(__file__).parents[2] / "examples" / "offline_bro.py").read_text()
    lines = [line for line in text.splitlines()[1:] if line.strip()]
    assert len(lines) <= 15
    short = text.replace("2_000", "3").replace('"0.55M"', "(1, 8)")
    (tmp_path / "example.py").write_text(
        f"{short}\nprint(best.shape, metrics['train/critic_loss'].isfinite().item())\n"
    )
    done = subprocess.run([sys.executable, tmp_path / "example.py"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "torch.Size([1000, 1]) True"
