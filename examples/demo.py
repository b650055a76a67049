"""
The demo of ``make demo``: BRO learns a DeepMind Control task from scratch while you watch, to catch a ball in a cup.

    python examples/demo.py [--folder demo]

It prints what random actions and what the learned policy reach, and leaves the model, a picture of the learning curve
and, where the machine can render without a screen, a GIF of the learned behaviour.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback, StopTrainingOnRewardThreshold
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from tqdm import tqdm

from sb3_sample import BRO, make_env
from sb3_sample.plots import Curve, Run, draw, summarize

ENV = "dmc/ball_in_cup-catch-v0"
STEPS, EVERY = 8_000, 500  # environment steps at most, and between two evaluations
SOLVED = 900  # evaluation return at which training ends


class ProgressWithReturn(EvalCallback):
    """A progress bar that shows the return of the latest evaluation."""

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.bar = tqdm(total=STEPS, unit="step", desc=f"BRO on {ENV}", dynamic_ncols=True)

    def _on_step(self) -> bool:
        self.bar.update(self.training_env.num_envs)
        n_evaluations = len(self.evaluations_timesteps)
        going_on = super()._on_step()
        if len(self.evaluations_timesteps) > n_evaluations:
            self.bar.set_postfix_str(f"evaluation return {self.last_mean_reward:.0f} of 1000")
        return going_on

    def _on_training_end(self) -> None:
        self.bar.close()


def save_gif(model: BRO, path: Path) -> None:
    """One episode of the learned policy."""
    from PIL import Image

    env = make_env(ENV, render_mode="rgb_array", width=240, height=240)
    frames = []
    observation, _ = env.reset(seed=0)
    for step in range(300):
        if step % 3 == 0:
            frames.append(Image.fromarray(env.render()))
        observation, *_ = env.step(model.predict(observation, deterministic=True)[0])
    env.close()
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=50, loop=0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("demo"), help="where the results go")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)

    env = Monitor(make_env(ENV))
    env.action_space.seed(0)
    returns = []
    for seed in range(5):
        env.reset(seed=seed)
        ended = False
        while not ended:
            *_, terminated, truncated, info = env.step(env.action_space.sample())
            ended = terminated or truncated
        returns.append(info["episode"]["r"])
    print(f"Random actions reach {np.mean(returns):.0f} of 1000 on {ENV} (5 episodes).\n")

    # The smallest critics and no resets: enough for this task, and quick on a laptop.
    model = BRO("MlpPolicy", ENV, model_size="0.55M", replay_ratio=4, learning_starts=1_000, resets=(), seed=0)
    evaluation = ProgressWithReturn(
        env,
        n_eval_episodes=5,
        eval_freq=EVERY,
        log_path=str(folder),
        best_model_save_path=str(folder),
        callback_on_new_best=StopTrainingOnRewardThreshold(SOLVED),
        verbose=0,
    )
    start = time.time()
    model.learn(STEPS, callback=evaluation)
    minutes = (time.time() - start) / 60
    steps = f"{model.num_timesteps:,} steps, {minutes:.1f} minutes"
    model = BRO.load(folder / "best_model")
    mean, std = evaluate_policy(model, env, n_eval_episodes=10)
    print(f"\nAfter {steps}, BRO's best policy reaches {mean:.0f} ± {std:.0f} of 1000 (10 episodes).")

    log = np.load(folder / "evaluations.npz")
    run = Run("BRO 0.55M, replay ratio 4", folder, log["timesteps"], log["results"].mean(axis=1))
    draw(ENV, [Curve(run.label, summarize([run]))], "return").savefig(folder / "learning_curve.png")
    print(f"Saved {folder / 'best_model.zip'} and {folder / 'learning_curve.png'}.")
    try:
        save_gif(model, folder / "behaviour.gif")
        print(f"Saved {folder / 'behaviour.gif'}.")
    except Exception as error:  # whatever the graphics stack lacks, the demo has done its work
        print(f"No GIF, since this machine cannot render ({error}): install libegl1 or libosmesa6.")
    print(
        "\nNext: README.md, and `.venv/bin/sb3-sample train --help` once `make test` or the [zoo] extra is installed."
    )


if __name__ == "__main__":
    main()
