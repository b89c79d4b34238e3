"""SAC learners in whole runs: reproducible, exported and loaded, asked by strangers, refused where they cannot act."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from small_sac import AT_G1, PIDS, START, TO_G2, TO_G3, TO_G4, averaged, product_states, small_sac, small_sac_task, twin

from coordinator.run_settings import RunSettings
from coordinator.snapshot import summary
from t4nmtd_dist.agents.common import product_states as networks_states
from t4nmtd_dist.agents.common.action_bounds import scaled
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import NoPeers
from t4nmtd_dist.agents.registry import build_learner
from t4nmtd_dist.agents.sac.actor import GaussianActor
from t4nmtd_dist.agents.weights import part_of
from t4nmtd_dist.cli.check import check
from t4nmtd_dist.core.errors import ConfigError, EnvError, PolicyError, ProtocolError
from t4nmtd_dist.environments.action_spaces import action_bounds
from t4nmtd_dist.environments.preparation import check_fit
from t4nmtd_dist.launch.serial import SerialRun
from t4nmtd_dist.method.compiled import CompiledTask, compile_task
from t4nmtd_dist.method.start_states import InitialStateBuffer
from t4nmtd_dist.policy.export import export_policy
from t4nmtd_dist.policy.global_policy import GlobalPolicy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.tasks import load_task

SERIAL = (
    "evaluation.every=60", "evaluation.episodes=2", "environment.horizon=20", "learner.attempt_steps=12",
)  # fmt: skip
ROUNDS = 5


# Serial runs


def run_of(seed: int, *, clock: float = 0.0) -> SerialRun:
    run = SerialRun(small_sac_task(*SERIAL), RunSettings(seed, 10**9, lease_s=float("inf")), lambda: clock)
    run.sessions["g1"].buffer.add(START, AT_G1)
    for _ in range(ROUNDS):
        run.round()
    return run


@pytest.fixture(scope="module")
def run() -> SerialRun:
    return run_of(3)


def all_weights(run: SerialRun) -> dict[str, NDArray[Any]]:
    return {f"{pid}/{k}": v for pid, s in run.sessions.items() for k, v in s.learner.weights().items()}


def same(a: dict[str, NDArray[Any]], b: dict[str, NDArray[Any]]) -> bool:
    return list(a) == list(b) and all(x.tobytes() == y.tobytes() for x, y in zip(a.values(), b.values(), strict=True))


def report_of(run: SerialRun) -> dict[str, Any]:
    report: dict[str, Any] = dict(summary(run.coordinator))
    report.pop("wall_s")
    return report


def evaluations_of(run: SerialRun) -> list[Any]:
    history = run.coordinator.evaluations.history
    return [(row.interactions, row.mean_length, row.mean_return, row.dfa_path) for row in history]


def test_two_runs_of_one_seed_are_equal_bit_for_bit(run: SerialRun) -> None:
    first, second = run, run_of(3, clock=1234.5)
    assert same(all_weights(first), all_weights(second))
    assert first.coordinator.method.entries() == second.coordinator.method.entries() != []
    assert report_of(first) == report_of(second)
    learners = [run.sessions["g1"].learner for run in (first, second)]
    assert learners[0].gradient_steps == learners[1].gradient_steps > 0
    for one, other in zip(*(learner.replay_buffer.state_dict().values() for learner in learners), strict=True):  # type: ignore
        assert one.tobytes() == other.tobytes()
    assert evaluations_of(first) == evaluations_of(second) != []


def test_another_seed_gives_another_run(run: SerialRun) -> None:
    first, second = all_weights(run), all_weights(run_of(4))
    differing = [name for name, array in first.items() if array.tobytes() != second[name].tobytes()]
    assert {"g1/actor.0.weight", "g1/critics.0.weight", "g1/log_alpha"} <= set(differing)


def test_interactions_and_updates_of_a_run_are_those_of_its_learners(run: SerialRun) -> None:
    learners = {pid: session.learner for pid, session in run.sessions.items()}
    assert learners["g1"].version == ROUNDS
    assert learners["g2"].version > 0, "start states are handed over"
    assert run.coordinator.interactions == 20 * sum(learner.version for learner in learners.values())
    steps = [max(0, 20 * learner.version - 48) for learner in learners.values()]
    assert [learner.gradient_steps for learner in learners.values()] == steps
    assert report_of(run)["gradient_steps"] == sum(steps)
    assert report_of(run)["intervention"]["asked"] > 0


# Exported policies


Q_TABLE = [(START, "g1", 1.0), (TO_G2, "g2", 1.0), (TO_G3, "g3", 1.0), (TO_G4, "g4", 1.0)]


def trained(name: str, pid: str) -> OffPolicyLearner:
    learner = small_sac(pid, name=name)
    for _ in range(4):
        learner.iterate(NoPeers())
    return learner


def test_a_loaded_policy_acts_as_the_live_actors_averages(tmp_path: Path) -> None:
    learners = {pid: trained("task5", pid) for pid in ("g1",)} | {pid: small_sac(pid) for pid in PIDS[1:]}
    folder = tmp_path / "policy"
    export_policy(folder, small_sac_task(), Q_TABLE, {pid: found.weights() for pid, found in learners.items()}, {})
    policy = load(folder)
    rng = np.random.default_rng(0)
    observations = rng.uniform(-1, 1, (40, 23)).astype(np.float32)
    q = rng.choice([START, TO_G2, TO_G3, TO_G4], size=40).astype(np.int32)
    actions, known = policy.actions(observations, q)
    assert known.all()
    assert actions.dtype == np.float32
    for row in range(len(q)):
        learner = learners[{START: "g1", TO_G2: "g2", TO_G3: "g3", TO_G4: "g4"}[int(q[row])]]
        state = product_states(observations[row : row + 1], q[row : row + 1])
        live = averaged(learner.agent.updater).act(state, deterministic=True)
        assert actions[row] == pytest.approx(live[0], abs=1e-6)
    assert policy.act(observations[0], []) in spaces.Box(-1, 1, (2,), np.float32)


def test_actions_of_a_policy_are_stretched_to_its_action_space() -> None:
    """Waterworld's velocities go up to 3.5."""
    learner, task = trained("task1", "red"), small_sac_task(name="task1")
    weights = learner.weights()
    weights["average.head.weight"][:] *= 300
    learner.load(weights, 1)
    policy = GlobalPolicy(task, [(0, "red", 1.0)], {"red": weights})
    observations = np.random.default_rng(0).uniform(-1, 1, (50, learner.rollout.observations.shape[1]))
    observations = observations.astype(np.float32)
    states = product_states(observations, np.zeros(50, np.int32), task.dfa.states)
    actions, _ = policy.actions(observations, np.zeros(50, np.int32))
    assert np.allclose(actions, 3.5 * averaged(learner.agent.updater).act(states, deterministic=True), atol=1e-5)
    assert all(action in spaces.Box(-3.5, 3.5, (2,), np.float32) for action in actions)
    assert np.abs(actions).max() > 3.4


