"""
Train BRC on several tasks at once, MT10 of Meta-World by default, and evaluate each task; or BRO Fast or SAC with all
widths doubled, as in BRO's figure 19. If interrupted and started again, it resumes where it stopped.

    python examples/multi_task.py --steps 10000 --seed 0
    python examples/multi_task.py --steps 10000 --seed 0 --agent bro_fast --folder runs/multi_task_bro_fast

With critics of width 512, the default, MT10 takes two gradient steps of 28 GFLOP for each step of its ten tasks: hours
on one CPU core. The published width is 4096.
"""

import argparse
from pathlib import Path
from typing import Any

from sb3_sample import BRC, SAC, BROFast, MultiTaskEvalCallback, multi_task_env


def main(given: list[str] | None = None) -> None:
    """
    :param given: arguments of the command line; None: the program's own
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", default=["MT10"], help="ids of environments, and names of suites")
    parser.add_argument("--steps", type=int, default=10_000, help="environment steps of each task")
    parser.add_argument("--random-steps", type=int, default=500, help="of each task, before the first gradient step")
    parser.add_argument("--eval-every", type=int, default=5_000, help="steps of each task between two evaluations")
    parser.add_argument("--episodes", type=int, default=10, help="of each task in an evaluation")
    parser.add_argument("--agent", choices=["brc", "bro_fast", "sac"], default="brc")
    parser.add_argument("--critic-width", type=int, help="of brc (default: 512)")
    parser.add_argument("--batch-size", type=int, help="default: 1024 for brc, 128 for bro_fast, 256 for sac")
    parser.add_argument("--buffer-size", type=int, default=1_000_000, help="transitions kept of each task")
    parser.add_argument("--max-episode-steps", type=int, help="time limit; that of the environments if left out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", default="runs/multi_task", help="where results go")
    args = parser.parse_args(given)
    if args.agent != "brc" and args.critic_width is not None:
        parser.error(f"--critic-width is of brc, and --agent is {args.agent}: leave it out")

    folder = Path(args.folder) / f"seed_{args.seed}"
    env_kwargs = {} if args.max_episode_steps is None else {"max_episode_steps": args.max_episode_steps}
    env = multi_task_env(args.tasks, seed=args.seed, env_kwargs=env_kwargs)
    evaluation = MultiTaskEvalCallback(
        multi_task_env(args.tasks, seed=args.seed + 1_000, env_kwargs=env_kwargs),
        n_eval_episodes=args.episodes,
        eval_freq=args.eval_every,
        log_path=folder / "tasks",
    )
    shared: dict[str, Any] = {
        "buffer_size": args.buffer_size * env.num_envs,
        "learning_starts": args.random_steps * env.num_envs,
        "seed": args.seed,
        "verbose": 1,
    }
    if args.batch_size is not None:
        shared["batch_size"] = args.batch_size
    model: SAC
    if args.agent == "brc":
        shared = {"batch_size": 1024, **shared}
        model = BRC("MultiInputPolicy", env, critic_width=args.critic_width or 512, **shared)
    elif args.agent == "bro_fast":
        model = BROFast("MultiInputPolicy", env, multitask=True, **shared)
    else:
        model = SAC("MultiInputPolicy", env, multitask=True, replay_ratio=2, **shared)
    model.learn(
        args.steps * env.num_envs,
        callback=evaluation,
        checkpoint=folder / "checkpoints",
        checkpoint_freq=1_000 * env.num_envs,
    )
    model.save(folder / "final_model")


if __name__ == "__main__":
    main()
