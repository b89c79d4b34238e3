"""Learning from peers' experience: copies that follow the original, what is refused, and what a batch holds."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from routers import receive_from
from small_sac import AT_G1, PIDS, TO_G2, small_sac, small_sac_task

from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_success_replay import target_symbols
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.common.replay_buffer import SHARED, ReplayBuffer
from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.method.rewards import subtask_tables
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import ExperienceReply, ExperienceRequest, Failure, Peer
from t4nmtd_dist.wire.peers.experience_client import (
    AFTER_MISFIT_S,
    ANSWER_WITHIN_S,
    ASK_EVERY_S,
    PeerExperience,
    checked_columns,
)
from t4nmtd_dist.wire.sockets import bind, bound_endpoint, send
from t4nmtd_dist.wire.zmq_types import Context, Socket
from workers.critic_service import EXPERIENCE_BYTES, CriticService

SIZE, ACTIONS, LETTERS = 3, 2, 4
WAIT_S = 20.0
PLENTY = 1 << 20

Columns = dict[str, NDArray[Any]]


def lived(steps: int, count: int, capacity: int, seed: int = 0, start: int = 0) -> ReplayBuffer:
    """An experience whose observations are numbers of their step and copy, never the same twice."""
    made, rng = ReplayBuffer(capacity, count, SIZE, ACTIONS), np.random.default_rng(seed)
    for t in range(start, start + steps):
        observations = np.repeat((t * count + np.arange(count))[:, None], SIZE, axis=1).astype(np.float32)
        ended = rng.random(count) < 0.2
        made.add(
            observations,
            np.zeros(count, np.int32),
            rng.uniform(-1, 1, (count, ACTIONS)).astype(np.float32),
            rng.integers(LETTERS, size=count),
            observations + 0.5,
            ended & (rng.random(count) < 0.5),
            ended,
            np.zeros(count, np.bool_),
        )
    return made


def kept(experience: ReplayBuffer) -> Columns:
    """All steps still there, in order."""
    return experience.since(0, PLENTY)[1]


def same(a: Columns, b: Columns) -> bool:
    return set(a) == set(b) == set(SHARED) and all(np.array_equal(a[name], b[name]) for name in a)


# Copies


@given(st.integers(0, 40), st.integers(1, 3), st.integers(1, 50), st.integers(1, 600), st.integers(0, 99))
def test_a_copy_made_in_parts_holds_the_same_steps(
    steps: int, count: int, capacity: int, bytes_at_once: int, seed: int
) -> None:
    original = lived(steps, count, capacity, seed)
    copy, step = original.alike(capacity), 0
    while step < original.written:
        first, columns = original.since(step, bytes_at_once)
        copy.extend(columns, follows=first == step)
        assert len(columns["symbols"]) > 0
        step = first + len(columns["symbols"])
    assert same(kept(copy), kept(original))
    assert len(copy) == len(original)


@given(st.integers(1, 30), st.integers(1, 10), st.integers(1, 40))
def test_a_small_copy_keeps_the_newest_steps(steps: int, capacity: int, bytes_at_once: int) -> None:
    original = lived(steps, 2, 50)
    copy = original.alike(capacity)
    copy.extend(original.since(0, PLENTY)[1], follows=True)
    newest = {name: column[-capacity:] for name, column in kept(original).items()}
    assert same(kept(copy), newest)


def test_attempts_count_as_ended_where_steps_are_missing() -> None:
    early, late = lived(5, 2, 10), lived(5, 2, 10, start=7)
    copy = early.alike(20)
    copy.extend(kept(early), follows=True)
    copy.extend(kept(late), follows=False)
    expected = np.concatenate([kept(early)["ended"], kept(late)["ended"]])
    expected[4] = True
    assert kept(copy)["ended"].tolist() == expected.tolist()
    assert not kept(early)["ended"][4].all(), "or nothing had to be changed"


def test_what_another_thread_reads_is_never_half_a_step() -> None:
    experience, torn, stop = ReplayBuffer(50, 3, SIZE, ACTIONS), [], threading.Event()

    def read() -> None:
        while not stop.is_set():
            _, columns = experience.since(0, PLENTY)
            numbers = columns["observations"][..., 0]
            torn.append(
                bool(
                    (columns["next_observations"][..., 0] != numbers + 0.5).any() or (np.ptp(numbers, axis=1) > 0).any()
                )
            )

    reader = threading.Thread(target=read)
    reader.start()
    for t in range(3000):
        observations = np.full((3, SIZE), t, np.float32)
        flags, zeros = np.zeros(3, np.bool_), np.zeros(3, np.int64)
        actions = np.zeros((3, ACTIONS), np.float32)
        experience.add(observations, zeros.astype(np.int32), actions, zeros, observations + 0.5, flags, flags, flags)
    stop.set()
    reader.join()
    assert len(torn) > 10
    assert not any(torn)


# From process to process


class Clock:
    """Time that passes a little at every look, so that nothing is ever too early for long."""

    def __init__(self, every: float = 0.02) -> None:
        self.now, self._every = 0.0, every

    def __call__(self) -> float:
        self.now += self._every
        return self.now


def follow(copies: PeerExperience, pid: str, written: int) -> ReplayBuffer:
    """Pull until the copy has as many steps."""
    for _ in range(int(WAIT_S * 100)):
        copies.pull()
        if pid in copies.copies and copies.copies[pid].written >= written:
            return copies.copies[pid]
        threading.Event().wait(0.01)
    raise AssertionError(f"no {written} steps of {pid} within {WAIT_S} s")


def stand(copies: PeerExperience) -> Socket:
    """The socket to g1, once it is connected."""
    socket = copies._connections.by_pid["g1"].socket
    assert socket.poll(int(WAIT_S * 1000), zmq.POLLOUT)
    return socket


def at(endpoint: str) -> Peer:
    return Peer(endpoint=endpoint, version=0, epoch=1)


def test_a_peers_experience_comes_and_is_kept_up_to_date(context: Context, service: CriticService) -> None:
    learner = small_sac("g1")
    service.serve("g1", learner.published, learner.replay_buffer)
    copies = PeerExperience(context, "asker", lambda: learner.replay_buffer.alike(200), 100)
    copies.set_peers({"g1": at(service.endpoint)})
    for rounds in (3, 5):
        for _ in range(rounds):
            learner.iterate(NoPeers())
        copy = follow(copies, "g1", learner.replay_buffer.written)
        assert same(kept(copy), kept(learner.replay_buffer))
    copies.set_peers({})
    copies.pull()
    assert same(kept(copies.copies["g1"]), kept(learner.replay_buffer)), "a peer that is gone leaves what it told"


def test_what_a_peer_tells_anew_does_not_go_on_from_what_it_told_before(
    context: Context, service: CriticService
) -> None:
    learner, experience = small_sac("g1"), lived(4, 2, 50)
    service.serve("g1", learner.published, experience)
    copies = PeerExperience(context, "asker", lambda: experience.alike(50), LETTERS)
    copies.set_peers({"g1": at(service.endpoint)})
    follow(copies, "g1", 4)
    copies.set_peers({})
    copies.set_peers({"g1": at(service.endpoint)})
    twice = kept(follow(copies, "g1", 8))
    assert (twice["observations"][:4] == twice["observations"][4:]).all()
    assert twice["ended"][3].all()
    assert not kept(experience)["ended"][3].all(), "or nothing had to be changed"


def test_a_peer_that_begins_anew_and_has_caught_up_is_noticed(context: Context, service: CriticService) -> None:
    critic, first, second = small_sac("g1").published, lived(4, 2, 50), lived(6, 2, 50, seed=1)
    service.serve("g1", critic, first)
    copies = PeerExperience(context, "asker", lambda: first.alike(50), LETTERS)
    copies.set_peers({"g1": at(service.endpoint)})
    follow(copies, "g1", 4)
    service.serve("g1", critic, second)
    joined = kept(follow(copies, "g1", 10))
    assert np.array_equal(joined["actions"], np.concatenate([kept(each)["actions"] for each in (first, second)]))
    assert joined["ended"][3].all(), "no return reaches from the one into the other"
    copies.close()


@pytest.mark.slow
def test_much_experience_comes_in_parts(context: Context, service: CriticService) -> None:
    learner, count = small_sac("g1"), 2
    wide = ReplayBuffer(3000, count, 200, ACTIONS)
    for t in range(1500):
        wide.add(
            np.full((count, 200), t, np.float32),
            np.zeros(count, np.int32),
            np.zeros((count, ACTIONS), np.float32),
            np.zeros(count, np.int64),
            np.full((count, 200), t + 1, np.float32),
            *(np.zeros(count, np.bool_) for _ in range(3)),
        )
    assert sum(column.nbytes for column in kept_all(wide).values()) > 2 * EXPERIENCE_BYTES
    service.serve("g1", learner.published, wide)
    copies = PeerExperience(context, "asker", lambda: wide.alike(3000), LETTERS)
    copies.set_peers({"g1": at(service.endpoint)})
    assert same(kept_all(follow(copies, "g1", 1500)), kept_all(wide))
    small = PeerExperience(context, "another", lambda: wide.alike(100), LETTERS)
    small.set_peers({"g1": at(service.endpoint)})
    copy = follow(small, "g1", 100)
    while copy.observations.max() < 1499:
        copy = follow(small, "g1", copy.written + 1)
    assert copy.written < 1000, "what would be dropped at once is not asked for"
    kept_steps = kept_all(copy)["observations"][:, 0, 0]
    gaps = np.flatnonzero(np.diff(kept_steps) != 1)
    assert kept_all(copy)["ended"][gaps].all(), "returns do not reach over what is missing"
    for each in (copies, small):
        each.close()


def kept_all(experience: ReplayBuffer) -> Columns:
    return experience.since(0, 1 << 30)[1]


def test_a_learner_without_experience_has_none_to_tell(context: Context, service: CriticService) -> None:
    service.serve("g1", small_sac("g1").published)
    copies = PeerExperience(context, "asker", lambda: lived(0, 2, 10), LETTERS, clock=Clock())
    copies.set_peers({"g1": at(service.endpoint)})
    socket = stand(copies)
    copies.pull()
    assert socket.poll(int(WAIT_S * 1000)), "it is told"
    copies.pull()
    assert copies.copies == {}
    copies.close()


def test_a_silent_peer_is_asked_again_after_a_while_and_never_waited_for(context: Context) -> None:
    router, clock = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), Clock(every=0.0)
    copies = PeerExperience(context, "asker", lambda: lived(0, 2, 10), LETTERS, clock=clock)
    copies.set_peers({"g1": at(bound_endpoint(router))})

    socket = stand(copies)

    def asked() -> tuple[bytes, Envelope] | None:
        if not router.poll(300):
            return None
        received = receive_from(router)
        assert received is not None
        peer, envelope = received
        assert isinstance(envelope, Envelope)
        return peer, envelope

    copies.pull()
    first = asked()
    assert first is not None
    assert first[1].message == ExperienceRequest(pid="g1", step=0)
    copies.pull()
    assert asked() is None
    clock.now += ANSWER_WITHIN_S
    copies.pull()
    second = asked()
    assert second is not None
    for number, steps in ((first[1].id, 7), (second[1].id, 4)):  # an answer to what was given up counts for nothing
        arrays = {f"experience.{name}": column for name, column in kept(lived(steps, 2, 10)).items()}
        send(router, Envelope(ExperienceReply(first=0, written=steps), arrays, id=number), peer=second[0])
    assert socket.poll(int(WAIT_S * 1000))
    threading.Event().wait(0.2)
    copies.pull()
    assert copies.copies["g1"].written == 4
    clock.now += ASK_EVERY_S
    copies.pull()
    third = asked()
    assert third is not None
    assert third[1].message == ExperienceRequest(pid="g1", step=4)
    copies.close()


BAD: dict[str, Callable[[Columns], Columns]] = {
    "nothing": lambda good: {},
    "a column missing": lambda good: {name: column for name, column in good.items() if name != "ended"},
    "a column more": lambda good: good | {"q": good["symbols"]},
    "not finite": lambda good: good | {"actions": np.full_like(good["actions"], np.nan)},
    "infinite": lambda good: good | {"observations": np.full_like(good["observations"], np.inf)},
    "other copies": lambda good: {name: column[:, :1] for name, column in good.items()},
    "fewer steps in one column": lambda good: good | {"actions": good["actions"][1:]},
    "another observation": lambda good: good | {"observations": good["observations"][..., :1]},
    "another type": lambda good: good | {"observations": good["observations"].astype(np.float64)},
    "a letter too high": lambda good: good | {"symbols": np.full_like(good["symbols"], LETTERS)},
    "a letter below 0": lambda good: good | {"symbols": np.full_like(good["symbols"], -1)},
    "a number for a column": lambda good: good | {"symbols": np.array(1)},
}


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
def test_columns_that_do_not_fit_are_refused(bad: Callable[[Columns], Columns]) -> None:
    good, room = kept(lived(5, 2, 10)), lived(0, 2, 10)
    assert same(checked_columns(good, room, LETTERS), good)
    with pytest.raises(ProtocolError, match=r"expected|outside"):
        checked_columns(bad(good), room, LETTERS)


def test_bad_columns_leave_what_is_there_and_are_told_of_once(context: Context) -> None:
    router, told = bind(context, zmq.ROUTER, "tcp://127.0.0.1:*"), list[str]()
    endpoint, clock = bound_endpoint(router), Clock(every=ASK_EVERY_S)
    copies = PeerExperience(context, "asker", lambda: lived(0, 2, 10), LETTERS, clock=clock, tell=told.append)
    copies.set_peers({"g1": at(endpoint)})
    good = {f"experience.{name}": column for name, column in kept(lived(3, 2, 10)).items()}
    bad, worse = (good | {"experience.symbols": np.zeros(size)} for size in (2, 1))
    answers: list[tuple[Any, Columns]] = [
        (ExperienceReply(first=0, written=3), good),
        (ExperienceReply(first=3, written=6), bad),
        (ExperienceReply(first=3, written=6), worse),
        (Failure(text="no"), {}),
        (ExperienceReply(first=0, written=3), good),
    ]
    for message, arrays in answers:
        while not router.poll(1):
            copies.pull()
        received = receive_from(router)
        assert received is not None
        assert isinstance(received[1], Envelope)
        send(router, Envelope(message, arrays, id=received[1].id), peer=received[0])
        line = copies._connections.by_pid["g1"]
        assert line.socket.poll(int(WAIT_S * 1000))
        copies.pull()
        assert (line.ask_at - clock.now > AFTER_MISFIT_S / 2) == any(arrays is each for each in (bad, worse)), (
            "asked again after a minute"
        )
    assert copies.copies["g1"].written == 6, "the first and the last"
    assert [line.partition(": ")[0] for line in told] == [f"dropping what g1 at {endpoint} tells of its experience"]
    assert "observations is float32 (3, 2, 3), expected float32 (2, 2, 3)" in told[0]
    copies.close()


# What a batch holds


def taught(share: float, **flags: str) -> tuple[OffPolicyLearner, OffPolicyLearner]:
    """Learners of g1 and g2, both with experience, g1 learning from both."""
    chosen = [f"sac.peer_share={share}", "sac.success_share=0.0", *(f"{k}={v}" for k, v in flags.items())]
    first, second = small_sac("g1", *chosen), small_sac("g2", *chosen, starts=((TO_G2, AT_G1),), seed=1)
    for learner in (first, second):
        for _ in range(5):
            assert learner.iterate(NoPeers())
    first.learn_from({"g1": first.replay_buffer, "g2": second.replay_buffer})
    return first, second


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_a_share_of_a_batch_is_read_from_peers(share: float) -> None:
    first, second = taught(share)
    assert first.peer_rows == (len(second.replay_buffer) if share else 0)
    theirs = {row.tobytes() for row in second.replay_buffer.actions[: len(second.replay_buffer)]}
    drawn = first.batches.draw(0, success=0.0)
    assert len(drawn.actions) == 16
    assert sum(row.tobytes() in theirs for row in drawn.actions) == round(16 * share)


def test_peers_rows_are_read_as_the_own_sub_tasks() -> None:
    """Every row has the reward of its own symbol in the DFA state in which it is read, one of the own sub-task's."""
    first, second = taught(1.0, **{"sac.n_step": "1"})
    task, columns = small_sac_task(), kept_all(second.replay_buffer)
    columns["symbols"] = np.random.default_rng(0).integers(task.dfa.delta.shape[1], size=columns["symbols"].shape)
    experience = second.replay_buffer.alike(len(columns["symbols"]))
    experience.extend(columns, follows=False)
    first.learn_from({"g2": experience})
    tables = subtask_tables(
        task.dfa, task.decomposition, "g1", task.rho, gamma=0.98, shaping="subtask", error_penalty=10.0
    )
    errors, size = 0, experience.observations.shape[1]
    row_of = {row.tobytes(): number for number, row in enumerate(experience.actions[: len(experience)])}
    for _ in range(20):
        drawn = first.batches.draw(0, success=0.0)
        for action, state, reward, following in zip(
            drawn.actions, drawn.states, drawn.rewards, drawn.next_states, strict=True
        ):
            row, q = row_of[action.tobytes()], int(state[size:].argmax())
            q_next = int(task.dfa.delta[q, experience.symbols[row]])
            assert tables.available[q]
            assert state[:size].tolist() == experience.observations[row].tolist()
            assert following[:size].tolist() == experience.next_observations[row].tolist()
            assert int(following[size:].argmax()) == q_next
            assert reward == pytest.approx(0.1 * tables.reward[q, q_next])
            errors += int(tables.error[q_next])
    assert errors > 0