@pytest.mark.parametrize("damage", ["low", "high", "0.weight", "head.bias"])
def test_an_actor_without_a_part_is_refused(damage: str) -> None:
    weights = part_of(small_sac("g1").weights(), "average")
    del weights[damage]
    with pytest.raises(PolicyError):
        GaussianActor((16,), weights)


def test_bounds_that_do_not_belong_together_are_refused() -> None:
    weights = part_of(small_sac("g1").weights(), "average")
    with pytest.raises(PolicyError, match=r"\(2,\) and \(3,\)"):
        GaussianActor((16,), weights | {"high": np.ones(3, np.float32)})


def test_weights_go_from_one_learner_to_another() -> None:
    first, second = trained("task5", "g1"), small_sac("g1", seed=5)
    second.load(first.weights(), first.version)
    assert second.version == first.version == 4
    assert all(np.array_equal(array, second.weights()[name]) for name, array in first.weights().items())


# The published copy


@pytest.fixture(scope="module")
def asked() -> OffPolicyLearner:
    return trained("task5", "g1")


def test_the_published_critic_is_the_one_after_the_last_update() -> None:
    learner = small_sac("g1")
    observations, q = np.zeros((3, 23), np.float32), np.array([START, TO_G2, START], np.int32)
    for version in range(1, 6):
        learner.iterate(NoPeers())
        critic = learner.published._critic
        expected = twin(learner.agent.updater)
        expected._generator.set_state(critic.generator.get_state())  # its noise is its own
        values, published = learner.published.values({"observation": observations, "q": q})
        assert published == learner.version == version
        assert values.dtype == np.float32
        assert values == pytest.approx(np.stack(expected.soft_values(product_states(observations, q)), axis=1))


def test_answering_does_not_disturb_the_learner() -> None:
    first, second = small_sac("g1"), small_sac("g1")
    for _ in range(4):
        first.published.values({"observation": np.zeros((3, 23), np.float32), "q": np.zeros(3, np.int32)})
        first.iterate(NoPeers())
        second.iterate(NoPeers())
    assert same(first.weights(), second.weights())


DTYPES = [np.float32, np.float64, np.int32, np.int64, np.uint8, np.bool_]
shapes = st.one_of(
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
    st.tuples(st.integers(0, 4), st.sampled_from([22, 23, 24])),
)
arrays = st.sampled_from(DTYPES).flatmap(lambda dtype: hnp.arrays(dtype, shapes))
good_observations = hnp.arrays(np.float32, st.tuples(st.integers(0, 4), st.just(23)))
good_q = hnp.arrays(np.int32, st.integers(0, 4), elements=st.integers(-1, 6))
questions = st.fixed_dictionaries(
    {}, optional={"observation": arrays | good_observations, "q": arrays | good_q, "more": arrays}
)


