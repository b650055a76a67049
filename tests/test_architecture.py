"""Arrows point one way: no circle of files, and the rooms that setup.cfg lists."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def imports(package: Path) -> dict[str, set[str]]:
    """By module, the modules of the package that it imports anywhere in its text, TYPE_CHECKING and functions too."""
    files = {}
    for path in package.rglob("*.py"):
        parts = path.relative_to(package.parent).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    found: dict[str, set[str]] = {}
    for module, path in files.items():
        names: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                # ``from package import x`` is of x where that is a module, and of the package where it is not.
                names |= {f"{node.module}.{alias.name}" for alias in node.names} & files.keys() or {node.module}
        found[module] = (names & files.keys()) - {module}
    return found


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected components of more than one module (Tarjan)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    components = []

    def visit(v: str) -> None:
        index[v] = low[v] = len(index)
        stack.append(v)
        for w in graph[v]:
            if w not in index:
                visit(w)
            if w in stack:
                low[v] = min(low[v], low[w])
        if low[v] == index[v]:
            component = [stack.pop()]
            while component[-1] != v:
                component.append(stack.pop())
            if len(component) > 1:
                components.append(sorted(component))

    for v in graph:
        if v not in index:
            visit(v)
    return components


def test_studies_import_slow_modules_where_they_are_used() -> None:
    """Every process of a study imports all of its modules, and scipy's statistics and optimisers take over a second."""
    for path in (ROOT / "sb3_sample/study").rglob("*.py"):
        for node in ast.parse(path.read_text()).body:
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not [n for n in names if n == "scipy" or n.startswith(("scipy.stats", "scipy.optimize"))], path


def test_no_circle_of_files() -> None:
    assert circles(imports(ROOT / "sb3_sample")) == []


def test_circles_are_found(tmp_path: Path) -> None:
    package = tmp_path / "package"
    (package / "inner").mkdir(parents=True)
    texts = {
        "__init__": "",
        "a": "from package.b import x",
        "b": "import typing\nif typing.TYPE_CHECKING:\n    from package import c",
        "c": "def f():\n    import package.inner.d",
        "inner/__init__": "",
        "inner/d": "from package import a",
        "e": "import package.a",
    }
    for name, text in texts.items():
        (package / f"{name}.py").write_text(text)
    assert circles(imports(package)) == [["package.a", "package.b", "package.c", "package.inner.d"]]


def test_the_contracts_hold() -> None:
    # In a process of its own: it prints to a console that it makes once, of the streams that it finds.
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as main; main()", "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_learner_does_without_stable_baselines3() -> None:
    """What it imports, all the way down."""
    graph, seen, waiting = imports(ROOT / "sb3_sample"), set(), ["sb3_sample.learner.learner"]
    while waiting:
        module = waiting.pop()
        if module not in seen:
            seen.add(module)
            waiting += graph[module]
    assert len(seen) > 15
    for module in seen:
        path = ROOT.joinpath(*module.split("."))
        text = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text()
        names = {
            name.split(".")[0]
            for node in ast.walk(ast.parse(text))
            for name in (
                [alias.name for alias in node.names]
                if isinstance(node, ast.Import)
                else [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else []
            )
        }
        assert names - {"sb3_sample", "torch", "numpy"} <= sys.stdlib_module_names, module
