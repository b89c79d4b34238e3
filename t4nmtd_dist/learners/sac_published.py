"""A copy of a SAC learner that other threads may ask for soft values while the original is trained."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.errors import ProtocolError
from t4nmtd_dist.learners.networks import product_state
from t4nmtd_dist.learners.peers import Values
from t4nmtd_dist.learners.sac_update import SACUpdater


class PublishedSoftCritic:
    """Answers with (min of the target critics, log pi) of the actor's action.

    Args:
        copy: an updater of the same shape, owned by this object.
        observation_size: d.
        dfa_states: |Q|.
    """

    def __init__(self, copy: SACUpdater, observation_size: int, dfa_states: int) -> None:
        self._copy = copy
        self._observation_size, self._dfa_states = observation_size, dfa_states
        self._version = 0
        self._lock = threading.Lock()

    def update(self, updater: SACUpdater, version: int) -> None:
        """Copy newer parameters."""
        weights = updater.weights()
        with self._lock:
            self._copy.load(weights)
            self._version = version

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Soft values float32 [k, 2] of the product states in a value request, and the copy's version.

        Raises:
            ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
        """
        observations, q = arrays.get("observation"), arrays.get("q")
        if observations is None or q is None or q.ndim != 1 or observations.shape != (len(q), self._observation_size):
            raise ProtocolError(f"a value request needs observation [k, {self._observation_size}] and q [k]")
        if observations.dtype != np.float32 or not np.isfinite(observations).all():
            raise ProtocolError("a value request needs observations that are finite numbers in float32")
        if q.dtype.kind != "i" or not ((q >= 0) & (q < self._dfa_states)).all():
            raise ProtocolError(f"a value request names a DFA state outside 0..{self._dfa_states - 1}")
        states = product_state(observations, q, self._dfa_states).numpy()
        with self._lock:
            values, log_probs = self._copy.soft_values(states)
            return np.stack([values, log_probs], axis=1), self._version
