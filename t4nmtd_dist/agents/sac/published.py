"""A copy of a SAC learner: other threads may ask it for soft values while the original is trained.

A learner answers its peers from one, and a peer may hold one as a replica.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.networks import product_state
from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.common.value_request import read_value_request
from t4nmtd_dist.agents.sac.interface import SoftActorCritic
from t4nmtd_dist.agents.weights import Weights, check_finite, part_of

NO_STATISTICS: Mapping[str, NDArray[Any]] = {}


class PublishedSoftCritic:
    """Answers with (min of the target critics, log pi) of the actor's action.

    Args:
        copy: an updater of the same shape, owned by this object.
        observation_size: d.
        dfa_states: |Q|.
        normalisation: statistics of its own, to load others into.
    """

    def __init__(
        self, copy: SoftActorCritic, observation_size: int, dfa_states: int, normalisation: Normalisation
    ) -> None:
        self._copy, self._normalisation = copy, normalisation
        self._observation_size, self._dfa_states = observation_size, dfa_states
        self._version = 0
        self._lock = threading.Lock()

    def update(
        self, updater: SoftActorCritic, version: int, statistics: Mapping[str, NDArray[Any]] = NO_STATISTICS
    ) -> None:
        """Copy newer parameters, and statistics of observations."""
        weights = updater.weights()
        with self._lock:
            self._normalisation.load(statistics)
            self._copy.load(weights)
            self._version = version

    def weights(self) -> tuple[Weights, int]:
        """What answers are computed from, and its version: ``actor.*``, ``targets.*``, statistics of observations."""
        with self._lock:
            weights, statistics, version = self._copy.weights(), self._normalisation.weights(), self._version
        answering = {name: array for name, array in weights.items() if name.startswith(("actor.", "targets."))}
        return answering | statistics, version

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
            own = self._normalisation.load(copied)
            self._copy.load({**own, **unused, "log_alpha": np.zeros(1, np.float32)})
            self._version = version

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Soft values float32 [k, 2] of the product states in a value request, and the copy's version.

        Raises:
            ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
        """
        observations, q = read_value_request(arrays, self._observation_size, self._dfa_states)
        with self._lock:
            states = product_state(self._normalisation.apply(observations), q, self._dfa_states).numpy()
            values, log_probs = self._copy.soft_values(states)
            return np.stack([values, log_probs], axis=1), self._version
