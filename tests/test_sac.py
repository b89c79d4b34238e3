"""SAC with policy intervention: acting, counting, and where every bootstrap value comes from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sac import (
    AT_G1,
    AT_G4,
    BEFORE_WALL,
    ERROR,
    PIDS,
    START,
    TO_G2,
    TO_G4,
    CheckedPeers,
    Floats,
    product_states,
    small_sac,
    small_sac_task,
    twin,
)

from t4nmtd_dist.agents.common.attempt_statistics import AttemptStatistics
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.batches_ahead import BATCHES_AHEAD
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import NoPeers, PeerCritics
from t4nmtd_dist.agents.common.replay_buffer import Returns
from t4nmtd_dist.agents.sac.updater import PeerSoftValues

# Acting and counting


@pytest.mark.parametrize(("name", "pid", "bound"), [("task5", "g1", 1.0), ("task1", "red", 3.5)])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_actions_are_within_the_bounds_and_use_all_of_them(name: str, pid: str, bound: float, share: float) -> None:
    flags = ("sac.exploration=sinusoid", f"sac.exploration_share={share}", "sac.learning_starts=400")
    learner = small_sac(pid, *flags, name=name)
    taken, step = [], learner.rollout.step
    learner.rollout.step = lambda actions: (taken.append(actions.copy()), step(actions))[1]  # type: ignore
    for _ in range(5):
        learner.iterate(NoPeers())
    actions = np.concatenate(taken)
    assert actions.shape == (100, 2)
    assert actions.dtype == np.float32
    assert 0.8 * bound < np.abs(actions).max() <= bound
    assert actions.min() < -0.5 * bound < 0.5 * bound < actions.max()
    stored = learner.replay_buffer.actions[:100]
    assert np.abs(stored).max() <= 1
    assert np.allclose(stored * bound, actions, atol=1e-6)


@pytest.mark.parametrize("per_step", [0.25, 0.5, 1.0, 2.5])
def test_interactions_and_updates_are_counted_exactly(per_step: float) -> None:
    learner = small_sac("g1", f"sac.updates_per_step={per_step}")
    for iteration in range(1, 6):
        assert learner.iterate(NoPeers())
        interactions = iteration * 20
        assert learner.rollout.interactions == interactions
        assert learner.version == iteration
        assert len(learner.replay_buffer) == interactions
        due = int(per_step * interactions) - int(per_step * 48)  # 50 experiences are there at interaction 50
        assert learner.gradient_steps == max(0, due)
    assert learner.losses()[0] is not None


def test_nothing_is_learned_before_there_is_enough_to_learn_from() -> None:
    learner = small_sac("g1")
    before = learner.weights()
    for _ in range(2):
        learner.iterate(NoPeers())
    assert learner.gradient_steps == 0
    assert learner.losses() == (None, None)
    assert all(np.array_equal(array, before[name]) for name, array in learner.weights().items())


def test_a_learner_without_start_states_waits() -> None:
    learner = small_sac("g3")
    assert not learner.iterate(NoPeers())
    assert (learner.rollout.interactions, learner.version, len(learner.replay_buffer)) == (0, 0, 0)


def test_what_is_stored_is_what_happened() -> None:
    learner = small_sac("g1", "learner.attempt_steps=4", "sac.learning_starts=400", starts=((START, AT_G1),))
    for _ in range(3):
        learner.iterate(NoPeers())
    found, count = learner.replay_buffer, len(learner.replay_buffer)
    begun = found.ended[: count - 2]
    assert begun.any()
    after, seen = found.next_observations[: count - 2], found.observations[2:count]  # two copies take turns
    assert (after[~begun] == seen[~begun]).all()
    assert (after[begun] != seen[begun]).any(axis=1).all()
    assert (found.observations[:count] != found.next_observations[:count]).any()
    delta = small_sac_task().dfa.delta
    after_q = delta[found.q[: count - 2], found.symbols[: count - 2]]
    assert (after_q[~begun] == found.q[2:count][~begun]).all()
    assert (found.q[2:count][begun] == START).all()
    assert (after_q == TO_G2).any()


def test_exploration_is_decided_when_an_attempt_begins_and_at_no_other_time() -> None:
    learner = small_sac("g1", "learner.attempt_steps=4", "sac.learning_starts=400", starts=((START, AT_G1),))
    told: list[tuple[list[int], float]] = []
    for exploration in (learner.agent._exploration._sinusoid, learner.agent._exploration._held):
        exploration.begin = lambda rows, success: told.append((rows.tolist(), success))  # type: ignore
    learner.iterate(NoPeers())
    learner.iterate(NoPeers())
    assert told[::2] == told[1::2], "both kinds are told the same"
    told = told[::2]
    ended = [np.flatnonzero(copies).tolist() for copies in learner.replay_buffer.ended[:40].reshape(20, 2)]
    assert [rows for rows, _ in told] == [[0, 1], *ended[:-1]]
    assert told[0][1] == 0.0
    assert told[-1][1] > 0, "half of the attempts begin in the target"


# What an update learns from


@dataclass
class Update:
    """One update: its batch, how it was read from the replay, what peers said, and the targets that came out.

    ``own_targets`` are those that a twin of the learner computes when it is told of no peer.
    """

    batch: Batch
    returns: Returns
    told: PeerSoftValues
    alpha: float
    targets: Floats
    own_targets: Floats


def updates_of(learner: OffPolicyLearner, peers: PeerCritics, iterations: int = 4) -> list[Update]:
    """Let a learner train, and look into every update."""
    updates: list[Update] = []
    drawn: list[Returns] = []
    read, update = learner.replay_buffer.returns, learner.agent.updater.update

    def reading(*arguments: Any) -> Returns:
        drawn.append(read(*arguments))
        return drawn[-1]

    def updating(batch: Batch, told: PeerSoftValues) -> None:
        alpha, other = float(np.exp(learner.weights()["log_alpha"][0])), twin(learner.agent.updater)
        other.update(batch)
        update(batch, told)
        targets, own = np.array(learner.agent.updater.targets), np.array(other.targets)
        updates.append(Update(batch, drawn[len(updates)], told, alpha, targets, own))

    learner.replay_buffer.returns, learner.agent.updater.update = reading, updating  # type: ignore[method-assign]
    for _ in range(iterations):
        learner.iterate(peers)
    assert len(updates) == learner.gradient_steps > 20
    return updates


def q_of(states: Any) -> NDArray[np.int64]:
    one_hots = states.numpy()[:, -6:]
    assert (np.sort(one_hots)[:, -2:] == [0, 1]).all()
    found: NDArray[np.int64] = one_hots.argmax(1)
    return found


def test_time_outs_bootstrap_and_errors_do_not() -> None:
    """Trap: a time-out treated as a terminal."""
    learner = small_sac("g1", "learner.attempt_steps=3", "learner.gamma=0.5", starts=((START, BEFORE_WALL),))
    cut_early, failed = 0, 0
    for update in updates_of(learner, NoPeers()):
        discounts, rewards = update.batch.discounts.numpy(), update.batch.rewards.numpy()
        error = q_of(update.batch.next_states) == ERROR
        assert ((discounts == 0) == error).all()
        assert (update.targets[error] == rewards[error]).all()
        assert (update.targets[~error] != rewards[~error]).all()
        assert set(discounts[~error].tolist()) <= {0.5, 0.25, 0.125}
        cut_early += int((discounts[~error] > 0.125).sum())
        failed += int(error.sum())
    assert min(cut_early, failed) > 20


def test_acceptance_is_terminal_and_paid() -> None:
    learner = small_sac("g4", "learner.reward_scale=0.1", "sac.n_step=1", starts=((TO_G4, AT_G4),))
    for update in updates_of(learner, NoPeers()):
        accepted = q_of(update.batch.next_states) == 5
        assert (update.batch.discounts.numpy()[accepted] == 0).all()
        assert accepted.any()
        paid = 0.1 * 100
        assert update.targets[accepted] == pytest.approx(paid, abs=1e-4)


def crossing_learner(*flags: str, silent: int = 0) -> tuple[OffPolicyLearner, CheckedPeers]:
    """A learner of g1 that begins in its target, half of the time, and its peers."""
    learner = small_sac("g1", "learner.attempt_steps=6", *flags, starts=((START, AT_G1),))
    others = {pid: small_sac(pid, *flags, seed=seed) for seed, pid in enumerate(PIDS[1:], 1)}
    return learner, CheckedPeers(others, silent)


@pytest.mark.slow
@pytest.mark.parametrize("n_step", [1, 4])
@pytest.mark.parametrize("shaping", ["paper", "potential", "subtask"])
def test_across_a_boundary_the_peers_pair_enters_the_target(shaping: str, n_step: int) -> None:
    """Trap: a peer's value taken with the learner's own DFA one-hot wrong or shifted by one."""
    learner, peers = crossing_learner(f"learner.shaping={shaping}", f"sac.n_step={n_step}")
    updates = updates_of(learner, peers)
    crossed = 0
    for update, answers in zip(updates, peers.gathered, strict=True):
        boundary, batch = np.flatnonzero(update.returns.boundary), update.batch
        assert sorted(answers.rows) == boundary.tolist()
        for row, (value, log_prob) in zip(answers.rows, answers.values.reshape(-1, 2), strict=True):
            assert q_of(batch.next_states)[row] == TO_G2
            soft = float(batch.discounts[row]) * (value - update.alpha * log_prob)
            assert update.targets[row] == pytest.approx(float(batch.rewards[row]) + soft, abs=1e-6)
        inside = np.setdiff1d(np.arange(len(update.targets)), boundary)
        assert (update.targets[inside] == update.own_targets[inside]).all()
        assert (update.targets[boundary] != update.own_targets[boundary]).all()
        crossed += len(boundary)
    assert crossed > 50
    assert peers.evaluated == crossed == peers.counts.answered
    assert peers.counts.own_used == 0


def test_what_is_asked_is_the_state_after_the_change_read_by_the_peer() -> None:
    learner, peers = crossing_learner("sac.n_step=3")
    updates = updates_of(learner, peers)
    asked = iter(peers.questions)
    seen = learner.replay_buffer.next_observations
    for batch, update in enumerate(updates):
        for row in np.flatnonzero(update.returns.boundary):
            number, asked_row, pid, observation, q = next(asked)
            assert (number, asked_row, pid, q) == (batch, row, "g2", TO_G2)
            assert pid in small_sac_task().decomposition.available(q)
            assert np.array_equal(observation, seen[update.returns.last[row]])
            expected = product_states(observation[None], np.array([q]))[0]
            assert np.array_equal(update.batch.next_states[row].numpy(), expected)


def test_peers_are_asked_about_the_batches_ahead_before_one_is_trained() -> None:
    """So that another process has time to answer."""
    learner, peers = crossing_learner()
    ahead, update = [], learner.agent.updater.update

    def updating(batch: Batch, told: PeerSoftValues) -> None:
        ahead.append(max(number for number, *_ in peers.questions) - learner.gradient_steps)
        update(batch, told)

    learner.agent.updater.update = updating  # type: ignore[method-assign]
    for _ in range(4):
        learner.iterate(peers)
    assert max(ahead) == BATCHES_AHEAD - 1
    assert np.mean(ahead) > BATCHES_AHEAD - 2, "nearly every batch has a row across a boundary"
    assert peers.evaluated == sum(len(answers.rows) for answers in peers.gathered)


def test_every_question_is_asked_once_and_after_a_resume_once_more() -> None:
    learner, first = crossing_learner()
    for _ in range(4):
        learner.iterate(first)
    asked = [(batch, row) for batch, row, *_ in first.questions]
    assert len(asked) == len(set(asked))
    pending = [drawn.number for drawn in learner._ahead.drawn for _ in drawn.asked_rows]
    assert {*pending} == {batch for batch, _ in asked if batch >= learner.gradient_steps}
    resumed, again = crossing_learner()
    resumed._ahead.load_state_dict(learner._ahead.state_dict(), learner.gradient_steps)
    resumed._ahead._ask(again)
    assert [batch for batch, *_ in again.questions] == pending


def test_another_one_hot_would_be_another_answer() -> None:
    learner = small_sac("g2")
    observations = np.random.default_rng(0).uniform(-1, 1, (5, 23)).astype(np.float32)
    generator = learner.agent.updater.optimiser_state()
    answers = []
    for q in range(6):
        learner.agent.updater.load_optimiser_state(generator)
        answers.append(learner.critic_values(observations, np.full(5, q, np.int32)))
    for q in range(6):
        assert all(np.abs(answers[q] - answers[other]).min() > 1e-5 for other in range(q))


def test_rows_whose_peer_did_not_answer_use_the_own_critic() -> None:
    learner, peers = crossing_learner(silent=3)
    own = 0
    for update in updates_of(learner, peers):
        boundary = np.flatnonzero(update.returns.boundary)
        unanswered = np.setdiff1d(boundary, update.told.rows)
        assert (update.targets[unanswered] == update.own_targets[unanswered]).all()
        assert (update.targets[update.told.rows] != update.own_targets[update.told.rows]).all()
        own += len(unanswered)
    assert own > 20


def test_a_learner_that_hands_over_to_itself_asks_nobody() -> None:
    learner = small_sac("g1", starts=((START, AT_G1),))
    learner.batches.method.successors = lambda role, q_next, rng: ["g1"] * len(q_next)  # type: ignore[method-assign]
    peers = CheckedPeers({})
    updates = updates_of(learner, peers)
    assert sum(update.returns.boundary.sum() for update in updates) > 20
    assert peers.questions == []
    assert all((update.targets == update.own_targets).all() for update in updates)


# Relabelling


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_share_of_a_batch_is_read_in_other_states_of_the_subtask(share: float) -> None:
    """Task 6 goes through g1 in ten of its automaton's transitions."""
    learner = small_sac("g1", f"sac.relabel_share={share}", "sac.batch=64", "sac.n_step=1", name="task6")
    available = set(np.flatnonzero(learner.batches.reader.tables.available).tolist())
    assert len(available) > 4
    states, experience = small_sac_task(name="task6").dfa.states, learner.replay_buffer
    for _ in range(3):
        learner.iterate(NoPeers())
    read, own = [], []
    for _ in range(20):
        batch = learner.batches.draw(0, success=0.0)
        q = batch.states[:, -states:].argmax(1)
        observations = batch.states[:, :-states]
        rows = [int(np.flatnonzero((experience.observations == seen).all(1))[0]) for seen in observations]
        read += q.tolist()
        own += experience.q[rows].tolist()
    other = np.mean(np.array(read) != own)
    assert set(read) <= available
    assert other == pytest.approx(share * (1 - 1 / len(available)), abs=0.06)
    assert share == 0 or set(read) == available


