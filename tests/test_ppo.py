"""PPO with policy intervention: advantages, and where every bootstrap value comes from."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from small_tasks import CARRYING_2, PICK, START, TO_GOAL, TO_PASSENGER_2, small_learner, small_task, snapshot_after

from t4nmtd_dist.agents.common.peer_values import (
    InterventionCounts,
    LocalPeers,
    NoPeers,
    PeerCritics,
    PeerValues,
    Questions,
)
from t4nmtd_dist.agents.ppo.agent import PPOLearner
from t4nmtd_dist.agents.ppo.losses import generalised_advantages

Floats = NDArray[np.float32]

BESIDE_2 = snapshot_after(*TO_PASSENGER_2)
WITH_2 = snapshot_after(*TO_PASSENGER_2, PICK)
BESIDE_GOAL = snapshot_after(*TO_PASSENGER_2, PICK, *TO_GOAL[:-1])

matrices = partial(hnp.arrays, np.float32, (7, 3))
numbers = st.floats(-10, 10, width=32)


@settings(max_examples=60)
@given(
    matrices(elements=numbers),
    matrices(elements=numbers),
    matrices(elements=numbers),
    hnp.arrays(np.bool_, (7, 3)),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_advantages_are_the_discounted_sums_of_deltas_up_to_the_next_cut(
    rewards: Floats, values: Floats, next_values: Floats, cut: NDArray[np.bool_], gamma: float, gae_lambda: float
) -> None:
    found = generalised_advantages(rewards, values, next_values, cut, gamma=gamma, gae_lambda=gae_lambda)
    for n in range(3):
        for t in range(7):
            expected, weight = 0.0, 1.0
            for k in range(t, 7):
                expected += weight * (float(rewards[k, n]) + gamma * float(next_values[k, n]) - float(values[k, n]))
                weight *= gamma * gae_lambda
                if cut[k, n]:
                    break
            assert found[t, n] == pytest.approx(expected, abs=1e-3)


# Bootstrap values


class RecordingPeers(LocalPeers):
    """Peers of this process that also keep what they were asked: (row, pid, observation, q)."""

    def __init__(self, learners: dict[str, PPOLearner]) -> None:
        super().__init__({pid: learner.critic_values for pid, learner in learners.items()})
        self.learners = learners
        self.questions: list[tuple[int, str, Floats, int]] = []

    def ask(self, batch: int, questions: Questions) -> None:
        columns = (questions.rows.tolist(), questions.pids, questions.observations.copy(), questions.q.tolist())
        self.questions += zip(*columns, strict=True)
        super().ask(batch, questions)


class HalfOfThem:
    """Passes every other question on: the others stay without an answer."""

    def __init__(self, peers: PeerCritics) -> None:
        self.peers = peers
        self.answered: set[int] = set()
        self.turn = 0

    @property
    def counts(self) -> InterventionCounts:
        return self.peers.counts

    def ask(self, batch: int, questions: Questions) -> None:
        for place, row in enumerate(questions.rows.tolist()):
            self.turn += 1
            if self.turn % 2:
                self.answered.add(row)
                one = slice(place, place + 1)
                columns = (questions.pids[one], questions.observations[one], questions.q[one])
                self.peers.ask(batch, Questions(questions.rows[one], *columns))

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        return self.peers.gather(batch, patience_s)


def value_of(learner: PPOLearner, observation: Floats, q: int) -> float:
    """V(s, q) by the network itself, its input put together by hand."""
    one_hot = torch.zeros(small_task().dfa.states)
    one_hot[q] = 1.0
    with torch.no_grad():
        return float(learner.network.critic(torch.cat([torch.from_numpy(observation), one_hot])))


def crossing_learner(*flags: str) -> tuple[PPOLearner, dict[str, PPOLearner]]:
    """A learner of p2 that begins beside its passenger, and its peers."""
    learner = small_learner("p2", "ppo.rollout=32", "learner.attempt_steps=6", *flags, starts=((START, BESIDE_2),))
    return learner, {pid: small_learner(pid, *flags) for pid in ("g", "p1", "p3")}


def collected(learner: PPOLearner, peers: PeerCritics) -> tuple[Floats, Floats]:
    """Values and bootstrap values, flat, of one roll-out."""
    assert learner.rollout.begin()
    learner.collect(peers)
    values, next_values = learner.bootstrap(peers)
    return values, next_values.reshape(-1)


@pytest.mark.parametrize("shaping", ["paper", "potential", "subtask"])
def test_across_a_boundary_the_value_is_the_peers_own_at_the_state_after_the_change(shaping: str) -> None:
    """Trap: a peer's value taken with the learner's own DFA one-hot wrong or shifted by one."""
    learner, others = crossing_learner(f"learner.shaping={shaping}")
    peers = RecordingPeers(others)
    _, next_values = collected(learner, peers)
    assert len(peers.questions) > 3
    for row, pid, observation, q in peers.questions:
        assert pid in small_task().decomposition.available(q)
        assert pid != learner.pid
        assert next_values[row] == pytest.approx(value_of(others[pid], observation, q), abs=1e-6)
        for wrong in (START, q + 1):
            assert abs(next_values[row] - value_of(others[pid], observation, wrong)) > 1e-5


def test_what_is_asked_is_the_state_after_the_change_not_the_one_of_the_restart() -> None:
    learner, others = crossing_learner()
    peers = RecordingPeers(others)
    collected(learner, peers)
    targets = [(observation, q) for _, _, observation, q in peers.questions if q == CARRYING_2]
    assert targets, "passenger 2 is one pick away from every start"
    reference = small_learner("g", starts=((CARRYING_2, WITH_2),))
    reference.rollout.begin()
    assert any(np.array_equal(observation, reference.rollout.observations[0]) for observation, _ in targets)


@pytest.mark.parametrize("half", [False, True])
def test_rows_without_an_answer_use_the_own_critic(half: bool) -> None:
    learner, others = crossing_learner()
    asked = HalfOfThem(RecordingPeers(others))
    values, next_values = collected(learner, asked if half else NoPeers())
    trajectory = learner.trajectory
    boundary, terminal = trajectory.boundary.reshape(-1), trajectory.terminal.reshape(-1)
    observations = trajectory.boundary_observations.reshape(len(boundary), -1)
    own = [row for row in np.flatnonzero(boundary) if not (half and row in asked.answered)]
    assert own
    for row in own:
        expected = value_of(learner, observations[row], int(trajectory.boundary_q.reshape(-1)[row]))
        assert next_values[row] == pytest.approx(expected, abs=1e-6)
    count = values.shape[1]
    inside = [row for row in np.flatnonzero(~boundary & ~terminal) if row + count < len(next_values)]
    assert next_values[inside] == pytest.approx(values.reshape(-1)[np.array(inside) + count], abs=1e-6)


def test_acceptance_and_holes_are_worth_nothing_and_a_time_out_is_not_terminal() -> None:
    learner = small_learner("g", "learner.attempt_steps=5", starts=((CARRYING_2, BESIDE_GOAL),))
    _, next_values = collected(learner, NoPeers())
    trajectory = learner.trajectory
    terminal = trajectory.terminal.reshape(-1)
    assert terminal.any()
    assert (next_values[terminal] == 0).all()
    timed_out = (trajectory.cut & ~trajectory.terminal).reshape(-1)
    assert timed_out.any()
    assert (next_values[timed_out] != 0).all()


def test_nobody_is_asked_about_terminals_or_inside_a_subtask() -> None:
    learner, others = crossing_learner()
    peers = RecordingPeers(others)
    collected(learner, peers)
    trajectory = learner.trajectory
    for row, _, observation, q in peers.questions:
        t, n = divmod(row, trajectory.rewards.shape[1])
        assert trajectory.boundary[t, n]
        assert np.array_equal(observation, trajectory.boundary_observations[t, n])
        assert q == trajectory.boundary_q[t, n]
        assert q != np.argmax(trajectory.states[t, n, -small_task().dfa.states :])


def test_the_published_critic_is_the_one_after_the_last_update() -> None:
    learner = small_learner("p2")
    q = np.array([START, CARRYING_2], np.int32)
    for version in range(1, 3):
        learner.iterate(NoPeers())
        observations = learner.rollout.observations[:2]
        values, published = learner.published.values({"observation": observations, "q": q})
        assert published == learner.version == version
        assert values == pytest.approx(learner.critic_values(observations, q), abs=1e-6)


def test_weights_go_from_one_learner_to_another() -> None:
    first, second = small_learner("p2"), small_learner("p2", "learner.gamma=0.5")
    first.iterate(NoPeers())
    second.load(first.weights(), first.version)
    assert second.version == first.version == 1
    assert all(np.array_equal(a, b) for a, b in zip(first.weights().values(), second.weights().values(), strict=True))
