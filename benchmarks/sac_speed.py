"""Gradient updates per second of our SAC against Stable-Baselines3's, same networks and batch, one thread each.

An update includes sampling, critics, actor, entropy coefficient and target networks. Ours samples like a learner with
default settings: half from a peer's experience, shares from before successes and in random DFA states, n-step returns,
and rows with a peer's value; querying these values is excluded. The two take turns, so that load slows both alike. CPU
time counts; wall time is shown. The peak share compares the update's minimum arithmetic with square sgemm products.
Run ``python benchmarks/sac_speed.py [--json]``; it needs Stable-Baselines3 (the ``test`` extra).
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"  # these before numpy and torch are imported
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import dataclasses
import itertools
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger

from t4nmtd_dist.agents.common.batch_source import BatchSource
from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.relabelling import ExperienceReader
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.sac.config import SACConfig
from t4nmtd_dist.agents.sac.fast_cpu.matmul import multiply
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.updater import PeerSoftValues, SACSettings
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.tasks import load_task

OBSERVATION, ACTIONS, HIDDEN, BATCH = 76, 2, (256, 256), 256
TASK, PID = "task6", "g1"  # its automaton is read, its environment is not opened
STORED, WORLDS, ATTEMPT, CHANGES, SUCCESS = 20_000, 4, 50, 0.05, 0.5
PEAK_SIDE = 256


class Spaces(gymnasium.Env):
    """Gives Stable-Baselines3 the sizes; never stepped."""

    observation_space = gymnasium.spaces.Box(-1, 1, (OBSERVATION,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (ACTIONS,), np.float32)


@dataclass
class Timed:
    """Work of a turn: repetitions per turn, and seconds per repetition in each turn."""

    work: Callable[[], object]
    repeats: int
    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)

    def take_turn(self) -> None:
        """Run and time the work."""
        cpu, wall = time.process_time(), time.perf_counter()
        for _ in range(self.repeats):
            self.work()
        self.cpu.append((time.process_time() - cpu) / self.repeats)
        self.wall.append((time.perf_counter() - wall) / self.repeats)


class Sampling:
    """Draws batches like a learner with successes, from random experience of its own and one peer."""

    def __init__(self) -> None:
        task = compile_task(load_task(TASK))
        learner, states, pids = task.config.learner, task.dfa.states, task.decomposition.pids
        method = task.method()
        method.load((q, pid, 1.0) for q in range(states) for pid in task.decomposition.available(q))
        self._rng = np.random.default_rng(0)
        own, peers = (self._filled(task, method.reads(PID).q) for _ in range(2))
        sac = dataclasses.replace(SACConfig(), batch=BATCH)
        reader = ExperienceReader(
            method.role(PID).tables, task.dfa.delta, learner.gamma, learner.reward_scale, sac.n_step
        )
        self._source = BatchSource(PID, own, reader, sac, method, self._rng)
        self._source.others = {next(pid for pid in pids if pid != PID): peers}

    def _filled(self, task: CompiledTask, readable: NDArray[np.int32]) -> ReplayBuffer:
        """A buffer whose observations leave 76 inputs for the networks; attempts have 50 steps, half succeed."""
        rng, width, symbols = self._rng, OBSERVATION - task.dfa.states, task.dfa.delta.shape[1]
        experience = ReplayBuffer(STORED // WORLDS, WORLDS, width, ACTIONS)
        for step in range(STORED // WORLDS):
            ended = np.full(WORLDS, step % ATTEMPT == ATTEMPT - 1)
            experience.add(
                rng.standard_normal((WORLDS, width), np.float32),
                rng.choice(readable, WORLDS).astype(np.int32),
                rng.uniform(-1, 1, (WORLDS, ACTIONS)).astype(np.float32),
                np.where(rng.random(WORLDS) < CHANGES, rng.integers(symbols, size=WORLDS), 0),
                rng.standard_normal((WORLDS, width), np.float32),
                np.zeros(WORLDS, np.bool_),
                ended,
                ended & (rng.random(WORLDS) < 0.5),
            )
        return experience

    def draw(self) -> tuple[Batch, PeerSoftValues]:
        """A batch, and peers' values for the rows that use them."""
        drawn = self._source.draw(0, SUCCESS)
        values, log_probs = self._rng.standard_normal((2, len(drawn.asked_rows)), np.float32)
        return drawn.tensors(), PeerSoftValues(drawn.asked_rows, values, log_probs)


def our_update(*, layer_norm: bool, actor_every: int = 1) -> Callable[[], object]:
    settings = SACSettings(hidden=HIDDEN, layer_norm=layer_norm, actor_every=actor_every)
    updater = SACUpdater(OBSERVATION, ACTIONS, settings, seed=0)
    sampling = Sampling()
    return lambda: updater.update(*sampling.draw())


