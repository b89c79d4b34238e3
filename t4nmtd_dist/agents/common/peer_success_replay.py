"""Rows of a peer's replay in which the own sub-task would have succeeded (docs/decisions/016)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.replay_buffer import Flags, Indices, ReplayBuffer
from t4nmtd_dist.method.rewards import SubtaskTables


def target_symbols(tables: SubtaskTables, delta: NDArray[np.int32]) -> Flags:
    """Symbols that lead some DFA state to a target, bool [L]; ``delta`` is int32 [Q, L]."""
    hits: Flags = tables.target[np.arange(len(delta))[:, None], delta]
    found: Flags = np.logical_or.reduce(hits, axis=0)
    return found


class PeerSuccesses:
    """Rows of one peer's replay buffer up to and including a step that reads a target symbol.

    They depend only on the buffer's current content, so a resumed run draws the same rows.

    Args:
        symbols: target symbols, bool [L].
    """

    def __init__(self, symbols: Flags) -> None:
        self._symbols = symbols
        self._leads: Flags = np.zeros(0, np.bool_)
        self._seen = 0
        self._rows: Indices = np.zeros(0, np.int64)

    def rows(self, experience: ReplayBuffer) -> Indices:
        """The row numbers [k], ascending. Every call must pass the same buffer."""
        if not len(self._leads):
            self._leads = np.zeros(len(experience.symbols), np.bool_)
        first = max(self._seen, experience.written - experience.steps)
        if first < experience.written:
            new = experience.rows_of(first, experience.written - first)
            self._leads[new] = False
            for step, copy in np.argwhere(self._symbols[experience.symbols[new]]).tolist():
                self._leads[experience.leading_to(first + step, copy)] = True
            self._seen, self._rows = experience.written, np.flatnonzero(self._leads)
        return self._rows
