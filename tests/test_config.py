"""Settings: what overrides what, and how mistakes are met."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_tasks import own_task

from t4nmtd_dist.agents.ppo.config import PPOConfig
from t4nmtd_dist.core.config import task_config
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_sources import merge, settings_from_flags
from t4nmtd_dist.tasks import load_task, task_names

OWN = """
name = "own"
formula = "F(a)"
propositions = ["a"]
[environment]
id = "x/Y-v0"
horizon = 10
[learner]
gamma = 0.5
attempt_steps = 7
[ppo]
num_envs = 3
"""


@pytest.fixture
def own(tmp_path: Path) -> Path:
    return own_task(tmp_path, OWN)


def overlay(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_give_way_to_the_task_to_configs_in_order_and_to_flags(own: Path, tmp_path: Path) -> None:
    first = overlay(tmp_path, "first.toml", "[learner]\ngamma = 0.6\nattempt_steps = 8\n[ppo]\nrollout = 5\n")
    second = overlay(tmp_path, "second.toml", "[learner]\ngamma = 0.7\n")
    flags = ["ppo.rollout=6"]
    config = load_task(str(own), configs=[first, second], flags=flags)
    plain = load_task(str(own))
    assert (plain.learner.gamma, plain.learner.attempt_steps, plain.agents["ppo"].num_envs) == (0.5, 7, 3)
    assert (config.learner.gamma, config.learner.attempt_steps) == (0.7, 8)
    assert (config.agents["ppo"].rollout, config.agents["ppo"].num_envs) == (6, 3)
    assert config.agents["ppo"].epochs == plain.agents["ppo"].epochs == PPOConfig().epochs


@pytest.mark.parametrize("name", task_names())
def test_every_task_of_the_package_loads_and_survives_the_wire(name: str) -> None:
    config = load_task(name)
    assert config.name == name
    assert task_config(config.to_dict()) == config


UNKNOWN = {
    "learner.gama=0.9": ("learner.gama", "learner.gamma"),
    "learnr.gamma=0.9": ("learnr", "learner"),
    "horizon=3": ("horizon", ""),
    "ppo.num_envs.x=3": ("ppo.num_envs", ""),
    "environment.horizn=3": ("environment.horizn", "environment.horizon"),
}


@pytest.mark.parametrize(("flag", "names"), UNKNOWN.items())
def test_an_unknown_key_is_named_with_the_nearest_known_one(flag: str, names: tuple[str, str]) -> None:
    with pytest.raises(ConfigError) as refusal:
        load_task("task7", flags=[flag])
    assert all(name in str(refusal.value) for name in names)


@pytest.mark.parametrize(
    ("flag", "instead"),
    [
        ("sac.worlds=3", "sac.num_envs"),
        ("ppo.worlds=3", "ppo.num_envs"),
        ("sac.wave_share=0.1", "sac.exploration_share"),
        ("sac.hold_share=0.1", "sac.exploration_share"),
        ("sac.tau=0.01", "it is fixed at 0.005 now"),
        ("ppo.clip=0.1", "it is fixed at 0.2 now"),
        ("dqn.steps_per_iteration=5", "it is fixed at 10 now"),
        ("learner.start_capacity=9", "it is fixed at 200 now"),
    ],
)
def test_a_key_of_an_earlier_version_is_refused_with_what_to_use_instead(flag: str, instead: str) -> None:
    with pytest.raises(ConfigError, match=rf"'{flag.partition('=')[0]}' was a key of an earlier version: .*{instead}"):
        load_task("task7", flags=[flag])


def test_options_of_the_environment_are_its_own_business() -> None:
    assert load_task("task7", flags=["environment.options.anything=1"]).environment.options["anything"] == 1


OUT_OF_RANGE = [
    "learner.gamma=1.5",
    "learner.gamma=-0.1",
    "learner.gamma=nan",
    "learner.attempt_steps=0",
    "learner.reward_scale=-1.0",
    "learner.reward_scale=nan",
    "ppo.num_envs=0",
    "ppo.rollout=-3",
    "ppo.learning_rate=0.0",
    "ppo.entropy_coefficient=-0.1",
    "high_level.alpha=7.0",
    "high_level.epsilon=-1.0",
    "evaluation.episodes=0",
    "evaluation.in_a_row=0",
    "max_interactions=0",
    "environment.horizon=0",
    "sac.actor_average=0.0",
    "sac.actor_average=1.1",
    "sac.replay_rows=999",
    "learner.hidden=[]",
    "learner.hidden=[64,0]",
    "learner.hidden=[-3]",
]


@pytest.mark.parametrize("flag", OUT_OF_RANGE)
def test_numbers_out_of_range_are_refused_by_key(flag: str) -> None:
    with pytest.raises(ConfigError, match=flag.partition("=")[0]):
        load_task("task7", flags=[flag])


@pytest.mark.parametrize(
    ("flag", "text"),
    [
        ("learner.shaping=none", "learner.shaping"),
        ("learner.gamma=high", "float"),
        ("ppo.num_envs=2.5", "int"),
        ("ppo=3", "ppo"),
        ("propositions=[1]", "str"),
    ],
)
def test_wrong_types_are_refused_with_the_place(flag: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        load_task("task7", flags=[flag])


@pytest.mark.parametrize("name", ["evaluator", "evaluations", "Evaluations"])
def test_a_proposition_called_like_a_part_of_every_run_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"proposition is called '{name.casefold()}'"):
        load_task("task7", flags=[f'propositions=["p1", "{name}"]', 'formula="F(p1)"', "exclusive=[]"])


def test_an_exclusive_group_of_undeclared_names_is_refused() -> None:
    with pytest.raises(ConfigError, match="'q9'"):
        load_task("task7", flags=['exclusive=[["p1", "q9"]]'])


def test_a_missing_key_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="environment"):
        load_task(str(own_task(tmp_path, 'name = "x"\nformula = "F(a)"\npropositions = ["a"]\n')))


def test_unknown_tasks_and_unreadable_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'task7'"):
        load_task("taks7")
    with pytest.raises(ConfigError, match=r"absent\.toml"):
        load_task(str(tmp_path / "absent.toml"))
    with pytest.raises(ConfigError, match="line 2"):
        load_task(str(own_task(tmp_path, 'name = "x"\nformula = F(a)\n')))
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match="not TOML"):
        load_task(str(binary))


FLAGS: dict[str, dict[str, Any]] = {
    "a=1": {"a": 1},
    "a.b.c=2.5": {"a": {"b": {"c": 2.5}}},
    " a = true ": {"a": True},
    "a=[16, 16]": {"a": [16, 16]},
    "a=paper": {"a": "paper"},
    'a="1"': {"a": "1"},
    "a=x=y": {"a": "x=y"},
    "a=": {"a": ""},
    "a={b=1}": {"a": {"b": 1}},
}


@pytest.mark.parametrize(("flag", "data"), FLAGS.items())
def test_flags_are_written_as_in_toml_and_bare_words_are_texts(flag: str, data: dict[str, Any]) -> None:
    assert settings_from_flags([flag]) == data


def test_flags_add_up_and_the_last_wins() -> None:
    assert settings_from_flags(["a.b=1", "a.c=2", "a.b=3"]) == {"a": {"b": 3, "c": 2}}


@pytest.mark.parametrize("flag", ["gamma", "=3", ""])
def test_a_flag_of_another_form_is_refused_with_an_example(flag: str) -> None:
    with pytest.raises(ConfigError, match=r"section\.key=value"):
        settings_from_flags([flag])


tables = st.recursive(
    st.integers(), lambda inner: st.dictionaries(st.sampled_from("abc"), inner, max_size=3), max_leaves=6
).map(lambda found: found if isinstance(found, dict) else {"a": found})


@given(tables, tables)
def test_merging_keeps_what_is_not_overridden(base: dict[str, Any], over: dict[str, Any]) -> None:
    merged = merge(base, over)
    assert set(merged) == set(base) | set(over)
    assert merge(merged, over) == merged
    assert merge(base, {}) == base
    for key in set(base) - set(over):
        assert merged[key] == base[key]


@given(st.text(max_size=30))
def test_any_flag_is_read_or_refused(flag: str) -> None:
    with suppress(ConfigError):
        load_task("task7", flags=[flag])


def test_an_algorithm_brings_its_own_defaults_which_every_setting_overrides() -> None:
    plain = {"name": "t", "formula": "F(a)", "propositions": ["a"], "environment": {"id": "e", "horizon": 5}}
    ppo = task_config(plain)
    sac = task_config({**plain, "learner": {"algorithm": "sac"}})
    assert (ppo.learner.shaping, ppo.learner.hidden, ppo.learner.error_penalty) == ("potential", (64, 64), 0.0)
    assert (sac.learner.shaping, sac.learner.hidden, sac.learner.error_penalty) == ("subtask", (128, 128), 10.0)
    chosen = task_config({**plain, "learner": {"algorithm": "sac", "shaping": "paper", "error_penalty": 0.0}})
    assert (chosen.learner.shaping, chosen.learner.error_penalty, chosen.learner.gamma) == ("paper", 0.0, 0.98)
    assert task_config(sac.to_dict()) == sac
    with pytest.raises(ConfigError, match="error_penalty"):
        task_config({**plain, "learner": {"error_penalty": -1.0}})
