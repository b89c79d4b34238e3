"""When the coordinator has the global policy evaluated, and when a run counts as solved."""

from __future__ import annotations

from typing import Any

import pytest
from coordinator_events import Conversation, of, weights

from coordinator.events import Finish, LogEvent, RecordEvaluation, Send
from coordinator.snapshot import summary
from t4nmtd_dist.wire.messages import (
    Claim,
    EvaluationJob,
    EvaluationPoll,
    EvaluationReport,
    LearnerStats,
    Refused,
    Release,
)


class Evaluated(Conversation):
    """A conversation with one learner and an evaluator."""

    def __init__(self, *flags: str) -> None:
        super().__init__("evaluation.every=100", "evaluation.in_a_row=5", *flags)
        self.claim("p1", "w")
        self.epoch = self.claim_evaluator("e").epoch
        self.steps = self.weights_version = 0

    def train(self, steps: int, *, fresh: bool = True, processor_s: float = 0.0) -> None:
        self.steps += steps
        self.weights_version += fresh
        arrays = weights(self.weights_version) if fresh else {}
        stats = LearnerStats(phase="training", interactions=self.steps, processor_s=processor_s)
        self.sync("p1", "w", sequence=self.steps, version=self.weights_version, stats=stats, arrays=arrays)

    def poll(self) -> EvaluationJob:
        job = self.answer("e", EvaluationPoll(epoch=self.epoch))
        assert isinstance(job, EvaluationJob)
        return job

    def report(
        self, job: int, success: float, length: float = 20.0, processor_s: float = 0.0, **fields: Any
    ) -> list[Any]:
        report = EvaluationReport(
            epoch=self.epoch,
            job=job,
            success_rate=success,
            mean_length=length,
            std_length=0.0,
            mean_return=1.0,
            episodes=20,
            dfa_path=[0],
            processor_s=processor_s,
            **fields,
        )
        return self.send("e", report)

    def evaluate(self, success: float, length: float = 20.0, **fields: Any) -> list[Any]:
        self.train(100)
        return self.report(self.poll().job, success, length, **fields)


def test_an_evaluation_is_due_only_after_enough_interactions_on_fresh_weights() -> None:
    talk = Evaluated()
    assert talk.poll().job == 0
    talk.train(99)
    assert talk.poll().job == 0
    talk.train(1)
    first = talk.poll()
    assert (first.job, first.interactions, first.versions) == (1, 100, {"p1": 2})
    talk.train(1000, fresh=False)
    assert talk.poll().job == 0, "the same weights must not be evaluated twice"
    talk.train(1)
    assert talk.poll().job == 2


def test_evaluations_take_at_most_a_tenth_of_the_processor_time() -> None:
    talk = Evaluated()
    talk.train(100)
    first = talk.poll()
    assert first.job == 1, "the first needs no time saved up"
    talk.report(first.job, 0.0, processor_s=2.0)
    talk.train(100, processor_s=17.9)
    assert talk.poll().job == 0
    talk.train(100, processor_s=18.1)
    assert talk.poll().job == 2
    assert summary(talk.state)["evaluations_processor_share"] == pytest.approx(2 / 20.1, abs=1e-4)
    resumed = Evaluated()
    resumed.state.evaluations.load_state_dict(talk.state.evaluations.state_dict())
    resumed.train(1000, processor_s=17.9)
    assert resumed.poll().job == 0, "what was spent before counts"


def test_every_training_learner_must_have_fresh_weights() -> None:
    talk = Evaluated()
    talk.claim("g", "v")
    stats = LearnerStats(phase="training", interactions=1)
    talk.sync("g", "v", version=1, stats=stats, arrays=weights())
    talk.train(100)
    assert talk.poll().job == 1
    talk.train(100)
    assert talk.poll().job == 0, "g is training and has sent nothing new"
    talk.now += 1000.0  # g falls silent, p1 goes on
    talk.train(100)
    assert talk.poll().job == 2


def test_the_weights_of_a_job_are_those_of_its_versions() -> None:
    talk = Evaluated()
    talk.train(100)
    actions = talk.send("e", EvaluationPoll(epoch=talk.epoch))
    (sent,) = of(Send, actions)
    actor = {f"p1/{name}": array.tolist() for name, array in weights(1.0).items() if ".actor." in name}
    assert {name: array.tolist() for name, array in sent.arrays.items()} == actor


