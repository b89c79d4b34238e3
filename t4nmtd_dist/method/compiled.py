"""Compiles a task for training: automaton, sub-tasks, distances and potentials."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.automata.acceptance import task_automaton
from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.dfa import DFA
from t4nmtd_dist.automata.translate import translate
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.method.decomposition import Decomposition
from t4nmtd_dist.method.potential import distances, potentials
from t4nmtd_dist.method.protocol import Method, method_module
from t4nmtd_dist.method.start_states import InitialStateBuffer

Translator = Literal["auto", "mona", "python"]


@dataclass(frozen=True)
class CompiledTask:
    """A compiled task, sent by the coordinator to every worker.

    Attributes:
        dist: distance of every DFA state to acceptance, infinite in E.
        rho: potential of every DFA state, float64 [Q].
    """

    config: TaskConfig
    dfa: DFA
    decomposition: Decomposition
    dist: dict[int, float]
    rho: NDArray[np.float64]

    @property
    def terminal(self) -> frozenset[int]:
        """F and E."""
        return self.dfa.accepting | self.dfa.error

    def start_buffer(self) -> InitialStateBuffer:
        """An empty initial-state buffer for a sub-task."""
        return InitialStateBuffer(repeats=self.config.learner.start_states == "entries")

    def method(self) -> Method:
        """The rules of ``learner.method`` for this task, with an untrained high level."""
        module = method_module(self.config.learner.method)
        return module.build(self.config, self.dfa, self.decomposition, self.rho)


def decomposed(task: TaskConfig, dfa: DFA, *, seed: int = 0, deadline: Deadline | None = None) -> Decomposition:
    """Decompose a task's automaton as ``learner.method`` does.

    Raises:
        ConfigError: see ``MethodModule.decompose``.
    """
    return method_module(task.learner.method).decompose(task, dfa, seed=seed, deadline=deadline)


def compile_task(config: TaskConfig, *, translator: Translator = "auto", seed: int = 0) -> CompiledTask:
    """Translate the formula, determine its acceptance, and decompose its automaton.

    Raises:
        FormulaError, TranslationError: if the formula is invalid or the translator fails.
        ConfigError: if there is nothing to learn, or compilation exceeds ``decomposition.time_limit``.
    """
    deadline = Deadline.after(config.decomposition.time_limit)
    formula = translate(config.formula, propositions=config.propositions, translator=translator, deadline=deadline)
    dfa, acceptance = task_automaton(formula, config.acceptance, config.exclusive)
    config = dataclasses.replace(config, acceptance=acceptance)
    decomposition = decomposed(config, dfa, seed=seed, deadline=deadline)
    if not decomposition.available(dfa.initial):
        raise ConfigError(f"task {config.name!r}: no sub-task is available in the initial state; run `t4nmtd inspect`")
    dist = distances(dfa, exclusive=config.exclusive, mode=config.decomposition.dist, deadline=deadline)
    dfa.find_edges(deadline)
    return CompiledTask(config, dfa, decomposition, dist, potentials(dfa, dist, config.learner.potential))
