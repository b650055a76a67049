"""
``examples/bro_in_one_file.py`` beside the authors' recorded updates and beside the library's: the file that is read is
the algorithm that is used.
"""

import dataclasses
import functools
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from sb3_sample import BRO
from sb3_sample.learner.batch import Batch, Noise
from tests.sac import test_golden as golden

FILE = Path(__file__).parents[1] / "examples" / "bro_in_one_file.py"


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("bro_in_one_file", FILE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["bro_in_one_file"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


one_file: Any = load()
TINY = one_file.Config(
    critic_blocks=1, critic_width=8, actor_width=8, n_quantiles=5, batch_size=8, learning_starts=20, replay_ratio=2
)


def named_parameters(agent: Any) -> dict[str, torch.Tensor]:
    """Views of every parameter of an agent by its name and in its layout in the golden files."""
    layers: dict[str, nn.Module] = {
        "actor/Dense_0": agent.actor.mean,
        "actor/Dense_1": agent.actor.log_std,
        "actor_o/Dense_0": agent.optimist.shift,
        **golden.trunk_layers(agent.actor.trunk, "actor/BroNet_0"),
        **golden.trunk_layers(agent.optimist.trunk, "actor_o/BroNet_0"),
    }
    for module, critics in (("critic", agent.critics), ("target_critic", agent.target_critics)):
        for e, critic in enumerate(critics.members):
            layers |= golden.trunk_layers(critic, f"{module}/Critic_{e}/BroNet_0")
    named: dict[str, torch.Tensor] = {
        "temp/log_temp": agent.log_temperature,
        "optimism/log_value": agent.optimism.raw,
        "regularizer/log_value": agent.kl_weight.raw,
    }
    for name, layer in layers.items():
        is_norm = isinstance(layer, nn.LayerNorm)
        named[f"{name}/{'scale' if is_norm else 'kernel'}"] = layer.weight if is_norm else layer.weight.T
        if layer.bias is not None:
            named[f"{name}/bias"] = layer.bias
    return named


def copy_parameters(agent: Any, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Give an agent all of these parameters, by their names in the golden files; gives views of them."""
    named = named_parameters(agent)
    assert named.keys() == values.keys()
    n_parameters = sum(
        p.numel()
        for module in (agent.actor, agent.optimist, agent.critics, agent.target_critics)
        for p in module.parameters()
    )
    assert sum(value.numel() for value in named.values()) == n_parameters + 3, "a parameter is without a name"
    with torch.no_grad():
        for name, value in values.items():
            assert named[name].shape == value.shape
            named[name].copy_(value)
    return named


def recorded_config(meta: dict[str, Any]) -> Any:
    dims, hp, optimizers = meta["dims"], meta["hyperparameters"], meta["optimizers"]
    assert (dims["actor_depth"], dims["actor_hidden"]) == (dims["actor_o_depth"], dims["actor_o_hidden"])
    assert hp["target_entropy"] == -dims["act_dim"] / 2
    return one_file.Config(
        critic_blocks=dims["critic_depth"],
        critic_width=dims["critic_hidden"],
        actor_blocks=dims["actor_depth"],
        actor_width=dims["actor_hidden"],
        n_quantiles=dims["n_quantiles"],
        weight_decay=optimizers["critic"]["weight_decay"],
        pessimism=hp["pessimism"],
        kl_target=hp["kl_target"],
        std_multiplier=hp["std_multiplier"],
        adjustment_learning_rate=optimizers["optimism"]["lr"],
        learning_rate=optimizers["critic"]["lr"],
        discount=hp["discount"],
        tau=hp["tau"],
    )


def recorded(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    data = dict(np.load(path))
    return data, json.loads(str(data["meta"]))


def mean_std(agent: Any, observations: torch.Tensor) -> float:
    with torch.no_grad():
        return float(agent.actor(observations)[1].exp().mean())


def replay(path: Path) -> int:
    """Run a file's updates, compare all parameters and reported numbers; gives how many numbers were compared."""
    data, meta = recorded(path)
    agent = one_file.Agent(meta["dims"]["obs_dim"], meta["dims"]["act_dim"], recorded_config(meta))
    stored = {key.removeprefix("init/"): torch.as_tensor(v) for key, v in data.items() if key.startswith("init/")}
    named = copy_parameters(agent, stored)
    as_model: Any = SimpleNamespace(learning_rate=agent.config.learning_rate)
    networks = {"critic": agent.critics, "actor": agent.actor, "actor_o": agent.optimist}
    n_compared = 0
    for i in range(meta["dims"]["n_updates"]):
        observations, actions, rewards, masks, next_observations = (
            torch.as_tensor(data[f"batch/{i}/{name}"])
            for name in ("observations", "actions", "rewards", "masks", "next_observations")
        )
        noise = torch.stack([torch.as_tensor(data[f"noise/{i}/{name}"]) for name in ("critic", "actor", "actor_o")])
        reported = {f"{name}_pnorm": golden.norm(list(module.parameters())) for name, module in networks.items()}
        a = actions.clone().requires_grad_()
        q1, q2 = agent.critics(observations, a).mean(dim=(1, 2))
        reported["critic_agnorm"] = float(torch.autograd.grad(0.5 * (q1 + q2), a)[0].norm(dim=1).mean())
        reported |= {"q1": q1.item(), "q2": q2.item(), "r": rewards.mean().item(), "std": mean_std(agent, observations)}

        batch = one_file.Batch(observations, actions, rewards[:, None], 1 - masks[:, None], next_observations)
        metrics = {name: value.item() for name, value in agent.update(batch, noise).items()}

        reported |= {theirs: metrics[ours] for theirs, ours in golden.SHARED_NAMES.items()}
        reported |= {f"{name}_gnorm": golden.norm([p.grad for p in m.parameters()]) for name, m in networks.items()}
        reported["optimism"] = metrics["exploration/optimism"]
        reported["kl"] = metrics["exploration/kl"] * meta["dims"]["act_dim"]
        # The optimistic actor started from the new actor's standard deviation.
        reported["std_c"] = mean_std(agent, observations)
        reported["std_o"] = reported["std_c"] * agent.config.std_multiplier
        for name in {key.split("/")[2] for key in data if key.startswith(f"info/{i}/")}:
            ours, theirs = reported[name], float(data[f"info/{i}/{name}"])
            assert abs(ours - theirs) <= golden.INFO_TOLERANCE * max(1, abs(theirs)), (
                f"{i}, {name}: {ours}, not {theirs}"
            )
            n_compared += 1
        last = i == meta["dims"]["n_updates"] - 1
        if last or f"after/{i}/temp/log_temp" in data:
            golden.check_parameters(named, data, "final/" if last else f"after/{i}/", i + 1, as_model)
    return n_compared


def is_quantile_bro(path: Path) -> bool:
    return bool(json.loads(str(np.load(path)["meta"]))["hyperparameters"].get("distributional"))


FILES = [path for path in golden.FILES if is_quantile_bro(path)]


def test_files_are_there() -> None:
    own = {path.stem for path in golden.OWN_FOLDER.glob("bro_quantile_*")}
    assert own
    # Another folder may be without files of BRO.
    assert golden.FOLDER != golden.OWN_FOLDER or own <= {path.stem for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=[path.stem for path in FILES])
def test_golden(path: Path) -> None:
    assert replay(path) >= len(golden.SHARED_NAMES), "the file reports nothing to compare with"


def test_torch_adamw_would_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comment on the optimizer is true: torch's decay is another."""

    class TorchAdamW:
        def __init__(self, parameters: Any, learning_rate: float, beta1: float = 0.9, weight_decay: float = 0.0):
            self.parameters = list(parameters)
            self.optimizer = torch.optim.AdamW(
                self.parameters, learning_rate, (beta1, 0.999), weight_decay=weight_decay
            )

        def minimize(self, loss: torch.Tensor) -> None:
            self.optimizer.zero_grad()
            loss.backward(inputs=self.parameters)
            self.optimizer.step()

    monkeypatch.setattr(one_file, "AdamW", TorchAdamW)
    with pytest.raises(AssertionError, match="weight decay is off"):
        replay(golden.OWN_FOLDER / "bro_quantile_public.npz")


def test_defaults_are_the_librarys() -> None:
    config, model = one_file.Config(), BRO("MlpPolicy", golden.Shapes(5, 3), device="cpu", buffer_size=1)
    explorer: Any = model.explorer
    assert config.resets == model.plasticity.steps
    assert (config.n_quantiles, config.pessimism) == (model.n_quantiles, model.pessimism)
    for name in ("replay_ratio", "learning_starts", "batch_size", "tau", "weight_decay", "learning_rate"):
        assert getattr(config, name) == getattr(model, name), name
    for name in ("kl_target", "std_multiplier", "initial_optimism", "initial_kl_weight", "adjustment_learning_rate"):
        assert getattr(config, name) == getattr(model, name), name
    assert config.discount == model.gamma
    agent = one_file.Agent(5, 3, config)
    theirs = golden.named_parameters(model)
    ours = named_parameters(agent)
    assert {name: value.shape for name, value in ours.items()} == {name: value.shape for name, value in theirs.items()}
    for name, value in ours.items():  # not the same draws, but of the same size; the numbers are equal
        assert value.norm().item() == pytest.approx(theirs[name].norm().item(), rel=1e-3, abs=1e-6), name
    assert explorer.shift.bias is None and agent.optimist.shift.bias is None


def test_library_update() -> None:
    """The same parameters, batches and noise, and afterwards the same parameters and reported numbers."""
    width = {"width": 16, "n_blocks": 1}
    model = BRO(
        "MlpPolicy",
        golden.Shapes(5, 3),
        model_size=(2, 24),
        n_quantiles=20,
        policy_kwargs={"actor_network_kwargs": width},
        exploration_kwargs={"network_kwargs": width},
        buffer_size=1,
        device="cpu",
        compile=False,
        seed=0,
    )
    theirs = golden.named_parameters(model)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in theirs.values():  # off the start, where biases are 0 and the targets equal the critics
            value += 0.05 * torch.randn(value.shape, generator=generator)
        # Moderate standard deviations: with the tiny ones of the start, the divergence drowns the optimistic value.
        theirs["actor/Dense_1/kernel"].mul_(0.15)
        theirs["actor/Dense_1/bias"].add_(0.75)
    agent = one_file.Agent(5, 3, one_file.Config(critic_width=24, n_quantiles=20, actor_width=16))
    ours = copy_parameters(agent, theirs)
    start = {name: value.clone() for name, value in ours.items()}
    for _ in range(5):
        observations, next_observations = torch.randn(2, 32, 5, generator=generator)
        actions = torch.tanh(torch.randn(32, 3, generator=generator))
        rewards = 3 * torch.randn(32, 1, generator=generator)
        terminated = (torch.rand(32, 1, generator=generator) < 0.2).float()
        noise = torch.randn(3, 32, 3, generator=generator)
        mine = agent.update(one_file.Batch(observations, actions, rewards, terminated, next_observations), noise)
        batch = Batch(observations, actions, next_observations, terminated, rewards)
        metrics = model.learner.update(batch, Noise(*noise))
        assert mine.keys() == metrics.keys()
        for name, value in mine.items():
            assert value.item() == pytest.approx(metrics[name].item(), rel=1e-4, abs=1e-5), name
    for name, value in ours.items():
        # Relative to how far the parameters went, which is little beside what they are.
        distance, difference = (value - start[name]).norm().item(), (value - theirs[name]).norm().item()
        assert distance > 0 and difference <= 1e-3 * distance, f"{name}: off by {difference} after {distance}"
        torch.testing.assert_close(value, theirs[name], rtol=1e-5, atol=2e-6)


def run(n_steps: int, seed: int = 0, **changes: Any) -> tuple[Any, list[float]]:
    return one_file.train("Pendulum-v1", dataclasses.replace(TINY, **changes), n_steps, seed, eval_every=100)


@pytest.mark.parametrize("n_steps", [29, 30, 31, pytest.param(75, marks=pytest.mark.slow)])
def test_resets_and_replay_ratio(n_steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As many gradient steps since the last reset, and as many resets, as the library's BRO has taken."""
    made: list[Any] = []

    class Counted(one_file.Agent):
        def __init__(self, *args: Any):
            super().__init__(*args)
            made.append(self)

    monkeypatch.setattr(one_file, "Agent", Counted)
    monkeypatch.setattr(one_file, "evaluate", lambda agent, env: 0.0)
    agent, _ = run(n_steps, resets=(30, 60))
    model = BRO(
        "MlpPolicy", "Pendulum-v1", model_size=(1, 8), n_quantiles=5, batch_size=8, learning_starts=20,
        replay_ratio=2, resets=(30, 60), buffer_size=100, device="cpu", compile=False,
    )  # fmt: skip
    model.learn(n_steps)
    assert len(made) - 1 == model.plasticity.n_done == sum(step <= n_steps for step in (30, 60))
    assert agent is made[-1]
    optimizers = [value for name, value in vars(agent).items() if name.endswith("_optimizer")]
    (theirs,) = {int(state["step"]) for state in model.critic.optimizer.state.values()}
    assert len(optimizers) == 5 and {optimizer.n_steps for optimizer in optimizers} == {theirs}
    assert sum(a.critic_optimizer.n_steps for a in made) == model._n_updates


@pytest.mark.slow
def test_equal_seeds_are_equal(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(one_file, "evaluate", functools.partial(one_file.evaluate, n_episodes=2))
    runs = [run(250, seed, learning_starts=150, resets=(200,)) for seed in (0, 0, 1)]
    (first, second, other), (returns, same_returns, _) = zip(*runs, strict=True)
    assert returns == same_returns and len(returns) == 3
    printed = capsys.readouterr().out.splitlines()
    assert printed[:3] == printed[3:6]
    assert printed[0] == f"step 100, return {returns[0]:.1f}", "nothing learned yet"
    assert printed[2].startswith(f"step 250, return {returns[2]:.1f}, train/critic_loss")
    first, second, other = map(named_parameters, (first, second, other))
    for name, value in first.items():
        assert torch.isfinite(value).all(), name
        assert torch.equal(value, second[name]), name
    assert any(not torch.equal(value, other[name]) for name, value in first.items())


def test_evaluation_plays_the_mean_action(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = one_file.Agent(3, 1, TINY)
    observation = np.array([0.5, -0.5, 2.0], np.float32)
    with torch.no_grad():
        mean = torch.tanh(agent.actor(torch.as_tensor(observation)[None])[0][0]).numpy()
    np.testing.assert_allclose(agent.mean_action(observation), mean, rtol=1e-6)
    monkeypatch.setattr(agent, "explore", None)
    env = one_file.make_env("Pendulum-v1")
    env.reset(seed=0)
    state = torch.get_rng_state()
    value = one_file.evaluate(agent, env, n_episodes=2)
    assert torch.equal(state, torch.get_rng_state()), "nothing is drawn"
    env.reset(seed=0)
    rewards = []
    for _ in range(2):
        observation, done = env.reset()[0], False
        while not done:
            observation, reward, _, done, _ = env.step(agent.mean_action(observation))
            rewards.append(reward)
    assert len(rewards) == 400 and value == pytest.approx(sum(rewards) / 2)


def test_exploration_samples_the_shifted_actor() -> None:
    """Against the library's formula: tanh of the mean, its shift, and 0.75 standard deviations of noise."""
    agent = one_file.Agent(3, 1, TINY)
    torch.nn.init.normal_(agent.optimist.shift.weight)
    observation = np.array([0.5, -0.5, 2.0], np.float32)
    torch.manual_seed(0)
    action = agent.explore(observation)
    torch.manual_seed(0)
    with torch.no_grad():
        observations = torch.as_tensor(observation)[None]
        mean, log_std = agent.actor(observations)
        shift = agent.optimist.shift(agent.optimist.trunk(torch.cat((observations, mean), dim=1)))
        expected = torch.tanh(mean + shift + 0.75 * log_std.exp() * torch.randn(1, 1))
    np.testing.assert_allclose(action, expected[0].numpy(), rtol=1e-5)


def test_replay_ring() -> None:
    buffer = one_file.ReplayBuffer(4, 2, 1)
    for i in range(6):
        buffer.add(np.full(2, i), np.array([-i]), 10.0 * i, float(i == 5), np.full(2, i + 1))
    batch = buffer.sample(200, np.random.default_rng(0))
    assert set(batch.rewards.flatten().tolist()) == {20.0, 30.0, 40.0, 50.0}, "the latest four"
    steps = batch.rewards / 10
    assert torch.equal(batch.observations, steps.expand(-1, 2)) and torch.equal(batch.actions, -steps)
    assert torch.equal(batch.next_observations, batch.observations + 1)
    assert torch.equal(batch.terminated, (steps == 5).float())


def test_what_it_refuses() -> None:
    with pytest.raises(ValueError, match=r"env must have a bounded Box .*; CartPole-v1 has Discrete\(2\)"):
        one_file.make_env("CartPole-v1")
    with pytest.raises(ValueError, match="n_steps must be more than learning_starts=20, not 20"):
        run(20)
    with pytest.raises(ValueError, match="eval_every must be at least 1, not 0"):
        one_file.train("Pendulum-v1", TINY, 30, seed=0, eval_every=0)


def test_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(one_file, "train", lambda *args: calls.append(args))
    monkeypatch.setattr(one_file, "make_env", lambda env_id: one_file.gym.Env())
    for line in ("--steps 2501 --seed 3", "--env Pendulum-v1 --model-size 0.55M --fast --eval-every 9"):
        monkeypatch.setattr(sys, "argv", ["bro_in_one_file.py", *line.split()])
        one_file.main()
    bro, fast = one_file.Config(), one_file.Config(critic_blocks=1, critic_width=128, replay_ratio=2, resets=(15_000,))
    assert calls == [("dmc/cheetah-run-v0", bro, 2501, 3, 5_000), ("Pendulum-v1", fast, 100_000, 0, 9)]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (
            "--env CartPole-v1",
            "env must have a bounded Box with one axis as its action space; CartPole-v1 has",
        ),
        ("--env no-such-env-v0", "doesn't exist"),
        ("--env a/b/c", "Malformed environment ID"),
        ("--env Pendulum-v1 --steps 2500", "n_steps must be more than learning_starts=2500, not 2500"),
        ("--env Pendulum-v1 --eval-every 0", "eval_every must be at least 1, not 0"),
        ("--env Pendulum-v1 --seed -1", "seed must be at least 0, not -1"),
        ("--model-size 3M", "invalid choice: '3M'"),
    ],
)
def test_bad_arguments_are_one_line(line: str, words: str, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.setattr(sys, "argv", ["bro_in_one_file.py", *line.split()])
    with pytest.raises(SystemExit) as caught:
        one_file.main()
    *_, last = capsys.readouterr().err.splitlines()
    assert caught.value.code == 2 and words in last and last.startswith("bro_in_one_file.py: error: ")


def test_stands_alone() -> None:
    """It needs neither this package nor Stable-Baselines3, but to register the environments."""
    program = (
        f"import runpy, sys; runpy.run_path({str(FILE)!r}); "
        "print(sorted(name for name in ('sb3_sample', 'stable_baselines3') if name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout == "[]\n"
