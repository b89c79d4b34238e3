"""Lake steps per second on one core: our batch of 64 against gymnasium FrozenLake-v1 8x8, same run.

Random actions (pick and drop only in ours); the time includes resets. Run
``python benchmarks/lake_speed.py [--json]``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable

import gymnasium
import numpy as np

import envs

BATCH = 64
STEPS = 2000  # per repeat, batches or single steps


def our_batch(observation: str) -> Callable[[], int]:
    batch = gymnasium.make_vec("t4nmtd/FrozenLake-v0", BATCH, goals=2, observation=observation)
    actions = np.random.default_rng(0).integers(0, 6, (STEPS, BATCH))
    batch.reset(seed=0)

    def run() -> int:
        for row in actions:
            terminated = batch.step(row)[2]
            if terminated.any():
                batch.reset(options={"reset_mask": terminated})
        return STEPS * BATCH

    return run


def single(env: gymnasium.Env, actions: int) -> Callable[[], int]:
    numbers = np.random.default_rng(0).integers(0, actions, STEPS).tolist()
    env.reset(seed=0)

    def run() -> int:
        for number in numbers:
            if env.step(number)[2]:
                env.reset()
        return STEPS

    return run


def gymnasium_batch() -> Callable[[], int]:
    batch = gymnasium.make_vec("FrozenLake-v1", BATCH, vectorization_mode="sync", map_name="8x8", is_slippery=False)
    actions = np.random.default_rng(0).integers(0, 4, (STEPS // BATCH, BATCH))
    batch.reset(seed=0)

    def run() -> int:
        for row in actions:
            batch.step(row)
        return len(actions) * BATCH

    return run


def steps_per_second(runs: dict[str, Callable[[], int]], repeats: int) -> dict[str, float]:
    """Medians over the repeats, which alternate so that load slows all alike; the first warms up."""
    speeds: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            steps = run()
            speeds[name].append(steps / (time.perf_counter() - start))
    return {name: statistics.median(measured[1:]) for name, measured in speeds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--repeats", type=int, default=7)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    envs.register_environments()
    peer = gymnasium.make("FrozenLake-v1", map_name="8x8", is_slippery=False)
    rows = {
        f"ours, batch of {BATCH}, features": our_batch("features"),
        f"ours, batch of {BATCH}, raw": our_batch("raw"),
        "ours, single": single(gymnasium.make("t4nmtd/FrozenLake-v0", goals=2), 6),
        "gymnasium FrozenLake-v1, loop": single(peer, 4),
        f"gymnasium FrozenLake-v1, SyncVectorEnv({BATCH})": gymnasium_batch(),
    }
    speed = steps_per_second(rows, arguments.repeats)
    names = list(speed)
    ours, loop, sync = speed[names[0]], speed[names[3]], speed[names[4]]
    if arguments.json:
        result = {
            "lake_steps_s": ours,
            "times_gymnasium_loop": ours / loop,
            "times_gymnasium_sync": ours / sync,
        }
        print(json.dumps({key: round(value, 1) for key, value in result.items()}))
        return
    print(f"{'lake steps/s on one core':<46}{'':>12}   ours (features) is")
    for name, value in speed.items():
        print(f"{name:<46}{value:>12,.0f}{ours / value:>14.1f} times")


if __name__ == "__main__":
    main()
