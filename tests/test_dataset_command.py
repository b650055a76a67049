"""``sb3-sample dataset``."""

import json
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_sample import Dataset, dataset_command
from sb3_sample.cli import main
from sb3_sample.saving import save_vec_normalize
from tests.sac.common import MAKERS, sac

pytest.importorskip("minari", reason="needs the extra [offline]")


def test_record_and_show(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = sac("Pendulum-v1")
    model.save(tmp_path / "model")
    main(["dataset", "record", str(tmp_path / "model.zip"), str(tmp_path / "set"), "--env", "Pendulum-v1",
          "--episodes", "2"])  # fmt: skip
    assert "400 transitions of 2 episodes written to" in capsys.readouterr().out
    data = Dataset.from_minari(tmp_path / "set")
    rows = data.rows(slice(None))
    np.testing.assert_allclose(rows["actions"], model.predict(rows["observations"], deterministic=True)[0], atol=1e-5)
    main(["dataset", "info", str(tmp_path / "set"), "--json"])
    facts = json.loads(capsys.readouterr().out)
    assert facts["fingerprint"] == data.fingerprint and facts["episodes"] == facts["truncated"] == 2
    assert facts["mean_return"] == pytest.approx(float(rows["rewards"].astype(float).sum()) / 2)
    main(["dataset", "info", str(tmp_path / "set")])
    assert "mean length            200.0" in capsys.readouterr().out


def test_a_place_that_is_taken_is_refused_before_the_recording(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def record(*args: object, **kwargs: object) -> None:
        raise AssertionError("recorded")

    monkeypatch.setattr(dataset_command, "record", record)
    monkeypatch.setattr(dataset_command, "read_dataset", record)
    sac("Pendulum-v1").save(tmp_path / "model")
    (tmp_path / "set" / "data").mkdir(parents=True)
    for source in (["record", str(tmp_path / "model.zip")], ["convert", str(tmp_path / "d4rl.hdf5")]):
        with pytest.raises(SystemExit):
            main(["dataset", *source, str(tmp_path / "set"), "--env", "Pendulum-v1"])
        assert "must be new" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main(["dataset", *source, str(tmp_path / "model.zip" / "set"), "--env", "Pendulum-v1"])
        assert "must be in a folder that can be written to, and" in capsys.readouterr().err


def test_models_of_all_algorithms_are_recorded(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for maker in "CrossQ", "DebiasedRQ":
        MAKERS[maker](env="Pendulum-v1").save(tmp_path / maker)
        main(["dataset", "record", str(tmp_path / f"{maker}.zip"), str(tmp_path / f"{maker}-data"), "--env",
              "Pendulum-v1", "--episodes", "1"])  # fmt: skip
        assert "200 transitions of 1 episodes written to" in capsys.readouterr().out


def test_the_environment_of_the_training_can_be_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_tasks.py").write_text(
        "import gymnasium as gym\n"
        "from gymnasium.envs.classic_control import PendulumEnv\n"
        "gym.register('MyPendulum-v0', PendulumEnv, max_episode_steps=50)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    sac("Pendulum-v1").save(tmp_path / "model")
    arguments = ["dataset", "record", str(tmp_path / "model.zip"), str(tmp_path / "set"), "--env", "MyPendulum-v0",
                 "--episodes", "1", "--gym-packages", "my_tasks"]  # fmt: skip
    main([*arguments, "--env-kwargs", "g:0.0"])
    assert "50 transitions of 1 episodes" in capsys.readouterr().out
    rows = Dataset.from_minari(tmp_path / "set").rows(slice(None))
    # Without gravity the torque alone changes the speed.
    speeds = rows["observations"][:, 2]
    expected = np.clip(speeds[:-1] + rows["actions"][:-1, 0] * 3 * 0.05, -8, 8)
    np.testing.assert_allclose(speeds[1:], expected, atol=1e-4)
    with pytest.raises(SystemExit):
        main([*arguments, "--env-kwargs", "g=0"])
    assert "'g=0' is no name with a value of Python's" in capsys.readouterr().err
    arguments[3] = str(tmp_path / "other")
    with pytest.raises(SystemExit):
        main([*arguments, "--env-kwargs", "nope:1"])
    assert "MyPendulum-v0 cannot be made with --env-kwargs {'nope': 1}: PendulumEnv" in capsys.readouterr().err


def test_a_model_of_normalized_observations_needs_their_statistics(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    venv = VecNormalize(make_vec_env("Pendulum-v1"))
    model = sac(venv).learn(30)
    model.save(tmp_path / "model")
    save_vec_normalize(venv, tmp_path / "statistics")
    arguments = ["dataset", "record", str(tmp_path / "model.zip"), str(tmp_path / "set"), "--env", "Pendulum-v1",
                 "--episodes", "1"]  # fmt: skip
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2 and not (tmp_path / "set").exists()
    assert "env must be in a VecNormalize with the statistics" in capsys.readouterr().err
    main([*arguments, "--vecnormalize", str(tmp_path / "statistics")])
    rows = Dataset.from_minari(tmp_path / "set").rows(slice(None))
    seen = venv.normalize_obs(rows["observations"])
    np.testing.assert_allclose(rows["actions"], model.predict(seen, deterministic=True)[0], atol=1e-5)


def test_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    h5py = pytest.importorskip("h5py")
    n, zeros = 12, np.zeros(12, bool)
    ends = zeros.copy()
    ends[5] = True
    observations = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    with h5py.File(tmp_path / "old.hdf5", "w") as file:
        for name, values in {
            "observations": observations, "actions": np.full((n, 1), 1.5, np.float32),
            "rewards": np.arange(n, dtype=np.float32), "terminals": ends, "timeouts": zeros,
        }.items():  # fmt: skip
            file[name] = values
    monkeypatch.chdir(tmp_path)
    with pytest.warns(UserWarning, match="no last observation is known of 1 terminated episode,"):
        main(["dataset", "convert", "old.hdf5", "sets/new", "--env", "Pendulum-v1"])
    output = capsys.readouterr().out
    assert "11 transitions of 2 episodes written to" in output and "(1 step without a next observation" in output
    rows = Dataset.from_minari("sets/new").rows(slice(None))
    assert Dataset.from_minari(tmp_path / "sets" / "new").fingerprint == Dataset.from_minari("sets/new").fingerprint
    assert rows["rewards"].tolist() == list(range(11)) and rows["actions"].ravel().tolist() == [1.5] * 11
    assert np.flatnonzero(rows["terminations"]).tolist() == [5]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["info", "none"], "id_or_path='none' must be a data set of Minari's"),
        (["info", "none.hdf5"], "path='none.hdf5' must be an HDF5 file"),
        (["info", "none", "--env", "Pendulum-v1"], "env='Pendulum-v1' is for HDF5 files"),
        (["record", "none.zip", "out", "--env", "Pendulum-v1"], "none.zip"),
    ],
)  # fmt: skip
def test_what_is_refused(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        main(["dataset", *arguments])
    assert end.value.code == 2 and words in capsys.readouterr().err
