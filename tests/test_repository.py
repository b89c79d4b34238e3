"""House rules that hold for every file: nothing unpickled or evaluated, one-way imports, quick help, small modules."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from coordinator.run_settings import RunSettings
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import compile_task
from t4nmtd_dist.policy.export import export_policy
from t4nmtd_dist.tasks import load_task

ROOT = Path(__file__).parent.parent
PACKAGES = ("t4nmtd_dist", "coordinator", "workers", "envs")
PROGRAMS = {"t4nmtd": "t4nmtd_dist.cli.main", "t4nmtd-coordinator": "t4nmtd_dist.cli.coordinator"}
PROGRAMS |= {"t4nmtd-worker": "t4nmtd_dist.cli.worker"}

MOST_MODULE_LINES, MOST_FUNCTION_LINES = 500, 60
HELP_S = 0.3
# Python's own modules, and how long a usual machine takes to import them: a slower or busier one gets longer.
YARDSTICK = (
    "import asyncio, unittest.mock, http.client, email.mime.text, xml.dom.minidom, sqlite3, multiprocessing.pool"
)
YARDSTICK_S = 0.1

PICKLING_MODULES = {"pickle", "_pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve"}
PICKLING_METHODS = {"recv_pyobj", "send_pyobj", "torch.load", "torch.save"}
EVALUATING_CALLS = {"eval", "exec", "builtins.eval", "builtins.exec"}

LATE_MODULES = (
    "torch", "sympy", "ltlf2dfa", "gymnasium", "mujoco", "pymunk", "coordinator.service", "workers.worker",
)  # fmt: skip

MACHINE_PATH = re.compile(r"(?<![\w.\-~])/(?:home/\w|Users/\w|root/|work/)|\b[A-Z]:\\\\?Users\\")
PACKAGE_INDEX = re.compile(
    r"https?://\S*(?:pypi|pythonhosted|/simple\b|/whl\b)|--(?:extra-)?(?:index-url|find-links)", re.I
)


def modules(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


OURS = modules(*PACKAGES)
ALL_MODULES = modules(*PACKAGES, "tests", "benchmarks", "examples")


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


# Nothing is unpickled or evaluated


def full_names(tree: ast.AST) -> dict[str, str]:
    """What every imported name stands for: ``{"t": "torch", "load": "torch.load"}``."""
    names: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.asname: alias.name for alias in node.names if alias.asname}
        elif isinstance(node, ast.ImportFrom):
            names |= {alias.asname or alias.name: f"{node.module}.{alias.name}" for alias in node.names}
    return names


def dotted(node: ast.expr, names: dict[str, str]) -> str:
    if isinstance(node, ast.Name):
        return names.get(node.id, node.id)
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value, names)}.{node.attr}"
    return ""


def forbidden_uses(source: str) -> list[str]:
    """Everything in a module that could run or rebuild objects from data."""
    tree = ast.parse(source)
    names = full_names(tree)
    return [found for node in ast.walk(tree) for found in forbidden_in(node, names)]


def forbidden_in(node: ast.AST, names: dict[str, str]) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name.split(".")[0] in PICKLING_MODULES)
    elif isinstance(node, ast.ImportFrom):
        used = {f"{node.module}.{alias.name}" for alias in node.names}
        yield from used & PICKLING_METHODS
        yield from {node.module or ""} & PICKLING_MODULES
    elif isinstance(node, ast.Attribute):
        yield from {node.attr, dotted(node, names)} & PICKLING_METHODS
    elif isinstance(node, ast.Call):
        yield from {dotted(node.func, names)} & EVALUATING_CALLS
        allowing = [key for key in node.keywords if key.arg == "allow_pickle"]
        yield from ("allow_pickle" for key in allowing if ast.unparse(key.value) != "False")


@pytest.mark.parametrize("path", OURS, ids=name_of)
def test_nothing_is_unpickled_or_evaluated(path: Path) -> None:
    assert forbidden_uses(path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import pickle as p",
        "from pickle import loads",
        "def f():\n    import torch\n    torch.load(p)",
        "import torch as t; t.load(p)",
        "from torch import load; load(p)",
        "socket.recv_pyobj()",
        "eval('1')",
        "import builtins; builtins.exec(text)",
        "numpy.load(file, allow_pickle=True)",
    ],
)
def test_forbidden_uses_are_found(source: str) -> None:
    assert forbidden_uses(source)


@pytest.mark.parametrize(
    "source",
    [
        '"""Evaluates; never uses eval() or pickle."""  # torch.load(x), exec(y)',
        "network.eval(); evaluate(x)",
        "policy.load(path); numpy.load(file, allow_pickle=False)",
    ],
)
def test_harmless_look_alikes_are_not_found(source: str) -> None:
    assert forbidden_uses(source) == []


# Imports point one way


def lint_imports(*arguments: str) -> subprocess.CompletedProcess[str]:
    if importlib.util.find_spec("importlinter") is None:
        pytest.skip("import-linter is not installed")
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"]
    return subprocess.run([*command, "--no-logo", "--no-cache", *arguments], cwd=ROOT, capture_output=True, text=True)


def test_import_contracts_are_kept() -> None:
    done = lint_imports()
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_broken_import_contract_is_noticed(tmp_path: Path) -> None:
    contract = tmp_path / "broken.ini"
    contract.write_text(
        "[importlinter]\nroot_packages = t4nmtd_dist\n    coordinator\n"
        "[importlinter:contract:1]\nname = the other way round\ntype = forbidden\n"
        "source_modules = coordinator\nforbidden_modules = t4nmtd_dist\n"
    )
    done = lint_imports("--config", str(contract))
    assert done.returncode == 1, done.stdout + done.stderr
    assert "0 kept, 1 broken" in done.stdout


# Help comes at once


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.command
def test_help_imports_nothing_heavy(program: str) -> None:
    code = f"""
