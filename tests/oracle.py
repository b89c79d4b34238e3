"""What later commits are held against: numbers of short trainings, bytes of messages, and compiled tasks.

``tests/oracle/`` holds what one commit computed, ``test_oracle.py`` compares. A commit that is meant to change numbers
says why and records anew: ``python tests/oracle.py --record``, or ``--record wire`` for that file alone.

* ``serial.json``: for five tasks, what a short ``t4nmtd train --serial --seed 0`` leaves behind. Hashes of all arrays
  and generator states in its checkpoint and policy (weights, targets, optimisers, replay, start states), counters and
  Q entries in clear. Arrays are compared by content (type, shape, bytes), equal ones counting once: their names only
  tell a reader what they were. Counters that come into being later are no difference. Every learner makes gradient
  steps; ``SHORTER`` says what it takes to get there soon.
* ``wire.json``: the frames of one message of every kind, with all fields and with the required ones only.
* ``inspect/``: ``t4nmtd inspect --json`` of the eight tasks.

The last two are the same on every machine. Sums of floating-point numbers are not: they follow the libraries' code for
the processor. So the numbers of a training are compared on the kind of processor, and with the versions of the
libraries, that they were recorded with (``fingerprint``). Elsewhere FrozenLake's counters still are: with discrete
actions a last digit hardly ever changes what happens. In the other worlds it soon does, and the test is skipped with a
word on why. To check those on another machine, record there at the commit that last changed ``serial.json``
(``--record --into FOLDER``), then compare at the commit in question (``--against FOLDER``).
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import platform
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.numpy import load_file
from wire_samples import ARRAYS, BODIES, NUMBER, SENDER

from t4nmtd_dist.wire.codec import Envelope, encode
from t4nmtd_dist.wire.messages import KINDS

RECORDED = Path(__file__).parent / "oracle"
PROGRAM = Path(sysconfig.get_path("scripts")) / "t4nmtd"
PARTS = ("serial", "wire", "inspect")
TASKS = tuple(f"task{number}" for number in range(1, 9))

SAC = ("sac.learning_starts=200", "sac.batch=32", "sac.updates_per_step=0.1", "evaluation.episodes=2")
PPO = ("evaluation.episodes=2", "evaluation.every=10000")
SHORTER: dict[str, tuple[int, tuple[str, ...]]] = {
    "task1": (5000, (*SAC, "evaluation.every=2500")),
    "task4": (5000, (*SAC, "evaluation.every=2500")),
    "task5": (12000, (*SAC, "evaluation.every=6000")),
    "task7": (20000, PPO),
    "task8": (20000, PPO),
}
"""Interactions of each training, and its settings: updates and an evaluation come sooner than by default."""

SAME_EVERYWHERE = ("task7", "task8")  # their counters
LIBRARIES = ("torch", "numpy", "gymnasium", "mujoco", "pymunk")
TIMES = ("elapsed_s", "wall_s", "processor_s", "evaluations_processor_share")
SHARED = "all learners"
DIGITS = 16  # of a SHA-256

Json = dict[str, Any]
Learner = dict[str, Any]


# Trainings


def fingerprint() -> dict[str, str]:
    """What the last digits of a training depend on beside the code."""
    kind = {"machine": platform.machine(), "capability": torch.backends.cpu.get_cpu_capability()}
    settings = {
        name: os.environ.get(name, "") for name in ("MKL_CBWR", "OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")
    }
    versions = {name: version(name) for name in LIBRARIES}
    return {**kind, **_processor(), **settings, **versions, "libc": " ".join(platform.libc_ver())}


def _processor() -> dict[str, str]:
    """Maker, family and model, as Linux tells them; empty elsewhere."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return {}
    told = dict(reversed([[part.strip() for part in line.split(":", 1)] for line in lines if ":" in line]))
    return {key: told[key] for key in ("vendor_id", "cpu family", "model") if key in told}


