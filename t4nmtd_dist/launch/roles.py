"""Creates a program's roles as objects of this process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from t4nmtd_dist.launch.build import transferred_weights
from t4nmtd_dist.launch.program import Program, Role
from t4nmtd_dist.method.compiled import CompiledTask
from t4nmtd_dist.runs.directory import CHECKPOINTS_FOLDER
from t4nmtd_dist.runs.options import RunOptions
from t4nmtd_dist.runs.planning import RunPlan

if TYPE_CHECKING:
    from coordinator.endpoints import Access
    from coordinator.service import CoordinatorService
    from workers.options import WorkerOptions

LEASE_S = 10.0


def coordinator_service(
    plan: RunPlan,
    task: CompiledTask,
    options: RunOptions,
    access: Access,
    *,
    lease_s: float = LEASE_S,
    by_hand: bool = False,
) -> CoordinatorService:
    """A listening coordinator; ``serve`` runs it.

    Args:
        plan: of the run.
        task: compiled and checked (``build.ready_task``).
        options: for checkpoint interval, TensorBoard and restart.
        access: endpoints and access control.
        lease_s: seconds of silence until a worker is lost.
        by_hand: whether users start the workers.

    Raises:
        ConfigError: if the task or its weights are too large for a message, or an endpoint cannot be used.
        KeyFileError: if the keys cannot be used.
        PolicyError: if the networks to transfer do not fit.
        RunError: if the run directory cannot be used.
    """
    from coordinator.run_settings import RunSettings
    from coordinator.service import CoordinatorService, RunStorage
    from coordinator.state import CoordinatorState
    from t4nmtd_dist.wire.task_size import check_task_size

    check_task_size(task)
    budget, run_id = plan.config.max_interactions, plan.identity.run_id
    origin = "" if options.transfer_from is None else str(options.transfer_from)
    settings = RunSettings(plan.seed, budget, str(plan.directory), lease_s, run_id, origin)
    state = CoordinatorState(task, settings, transferred_weights(task, options))
    storage = RunStorage(plan.directory, options.restart, plan.resumes, options.checkpoint_every, options.tensorboard)
    return CoordinatorService(state, storage, access, by_hand=by_hand)


def worker_options(program: Program, role: Role, control: str) -> WorkerOptions:
    """Options of a program's learner or evaluator, for ``workers.worker.Worker``.

    Args:
        program: the program.
        role: one of its workers.
        control: the coordinator's endpoint.
    """
    from workers.options import CheckpointOptions, Connection, WorkerOptions

    learns = role.kind == "learner"
    kept = CheckpointOptions(program.directory / CHECKPOINTS_FOLDER, program.options.checkpoint_every)
    return WorkerOptions(
        Connection(control, keys=program.keys, trust=True),
        role="learner" if learns else "evaluator",
        pids=role.pids,
        instance=role.name,
        checkpoints=kept if learns else None,
        device=program.device if learns else "cpu",
    )
