"""Policy intervention in a run: what it does to critics, whichever way the values come."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sac import AT_G1, small_sac_task
from small_sac import START as START_OF_TRACK
from small_tasks import START as START_OF_LAKE
from small_tasks import TO_PASSENGER_2, small_task, snapshot_after

from coordinator.state import RunSettings
from t4nmtd_dist.launch.serial import SerialRun


def critics_after(algorithm: str, mode: str) -> dict[str, NDArray[np.float32]]:
    """Critic parameters after some serial rounds of a learner that often begins beside its target."""
    if algorithm == "ppo":
        beside_2 = snapshot_after(*TO_PASSENGER_2)
        make, pid, start, rounds = small_task, "p2", (START_OF_LAKE, beside_2), 2
    else:
        make, pid, start, rounds = small_sac_task, "g1", (START_OF_TRACK, AT_G1), 5
    task = make(f"learner.intervention={mode}", "learner.attempt_steps=6")
    run = SerialRun(task, RunSettings(seed=0, max_interactions=10**9), lambda: 0.0)
    session = run.sessions[pid]
    session.buffer.add(*start)
    for _ in range(rounds):
        run.round()
    assert (session._stats().intervention.asked > 0) == (mode != "off")
    return {name: array for name, array in session.learner.weights().items() if name.startswith("critic")}


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_intervention_changes_the_critic_and_only_that_way_of_bootstrapping(algorithm: str) -> None:
    on, off = critics_after(algorithm, "query"), critics_after(algorithm, "off")
    assert on
    for mode in ("local", "replica"):
        again = critics_after(algorithm, mode)
        assert all(np.array_equal(on[name], again[name]) for name in on)
    assert any(not np.array_equal(on[name], off[name]) for name in on)
