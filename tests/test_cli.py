"""The command line, run in this process where that is enough."""

import io
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_sample import cli

ENV = "dmc/pendulum-swingup-v0"
NAME = "dmc-pendulum-swingup-v0"
TINY = ["-params", "model_size:'0.55M'", "learning_starts:25", "replay_ratio:0.2", "buffer_size:2000"]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Runs the command in an empty folder; the zoo's commands change ``sys.argv``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sb3-sample"])
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return lambda *arguments: cli.main(arguments)


@pytest.fixture
def zoo_run(run):
    pytest.importorskip("rl_zoo3")
    pytest.importorskip("dm_control")
    return run


def test_help_lists_the_commands(run, capsys: pytest.CaptureFixture[str]) -> None:
    run()
    output = capsys.readouterr().out
    assert all(command in output for command in cli.COMMANDS)
    run("--version")
    assert capsys.readouterr().out.strip() == cli.__version__


def test_a_reader_that_has_gone_ends_the_command(run, monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as gone, monkeypatch.context() as patched:
        patched.setattr("sys.stdout", gone)
        with pytest.raises(SystemExit) as caught:
            run("--help")
        assert caught.value.code == 128 + signal.SIGPIPE
    monkeypatch.setitem(cli.COMMANDS, "plot", cli.Command(lambda _: (_ for _ in ()).throw(BrokenPipeError()), ""))
    with pytest.raises(BrokenPipeError):  # of another pipe
        run("plot")


def test_an_unknown_command_is_refused(run) -> None:
    with pytest.raises(SystemExit, match=r"command must be one of train, .*, not 'trian'"):
        run("trian")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "-params", "modelsize:'0.55M'"], "modelsize is no hyper.* of bro, you maybe meant model_size"),
        (["train", "-params", "seed:3"], "seed is no hyperparameter of bro, which has .*learning_rate"),
        (["train", "-params", "model_size:0.55M"], "-params must be NAME:VALUE.*, not 'model_size:0.55M' .SyntaxError"),
        (["train", "-params", "gamma:0.9", "resets"], "-params must be NAME:VALUE.*, not 'resets'"),
        (["train", "--env-kwargs", "g:x"], "--env-kwargs must be NAME:VALUE.*, not 'g:x' .NameError"),
        (["enjoy", "--env-kwargs", "g:x"], "--env-kwargs must be NAME:VALUE.*, not 'g:x' .NameError"),
        (["record_video", "--env-kwargs", "g:x"], "--env-kwargs must be NAME:VALUE.*, not 'g:x' .NameError"),
        (
            ["train", "--env-kwargs", "nope:1"],
            "Pendulum-v1 cannot be made with env_kwargs={'nope': 1}: .*argument 'nope'",
        ),
        (["train", "-params", "policy_kwargs:'dict('"], "a hyperparameter that is a text of Python is none"),
        (["train", "-params", "replay_ratio:-1"], "replay_ratio must be at least 0 and finite, or None, not -1"),
        (["train", "-params", "replay_buffer_kwargs:dict(x=3)"], "replay_buffer_kwargs has 'x', which is no argument"),
        (["train", "-i", "logs/model.zip"], "-i must be a .zip file of a model, not 'logs/model.zip', which is not th"),
        (["train", "--env", "Pendulum-v9"], "Pendulum-v9 not found in gym registry"),
    ],
)
def test_a_wrong_argument_is_one_line(
    zoo_run, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    command, *rest = arguments
    with pytest.raises(SystemExit, match=message) as caught:
        zoo_run(command, "--algo", "bro", "--env", "Pendulum-v1", *rest)
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"sb3-sample {command}: ")
    # Otherwise enjoy would take it for the latest run.
    assert not list(Path("logs").rglob("Pendulum-v1_*"))


def test_an_error_of_anything_else_keeps_its_traceback(zoo_run, monkeypatch: pytest.MonkeyPatch) -> None:
    from gymnasium.envs.classic_control import PendulumEnv

    def broken(self: object, **_: object) -> None:
        raise ValueError("of the environment's own")

    monkeypatch.setattr(PendulumEnv, "reset", broken)
    with pytest.raises(ValueError, match="of the environment's own"):
        zoo_run("train", "--algo", "bro", "--env", "Pendulum-v1", "-n", "20", *TINY)


