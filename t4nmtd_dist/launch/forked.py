"""The ``forked`` launcher: every role is a fork of this process and has all its Python objects.

The Python API uses it, because other programs cannot import an environment defined in a notebook.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import subprocess
import sys
from types import FrameType

from coordinator.endpoints import Access
from t4nmtd_dist.core.errors import BROKEN_ENVIRONMENT, EnvError, T4NMTDError
from t4nmtd_dist.launch.local import LOOPBACK, start_processes
from t4nmtd_dist.launch.program import Program, Role
from t4nmtd_dist.launch.protocol import BUDGET_SPENT, SOLVED, STOPPED, Handle, Supervisor
from t4nmtd_dist.launch.restarts import Process
from t4nmtd_dist.launch.roles import coordinator_service, worker_options
from t4nmtd_dist.process.parent_watchdog import end_with_parent
from t4nmtd_dist.process.signals import install_signal_handlers
from t4nmtd_dist.runs.links import open_to_append

USAGE = 2
CODES = {"solved": SOLVED, "budget spent": BUDGET_SPENT}


def start(program: Program, supervisor: Supervisor) -> Handle:
    """Start a program as forks of this process; see ``Launcher``."""
    return start_processes(program, supervisor, fork)


def fork(program: Program, role: Role, control: str) -> Process:
    """Start a role as a fork of this process; see ``local.Spawn``."""
    child = multiprocessing.get_context("fork").Process(
        target=_child, args=(program, role, control, os.getpid()), name=role.name, daemon=True
    )
    child.start()
    return ForkedProcess(child)


class ForkedProcess:
    """A fork with the interface of ``subprocess.Popen``."""

    def __init__(self, child: multiprocessing.process.BaseProcess) -> None:
        self._child = child
        self.pid = child.pid or 0

    @property
    def returncode(self) -> int | None:
        """The exit code, negative for a signal; None while the process runs."""
        return self._child.exitcode

    def poll(self) -> int | None:
        """See ``Process.poll``."""
        return self._child.exitcode

    def wait(self, timeout: float | None = None) -> int:
        """See ``Process.wait``."""
        self._child.join(timeout)
        code = self._child.exitcode
        if code is None:
            raise subprocess.TimeoutExpired(self._child.name, timeout or 0.0)
        return code

    def terminate(self) -> None:
        """See ``Process.terminate``."""
        self._child.terminate()

    def kill(self) -> None:
        """See ``Process.kill``."""
        self._child.kill()


def _child(program: Program, role: Role, control: str, parent: int) -> None:
    """Run a role and exit without inherited clean-up."""
    code = USAGE
    try:
        _leave_parent(program, role)
        end_with_parent(parent)
        code = _serve(program) if role.kind == "coordinator" else _work(program, role, control)
    except T4NMTDError as error:
        print(f"t4nmtd-{'coordinator' if role.kind == 'coordinator' else 'worker'}: {error}", file=sys.stderr)
        code = BROKEN_ENVIRONMENT if isinstance(error, EnvError) else USAGE
    except BaseException:
        sys.excepthook(*sys.exc_info())
        code = 1
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _leave_parent(program: Program, role: Role) -> None:
    """Detach from the parent's terminal, output, signals and threads."""
    os.setsid()
    signal.set_wakeup_fd(-1)  # inherited from a notebook's event loop
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    os.environ.update(role.environment)
    with open_to_append(program.log(role)) as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    sys.stdout = os.fdopen(1, "w", buffering=1, closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)


def _serve(program: Program) -> int:
    options = dataclasses.replace(program.options, restart=False)  # the parent has done it
    access = Access(LOOPBACK, LOOPBACK, program.keys, False)
    service = coordinator_service(program.plan, program.task, options, access)

    def stop(number: int, _: FrameType | None) -> None:
        service.interrupt(signal.Signals(number).name)

    install_signal_handlers(stop)
    service.serve()
    return CODES.get(service.state.outcome or "", STOPPED)


def _work(program: Program, role: Role, control: str) -> int:
    import torch

    from workers.worker import Worker

    torch.set_num_threads(1)
    return Worker(worker_options(program, role, control)).run()
