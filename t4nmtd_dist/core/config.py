"""Settings of a task: frozen dataclasses with the defaults, and how TOML files and flags change them.

Precedence: the defaults here < the task file < ``--config`` files < ``--set`` flags. An unknown key is an error
that names the nearest known one.
"""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec

from t4nmtd_dist.core.action_modes import EvaluationActions
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.setting_ranges import check_ranges

Shaping = Literal["paper", "potential", "subtask"]
AcceptanceSetting = Literal["auto", "first", "end"]
InterventionMode = Literal["query", "replica", "local", "off"]


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
    horizon: int
    options: dict[str, Any] = field(default_factory=dict)
    labels: str = ""
    path: str | tuple[str, ...] = ""
    snapshots: Literal["auto", "own", "mujoco", "attributes", "replay"] = "auto"
    snapshot_bytes: int = 0
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
    time_limit: float = 20.0


@dataclass(frozen=True)
class HighLevelConfig:
    """Q(q, T) and E(Q, q): step size, exploration, and whether a decision's length is discounted."""

    alpha: float = 0.1
    epsilon: float = 0.1
    smdp_discount: bool = False


@dataclass(frozen=True)
class LearnerConfig:
    """What all learners share.

    Attributes:
        method: how the task is decomposed and its sub-tasks are joined, a name in ``core.registry.METHODS``:
            ``t4nmtd``, or ``random``, which deals the same transitions to as many sub-tasks from the run's seed
            (experiment 2).
        algorithm: ``ppo`` (discrete actions), ``sac`` (continuous actions), or ``auto``: by the action space.
        gamma: discount per step, also the one inside the shaped reward.
        shaping: ``potential`` (potential difference on every step), ``paper`` (only when a target is reached),
            ``subtask`` (10 for a target, 100 for acceptance); docs/decisions/006 and 014 have the measurements.
        error_penalty: taken off the reward of a step into an error state, in any shaping.
        reward_scale: factor on rewards before they reach the critics.
        intervention: where a peer's value comes from (docs/decisions/013): ``query`` asks its process, ``replica``
            evaluates a copy of its networks, and both evaluate peers in the learner's own process directly; ``local``
            knows only the latter, and uses the own critic for all others; ``off`` always uses the own critic.
        attempt_steps: steps after which an attempt is cut (a truncation, the critic bootstraps).
        start_capacity: initial-state buffer entries per DFA state.
        hand_over: which states become start states of the next sub-task: those in which a ``target`` was reached,
            as in the paper, or all in which the DFA changed, so that a critic knows whatever it is asked about.
        hidden: widths of the hidden layers of actor and critic, at least one.
        normalise_observations: whether every learner brings observations to mean 0 and variance 1, by what it has seen
            (docs/decisions/020); ``auto``: unless the environment comes with the package. Before ``auto`` is decided
            (``environments.decisions``), it counts as ``off``.
    """

    method: str = "t4nmtd"
    algorithm: Literal["auto", "ppo", "sac"] = "auto"
    gamma: float = 0.99
    shaping: Shaping = "potential"
    error_penalty: float = 0.0
    reward_scale: float = 0.01
    intervention: InterventionMode = "query"
    attempt_steps: int = 300
    start_capacity: int = 200
    hand_over: Literal["targets", "changes"] = "changes"
    hidden: tuple[int, ...] = (64, 64)
    normalise_observations: Literal["auto", "on", "off"] = "auto"


@dataclass(frozen=True)
class PPOConfig:
    """PPO (Schulman et al., 2017); Stable-Baselines3's defaults where no reason speaks against them.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        rollout: steps of each copy between updates.
        epochs: passes over the roll-out.
        minibatch: rows of one gradient step.
        entropy_coefficient: weight of the entropy bonus of a learner without success.
        entropy_coefficient_successful: weight once every attempt succeeds; linear in the recent success between.
        gae_lambda: lambda of generalised advantage estimation.
        advantage_floor: advantages are divided by their standard deviation, but by no less than this, so that the
            noise of a roll-out without reward is not blown up into a policy.
    """

    num_envs: int = 16
    rollout: int = 64
    epochs: int = 6
    minibatch: int = 256
    learning_rate: float = 1e-3
    clip: float = 0.2
    entropy_coefficient: float = 0.15
    entropy_coefficient_successful: float = 0.005
    value_coefficient: float = 0.5
    gae_lambda: float = 0.95
    max_grad_norm: float = 0.5
    advantage_floor: float = 0.1


@dataclass(frozen=True)
class SACConfig:
    """SAC (Haarnoja et al., 2018); Stable-Baselines3's defaults where no reason speaks against them.

    Attributes:
        num_envs: copies of the environment stepped together by one learner.
        steps_per_iteration: steps of each copy between two messages to the coordinator.
        replay_rows: experiences kept.
        learning_starts: experiences before the first update.
        batch: rows of one update.
        updates_per_step: updates per interaction.
        n_step: longest return, cut at every change of the DFA state.
        relabel_share: share of a batch that is read in a DFA state drawn from all those in which the sub-task has a
            transition, often the row's own among them (exact relabelling).
        peer_share: share of a batch from the experience of peers, read as the sub-task's own (docs/decisions/016).
        success_share: share of a batch from the last steps before past successes.
        wave_share: share of the attempts of a learner without success that are driven by sinusoids.
        hold_share: share of the attempts of a learner without success in which random actions interrupt the policy,
            each held for some steps.
        learning_rate_decay: share of the learning rate that is gone once every attempt succeeds; it goes with the
            square of the share of attempts that do.
        initial_alpha: entropy coefficient at the start, tuned from there; 0 for the one with which acting at random
            for ever is worth as much as one target.
        alpha_floor: share of ``initial_alpha`` below which that of a learner without success does not fall; it goes
            to 0 with the square of the share of attempts that fail.
        tau: step of the target networks.
        actor_average: share of the actor that enters, at each of its updates, the running average of its weights
            that is evaluated and exported; 1 for the actor as it is (docs/decisions/015).
        layer_norm: layer normalisation in the critics.
    """

    num_envs: int = 4
    steps_per_iteration: int = 10
    replay_rows: int = 300_000
    learning_starts: int = 1000
    batch: int = 256
    updates_per_step: float = 0.5
    n_step: int = 5
    relabel_share: float = 0.5
    peer_share: float = 0.5
    success_share: float = 0.25
    wave_share: float = 0.25
    hold_share: float = 0.25
    learning_rate: float = 3e-4
    learning_rate_decay: float = 0.0
    initial_alpha: float = 0.0
    alpha_floor: float = 1.0
    tau: float = 0.005
    actor_average: float = 0.005
    layer_norm: bool = True


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

    episodes: int = 20
    every: int = 5000
    in_a_row: int = 5
    success: float = 1.0
    actions: EvaluationActions = "best"


