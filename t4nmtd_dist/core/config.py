"""Settings of a task: frozen dataclasses with the defaults, and how they are made from plain data.

Precedence: the defaults here < those of the chosen agent < the task file < ``--config`` files < ``--set`` flags
(``core.setting_sources``). An unknown key is an error that names the nearest known one; a key of an earlier version is
an error that names what to use instead.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from t4nmtd_dist.core.action_modes import EvaluationActions
from t4nmtd_dist.core.agent_settings import agent_settings, default_sections
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.registry import AGENTS, METHODS
from t4nmtd_dist.core.sections import check_ranges, hints, plain, read_section
from t4nmtd_dist.core.setting_sources import merge
from t4nmtd_dist.core.setting_types import Count, CountOrZero, NotNegative, Positive, PositiveShare, Share, Widths

Shaping = Literal["paper", "potential", "subtask"]
AcceptanceSetting = Literal["auto", "first", "end"]
InterventionMode = Literal["query", "replica", "local", "off"]

FORMER_KEYS: Mapping[str, str] = {"learner.start_capacity": "it is fixed at 200 now"}
"""Keys of earlier versions outside the agents' sections, and what to use instead."""

RESERVED_NAMES = {"evaluator", "evaluations"}
"""Names of processes and files of every run, which no proposition can have."""


@dataclass(frozen=True)
class EnvironmentConfig:
    """The environment.

    Attributes:
        id: a registered Gymnasium id, ``module:id`` (the module registers it), or ``module:callable``.
        horizon: steps of an episode.
        options: keywords of the constructor or the callable.
        labels: ``module:function``, the labelling function; without it the environment reports ``info["labels"]``.
        path: further folders in which modules are searched for, one or a list, relative to the task file's folder.
            ``load_task`` makes them absolute and puts the task file's own folder first.
        snapshots: how states are saved and restored; ``auto`` tries the others in this order and checks each.
        snapshot_bytes: room of a snapshot, 0 for what the check found; ``replay`` takes what the horizon needs.
        leave_out: keys of a Dict observation that are not learned from, such as texts.
    """

    id: str
    horizon: Count
    options: dict[str, Any] = field(default_factory=dict)
    labels: str = ""
    path: str | tuple[str, ...] = ""
    snapshots: Literal["auto", "own", "mujoco", "attributes", "replay"] = "auto"
    snapshot_bytes: CountOrZero = 0
    leave_out: tuple[str, ...] = ()

    @property
    def folders(self) -> tuple[str, ...]:
        """The folders of ``path``, in the order in which they are searched."""
        listed = (self.path,) if isinstance(self.path, str) else self.path
        return tuple(folder for folder in listed if folder)


@dataclass(frozen=True)
class DecompositionConfig:
    """How transitions are dealt to sub-tasks and how far states are from acceptance (spec: Decomposition).

    Attributes:
        mode: ``objective``, ``literal`` or ``random`` (see ``t4nmtd_dist.method.decomposition.decompose``).
        prune: leave out transitions that no simple path to acceptance takes.
        keep: ``helpful`` merges sub-tasks with equal transitions and, where ``prune`` is on, leaves out those that
            never bring acceptance nearer; ``all`` keeps every sub-task, as in the paper (docs/decisions/019).
        dist: ``shortest`` path to acceptance, or the ``mean`` over all simple paths.
        time_limit: seconds that compiling the task may take, from formula to sub-tasks.
    """

    mode: Literal["objective", "literal", "random"] = "objective"
    prune: bool = True
    keep: Literal["helpful", "all"] = "helpful"
    dist: Literal["shortest", "mean"] = "shortest"
    time_limit: Positive = 20.0


@dataclass(frozen=True)
class HighLevelConfig:
    """Q(q, T) and E(Q, q): step size, exploration, and whether a decision's length is discounted."""

    alpha: Share = 0.1
    epsilon: Share = 0.1
    smdp_discount: bool = False


@dataclass(frozen=True)
class LSTSConfig:
    """LSTS, for ``learner.method = "lsts"``.

    Attributes:
        slice_attempts: attempts of an edge between two choices of the teacher.
    """

    slice_attempts: Count = 50


@dataclass(frozen=True)
class DIRLConfig:
    """DIRL, for ``learner.method = "dirl"``.

    Attributes:
        edge_interactions: interactions after which the training of an edge ends; 0 for ``max_interactions`` divided by
            the number of edges.
    """

    edge_interactions: CountOrZero = 0


