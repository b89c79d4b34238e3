"""LTLf to automaton by MONA: LTLf2DFA writes the program, this module parses the transition table."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from t4nmtd_dist.automata.deadline import Deadline
from t4nmtd_dist.automata.formula import Formula, Operator
from t4nmtd_dist.automata.minimise import RawAutomaton, check_size
from t4nmtd_dist.core.errors import TranslationError

_VARIABLES = re.compile(r"^DFA for formula with free variables:(.*)$", re.MULTILINE)
_ACCEPTING = re.compile(r"^Accepting states:(.*)$", re.MULTILINE)
_STATES = re.compile(r"^Automaton has (\d+) states?", re.MULTILINE)
_TRANSITION = re.compile(r"^State (\d+): ([01X]*) -> state (\d+)$", re.MULTILINE)


def find_mona() -> str | None:
    """Path of the ``mona`` program, or None if not installed."""
    return shutil.which("mona")


def translate_by_mona(formula: Formula, propositions: Sequence[str], deadline: Deadline) -> RawAutomaton:
    """A formula's complete deterministic automaton, built by MONA.

    Args:
        formula: its propositions must be among ``propositions``.
        propositions: at most 16 names, in the order of the symbols' bits.
        deadline: of the translation; MONA is killed when it passes.

    Raises:
        TranslationError: if MONA is missing or fails, the deadline passes, or the table is too large.
    """
    table = _run_mona(mona_program(formula, propositions), deadline)
    return read_table(table, len(propositions))


def mona_program(formula: Formula, propositions: Sequence[str]) -> str:
    """LTLf2DFA's MONA program for a formula, with proposition i renamed to ``Pi``.

    The task's own names could clash with MONA's reserved words or LTLf2DFA's upper-casing.
    """
    from ltlf2dfa.base import MonaProgram

    variables = {name: f"p{i}" for i, name in enumerate(propositions)}
    program: str = MonaProgram(_ltlf2dfa_tree(formula, variables)).mona_program()
    return program


def _ltlf2dfa_tree(formula: Formula, variables: Mapping[str, str]) -> Any:
    from ltlf2dfa import ltlf

    node = getattr(ltlf, formula.operator.value)
    if formula.operator is Operator.PROPOSITION:
        return node(variables[formula.name])
    operands = [_ltlf2dfa_tree(operand, variables) for operand in formula.operands]
    if len(operands) > 1:
        return node(operands)
    return node(*operands)


def _run_mona(program: str, deadline: Deadline) -> str:
    """Run MONA on a program in a temporary file."""
    path = find_mona()
    if path is None:
        raise TranslationError(
            "the program mona was not found on the PATH: install Debian's package `mona`, "
            "or choose `--translator python`"
        )
    with tempfile.TemporaryDirectory(prefix="t4nmtd-mona-") as folder:
        file = Path(folder, "formula.mona")
        file.write_text(program, encoding="ascii")
        return _output([path, "-q", "-u", "-w", str(file)], deadline)


def _output(command: list[str], deadline: Deadline) -> str:
    """Output of a command, killed with its process group on timeout."""
    process = _started(command)
    try:
        output, _ = process.communicate(timeout=deadline.left())
    except subprocess.TimeoutExpired:
        raise deadline.exceeded() from None
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
    if process.returncode != 0:
        raise TranslationError(f"mona ended with code {process.returncode}: {output.strip()[-500:]}")
    return output


def _started(command: list[str]) -> subprocess.Popen[str]:
    """Start a process in its own session, so that its children can be killed too."""
    try:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="ascii",
            errors="replace",
            start_new_session=True,
        )
    except OSError as error:
        raise TranslationError(f"mona could not be started: {error}; choose `--translator python`") from None


def read_table(output: str, propositions: int) -> RawAutomaton:
    """Parse the automaton in MONA's output.

    State 0 is MONA's dummy start; its successor is the initial state. A transition line is a cube with one digit per
    free variable: 0, 1, or X for either.

    Args:
        output: output of ``mona -w`` with free variables ``P0``, ``P1``, ...
        propositions: number of propositions.

    Raises:
        TranslationError: if the automaton is incomplete or the table too large.
    """
    header = [pattern.search(output) for pattern in (_VARIABLES, _ACCEPTING, _STATES)]
    if None in header:
        raise TranslationError(f"expected an automaton from mona, got: {output.strip()[-500:]}")
    variables, accepted, count = (found.group(1).split() for found in header if found)
    states = int(count[0])
    check_size(states, propositions)
    # After the state axis, one axis of length 2 per proposition, highest bit first.
    delta = np.full((states, *[2] * propositions), -1, dtype=np.int32)
    axes = [propositions - int(name[1:]) for name in variables]
    for source, cube, target in _TRANSITION.findall(output):
        delta[_cube_index(int(source), cube, axes, propositions)] = int(target)
    if np.any(delta < 0):
        raise TranslationError("mona's transition table leaves some letter without a target; please report this")
    delta = delta.reshape(states, -1)
    accepting = np.isin(np.arange(states), [int(state) for state in accepted])
    return RawAutomaton(delta, accepting, int(delta[0, 0]))


def _cube_index(source: int, cube: str, axes: Sequence[int], propositions: int) -> tuple[int | slice, ...]:
    index: list[int | slice] = [source, *[slice(None)] * propositions]
    for axis, digit in zip(axes, cube, strict=True):
        if digit != "X":
            index[axis] = int(digit)
    return tuple(index)
