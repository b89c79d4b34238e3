"""An evaluator's session: weights in, episodes in one or two action modes, a report out."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import Any

from numpy.typing import NDArray

from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.method.high_level import QEntries
from t4nmtd_dist.policy.evaluation import Evaluator, finished
from t4nmtd_dist.policy.evaluation_modes import play
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.wire.codec import Envelope
from t4nmtd_dist.wire.messages import LONGEST_PATH, EvaluationJob, EvaluationReport, Granted
from workers.learner_session import compiled_from, training_of


class EvaluationSession:
    """Evaluates the composed policy for each of the coordinator's jobs.

    Args:
        granted: the evaluator's lease.
        seed: of the episodes' starts; by default the run's.
    """

    def __init__(self, granted: Granted, *, seed: int | None = None) -> None:
        self.place, self.epoch = granted.pid, granted.epoch
        self._task = compiled_from(granted)
        self._training = training_of(granted)
        self._seed = granted.seed if seed is None else seed
        self._evaluator: Evaluator | None = None

    def renew(self, granted: Granted) -> bool:
        """Continue under a later lease; False if it is for a different training."""
        if training_of(granted) != self._training:
            return False
        self.epoch = granted.epoch
        return True

    def evaluate(self, envelope: Envelope) -> EvaluationReport:
        """Run one job."""
        return finished(self.steps(envelope))

    def steps(self, envelope: Envelope) -> Generator[None, None, EvaluationReport]:
        """Run one job step by step; returns the report."""
        job = envelope.message
        assert isinstance(job, EvaluationJob)
        policy = self._policy(job.q_table, envelope.arrays)
        played = yield from play(self._evaluator_for(policy), policy, job.actions, self._task.config.evaluation.success)
        result = played.result
        return EvaluationReport(
            epoch=self.epoch,
            job=job.job,
            success_rate=result.success_rate,
            mean_length=float(result.lengths.mean()),
            std_length=float(result.lengths.std()),
            mean_return=float(result.returns.mean()),
            episodes=len(result.success),
            dfa_path=result.dfa_path[:LONGEST_PATH],
            actions=played.mode,
            other_success_rate=played.other_success_rate,
        )

    def _evaluator_for(self, policy: GlobalPolicy) -> Evaluator:
        if self._evaluator is None:
            self._evaluator = Evaluator(policy, self._task.config.evaluation.episodes, seed=self._seed)
        return self._evaluator

    def state_dict(self) -> State:
        """The state that determines the next evaluations' starts, for a checkpoint."""
        return {"evaluator": None if self._evaluator is None else self._evaluator.state_dict()}

    def load_state_dict(self, state: State) -> None:
        """Restore from ``state_dict`` of a session of the same run."""
        if state["evaluator"] is not None:
            self._evaluator_for(self._policy([], {})).load_state_dict(state["evaluator"])

    def _policy(self, q_table: QEntries, arrays: Mapping[str, NDArray[Any]]) -> GlobalPolicy:
        actors: dict[str, dict[str, NDArray[Any]]] = {}
        for key, array in arrays.items():
            pid, _, name = key.partition("/weights.")
            actors.setdefault(pid, {})[name] = array
        task = self._task
        return GlobalPolicy(task, q_table, actors)