def run_task(task: str) -> Json:
    """Train a task for a short while; what is recorded of it."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        interactions, settings = SHORTER[task]
        command = [
            str(PROGRAM), "train", "--task", task, "--serial", "--seed", "0", "--max-interactions", str(interactions),
            "--no-dashboard", "--tensorboard", "off", "--checkpoint-every", "1e6", "--run-dir", str(run),
        ]  # fmt: skip
        command += [word for setting in settings for word in ("--set", setting)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 3:
            raise RuntimeError(f"{' '.join(command)}\nexit code {done.returncode}, not 3\n{done.stdout}{done.stderr}")
        return read_run(run)


def read_run(run: Path) -> Json:
    """Everything in a run's folder that the same training always leaves behind."""
    summary = json.loads((run / "summary.json").read_text())
    pids = list(summary["learners"])
    state = json.loads(_only(run.glob("checkpoints/**/state.json")).read_text())
    policy = json.loads((run / "policy" / "policy.json").read_text())
    owners: dict[str, Learner] = {
        pid: {"counters": _counters(run, pid), "arrays": {}, "generators": []} for pid in pids
    }
    owners[SHARED] = {"counters": {}, "arrays": {}, "generators": []}
    _add_arrays(owners, run)
    _add_generators(owners, state)
    return {
        "summary": {key: value for key, value in summary.items() if key not in TIMES},
        "evaluations": [_without_times(row) for row in _rows(run / "metrics" / "evaluations.csv")],
        "q": max(_q_tables(state, pids), key=lambda table: len(table)),
        "policy_q": max(_q_tables(policy, pids), key=lambda table: len(table)),
        "learners": owners,
    }


def _only(paths: Iterable[Path]) -> Path:
    (path,) = paths
    return path


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def _without_times(row: Mapping[str, str]) -> dict[str, str]:
    return {key: value for key, value in row.items() if key not in TIMES}


def _counters(run: Path, pid: str) -> dict[str, str]:
    """A learner's last row of metrics; its start states are counted there."""
    return _without_times(_rows(run / "metrics" / f"{pid}.csv")[-1])


def _owner(path: Iterable[str], owners: Mapping[str, Learner]) -> str:
    return next((part for part in path if part in owners), SHARED)


def _add_arrays(owners: Mapping[str, Learner], run: Path) -> None:
    """Arrays of checkpoint and policy; of equal ones a learner has the first by name."""
    for file in sorted(run.rglob("*.safetensors")):
        source = file.relative_to(run).parts[0]
        for key, array in sorted(load_file(file).items()):
            parts = [source, *key.strip("/").split("/")]
            owner = _owner(parts, owners)
            name = f"{'/'.join(part for part in parts if part != owner)} {array.dtype} {list(array.shape)}"
            if (digest := _digest(array)) not in owners[owner]["arrays"].values():
                owners[owner]["arrays"][name] = digest


def _digest(array: NDArray[Any]) -> str:
    about = f"{array.dtype.str} {array.shape} ".encode()
    return hashlib.sha256(about + np.ascontiguousarray(array).tobytes()).hexdigest()[:DIGITS]


def _add_generators(owners: Mapping[str, Learner], state: Json) -> None:
    """States of numpy's generators, each as a hash, equal ones once.

    Not those of worlds: one that only ever goes on from start states was never seeded, and never draws.
    """
    for path, value in _nodes(state):
        if isinstance(value, dict) and "bit_generator" in value and "env" not in path:
            found = owners[_owner(path, owners)]["generators"]
            digest = hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:DIGITS]
            found += [] if digest in found else [digest]
    for owner in owners.values():
        owner["generators"].sort()