def test_solved_after_five_perfect_evaluations_in_a_row_and_dated_at_the_first() -> None:
    talk = Evaluated()
    for success in (1.0, 1.0, 1.0, 1.0, 0.95):
        assert of(Finish, talk.evaluate(success)) == []
    for _ in range(4):
        assert of(Finish, talk.evaluate(1.0)) == []
    (finish,) = of(Finish, talk.evaluate(1.0))
    assert finish.outcome == "solved"
    assert talk.state.evaluations.solved_at == 600
    assert talk.state.evaluations.converged
    assert talk.state.evaluations.best is not None
    assert talk.state.evaluations.best.snapshot.interactions == 1000


def test_solved_with_lengths_that_spread_is_not_converged() -> None:
    talk = Evaluated()
    for length in (10.0, 20.0, 30.0, 40.0, 50.0):
        talk.evaluate(1.0, length)
    assert talk.state.evaluations.solved
    assert not talk.state.evaluations.converged


def test_a_success_rate_that_is_no_number_is_no_success() -> None:
    talk = Evaluated()
    for _ in range(5):
        talk.evaluate(float("nan"))
    assert not talk.state.evaluations.solved


def test_the_report_of_a_stale_job_is_ignored() -> None:
    talk = Evaluated()
    talk.train(100)
    old = talk.poll().job
    talk.train(100)
    new = talk.poll().job
    assert talk.report(old, 1.0) == []
    assert talk.state.evaluations.history == []
    assert len(of(RecordEvaluation, talk.report(new, 1.0))) == 1
    assert talk.report(new, 1.0) == [], "a repeated report counts once"


def test_an_evaluator_taken_over_is_told_so_and_its_report_ignored() -> None:
    talk = Evaluated()
    talk.train(100)
    job = talk.poll().job
    talk.now += 1000.0
    talk.claim_evaluator("e2")
    assert talk.report(job, 1.0) == []
    refused = talk.answer("e", EvaluationPoll(epoch=talk.epoch))
    assert isinstance(refused, Refused)
    assert not refused.final


def test_a_further_evaluator_stands_by_until_the_first_gives_its_place_back() -> None:
    talk = Evaluated()
    refused = talk.answer("e2", Claim(role="evaluator", instance="e2"))
    assert isinstance(refused, Refused)
    assert (refused.final, refused.text.endswith("standing by")) == (False, True)
    talk.send("stranger", Release(pid="evaluator", epoch=talk.epoch))
    assert isinstance(talk.answer("e2", Claim(role="evaluator", instance="e2")), Refused)
    talk.send("e", Release(pid="evaluator", epoch=talk.epoch))
    assert talk.claim_evaluator("e2").epoch == talk.epoch + 1


def test_of_learners_weights_an_evaluation_gets_those_of_the_actor_that_acts() -> None:
    sac = 'learner.algorithm="sac"'
    talk = Evaluated(sac)
    many = weights(1.0, sac)
    averages = {name for name in many if name.startswith("weights.average.")}
    stats = LearnerStats(phase="training", interactions=1000)
    talk.sync("p1", "w", sequence=1, version=1, stats=stats, arrays=many)
    (sent,) = of(Send, talk.send("e", EvaluationPoll(epoch=talk.epoch)))
    assert averages
    assert set(sent.arrays) == {f"p1/{name}".replace("average", "actor") for name in averages}


# Which actions are played


BEST = "evaluation.actions=best"


def test_a_job_says_which_actions_to_play() -> None:
    for setting, modes in (("greedy", ("greedy",)), ("sampled", ("sampled",)), ("best", ("greedy", "sampled"))):
        talk = Evaluated(f"evaluation.actions={setting}")
        talk.train(100)
        assert talk.poll().actions == modes


def test_an_evaluation_remembers_its_mode_and_the_other_modes_success() -> None:
    talk = Evaluated(BEST)
    talk.evaluate(0.9, actions="sampled", other_success_rate=0.7)
    (row,) = talk.state.evaluations.history
    assert (row.actions, row.success_rate, row.other_success_rate) == ("sampled", 0.9, 0.7)