def test_nothing_is_read_from_peers_that_have_nothing() -> None:
    first, _ = taught(0.5)
    first.learn_from({"g1": first.replay_buffer, "g2": lived(0, 2, 10)})
    assert first.peer_rows == 0
    assert len(first.batches.draw(0, success=0.0).actions) == 16


def test_peers_are_as_likely_as_their_experience_is_long() -> None:
    first, second = taught(1.0)
    short = second.replay_buffer.alike(10)
    size = first.replay_buffer.observations.shape[1]
    columns = {name: column[:5].copy() for name, column in kept_all(second.replay_buffer).items()}
    columns["observations"][:] = 7.0
    short.extend(columns, follows=True)
    first.learn_from({"g2": second.replay_buffer, "g3": short})
    drawn = [bool((first.batches.draw(0, success=0.0).states[:, :size] == 7.0).all()) for _ in range(600)]
    share = len(short) / (len(short) + len(second.replay_buffer))
    assert np.mean(drawn) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 600))


def test_all_peers_together_are_kept_as_long_as_the_own_experience() -> None:
    learner = small_sac("g1")
    assert learner.peer_steps == learner.replay_buffer.steps // (len(PIDS) - 1)
    assert small_sac("g1", "sac.peer_share=0.0").peer_steps == 0


