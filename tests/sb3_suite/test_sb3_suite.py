"""Stable-Baselines3's and SB3-contrib's own tests, with our classes in the place of theirs."""

import subprocess
import tarfile
from types import SimpleNamespace

import pytest

from sb3_sample import BRO, SAC
from tests.sb3_suite import selection
from tests.sb3_suite import suite as suites
from tests.sb3_suite.exclusions import REASONS, SUITES
from tests.sb3_suite.suite import Exclusion, Suite

SAC_SUITE = Suite("stable_baselines3", "SAC", "BRO", ("run",))
DOCS = suites.ROOT / "docs" / "stable_baselines3.md"


@pytest.mark.slow
@pytest.mark.parametrize("suite", SUITES, ids=str)
def test_what_fails_is_what_differs_by_design(suite, tmp_path, request):
    """Needs the network, or the source distributions where it says: a skip would be a check that cannot fail."""
    sdist = suites.fetch(suite.distribution, request.config.cache.mkdir("sb3_suite"))
    assert suites.copy_tests(sdist, suite, tmp_path) > 0
    outcomes = suites.run(suite, tmp_path)
    passed = sum(error is None for error in outcomes.values())
    print(f"{suite}: {passed} of {len(outcomes)} pass")
    problems = suites.compare(outcomes, SUITES[suite], REASONS)
    assert not problems, "\n" + "\n".join(problems)


# ---------------------------------------------------------------- the runner itself


def test_every_reason_is_in_the_docs_and_used():
    table = DOCS.read_text().split("| | here | the tests |")[1].split("\n\n")[0]
    headings = [row.split("|")[1].strip() for row in table.splitlines()[2:]]
    assert headings == list(REASONS)
    assert {exclusion.reason for exclusions in SUITES.values() for exclusion in exclusions} == set(REASONS)


@pytest.mark.parametrize(
    ("outcomes", "words"),
    [
        ({"test_run::test_a[1-BRO]": "Boom: x\nlines"}, None),
        ({"test_run::test_a[1-BRO]": "Boom: x", "test_run::test_b": None}, None),
        ({"test_run::test_a[1-BRO]": "Boom: x", "test_run::test_b": "KeyError"}, "FAILS test_run::test_b: KeyError"),
        ({"test_run::test_a[1-BRO]": "KeyError"}, "FAILS OTHERWISE test_run::test_a[1-BRO]: KeyError, and not with 'B"),
        ({"test_run::test_a[1-BRO]": None}, "PASSES test_run::test_a[1-BRO], which 'test_run::test_a[1-*]' excludes"),
        ({"test_run::test_a[2-BRO]": None}, "NOT THERE test_run::test_a[1-*]"),
    ],
)  # fmt: skip
def test_comparison(outcomes, words):
    problems = suites.compare(outcomes, [Exclusion("test_run::test_a[1-*]", "Boom", "why")], ["why"])
    if words is None:
        assert problems == []
    else:
        assert len(problems) == 1
        assert problems[0].startswith(words)


def test_comparison_of_what_may_pass_and_of_what_has_no_reason():
    outcomes = {"test_gae::test_a": None}
    by_chance = Exclusion("test_gae::test_a", "", "why", by_chance=True)
    assert suites.compare(outcomes, [by_chance], ["why"]) == []
    assert suites.compare(outcomes, [by_chance], []) == ["NO REASON test_gae::test_a: 'why' is not explained"]


def test_the_class_is_replaced_where_it_is_imported():
    text = "import os\nfrom stable_baselines3 import (\n    PPO,\n    SAC,\n)\nprint(SAC)\n"
    changed = suites.replace_class(text, SAC_SUITE)
    assert changed is not None
    ours = "from tests.sb3_suite.replacements import BRO as SAC"
    assert changed.splitlines()[4:] == [")", ours, "print(SAC)"]
    assert suites.replace_class("from stable_baselines3 import PPO\nSAC = 3\n", SAC_SUITE) is None


def test_the_tests_of_the_class_are_chosen():
    def named():
        return SAC

    def within():
        return [lambda: SAC for _ in range(2)]

    def other():
        return BRO

    def item(function, **parameters):
        module = SimpleNamespace(MODEL_DICT={"sac": (SAC, ""), "td3": (BRO, "")})
        found = SimpleNamespace(function=function, module=module)
        if parameters:
            found.callspec = SimpleNamespace(params=parameters)
        return found

    def uses(*args, **kwargs):
        return selection.uses(item(*args, **kwargs), "SAC", SAC)

    assert uses(named)
    assert uses(within)
    assert not uses(other)
    assert uses(named, n_critics=3)
    assert uses(other, model_class=SAC)
    assert not uses(named, model_class=BRO)
    assert uses(other, model_name="sac")
    assert not uses(named, model_name="td3")


def test_what_cannot_be_fetched_is_an_error_that_says_what_to_do(tmp_path, monkeypatch):
    answer = subprocess.CompletedProcess([], 1, "", "no route to host")
    monkeypatch.setattr(subprocess, "run", lambda *args, **kwargs: answer)
    with pytest.raises(RuntimeError, match=rf"(?s)could not be fetched.*into {tmp_path}.*no route to host"):
        suites.fetch("stable_baselines3", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_is_there_is_not_fetched_again(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "run", None)
    monkeypatch.setattr(suites.importlib.metadata, "version", lambda name: "9.9")
    path = tmp_path / "stable_baselines3-9.9.tar.gz"
    path.touch()
    assert suites.fetch("stable_baselines3", tmp_path) == path


def test_a_source_distribution_without_tests_is_an_error(tmp_path):
    (tmp_path / "pyproject.toml").touch()
    with tarfile.open(tmp_path / "a.tar.gz", "w:gz") as archive:
        archive.add(tmp_path / "pyproject.toml", "a-1/pyproject.toml")
    with pytest.raises(RuntimeError, match=r"a\.tar\.gz has no tests/test_run\.py"):
        suites.copy_tests(tmp_path / "a.tar.gz", SAC_SUITE, tmp_path)


@pytest.mark.slow
def test_a_suite_is_run_and_its_report_read(tmp_path):
    """One that passes, one that fails, one that is skipped, one of another class."""
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "test_run.py").write_text(
        "import pytest\n"
        "from tests.sb3_suite.replacements import BRO as SAC\n"
        "def test_passes(): assert SAC\n"
        "def test_fails(): raise ValueError(f'no {SAC.__name__}')\n"
        "def test_is_skipped(): pytest.skip(str(SAC))\n"
        "def test_of_another_class(): raise ValueError\n"
    )
    outcomes = suites.run(SAC_SUITE, tmp_path)
    assert set(outcomes) == {"test_run::test_passes", "test_run::test_fails"}
    assert outcomes["test_run::test_passes"] is None
    assert outcomes["test_run::test_fails"].startswith("ValueError: no BRO")


@pytest.mark.slow
def test_a_suite_that_cannot_be_run_is_an_error(tmp_path):
    (tmp_path / "pyproject.toml").write_text("[tool.pytest.ini_options]\n")
    (tmp_path / "suite").mkdir()
    (tmp_path / "suite" / "test_run.py").write_text("import a_module_that_is_not_there\n")
    with pytest.raises(RuntimeError, match="a_module_that_is_not_there"):
        suites.run(SAC_SUITE, tmp_path)
