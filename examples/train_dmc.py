"""
Train BRO Fast on a DeepMind Control task, with evaluations as in the published curves: 5 episodes of the pessimistic
actor's mean action. If interrupted and started again, it resumes where it stopped.

    python examples/train_dmc.py --env dmc/cartpole-swingup-v0 --steps 50000 --seed 0
"""

import argparse
from pathlib import Path

from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_sample import BROFast

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="dmc/cartpole-swingup-v0", help="environment id")
    parser.add_argument("--steps", type=int, default=50_000, help="environment steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", default="runs", help="where results go")
    args = parser.parse_args()

    folder = Path(args.folder) / args.env.replace("/", "_") / f"seed_{args.seed}"
    evaluation = EvalCallback(
        make_vec_env(args.env, seed=args.seed + 1_000),
        n_eval_episodes=5,
        eval_freq=2_500,
        log_path=str(folder),
        best_model_save_path=str(folder),
    )
    model = BROFast("MlpPolicy", make_vec_env(args.env, seed=args.seed), seed=args.seed, verbose=1)
    model.learn(args.steps, callback=evaluation, checkpoint=folder / "checkpoints", checkpoint_freq=5_000)
    model.save(folder / "final_model")
