"""A program: a run's processes as data; a launcher decides where and how they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Literal

from t4nmtd_dist.core.devices import Device
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.runs.file_names import file_name
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import RunPlan

RoleKind = Literal["coordinator", "learner", "evaluator"]

COORDINATOR, EVALUATOR = "coordinator", "evaluator"
RESERVED_NAMES = (COORDINATOR, EVALUATOR)
LONGEST_NAME = 100
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class Role:
    """One process of a program.

    Attributes:
        name: unique in its program, and usable as a file name.
        pids: sub-tasks of a learner process.
        environment: additional environment variables.
    """

    kind: RoleKind
    name: str
    pids: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=lambda: dict(ONE_THREAD))


@dataclass(frozen=True)
class Program:
    """One run as data; nothing is started or written.

    Attributes:
        plan: settings, seed, identity and directory of the run.
        task: the compiled task, with a checked environment.
        options: user options, repeated on the coordinator's command line.
        roles: all processes; exactly one is the coordinator.
        keys: folder of keys for encrypted connections, or None.
        device: where learners train.
        dashboard: whether to show the run on this terminal.
    """

    plan: RunPlan
    task: CompiledTask
    options: RunOptions
    roles: tuple[Role, ...]
    keys: Path | None = None
    device: Device = "cpu"
    dashboard: bool = False

    @property
    def directory(self) -> Path:
        """The run directory."""
        return self.plan.directory

    @property
    def coordinator(self) -> Role:
        """The coordinator's role."""
        return next(role for role in self.roles if role.kind == "coordinator")

    @property
    def workers(self) -> tuple[Role, ...]:
        """Learners and evaluators, in starting order."""
        return tuple(role for role in self.roles if role.kind != "coordinator")

    def log(self, role: Role) -> Path:
        """The log file of a role's output."""
        return self.directory / "logs" / f"{role.name}.log"


def make_roles(pids: Sequence[str], workers: int | None = None) -> tuple[Role, ...]:
    """Create a coordinator, learners for all sub-tasks, and an evaluator.

    Args:
        pids: the sub-tasks.
        workers: number of learner processes; None for one per sub-task.

    Raises:
        ConfigError: if ``workers`` is below 1 or above the number of sub-tasks.
    """
    learners = [Role("learner", name, tuple(held)) for name, held in assign_pids(pids, workers).items()]
    return (Role("coordinator", COORDINATOR), *learners, Role("evaluator", EVALUATOR))


def assign_pids(pids: Sequence[str], workers: int | None) -> dict[str, list[str]]:
    """Assign sub-tasks to learner processes round-robin; returns them by process name.

    Args:
        pids: the sub-tasks.
        workers: number of processes; None for one per sub-task.

    Raises:
        ConfigError: if ``workers`` is below 1 or above the number of sub-tasks.
    """
    processes = len(pids) if workers is None else workers
    if not 1 <= processes <= len(pids):
        raise ConfigError(f"--workers {processes}: expected 1 to {len(pids)}, the number of this task's sub-tasks")
    named: dict[str, list[str]] = {}
    for first in range(processes):
        held = list(pids[first::processes])
        named[_name_of(held, named)] = held
    return named


def _name_of(pids: Sequence[str], taken: Mapping[str, object]) -> str:
    """The sub-tasks' names joined, or a numbered name if unusable."""
    joined = "+".join(map(file_name, pids))
    if len(joined) <= LONGEST_NAME and joined not in taken and joined not in RESERVED_NAMES:
        return joined
    return next(name for number in count(len(taken) + 1) if (name := f"worker-{number}") not in taken)
