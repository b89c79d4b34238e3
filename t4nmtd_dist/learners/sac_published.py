"""A copy of a SAC learner: other threads may ask it for soft values while the original is trained.

A learner answers its peers from one, and a peer may hold one as a replica.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.learners.networks import Weights, check_finite, part_of, product_state
from t4nmtd_dist.learners.peers import Values
from t4nmtd_dist.learners.sac_interface import SoftActorCritic
from t4nmtd_dist.learners.value_request import read_value_request


class PublishedSoftCritic:
    """Answers with (min of the target critics, log pi) of the actor's action.

    Args:
        copy: an updater of the same shape, owned by this object.
        observation_size: d.
        dfa_states: |Q|.
    """

    def __init__(self, copy: SoftActorCritic, observation_size: int, dfa_states: int) -> None:
        self._copy = copy
        self._observation_size, self._dfa_states = observation_size, dfa_states
        self._version = 0
        self._lock = threading.Lock()

    def update(self, updater: SoftActorCritic, version: int) -> None:
        """Copy newer parameters."""
        weights = updater.weights()
        with self._lock:
            self._copy.load(weights)
            self._version = version

    def weights(self) -> tuple[Weights, int]:
        """What answers are computed from, ``actor.*`` and ``targets.*``, and its version."""
        with self._lock:
            weights, version = self._copy.weights(), self._version
        return {name: array for name, array in weights.items() if name.startswith(("actor.", "targets."))}, version

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Answer from the ``weights`` of another copy from now on.

        Raises:
            PolicyError: if names or shapes differ; the copy is of no use then.
            ProtocolError: if they are not finite.
        """
        check_finite(weights)
        copied = {name: np.array(array) for name, array in weights.items()}  # torch wants to be able to write
        unused = {f"critics.{name}": array for name, array in part_of(copied, "targets").items()}
        unused |= {f"average.{name}": array for name, array in part_of(copied, "actor").items()}
        with self._lock:
            self._copy.load({**copied, **unused, "log_alpha": np.zeros(1, np.float32)})
            self._version = version

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Soft values float32 [k, 2] of the product states in a value request, and the copy's version.

        Raises:
            ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
        """
        observations, q = read_value_request(arrays, self._observation_size, self._dfa_states)
        states = product_state(observations, q, self._dfa_states).numpy()
        with self._lock:
            values, log_probs = self._copy.soft_values(states)
            return np.stack([values, log_probs], axis=1), self._version
