"""
Demo of ``make demo``: BRO learns a DeepMind Control task, balancing a pole on a cart, from scratch while you watch.

The reward is 1 while the pole stands upright and the cart is near the middle of its rail, else 0: random actions lose
it within a fraction of the episode.

    python examples/demo.py [--folder demo] [--seed 0]

It prints the returns of random actions and of the learned policy, and writes the model, a picture of the learning curve
and, if the machine can render without a screen, a GIF of the learned behaviour.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from tqdm import tqdm

from sb3_sample import BRO, make_env
from sb3_sample.plots import Curve, Run, draw, summarize

ENV, ENV_ARGUMENTS = "dmc/cartpole-balance_sparse-v0", {"action_repeat": 4}  # an episode is 250 decisions
STEPS, EVERY = 10_000, 500  # decisions: in total at most, and between two evaluations
SOLVED = 900  # mean return, of at most 1,000
# The smallest critics, larger steps and no resets: enough for this task, and quick on a laptop.
AGENT: dict[str, Any] = dict(model_size="0.55M", replay_ratio=4, learning_rate=1e-3, learning_starts=1_000, resets=())


def fresh_env(**kwargs: Any) -> gym.Env:
    return Monitor(make_env(ENV, **ENV_ARGUMENTS, **kwargs))


def fresh_returns(policy: Any, seed: int) -> np.ndarray:
    """
    :param policy: a model, or any object with ``predict``
    :param seed: of the environment
    :return: returns of ten episodes in a fresh environment, (10,)
    """
    env = fresh_env()
    env.reset(seed=seed)
    env.action_space.seed(seed)
    returns, _ = evaluate_policy(policy, env, n_eval_episodes=10, return_episode_rewards=True)
    env.close()
    return np.array(returns)


class RandomActions:
    """Actions drawn uniformly, behind the interface of a policy."""

    def __init__(self, seed: int):
        self.space = fresh_env().action_space
        self.space.seed(seed)

    def predict(self, observation: np.ndarray, **_: Any) -> tuple[np.ndarray, None]:
        return np.stack([self.space.sample() for _ in observation]), None


class Evaluation(EvalCallback):
    """
    Evaluates every ``EVERY`` steps and shows the latest return: in a progress bar, or in lines if there is no terminal.
    One good evaluation may be luck, and the next update may undo it: training ends when a policy that passes an
    evaluation is as good in ten fresh episodes.
    """

    solved = False

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.start = time.time()
        hidden = not sys.stderr.isatty()
        self.bar = tqdm(total=STEPS, unit="step", desc=f"BRO on {ENV}", dynamic_ncols=True, disable=hidden)

    def show(self, text: str) -> None:
        self.bar.set_postfix_str(text)
        if self.bar.disable:
            minutes = (time.time() - self.start) / 60
            print(f"{self.num_timesteps:,} of {STEPS:,} steps, {minutes:.1f} minutes: {text}", flush=True)

    def _on_step(self) -> bool:
        self.bar.update(self.training_env.num_envs)
        n_evaluations = len(self.evaluations_timesteps)
        super()._on_step()
        if len(self.evaluations_timesteps) > n_evaluations:
            self.show(f"evaluation return {self.last_mean_reward:.0f} of 1000")
            if self.last_mean_reward >= SOLVED:
                again = fresh_returns(self.model, seed=self.num_timesteps).mean()
                self.show(f"evaluation return {self.last_mean_reward:.0f} of 1000, ten fresh episodes {again:.0f}")
                self.solved = bool(again >= SOLVED)
        if self.num_timesteps == AGENT["learning_starts"] and self.model.compiled:
            # The first gradient step, which compiles the update, comes next; nothing else is printed meanwhile.
            tqdm.write("Compiling the update: a minute on free cores, several on busy ones ...")
            sys.stdout.flush()
        return not self.solved

    def _on_training_end(self) -> None:
        self.bar.close()


def save_gif(model: BRO, path: Path) -> None:
    """Save one episode of the learned policy."""
    from PIL import Image

    env = make_env(ENV, **ENV_ARGUMENTS, render_mode="rgb_array", width=240, height=240)
    frames = []
    observation, _ = env.reset(seed=0)
    for _ in range(100):
        frames.append(Image.fromarray(env.render()))
        observation, *_ = env.step(model.predict(observation, deterministic=True)[0])
    env.close()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=80, loop=0)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where the results go")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    folder: Path = args.folder
    folder.mkdir(parents=True, exist_ok=True)

    random = fresh_returns(RandomActions(args.seed), seed=args.seed)
    print(f"Random actions reach {random.mean():.0f} of 1000 on {ENV} (10 episodes).\n", flush=True)

    model = BRO("MlpPolicy", fresh_env(), **AGENT, seed=args.seed)
    files = dict(log_path=str(folder), best_model_save_path=str(folder))
    evaluation = Evaluation(fresh_env(), n_eval_episodes=5, eval_freq=EVERY, verbose=0, **files)
    start = time.time()
    model.learn(STEPS, callback=evaluation)
    minutes, steps = (time.time() - start) / 60, model.num_timesteps
    if not evaluation.solved:
        print(
            f"\nNot solved within {STEPS:,} steps, which would be a mean of {SOLVED}: here is the best policy so far."
        )
        model = BRO.load(folder / "best_model")
    model.save(folder / "model")
    returns = fresh_returns(model, seed=STEPS + args.seed)
    print(
        f"\nAfter {steps:,} steps, {minutes:.1f} minutes, BRO's policy reaches {returns.mean():.0f} ± "
        f"{returns.std():.0f} of 1000 (10 fresh episodes)."
    )

    log = np.load(folder / "evaluations.npz")
    simulator_steps = log["timesteps"] * ENV_ARGUMENTS.get("action_repeat", 1)
    run = Run("BRO 0.55M, replay ratio 4", folder, simulator_steps, log["results"].mean(axis=1))
    draw(ENV, [Curve(run.label, summarize([run]))], "return").savefig(folder / "learning_curve.png")
    print(f"Saved {folder / 'model.zip'} and {folder / 'learning_curve.png'}.")
    try:
        save_gif(model, folder / "behaviour.gif")
        print(f"Saved {folder / 'behaviour.gif'}.")
    except Exception as error:  # the demo is complete even if the graphics stack is not
        print(f"No GIF, since this machine cannot render ({error}): install libegl1 or libosmesa6.")
    print(
        "\nNext: README.md, and `.venv/bin/sb3-sample train --help` once `make test` or the [zoo] extra is installed."
    )


if __name__ == "__main__":
    main()
