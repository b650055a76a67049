"""Which ids there are, and that they are found wherever an environment is made."""

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_sample.envs import ALL_IDS, DMC_IDS, METAWORLD_IDS, MYOSUITE_IDS, make_env
from sb3_sample.envs.registration import MYOSUITE_TASKS, register_all


def run(code: str) -> str:
    """Run a program in a new interpreter and return what it prints."""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_dmc_is_the_suite_without_lqr() -> None:
    from dm_control import suite

    assert set(DMC_IDS) == {f"dmc/{domain}-{task}-v0" for domain, task in suite.ALL_TASKS if domain != "lqr"}
    assert len(DMC_IDS) == len(suite.ALL_TASKS) - 2


def test_metaworld_is_all_of_the_library() -> None:
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    assert sorted(METAWORLD_IDS) == sorted(f"metaworld/{task}" for task in ALL_V3_ENVIRONMENTS)
    assert len(METAWORLD_IDS) == 50


def test_myosuite_ids_exist_in_the_library() -> None:
    import myosuite

    assert set(MYOSUITE_TASKS.values()) <= set(myosuite.myosuite_myobase_suite)
    assert len(MYOSUITE_IDS) == 10


def test_registering_again_changes_nothing(recwarn: pytest.WarningsRecorder) -> None:
    before = {env_id: gym.registry[env_id] for env_id in ALL_IDS}
    register_all()
    assert all(gym.registry[env_id] is spec for env_id, spec in before.items())
    assert len(recwarn) == 0


def test_importing_the_package_imports_no_library() -> None:
    libraries = "('dm_control', 'metaworld', 'myosuite', 'mujoco')"
    print_imported = f"import sys, sb3_sample; print([name for name in {libraries} if name in sys.modules])"
    assert run(print_imported).strip() == "[]"


@pytest.mark.slow
def test_the_module_prefix_needs_no_import() -> None:
    code = "import gymnasium as gym; print(gym.make('sb3_sample:dmc/acrobot-swingup-v0').spec.id)"
    assert run(code).strip() == "dmc/acrobot-swingup-v0"


@pytest.mark.parametrize(
    ("env_id", "module", "extra"),
    [
        ("dmc/cheetah-run-v0", "dm_control.suite", "dmc"),
        ("metaworld/push-v3", "metaworld.env_dict", "metaworld"),
        ("myosuite/pose-v0", "myosuite", "myosuite"),
    ],
)
def test_a_missing_library_names_its_extra(
    env_id: str, module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    then = ", then: pip install --no-deps dm-control" if extra == "dmc" and sys.version_info >= (3, 13) else ""
    with pytest.raises(ImportError, match=rf'pip install -e "\.\[{extra}\]" in the checkout of sb3_sample{then}$'):
        gym.make(env_id)


@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
def test_an_unknown_id_names_close_ones() -> None:
    with pytest.raises(gym.error.UnregisteredEnv, match="dmc/cheetah-run-v0"):
        make_env("dmc/cheeta-run-v0")
    with pytest.raises(gym.error.UnregisteredEnv, match="metaworld/push-v3"):
        make_env("metaworld/push-v2")
    with pytest.raises(gym.error.UnregisteredEnv, match="ALL_IDS"):
        make_env("-")


def test_an_id_given_to_an_algorithm() -> None:
    model = SAC("MlpPolicy", "metaworld/reach-v3", learning_starts=1000, buffer_size=1000).learn(200)
    assert model.ep_success_buffer is not None and len(model.ep_success_buffer) == 1


@pytest.mark.slow
@pytest.mark.parametrize("start_method", ["spawn", "forkserver"])
def test_workers_that_never_imported_the_package(start_method: str) -> None:
    # In a program given by -c a worker cannot import the main module again, as it would a script's.
    code = f"""
import sb3_sample
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
settings = dict(vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method={start_method!r}))
for env_id in ("dmc/acrobot-swingup-v0", "metaworld/reach-v3"):
    env = make_vec_env(env_id, n_envs=2, seed=0, **settings)
    print(env.reset().shape)
    env.close()
"""
    assert run(code).splitlines() == ["(2, 6)", "(2, 39)"]


@pytest.mark.slow
def test_workers_play_the_same_episodes() -> None:
    settings: dict = {"vec_env_cls": SubprocVecEnv, "vec_env_kwargs": {"start_method": "spawn"}}
    workers = make_vec_env("dmc/acrobot-swingup-v0", n_envs=1, seed=3, env_kwargs={"action_repeat": 4}, **settings)
    here = make_vec_env("dmc/acrobot-swingup-v0", n_envs=1, seed=3, env_kwargs={"action_repeat": 4})
    np.testing.assert_array_equal(workers.reset(), here.reset())
    workers.close()
