"""Critic copies that other threads can query during training.

A learner answers its peers from one; a peer may hold one as a replica.
"""

from __future__ import annotations

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.normalisation import Normalisation
from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.value_request import read_value_request
from t4nmtd_dist.agents.weights import Arrays, Weights, check_finite


class Critic(Protocol):
    """Evaluates product states on the CPU; owned by one ``PublishedCritic``."""

    def values(self, states: NDArray[np.float32]) -> Values:
        """Bootstrap values at product states [k, d + |Q|], float32 [k] or [k, 2]."""

    def weights(self) -> Weights:
        """Copies of the weights behind ``values``."""

    def load(self, weights: Arrays) -> None:
        """Load arrays from ``weights``.

        Raises:
            PolicyError: if names or shapes differ.
        """


class PublishedCritic:
    """``PublishedValues`` of one critic and its observation statistics, both owned by this object.

    Args:
        critic: the copy.
        normalisation: its statistics.
        dfa_states: |Q|.
    """

    def __init__(self, critic: Critic, normalisation: Normalisation, dfa_states: int) -> None:
        self._critic, self._normalisation, self._dfa_states = critic, normalisation, dfa_states
        self._version = 0
        self._lock = threading.Lock()

    @classmethod
    def of(cls, critic: Critic, context: AgentContext) -> PublishedCritic:
        """A copy for the sub-task of ``context``."""
        return cls(critic, context.normalisation(), context.dfa_states)

    def weights(self) -> tuple[Weights, int]:
        """Weights, observation statistics included, and their version."""
        with self._lock:
            return self._critic.weights() | self._normalisation.weights(), self._version

    def load(self, weights: Arrays, version: int) -> None:
        """Load another copy's ``weights``.

        Raises:
            PolicyError: if names or shapes differ; discard the copy then.
            ProtocolError: if they are not finite.
        """
        check_finite(weights)
        self.update(weights, version)

    def update(self, weights: Arrays, version: int) -> None:
        """``load`` without the check for finite values, for weights from this process."""
        with self._lock:
            self._critic.load(self._normalisation.load(weights))
            self._version = version

    def values(self, arrays: Arrays) -> tuple[Values, int]:
        """Values for a value request (``observation`` [k, d], ``q`` [k]), and their version.

        Raises:
            ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
        """
        observations, q = read_value_request(arrays, self._normalisation.size, self._dfa_states)
        with self._lock:
            states = product_states(self._normalisation.apply(observations), q, self._dfa_states)
            return self._critic.values(states), self._version
