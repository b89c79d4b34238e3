"""Questions to a critic that do not follow the protocol, whatever the algorithm behind it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sac import small_sac
from small_tasks import small_learner

from t4nmtd_dist.agents.common.value_request import read_value_request
from t4nmtd_dist.agents.protocol import PublishedValues
from t4nmtd_dist.core.errors import ProtocolError

SIZES = {"ppo": 83, "sac": 23}  # of an observation
STATES = 6


def published(algorithm: str) -> PublishedValues:
    return small_learner("p2").published if algorithm == "ppo" else small_sac("g1").published


def question(size: int, **changed: NDArray[Any] | None) -> dict[str, NDArray[Any]]:
    """Two product states, with some arrays replaced (None: left out)."""
    arrays = {"observation": np.zeros((2, size), np.float32), "q": np.array([0, STATES - 1], np.int32), **changed}
    return {name: array for name, array in arrays.items() if array is not None}


def malformed(size: int) -> dict[str, tuple[str, dict[str, NDArray[Any]]]]:
    nan, far = np.zeros((2, size), np.float32), np.zeros((2, size), np.float32)
    nan[1, 0], far[0, 0] = np.nan, np.inf
    return {
        "no q": ("needs observation", question(size, q=None)),
        "no observation": ("needs observation", question(size, observation=None)),
        "q of no dimension": ("needs observation", question(size, q=np.array(0, np.int32))),
        "narrow": ("needs observation", question(size, observation=np.zeros((2, size - 1), np.float32))),
        "too many q": ("needs observation", question(size, q=np.zeros(3, np.int32))),
        "float64": ("finite numbers in float32", question(size, observation=np.zeros((2, size)))),
        "not a number": ("finite numbers in float32", question(size, observation=nan)),
        "infinite": ("finite numbers in float32", question(size, observation=far)),
        "negative q": ("outside 0..5", question(size, q=np.array([0, -1], np.int32))),
        "q beyond the last": ("outside 0..5", question(size, q=np.array([0, STATES], np.int32))),
        "q of floats": ("outside 0..5", question(size, q=np.zeros(2, np.float32))),
    }


@pytest.mark.parametrize("fault", malformed(1))
@pytest.mark.parametrize("algorithm", SIZES)
def test_a_malformed_question_is_refused_by_every_critic(algorithm: str, fault: str) -> None:
    text, arrays = malformed(SIZES[algorithm])[fault]
    with pytest.raises(ProtocolError, match=text):
        published(algorithm).values(arrays)


@pytest.mark.parametrize("algorithm", SIZES)
def test_a_good_question_is_answered(algorithm: str) -> None:
    values, _ = published(algorithm).values(question(SIZES[algorithm]))
    assert len(values) == 2


def test_what_is_read_is_what_was_asked() -> None:
    asked = question(4)
    observations, q = read_value_request(asked, 4, STATES)
    assert observations is asked["observation"]
    assert q is asked["q"]
