"""Policy intervention in a serial run, where peers are in the same process, whichever way is set."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from small_sac import AT_G1, small_sac_task
from small_sac import START as START_OF_TRACK
from small_tasks import START as START_OF_LAKE
from small_tasks import TO_PASSENGER_2, small_task, snapshot_after

from coordinator.run_settings import RunSettings
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
    assert (session._all_counts().intervention.asked > 0) == (mode != "off")
    return {name: array for name, array in session.learner.weights().items() if name.startswith("critic")}


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_peers_values_change_the_critic(algorithm: str) -> None:
    on, off = critics_after(algorithm, "query"), critics_after(algorithm, "off")
    assert any(not np.array_equal(on[name], off[name]) for name in on)


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
@pytest.mark.parametrize("way", ["local", "replica"])
def test_a_serial_run_needs_no_wire_whatever_way_is_set(algorithm: str, way: str) -> None:
    """How the ways compare between processes is told in ``test_intervention.py``."""
    one, another = critics_after(algorithm, "query"), critics_after(algorithm, way)
    assert all(np.array_equal(one[name], another[name]) for name in one)
