"""Validates the product states of a peer's value request."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.core.errors import ProtocolError
from t4nmtd_dist.environments.batched import Observations


def read_value_request(
    arrays: Mapping[str, NDArray[Any]], observation_size: int, dfa_states: int
) -> tuple[Observations, NDArray[Any]]:
    """Observations float32 [k, d] and DFA states, integers [k], of a value request.

    Raises:
        ProtocolError: if ``observation`` is not finite float32 [k, d] or ``q`` not [k] states of the DFA.
    """
    observations, q = arrays.get("observation"), arrays.get("q")
    if observations is None or q is None or q.ndim != 1 or observations.shape != (len(q), observation_size):
        raise ProtocolError(f"a value request needs observation [k, {observation_size}] and q [k]")
    if observations.dtype != np.float32 or not np.isfinite(observations).all():
        raise ProtocolError("a value request needs observations that are finite numbers in float32")
    if q.dtype.kind != "i" or not ((q >= 0) & (q < dfa_states)).all():
        raise ProtocolError(f"a value request names a DFA state outside 0..{dfa_states - 1}")
    return observations, q