@pytest.mark.slow
@pytest.mark.parametrize(("success", "least", "most"), [(0.0, 0.8, 0.95), (0.5, 0.2, 0.35), (1.0, 0.0, 0.05)])
def test_a_learner_that_fails_reads_more_of_the_rows_in_which_it_would_have_succeeded(
    success: float, least: float, most: float
) -> None:
    """One symbol in a hundred is g1's; its row is drawn a hundredth of the time by a learner that succeeds."""
    first, second = taught(1.0, **{"sac.success_share": "0.9", "sac.batch": "1000"})
    size = second.replay_buffer.observations.shape[1]
    symbol = int(np.flatnonzero(target_symbols(first.batches.reader.tables, small_sac_task().dfa.delta))[0])
    wide, like = second.replay_buffer.alike(100), kept_all(second.replay_buffer)
    columns = {name: np.zeros((100, *column.shape[1:]), column.dtype) for name, column in like.items()}
    columns["ended"][:] = True
    columns["symbols"][50, 0] = symbol
    columns["observations"][50, 0] = 7.0
    wide.extend(columns, follows=False)
    first.learn_from({"g2": wide})
    drawn = first.batches.draw(0, success=success)
    share = float((drawn.states[:, :size] == 7.0).all(1).mean())
    assert least <= share <= most
