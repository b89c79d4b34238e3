"""TensorBoard event files, written without TensorFlow or PyTorch.

Each group of curves (a learner, or the evaluations) has its own folder, so that TensorBoard draws curves of the same
name into one chart. The required package is an extra.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.runs.file_names import file_name

TensorBoard = Literal["auto", "on", "off"]
HOW_TO_GET_IT = "pip install 't4nmtd-dist[tensorboard]'"


def check_tensorboard(choice: TensorBoard) -> None:
    """Check that requested event files can be written.

    Raises:
        ConfigError: if not; says what to install.
    """
    if choice == "on" and not _installed():
        raise ConfigError(f"--tensorboard on needs the package tensorboard, which is not installed: {HOW_TO_GET_IT}")


def open_event_files(folder: Path, choice: TensorBoard, step: int = 0) -> EventFiles | None:
    """Open event files below ``folder``; None if off, or (``auto``) not installed.

    Args:
        folder: created with the first curve.
        choice: ``auto`` writes if the package is installed.
        step: first step of this process; hides what an earlier process wrote from there on.

    Raises:
        ConfigError: if requested and not installed, or if the package is damaged.
    """
    check_tensorboard(choice)
    if choice == "off" or not _installed():
        return None
    try:
        return EventFiles(folder, step)
    except (ImportError, TypeError) as error:  # TypeError: from an incompatible version of protobuf
        raise ConfigError(f"the package tensorboard is damaged; mend it, or pass --tensorboard off: {error}") from error


def _installed() -> bool:
    return importlib.util.find_spec("tensorboard") is not None


class EventFiles:
    """Scalars over steps, one file per group; each ``add`` is flushed to disk.

    Args:
        folder: of the groups' folders.
        step: where a resumed run continues; 0 for a new one.
    """

    def __init__(self, folder: Path, step: int = 0) -> None:
        # A lazy import, which takes about 0.3 s. TensorBoard's own writer flushes only every two minutes.
        from tensorboard.compat.proto import event_pb2, summary_pb2
        from tensorboard.summary.writer.record_writer import RecordWriter

        self._event, self._session, self._summary = event_pb2.Event, event_pb2.SessionLog, summary_pb2.Summary
        self._record_writer = RecordWriter
        self._folder, self._step = folder, step
        self._name = f"events.out.tfevents.{int(time.time()):010d}.{os.getpid()}"
        self._writers: dict[str, Any] = {}

    def add(self, group: str, step: int, scalars: Mapping[str, float | None]) -> None:
        """Write one point per curve of ``group``; skips None.

        Args:
            group: name of the folder.
            step: x of the points.
            scalars: y by curve name.
        """
        known = {name: value for name, value in scalars.items() if value is not None}
        values = [self._summary.Value(tag=name, simple_value=value) for name, value in known.items()]
        self._write(group, self._event(step=step, summary=self._summary(value=values)))

    def close(self) -> None:
        """Close all files; a later ``add`` reopens them."""
        for writer in self._writers.values():
            writer.close()
        self._writers.clear()

    def _write(self, group: str, event: Any) -> None:
        if group not in self._writers:
            self._begin(group)
        event.wall_time = time.time()
        self._writers[group].write(event.SerializeToString())
        self._writers[group].flush()

    def _begin(self, group: str) -> None:
        path = self._folder / file_name(group) / self._name
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = not path.exists()
        self._writers[group] = self._record_writer(path.open("ab"))
        if fresh:
            self._write(group, self._event(file_version="brain.Event:2"))
        if self._step:
            start = self._session(status=self._session.START)
            self._write(group, self._event(step=self._step, session_log=start))