@dataclass(frozen=True)
class LearnerConfig:
    """What all learners share.

    Attributes:
        method: how the task is decomposed and its sub-tasks are joined, a name in ``core.registry.METHODS``:
            ``t4nmtd``; ``random``, which deals the same transitions to as many sub-tasks from the run's seed
            (experiment 2); or ``lsts`` or ``dirl``, which train one policy for each transition, one after the other.
        algorithm: name of an agent, such as ``ppo`` (discrete actions) or ``sac`` (continuous actions); ``auto``
            chooses by the action space.
        gamma: discount per step, also the one inside the shaped reward.
        shaping: ``potential`` (potential difference on every step), ``paper`` (only when a target is reached),
            ``subtask`` (10 for a target, 100 for acceptance); docs/decisions/006 and 014 have the measurements.
        error_penalty: taken off the reward of a step into an error state, in any shaping.
        reward_scale: factor on rewards before they reach the critics.
        intervention: where a peer's value comes from (docs/decisions/013): ``query`` asks its process, ``replica``
            evaluates a copy of its networks, and both evaluate peers in the learner's own process directly; ``local``
            knows only the latter, and uses the own critic for all others; ``off`` always uses the own critic.
        attempt_steps: steps after which an attempt is cut (a truncation, the critic bootstraps).
        hand_over: which states become start states of the next sub-task: those in which a ``target`` was reached,
            as in the paper, or all in which the DFA changed, so that a critic knows whatever it is asked about.
        hidden: widths of the hidden layers of actor and critic, at least one.
        normalise_observations: whether every learner brings observations to mean 0 and variance 1, by what it has seen
            (docs/decisions/020); ``auto``: unless the environment comes with the package. Before ``auto`` is decided
            (``environments.decisions``), it counts as ``off``.
    """

    method: str = "t4nmtd"
    algorithm: str = "auto"
    gamma: Share = 0.99
    shaping: Shaping = "potential"
    error_penalty: NotNegative = 0.0
    reward_scale: Positive = 0.01
    intervention: InterventionMode = "query"
    attempt_steps: Count = 300
    hand_over: Literal["targets", "changes"] = "changes"
    hidden: Widths = (64, 64)
    normalise_observations: Literal["auto", "on", "off"] = "auto"


@dataclass(frozen=True)
class EvaluationConfig:
    """When the global policy is evaluated and when the task counts as solved.

    Attributes:
        episodes: episodes of an evaluation.
        every: interactions between two evaluations.
        in_a_row: how many successful evaluations in a row solve the task.
        success: success rate from which on an evaluation counts towards those in a row.
        actions: ``greedy`` (the most likely ones), ``sampled``, or ``best``: greedy ones, and sampled ones where those
            fall short of ``success``; the better of the two is reported, and what is exported acts in that way. All
            evaluations of a row are of one mode.
    """

    episodes: Count = 20
    every: Count = 5000
    in_a_row: Count = 5
    success: PositiveShare = 1.0
    actions: EvaluationActions = "best"


@dataclass(frozen=True)
class TaskConfig:
    """Everything that defines a training: the task file with all defaults filled in.

    Attributes:
        acceptance: ``first`` ends an episode at the first accepting state, ``end`` asks what the whole episode
            satisfies (docs/acceptance.md); ``auto`` decides by the automaton, and a compiled task has one of the two.
        agents: settings of every registered agent by name; in a task file, the section ``[<name>]``.
        learner_given: keys of the section ``[learner]`` that were given. It is no setting, and not part of ``to_dict``:
            an algorithm that is chosen later brings its own defaults for all others.
    """

    name: str
    formula: str
    propositions: tuple[str, ...]
    environment: EnvironmentConfig
    title: str = ""
    exclusive: tuple[tuple[str, ...], ...] = ()
    acceptance: AcceptanceSetting = "auto"
    max_interactions: Count = 5_000_000
    decomposition: DecompositionConfig = DecompositionConfig()
    high_level: HighLevelConfig = HighLevelConfig()
    lsts: LSTSConfig = LSTSConfig()
    dirl: DIRLConfig = DIRLConfig()
    learner: LearnerConfig = LearnerConfig()
    agents: Mapping[str, Any] = field(default_factory=default_sections)
    evaluation: EvaluationConfig = EvaluationConfig()
    learner_given: frozenset[str] = field(default=frozenset(), compare=False, repr=False)

    def __post_init__(self) -> None:
        check_ranges(self)
        METHODS.check(self.learner.method, "learner.method")
        check_algorithm(self.learner.algorithm)
        for name, section in self.agents.items():
            check_ranges(section, name)
            agent_settings(name).check(section, self.learner)
        _check_groups(self)
        _check_names(self)

    @property
    def agent(self) -> Any:
        """Settings of the chosen algorithm: an instance of its agent's ``CONFIG``.

        Raises:
            ConfigError: if the algorithm is not decided yet.
        """
        if self.learner.algorithm == "auto":
            raise ConfigError('learner.algorithm = "auto" is not decided yet: pass the task through prepared() first')
        return self.agents[self.learner.algorithm]

    def to_dict(self) -> dict[str, Any]:
        """Plain data that ``task_config`` reads back; fit for TOML and the wire."""
        whole: dict[str, Any] = plain(self)
        del whole["learner_given"]
        agents: dict[str, Any] = whole.pop("agents")
        return whole | agents


