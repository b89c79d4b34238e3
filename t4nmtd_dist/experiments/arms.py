"""The experiments and their arms. An arm is what ``t4nmtd train`` is given beyond a task and a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.tasks import load_task, task_names

CAPS = {
    "task1": 500_000,
    "task2": 1_200_000,
    "task3": 500_000,
    "task4": 1_400_000,
    "task5": 300_000,
    "task6": 300_000,
    "task7": 800_000,
    "task8": 3_500_000,
}
"""Interactions after which a run counts as unsolved: ten times the mean that T4NMTD took when they were fixed."""

PAIRS = {
    "task1": "task2",
    "task2": "task1",
    "task3": "task4",
    "task4": "task3",
    "task5": "task6",
    "task6": "task5",
    "task7": "task8",
    "task8": "task7",
}
"""Experiment 4: the task that a task's networks come from."""

CONVERGED = ("evaluation.until=converged",)
BOTH_PONDS = {
    "task1": (
        "environment.options.colours=8",
        'propositions=["red", "blue", "green", "pink", "black", "white", "grey", "yellow"]',
    )
}
"""Experiment 4 trains task 1 among the 24 balls of task 2, from scratch too, since observations must be alike."""

PLAIN = ("sac.relabel_share=0", "sac.peer_share=0")
DQN = ("learner.algorithm=dqn",)
PLAIN_DQN = ("dqn.relabel_share=0", "dqn.peer_share=0")


@dataclass(frozen=True)
class Arm:
    """One way to train in an experiment.

    Attributes:
        name: also the name of its folder.
        settings: ``key=value`` as for ``--set``; arms of an experiment differ in nothing else.
        method: as for ``--method``.
        preset: as for ``--preset``.
        agents: agents of the tasks in which it differs from the others; none for all tasks.
        source: arm of whose run, of the same seed and the task that ``PAIRS`` names, the networks are transferred.
    """

    name: str
    settings: tuple[str, ...] = ()
    method: str = ""
    preset: str = ""
    agents: tuple[str, ...] = ()
    source: str = ""


@dataclass(frozen=True)
class Experiment:
    """A comparison of arms.

    Attributes:
        title: a heading.
        arms: the first is what the others are compared with.
        by_task: settings of all arms in a task.
    """

    name: str
    title: str
    arms: tuple[Arm, ...]
    by_task: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def chosen(self, names: Sequence[str]) -> tuple[Arm, ...]:
        """The arms of these names, in the experiment's order; all for none.

        Raises:
            ConfigError: for an unknown name.
        """
        known = [arm.name for arm in self.arms]
        for name in names:
            if name not in known:
                raise ConfigError(f"experiment {self.name}: unknown arm {name!r}; known: {', '.join(known)}")
        return tuple(arm for arm in self.arms if not names or arm.name in names)


def _with_plain(arms: Sequence[Arm]) -> tuple[Arm, ...]:
    """The arms, and each without relabelling and peers' experience, which are not in the paper; PPO has neither."""
    plain = [Arm(f"{arm.name}-plain", (*arm.settings, *PLAIN), agents=("sac",)) for arm in arms]
    return (*arms, *plain)


PAPER = {
    "task1": 800_000,
    "task2": 1_500_000,
    "task3": 1_300_000,
    "task4": 1_500_000,
    "task5": 1_100_000,
    "task6": 2_500_000,
    "task7": 4_400_000,
    "task8": 4_900_000,
}
"""Mean interactions that the paper reports for T4NMTD (Table 2)."""

EXPERIMENTS = {
    experiment.name: experiment
    for experiment in (
        Experiment("tasks", "T4NMTD on every task", (Arm("t4nmtd"),)),
        Experiment(
            "comparison",
            "Experiment 1: methods",
            (
                Arm("t4nmtd"),
                Arm("t4nmtd-plain", PLAIN, agents=("sac",)),
                Arm("t4nmtd-dqn", DQN, agents=("ppo",)),
                Arm("t4nmtd-dqn-plain", (*DQN, *PLAIN_DQN), agents=("ppo",)),
                Arm("paper", preset="paper"),
                *(
                    Arm(method, method=method)
                    for method in ("product", "mod", "qrm", "crm", "hrm", "hdqn", "lsts", "dirl")
                ),
            ),
        ),
        Experiment(
            "decomposition",
            "Experiment 2: decomposition by objective or at random",
            _with_plain([Arm("objective"), Arm("random", ("learner.method=random",))]),
        ),
        Experiment(
            "intervention",
            "Experiment 3: with and without policy intervention",
            _with_plain([Arm("intervention"), Arm("off", ("learner.intervention=off",))]),
        ),
        Experiment(
            "transfer",
            "Experiment 4: from scratch, or from the networks of another task",
            (Arm("scratch", CONVERGED), Arm("transfer", CONVERGED, source="scratch")),
            by_task=BOTH_PONDS,
        ),
    )
}


def experiment(name: str) -> Experiment:
    """The experiment of a name.

    Raises:
        ConfigError: if there is none.
    """
    if name not in EXPERIMENTS:
        raise ConfigError(f"unknown experiment {name!r}; known: {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[name]


def applies(arm: Arm, task: TaskConfig) -> bool:
    """Whether an arm differs from the others in a task."""
    return not arm.agents or task.learner.algorithm in arm.agents


def check_tasks(names: Sequence[str]) -> tuple[str, ...]:
    """Names of bundled tasks, all for none.

    Raises:
        ConfigError: for a task without a cap.
    """
    for name in names:
        if name not in CAPS:
            raise ConfigError(f"task {name!r}: experiments know the caps of {', '.join(CAPS)} only")
        load_task(name)
    return tuple(names) or tuple(task_names())
