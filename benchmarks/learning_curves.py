"""
Train one agent with the settings of the papers' comparison, evaluating as it learns.

    OMP_NUM_THREADS=1 python benchmarks/learning_curves.py --agent SAC --seed 0 --output runs

Every off-policy agent but CrossQ has the papers' shared settings: two hidden layers of 256, batch 256, two gradient
steps a transition, 10,000 random steps, target entropy -|A|/2, Adam 3e-4. SRSAC takes eight gradient steps and is reset
every 10,000 steps, the papers' 16 and 160,000 scaled to a short run.

    python benchmarks/learning_curves.py --agent MBMAPPO --action-repeat 4 --steps 40960 --eval-freq 2048

The on-policy agents have the settings of the MBMA paper (https://arxiv.org/abs/2210.13011), and observations and
rewards normalised by VecNormalize; "PPO" is MBMAPPO without simulated actions, which is stable_baselines3's PPO step
for step.

    python benchmarks/learning_curves.py --agent "CrossQ (sb3_contrib)" --env HalfCheetah-v5 --steps 50000

CrossQ and sb3_contrib's, with the published sizes and random steps. If a run of stable_baselines3's or sb3_contrib's
agent is interrupted and started again, it resumes from its last 1,000 steps.

The run goes to ``OUTPUT/AGENT/seed_SEED`` (``evaluations.npz``, Monitor files), ``learning_summary.py`` makes a table
and a picture of all of them.
"""

import argparse
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import sb3_sample

#: Arguments that differ from the class's defaults.
AGENTS: dict[str, dict[str, Any]] = {
    "SAC": {},
    "DAC": {},
    "VPLSAC": {},
    "TOPSAC": {},
    "GPLSAC": {},
    "OPLSAC": {},
    "OAC": {},
    "SRSAC": {"replay_ratio": 8, "resets": 10_000},
    "CrossQ": {},
}
#: Class and arguments of the on-policy agents.
ON_POLICY: dict[str, tuple[str, dict[str, Any]]] = {
    "PPO": ("MBMAPPO", {"n_simulated": 0}),
    "MBMAPPO": ("MBMAPPO", {}),
    "MBPOPPO": ("MBPOPPO", {}),
    "QMAPPO": ("QMAPPO", {}),
}
#: stable_baselines3.SAC with the same settings.
SB3 = "SAC (stable_baselines3)"
#: sb3_contrib.CrossQ with the published sizes and random steps, which CrossQ has by default.
CONTRIB = "CrossQ (sb3_contrib)"
#: Steps from one state of SB3 or CONTRIB to the next.
SAVE_EVERY = 1_000
#: Monitor file of the one environment.
MONITOR = "0.monitor.csv"


def environment(args: argparse.Namespace, seed: int, folder: Path | None = None, resumed: bool = False) -> VecEnv:
    """The environment for training, with Monitor files in ``folder``, or for evaluation."""
    kwargs = {} if args.action_repeat is None else {"action_repeat": args.action_repeat}
    training = folder is not None
    env = make_vec_env(
        args.env, seed=seed, env_kwargs=kwargs, monitor_dir=str(folder) if training else None,
        monitor_kwargs={"override_existing": not resumed} if training else None,
    )  # fmt: skip
    return VecNormalize(env, training=training, norm_reward=training) if args.agent in ON_POLICY else env


def build(agent: str, env: VecEnv, seed: int) -> Any:
    if agent in ON_POLICY:
        name, arguments = ON_POLICY[agent]
        return getattr(sb3_sample, name)("MlpPolicy", env, seed=seed, device="cpu", **arguments)
    if agent == SB3:
        return stable_baselines3.SAC(
            "MlpPolicy", env, learning_starts=10_000, gradient_steps=2, target_entropy=-env.action_space.shape[0] / 2,
            seed=seed, device="cpu",
        )  # fmt: skip
    if agent == CONTRIB:
        sizes = {"pi": [256, 256], "qf": [2048, 2048]}
        return sb3_contrib.CrossQ(
            "MlpPolicy", env, learning_starts=5_000, policy_kwargs={"net_arch": sizes}, seed=seed, device="cpu"
        )
    return getattr(sb3_sample, agent)("MlpPolicy", env, seed=seed, device="cpu", **AGENTS[agent])


class SaveState(BaseCallback):
    """
    Save the agent, its replay buffer and the Monitor file in ``FOLDER/states/STEPS``, and delete the state before once
    they are complete.
    """

    model: OffPolicyAlgorithm

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        if self.num_timesteps % SAVE_EVERY == 0:
            before = saved_states(self.folder)
            states = self.folder / "states"
            new = states / "incomplete"
            shutil.rmtree(new, ignore_errors=True)
            new.mkdir(parents=True)
            self.model.save(new / "model")
            self.model.save_replay_buffer(new / "replay_buffer")
            shutil.copy(self.folder / MONITOR, new)
            new.rename(states / str(self.num_timesteps))
            for state in before:
                shutil.rmtree(state)
        return True


def saved_states(folder: Path) -> list[Path]:
    """Complete states of the run in ``folder``, the last at the end."""
    states = [state for state in folder.glob("states/*") if state.name.isdecimal()]
    return sorted(states, key=lambda state: int(state.name))


def resume(args: argparse.Namespace, state: Path, folder: Path, evaluation: EvalCallback) -> OffPolicyAlgorithm:
    """The agent of ``state``, with a new episode and new random numbers; evaluations and episodes end there."""
    shutil.copy(state / MONITOR, folder)
    agent = stable_baselines3.SAC if args.agent == SB3 else sb3_contrib.CrossQ
    model: OffPolicyAlgorithm = agent.load(
        state / "model", environment(args, args.seed, folder, resumed=True), device="cpu"
    )
    model.load_replay_buffer(state / "replay_buffer")
    model.set_random_seed(args.seed + model.num_timesteps)
    evaluation.n_calls = model.num_timesteps
    if (folder / "evaluations.npz").exists():
        with np.load(folder / "evaluations.npz") as found:
            n = int((found["timesteps"] <= model.num_timesteps).sum())
            evaluation.evaluations_timesteps = found["timesteps"][:n].tolist()
            evaluation.evaluations_results = found["results"][:n].tolist()
            evaluation.evaluations_length = found["ep_lengths"][:n].tolist()
    return model


def main(given: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agent", required=True, choices=[SB3, CONTRIB, *AGENTS, *ON_POLICY])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--env", default="dmc/cartpole-swingup-v0")
    parser.add_argument("--action-repeat", type=int, help="of dmc/ environments; steps are decisions")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--eval-freq", type=int, default=5_000)
    parser.add_argument("--eval-episodes", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path("runs"))
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    args = parser.parse_args(given)
    torch.set_num_threads(args.threads)

    folder = args.output / args.agent / f"seed_{args.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    evaluation = EvalCallback(
        environment(args, args.seed + 1_000), n_eval_episodes=args.eval_episodes, eval_freq=args.eval_freq,
        log_path=str(folder), verbose=0,
    )  # fmt: skip
    states = saved_states(folder)
    if states:
        model = resume(args, states[-1], folder, evaluation)
    else:
        model = build(args.agent, environment(args, args.seed, folder), args.seed)
    log = folder / f"from_{model.num_timesteps}" if states else folder
    model.set_logger(configure(str(log), ["csv"]))
    peer = args.agent in (SB3, CONTRIB)
    model.learn(
        args.steps - model.num_timesteps,
        callback=[evaluation, SaveState(folder)] if peer else evaluation,
        reset_num_timesteps=not states,
    )
    model.save(folder / "model")


if __name__ == "__main__":
    main()