def test_what_a_relabelled_row_leads_to_is_computed_from_its_letter() -> None:
    learner = small_sac("g1", "sac.relabel_share=1", "sac.n_step=1", starts=(), name="task6")
    task, experience = small_sac_task(name="task6"), learner.replay_buffer
    for _ in range(4):
        learner.iterate(NoPeers())
    rows = np.arange(len(experience))
    for q in np.flatnonzero(learner.batches.reader.tables.available):
        found = experience.returns(
            rows, np.full(len(rows), q, np.int32), learner.batches.reader.tables, task.dfa.delta, 0.99, 1
        )
        assert found.q_next.tolist() == [int(task.dfa.delta[q, symbol]) for symbol in experience.symbols[rows]]


# The entropy coefficient


@pytest.mark.parametrize(("gamma", "attempt_steps", "horizon"), [(0.98, 300, 50), (1.0, 300, 300)])
def test_by_default_random_actions_for_ever_are_worth_one_target(
    gamma: float, attempt_steps: int, horizon: int
) -> None:
    learner = small_sac("g1", f"learner.gamma={gamma}", f"learner.attempt_steps={attempt_steps}")
    entropy_of_a_step = 2 * np.log(2)  # two actions, each uniform in [-1, 1]
    alpha = np.exp(learner.weights()["log_alpha"][0])
    assert alpha * entropy_of_a_step * horizon == pytest.approx(10 * 0.1, rel=1e-4)  # the target's reward, scaled