def check_algorithm(name: str) -> None:
    """Check the value of ``learner.algorithm``.

    Raises:
        ConfigError: if it is neither ``auto`` nor the name of an agent.
    """
    if name != "auto":
        AGENTS.check(name, "learner.algorithm")


def _check_groups(task: TaskConfig) -> None:
    for group in task.exclusive:
        strange = [name for name in group if name not in task.propositions]
        if strange:
            raise ConfigError(f"exclusive names {strange[0]!r}; declared propositions: {', '.join(task.propositions)}")


def _check_names(task: TaskConfig) -> None:
    taken = sorted(RESERVED_NAMES & {name.casefold() for name in task.propositions})
    if taken:
        raise ConfigError(
            f"a proposition is called {taken[0]!r}, as a process or a file of every run is; give it another name"
        )


def task_config(data: Mapping[str, Any], *, source: str = "task") -> TaskConfig:
    """Build a TaskConfig from plain data.

    Args:
        data: nested mappings, as a TOML file gives them.
        source: where they come from, for messages.

    Raises:
        ConfigError: for an unknown key (with the nearest known one), a key of an earlier version (with what replaces
            it), a missing key, a wrong type or range.
    """
    try:
        _refuse_unknown_keys(data, TaskConfig, ())
        return _from_known_keys(data)
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def _from_known_keys(data: Mapping[str, Any]) -> TaskConfig:
    given = data.get("learner")
    learner: Mapping[str, Any] = given if isinstance(given, Mapping) else {}
    agents: dict[str, Any] = {
        name: read_section(agent_settings(name).config, data.get(name, {}), name) for name in AGENTS.modules
    }
    own = {"agents": agents, "learner_given": list(learner)}
    return read_section(TaskConfig, merge({"learner": learner_defaults(learner.get("algorithm"))}, data) | own)


def learner_defaults(algorithm: object) -> Mapping[str, Any]:
    """What an algorithm lays under the section ``[learner]``; nothing for what is no algorithm, or ``auto``."""
    return agent_settings(algorithm).learner_defaults if algorithm in AGENTS.modules else {}


def _known_keys(kind: Any) -> Mapping[str, Any]:
    """The keys of a section and their types."""
    found = dict(hints(kind))
    if kind is TaskConfig:
        del found["learner_given"], found["agents"]
        found |= {name: agent_settings(name).config for name in AGENTS.modules}
    return found


def _refuse_unknown_keys(data: Mapping[str, Any], kind: Any, path: tuple[str, ...]) -> None:
    known = _known_keys(kind)
    for key, value in data.items():
        dotted = ".".join((*path, key))
        if key not in known:
            raise ConfigError(former_key((*path, key)) or f"unknown key {dotted!r}; {_nearest(key, known, path)}")
        if dataclasses.is_dataclass(known[key]) and isinstance(value, Mapping):
            _refuse_unknown_keys(value, known[key], (*path, key))


def _nearest(key: str, known: Mapping[str, Any], path: tuple[str, ...]) -> str:
    nearest = difflib.get_close_matches(key, known, n=1, cutoff=0)
    return f"did you mean {'.'.join((*path, *nearest))!r}?"


def former_key(path: tuple[str, ...]) -> str:
    """What to use instead of a key of an earlier version, as a sentence; empty for a key that never was."""
    section, key = path[0], path[-1]
    dotted = ".".join(path)
    table = agent_settings(section).former_keys if section in AGENTS.modules and len(path) == 2 else FORMER_KEYS
    advice = table.get(key if table is not FORMER_KEYS else dotted)
    return f"{dotted!r} was a key of an earlier version: {advice}" if advice else ""
