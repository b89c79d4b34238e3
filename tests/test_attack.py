"""A training under attack: it ends solved, and no process grows."""

from __future__ import annotations

import functools
import re
import time
from pathlib import Path

import attacks
import psutil
import pytest
from processes import Processes, endpoints, events, processes_of

from t4nmtd_dist.wire.messages import DashboardState
from t4nmtd_dist.wire.status_client import ask_status
from t4nmtd_dist.wire.zmq_types import new_context

MALFORMED = 100_000
SOLVE_S = 240.0
SETTLE_S = 10.0
GROWTH = 1.2
SHARES = {"control": 0.6, "critics": 0.3, "state": 0.1}


def busy(state: DashboardState) -> bool:
    return all(row.worker and row.version > 3 for row in state.learners)


def names(run: Path) -> dict[int, str]:
    """What every process of the run is called, by its number."""
    found = {}
    for number, command in processes_of(run).items():
        if "--instance" in command:
            found[number] = command[command.index("--instance") + 1]
        else:
            found[number] = "coordinator" if "coordinator" in command else "launcher"
    return found


def critics(run: Path) -> list[str]:
    context = new_context()
    try:
        return sorted(ask_status(context, endpoints(run)[0], None, 20.0).critics.values())
    finally:
        context.destroy(linger=0)


def attack(run: Path, count: int) -> int:
    """Everything at once, from several connections; how many malformed messages were sent."""
    control, state = endpoints(run)
    asked = critics(run)
    sent: list[int] = []

    def malformed(endpoint: str, share: float, seed: int) -> None:
        sent.append(attacks.malformed_messages(endpoint, round(count * share), seed))

    streams = [functools.partial(malformed, control, SHARES["control"] / 4, seed) for seed in range(4)]
    streams += [functools.partial(malformed, each, SHARES["critics"] / len(asked), 9) for each in asked]
    streams += [functools.partial(malformed, state, SHARES["state"], 10)]
    floods = [
        functools.partial(attacks.subscriptions, state),
        *[functools.partial(attacks.endless_multipart, each) for each in (control, asked[0])],
        *[functools.partial(attacks.empty_frames, each) for each in (control, asked[0])],
        functools.partial(attacks.unread_answers, control),
        functools.partial(attacks.many_connections, control, 100),
    ]
    attacks.together(*streams, *floods)
    return sum(sent)


@pytest.mark.training
@pytest.mark.timeout(400)
def test_a_training_under_attack_is_solved_and_no_process_grows(processes: Processes) -> None:
    run = processes.folder / "run"
    settings = ["--set", "evaluation.in_a_row=3", "--set", "evaluation.every=200000"]
    command = ["train", "--task", "task7", "--seed", "8", "--run-dir", str(run), "--no-dashboard", *settings]
    launcher = processes.start("t4nmtd", *command)
    processes.until(lambda: (run / "endpoints.json").exists(), "the coordinator listens")
    processes.until_state(run, busy, "every sub-task is learned")
    numbers = names(run)
    watch = attacks.MemoryWatch(list(numbers))
    began = time.monotonic()
    assert attack(run, MALFORMED) >= MALFORMED - 20
    print(f"attack took {time.monotonic() - began:.1f} s")
    time.sleep(SETTLE_S)
    watch.close()
    after = watch.now()
    for number, name in numbers.items():
        before, now, peak = watch.before[number], after.get(number, 0), watch.peak[number]
        print(f"{name}: {before >> 20} MiB before, at most {peak >> 20} MiB, {now >> 20} MiB afterwards")
    assert launcher.wait(SOLVE_S) == 0, launcher.story()
    assert {numbers[number]: after[number] / watch.before[number] for number in after} == {
        numbers[number]: pytest.approx(1.0, abs=GROWTH - 1.0) for number in numbers
    }
    assert not [text for text in events(run) if re.search(r"unexpected|lost", text)], events(run)
    assert not any(psutil.pid_exists(number) for number in numbers)
