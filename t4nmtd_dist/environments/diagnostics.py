"""Diagnoses a task's environment under random actions."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from dataclasses import dataclass, field

from t4nmtd_dist.automata.acceptance import LAST
from t4nmtd_dist.core.config import LearnerConfig
from t4nmtd_dist.core.errors import EnvError, T4NMTDError
from t4nmtd_dist.environments.decisions import decided
from t4nmtd_dist.environments.exclusive import Suggestion, suggestions
from t4nmtd_dist.environments.observation_range import ObservationRange
from t4nmtd_dist.environments.preparation import check_fit, slowness
from t4nmtd_dist.environments.single_env import SingleEnv
from t4nmtd_dist.environments.snapshot_choice import AdapterChoice, choose_snapshots, with_choice
from t4nmtd_dist.environments.timed import check_last_is_free, ends_episode
from t4nmtd_dist.environments.user_errors import described
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.tasks import is_packages_environment

MORE_TRIALS = 20
FORGOTTEN = 0.05
"""The share of a reward that a learner must still see from the start of an episode."""


@dataclass
class Diagnosis:
    """The findings.

    Attributes:
        environment, observation_space, action_space: their text forms, wrappers included.
        observation_size: length of the networks' observation, remaining time included.
        learner: its settings, with ``auto`` resolved.
        propositions: all that may be reported.
        snapshots: the adapter that restores exactly.
        observations: their observed ranges.
        steps, episodes: number taken.
        cut: accepted episodes that the environment ended before the horizon.
        endings: episodes by ending: accepted, error, terminated, truncated, horizon.
        true_steps: steps on which each proposition held.
        together: counts of the sets seen that an exclusive group forbids.
        seen: counts of the sets of true propositions.
        suggestions: groups that might be declared exclusive.
        steps_per_s: of one environment, labels included.
        problems: reasons why the task is unusable.
        warnings: possible problems.
    """

    environment: str
    observation_space: str
    action_space: str
    observation_size: int
    learner: LearnerConfig
    propositions: tuple[str, ...]
    snapshots: AdapterChoice
    observations: ObservationRange
    steps: int = 0
    episodes: int = 0
    cut: int = 0
    endings: Counter[str] = field(default_factory=Counter)
    true_steps: Counter[str] = field(default_factory=Counter)
    together: Counter[tuple[str, ...]] = field(default_factory=Counter)
    seen: Counter[frozenset[str]] = field(default_factory=Counter)
    suggestions: list[Suggestion] = field(default_factory=list)
    steps_per_s: float = 0.0
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def normalised(self) -> bool:
        """Whether learners normalise any entry of the observations."""
        numbers = any(not part.one_hot for part in self.observations.parts)
        return numbers and self.learner.normalise_observations == "on"

    @property
    def never_true(self) -> list[str]:
        """Propositions that never held."""
        return [name for name in self.propositions if not self.true_steps[name]]


def diagnose(task: CompiledTask, *, steps: int, seed: int) -> Diagnosis:
    """Take random actions in any task's environment and collect findings.

    Raises:
        EnvError: if the environment cannot be opened, stepped, labelled or restored.
    """
    config = task.config
    try:
        choice = choose_snapshots(config.environment, config.propositions, trials=MORE_TRIALS)
        env = SingleEnv(with_choice(config.environment, choice), config.propositions)
        task = dataclasses.replace(task, config=decided(config, env.action_space))
        found = _described(task, env, choice)
        _fits(task, env, found)
        _act(task, env, found, steps, seed)
    except T4NMTDError:
        raise
    except Exception as error:  # user code may raise anything
        raise EnvError(f"environment {config.environment.id!r} raised {described(error)}") from error
    _judge(task, found)
    found.suggestions = suggestions(task, found.seen)
    return found


def _described(task: CompiledTask, env: SingleEnv, choice: AdapterChoice) -> Diagnosis:
    timed = task.config.acceptance == "end"
    return Diagnosis(
        str(env.env),
        str(env.env.observation_space),
        str(env.action_space),
        env.observation_size + timed,
        task.config.learner,
        tuple(name for name in env.propositions if not (timed and name == LAST)),
        choice,
        ObservationRange(env.parts),
    )


def _fits(task: CompiledTask, env: SingleEnv, found: Diagnosis) -> None:
    try:
        last = (LAST,) if task.config.acceptance == "end" else ()
        if last:
            check_last_is_free(env.propositions)
        check_fit(task, (*env.propositions, *last), env.action_space)
    except EnvError as error:
        found.problems.append(str(error))


def _act(task: CompiledTask, env: SingleEnv, found: Diagnosis, steps: int, seed: int) -> None:
    env.action_space.seed(seed)
    began = time.perf_counter()
    while found.steps < steps:
        _episode(task, env, found, steps, seed)
    found.steps_per_s = found.steps / (time.perf_counter() - began)


def _episode(task: CompiledTask, env: SingleEnv, found: Diagnosis, steps: int, seed: int) -> None:
    found.observations.note(env.reset(seed if not found.steps else None))
    q, ending, horizon = task.dfa.initial, "horizon", task.config.environment.horizon
    for t in range(1, horizon + 1):
        step = env.step(env.action_space.sample())
        true = [name for name, holds in zip(env.propositions, step.labels, strict=True) if holds]
        names = [name for name in true if name in found.propositions]
        found.observations.note(step.observation)
        found.steps += 1
        found.true_steps.update(names)
        found.seen[frozenset(names)] += 1
        for group in task.config.exclusive:
            both = tuple(name for name in names if name in group)
            found.together.update([both] if len(both) > 1 else [])
        if ends_episode(t, horizon, terminated=step.terminated, truncated=step.truncated):
            names.append(LAST)
        q = task.dfa.step(q, names)
        found.cut += LAST in names and t < horizon and q in task.dfa.accepting
        ending = _ending(task, q, step.terminated, step.truncated)
        if ending != "horizon":
            break
        if found.steps >= steps:
            return
    found.episodes += 1
    found.endings[ending] += 1


def _ending(task: CompiledTask, q: int, terminated: bool, truncated: bool) -> str:
    holds = {
        "accepted": q in task.dfa.accepting,
        "error": q in task.dfa.error,
        "terminated": terminated,
        "truncated": truncated,
    }
    return next((name for name, held in holds.items() if held), "horizon")


def _judge(task: CompiledTask, found: Diagnosis) -> None:
    for names, times in found.together.items():
        text = f"exclusive says that {' and '.join(names)} never hold together, but they did on {times} steps"
        found.problems.append(text)
    unseen = [name for name in found.never_true if name in task.dfa.propositions]
    if unseen:
        found.warnings.append(
            f"{', '.join(unseen)} never held under {found.steps} random steps: exploration may not find it either, "
            "or it is never reported"
        )
    always = [name for name in found.propositions if found.true_steps[name] == found.steps]
    if always:
        found.warnings.append(f"{', '.join(always)} held on every step: does it depend on the state?")
    found.warnings += _about_the_end(task, found)
    if not is_packages_environment(task.config.environment):
        found.warnings += found.observations.warnings(normalised=found.normalised)
    slow = slowness(with_choice(task.config.environment, found.snapshots))
    if slow is not None:
        found.warnings.append(slow)


def _about_the_end(task: CompiledTask, found: Diagnosis) -> list[str]:
    """Warnings for tasks whose trace ends with the episode."""
    if task.config.acceptance != "end":
        return []
    horizon, gamma = task.config.environment.horizon, task.config.learner.gamma
    warnings = []
    if gamma**horizon < FORGOTTEN:
        warnings.append(
            f"success comes with the end of the episode, {horizon} steps away, of which learner.gamma = {gamma} leaves "
            f"{gamma**horizon:.1g}: raise it to {1 - 1 / horizon:.4g} or more, or lower environment.horizon"
        )
    if found.cut:
        warnings.append(
            f"the environment itself ended {found.cut} of {found.episodes} episodes before the horizon, and they count "
            "as accepted because the formula held by then; if the environment must not end them, make a proposition of "
            "what ended them, and forbid it in the formula"
        )
    return warnings
