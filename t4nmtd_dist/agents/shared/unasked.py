"""The published critic of a learner without peers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from t4nmtd_dist.agents.common.peer_values import Values
from t4nmtd_dist.agents.weights import Weights
from t4nmtd_dist.core.errors import ProtocolError


class UnaskedCritic:
    """``PublishedValues`` that refuses every query."""

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Refuse.

        Raises:
            ProtocolError: always.
        """
        raise ProtocolError("one learner holds all policies of this run; it expects no value queries")

    def weights(self) -> tuple[Weights, int]:
        """None."""
        return {}, 0

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Ignore them."""
