"""Exploration by sinusoids and by held actions: how many attempts are driven, which, and by what."""

from __future__ import annotations

from collections.abc import Callable
from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.exploration import (
    FREQUENCIES,
    LONGEST_HOLD,
    Exploration,
    HeldActionExploration,
    SinusoidExploration,
)

Floats = NDArray[np.float32]


def everywhere(count: int) -> NDArray[np.int64]:
    return np.arange(count)


def driven_steps(exploration: SinusoidExploration, policy: Floats, steps: int) -> Floats:
    """Actions [steps, N, A] where the policy's are always the same."""
    return np.stack([exploration.drive(everywhere(len(policy)), policy) for _ in range(steps)])


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("success", [0.0, 0.3, 1.0])
def test_the_share_of_driven_attempts_falls_with_success(share: float, success: float) -> None:
    count, policy = 5000, np.full((5000, 2), 0.123, np.float32)
    exploration = SinusoidExploration(count, 2, share, np.random.default_rng(0))
    exploration.begin(everywhere(count), success)
    driven = (driven_steps(exploration, policy, 3) != policy).any(axis=(0, 2)).mean()
    expected = share * (1 - success) ** 2
    assert driven == pytest.approx(expected, abs=0.03)
    assert expected not in (0.0, 1.0) or driven == expected


@given(st.integers(0, 1000), st.integers(1, 6), st.integers(1, 5), st.floats(0, 1))
def test_actions_are_either_the_policys_own_or_within_the_bounds(
    seed: int, count: int, size: int, share: float
) -> None:
    rng = np.random.default_rng(seed)
    exploration = SinusoidExploration(count, size, share, rng)
    exploration.begin(everywhere(count), 0.0)
    policies = rng.uniform(-1, 1, (40, count, size)).astype(np.float32)
    actions = np.stack([exploration.drive(everywhere(len(policy)), policy) for policy in policies])
    assert actions.dtype == np.float32
    assert actions.shape == policies.shape
    assert (np.abs(actions) <= 1).all()
    for copy in range(count):
        same = (actions[:, copy] == policies[:, copy]).all(axis=1)
        assert same.all() or not same.any(), "an attempt is driven from beginning to end, or not at all"


def test_an_attempt_has_one_frequency_and_every_action_a_phase_of_its_own() -> None:
    exploration = SinusoidExploration(20, 6, 1.0, np.random.default_rng(0))
    exploration.begin(everywhere(20), 0.0)
    waves = driven_steps(exploration, np.zeros((20, 6), np.float32), 300).astype(np.float64)
    # x(t+1) + x(t-1) = 2 cos(w) x(t) holds for every sinusoid of frequency w and for no other
    slope = ((waves[2:] + waves[:-2]) * waves[1:-1]).sum(0) / (waves[1:-1] ** 2).sum(0)
    frequencies = np.arccos(slope / 2)  # radians a step
    assert np.abs(waves[2:] + waves[:-2] - slope * waves[1:-1]).max() < 1e-5
    assert np.ptp(frequencies, axis=1).max() < 1e-4
    assert len(np.unique(frequencies[:, 0].round(3))) > 15
    lowest, highest = 2 * np.pi * np.array(FREQUENCIES)
    assert lowest - 1e-4 < frequencies.min() < frequencies.max() < highest + 1e-4
    # the phase, from sin(p) and sin(w + p)
    phases = np.arctan2(waves[0] * np.sin(frequencies), waves[1] - waves[0] * np.cos(frequencies))
    assert min(np.diff(np.sort(row)).min() for row in phases) > 1e-4
    assert phases.min() < -2.5 < 2.5 < phases.max()


def test_an_attempt_that_begins_changes_nothing_for_the_others() -> None:
    first, second = (SinusoidExploration(3, 2, 1.0, np.random.default_rng(0)) for _ in range(2))
    policy = np.zeros((3, 2), np.float32)
    for exploration in (first, second):
        exploration.begin(everywhere(3), 0.0)
        driven_steps(exploration, policy, 5)
    first.begin(np.array([1]), 0.0)
    left, right = driven_steps(first, policy, 20), driven_steps(second, policy, 20)
    assert np.array_equal(left[:, [0, 2]], right[:, [0, 2]])
    assert not np.array_equal(left[:, 1], right[:, 1])


@pytest.mark.parametrize("kind", [SinusoidExploration, HeldActionExploration])
def test_copies_that_another_network_acts_for_wait(kind: type[SinusoidExploration | HeldActionExploration]) -> None:
    exploration = kind(3, 2, 1.0, np.random.default_rng(0))
    exploration.begin(everywhere(3), 0.0)
    before = {name: column.copy() for name, column in exploration.state_dict().items()}
    for _ in range(30):
        assert exploration.drive(np.array([2, 0]), np.zeros((2, 2), np.float32)).shape == (2, 2)
    after = exploration.state_dict()
    assert all(np.array_equal(before[name][1], after[name][1]) for name in before)
    assert any(not np.array_equal(before[name][0], after[name][0]) for name in before)


