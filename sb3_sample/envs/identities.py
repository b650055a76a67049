"""Which environments are the same ones."""

from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv


def identities(env: GymEnv) -> set[int]:
    """
    Identify the environments in an environment.

    :param env: environment, vectorised or not
    :return: identities of those in this process, below all wrappers that can be unwrapped
    """
    innermost = env.unwrapped
    inside = [e.unwrapped for e in innermost.envs] if isinstance(innermost, DummyVecEnv) else []
    return {id(e) for e in [innermost, *inside]}