@pytest.mark.parametrize(("success", "share"), [(None, 1.0), (0.0, 1.0), (0.5, 0.25), (1.0, 0.0)])
def test_the_entropy_coefficient_of_a_learner_that_fails_stays_up(success: float | None, share: float) -> None:
    learner = small_sac("g1", "sac.initial_alpha=0.3", "sac.alpha_floor=0.5", "learner.reward_scale=1e-6")
    learner.rollout.statistics.__class__ = type("Told", (AttemptStatistics,), {"recent_success": success})
    learner.iterate(NoPeers())
    learner.agent.updater._log_alpha.fill_(-20.0)
    for _ in range(3):
        learner.iterate(NoPeers())
    expected = max(0.3 * 0.5 * share, np.exp(-20.0))
    assert np.exp(learner.weights()["log_alpha"][0]) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(
    ("decay", "success", "factor"), [(0.9, None, 1.0), (0.9, 0.5, 0.775), (0.9, 1.0, 0.1), (0.0, 1.0, 1.0)]
)
def test_the_learning_rate_falls_with_success(
    decay: float, success: float | None, factor: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(AttemptStatistics, "recent_success", success)
    learner = small_sac("g1", f"sac.learning_rate_decay={decay}", "sac.learning_rate=0.01")
    while not learner.gradient_steps:
        learner.iterate(NoPeers())
    optimisers = learner.agent.updater._optimisers  # type: ignore[attr-defined]
    assert {name: each.learning_rate for name, each in optimisers.items()} == pytest.approx(
        dict.fromkeys(("actor", "critics", "alpha"), 0.01 * factor)
    )
