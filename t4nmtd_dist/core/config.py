"""Task settings: frozen dataclasses with defaults, built from plain data.

Precedence: the defaults here < those of the chosen agent < the task file < ``--config`` files < ``--set`` flags
(``core.setting_sources``). Unknown and former keys are errors that name the key to use.
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
from t4nmtd_dist.core.method_settings import default_sections as default_method_sections
from t4nmtd_dist.core.method_settings import method_configs
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
        horizon: steps per episode.
        options: keyword arguments of the constructor or callable.
        labels: labelling function, ``module:function``; empty if the environment reports ``info["labels"]``.
        path: module search folders, one or a list, relative to the task file. ``load_task`` makes them absolute and
            adds the task file's folder in front.
        snapshots: how states are saved and restored; ``auto`` takes the first of the others that passes verification.
        snapshot_bytes: snapshot size, 0 for the measured one; ``replay`` takes what the horizon needs.
        leave_out: keys of a Dict observation to ignore, such as texts.
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
        """The folders of ``path`` in search order."""
        listed = (self.path,) if isinstance(self.path, str) else self.path
        return tuple(folder for folder in listed if folder)


@dataclass(frozen=True)
class DecompositionConfig:
    """How transitions are assigned to sub-tasks, and distances to acceptance.

    Attributes:
        mode: ``objective``, ``literal`` or ``random`` (see ``t4nmtd_dist.method.decomposition.decompose``).
        prune: drop transitions on no simple path to acceptance.
        error_transitions: assign transitions into error states to sub-tasks as well, as the paper's wording does.
        keep: ``helpful`` merges sub-tasks with equal transitions and, with ``prune``, drops those that never reduce the
            distance to acceptance; ``all`` keeps every sub-task, as in the paper (docs/decisions/019).
        dist: ``shortest`` path to acceptance, or the ``mean`` over all simple paths.
        time_limit: maximum compilation time in seconds, from formula to sub-tasks.
    """

    mode: Literal["objective", "literal", "random"] = "objective"
    prune: bool = True
    error_transitions: bool = False
    keep: Literal["helpful", "all"] = "helpful"
    dist: Literal["shortest", "mean"] = "shortest"
    time_limit: Positive = 20.0


@dataclass(frozen=True)
class HighLevelConfig:
    """The table Q(q, T) and the choice E(Q, q).

    Attributes:
        alpha: step size.
        epsilon: share of uniform choices.
        smdp_discount: discount a decision by its length in steps.
        learn_failures: attempts that miss their targets lower Q(q, T); not in the paper.
    """

    alpha: Share = 0.1
    epsilon: Share = 0.1
    smdp_discount: bool = False
    learn_failures: bool = True


@dataclass(frozen=True)
class LearnerConfig:
    """Settings shared by all learners.

    Attributes:
        method: a name in ``core.registry.METHODS``: ``t4nmtd``; ``random``, which assigns the same transitions to as
            many sub-tasks at random (experiment 2); ``lsts`` or ``dirl``, which train one policy per transition, one
            after the other.
        algorithm: an agent, such as ``ppo`` (discrete actions) or ``sac`` (continuous actions); ``auto`` chooses by the
            action space.
        gamma: discount per step, also used in the shaped reward.
        shaping: ``potential`` (potential difference on every step), ``paper`` (only at targets), ``subtask`` (10 for a
            target, 100 for acceptance); measured in docs/decisions/006 and 014.
        potential: C, the potential of accepting states.
        error_penalty: subtracted from the reward of a step into an error state.
        reward_scale: reward factor for the critics.
        intervention: source of a peer's value (docs/decisions/013): ``query`` asks its process, ``replica`` evaluates a
            copy of its networks; both evaluate peers in this process directly. ``local`` does only the latter and
            otherwise uses the own critic; ``off`` always does.
        attempt_steps: maximum length of an attempt (a truncation: the critic bootstraps).
        stranded_ends: end an attempt in a DFA state where its sub-task has no transition; not in the paper.
        start_states: ``balanced`` stores a state once and draws a DFA state, then a state in it, with the reset as a
            standing choice; ``entries`` stores duplicates and draws uniformly from all entries, one of which is the
            reset, as in the paper.
        hand_over: which states become start states of the next sub-task: those at a ``target``, as in the paper, or at
            any DFA change, so that critics are trained on all states they are queried about.
        hidden: hidden layer widths of actor and critic, at least one.
        normalise_observations: normalise observations to mean 0 and variance 1 by each learner's statistics
            (docs/decisions/020); ``auto``: unless the environment comes with the package. Unresolved
            (``environments.decisions``), ``auto`` counts as ``off``.
    """

    method: str = "t4nmtd"
    algorithm: str = "auto"
    gamma: Share = 0.99
    shaping: Shaping = "potential"
    potential: Positive = 100.0
    error_penalty: NotNegative = 0.0
    reward_scale: Positive = 0.01
    intervention: InterventionMode = "query"
    attempt_steps: Count = 300
    stranded_ends: bool = True
    start_states: Literal["balanced", "entries"] = "balanced"
    hand_over: Literal["targets", "changes"] = "changes"
    hidden: Widths = (64, 64)
    normalise_observations: Literal["auto", "on", "off"] = "auto"


@dataclass(frozen=True)
class EvaluationConfig:
    """When the global policy is evaluated and when the task counts as solved.

    Attributes:
        until: end a run when ``solved``, or when ``converged``: solved, with mean episode lengths of the solving
            evaluations that differ by less than 10 % (the paper's convergence).
        episodes: episodes per evaluation.
        every: interactions between evaluations.
        in_a_row: consecutive successful evaluations that solve the task.
        success: minimum success rate of a successful evaluation.
        actions: ``greedy`` (the most likely ones), ``sampled``, or ``best``: greedy, then sampled if greedy falls short
            of ``success``. The better one is reported, and the exported policy uses it. All evaluations of a row have
            one mode.
    """

    until: Literal["solved", "converged"] = "solved"
    episodes: Count = 20
    every: Count = 5000
    in_a_row: Count = 5
    success: PositiveShare = 1.0
    actions: EvaluationActions = "best"


@dataclass(frozen=True)
class TaskConfig:
    """All settings of a training: the task file with defaults filled in.

    Attributes:
        acceptance: ``first`` ends an episode at the first accepting state, ``end`` evaluates the whole episode
            (docs/acceptance.md); ``auto`` decides by the automaton and is resolved in a compiled task.
        methods: settings of every method that has some, by name; in a task file, the section ``[<name>]``.
        agents: the same of every registered agent.
        learner_given: keys given in the section ``[learner]``; an algorithm chosen later supplies its defaults for the
            others. Not a setting and not in ``to_dict``.
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
    methods: Mapping[str, Any] = field(default_factory=default_method_sections)
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
        for name, section in self.methods.items():
            check_ranges(section, name)
        _check_groups(self)
        _check_names(self)

    @property
    def agent(self) -> Any:
        """Settings of the chosen algorithm: an instance of its agent's ``CONFIG``.

        Raises:
            ConfigError: if the algorithm is still ``"auto"``.
        """
        if self.learner.algorithm == "auto":
            raise ConfigError('learner.algorithm = "auto" is not decided yet: pass the task through prepared() first')
        return self.agents[self.learner.algorithm]

    @property
    def method(self) -> Any:
        """Settings of the chosen method: an instance of its module's ``CONFIG``; None if it has none."""
        return self.methods.get(self.learner.method)

    def to_dict(self) -> dict[str, Any]:
        """Plain data for ``task_config``; fit for TOML and the wire."""
        whole: dict[str, Any] = plain(self)
        del whole["learner_given"]
        agents: dict[str, Any] = whole.pop("agents")
        methods: dict[str, Any] = whole.pop("methods")
        return whole | methods | agents


def check_algorithm(name: str) -> None:
    """Check the value of ``learner.algorithm``.

    Raises:
        ConfigError: if it is neither ``auto`` nor an agent.
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
    """Build a TaskConfig from nested mappings, as in TOML; ``source`` is for messages.

    Raises:
        ConfigError: for an unknown key (suggests the nearest), a former key (names its replacement), a missing key, a
            wrong type or range.
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
    methods: dict[str, Any] = {
        name: read_section(config, data.get(name, {}), name) for name, config in method_configs().items()
    }
    own = {"agents": agents, "methods": methods, "learner_given": list(learner)}
    return read_section(TaskConfig, merge({"learner": learner_defaults(learner.get("algorithm"))}, data) | own)


def learner_defaults(algorithm: object) -> Mapping[str, Any]:
    """An algorithm's defaults for the section ``[learner]``; empty for ``auto`` and unknown names."""
    return agent_settings(algorithm).learner_defaults if algorithm in AGENTS.modules else {}


def _known_keys(kind: Any) -> Mapping[str, Any]:
    """Keys of a section and their types."""
    found = dict(hints(kind))
    if kind is TaskConfig:
        del found["learner_given"], found["agents"], found["methods"]
        found |= {name: agent_settings(name).config for name in AGENTS.modules} | {**method_configs()}
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
    """A sentence naming the replacement of a former key; empty for others."""
    section, key = path[0], path[-1]
    dotted = ".".join(path)
    table = agent_settings(section).former_keys if section in AGENTS.modules and len(path) == 2 else FORMER_KEYS
    advice = table.get(key if table is not FORMER_KEYS else dotted)
    return f"{dotted!r} was a key of an earlier version: {advice}" if advice else ""