def test_a_row_is_of_one_mode() -> None:
    """A greedily perfect evaluation does not lengthen a row of sampled ones."""
    talk = Evaluated(BEST)
    for mode, count in (("sampled", 1), ("sampled", 2), ("greedy", 1), ("greedy", 2), ("sampled", 1)):
        talk.evaluate(1.0, actions=mode)
        assert talk.state.evaluations.in_a_row == count
    for _ in range(3):
        assert of(Finish, talk.evaluate(1.0, actions="sampled")) == []
    assert [finish.outcome for finish in of(Finish, talk.evaluate(1.0, actions="sampled"))] == ["solved"]
    assert talk.state.evaluations.solved_at == 500


def test_the_mode_of_a_row_is_played_first_as_long_as_the_row_lasts() -> None:
    talk = Evaluated(BEST)
    talk.evaluate(1.0, actions="sampled", other_success_rate=0.5)
    talk.train(100)
    job = talk.poll()
    assert job.actions == ("sampled", "greedy")
    talk.report(job.job, 0.9, actions="greedy", other_success_rate=0.8)
    talk.train(100)
    assert talk.poll().actions == ("greedy", "sampled")


# What counts


def test_an_evaluation_counts_from_the_threshold_on() -> None:
    talk = Evaluated("evaluation.success=0.9")
    for success, count in ((0.9, 1), (0.95, 2), (0.89, 0), (1.0, 1), (float("nan"), 0)):
        talk.evaluate(success)
        assert talk.state.evaluations.in_a_row == count
    for _ in range(4):
        talk.evaluate(0.9)
    assert [finish.outcome for finish in of(Finish, talk.evaluate(0.9))] == ["solved"]


# The policy that is kept


def kept(talk: Evaluated) -> tuple[int, float]:
    best = talk.state.evaluations.best
    assert best is not None
    assert best.snapshot.job == best.row.job
    assert (best.snapshot.weights["p1"]["actor.0.weight"] == best.snapshot.versions["p1"]).all()
    return best.row.job, best.row.success_rate


def test_the_best_policy_is_kept_and_the_newest_among_equals() -> None:
    talk = Evaluated()
    assert talk.state.evaluations.best is None
    for success, job in ((float("nan"), 1), (0.0, 2), (0.5, 3), (0.4, 3), (0.5, 5), (float("nan"), 5), (0.6, 7)):
        talk.evaluate(success)
        assert kept(talk)[0] == job


def test_the_policy_of_a_solved_run_is_that_of_the_fifth() -> None:
    talk = Evaluated()
    for _ in range(5):
        talk.evaluate(1.0)
    assert kept(talk) == (5, 1.0)


def test_the_best_policy_survives_a_resume() -> None:
    talk, resumed = Evaluated(), Evaluated()
    talk.evaluate(0.5)
    talk.evaluate(0.4)
    resumed.state.evaluations.load_state_dict(talk.state.evaluations.state_dict())
    assert kept(resumed) == (1, 0.5)


def test_a_checkpoint_that_knows_only_the_last_policy_is_gone_on_from() -> None:
    """As the program wrote them before it kept the best policy."""
    talk, resumed = Evaluated(), Evaluated()
    talk.evaluate(0.5)
    state = talk.state.evaluations.state_dict()
    best = state.pop("best")
    new = {"actions", "other_success_rate"}
    state["history"] = [{name: row[name] for name in row.keys() - new} for row in state["history"]]
    resumed.state.evaluations.load_state_dict({**state, "last": best["snapshot"]})
    assert kept(resumed) == (1, 0.5)
    unevaluated = Evaluated()
    unevaluated.state.evaluations.load_state_dict({**state, "history": [], "last": None})
    assert unevaluated.state.evaluations.best is None


# What is reported


def test_the_summary_has_both_counts_and_the_policy_that_is_kept() -> None:
    talk = Evaluated(BEST)
    assert summary(talk.state)["policy"] is None
    talk.evaluate(0.5)
    talk.evaluate(0.75, actions="sampled", other_success_rate=0.25)
    talk.evaluate(0.25)
    told = summary(talk.state)
    assert told["policy"] == {"interactions": 200, "success_rate": 0.75, "actions": "sampled", "job": 2}
    assert (told["interactions"], told["interactions_total"], told["success_rate"]) == (300, 300, 0.25)
    for _ in range(5):
        actions = talk.evaluate(1.0)
    told = summary(talk.state)
    assert (told["interactions"], told["interactions_total"]) == (400, 800)
    assert "solved: after 400 interactions (the first of 5 evaluations in a row), 800 in all" in [
        tell.text for tell in of(LogEvent, actions)
    ]
