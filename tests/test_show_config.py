"""``t4nmtd config`` prints settings that say where they come from and can be read back."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from small_tasks import own_task

from t4nmtd_dist.cli.commands import Config
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.environments.decisions import with_algorithm
from t4nmtd_dist.tasks import load_task, task_names

Show = Callable[..., str]

OWN = """
name = "own"
formula = "F(a) & F(\\"b c\\")"
propositions = ["a", "b c"]
[environment]
id = "x:y"
horizon = 10
options = { sizes = [1, 2.5], names = { "two words" = "a\\nb", empty = {} }, on = true }
"""


@pytest.fixture
def shown(capsys: pytest.CaptureFixture[str]) -> Show:
    def show(task: str, *flags: str, configs: tuple[Path, ...] = ()) -> str:
        assert Config(task, config=list(configs), set=list(flags)).run() == 0
        return capsys.readouterr().out

    return show


def origins(text: str) -> dict[str, str]:
    """The comment of every setting by its dotted key."""
    found, section = {}, ""
    for line in text.splitlines():
        if header := re.fullmatch(r"\[(.*)\]", line):
            section = header[1] + "."
        elif match := re.fullmatch(r"(# )?(\w+) = .*  # (.*)", line):
            found[section + match[2]] = match[3]
    return found


def read_back(text: str, task: str, folder: Path) -> TaskConfig:
    path = folder / "shown.toml"
    path.write_text(text, encoding="utf-8")
    return load_task(task, configs=[path])


@pytest.mark.parametrize("name", task_names())
def test_what_is_printed_reads_back_the_same(name: str, shown: Show, tmp_path: Path) -> None:
    text = shown(name)
    assert read_back(text, name, tmp_path) == load_task(name)
    assert read_back(shown(name, configs=(tmp_path / "shown.toml",)), name, tmp_path) == load_task(name)
    sections = tomllib.loads(text).keys() & {"sac", "ppo"}
    assert sections == {load_task(name).learner.algorithm}, "the sections of other agents are left out"


@pytest.mark.parametrize("given", ["", 'exclusive = [["a", "b c"]]\ntitle = \'say "hi" \u00e4\\\'\n'])
def test_a_task_of_ones_own_reads_back_the_same(given: str, shown: Show, tmp_path: Path) -> None:
    path = str(own_task(tmp_path, given + OWN))
    assert read_back(shown(path), path, tmp_path) == load_task(path)


def test_every_line_says_where_its_value_comes_from(shown: Show, tmp_path: Path) -> None:
    laid_over = tmp_path / "mine.toml"
    laid_over.write_text("[learner]\ngamma = 0.5\nreward_scale = 0.3\n[sac]\nn_step = 2\n", encoding="utf-8")
    found = origins(shown("task1", "learner.gamma=0.6", "sac.batch=7", configs=(laid_over,)))
    expected = {
        "learner.gamma": "--set",
        "learner.reward_scale": f"--config {laid_over}",
        "learner.algorithm": "task1.toml",
        "learner.shaping": "default of sac",
        "learner.intervention": "default",
        "sac.batch": "--set",
        "sac.n_step": f"--config {laid_over}",
        "sac.exploration": "task1.toml",
        "sac.num_envs": "default",
        "environment.options.colours": "task1.toml",
        "max_interactions": "default",
    }
    assert {key: found[key] for key in expected} == expected


def test_a_folder_that_the_loader_adds_is_named_so(shown: Show, tmp_path: Path) -> None:
    assert origins(shown(str(own_task(tmp_path, OWN))))["environment.path"] == "folder of the task file"


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_an_algorithm_chosen_later_still_brings_its_own_defaults(algorithm: str, shown: Show, tmp_path: Path) -> None:
    path = str(own_task(tmp_path, OWN + "[learner]\nattempt_steps = 7\n[ppo]\nepochs = 2\n[sac]\nbatch = 3\n"))
    text = shown(path)
    assert origins(text)["learner.gamma"] == "default; sac: 0.98"
    again = read_back(text, path, tmp_path)
    assert with_algorithm(again, algorithm) == with_algorithm(load_task(path), algorithm)
