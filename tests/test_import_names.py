"""Modules and packages of the user's that are called like ours: envs, workers, coordinator."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import gymnasium
import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import Processes, events, worker_number
from small_tasks import own_task

import envs
import workers
from coordinator.notice_filter import NoticeFilter
from t4nmtd_dist.cli import programs
from t4nmtd_dist.core.config import EnvironmentConfig
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.environments.opening import import_function, open_environment
from t4nmtd_dist.tasks import load_task

HERE = Path(__file__).parent
PROGRAMS = {
    "t4nmtd": ["tasks"],
    "t4nmtd-coordinator": ["--task", "task7", "--bind", "tcp://127.0.0.1:*", "--publish", "tcp://127.0.0.1:*"],
    "t4nmtd-worker": ["--connect", "tcp://127.0.0.1:9", "--wait", "30"],
}
FOREIGN = 'raise SystemExit("this module is not meant to be imported")\n'
SHORT = ("--max-interactions", "3000", "--no-dashboard")


# In the current folder


def test_modules_in_the_current_folder_are_not_taken_for_ours(commands: Processes) -> None:
    for name in ("workers.py", "coordinator.py", "envs/__init__.py", "t4nmtd_dist/__init__.py"):
        path = commands.folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(FOREIGN, encoding="utf-8")
    started = commands.start("t4nmtd", "train", "--task", "task7", "--run-dir", "run", *SHORT)
    assert started.wait(110) in (0, 3), started.story()


def test_every_program_starts_with_the_check() -> None:
    settings = tomllib.loads((HERE.parent / "pyproject.toml").read_text(encoding="utf-8"))
    scripts = settings["project"]["scripts"]
    assert set(scripts) == set(PROGRAMS)
    for entry in scripts.values():
        module, _, name = entry.partition(":")
        assert module == programs.__name__
        assert callable(getattr(programs, name))


# On PYTHONPATH


@pytest.mark.parametrize("program", PROGRAMS)
@pytest.mark.parametrize("name", ["envs/__init__.py", "coordinator.py", "workers/__init__.py"])
def test_what_hides_ours_on_pythonpath_is_named_and_refused(name: str, program: str, commands: Processes) -> None:
    path = commands.folder / "lib" / name
    path.parent.mkdir(parents=True)
    path.write_text(FOREIGN, encoding="utf-8")
    started = commands.start(program, *PROGRAMS[program], env={"PYTHONPATH": str(commands.folder / "lib")})
    package = Path(name).parts[0].removesuffix(".py")
    assert started.wait(20) == 2, started.story()
    (line,) = started.err.splitlines()
    assert line.startswith(f"{program}: {path} (found through PYTHONPATH) hides the package {package} of t4nmtd-dist")
    assert f"take {commands.folder / 'lib'} out of PYTHONPATH" in line


EDITABLE = """
import importlib.util, sys
from pathlib import Path
root = Path({root!r})
sys.path[:] = [path for path in sys.path if not path or Path(path).resolve() != root]

class Finder:  # as setuptools installs one
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        if name in ("t4nmtd_dist", "coordinator", "workers", "envs"):
            folder = root / name
            locations = [str(folder)]
            return importlib.util.spec_from_file_location(
                name, folder / "__init__.py", submodule_search_locations=locations
            )

sys.meta_path.append(Finder)
sys.path.insert(0, {lib!r})
from t4nmtd_dist.process.import_names import check_import_names
check_import_names()
"""


@pytest.mark.parametrize("hidden", [True, False])
@pytest.mark.command
def test_a_folder_without_init_hides_a_package_of_an_editable_installation(hidden: bool, tmp_path: Path) -> None:
    (tmp_path / ("envs" if hidden else "others")).mkdir()
    code = EDITABLE.format(root=str(HERE.parent), lib=str(tmp_path))
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True)
    last = done.stderr.strip().splitlines()[-1:]
    assert (done.returncode != 0) is hidden, done.stderr
    assert not hidden or f"{tmp_path / 'envs'} (found in {tmp_path}, where Python looks first) hides" in last[0]


@pytest.mark.parametrize("path", [":/nonexistent", ".", "/nonexistent:"])
def test_the_current_folder_on_pythonpath_counts_as_it_does_for_python(path: str, commands: Processes) -> None:
    (commands.folder / "envs.py").write_text(FOREIGN, encoding="utf-8")
    started = commands.start("t4nmtd", "tasks", env={"PYTHONPATH": path})
    assert started.wait(20) == 2, started.story()
    assert f"{commands.folder / 'envs.py'} (found through PYTHONPATH) hides the package envs" in started.err


def test_a_sitecustomize_that_imports_its_own_envs_is_refused(commands: Processes) -> None:
    (commands.folder / "sitecustomize.py").write_text("import envs\n", encoding="utf-8")
    (commands.folder / "envs.py").write_text("", encoding="utf-8")
    started = commands.start("t4nmtd", "tasks", env={"PYTHONPATH": str(commands.folder)})
    assert started.wait(20) == 2, started.story()
    assert "hides the package envs" in started.err


def test_a_pythonpath_that_hides_nothing_is_honoured(commands: Processes) -> None:
    (commands.folder / "lib").mkdir()
    (commands.folder / "task").mkdir()
    shutil.copy(HERE / "own_environments.py", commands.folder / "lib")
    task = own_task(commands.folder / "task", TASK.replace("envs:make", "own_environments:Corridor"))
    task.write_text(task.read_text().replace('labels = "workers:labels"', ""), encoding="utf-8")
    started = commands.start("t4nmtd", "check", str(task), env={"PYTHONPATH": str(commands.folder / "lib")})
    assert started.wait(60) == 0, started.story()


# In the task's folder

TASK = """
name = "corridor"
formula = "F(left & X(F(right)))"
propositions = ["left", "right", "again"]
[environment]
id = "envs:make"
labels = "workers:labels"
horizon = 30
[learner]
hidden = [16]
attempt_steps = 20
"""
MAKE = """
from __future__ import annotations
import own_environments
from {relative} import size
def make(**options):
    assert size.PLACES == own_environments.LENGTH
    return own_environments.Corridor(**options)
