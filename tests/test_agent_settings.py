"""Settings of agents live with the agents: a registered one has its section, defaults and checks without more ado."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest
from own_agent.config import OwnConfig

from t4nmtd_dist.agents.ppo.config import PPOConfig
from t4nmtd_dist.core.agent_settings import agent_for, agent_settings
from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS
from t4nmtd_dist.tasks import load_task


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(AGENTS.modules, "own", "own_agent")  # type: ignore[misc]


@pytest.mark.usefixtures("own")
def test_a_registered_agent_has_a_section_of_its_own() -> None:
    config = load_task("task7", flags=["learner.algorithm=own", "own.share=0.25"])
    assert config.agent == config.agents["own"] == OwnConfig(share=0.25)
    assert config.agents["ppo"] == PPOConfig()
    assert config.to_dict()["own"] == {"share": 0.25, "most": 1.0}
    assert task_config(config.to_dict()) == config


@pytest.mark.usefixtures("own")
def test_its_defaults_lie_under_what_the_task_gives() -> None:
    assert load_task("task7", flags=["learner.algorithm=own"]).learner.gamma == 0.95, "task 7 gives its own"
    plain = {"name": "t", "formula": "F(a)", "propositions": ["a"], "environment": {"id": "e", "horizon": 5}}
    assert task_config({**plain, "learner": {"algorithm": "own"}}).learner.gamma == 0.7


@pytest.mark.usefixtures("own")
@pytest.mark.parametrize(
    ("flag", "text"),
    [
        ("own.share=1.5", "own.share = 1.5: expected a number from 0 to 1"),
        ("own.share=much", "own.share = 'much': expected `float`"),
        ("own.shar=0.1", "unknown key 'own.shar'; did you mean 'own.share'?"),
        ("own.part=0.1", "'own.part' was a key of an earlier version: use 'own.share'"),
        ("own.most=0.1", "own.share = 0.5: expected at most own.most = 0.1"),
        ("own=3", "own = 3"),
    ],
)
def test_mistakes_in_it_are_named(flag: str, text: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load_task("task7", flags=[flag])
    assert text in str(refusal.value)


def test_a_section_of_no_agent_is_an_unknown_key() -> None:
    with pytest.raises(ConfigError, match="unknown key 'own'"):
        load_task("task7", flags=["own.share=0.5"])


def test_an_unknown_algorithm_is_refused_with_the_known_ones_and_the_nearest() -> None:
    known = ", ".join(AGENTS.names())
    with pytest.raises(
        ConfigError, match=rf"learner\.algorithm: unknown agent 'sacc'; did you mean 'sac'\? Known: {known}$"
    ):
        load_task("task7", flags=["learner.algorithm=sacc"])


def test_what_a_program_makes_is_checked_as_what_a_file_says() -> None:
    config = load_task("task7")
    with pytest.raises(ConfigError, match=r"ppo\.rollout = 0: expected 1 or more"):
        replace(config, agents={**config.agents, "ppo": PPOConfig(rollout=0)})
    with pytest.raises(ConfigError, match=r"learner\.gamma = 2\.0: expected a number from 0 to 1"):
        replace(config, learner=replace(config.learner, gamma=2.0))
    with pytest.raises(ConfigError, match="unknown agent 'sacc'"):
        replace(config, learner=replace(config.learner, algorithm="sacc"))


def test_an_undecided_algorithm_has_no_settings_yet() -> None:
    with pytest.raises(ConfigError, match="not decided yet"):
        _ = load_task("task7", flags=["learner.algorithm=auto"]).agent


def test_auto_takes_the_first_agent_that_takes_the_actions(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (agent_for("discrete", "t4nmtd"), agent_for("continuous", "t4nmtd")) == ("ppo", "sac")
    monkeypatch.setitem(AGENTS.modules, "own", "own_agent")  # type: ignore[misc]
    assert agent_for("discrete", "t4nmtd") == "ppo", "one that was added later does not change what auto means"


@pytest.mark.parametrize("name", AGENTS.names())
@pytest.mark.command
def test_settings_are_read_without_torch(name: str) -> None:
    code = f"import sys, {AGENTS.modules[name]}.config; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 0
    assert agent_settings(name).config().num_envs >= 1
