"""Attempts of a policy as it is: without exploration, and without learning from them."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.product_states import product_states
from t4nmtd_dist.agents.common.rollout import Rollout


class GreedyActor(Protocol):
    """``agents.protocol.Actor``, as far as it is needed here."""

    def act(self, states: NDArray[np.float32]) -> NDArray[Any]:
        """The most likely actions of product states [N, d + |Q|]."""


def rehearse(rollout: Rollout, actor: GreedyActor, dfa_states: int) -> bool:
    """One whole attempt of every copy from a new start; False while there is no start state."""
    return rollout.attempt_once(lambda: actor.act(product_states(rollout.observations, rollout.q, dfa_states)))