"""
LABELS = """
def labels(observation, info):
    return info["labels"]
"""


def theirs(folder: Path) -> Path:
    """A task whose modules are called like ours, with a sibling of a name that is free."""
    folder.mkdir(exist_ok=True)
    shutil.copy(HERE / "own_environments.py", folder)
    (folder / "envs").mkdir()
    (folder / "envs" / "__init__.py").write_text(MAKE.format(relative="."), encoding="utf-8")
    (folder / "envs" / "size.py").write_text("PLACES = 7\n", encoding="utf-8")
    (folder / "workers.py").write_text(LABELS, encoding="utf-8")
    (folder / "coordinator.py").write_text(FOREIGN, encoding="utf-8")
    return own_task(folder, TASK)


def test_a_task_may_name_modules_that_are_called_like_ours(commands: Processes) -> None:
    task = theirs(commands.folder / "mine")
    for arguments in (["check", str(task)], ["train", "--task", str(task), "--run-dir", "run", *SHORT]):
        started = commands.start("t4nmtd", *arguments)
        assert started.wait(90) in (0, 3), started.story()
    assert (commands.folder / "run" / "summary.json").exists()


def environment(folder: Path, name: str = "envs:make", **more: str) -> EnvironmentConfig:
    return EnvironmentConfig(id=name, horizon=30, path=str(folder), **more)


def test_modules_called_like_ours_are_loaded_once_and_leave_ours_alone(tmp_path: Path) -> None:
    theirs(tmp_path)
    config = environment(tmp_path)
    first = import_function("envs:make", config, "environment.id")
    assert first is import_function("envs:make", config, "environment.id")
    assert first.__globals__["__file__"] == str(tmp_path / "envs" / "__init__.py")
    assert import_function("envs.size:__name__.upper", config, "environment.id")
    assert sys.modules["envs"] is envs
    assert sys.modules["workers"] is workers
    assert open_environment(config).observation_space.n == 7  # type: ignore[attr-defined]


def test_our_own_worlds_keep_their_ids_beside_a_package_called_envs(tmp_path: Path) -> None:
    theirs(tmp_path)
    lake = open_environment(environment(tmp_path, "envs:t4nmtd/FrozenLake-v0"))
    assert type(lake.unwrapped).__module__ == "envs.frozenlake"


def test_a_folder_called_envs_without_the_module_in_it_hides_nothing(tmp_path: Path) -> None:
    (tmp_path / "envs").mkdir()
    made = open_environment(environment(tmp_path, "envs.frozenlake:FrozenLakeEnv"))
    assert type(made).__module__ == "envs.frozenlake"
    (tmp_path / "envs" / "office.py").write_text(MAKE.format(relative="."), encoding="utf-8")
    (tmp_path / "envs" / "size.py").write_text("PLACES = 7\n", encoding="utf-8")
    shutil.copy(HERE / "own_environments.py", tmp_path)
    assert open_environment(environment(tmp_path, "envs.office:make"))


def test_two_tasks_with_modules_of_one_name_get_each_its_own(tmp_path: Path) -> None:
    places = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "twin_module.py").write_text(LABELS, encoding="utf-8")
        found = import_function("twin_module:labels", environment(tmp_path / name), "environment.labels")
        places.append(found.__globals__["__file__"])
    assert places == [str(tmp_path / name / "twin_module.py") for name in ("a", "b")]


REGISTERS = """
import gymnasium
gymnasium.register(id="Theirs-v0", entry_point="envs.office:Office")
"""
OFFICE = """
from own_environments import Corridor
class Office(Corridor):
    pass
