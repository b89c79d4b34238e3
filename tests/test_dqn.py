"""Double DQN: its target by hand, peers' values at boundaries, exploration, checkpoints, exports, and CartPole."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from benchmark_modules import benchmark
from small_agents import small_agent, small_agent_task

from t4nmtd_dist.agents.common.batches import DrawnBatch
from t4nmtd_dist.agents.common.off_policy import OffPolicyLearner
from t4nmtd_dist.agents.common.peer_values import LocalPeers, PeerValues
from t4nmtd_dist.agents.dqn.actor import SAMPLED_EPSILON, GreedyActor
from t4nmtd_dist.agents.dqn.agent import DQN, epsilon_after, initial_networks
from t4nmtd_dist.agents.dqn.config import DQNConfig
from t4nmtd_dist.agents.dqn.losses import double_q_target, q_loss
from t4nmtd_dist.agents.weights import part_of
from t4nmtd_dist.core.agent_settings import agent_for
from t4nmtd_dist.core.errors import ConfigError
from t4nmtd_dist.core.state_dict import copied, joined, split
from t4nmtd_dist.policy.export import export_policy
from t4nmtd_dist.policy.loading import load
from t4nmtd_dist.tasks import load_task

NO_ANSWERS = PeerValues.joined([])
PEERS_VALUE = 7.0


def learner_of_dqn(iterations: int = 0) -> tuple[OffPolicyLearner, DQN]:
    learner = small_agent("dqn", iterations)
    assert isinstance(learner, OffPolicyLearner)
    assert isinstance(learner.agent, DQN)
    return learner, learner.agent


def peers_valuing(value: float) -> LocalPeers:
    """Peers of every sub-task, to whom all states are worth the same."""
    pids = small_agent_task("dqn").decomposition.pids
    return LocalPeers(dict.fromkeys(pids, lambda _, q: np.full(len(q), value, np.float32)))


@pytest.fixture(scope="module")
def drawn() -> tuple[DQN, DrawnBatch]:
    """A batch that holds boundaries, terminals and steps within the sub-task, and its agent."""
    learner, agent = learner_of_dqn(40)
    for number in range(200):
        batch = learner.batches.draw(number, 0.0)
        if len(batch.asked_rows) and (batch.discounts == 0).any():
            return agent, batch
    raise AssertionError("no batch with both a boundary and a terminal")


def test_the_target_is_qs_choice_valued_by_its_target_network_and_the_peers_value_where_it_answered() -> None:
    reward, discount = torch.tensor([1.0, 1.0, 1.0, 1.0]), torch.tensor([0.5, 0.25, 0.0, 0.5])
    q = torch.tensor([[1.0, 2.0], [3.0, 1.0], [0.0, 5.0], [2.0, 0.0]])
    target_q = torch.tensor([[40.0, 20.0], [8.0, 80.0], [9.0, 9.0], [6.0, 60.0]])
    peer, answered = torch.tensor([9e9, 9e9, 9e9, 10.0]), torch.tensor([False, False, False, True])
    found = double_q_target(reward, discount, q, target_q, peer, answered)
    assert found.tolist() == [1 + 0.5 * 20, 1 + 0.25 * 8, 1.0, 1 + 0.5 * 10]


def test_the_loss_is_huber_of_the_actions_taken() -> None:
    q, actions = torch.tensor([[0.5, 99.0], [99.0, 3.0]]), torch.tensor([[0], [1]])
    assert q_loss(q, actions, torch.zeros(2)).item() == pytest.approx((0.5 * 0.5**2 + 3.0 - 0.5) / 2)


@pytest.mark.slow
def test_a_peers_value_enters_at_the_boundaries_it_is_asked_about_and_there_alone(
    drawn: tuple[DQN, DrawnBatch],
) -> None:
    agent, batch = drawn
    observed = len(batch.states[0]) - small_agent_task("dqn").dfa.states
    changed = (batch.states[:, observed:] != batch.next_states[:, observed:]).any(axis=1)
    assert changed[batch.asked_rows].all()
    assert (batch.discounts[batch.asked_rows] > 0).all()
    answers = PeerValues(batch.asked_rows, np.full(len(batch.asked_rows), PEERS_VALUE, np.float32))
    own, with_peer = (agent.updater.targets(batch.tensors(), each).numpy() for each in (NO_ANSWERS, answers))
    rows = batch.asked_rows
    assert with_peer[rows] == pytest.approx(batch.rewards[rows] + batch.discounts[rows] * PEERS_VALUE)
    others = np.setdiff1d(np.arange(len(own)), rows)
    assert len(others)
    assert np.array_equal(own[others], with_peer[others])


def test_a_terminal_is_worth_its_reward_alone(drawn: tuple[DQN, DrawnBatch]) -> None:
    agent, batch = drawn
    ends = batch.discounts == 0
    found = agent.updater.targets(batch.tensors(), NO_ANSWERS).numpy()
    assert np.array_equal(found[ends], batch.rewards[ends])
    assert not np.array_equal(found[~ends], batch.rewards[~ends])


@pytest.mark.slow
def test_a_time_out_bootstraps_and_a_hole_does_not() -> None:
    learner, _ = learner_of_dqn(60)
    replay, task = learner.replay_buffer, small_agent_task("dqn")
    rows = np.flatnonzero(replay.ended[: len(replay)])
    reader = learner.batches.reader
    returns = replay.returns(rows, replay.q[rows], reader.tables, reader.delta, task.config.learner.gamma, 1)
    kept = returns.q_next == replay.q[rows]
    timed_out = kept & ~replay.terminated[rows]
    assert timed_out.any()
    assert replay.terminated[rows].any()
    assert (returns.discount[timed_out] == task.config.learner.gamma).all()
    assert (returns.discount[replay.terminated[rows]] == 0).all()


def test_peers_in_the_process_and_elsewhere_are_told_the_target_networks_maximum() -> None:
    learner, agent = learner_of_dqn(6)
    observations, q = learner.rollout.observations, learner.rollout.q
    states = np.concatenate([observations, np.eye(small_agent_task("dqn").dfa.states, dtype=np.float32)[q]], axis=1)
    with torch.no_grad():
        expected = agent.networks.target(torch.from_numpy(states)).numpy().max(axis=1)
    assert learner.critic_values(observations, q) == pytest.approx(expected)
    published, version = learner.published.values({"observation": observations, "q": q})
    assert published == pytest.approx(expected)
    assert version == learner.version


def test_the_target_network_takes_a_step_of_tau_after_each_update(drawn: tuple[DQN, DrawnBatch]) -> None:
    _, batch = drawn
    fresh = DQN(
        initial_networks(batch.states.shape[1], 6, (16,), 5), DQNConfig(tau=0.25), "cpu", np.random.default_rng()
    )
    before = part_of(fresh.weights(), "target")
    fresh.update(batch.tensors(), NO_ANSWERS, 0.0)
    online, after = part_of(fresh.weights(), "actor"), part_of(fresh.weights(), "target")
    for name, array in before.items():
        assert not np.array_equal(online[name], array), name
        np.testing.assert_allclose(after[name], array + 0.25 * (online[name] - array), rtol=1e-5, atol=1e-7)


def test_epsilon_falls_with_the_learners_own_interactions() -> None:
    config = DQNConfig(epsilon_start=1.0, epsilon_end=0.2, epsilon_steps=100)
    assert [epsilon_after(n, config) for n in (0, 50, 100, 10**9)] == pytest.approx([1.0, 0.6, 0.2, 0.2])
    learner, agent = learner_of_dqn(3)
    assert agent.interactions == len(learner.replay_buffer) == 3 * 10 * 2


@pytest.mark.parametrize(("share", "greedy"), [(0.0, 1.0), (1.0, 0.25)])
def test_actions_are_uniform_in_a_share_of_epsilon(share: float, greedy: float) -> None:
    config = DQNConfig(epsilon_start=share, epsilon_end=share)
    agent = DQN(initial_networks(3, 4, (8,), 0), config, "cpu", np.random.default_rng(0))
    states = np.random.default_rng(1).standard_normal((4000, 3), np.float32)
    actions = agent.environment_actions(agent.act(states, np.arange(4000), np.zeros(4000, np.bool_), 0.0))
    assert (actions == agent.q_values(states).argmax(1)).mean() == pytest.approx(greedy, abs=0.03)


def test_sampled_actions_of_an_actor_are_epsilon_greedy() -> None:
    networks = initial_networks(3, 4, (8,), 0)
    actor = GreedyActor((8,), {name: tensor.numpy() for name, tensor in networks.actor.state_dict().items()})
    states = np.random.default_rng(1).standard_normal((20_000, 3), np.float32)
    other = (actor.act(states, np.random.default_rng(2)) != actor.act(states)).mean()
    assert other == pytest.approx(SAMPLED_EPSILON * 3 / 4, abs=0.006)


def test_a_learner_continues_from_its_state_bit_for_bit() -> None:
    (first, _), (second, _) = learner_of_dqn(), learner_of_dqn()
    peers = peers_valuing(PEERS_VALUE)
    for _ in range(5):
        first.iterate(peers)
    second.load_state_dict(joined(*split(copied(first.state_dict()))))
    others = peers_valuing(PEERS_VALUE)
    for _ in range(4):
        first.iterate(peers)
        second.iterate(others)
    assert others.counts.answered
    assert first.gradient_steps == second.gradient_steps > 0
    assert first.losses() == second.losses()
    one, two = (split(copied(learner.state_dict())) for learner in (first, second))
    assert one[0] == two[0]
    assert all(np.array_equal(array, two[1][name]) for name, array in one[1].items())


def test_an_exported_policy_acts_greedily(tmp_path: Path) -> None:
    learner, agent = learner_of_dqn(4)
    task, q = small_agent_task("dqn"), int(learner.rollout.q[0])
    pids = task.decomposition.pids
    folder = tmp_path / "policy"
    export_policy(folder, task, [(q, learner.pid, 1.0)], {pid: learner.weights() for pid in pids}, {})
    observations = learner.rollout.observations
    states = np.concatenate([observations, np.eye(task.dfa.states, dtype=np.float32)[[q] * len(observations)]], axis=1)
    actions, known = load(folder).actions(observations, np.full(len(observations), q, np.int32))
    assert known.all()
    assert actions.tolist() == agent.q_values(states).argmax(1).tolist()


def test_auto_does_not_choose_it_and_a_task_file_can() -> None:
    assert agent_for("discrete", "t4nmtd") == "ppo"
    assert agent_for("discrete", "crm") == "dqn"
    config = load_task("task7", flags=["learner.algorithm=dqn"])
    assert config.agent == DQNConfig()
    assert (config.learner.gamma, config.learner.attempt_steps) == (0.95, 60), "task 7 gives its own"


def test_a_replay_too_small_to_ever_learn_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"dqn\.replay_rows = 49: expected at least dqn\.learning_starts"):
        load_task("task7", flags=["dqn.replay_rows=49"])


@pytest.mark.slow
def test_the_cartpole_loop_updates_as_often_as_the_other_and_falls_are_terminal() -> None:
    cartpole = benchmark("cartpole")
    ours, theirs = cartpole.Ours(0, 700), cartpole.Theirs(0, 700)
    for agent in (ours, theirs):
        agent.train(700)
    assert ours.updates == theirs.updates == 100
    replay = ours.replay_buffer
    assert replay.terminated.any()
    assert sorted(set(ours.draw().discounts.tolist())) == pytest.approx([0.0, cartpole.GAMMA])
    assert cartpole.mean_return(ours, 2) >= 1


@pytest.mark.nightly
@pytest.mark.training
@pytest.mark.timeout(600)
def test_cartpole_is_learned_about_as_well_as_by_stable_baselines3() -> None:
    found = benchmark("cartpole").compared(15_000, [0])
    ours, theirs = found["ours"]["mean"], found["Stable-Baselines3"]["mean"]
    assert ours >= 0.8 * theirs or min(ours, theirs) >= 195
