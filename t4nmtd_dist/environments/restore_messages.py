"""Messages about inexact restores: the difference, a likely cause, and a remedy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from t4nmtd_dist.environments.snapshots import Adapter

WAYS: Mapping[Adapter, str] = {
    "own": "own (its get_state and set_state)",
    "mujoco": "mujoco (the state of its model and data)",
    "attributes": "attributes (all of them read and put back)",
    "replay": "replay (a reset with the same seed, and the same actions)",
}
CAUSES: Mapping[Adapter, str] = {
    "own": "get_state() or set_state() leaves out something that decides what comes next; add it there",
    "mujoco": "it has state outside MuJoCo's; write get_state() and set_state(), which return and restore all of it",
    "attributes": "it has state that is not among its attributes, such as in a module or in a C++ object; "
    "write get_state() and set_state(), which return and restore all of it",
    "replay": "it has chance that reset(seed=...) does not decide, such as random, np.random or the time; "
    "draw all of it from self.np_random, and call super().reset(seed=seed) in reset()",
}


def difference(name: str, now: Any, then: Any, propositions: Sequence[str]) -> str | None:
    """How a step after restoring (``now``) differs from the original (``then``); None if it does not.

    ``name`` is "observation" (float [d]), "labels" (bool [P]), "terminated" or "truncated" (bool).
    """
    if np.array_equal(now, then, equal_nan=True):
        return None
    if name == "observation":
        return _numbers(np.asarray(now), np.asarray(then))
    if name == "labels":
        pairs = list(zip(propositions, now, then, strict=True))
        appeared = [f"{label} holds but should not" for label, holds, held in pairs if holds and not held]
        gone = [f"{label} should hold but does not" for label, holds, held in pairs if held and not holds]
        return ", ".join(appeared + gone)
    return f"the episode is {name} but should not be" if now else f"the episode is not {name} but should be"


def _numbers(now: Any, then: Any) -> str:
    if now.shape != then.shape:
        return f"the observation has {now.size} numbers instead of {then.size}"
    differ = np.flatnonzero(~((now == then) | (np.isnan(now) & np.isnan(then))))
    entry = int(differ[0])
    others = f" ({len(differ)} of {now.size} entries differ)" if len(differ) > 1 else ""
    return f"entry {entry} of the observation is {_number(now[entry], then[entry])}{others}"


def _number(now: Any, then: Any) -> str:
    """Both numbers, in full if their short forms are equal."""
    short = f"{now:g}", f"{then:g}"
    return " instead of ".join(short if short[0] != short[1] else (repr(float(now)), repr(float(then))))


def refusal(environment: str, failures: Mapping[Adapter, str]) -> str:
    """The full message, with the failure of each adapter tried; at least one."""
    lines = [
        f"environment {environment!r} cannot be put back into an earlier state, in which the next sub-task begins; "
        "after restoring a snapshot, the same actions must give exactly the same steps. What was tried:"
    ]
    lines += [f"  {WAYS[adapter]}: {reason}" for adapter, reason in failures.items()]
    last = "replay" if "replay" in failures else list(failures)[-1]
    lines.append(f"A likely cause: {CAUSES[last]}")
    if last != "replay":
        lines[-1] += ', or set environment.snapshots = "replay", which needs none of this but is slow'
    return "\n".join(lines)
