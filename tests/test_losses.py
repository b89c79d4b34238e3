"""Losses and targets of SAC and PPO, against formulas written out here."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from t4nmtd_dist.agents.common.peer_values import PeerValues
from t4nmtd_dist.agents.ppo import losses as ppo
from t4nmtd_dist.agents.ppo.trajectory import Trajectory
from t4nmtd_dist.agents.sac import losses as sac

OWN = sac.NextValues(torch.tensor([5.0, 5.0, 5.0]), torch.tensor([-1.0, -1.0, -1.0]))
PEERS = sac.NextValues(torch.tensor([7.0, 7.0, 7.0]), torch.tensor([-3.0, -3.0, -3.0]))
REWARD, DISCOUNT = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.9, 0.9, 0.0])


def target(answered: list[bool], alpha: float = 0.5) -> list[float]:
    found = sac.critic_target(REWARD, DISCOUNT, OWN, PEERS, torch.tensor(answered), torch.tensor([alpha]))
    return [round(value, 5) for value in found.tolist()]


def test_across_a_boundary_value_and_log_probability_are_the_peers_and_alpha_is_the_own() -> None:
    assert target([False, False, False]) == pytest.approx([1 + 0.9 * 5.5, 2 + 0.9 * 5.5, 3])
    assert target([False, True, False]) == pytest.approx([1 + 0.9 * 5.5, 2 + 0.9 * 8.5, 3])
    assert target([False, True, False], alpha=0.0) == pytest.approx([1 + 0.9 * 5, 2 + 0.9 * 7, 3])


def test_a_terminal_bootstraps_from_nobody() -> None:
    assert target([True, True, True])[2] == 3.0


def descent(loss: Tensor, parameter: Tensor) -> float:
    (gradient,) = torch.autograd.grad(loss, parameter)
    return -float(gradient.sum())


@pytest.mark.parametrize(("entropy", "rises"), [(0.5, True), (2.0, False)])
def test_alpha_rises_where_the_entropy_is_below_its_target(entropy: float, rises: bool) -> None:
    log_alpha = torch.zeros(1, requires_grad=True)
    loss = sac.alpha_loss(log_alpha, torch.full((4,), -entropy), target_entropy=1.0)
    assert (descent(loss, log_alpha) > 0) == rises


def test_the_critics_loss_is_the_sum_of_half_mean_squares() -> None:
    errors = torch.tensor([[1.0, 3.0], [2.0, 0.0]])
    assert float(sac.critic_loss(errors)) == 0.5 * 5 + 0.5 * 2


def test_the_actors_loss_weighs_entropy_against_value() -> None:
    loss = sac.actor_loss(torch.tensor([0.5]), torch.tensor([-2.0, 0.0]), torch.tensor([1.0, 3.0]))
    assert float(loss) == (-1 - 1 + 0 - 3) / 2


# PPO


def trajectory() -> Trajectory:
    """Three steps of two copies; copy 0 crosses a boundary at step 1, copy 1 ends in a terminal there."""
    made = Trajectory.empty(3, 2, 4, 3)
    made.cut[1] = True
    made.boundary[1, 0] = True
    made.terminal[1, 1] = True
    return made


@pytest.mark.parametrize(("rows", "expected"), [([], 50.0), ([2], 70.0)])
def test_a_boundary_bootstraps_from_the_peer_else_from_the_own_critic(rows: list[int], expected: float) -> None:
    values = np.arange(6, dtype=np.float32).reshape(3, 2)
    answers = PeerValues(np.array(rows, np.int64), np.full(len(rows), 70.0, np.float32))
    last, own = np.array([10.0, 11.0], np.float32), np.array([50.0], np.float32)
    found = ppo.bootstrap_values(trajectory(), values, last, own, answers)
    assert found.tolist() == [[2.0, 3.0], [expected, 0.0], [10.0, 11.0]]


def test_the_trace_stops_at_a_boundary() -> None:
    ones = np.ones((3, 1), np.float32)
    cut = np.array([[False], [True], [False]])
    found = ppo.generalised_advantages(ones, 0 * ones, 0 * ones, cut, gamma=1.0, gae_lambda=1.0)
    assert found.ravel().tolist() == [2.0, 1.0, 1.0]


@pytest.mark.parametrize(
    ("ratio", "advantage", "moves"), [(1.3, 1.0, False), (1.3, -1.0, True), (0.7, -1.0, False), (1.0, 1.0, True)]
)
def test_the_surrogate_lets_no_ratio_go_further_from_one_than_the_clip(
    ratio: float, advantage: float, moves: bool
) -> None:
    log_probs = torch.tensor([math.log(ratio)], requires_grad=True)
    loss = ppo.clipped_surrogate(log_probs, torch.zeros(1), torch.tensor([advantage]), clip=0.2)
    assert np.sign(descent(loss, log_probs)) == (np.sign(advantage) if moves else 0)


def test_entropy_and_value_loss() -> None:
    even = torch.log(torch.full((3, 4), 0.25))
    assert float(ppo.entropy_of(even)) == pytest.approx(math.log(4))
    assert float(ppo.value_loss(torch.tensor([1.0, 2.0]), torch.tensor([3.0, 2.0]))) == 2.0