def _nodes(value: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every part of JSON data with the keys that lead to it."""
    yield path, value
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in inner:
        yield from _nodes(part, (*path, str(key)))


def _q_tables(data: Json, pids: list[str]) -> Iterator[list[list[Any]]]:
    """Q tables that belong to no learner: lists of (state, sub-task, value). Values are written without rounding."""
    for path, value in _nodes(data):
        if not set(path) & set(pids) and isinstance(value, list) and value and all(map(_is_q_entry, value)):
            yield sorted([q, pid.removeprefix(":"), number.hex()] for q, pid, number in value)


def _is_q_entry(entry: Any) -> bool:
    return isinstance(entry, list) and [type(part) for part in entry] == [int, str, float]


# Messages and tasks


def wire_frames(kind: str) -> dict[str, list[str]]:
    """The frames of a message in hexadecimal."""
    return {"all fields": _frames(kind, BODIES[kind]), "required": _frames(kind, _required(kind))}


def _required(kind: str) -> Json:
    needed = [field.name for field in msgspec.structs.fields(KINDS[kind]) if field.required]
    return {name: BODIES[kind][name] for name in needed}


def _frames(kind: str, body: Json) -> list[str]:
    message = msgspec.convert({**body, "type": kind}, KINDS[kind])
    return [frame.hex() for frame in encode(Envelope(message, ARRAYS.get(kind, {}), SENDER, NUMBER))]


def inspect_json(task: str) -> str:
    """What ``t4nmtd inspect --json`` prints."""
    command = [str(PROGRAM), "inspect", "--task", task, "--json"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


# Comparison


def same_machine(recorded: Json) -> str:
    """Empty if a recording's numbers can be expected here to the last digit; else how the two differ."""
    here, there = fingerprint(), recorded["fingerprint"]
    keys = sorted(here.keys() | there.keys())
    return "; ".join(f"{k}: {there.get(k)!r}, here {here.get(k)!r}" for k in keys if there.get(k) != here.get(k))


def differences(task: str, recorded: Json, found: Json) -> list[str]:
    """How a training differs from what was recorded: a line for every learner and part."""
    lines = [
        f"{task}: {line}"
        for part in ("summary", "evaluations", "q", "policy_q")
        for line in _value_differences(part, recorded[part], found[part])
    ]
    for pid in sorted(recorded["learners"].keys() | found["learners"].keys()):
        lines += [f"{task}, {pid}: {line}" for line in _learner_differences(recorded, found, pid)]
    return lines


def _value_differences(name: str, before: Any, after: Any) -> Iterator[str]:
    """How recorded JSON data differs; keys that were not recorded are no difference."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key, value in before.items():
            yield from _value_differences(f"{name} {key}".strip(), value, after.get(key))
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for i, (value, other) in enumerate(zip(before, after, strict=True)):
            yield from _value_differences(f"{name}[{i}]", value, other)
    elif before != after:
        yield f"{name} was {before}, is {after}"


def _learner_differences(recorded: Json, found: Json, pid: str) -> Iterator[str]:
    if pid not in recorded["learners"] or pid not in found["learners"]:
        yield "is only in what was " + ("recorded" if pid in recorded["learners"] else "found")
        return
    before, after = recorded["learners"][pid], found["learners"][pid]
    yield from _value_differences("", before["counters"], after["counters"])
    gone = _not_in(before["arrays"], after["arrays"])
    fresh = _not_in(after["arrays"], before["arrays"])
    if gone or fresh:
        total = len(before["arrays"])
        yield f"{len(gone)} of {total} arrays are not as recorded: {', '.join(gone[:8])}" + ", ..." * (len(gone) > 8)
        yield f"{len(fresh)} arrays were not recorded: {', '.join(fresh[:8])}" + ", ..." * (len(fresh) > 8)
    if lost := set(before["generators"]) - set(after["generators"]):
        yield f"{len(lost)} of {len(before['generators'])} generators are not as recorded"


def _not_in(arrays: Mapping[str, str], others: Mapping[str, str]) -> list[str]:
    known = set(others.values())
    return [name for name, digest in arrays.items() if digest not in known]


def coarse_differences(task: str, recorded: Json, found: Json) -> list[str]:
    """As ``differences``, but of whole numbers only: what another processor should come to as well."""
    return [
        f"{task}, {pid}: {line}"
        for pid, learner in recorded["learners"].items()
        for line in _value_differences("", _whole(learner), found["learners"][pid]["counters"])
    ]


def _whole(learner: Learner) -> dict[str, str]:
    return {name: text for name, text in learner["counters"].items() if text.isdigit()}


# Command


def load(name: str, folder: Path = RECORDED) -> Json:
    """One of the recorded files."""
    data: Json = json.loads((folder / name).read_text(encoding="utf-8"))
    return data


def _dump(path: Path, data: Json) -> None:
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def record(parts: Iterable[str], folder: Path) -> None:
    """Compute what was asked for and write it down."""
    (folder / "inspect").mkdir(parents=True, exist_ok=True)
    if "wire" in parts:
        _dump(folder / "wire.json", {kind: wire_frames(kind) for kind in BODIES})
    for task in TASKS if "inspect" in parts else ():
        (folder / "inspect" / f"{task}.json").write_text(inspect_json(task), encoding="utf-8")
    if "serial" in parts:
        found = {task: run_task(task) for task in SHORTER}
        _dump(folder / "serial.json", {"fingerprint": fingerprint(), "tasks": found})


def compare(folder: Path) -> list[str]:
    """How the trainings differ from a recording of this machine."""
    recorded = load("serial.json", folder)
    other = same_machine(recorded)
    found = [f"recorded on another machine: {other}"] if other else []
    return found + [line for t in SHORTER for line in differences(t, recorded["tasks"][t], run_task(t))]


def main() -> int:
    """Record, or compare the trainings with a recording."""
    parser = argparse.ArgumentParser(description="Records what later commits are held against, or compares with it.")
    parser.add_argument("--record", nargs="*", choices=PARTS, help="compute these, by default all, and write them down")
    parser.add_argument("--into", type=Path, default=RECORDED, help="the folder to record into")
    parser.add_argument("--against", type=Path, default=RECORDED, help="the folder to compare with")
    given = parser.parse_args()
    if given.record is not None:
        record(given.record or PARTS, given.into)
        return 0
    found = compare(given.against)
    print("\n".join(found) or "no difference")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
