"""Run Stable-Baselines3's own tests with our classes, and compare what fails with a table of what may."""

import ast
import importlib.metadata
import os
import pathlib
import re
import subprocess
import sys
import tarfile
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

ROOT = pathlib.Path(__file__).parents[2]
#: Seconds after which a suite is stuck. It takes one to three minutes.
TIMEOUT = 3600


class Suite(NamedTuple):
    """
    :param distribution: whose tests they are: the distribution's and the package's name
    :param replaced: the class that they are about
    :param replacement: the class that takes its place, of ``replacements.py``
    :param files: test files, without ``test_`` and suffix
    """

    distribution: str
    replaced: str
    replacement: str
    files: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.distribution}-{self.replaced}-{self.replacement}"


class Exclusion(NamedTuple):
    """
    Tests that fail, and shall.

    :param tests: pattern of the tests' names, ``test_file::test_name[parameters]``, with ``*`` for any text
    :param error: part of what each of them fails with, so that another failure is noticed
    :param reason: why, by its name in ``REASONS``
    :param by_chance: whether they may pass, since what they compare with a bound is a trained number
    """

    tests: str
    error: str
    reason: str
    by_chance: bool = False

    def matches(self, test: str) -> bool:
        """
        :param test: a test's name
        :return: whether it is one of these
        """
        return re.fullmatch(re.escape(self.tests).replace(r"\*", ".*"), test) is not None


def fetch(distribution: str, folder: pathlib.Path) -> pathlib.Path:
    """
    Source distribution of the installed version, which the set-up takes from the lock file.

    :param distribution: its name
    :param folder: where it is kept from one run to the next
    :return: its file
    :raises RuntimeError: if it is not there and cannot be had
    """
    version = importlib.metadata.version(distribution)
    path = folder / f"{distribution}-{version}.tar.gz"
    if path.is_file():
        return path
    # One that a concurrent process also fetches is complete or not there.
    with tempfile.TemporaryDirectory(dir=folder) as name:
        command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", distribution]
        pip = subprocess.run(
            [*command, "--dest", name, f"{distribution}=={version}"], capture_output=True, text=True, check=False
        )
        found = list(pathlib.Path(name).glob("*.tar.gz"))
        if pip.returncode != 0 or len(found) != 1:
            raise RuntimeError(
                f"The source distribution of {distribution} {version}, whose tests are to be run, could not be "
                f"fetched. Without a network put it into {folder}. pip says:\n{pip.stdout}{pip.stderr}"
            )
        os.replace(found[0], path)
    return path


def copy_tests(sdist: pathlib.Path, suite: Suite, folder: pathlib.Path) -> int:
    """
    Write those of a suite's files that import the class, with ours in its place, and pytest's settings.

    :param sdist: a source distribution
    :param suite: which suite
    :param folder: where to
    :return: how many files
    :raises RuntimeError: if the source distribution lacks one of the files
    """
    wanted = {f"tests/test_{name}.py" for name in suite.files} | {"pyproject.toml"}
    texts: dict[str, str] = {}
    with tarfile.open(sdist) as archive:
        for member in archive:
            name = member.name.partition("/")[2]
            file = archive.extractfile(member) if name in wanted else None
            if file is not None:
                texts[name] = file.read().decode()
    if wanted - texts.keys():
        raise RuntimeError(f"{sdist.name} has no {', '.join(sorted(wanted - texts.keys()))}")
    (folder / "pyproject.toml").write_text(texts.pop("pyproject.toml"))
    (folder / "suite").mkdir()
    n_files = 0
    for name, text in texts.items():
        changed = replace_class(text, suite)
        if changed is not None:
            (folder / "suite" / pathlib.Path(name).name).write_text(changed)
            n_files += 1
    return n_files


def replace_class(text: str, suite: Suite) -> str | None:
    """
    :param text: a test module
    :param suite: which class to replace
    :return: the module with our class under the name of theirs; None if it does not import theirs
    """
    for node in ast.parse(text).body:
        imports = node.names if isinstance(node, ast.ImportFrom) and node.module == suite.distribution else []
        if suite.replaced in [alias.name for alias in imports]:
            lines = text.splitlines(keepends=True)
            ours = f"from {__package__}.replacements import {suite.replacement} as {suite.replaced}\n"
            return "".join([*lines[: node.end_lineno], ours, *lines[node.end_lineno :]])
    return None


def run(suite: Suite, folder: pathlib.Path) -> dict[str, str | None]:
    """
    Run copied tests in a process of their own.

    :param suite: which suite
    :param folder: where :func:`copy_tests` wrote it
    :return: by the test's name, ``test_file::test_name[parameters]``, what it failed with; None if it passed.
        Skipped ones are left out
    :raises RuntimeError: if the tests could not be run
    """
    report = folder / "report.xml"
    options = ["-q", "--tb=short", "-p", "no:cacheprovider", "-p", "no:xdist", "-p", f"{__package__}.selection"]
    names = ["--replaced", suite.replaced, "--replacement", suite.replacement]
    files = [f"--junitxml={report}", f"--basetemp={folder / 'temporary'}"]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    paths = [str(ROOT), *filter(None, [environment.get("PYTHONPATH")])]
    environment |= {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    process = subprocess.run(
        [sys.executable, "-m", "pytest", "suite", *options, *names, *files],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    # 1: tests failed, as some shall.
    if process.returncode not in (0, 1) or not report.is_file():
        raise RuntimeError(f"{suite}: pytest ended with {process.returncode}\n{process.stdout}{process.stderr}")
    return read_report(report)


def read_report(report: pathlib.Path) -> dict[str, str | None]:
    """
    :param report: pytest's, as JUnit's XML
    :return: as :func:`run`
    """
    outcomes: dict[str, str | None] = {}
    for case in ElementTree.parse(report).getroot().iter("testcase"):
        name = f"{case.attrib['classname'].rpartition('.')[2]}::{case.attrib['name']}"
        if case.find("skipped") is not None:
            continue
        failures = [*case.iter("failure"), *case.iter("error")]
        outcomes[name] = "\n".join(f"{f.get('message')}\n{f.text}" for f in failures) if failures else None
    return outcomes


def compare(outcomes: Mapping[str, str | None], exclusions: Sequence[Exclusion], reasons: Iterable[str]) -> list[str]:
    """
    :param outcomes: from :func:`run`
    :param exclusions: what shall fail
    :param reasons: the names of all reasons
    :return: whatever is not as the exclusions say, a line each
    """
    problems = []
    for test, error in outcomes.items():
        if error is None:
            continue
        covering = [exclusion for exclusion in exclusions if exclusion.matches(test)]
        if not covering:
            problems.append(f"FAILS {test}: {_first_line(error)}")
        elif not any(exclusion.error in error for exclusion in covering):
            wanted = " or ".join(repr(exclusion.error) for exclusion in covering)
            problems.append(f"FAILS OTHERWISE {test}: {_first_line(error)}, and not with {wanted}")
    for exclusion in exclusions:
        covered = [test for test in outcomes if exclusion.matches(test)]
        if not covered:
            problems.append(f"NOT THERE {exclusion.tests}: no test of this name was run")
        passed = [] if exclusion.by_chance else [test for test in covered if outcomes[test] is None]
        problems += [f"PASSES {test}, which {exclusion.tests!r} excludes" for test in passed]
        if exclusion.reason not in reasons:
            problems.append(f"NO REASON {exclusion.tests}: {exclusion.reason!r} is not explained")
    return problems


def _first_line(error: str) -> str:
    return error.strip().splitlines()[0][:300]