@dataclass(frozen=True)
class TaskConfig:
    """Everything that defines a training: the task file with all defaults filled in.

    Attributes:
        acceptance: ``first`` ends an episode at the first accepting state, ``end`` asks what the whole episode
            satisfies (docs/acceptance.md); ``auto`` decides by the automaton, and a compiled task has one of the two.
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
    max_interactions: int = 5_000_000
    decomposition: DecompositionConfig = DecompositionConfig()
    high_level: HighLevelConfig = HighLevelConfig()
    learner: LearnerConfig = LearnerConfig()
    ppo: PPOConfig = PPOConfig()
    sac: SACConfig = SACConfig()
    evaluation: EvaluationConfig = EvaluationConfig()
    learner_given: frozenset[str] = field(default=frozenset(), compare=False, repr=False)

    def __post_init__(self) -> None:
        check_ranges(self)

    def to_dict(self) -> dict[str, Any]:
        """Plain data that ``task_config`` reads back; fit for TOML and the wire."""
        plain: dict[str, Any] = _plain(self)
        del plain["learner_given"]
        return plain


def _plain(value: Any) -> Any:
    """Builtins of a setting; msgspec itself leaves out what a section has by default."""
    if dataclasses.is_dataclass(value):
        return {each.name: _plain(getattr(value, each.name)) for each in dataclasses.fields(value)}
    return msgspec.to_builtins(value)


ALGORITHM_DEFAULTS: Mapping[str, Mapping[str, Any]] = {
    "sac": {
        "learner": {
            "gamma": 0.98,
            "shaping": "subtask",
            "error_penalty": 10.0,
            "reward_scale": 0.1,
            "hidden": [128, 128],
        }
    }
}
"""Where an algorithm's defaults differ from those of the dataclasses (docs/decisions/014)."""


def _with_algorithm_defaults(data: Mapping[str, Any]) -> dict[str, Any]:
    learner = data.get("learner")
    algorithm = learner.get("algorithm") if isinstance(learner, Mapping) else None
    return merge(ALGORITHM_DEFAULTS.get(algorithm, {}) if isinstance(algorithm, str) else {}, data)


def _learner_given(data: Mapping[str, Any]) -> list[str]:
    learner = data.get("learner")
    return list(learner) if isinstance(learner, Mapping) else []


def task_config(data: Mapping[str, Any], *, source: str = "task") -> TaskConfig:
    """Build a TaskConfig from plain data.

    Raises:
        ConfigError: for an unknown key (with the nearest known one), a missing key, a wrong type or range.
    """
    _refuse_unknown_keys(data, TaskConfig, source, ())
    try:
        return msgspec.convert(_with_algorithm_defaults(data) | {"learner_given": _learner_given(data)}, TaskConfig)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {error}") from None


def _refuse_unknown_keys(data: Mapping[str, Any], kind: type, source: str, path: tuple[str, ...]) -> None:
    hints = {key: hint for key, hint in typing.get_type_hints(kind).items() if key != "learner_given"}
    for key, value in data.items():
        dotted = ".".join((*path, key))
        if key not in hints:
            nearest = difflib.get_close_matches(key, hints, n=1, cutoff=0)
            raise ConfigError(f"{source}: unknown key {dotted!r}; did you mean {'.'.join((*path, *nearest))!r}?")
        if dataclasses.is_dataclass(hints[key]) and isinstance(value, Mapping):
            _refuse_unknown_keys(value, typing.cast(type, hints[key]), source, (*path, key))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        ConfigError: if it cannot be read, or is not TOML; the text has file, line and column.
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} is not TOML: {error}") from None


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with the keys of ``over`` laid on top, tables merged key by key."""
    merged = dict(base)
    for key, value in over.items():
        old = merged.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        merged[key] = merge(old, value) if both else value  # type: ignore[arg-type]
    return merged


def settings_from_flags(flags: Iterable[str]) -> dict[str, Any]:
    """Plain data from ``--set section.key=value`` flags; the value is written as in TOML.

    Raises:
        ConfigError: if a flag is not of that form.
    """
    data: dict[str, Any] = {}
    for flag in flags:
        key, equals, text = flag.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {flag!r}: expected section.key=value, for instance learner.gamma=0.98")
        data = merge(data, _nested(key.strip().split("."), _toml_value(text.strip())))
    return data


def _toml_value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _nested(path: list[str], value: Any) -> dict[str, Any]:
    return {path[0]: value if len(path) == 1 else _nested(path[1:], value)}