"""


def test_an_entry_point_in_a_package_called_envs_is_found(tmp_path: Path) -> None:
    shutil.copy(HERE / "own_environments.py", tmp_path)
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text(REGISTERS, encoding="utf-8")
    (tmp_path / "envs" / "office.py").write_text(OFFICE, encoding="utf-8")
    config = environment(tmp_path, "envs:Theirs-v0")
    try:
        for _ in range(2):
            assert type(open_environment(config).unwrapped).__name__ == "Office"
    finally:
        gymnasium.registry.pop("Theirs-v0", None)


@pytest.mark.parametrize("line", ["from envs.office import Office", "import envs.office", "from envs import office"])
def test_an_import_that_ours_answers_is_explained(line: str, tmp_path: Path) -> None:
    (tmp_path / "envs").mkdir()
    (tmp_path / "envs" / "__init__.py").write_text("", encoding="utf-8")
    (tmp_path / "envs" / "office.py").write_text(OFFICE, encoding="utf-8")
    module = f"uses_office_{abs(hash(line))}"
    (tmp_path / f"{module}.py").write_text(f"{line}\nmake = None\n", encoding="utf-8")
    with pytest.raises(EnvError, match=r"envs is a package of t4nmtd-dist here.*rename"):
        open_environment(environment(tmp_path, f"{module}:make"))


def test_the_examples_modules_keep_their_names() -> None:
    config = load_task(str(HERE.parent / "examples" / "mountain_car.toml")).environment
    assert import_function(config.labels, config, "environment.labels").__module__ == "mountain_car"


# A worker that dies at start

DIES = """
import os, sys
from own_environments import Corridor
if "--evaluate" in sys.argv:
    print("no licence for the simulator", file=sys.stderr, flush=True)
    os._exit(7)
"""


def test_a_worker_that_dies_at_start_is_reported_at_once_with_its_last_lines(commands: Processes) -> None:
    folder = commands.folder
    shutil.copy(HERE / "own_environments.py", folder)
    (folder / "dies.py").write_text(DIES, encoding="utf-8")
    task = own_task(folder, TASK.replace("envs:make", "dies:Corridor").replace('labels = "workers:labels"', ""))
    run = folder / "run"
    started = commands.start("t4nmtd", "train", "--task", str(task), "--run-dir", str(run), "--no-dashboard")
    commands.until(lambda: "no licence" in started.err, "the launcher says what happened", 40)
    assert "t4nmtd: worker evaluator ended with code 7" in started.err
    commands.until(lambda: any("no licence" in text for text in events(run)), "so does the event log", 10)
    commands.until_state(run, lambda s: any("no licence" in e.text for e in s.events), "and the dashboard", 10)
    assert any(text.startswith("worker evaluator ended with code 7") for text in events(run))


@given(st.text(max_size=3000), st.integers(1, 400))
def test_a_notice_fills_neither_the_event_log_nor_the_screen(text: str, times: int) -> None:
    bulletin = NoticeFilter()
    taken = [bulletin.lines(text) for _ in range(times)]
    assert all(len(lines) <= 6 for lines in taken)
    assert sum(map(len, taken)) <= 1000
    assert all(line and line.isprintable() and len(line) <= 300 for lines in taken for line in lines)


def test_a_notice_keeps_its_first_line_and_the_last_ones() -> None:
    assert NoticeFilter().lines("\n".join("abcdefghij")) == ["a", "f", "g", "h", "i", "j"]


def test_a_worker_killed_from_outside_is_told_in_the_event_log_and_on_the_terminal_if_it_is_killed_again(
    commands: Processes,
) -> None:
    run = commands.folder / "run"
    started = commands.start("t4nmtd", "train", "--task", "task8", "--run-dir", str(run), "--no-dashboard")
    for times in (1, 2):
        commands.until(lambda: f"evaluator takes evaluator (epoch {times})" in events(run), "it evaluates")  # noqa: B023
        os.kill(worker_number(run, "evaluator") or 0, signal.SIGKILL)
        says = "worker evaluator was killed by SIGKILL"
        commands.until(lambda: sum(says in text for text in events(run)) == times, "the event log has it")  # noqa: B023
        assert started.err.count(says) == times - 1


@pytest.mark.command
def test_processes_are_started_without_the_current_folder_on_their_path(tmp_path: Path) -> None:
    from t4nmtd_dist.launch.command_lines import python_command

    (tmp_path / "torch.py").write_text(FOREIGN, encoding="utf-8")
    code = subprocess.run(
        [*python_command("worker"), "--help"], cwd=tmp_path, capture_output=True, env=dict(os.environ)
    )
    assert code.returncode == 0, code.stderr