import sys
from {PROGRAMS[program]} import main
sys.argv = [{program!r}, "--help"]
try:
    main()
except SystemExit as end:
    code = end.code
print([name for name in {LATE_MODULES} if name in sys.modules], file=sys.stderr)
sys.exit(code)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert f"usage: {program}" in done.stdout
    assert done.stderr.strip() == "[]"


def seconds(*command: str) -> float:
    """Processor time that a command takes: what other programs do meanwhile does not count."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


@pytest.mark.parametrize(
    ("program", "verb"), [*((program, ()) for program in PROGRAMS), ("t4nmtd", ("train",)), ("t4nmtd", ("inspect",))]
)
@pytest.mark.process
def test_help_comes_at_once(program: str, verb: tuple[str, ...]) -> None:
    script = Path(sys.executable).with_name(program)
    if not script.exists():
        pytest.skip(f"{script.name} is not installed beside this interpreter")
    limits: list[float] = []
    helped: list[float] = []
    while len(helped) < 5 and (not helped or min(helped) >= min(limits)):
        limits.append(HELP_S * max(1.0, seconds(sys.executable, "-c", YARDSTICK) / YARDSTICK_S))
        helped.append(seconds(str(script), *verb, "--help"))
    assert min(helped) < min(limits), f"took {helped}, at most {limits} on a machine as fast as this one is now"


# Modules and functions stay small, and say what they are for


@pytest.mark.parametrize("path", ALL_MODULES, ids=name_of)
def test_a_module_is_documented_and_small(path: Path) -> None:
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    assert ast.get_docstring(tree), "no docstring"
    assert len(source.splitlines()) <= MOST_MODULE_LINES
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    lengths = {node.name: (node.end_lineno or node.lineno) - node.lineno + 1 for node in functions}
    assert {name: lines for name, lines in lengths.items() if lines > MOST_FUNCTION_LINES} == {}


def test_packages_say_that_they_are_typed() -> None:
    assert [package for package in PACKAGES if not (ROOT / package / "py.typed").is_file()] == []


# Files are free of what belongs to one machine


def texts() -> Iterator[tuple[str, str]]:
    """Every file that belongs to the project, as far as it is text."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.is_file():
            yield name, path.read_bytes().decode("utf-8", errors="ignore")