def test_train_shows_the_options_of_the_zoo(zoo_run, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        zoo_run("train", "--help")
    assert exit_.value.code == 0
    output = capsys.readouterr().out
    assert "usage: sb3-sample train" in output
    assert "--optimize-hyperparameters" in output
    assert "bro_fast" in output


@pytest.mark.slow
def test_train_continue_enjoy_and_plot_an_id_with_a_slash(zoo_run, capsys: pytest.CaptureFixture[str]) -> None:
    folder = Path("logs/bro") / f"{NAME}_1"
    zoo_run(
        "train", "--algo", "bro", "--env", ENV, "-n", "1010", "--seed", "3", "--eval-freq", "505",
        "--eval-episodes", "2", "--save-freq", "505", "--save-replay-buffer", "-P", *TINY,
    )  # fmt: skip
    for file in (f"{NAME}.zip", "replay_buffer.pkl", "rl_model_505_steps.zip", "best_model.zip", "0.monitor.csv"):
        assert (folder / file).exists()
    assert list(np.load(folder / "evaluations.npz")["timesteps"]) == [505, 1010]

    zoo_run("train", "--algo", "bro", "--env", ENV, "-n", "20", "-i", f"{folder}/{NAME}.zip", "--eval-freq", "-1")
    assert "Loading replay buffer" in capsys.readouterr().out
    assert (Path("logs/bro") / f"{NAME}_2" / f"{NAME}.zip").exists()

    for which in (["--load-best"], ["--load-checkpoint", "505"], ["--load-last-checkpoint"]):
        zoo_run("enjoy", "--algo", "bro", "--env", ENV, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "5", *which)
    zoo_run("enjoy", "--algo", "bro", "--env", ENV, "-f", "logs", "--exp-id", "1", "--no-render", "-n", "1000")
    assert "1 Episodes" in capsys.readouterr().out

    pytest.importorskip("seaborn")
    from matplotlib import pyplot as plt

    plt.close("all")  # of other tests
    zoo_run("plot_train", "--algo", "bro", "--env", ENV, "-f", "logs", "-w", "1")
    assert plt.gca().get_legend_handles_labels()[1] == [f"{NAME}_1"]  # run 2 has no finished episode
    # The zoo's tables need two runs.
    shutil.copytree(folder, folder.with_name(f"{NAME}_3"))
    zoo_run("all_plots", "--algos", "bro", "--env", ENV, "-f", "logs", "-o", "all", "--no-display")
    assert Path("all.pkl").exists()
    zoo_run("plot_from_file", "-i", "all.pkl", "-o", "all.png", "--format", "png")
    assert Path("all.png").exists()
    plt.close("all")

    zoo_run("plot", str(folder), "-o", "picture.png")
    assert Path("picture.png").exists()
    assert "| 505 |" in capsys.readouterr().out


def write_evaluations(task: str, algorithm: str, seed: int, **arrays: np.ndarray) -> None:
    folder = Path(f"logs/{algorithm}/{task.replace('/', '-')}_{seed}")
    folder.mkdir(parents=True)
    np.savez(folder / "evaluations.npz", timesteps=np.arange(1, 6) * 1_000, **arrays)


@pytest.fixture
def rliable(run, monkeypatch: pytest.MonkeyPatch):
    """Runs ``plot_from_file --rliable`` on runs of some tasks; gives the scores that rliable is given."""
    pytest.importorskip("rl_zoo3")
    pytest.importorskip("seaborn")
    library = pytest.importorskip("rliable.library")
    from matplotlib import pyplot as plt

    returns = np.arange(1, 6)[:, None] * [100.0, 120.0]  # the last evaluation: 500 and 600
    for seed in (1, 2, 3):
        for algorithm in ("bro", "sac"):
            for task in ("dmc/cheetah-run-v0", "dmc/walker-run-v0"):
                write_evaluations(task, algorithm, seed, results=returns + seed)
            write_evaluations("metaworld/push-v3", algorithm, seed, results=returns * 9, successes=returns / 1_000)
            write_evaluations("Pendulum-v1", algorithm, seed, results=-returns)
    seen: list[dict[str, np.ndarray]] = []
    estimates = library.get_interval_estimates

    def spy(scores: dict[str, np.ndarray], *args: object, **kwargs: object):
        seen.append(scores)
        return estimates(scores, *args, **{**kwargs, "reps": 20})

    def profile(scores: dict[str, np.ndarray], *_: object, **__: object):
        seen.append(scores)
        return {}, {}

    monkeypatch.setattr(library, "get_interval_estimates", spy)
    monkeypatch.setattr(library, "create_performance_profile", profile)

    def draw(tasks: list[str], *arguments: str, key: str = "results") -> list[dict[str, np.ndarray]]:
        run("all_plots", "--algos", "bro", "sac", "--env", *tasks, "-f", "logs", "-k", key, "-o", "x", "--no-display")
        run("plot_from_file", "-i", "x", *arguments)
        return seen

    yield draw
    plt.close("all")


def test_rliable_plots_are_of_scores_between_0_and_1(rliable, capsys: pytest.CaptureFixture[str], recwarn) -> None:
    aggregated, profile, versus, curve = rliable(
        ["dmc/cheetah-run-v0", "dmc/walker-run-v0"], "--rliable", "--versus", "--iqm"
    )
    # Of both tasks, runs 1 to 3: the mean of 500 and 600, and the run's number.
    expected = (550 + np.array([[1, 1], [2, 2], [3, 3]])) / 1_000
    for scores in (aggregated, profile):
        assert set(scores) == {"BRO-logs", "SAC-logs"}
        for matrix in scores.values():
            np.testing.assert_allclose(np.sort(matrix, axis=0), expected)
    np.testing.assert_allclose(np.sort(versus["BRO-logs, SAC-logs"][0], axis=0), expected)
    assert curve["BRO-logs"].shape == (3, 2, 2) and curve["BRO-logs"].max() == pytest.approx(0.553)
    assert "returns of DeepMind Control over 1,000" in capsys.readouterr().out
    assert not [w for w in recwarn if "normalizing scores" in str(w.message)]


def test_rliable_plots_take_success_rates_as_they_are(rliable) -> None:
    for scores in rliable(["metaworld/push-v3"], "-r", key="successes")[:2]:
        np.testing.assert_allclose(scores["BRO-logs"], 0.55)


def test_rliable_plots_of_raw_returns_are_refused(rliable) -> None:
    with pytest.raises(SystemExit, match="metaworld-push-v3 are returns.* all_plots --key successes"):
        rliable(["metaworld/push-v3"], "--rliable")
    with pytest.raises(SystemExit, match="for Pendulum-v1 there is no score to .*--skip-envs.* study aggregate"):
        rliable(["dmc/cheetah-run-v0", "Pendulum-v1"], "--rliable")
    for leaving_out in (["--skip-envs", "Pendulum-v1"], ["--keep-envs", "dmc/cheetah-run-v0"]):
        scores = rliable(["dmc/cheetah-run-v0", "Pendulum-v1"], "--rliable", *leaving_out)[-1]
        assert scores["BRO-logs"].shape == (3, 1) and scores["BRO-logs"].max() < 1


@pytest.mark.parametrize(("task", "unit"), [("HalfCheetah-v5", 8_500), ("Ant-v4", 6_625), ("FetchReach-v4", 1)])
def test_tasks_of_gymnasium_are_normalised_by_their_ids(task: str, unit: float) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_sample.zoo.files import RunError
    from sb3_sample.zoo.scores import _score

    assert _score(task, {"mean": np.array([0.5]), "last_evals": np.array([[1.0]])}).of(unit) == 1
    for pybullet in ("Half", "Ant"):
        with pytest.raises(RunError, match=f"zoo's for '{pybullet}' are those of PyBullet's.* study aggregate"):
            _score(pybullet, {})


def test_games_of_atari_are_between_random_play_and_a_human(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_sample.zoo.files import PlottedRuns
    from sb3_sample.zoo.scores import NormalizedRuns

    runs = {"timesteps": np.array([4.0]), "mean": np.array([-20.7, 14.6]), "std_error": np.array([3.53])}
    monkeypatch.setattr(PlottedRuns, "load", lambda *_: {"ALE-Pong-v5": {"SRSPR-logs": {**runs, "last_evals": 14.6}}})
    found = NormalizedRuns(False).load(io.BytesIO())["ALE-Pong-v5"]["SRSPR-logs"]
    np.testing.assert_allclose(found["mean"], [0, 1])
    np.testing.assert_allclose(found["std_error"], 0.1)
    assert found["last_evals"] == 1 and found["timesteps"] == 4


def test_plots_find_the_folders_of_atari_games(run, monkeypatch: pytest.MonkeyPatch) -> None:
    plots = pytest.importorskip("rl_zoo3.plots")
    seen: list[str] = []
    monkeypatch.setattr(plots, "all_plots", lambda: seen.extend(sys.argv))
    run("all_plots", "--env", "ALE/Pong-v5")
    assert seen[-1] == "ALE-Pong-v5"


def test_without_rliable_scores_are_as_they_were(rliable) -> None:
    assert rliable(["metaworld/push-v3", "Pendulum-v1", "dmc/walker-run-v0"]) == []
    from matplotlib import pyplot as plt

    heights = [bar.get_height() for bar in plt.figure("Sensitivity plot").axes[0].patches]
    assert max(heights) == pytest.approx(550 * 9)


#: What runs in a few seconds and still takes gradient steps, in the cheapest of each algorithm's networks.
SHORT = ["--env", "Pendulum-v1", "--eval-freq", "-1", "--device", "cpu"]
QUICK = ("dac", "vpl_sac")
NAMES = [
    "brc", "bro", "bro_fast", "bro_td3", "crossq", "dac", "dr_q", "flash_sac", "gpl_sac", "oac", "opl_sac",
    "regularized_sac", "sac_sample", "simba", "simbav2", "sr_sac", "top_sac", "vpl_sac", "xqc",
]  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in NAMES])
def test_every_algorithm_trains_in_two_environments_goes_on_and_is_shown(
    zoo_run, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    params = ["-params", "learning_starts:20", "buffer_size:2000", "replay_ratio:1", "n_envs:2"]
    file = f"logs/{name}/Pendulum-v1_1/Pendulum-v1.zip"
    zoo_run("train", "--algo", name, *SHORT, "-n", "60", "--save-replay-buffer", *params)
    assert Path(f"logs/{name}/Pendulum-v1_1/1.monitor.csv").exists()
    zoo_run("train", "--algo", name, *SHORT, "-n", "40", "-i", file, *params)
    assert "Loading replay buffer" in capsys.readouterr().out
    for run_id in ("1", "2"):
        zoo_run(
            "enjoy", "--algo", name, "--env", "Pendulum-v1", "-f", "logs", "--exp-id", run_id, "--no-render",
            "-n", "210", "--device", "cpu",
        )  # fmt: skip
    assert capsys.readouterr().out.count("1 Episodes") == 2

    from rl_zoo3 import ALGOS

    first, second = (ALGOS[name].load(file.replace("_1/", f"_{run_id}/"), device="cpu") for run_id in "12")
    # Transitions of both environments; gradient steps for those after the warm-up.
    assert (first.num_transitions, first._n_updates) == (60, 40)
    assert (second.num_transitions, second._n_updates) == (100, 80)


#: What makes the models of the MBMA paper's algorithms small.
ON_POLICY = {
    "mbma_ppo": "dynamics_kwargs:dict(width=8)",
    "mbpo_ppo": "dynamics_kwargs:dict(width=8)",
    "qma_ppo": "q_kwargs:dict(width=8)",
    "rewound_ppo": "copies:4",
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "rewound_ppo" else []) for name in ON_POLICY]
)
def test_p1s_algorithms_train_in_two_environments_go_on_and_are_shown(
    zoo_run, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    params = ["-params", "n_steps:16", "batch_size:8", "n_envs:2", "policy_kwargs:dict(net_arch=[8])", ON_POLICY[name]]
    file = f"logs/{name}/Pendulum-v1_1/Pendulum-v1.zip"
    zoo_run("train", "--algo", name, *SHORT, "-n", "64", *params)
    zoo_run("train", "--algo", name, *SHORT, "-n", "32", "-i", file, *params)
    zoo_run("enjoy", "--algo", name, "--env", "Pendulum-v1", "-f", "logs", "--no-render", "-n", "210")
    assert "1 Episodes" in capsys.readouterr().out

    from rl_zoo3 import ALGOS

    first, second = (ALGOS[name].load(file.replace("_1/", f"_{run_id}/"), device="cpu") for run_id in "12")
    assert second._n_updates > first._n_updates > 0
    if name not in ("qma_ppo", "rewound_ppo"):
        assert (first.transitions.size, second.transitions.size) == (64, 96)


def test_every_algorithm_is_run() -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_sample.zoo import ALGORITHMS

    # Those that learn from data sets: test_zoo_data.py; from Atari: tests/srspr. Those from drawn pictures are built in
    # test_zoo.py, and trained in sac/test_drq.py.
    assert list(ALGORITHMS) == sorted([*NAMES, *ON_POLICY, "bc", "iql", "td3bc", "srspr", "drq", "drqv2"])


@pytest.mark.slow
def test_regularizations_and_the_high_replay_ratio_stay_when_a_run_goes_on(zoo_run) -> None:
    small = ["learning_starts:20", "buffer_size:2000"]
    zoo_run(
        "train", "--algo", "regularized_sac", *SHORT, "-n", "40", "--save-replay-buffer", "-params", *small,
        "replay_ratio:16", "critic_regularization:'gpl'", "network_regularization:['layer_norm', 'weight_decay']",
        "plasticity_regularization:['resets', 'sam']", "sam_radius:0.1",
    )  # fmt: skip
    file = "logs/regularized_sac/Pendulum-v1_1/Pendulum-v1.zip"
    zoo_run("train", "--algo", "regularized_sac", *SHORT, "-n", "10", "-i", file, "-params", *small)

    from sb3_sample import RegularizedSAC

    model = RegularizedSAC.load(file.replace("_1/", "_2/"), device="cpu")
    assert (model.replay_ratio, model.resets, model.sam_radius, model.weight_decay) == (16, 160_000, 0.1, 0.01)
    assert model.network_regularization == ["layer_norm", "weight_decay"]
    assert model._n_updates == 16 * (20 + 10)


def test_the_algorithms_of_the_zoo_go_on_working(zoo_run, capsys: pytest.CaptureFixture[str]) -> None:
    zoo_run("train", "--algo", "sac", "--env", "Pendulum-v1", "-n", "110", "--eval-freq", "-1")
    assert "rl_zoo3/hyperparams/sac.yml" in capsys.readouterr().out
    assert Path("logs/sac/Pendulum-v1_1/Pendulum-v1.zip").exists()


def test_a_missing_zoo_is_named(tmp_path: Path) -> None:
    code = "import sys; sys.modules['rl_zoo3'] = None; from sb3_sample.cli import main; main(['train'])"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert result.returncode == 1
    assert 'pip install -e ".[zoo]"' in result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
def test_a_broken_import_is_not_taken_for_a_missing_zoo(tmp_path: Path) -> None:
    (tmp_path / "optuna.py").write_text("raise ImportError('broken')")  # stands before the installed one
    code = "from sb3_sample.cli import main; main(['train'])"
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert result.returncode == 1
    assert "ImportError: broken" in result.stderr
    assert "pip install" not in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "env_id"),
    [("bro_fast", "Pendulum-v1"), ("bro_fast", ENV), ("regularized_sac", "Pendulum-v1"), ("vpl_sac", "Pendulum-v1")],
)
def test_search_store_and_train_with_a_stored_trial(
    zoo_run, capsys: pytest.CaptureFixture[str], name: str, env_id: str
) -> None:
    study = ["--storage", "sqlite:///study.db", "--study-name", "study"]
    zoo_run(
        "train", "--algo", name, "--env", env_id, "-n", "60", "-optimize", "--n-trials", "2",
        "--n-startup-trials", "1", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots", *study,
        "-params", "learning_starts:50",
    )  # fmt: skip
    import optuna

    from sb3_sample.zoo import ALGORITHMS

    trials = optuna.load_study(storage="sqlite:///study.db", study_name="study").trials
    assert len(trials) == 2
    zoo_run("train", "--algo", name, "--env", env_id, "-n", "30", "--eval-freq", "-1", *study, "--trial-id", "1")
    output = capsys.readouterr().out
    assert len(trials[1].params) > 4
    for argument, value in ALGORITHMS[name].convert(trials[1].params).items():
        assert re.search(rf"\('{argument}',\s+{re.escape(repr(value))}\)", output)


@pytest.mark.slow
def test_subprocesses_in_the_installed_command(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    pytest.importorskip("dm_control")
    command = Path(sys.executable).parent / "sb3-sample"
    arguments = ["train", "--algo", "bro_fast", "--env", ENV, "-n", "60", "--vec-env", "subproc", *TINY, "n_envs:2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    result = subprocess.run(
        [str(command), *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "logs/bro_fast" / f"{NAME}_1" / "1.monitor.csv").exists()


@pytest.mark.slow
def test_record_video(zoo_run) -> None:
    pytest.importorskip("moviepy")
    from sb3_sample import make_env

    env = make_env(ENV, render_mode="rgb_array")
    env.reset()
    try:
        env.render()
    except Exception as error:  # OpenGL's libraries fail in many ways
        pytest.skip(f"this machine cannot render: {error}")
    finally:
        env.close()
    zoo_run("train", "--algo", "bro", "--env", ENV, "-n", "20", "--eval-freq", "-1", *TINY)
    zoo_run("record_video", "--algo", "bro", "--env", ENV, "-f", "logs", "-n", "10")
    assert list(Path("logs/bro").glob(f"{NAME}_1/videos/*.mp4"))
