"""Checks weights and start states received from learners."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coordinator.learner_registry import LearnerRecord
from t4nmtd_dist.agents.weight_checks import NetworkSizes, check_weights, sizes_of
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.method.compiled import CompiledTask

MOST_VERSIONS_AT_ONCE = 2**40  # a version near the maximum would block all later ones

Start = tuple[int, NDArray[Any]]


class Intake:
    """Checks weights and start states against the task."""

    def __init__(self, task: CompiledTask) -> None:
        self._config, self._dfa_states = task.config, task.dfa.states
        self._sizes: NetworkSizes | None = None

    def take_weights(
        self, pid: str, weights: Mapping[str, NDArray[Any]], version: int, records: Mapping[str, LearnerRecord]
    ) -> str:
        """Store a learner's newer weights; returns why they are unusable, or ""."""
        record = records[pid]
        if not weights or version <= record.version:
            return ""
        trouble = self.weights_trouble(weights, version, records.values())
        record.unusable = bool(trouble)
        if not trouble:
            record.version, record.weights = version, weights
        return trouble

    def weights_trouble(
        self, weights: Mapping[str, NDArray[Any]], version: int, records: Iterable[LearnerRecord]
    ) -> str:
        """Why weights are unusable, or "".

        The settings do not state the sizes of observations and actions. The first accepted weights do, including those
        in ``records`` of a resumed run.
        """
        records = list(records)
        newest = max(record.version for record in records)
        if version > newest + MOST_VERSIONS_AT_ONCE:
            return f"weights of version {version} are dropped: the newest version known is {newest}"
        try:
            self._sizes = check_weights(weights, self._config, self._dfa_states, self._sizes or self._known(records))
        except PolicyError as error:
            return f"weights of version {version} are dropped, and those known before are kept: {error}"
        return ""

    def _known(self, records: Iterable[LearnerRecord]) -> NetworkSizes | None:
        for record in records:
            with suppress(PolicyError):  # possible in a resumed run
                return sizes_of(record.weights, self._config, self._dfa_states)
        return None


def usable(starts: Iterable[Start]) -> list[Start]:
    """The start states without non-finite numbers."""
    return [(q, state) for q, state in starts if state.dtype.kind != "f" or np.isfinite(state).all()]
