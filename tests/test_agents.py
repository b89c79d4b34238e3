"""What is true of every registered agent: its folder's modules, and what may be known of it without torch."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from small_agents import small_agent, small_agent_task

from t4nmtd_dist.agents.actors import make_actor
from t4nmtd_dist.agents.modules import actor_module, builder_module, shapes_module
from t4nmtd_dist.agents.protocol import Learner
from t4nmtd_dist.agents.weight_checks import check_weights, expected_shapes
from t4nmtd_dist.agents.weights import acting_parameters
from t4nmtd_dist.core.agent_settings import agent_settings
from t4nmtd_dist.core.errors import ConfigError, PolicyError
from t4nmtd_dist.core.registry import AGENTS

WITHOUT_TORCH = ("agents.weight_checks", "agents.actors", "agents.protocol", "wire.task_size")
MODULES_OF = (shapes_module, actor_module, builder_module)

every_agent = pytest.mark.parametrize("name", AGENTS.names())


@cache
def trained(name: str) -> Learner:
    learner = small_agent(name, iterations=4)
    assert learner.gradient_steps
    return learner


@pytest.mark.command
@pytest.mark.parametrize("module", [*WITHOUT_TORCH, *(f"agents.{name}.shapes" for name in AGENTS.names())])
def test_what_the_coordinator_reads_of_agents_imports_no_torch(module: str) -> None:
    code = f"import sys, t4nmtd_dist.{module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-P", "-c", code], timeout=60).returncode == 0


@pytest.mark.parametrize("module_of", MODULES_OF)
def test_an_unknown_algorithm_is_refused_with_the_known_ones(module_of: Callable[[str], object]) -> None:
    with pytest.raises(ConfigError, match=r"learner.algorithm: unknown agent 'sacc'; did you mean 'sac'.*ppo, sac"):
        module_of("sacc")


@pytest.mark.parametrize("module_of", MODULES_OF)
def test_an_undecided_algorithm_is_refused(module_of: Callable[[str], object]) -> None:
    with pytest.raises(ConfigError, match="not decided yet"):
        module_of("auto")


@every_agent
def test_the_weights_of_a_learner_are_those_that_the_coordinator_expects(name: str) -> None:
    task, weights = small_agent_task(name), trained(name).weights()
    sizes = check_weights(weights, task.config, task.dfa.states)
    assert sizes.observation == trained(name).rollout.observations.shape[1]
    shapes = {name: array.shape for name, array in weights.items()}
    assert expected_shapes(task.config, task.dfa.states, sizes) == shapes


@every_agent
def test_the_exploration_settings_that_are_recommended_exist(name: str) -> None:
    settings = small_agent_task(name).config.to_dict()
    for setting in agent_settings(name).exploration:
        section, key = setting.split(".")
        assert key in settings[section]


@every_agent
def test_an_actor_acts_on_the_parameters_that_are_exported_and_on_no_others(name: str) -> None:
    settings, weights = small_agent_task(name).config.learner, trained(name).weights()
    exported = acting_parameters(weights)
    rng = np.random.default_rng(0)
    actor, again = make_actor(settings, weights), make_actor(settings, exported)
    states = rng.standard_normal((7, actor.inputs), np.float32)
    expected = actor.act(states)
    assert len(expected) == 7
    assert np.array_equal(again.act(states), expected)
    sampled = [each.act(states, np.random.default_rng(1)) for each in (actor, again)]
    assert np.array_equal(*sampled)
    for lacking in exported:
        with pytest.raises((PolicyError, KeyError)):
            make_actor(settings, {key: array for key, array in exported.items() if key != lacking})


@every_agent
def test_a_replica_answers_from_the_published_weights(name: str) -> None:
    learner = trained(name)
    replica = learner.replica()
    replica.load(*learner.published.weights())
    weights, version = replica.weights()
    assert version == learner.version
    for key, array in learner.published.weights()[0].items():
        assert np.array_equal(weights[key], array), key
    request = {"observation": learner.rollout.observations[:2], "q": learner.rollout.q[:2]}
    assert replica.values(request)[0].shape == (2, *learner.value_shape)