def fits(request: dict[str, NDArray[Any]]) -> bool:
    """Whether a request follows the protocol: observation float32 [k, d], finite, and q [k] of DFA states."""
    if not {"observation", "q"} <= request.keys():
        return False
    observation, q = request["observation"], request["q"]
    right = observation.ndim == 2 and q.ndim == 1 and observation.shape == (len(q), 23)
    right = right and observation.dtype == np.float32 and bool(np.isfinite(observation).all())
    return right and q.dtype.kind == "i" and all(0 <= state < 6 for state in q)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(question=questions)
@example(question={"observation": np.full((1, 23), np.nan, np.float32), "q": np.zeros(1, np.int32)})
@example(question={"observation": np.zeros((2, 23), np.float32), "q": np.array([0, 6], np.int32)})
@example(question={"observation": np.zeros((0, 23), np.float32), "q": np.zeros(0, np.int32)})
@example(question={"observation": np.zeros((2, 23), np.float32), "q": np.array([0, 5], np.int64)})
def test_a_malformed_request_is_refused_and_a_good_one_answered(
    asked: OffPolicyLearner, question: dict[str, NDArray[Any]]
) -> None:
    if not fits(question):
        with pytest.raises(ProtocolError):
            asked.published.values(question)
        return
    values, version = asked.published.values(question)
    assert values.shape == (len(question["q"]), 2)
    assert values.dtype == np.float32
    assert version == 4


# Where it cannot act


def misfit(name: str, algorithm: str, *flags: str) -> CompiledTask:
    return compile_task(load_task(name, flags=[f"learner.algorithm={algorithm}", *flags]))


MISFITS = [
    ("task7", "sac", r"SAC needs a Box action space; .*FrozenLake-v0 has Discrete\(6\)"),
    ("task5", "ppo", r"PPO needs a Discrete action space; .*Racecar-v0 has Box\(-1.0, 1.0, \(2,\), float32\)"),
]


@pytest.mark.parametrize(("name", "algorithm", "message"), MISFITS)
def test_actions_that_a_learner_cannot_take_are_refused_by_name(name: str, algorithm: str, message: str) -> None:
    task = misfit(name, algorithm)
    with pytest.raises(EnvError, match=message):
        build_learner(task, task.decomposition.pids[0], InitialStateBuffer(10), task.method(), seed=0)


@pytest.mark.parametrize(("name", "algorithm", "message"), MISFITS)
def test_check_tells_so_before_a_run(
    name: str, algorithm: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert check(name, steps=30, seed=0, flags=[f"learner.algorithm={algorithm}"], as_json=True) == 2
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert len(problems) == 1
    with pytest.raises(EnvError, match=message):
        raise EnvError(problems[0])


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (2, 3)),
        spaces.Box(-np.inf, 1, (2,)),
        spaces.Box(np.array([-1.0, 0.0]), np.array([1.0, np.inf]), dtype=np.float64),
        spaces.Box(0, 5, (2,), np.int64),
        spaces.Box(0, 1, (), np.float32),
        spaces.MultiBinary(3),
    ],
)
def test_boxes_that_sac_cannot_fill_are_refused(space: spaces.Space[Any]) -> None:
    task = small_sac_task()
    check_fit(task, task.config.propositions, spaces.Box(-1, 1, (2,)))
    with pytest.raises(EnvError, match=r"SAC needs .* has "):
        check_fit(task, task.config.propositions, space)


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(-1e4, 1e4), st.floats(0.01, 1e6)), min_size=1, max_size=4),
    st.integers(0, 100),
)
def test_scaled_actions_are_in_the_space_whatever_its_bounds(limits: list[tuple[float, float]], seed: int) -> None:
    """The nearest float32 of a float64 bound may lie outside."""
    low, width = np.array(limits).T
    high = low + width
    space = spaces.Box(low, high, dtype=np.float64)
    bounds = action_bounds(space, "an environment")
    actions = np.random.default_rng(seed).uniform(-1, 1, (20, len(low))).astype(np.float32)
    actions[0], actions[1] = -1, 1
    taken = scaled(actions, *bounds)
    assert taken.dtype == np.float32
    assert all(action in space for action in taken)
    assert np.allclose(taken[:2], [low, high], rtol=1e-6, atol=1e-30)


@pytest.mark.parametrize("flags", [("sac.replay_rows=1", "sac.learning_starts=0"), ("sac.replay_rows=49",)])
def test_a_replay_too_small_to_ever_learn_is_refused(flags: tuple[str, ...]) -> None:
    with pytest.raises(ConfigError, match=r"sac\.replay_rows = \d+: expected at least"):
        small_sac("g1", *flags)


def test_product_states_of_the_tests_are_those_of_the_networks() -> None:
    observations, q = np.random.default_rng(0).random((6, 3)).astype(np.float32), np.arange(6, dtype=np.int32)
    assert np.array_equal(product_states(observations, q), networks_states.product_states(observations, q, 6))