def their_updates(count: int) -> Callable[[], object]:
    """``count`` updates in one call of ``train``, as in their learning loop."""
    policy = {"net_arch": list(HIDDEN)}
    sac = SAC("MlpPolicy", Spaces(), buffer_size=STORED, batch_size=BATCH, policy_kwargs=policy, device="cpu", seed=0)
    sac.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    for _ in range(STORED):
        observation, next_observation = rng.standard_normal((2, OBSERVATION), np.float32)
        action = rng.uniform(-1, 1, ACTIONS).astype(np.float32)
        sac.replay_buffer.add(observation, next_observation, action, rng.standard_normal(1), np.zeros(1), [{}])
    return lambda: sac.train(count, BATCH)


def square_product() -> Callable[[], object]:
    a, b, out = (torch.randn(PEAK_SIDE, PEAK_SIDE) for _ in range(3))
    return lambda: multiply(a, b, out)


def update_gflop() -> float:
    """Minimum matrix products of one update, in GFLOP."""
    first, hidden = HIDDEN[0], sum(a * b for a, b in itertools.pairwise(HIDDEN))
    actor_in, critic_in = OBSERVATION * first, (OBSERVATION + ACTIONS) * first
    forward = 2 * (actor_in + hidden) + 3 * 2 * (critic_in + hidden)  # actor in s and s'; targets; critics twice
    backward = 2 * (critic_in + 2 * hidden) + hidden + actor_in + 2 * hidden  # critics; through one critic; actor
    return 2e-9 * BATCH * (forward + backward)


def measure(turns: int, updates: int) -> dict[str, Timed]:
    timed = {
        "ours": Timed(our_update(layer_norm=False), updates),
        "ours, layer norm": Timed(our_update(layer_norm=True), updates),
        "ours, layer norm, actor every 2nd": Timed(our_update(layer_norm=True, actor_every=2), updates),
        "Stable-Baselines3": Timed(their_updates(updates), 1),
        "sgemm": Timed(square_product(), 20 * updates),
    }
    with torch.no_grad():
        timed["sgemm"].work()
    for _ in range(turns + 1):
        for each in timed.values():
            each.take_turn()
    for each in timed.values():
        per_run = updates if each is timed["Stable-Baselines3"] else 1
        each.cpu, each.wall = ([seconds / per_run for seconds in taken[1:]] for taken in (each.cpu, each.wall))
    return timed


def table(timed: dict[str, Timed], peak: float) -> str:
    theirs = timed["Stable-Baselines3"]
    lines = [f"{'fp32, batch 256, networks 256-256':<36}{'updates/s':>10}{'ms cpu':>9}{'ms wall':>9}{'times SB3':>11}"]
    for name, each in timed.items():
        if name == "sgemm":
            continue
        cpu, wall = statistics.median(each.cpu), statistics.median(each.wall)
        ratio = ratio_of(theirs, each)
        lines.append(f"{name:<36}{1 / cpu:>10.1f}{1e3 * cpu:>9.2f}{1e3 * wall:>9.2f}{ratio:>11.2f}")
    share = peak_share(timed, peak)
    lines.append(f"sgemm {PEAK_SIDE}x{PEAK_SIDE}: {peak:.1f} GFLOP/s; our update reaches {share:.0%} of it")
    return "\n".join(lines)


def ratio_of(theirs: Timed, ours: Timed) -> float:
    """Median over the turns of their CPU time divided by ours."""
    return statistics.median(their / our for their, our in zip(theirs.cpu, ours.cpu, strict=True))


def peak_share(timed: dict[str, Timed], peak: float) -> float:
    return update_gflop() / statistics.median(timed["ours"].cpu) / peak


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--turns", type=int, default=25, help="turns of each side")
    parser.add_argument("--updates", type=int, default=10, help="updates of a turn")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    timed = measure(arguments.turns, arguments.updates)
    peak = 2e-9 * PEAK_SIDE**3 / statistics.median(timed["sgemm"].cpu)
    if not arguments.json:
        print(table(timed, peak))
        return
    theirs = timed["Stable-Baselines3"]
    result = {
        "ratio_bf16": None,
        "ratio_fp32": round(ratio_of(theirs, timed["ours"]), 2),
        "peak_share": round(peak_share(timed, peak), 3),
        "ratio_fp32_layer_norm": round(ratio_of(theirs, timed["ours, layer norm"]), 2),
        "updates_s": round(1 / statistics.median(timed["ours"].cpu), 1),
        "sgemm_gflops": round(peak, 1),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
