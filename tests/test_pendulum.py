"""The loop that compares our SAC to Stable-Baselines3's: what it counts, and that the two are treated alike."""

from __future__ import annotations

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from benchmark_modules import benchmark

from t4nmtd_dist.agents.sac.updater import SACSettings

INTERACTIONS, SOME, HORIZON = 300, 150, 200
TINY = SACSettings(initial_alpha=1.0, layer_norm=False, hidden=(16, 16))


@pytest.fixture(scope="module")
def pendulum() -> ModuleType:
    torch.set_num_threads(1)
    return benchmark("pendulum")


def trained(make: Any, interactions: int = INTERACTIONS) -> Any:
    agent = make(0, interactions, TINY)
    for _ in range(interactions // 50):
        agent.train(50)
    return agent


@pytest.mark.slow
@pytest.mark.parametrize(("name", "interactions"), [("Ours", INTERACTIONS), ("Theirs", SOME)])
def test_updates_are_one_per_interaction_after_the_first_hundred_and_returns_are_finite(
    name: str, interactions: int, pendulum: ModuleType
) -> None:
    agent = trained(getattr(pendulum, name), interactions)
    assert agent.updates == interactions - 100
    found = pendulum.mean_return(agent, episodes=2)
    assert math.isfinite(found)
    assert -2000 < found < 0
    assert pendulum.mean_return(agent, episodes=2) == found, "always from the same starts"


def test_every_interaction_is_kept_and_a_time_out_bootstraps(pendulum: ModuleType) -> None:
    agent = trained(pendulum.Ours)
    experience = agent.replay_buffer
    assert len(experience) == INTERACTIONS
    assert np.flatnonzero(experience.ended).tolist() == [HORIZON - 1]
    rows = np.arange(INTERACTIONS)
    returns = experience.returns(rows, experience.q[rows], pendulum.ONE_STATE, pendulum.DELTA, 0.99, 1)
    assert (returns.discount == 0.99).all()
    assert (returns.last == rows).all()
    follows = (experience.next_observations[:-1] == experience.observations[1:]).all(axis=1)
    assert np.flatnonzero(~follows).tolist() == [HORIZON - 1], "only the reset breaks the chain"


def test_stored_rewards_and_actions_are_those_of_the_world(pendulum: ModuleType) -> None:
    """Pendulum's reward is -(angle^2 + 0.1 speed^2 + 0.001 torque^2), before the step."""
    agent = trained(pendulum.Ours)
    cosine, sine, speed = agent.replay_buffer.observations.T.astype(np.float64)
    torque = 2.0 * agent.replay_buffer.actions[:, 0]
    expected = -(np.arctan2(sine, cosine) ** 2 + 0.1 * speed**2 + 0.001 * torque**2)
    np.testing.assert_allclose(agent._rewards, expected, atol=1e-4)
    assert np.ptp(torque[:100]) > 3.5, "uniform at first"


def test_both_begin_in_the_same_state_and_have_the_same_sizes(pendulum: ModuleType) -> None:
    ours, theirs = pendulum.Ours(7, INTERACTIONS, TINY), pendulum.Theirs(7, INTERACTIONS, TINY)
    theirs.train(1)
    np.testing.assert_array_equal(ours._observation, theirs._sac.replay_buffer.observations[0, 0])
    actor = sum(array.size for name, array in ours._updater.weights().items() if name.startswith("actor."))
    assert actor == sum(parameter.numel() for parameter in theirs._sac.actor.parameters())
    critics = sum(array.size for name, array in ours._updater.weights().items() if name.startswith("critics."))
    assert critics == sum(parameter.numel() for parameter in theirs._sac.critic.parameters())
    assert ours._updater.weights()["log_alpha"] == theirs._sac.log_ent_coef.item() == 0.0


@pytest.mark.slow
def test_a_run_is_the_same_whoever_trains_beside_it(pendulum: ModuleType) -> None:
    alone = trained(pendulum.Theirs, SOME)
    beside, other = pendulum.Theirs(0, SOME, TINY), pendulum.Ours(0, SOME, TINY)
    for _ in range(SOME // 50):
        other.train(50)
        beside.train(50)
    assert pendulum.mean_return(alone, episodes=1) == pendulum.mean_return(beside, episodes=1)


@pytest.mark.parametrize(
    ("ours", "theirs", "by", "error"),
    [
        ([-150.0, -160.0, -170.0], [-160.0, -160.0, -160.0], 0.0, (100 / 3) ** 0.5),
        ([-150.0], [-160.0], 10.0, 0.0),
        ([-100.0, -200.0], [-120.0, -160.0], -10.0, ((5000 + 800) / 2) ** 0.5),
    ],
)
def test_the_difference_comes_with_the_standard_error_over_seeds(
    ours: list[float], theirs: list[float], by: float, error: float, pendulum: ModuleType
) -> None:
    assert pendulum.difference(ours, theirs) == pytest.approx((by, error))
