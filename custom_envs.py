"""
The stock zoo's way in: ``python -m rl_zoo3.train`` imports a module of this name, if there is one on its path, before
it reads its command line. In this folder that puts our algorithms and environments into it.
"""

try:
    from sb3_sample.zoo import register

    register()
except ImportError as error:
    # The zoo takes any ImportError for "there is no custom_envs" and goes on without a word.
    raise RuntimeError(f"sb3_sample could not be put into the zoo: {error}") from error
