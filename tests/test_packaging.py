"""The files that say what is installed agree with each other."""

import configparser
import importlib.metadata
import re
import subprocess
import sys
from pathlib import Path

import packaging.requirements
import pytest

ROOT = Path(__file__).parents[1]
PYTHONS = ["3.11", "3.12", "3.13", "3.14"]


def setup_cfg() -> configparser.ConfigParser:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return config


def name_of(requirement: str) -> str:
    """Normalized name: ``"PyOpenGL>=3.1.4"`` is ``"pyopengl"``."""
    return re.sub("[-_.]+", "-", re.match(r"[\w.-]+", requirement.strip())[0]).lower()  # type: ignore[index]


def pins(python: str) -> dict[str, str]:
    lines = (ROOT / "constraints" / f"{python}.txt").read_text().splitlines()
    return dict(line.split("==") for line in lines if line and not line.startswith("#"))


def test_each_python_has_its_lock_file() -> None:
    assert sorted(path.stem for path in (ROOT / "constraints").glob("3.*.txt")) == PYTHONS
    assert f"PYTHONS := {' '.join(PYTHONS)}\n" in (ROOT / "Makefile").read_text()
    classifiers = setup_cfg()["metadata"]["classifiers"]
    assert re.findall(r"Python :: (3\.\d+)", classifiers) == PYTHONS
    assert setup_cfg()["options"]["python_requires"] == f">={PYTHONS[0]}"


@pytest.mark.parametrize("python", PYTHONS)
def test_the_lock_has_everything_that_setup_asks_for(python: str) -> None:
    config = setup_cfg()
    asked = config["options"]["install_requires"].splitlines()
    for extra in config["options.extras_require"].values():
        asked += extra.splitlines()
    names = {name_of(line) for line in asked if line.strip() and not line.startswith("#")} - {"sb3-sample"}
    assert names - pins(python).keys() == set()
    assert ("labmaze" in pins(python)) == (python in ("3.11", "3.12"))


def test_what_is_said_of_installing_works_in_the_checkout() -> None:
    """The package is on no index, so that its name alone installs nothing."""
    files = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "sb3_sample").rglob("*.py")]
    text = "\n".join(file.read_text() for file in files)
    assert not re.findall(r"install [^\n]*sb3_sample\[", text)
    named = [*re.findall(r'pip install -e "\.\[([\w,]+)\]"', text), *re.findall(r"install\('([^)]*)'\)", text)]
    extras = {extra for group in named for extra in re.findall(r"\w+", group)}
    assert {"dmc", "metaworld", "zoo", "export", "plots"} <= extras <= set(setup_cfg()["options.extras_require"])


def test_the_package_has_the_files_that_it_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a wheel as setuptools builds it by ``package_data``, whatever git has."""
    dist = pytest.importorskip("setuptools.dist").Distribution({"script_name": "setup.py"})
    monkeypatch.chdir(ROOT)
    dist.parse_config_files(["setup.cfg"])
    dist.include_package_data = False
    command = dist.get_command_obj("build_py")
    command.ensure_finalized()
    packed = {Path(folder, file) for _, folder, _, files in command.data_files for file in files}
    code = {Path(file) for _, _, file in command.find_all_modules()}
    there = {path.relative_to(ROOT) for path in (ROOT / "sb3_sample").rglob("*.*") if "__pycache__" not in path.parts}
    assert there - packed - code == set()


@pytest.mark.parametrize("python", PYTHONS[1:])
def test_the_pythons_have_the_same_versions_of_what_runs(python: str) -> None:
    first, other = pins(PYTHONS[0]), pins(python)
    different = {name for name in first.keys() & other.keys() if first[name] != other[name]}
    # MyoSuite asks for an old one before Python 3.14, and 3.14 needs a newer one.
    assert different == ({"onnxruntime"} if python == "3.14" else set())


def test_without_labmaze_the_extra_is_all_that_dm_control_asks_for() -> None:
    pytest.importorskip("dm_control")
    requires = importlib.metadata.requires("dm-control") or []
    asked = {name_of(line) for line in requires if "extra ==" not in line} - {"labmaze"}
    later = [line for line in setup_cfg()["options.extras_require"]["dmc"].splitlines() if '>= "3.13"' in line]
    installed = setup_cfg()["options"]["install_requires"].splitlines()
    assert {name_of(line) for line in later} == asked - {name_of(line) for line in installed if line}


def installed_without_extras() -> set[str]:
    """Distributions that an installation without extras has."""
    asked = [*setup_cfg()["options"]["install_requires"].split(), "sb3-sample"]
    found: set[str] = set()
    while asked:
        name = name_of(asked.pop())
        if name in found:
            continue
        try:
            requirements = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # of another system
            continue
        found.add(name)
        parsed = [packaging.requirements.Requirement(each) for each in requirements if name != "sb3-sample"]
        asked += [each.name for each in parsed if each.marker is None or each.marker.evaluate({"extra": ""})]
    return found


def test_an_installation_without_extras_trains(tmp_path: Path) -> None:
    plain = installed_without_extras()
    modules = importlib.metadata.packages_distributions()
    absent = sorted(module for module, owners in modules.items() if not {name_of(owner) for owner in owners} & plain)
    assert {"pandas", "matplotlib", "rl_zoo3", "dm_control", "tqdm"} & set(modules) <= set(absent)
    assert not {"torch", "numpy", "stable_baselines3", "gymnasium", "sb3_sample"} & set(absent)
    program = f"""
import sys

sys.modules.update(dict.fromkeys({absent!r}))
from sb3_sample import BRO, MBMAPPO, SAC, SupervisedSubprocVecEnv, make_env
from sb3_sample.cli import main

env = make_env("Pendulum-v1")
model = SAC("MlpPolicy", env, learning_starts=5, policy_kwargs=dict(net_arch=[8])).learn(12, checkpoint="run")
model.save("model")
assert SAC.load("model", env=env).num_timesteps == 12
MBMAPPO("MlpPolicy", env, n_steps=16, batch_size=8, dynamics_kwargs=dict(width=8)).learn(32)
main(["--help"])
for command, extra in dict(plot="plots", study="study", scaling="study", advise="study", train="zoo").items():
    try:
        main([command, "--help"])
    except SystemExit as end:
        assert f'pip install -e ".[{{extra}}' in str(end), (command, end)
    else:
        raise AssertionError(command)
for command in ("variance", "dataset"):
    try:
        main([command, "--help"])
    except SystemExit as end:
        assert not end.code, (command, end)
"""
    result = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