def test_once_the_learner_succeeds_new_attempts_are_its_own() -> None:
    exploration = SinusoidExploration(2, 1, 1.0, np.random.default_rng(0))
    policy = np.full((2, 1), 0.5, np.float32)
    exploration.begin(everywhere(2), 0.0)
    exploration.begin(np.array([0]), 1.0)
    actions = driven_steps(exploration, policy, 10)
    assert (actions[:, 0] == 0.5).all()
    assert (actions[:, 1] != 0.5).all()


@pytest.mark.parametrize(("share", "success"), [(0.0, 0.0), (0.5, 0.0), (1.0, 0.3), (1.0, 1.0)])
def test_the_share_of_interrupted_attempts_falls_with_success(share: float, success: float) -> None:
    count = 5000
    exploration = HeldActionExploration(count, 1, share, np.random.default_rng(0))
    exploration.begin(everywhere(count), success)
    policy = np.full((count, 1), 0.123, np.float32)
    interrupted = (
        np.stack([exploration.drive(everywhere(len(policy)), policy) != policy for _ in range(100)])
        .any(axis=(0, 2))
        .mean()
    )
    assert interrupted == pytest.approx(share * (1 - success) ** 2, abs=0.03)


def test_random_actions_are_held_and_the_policy_acts_in_between() -> None:
    exploration = HeldActionExploration(200, 2, 1.0, np.random.default_rng(0))
    exploration.begin(everywhere(200), 0.0)
    policy = np.full((200, 2), 2.0, np.float32)  # outside the bounds, so that it can be told apart
    actions = np.stack([exploration.drive(everywhere(len(policy)), policy) for _ in range(400)])
    held = (actions != policy).all(axis=2)
    assert (np.abs(actions[held]) <= 1).all()
    holds = [
        len(list(group))
        for copy in range(200)
        for action, group in groupby(map(tuple, actions[:, copy].tolist()))
        if action != (2.0, 2.0)
    ]
    assert LONGEST_HOLD / 2 < max(holds) <= LONGEST_HOLD
    # a hold lasts 10.5 steps on average, and the pause before the next one (1 - 0.1) / 0.1 = 9 steps
    assert held.mean() == pytest.approx(10.5 / 19.5, abs=0.03)


def test_a_hold_ends_with_its_attempt() -> None:
    exploration = HeldActionExploration(500, 1, 1.0, np.random.default_rng(0))
    policy = np.full((500, 1), 2.0, np.float32)
    exploration.begin(everywhere(500), 0.0)
    for _ in range(20):
        exploration.drive(everywhere(len(policy)), policy)
    exploration.begin(everywhere(500), 1.0)
    assert (exploration.drive(everywhere(len(policy)), policy) == policy).all()


def test_a_saved_exploration_goes_on_as_it_was() -> None:
    def made() -> HeldActionExploration:
        return HeldActionExploration(50, 3, 0.7, np.random.default_rng(4))

    first, second, policy = made(), made(), np.zeros((50, 3), np.float32)
    first.begin(everywhere(50), 0.2)
    for _ in range(7):
        first.drive(everywhere(len(policy)), policy)
    second.load_state_dict(first.state_dict())
    second._rng.bit_generator.state = first._rng.bit_generator.state
    for _ in range(30):
        assert np.array_equal(
            first.drive(everywhere(len(policy)), policy), second.drive(everywhere(len(policy)), policy)
        )


def shares_of(kinds: str, share: float, success: float = 0.0) -> tuple[float, float, float]:
    """Of all attempts: driven throughout, by sinusoids; interrupted by held actions; left to the policy."""
    count, policy = 4000, np.full((4000, 1), 2.0, np.float32)  # outside the bounds, so that it can be told apart
    exploration = Exploration(kinds, share, count, 1, np.random.default_rng(0))
    exploration.begin(everywhere(count), success)
    own = np.stack([(exploration.drive(everywhere(len(policy)), policy) == policy).all(axis=1) for _ in range(150)])
    sinusoid, left = ~own.any(axis=0), own.all(axis=0)
    return sinusoid.mean(), (~sinusoid & ~left).mean(), left.mean()


@pytest.mark.parametrize("success", [0.0, 0.5])
@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ("none", lambda p: (0, 0, 1)),
        ("held", lambda p: (0, p, 1 - p)),
        ("sinusoid", lambda p: (p, 0, 1 - p)),
        ("held+sinusoid", lambda p: (p, p * (1 - p), (1 - p) ** 2)),
    ],
)
def test_each_chosen_kind_drives_the_same_share_under_one_schedule(
    kinds: str, expected: Callable[[float], tuple[float, float, float]], success: float
) -> None:
    share = 0.4
    assert shares_of(kinds, share, success) == pytest.approx(expected(share * (1 - success) ** 2), abs=0.03)


def test_both_kinds_are_saved_and_go_on_as_they_were() -> None:
    def made() -> Exploration:
        return Exploration("held+sinusoid", 0.7, 50, 3, np.random.default_rng(4))

    first, second, policy = made(), made(), np.zeros((50, 3), np.float32)
    first.begin(everywhere(50), 0.2)
    for _ in range(7):
        first.drive(everywhere(len(policy)), policy)
    second.load_state_dict(first.state_dict())
    second._held._rng.bit_generator.state = first._held._rng.bit_generator.state
    for _ in range(30):
        assert np.array_equal(
            first.drive(everywhere(len(policy)), policy), second.drive(everywhere(len(policy)), policy)
        )
