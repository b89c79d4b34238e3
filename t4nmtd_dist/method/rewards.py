"""The product of environment and DFA: targets and rewards of a sub-task.

Everything depends on (q, q') only, so it is tabulated once and looked up for whole batches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.config import Shaping
from t4nmtd_dist.core.errors import EnvError
from t4nmtd_dist.method.decomposition import Decomposition

ACCEPTANCE_REWARD = 100.0
TARGET_REWARD = 10.0

States = NDArray[np.int32]


class SymbolReader:
    """Converts the environment's label matrix to DFA symbols.

    Args:
        dfa: defines the symbols.
        propositions: the environment's propositions, the columns of its label matrix.

    Attributes:
        delta: the DFA's transition table, int32 [Q, symbols].

    Raises:
        EnvError: if the environment does not report a proposition of the formula.
    """

    def __init__(self, dfa: DFA, propositions: tuple[str, ...]) -> None:
        missing = [name for name in dfa.propositions if name not in propositions]
        if missing:
            raise EnvError(
                f"the formula uses {missing[0]!r}, which the environment does not report; "
                f"it reports {', '.join(propositions)}"
            )
        self.delta = dfa.delta
        self._bits = np.array([dfa.symbol([name]) for name in propositions], dtype=np.int64)

    def symbols(self, labels: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Symbols int64 [N] of a bool label matrix [N, P]."""
        codes: NDArray[np.int64] = labels @ self._bits
        return codes


@dataclass(frozen=True)
class SubtaskTables:
    """DFA tables for the learner of one sub-task.

    Attributes:
        target: bool [Q, Q]; q' in Q_target(q, T).
        available: bool [Q]; the sub-task has a transition out of q.
        accepting: bool [Q], F.
        error: bool [Q], E.
        reward: float64 [Q, Q], shaped reward of a step from q to q', self-loops included.
        carried_potential: float64 [Q], the part of the reward from the potential of q'. It is subtracted at environment
            termination, since no later step pays it back.
    """

    target: NDArray[np.bool_]
    available: NDArray[np.bool_]
    accepting: NDArray[np.bool_]
    error: NDArray[np.bool_]
    reward: NDArray[np.float64]
    carried_potential: NDArray[np.float64]

    @property
    def terminal(self) -> NDArray[np.bool_]:
        """F or E, where the critic's value is 0, bool [Q]."""
        return self.accepting | self.error

    def transition_rewards(self, q: States, q_next: States, terminated: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Shaped reward of steps from q to q' (paper, Algorithm 2, lines 7 to 9), unscaled.

        Args:
            q: DFA states [N].
            q_next: DFA states after the step [N].
            terminated: whether the environment terminated on the step [N].

        Returns:
            float64 [N].
        """
        rewards: NDArray[np.float64] = self.reward[q, q_next]
        return rewards - np.where(terminated, self.carried_potential[q_next], 0.0)

    def terminals(self, q_next: States, terminated: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Steps into F or E, or on which the environment terminated, bool [N]: the value of s' is 0."""
        return self.terminal[q_next] | terminated


def subtask_tables(
    dfa: DFA,
    decomposition: Decomposition,
    pid: str,
    rho: NDArray[np.float64],
    *,
    gamma: float,
    shaping: Shaping,
    error_penalty: float = 0.0,
) -> SubtaskTables:
    """Tabulate sub-task ``pid`` of a task (paper, Algorithm 2, lines 7 to 9)."""
    target = np.zeros((dfa.states, dfa.states), dtype=np.bool_)
    for q, q_next in decomposition.subtasks[pid]:
        target[q, q_next] = True
    accepting = _mask(dfa, dfa.accepting)
    error = _mask(dfa, dfa.error)
    reward = shaped_reward(target, accepting, error, rho, gamma=gamma, shaping=shaping)
    reward -= error_penalty * (error[None, :] & ~error[:, None])
    available: NDArray[np.bool_] = np.any(target, axis=1, keepdims=True)[:, 0]
    kept = gamma * np.where(accepting | error, 0.0, rho) if shaping == "potential" else np.zeros(dfa.states)
    return SubtaskTables(target, available, accepting, error, reward, kept)


def environment_rewards(dfa: DFA, *, error_penalty: float = 0.0) -> NDArray[np.float64]:
    """What every change of the DFA state pays without shaping and whoever acts, float64 [Q, Q]."""
    accepting, error = _mask(dfa, dfa.accepting), _mask(dfa, dfa.error)
    accepts = accepting[None, :] & ~accepting[:, None]
    rewards = np.where(accepts, ACCEPTANCE_REWARD, 0.0)
    rewards -= error_penalty * (error[None, :] & ~error[:, None])
    return rewards


def _mask(dfa: DFA, states: frozenset[int]) -> NDArray[np.bool_]:
    mask = np.zeros(dfa.states, dtype=np.bool_)
    mask[list(states)] = True
    return mask


def shaped_reward(
    target: NDArray[np.bool_],
    accepting: NDArray[np.bool_],
    error: NDArray[np.bool_],
    rho: NDArray[np.float64],
    *,
    gamma: float,
    shaping: Shaping,
) -> NDArray[np.float64]:
    """Rewards of all pairs (q, q'), float64 [Q, Q], before reward scaling.

    ``paper``: r + gamma rho(q') - rho(q) for q' in Q_target(q), else 0. ``potential``: that difference on every step,
    with rho = 0 on F and E, plus r. ``subtask``: 10 for a target, 100 if it accepts.
    """
    accepts = np.broadcast_to(accepting[None, :], target.shape)
    environment_reward = np.where(accepts & ~np.eye(len(rho), dtype=np.bool_), ACCEPTANCE_REWARD, 0.0)
    if shaping == "subtask":
        return np.where(target, np.where(accepts, ACCEPTANCE_REWARD, TARGET_REWARD), 0.0)
    if shaping == "potential":
        kept = np.where(accepting | error, 0.0, rho)
        return environment_reward + gamma * kept[None, :] - kept[:, None]
    return np.where(target, environment_reward + gamma * rho[None, :] - rho[:, None], 0.0)