@pytest.mark.parametrize("pattern", [MACHINE_PATH, PACKAGE_INDEX], ids=["machine path", "package index"])
def test_no_file_names_a_developers_machine_or_a_package_index(pattern: re.Pattern[str]) -> None:
    found = {name: match.group() for name, text in texts() if (match := pattern.search(text))}
    assert found == {}


def test_the_patterns_find_what_they_are_for() -> None:
    found = ["see /" + "home/ada/code", "cd /" + "work/main", "C:" + "\\Users\\ada"]
    assert all(MACHINE_PATH.search(text) for text in found)
    assert not MACHINE_PATH.search("coordinator/workers/state.py and docs/home/index.md")
    assert PACKAGE_INDEX.search("https:" + "//pypi.example/simple/torch")
    assert not PACKAGE_INDEX.search("https://keepachangelog.com/en/1.1.0/")


# The README's promises


def test_the_readmes_python_is_the_examples() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    examples = [ROOT / "examples" / name for name in ("python_api.py", "use_policy.py")]
    blocks = re.findall(r"^```python\n(.*?)^```", readme, re.MULTILINE | re.DOTALL)
    lines = {line.strip() for example in examples for line in example.read_text(encoding="utf-8").splitlines()}
    assert len(blocks) == len(examples)
    code = [line.strip() for block in blocks for line in block.splitlines() if line.strip()]
    assert [line for line in code if line not in lines and "load(" not in line] == []


def test_the_example_plays_a_policy_that_was_just_exported(tmp_path: Path) -> None:
    task = compile_task(load_task("task7"), translator="python")
    run = SerialRun(task, RunSettings(0, 1), float)
    weights = {pid: session.learner.weights() for pid, session in run.sessions.items()}
    export_policy(tmp_path, task, [], weights, {})
    specification = importlib.util.spec_from_file_location("use_policy", ROOT / "examples" / "use_policy.py")
    assert specification is not None
    assert specification.loader is not None
    example = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(example)
    assert example.play(str(tmp_path)) in (False, True)


def test_the_readmes_commands_are_verbs_of_the_makefile() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    verbs = set(re.findall(r"^([a-z-]+):", makefile, re.MULTILINE))
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    checks = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    promised = set(re.findall(r"(?:^|`)make ([a-z-]+)", readme, re.MULTILINE))
    checked = set(re.findall(r"\bmake --no-print-directory ([a-z]+)$", checks, re.MULTILINE))
    assert {"run", "test"} <= promised
    assert {"setup", "lint", "type", "test"} == checked
    assert promised | checked <= verbs


@pytest.mark.parametrize(
    ("parallel", "serial", "passes"),
    [(0, 0, True), (0, 5, True), (5, 0, True), (1, 0, False), (0, 1, False), (5, 5, False), (2, 5, False)],
)
def test_make_test_runs_both_parts_and_fails_if_one_fails(
    parallel: int, serial: int, passes: bool, tmp_path: Path
) -> None:
    """pytest's exit code 5 means that no test was chosen."""
    pytest_stand_in, calls = tmp_path / "pytest", tmp_path / "calls"
    code = f'case "$2" in "not process"*) exit {parallel} ;; process*) exit {serial} ;; esac'
    pytest_stand_in.write_text(f'#!/bin/sh\necho "$@" >> {calls}\n{code}\n')
    pytest_stand_in.chmod(0o755)
    command = ["make", "--silent", "--old-file=.venv/.set-up", "test", f"PYTEST={pytest_stand_in}", "ARGS=-k lake"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env={"PATH": os.environ["PATH"]})
    assert (done.returncode == 0) is passes, done.stdout + done.stderr
    first, second = calls.read_text().splitlines()
    assert first == "-m not process and not nightly --numprocesses 2 --dist loadfile -k lake"
    assert second == "-m process and not nightly -k lake"
