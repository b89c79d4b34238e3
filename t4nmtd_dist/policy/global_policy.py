"""The global policy: in <s, q>, act with the actor of arg max Q(q, .) (paper, section "Global policy").

An exported policy is a folder: ``policy.json`` (format, task, DFA, sub-tasks, Q, rho) and ``actors.safetensors``.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.actors import make_actor, make_upper
from t4nmtd_dist.agents.common.product_states import product_states, with_goal
from t4nmtd_dist.agents.protocol import Actions
from t4nmtd_dist.agents.weights import UPPER, acting_parameters, networks_of
from t4nmtd_dist.automata.acceptance import LAST
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.core.action_modes import ActionMode, action_mode
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import PolicyError
from t4nmtd_dist.environments.batched import Observations
from t4nmtd_dist.environments.timed import remaining_share
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.method.options import OptionMethod
from t4nmtd_dist.method.protocol import Method, method_module
from t4nmtd_dist.policy.held_roles import HeldRoles, Rows
from t4nmtd_dist.policy.one_thread import one_torch_thread

FLATTEN = "flatten observations that are one-hot or a Dict by t4nmtd_dist.environments.observations.flattener"


ActorWeights = Mapping[str, Mapping[str, NDArray[Any]]]


class PolicyTask(Protocol):
    """The parts of a compiled or exported task that a policy needs."""

    @property
    def config(self) -> TaskConfig:
        """The settings."""

    @property
    def dfa(self) -> DFA:
        """The automaton."""

    @property
    def decomposition(self) -> Decomposition:
        """The sub-tasks."""

    @property
    def rho(self) -> NDArray[np.float64]:
        """Potential of every DFA state [Q], for the validation return."""


class GlobalPolicy:
    """One actor per sub-task (or other role), and which of them acts.

    In T4NMTD the DFA state determines who acts. Under options (HRM, h-DQN) a role is held until the method ends it, so
    ``actions`` follows N episodes from ``begin`` on.

    Args:
        task: settings, automaton, sub-tasks and potentials.
        q_table: known entries of Q(q, T).
        actors: parameters by pid, named ``actor.*`` (others are ignored); of several networks, ``network:actor.*``.
        mode: default action mode of ``act``, ``greedy`` (most likely actions) or ``sampled``; that of the best
            evaluation in an exported policy.
        seed: for sampled actions; None for a random one.

    Raises:
        PolicyError: if the actors' parameters are missing or do not fit, or the mode is unknown.
    """

    def __init__(
        self,
        task: PolicyTask,
        q_table: QEntries,
        actors: ActorWeights,
        *,
        mode: str = "greedy",
        seed: int | None = None,
    ) -> None:
        self.config, self.dfa, self.decomposition, self.rho = task.config, task.dfa, task.decomposition, task.rho
        self.q_table = q_table
        networks = {
            name or pid: own
            for pid, weights in actors.items()
            for name, own in networks_of(acting_parameters(weights)).items()
        }
        self._method = self._restored_method()
        self._roles = {name: self._method.role(name) for name in self._method.roles}
        self._goals = sum(role.goal is not None for role in self._roles.values())
        self._actors = {name: make_actor(task.config.learner, own) for name, own in networks.items() if name != UPPER}
        self.subtask_of = self._choices()
        self._held: HeldRoles | None = None
        if UPPER in networks and isinstance(self._method, OptionMethod):
            self._method.upper = make_upper(networks[UPPER], self.dfa.states)
        self.mode: ActionMode = action_mode(mode)
        self._rng = np.random.default_rng(seed)
        self._q = self.dfa.initial
        self._first = True
        self._steps = 0

    @property
    def _timed(self) -> bool:
        """Whether actors observe the remaining time (docs/acceptance.md)."""
        return LAST in self.dfa.propositions

    def _restored_method(self) -> Method:
        module = method_module(self.config.learner.method)
        method = module.build(self.config, self.dfa, self.decomposition, self.rho)
        method.load(self.q_table)
        return method

    def _choices(self) -> dict[int, str]:
        """The greedy choice in every DFA state, among roles with an actor; without an upper network's values."""
        able = [name for name, role in self._roles.items() if role.network in self._actors]
        chosen = self._method.choose(range(self.dfa.states), among=able)
        return {q: name for q, name in enumerate(chosen) if name is not None}

    def begin(self, count: int) -> None:
        """``actions`` now follows ``count`` new episodes."""
        if isinstance(self._method, OptionMethod):
            self._held = HeldRoles(self._method, count)

    def active(self, q: int) -> str | None:
        """The role that acted last in DFA state ``q``, in the first episode that ``actions`` follows."""
        return self.subtask_of.get(q) if self._held is None else self._held.first

    def actions(
        self, observations: Observations, q: NDArray[np.int32], rng: np.random.Generator | None = None
    ) -> tuple[Actions, NDArray[np.bool_]]:
        """Actions at product states, and which of them have an actor. torch uses one thread.

        Args:
            observations: float32 [N, d].
            q: DFA states [N].
            rng: samples the actions; without it they are greedy.

        Returns:
            int64 [N] or float32 [N, A], arbitrary valid actions where there is no actor; bool [N].
        """
        with one_torch_thread():
            return self._actions(observations, q, rng)

    def _actions(
        self, observations: Observations, q: NDArray[np.int32], rng: np.random.Generator | None
    ) -> tuple[Actions, NDArray[np.bool_]]:
        known = np.zeros(len(q), np.bool_)
        actions: Actions | None = None
        for name, rows in self._groups(observations, q):
            role = self._roles[name]
            states = product_states(observations[rows], q[rows], self.dfa.states)
            if role.goal is not None:
                states = with_goal(states, role.goal, self._goals)
            found = self._actors[role.network].act(states, rng)
            if actions is None:
                actions = np.zeros((len(q), *found.shape[1:]), found.dtype)
            actions[rows], known[rows] = found, True
        return (np.zeros(len(q), np.int64) if actions is None else actions), known

    def _groups(self, observations: Observations, q: NDArray[np.int32]) -> Iterator[tuple[str, Rows]]:
        """Who acts in which rows."""
        if isinstance(self._method, OptionMethod):
            if self._held is None or self._held.count != len(q):
                self.begin(len(q))
            assert self._held is not None
            yield from self._held.groups(observations, q)
            return
        for state in np.unique(q):
            name = self.subtask_of.get(int(state))
            if name is not None:
                yield name, np.flatnonzero(q == state)

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode in the initial DFA state; ``seed``, if given, reseeds sampled actions."""
        self.begin(1)
        self._q, self._first, self._steps = self.dfa.initial, True, 0
        if seed is not None:
            self._rng = np.random.default_rng(seed)

    @property
    def state(self) -> int:
        """The current DFA state."""
        return self._q

    def act(
        self,
        observation: NDArray[Any],
        labels: Iterable[str],
        *,
        actions: ActionMode | None = None,
        rng: np.random.Generator | None = None,
    ) -> Any:
        """The action at an observation, after reading its labels: a number, or an array [A].

        The first labels after ``reset`` are ignored: a trace begins with the first step.

        Args:
            observation: numbers of a Box; pass one-hot and Dict observations through
                ``environments.observations.flattener`` first.
            labels: names of the true propositions.
            actions: ``greedy`` or ``sampled``; None for the policy's own mode.
            rng: for sampled actions; None for the policy's own generator.

        Raises:
            PolicyError: if nothing was learned for the DFA state, the observation has another length, or the mode is
                unknown.
        """
        sampling = (self.mode if actions is None else action_mode(actions)) == "sampled"
        if not self._first:
            self._q = self._after(labels)
            self._steps += 1
        self._first = False
        row = self._row(observation)
        found, known = self.actions(row, np.array([self._q], np.int32), (rng or self._rng) if sampling else None)
        if not known[0]:
            raise PolicyError(
                f"no action at DFA state {self._q}: it is {self._kind()}; call reset() to begin an episode"
            )
        return found[0]

    def _kind(self) -> str:
        """The kind of a DFA state without an action."""
        if self._q in self.dfa.accepting:
            return "accepting"
        return "an error state" if self._q in self.dfa.error else "one for which nothing was learned"

    def accepts(self, labels: Iterable[str], *, ended: bool = False) -> bool:
        """Whether the task is solved after the step that followed the last action.

        Args:
            labels: names of the true propositions after that step.
            ended: whether the environment ended the episode; the horizon is detected automatically.
        """
        return self._after(labels, ended=ended) in self.dfa.accepting

    def failed(self, labels: Iterable[str], *, ended: bool = False) -> bool:
        """Whether the task can no longer be solved after that step; arguments as for ``accepts``."""
        return self._after(labels, ended=ended) in self.dfa.error

    def _after(self, labels: Iterable[str], *, ended: bool = False) -> int:
        """The DFA state after the last action's step."""
        ended = ended or self._steps + 1 >= self.config.environment.horizon
        return self.dfa.step(self._q, [*labels, LAST] if ended else labels)

    def _row(self, observation: NDArray[Any]) -> Observations:
        try:
            row = np.asarray(observation, np.float32).reshape(1, -1)
        except (TypeError, ValueError) as error:
            raise PolicyError(
                f"an observation of type {type(observation).__name__} ({error}); expected numbers: {FLATTEN}"
            ) from None
        inputs = self._observation_size()
        learned_from = None if inputs is None else inputs - self._timed
        if learned_from not in (None, row.shape[1]):
            raise PolicyError(
                f"an observation of {row.shape[1]} numbers, where the policy learned from {learned_from}; {FLATTEN}"
            )
        if not self._timed:
            return row
        share = remaining_share(self._steps, self.config.environment.horizon)
        return np.concatenate([row, share.reshape(1, 1)], axis=1)

    def _observation_size(self) -> int | None:
        """Length of the actors' observations, or None without actors."""
        return next((actor.inputs - self.dfa.states - self._goals for actor in self._actors.values()), None)

    def check_fits(self, observations: Observations) -> None:
        """Check that the actors were trained on observations of this size [N, d].

        Raises:
            PolicyError: if not.
        """
        learned_from = self._observation_size()
        if learned_from not in (None, observations.shape[1]):
            raise PolicyError(
                f"the policy learned from observations of {learned_from} numbers, and those of "
                f"{self.config.environment.id} have {observations.shape[1]}: train it again, or use the version of "
                "the environment that it learned in"
            )
