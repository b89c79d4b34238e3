"""``t4nmtd-coordinator``: owns a task and waits for workers."""

from __future__ import annotations

import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from t4nmtd_dist.cli.entry import parse
from t4nmtd_dist.cli.options import RunFlags
from t4nmtd_dist.wire.endpoints import DEFAULT_CONTROL, DEFAULT_STATE

EXIT_CODES = {"solved": 0, "budget spent": 3, "stopped": 130}


@dataclass(frozen=True)
class CoordinatorCommand(RunFlags):
    """Coordinate the learners of a task until it is solved or the budget is spent."""

    bind: str = DEFAULT_CONTROL
    """Endpoint on which workers are heard."""
    publish: str = DEFAULT_STATE
    """Endpoint on which the state is published for dashboards."""
    keys: Path | None = None
    """Folder of keys made by `t4nmtd keys new`; needed for addresses that other machines can reach."""
    insecure: bool = False
    """Allow addresses that other machines can reach without keys: on a trusted network only."""
    no_dashboard: bool = False
    """Show nothing on this terminal but the outcome."""
    lease: float = 10.0
    """Seconds of silence after which a worker counts as lost and its sub-task is free again."""
    parent: int | None = None
    """End when the process of this number, which started this one, has ended (used by `t4nmtd train`)."""


def main() -> None:
    """Entry point of ``t4nmtd-coordinator``."""
    sys.exit(run(parse(CoordinatorCommand, "t4nmtd-coordinator", CoordinatorCommand.__doc__)))


def run(command: CoordinatorCommand) -> int:
    """Run a coordinator; exit code 0 solved, 3 budget spent, 130 stopped, 2 usage."""
    from t4nmtd_dist.core.errors import T4NMTDError
    from t4nmtd_dist.process.parent_watchdog import end_with_parent

    if command.parent is not None:
        end_with_parent(command.parent)
    try:
        return _serve(command)
    except T4NMTDError as error:
        print(f"t4nmtd-coordinator: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return EXIT_CODES["stopped"]


def _serve(command: CoordinatorCommand) -> int:
    from coordinator.endpoints import Access
    from coordinator.snapshot import summary
    from coordinator.ui.viewer import BackgroundViewer
    from t4nmtd_dist.core.errors import ConfigError
    from t4nmtd_dist.launch.build import ready_task
    from t4nmtd_dist.launch.roles import coordinator_service
    from t4nmtd_dist.process.signals import install_signal_handlers
    from t4nmtd_dist.runs.planning import plan_run
    from t4nmtd_dist.runs.report import outcome_text
    from t4nmtd_dist.wire.addresses import here
    from t4nmtd_dist.wire.zmq_types import new_context

    if not command.lease > 0:
        raise ConfigError(f"--lease {command.lease}: expected seconds above 0")
    plan = plan_run(command, warn=_warn)
    if plan.solved:
        print(plan.solved)
        return EXIT_CODES["solved"]
    task = ready_task(plan, command, _warn)
    access = Access(command.bind, command.publish, command.keys, command.insecure)
    by_hand = command.parent is None
    service = coordinator_service(plan, task, command, access, lease_s=command.lease, by_hand=by_hand)
    if service.commands is not None and not command.no_dashboard:
        print(service.commands.welcome(plan.config.name), flush=True)

    def stop(number: int, _: FrameType | None) -> None:
        service.interrupt(signal.Signals(number).name)

    install_signal_handlers(stop)
    viewer = None if command.no_dashboard else BackgroundViewer(new_context(), here(service.publish), service.own_keys)
    try:
        service.serve()
    finally:
        if viewer is not None:
            viewer.close()
    told = outcome_text(summary(service.state), plan.directory)
    print(f"{plan.config.name} seed {plan.seed}: {told}; run directory {plan.directory}")
    return EXIT_CODES[service.state.outcome or "stopped"]


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)


if __name__ == "__main__":
    main()
