"""Selects whose value a learner bootstraps from after a handover (paper, Algorithm 2, line 12)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.peer_values import RowNumbers
from t4nmtd_dist.method.protocol import Mask, Method, States


@dataclass(frozen=True)
class Successors:
    """Rows across a boundary that do not bootstrap from the own critic.

    Attributes:
        rows: rows that bootstrap from a peer [k].
        pids: that peer, for each row [k].
        without_value: rows that bootstrap from 0 [m].
    """

    rows: RowNumbers
    pids: tuple[str, ...]
    without_value: NDArray[np.int64]


def draw_successors(method: Method, role: str, boundary: Mask, q_next: States, rng: np.random.Generator) -> Successors:
    """Ask the method for the successor of each row that crosses a boundary.

    Args:
        method: decides.
        role: owner of the rows.
        boundary: rows on which the DFA moved to a state outside F and E [B].
        q_next: that state [B].
        rng: random generator.
    """
    rows = np.flatnonzero(boundary)
    named = dict(zip(rows.tolist(), method.successors(role, q_next[rows], rng), strict=True))
    asked = {row: pid for row, pid in named.items() if pid is not None and pid != role}
    without = [row for row, pid in named.items() if pid is None]
    return Successors(np.array(list(asked), np.int64), tuple(asked.values()), np.array(without, np.int64))
