"""Steps per second of the four environments on one core, against their peers in the same run.

Peers: pyRDDLGym's IPPC 2023 RaceCar (first instance) and gymnasium's HalfCheetah-v5, both without wrappers, like ours.
Actions are random; times include resets, observations and labels. They are CPU time on one core and thread, and rows
take turns, so that load disturbs the results less. Run ``python benchmarks/env_speed.py [--json]`` after
``pip install '.[bench]'``; a missing peer's result is null.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from lake_speed import our_batch

import envs

Run = Callable[[], int]  # takes some steps and returns their number

LAKE = "lake, batch of 64"
WATER_BATCH = 64
WATER = f"waterworld, 18 balls, batch of {WATER_BATCH}"
CAR = "racecar, single"
RDDL = "pyRDDLGym RaceCar_ippc2023, single"
CHEETAH = "halfcheetah, single"
CHEETAH_SNAPSHOTS = "halfcheetah, a snapshot at every step"
GYMNASIUM = "gymnasium HalfCheetah-v5, single"
PEERS = {WATER: None, CAR: RDDL, CHEETAH: GYMNASIUM, CHEETAH_SNAPSHOTS: GYMNASIUM, LAKE: None}


def single(env: Any, steps: int, horizon: int, snapshots: bool = False) -> Run:
    """Random steps of one environment, reset every ``horizon`` steps."""
    space = env.action_space
    actions = np.random.default_rng(0).uniform(space.low, space.high, (steps, *space.shape))
    actions = actions.astype(np.float32)
    env.reset(seed=0)

    def run() -> int:
        for number, action in enumerate(actions):
            env.step(action)
            if snapshots:
                env.get_state()
            if number % horizon == horizon - 1:
                env.reset()
        return steps

    return run


def water_batch(count: int, colours: int, steps: int) -> Run:
    """Random steps of N Waterworlds, reset every 300 steps."""
    batch = gymnasium.make_vec("t4nmtd/Waterworld-v0", count, vectorization_mode="vector_entry_point", colours=colours)
    actions = np.random.default_rng(0).uniform(-3.5, 3.5, (steps // count, count, 2)).astype(np.float32)
    batch.reset(seed=0)

    def run() -> int:
        for number, row in enumerate(actions):
            batch.step(row)
            if number % 300 == 299:
                batch.reset()
        return actions.shape[0] * count

    return run


def rddl_racecar(steps: int) -> Run | None:
    """The peer of Racecar; None if not installed."""
    try:
        import pyRDDLGym
    except ImportError:
        return None
    with contextlib.redirect_stdout(None):
        env = pyRDDLGym.make("RaceCar_ippc2023", "1")
    forces = np.random.default_rng(0).uniform(-1, 1, (steps, 2)).tolist()
    env.reset(seed=0)

    def run() -> int:
        for fx, fy in forces:
            _, _, terminated, truncated, _ = env.step({"fx": fx, "fy": fy})
            if terminated or truncated:
                env.reset()
        return steps

    return run


def gymnasium_cheetah(steps: int) -> Run | None:
    """The peer of HalfCheetah; None if gymnasium's MuJoCo environments are not installed."""
    # MuJoCo 4 logs a deprecation in the model file into the current folder.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            env = gymnasium.make("HalfCheetah-v5", exclude_current_positions_from_observation=False)
        except ImportError:
            return None
    return single(env.unwrapped, steps, 1000)


def rows() -> dict[str, Run]:
    """All measurements by name."""
    made: dict[str, Run | None] = {
        WATER: water_batch(WATER_BATCH, 6, 6400),
        "waterworld, 18 balls, batch of 16": water_batch(16, 6, 3200),
        "waterworld, 24 balls, batch of 64": water_batch(64, 8, 6400),
        "waterworld, 18 balls, single": single(our("Waterworld"), 1000, 300),
        CAR: single(our("Racecar"), 4000, 500),
        RDDL: rddl_racecar(200),
        CHEETAH: single(our("HalfCheetah"), 1500, 1000),
        CHEETAH_SNAPSHOTS: single(our("HalfCheetah"), 1500, 1000, snapshots=True),
        GYMNASIUM: gymnasium_cheetah(1500),
        LAKE: our_batch("features"),
    }
    return {name: run for name, run in made.items() if run is not None}


def our(env: str) -> Any:
    return gymnasium.make(f"t4nmtd/{env}-v0").unwrapped


def measure(runs: dict[str, Run], repeats: int) -> list[dict[str, float]]:
    """Steps per second of every row in each round, without a first warm-up round."""
    rounds = []
    for _ in range(repeats + 1):
        speeds = {}
        for name, run in runs.items():
            start = time.process_time()
            steps = run()
            speeds[name] = steps / (time.process_time() - start)
        rounds.append(speeds)
    return rounds[1:]


def ratio(rounds: list[dict[str, float]], ours: str, peer: str) -> float | None:
    """Median of the per-round ratios, because load slows both rows."""
    if peer not in rounds[0]:
        return None
    return statistics.median(speeds[ours] / speeds[peer] for speeds in rounds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--repeats", type=int, default=9)
    arguments = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    envs.register_environments()
    rounds = measure(rows(), arguments.repeats)
    medians = {name: statistics.median(speeds[name] for speeds in rounds) for name in rounds[0]}
    if arguments.json:
        figures = {
            "racecar_vs_pyrddlgym": ratio(rounds, CAR, RDDL),
            "waterworld_steps_s": medians[WATER],
            "halfcheetah_vs_gymnasium": ratio(rounds, CHEETAH, GYMNASIUM),
            "lake_steps_s": medians[LAKE],
        }
        print(json.dumps({key: None if value is None else round(value, 2) for key, value in figures.items()}))
        return
    print(f"{'steps per CPU second, observations and labels included':<58}{'median':>10}   times its peer")
    for name, value in medians.items():
        times = ratio(rounds, name, PEERS.get(name) or "")
        print(f"{name:<58}{value:>10,.0f}" + (f"{times:>17.2f}" if times else ""))


if __name__ == "__main__":
    main()
