"""Task 5, the Racecar, with tiny SAC learners, and places of its track."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import LocalPeers, PeerValues, Questions
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.agents.sac.agent import SAC
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.weights import part_of
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.tasks import load_task

torch.set_num_threads(1)

Floats = NDArray[np.float32]
Place = tuple[int, NDArray[np.float64]]

TINY = (
    "learner.hidden=[16]",
    "sac.batch=16",
    "sac.learning_starts=50",
    "sac.num_envs=2",
    "sac.replay_rows=400",
    "sac.updates_per_step=1",
)
START, TO_G2, ERROR, TO_G3, TO_G4, ACCEPTING = range(6)  # states of the task's automaton, after their next target
PIDS = ("g1", "g2", "g3", "g4")


@cache
def small_sac_task(*flags: str, name: str = "task5") -> CompiledTask:
    """A task compiled with tiny learners; further ``key=value`` flags on top."""
    return compile_task(load_task(name, flags=[*TINY, *flags]))


def car_at(x: float, y: float, vx: float = 0.0, vy: float = 0.0) -> NDArray[np.float64]:
    """A snapshot of the car."""
    return np.array([x, y, vx, vy, 0, 0, 0, 0, 0, 0])


AT_G1 = car_at(0.75, -0.75)
AT_G4 = car_at(-0.75, 0.75)
BEFORE_WALL = car_at(1.45, 0.3, vx=0.5)  # meets it in the next step, which the step after that reports


def small_sac(
    pid: str, *flags: str, starts: tuple[Place, ...] = (), name: str = "task5", seed: int = 0
) -> OffPolicyLearner:
    """A learner whose buffer holds ``starts`` as (DFA state, snapshot)."""
    task, buffer = small_sac_task(*flags, name=name), InitialStateBuffer(100)
    for q, state in starts:
        buffer.add(q, state)
    learner = build_learner(task, pid, buffer, task.method(), seed=seed)
    assert isinstance(learner, OffPolicyLearner)
    assert isinstance(learner.agent, SAC)
    return learner


def product_states(observations: Floats, q: NDArray[np.int32], dfa_states: int = 6) -> Floats:
    """Observations and one-hots, put together by hand."""
    return np.concatenate([observations, np.eye(dfa_states, dtype=np.float32)[q]], axis=1)


def twin(updater: SACUpdater) -> SACUpdater:
    """Another updater in exactly the same state, that of its noise included."""
    weights = updater.weights()
    actions, state_size = weights["actor.head.bias"].shape[1] // 2, weights["actor.0.weight"].shape[1]
    made = SACUpdater(state_size, actions, updater.settings, seed=99)
    made.load(weights)
    made.load_optimiser_state(updater.optimiser_state())
    return made


def averaged(updater: SACUpdater) -> SACUpdater:
    """An updater whose actor is the average of the other's."""
    made = twin(updater)
    weights = updater.weights()
    made.load(weights | {f"actor.{name}": array for name, array in part_of(weights, "average").items()})
    return made


class CheckedPeers(LocalPeers):
    """Peers of this process; every answer is checked against the peer's twin, and kept by row.

    Args:
        learners: the peers by pid.
        silent: every so manieth question stays without an answer; 0 for none.
    """

    def __init__(self, learners: dict[str, OffPolicyLearner], silent: int = 0) -> None:
        super().__init__({pid: self._checked(learner) for pid, learner in learners.items()})
        self._silent, self._turn = silent, 0
        self.questions: list[tuple[int, int, str, Floats, int]] = []  # with the number of the batch
        self.gathered: list[PeerValues] = []
        self.evaluated = 0

    def _checked(self, learner: OffPolicyLearner):  # type: ignore[no-untyped-def]
        def values(observations: Floats, q: NDArray[np.int32]) -> Floats:
            expected = twin(learner.agent.updater).soft_values(product_states(observations, q))
            found = learner.critic_values(observations, q)
            np.testing.assert_allclose(found, np.stack(expected, axis=1), atol=1e-6)
            self.evaluated += len(q)
            return found

        return values

    def ask(self, batch: int, questions: Questions) -> None:
        heard = []
        for place, (row, pid) in enumerate(zip(questions.rows.tolist(), questions.pids, strict=True)):
            self.questions.append((batch, row, pid, questions.observations[place].copy(), int(questions.q[place])))
            self._turn += 1
            if not self._silent or self._turn % self._silent:
                heard.append(place)
        if heard:
            pids = tuple(questions.pids[place] for place in heard)
            super().ask(
                batch, Questions(questions.rows[heard], pids, questions.observations[heard], questions.q[heard])
            )

    def gather(self, batch: int, patience_s: float = 0.0) -> PeerValues:
        self.gathered.append(super().gather(batch, patience_s))
        return self.gathered[-1]
