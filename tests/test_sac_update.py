"""SAC's gradient step: every hand-written gradient against autograd, and whole updates against Stable-Baselines3."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.sac.fast_cpu import matmul as products
from t4nmtd_dist.agents.sac.fast_cpu.backward import chosen_input_gradient, weight_gradients
from t4nmtd_dist.agents.sac.fast_cpu.forward import Activations, evaluate
from t4nmtd_dist.agents.sac.fast_cpu.squashed_gaussian import output_gradient, squashed_sample
from t4nmtd_dist.agents.sac.fast_cpu.update import SACUpdater
from t4nmtd_dist.agents.sac.networks import LAYER_NORM_EPSILON, Layers, Stack, flat_length, layers_of
from t4nmtd_dist.agents.sac.shapes import StackShape
from t4nmtd_dist.agents.sac.updater import PeerSoftValues, SACSettings
from t4nmtd_dist.core.errors import PolicyError

torch.set_num_threads(1)  # a second thread waits for the other tests' processes

DOUBLE = torch.float64
SMALL = SACSettings(hidden=(16, 12), layer_norm=True)


def plain_evaluation(layers: Layers, inputs: Tensor) -> Tensor:
    """A stack in plain torch, for autograd: [n, outputs, rows] for inputs [rows, d] or [n, rows, d]."""
    outputs = []
    for n in range(len(layers.head_bias)):
        hidden = inputs if inputs.dim() == 2 else inputs[n]
        for layer in layers.hidden:
            hidden = hidden @ layer.weight[n] + layer.bias[n]
            if layer.gain is not None and layer.shift is not None:
                width = (hidden.shape[1],)
                hidden = functional.layer_norm(hidden, width, layer.gain[n], layer.shift[n], LAYER_NORM_EPSILON)
            hidden = hidden.relu()
        outputs.append((hidden @ layers.head_weight[n].t() + layers.head_bias[n, :, 0]).t())
    return torch.stack(outputs)


def random_stack(shape: StackShape, seed: int) -> Stack:
    stack = Stack(shape, torch.Generator().manual_seed(seed), dtype=DOUBLE)
    stack.flat += 0.1 * torch.randn(len(stack.flat), dtype=DOUBLE, generator=torch.Generator().manual_seed(seed + 1))
    return stack


def draw(seed: int, *size: int) -> Tensor:
    return torch.randn(*size, dtype=DOUBLE, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(params=["torch", "numpy"], autouse=True, scope="module")
def _library(request: pytest.FixtureRequest) -> Iterator[None]:
    """Everything holds for both libraries that may multiply."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(products, "through_numpy", request.param == "numpy")
        yield


shapes = st.builds(
    StackShape,
    count=st.integers(1, 3),
    inputs=st.integers(2, 9),
    hidden=st.lists(st.integers(2, 20), min_size=1, max_size=3).map(tuple),
    outputs=st.integers(1, 5),
    layer_norm=st.booleans(),
)
seeds = st.integers(0, 2**20)
rows = st.integers(1, 9)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(shapes, rows, seeds)
def test_evaluation_and_weight_gradients_are_those_of_autograd(shape: StackShape, rows: int, seed: int) -> None:
    stack, inputs = random_stack(shape, seed), draw(seed, rows, shape.inputs)
    workspace, d_outputs = Activations(shape, rows, dtype=DOUBLE), draw(seed + 2, shape.count, shape.outputs, rows)
    flat = stack.flat.clone().requires_grad_()
    expected = plain_evaluation(layers_of(flat, shape), inputs)
    torch.testing.assert_close(evaluate(stack.layers, inputs, workspace), expected)
    expected.backward(d_outputs)  # type: ignore[no-untyped-call]
    found = torch.zeros(flat_length(shape), dtype=DOUBLE)
    weight_gradients(stack.layers, layers_of(found, shape), inputs, workspace, d_outputs)
    torch.testing.assert_close(found, flat.grad)


@settings(max_examples=60, deadline=None)
@given(shapes, rows, seeds, st.data())
def test_the_gradient_of_the_actions_goes_through_the_chosen_critic_of_each_row(
    shape: StackShape, rows: int, seed: int, data: st.DataObject
) -> None:
    shape = StackShape(shape.count, shape.inputs, shape.hidden, 1, shape.layer_norm)
    first = data.draw(st.integers(0, shape.inputs - 1))
    choice = torch.tensor(data.draw(st.lists(st.integers(0, shape.count - 1), min_size=rows, max_size=rows)))
    stack, inputs = random_stack(shape, seed), draw(seed, rows, shape.inputs).requires_grad_()
    chosen = plain_evaluation(stack.layers, inputs)[:, 0].gather(0, choice[None])
    chosen.sum().backward()  # type: ignore[no-untyped-call]
    assert inputs.grad is not None
    workspace = Activations(shape, rows, dtype=DOUBLE)
    evaluate(stack.layers, inputs.detach(), workspace)
    found = chosen_input_gradient(stack.layers, workspace, choice.numpy(), first)
    torch.testing.assert_close(torch.from_numpy(found), inputs.grad[:, first:].t())


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 6), rows, seeds, st.sampled_from([0.3, 3.0, 15.0]))
def test_the_policy_and_its_gradient_are_those_of_torch_distributions(
    actions: int, rows: int, seed: int, spread: float
) -> None:
    outputs = (draw(seed, 2 * actions, rows) * spread).requires_grad_()
    noise, d_actions = draw(seed + 1, actions, rows), draw(seed + 2, actions, rows)
    normal = torch.distributions.Normal(outputs[:actions], outputs[actions:].clamp(-20, 2).exp())
    unsquashed = normal.loc + normal.scale * noise
    log_probs = normal.log_prob(unsquashed) - torch.log(1 - unsquashed.tanh() ** 2 + 1e-6)
    found = squashed_sample(outputs.detach().numpy(), noise.numpy())
    np.testing.assert_allclose(found.actions, unsquashed.detach().tanh().numpy(), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.log_probs, log_probs.sum(0).detach().numpy(), rtol=1e-6, atol=1e-6)
    (unsquashed.tanh() * d_actions).sum().add(0.7 * log_probs.sum()).backward()
    assert outputs.grad is not None
    gradient = output_gradient(found, d_actions.numpy(), 0.7)
    np.testing.assert_allclose(gradient, outputs.grad.numpy(), rtol=1e-6, atol=1e-6)


def test_adam_is_torchs_adam() -> None:
    mine, theirs = torch.linspace(-1, 1, 40), torch.linspace(-1, 1, 40).requires_grad_()
    adam, reference = FlatAdam(mine, 0.01), torch.optim.Adam([theirs], lr=0.01)
    for step in range(20):
        adam.gradient.copy_(torch.sin(torch.arange(40.0) * (step + 1)))
        theirs.grad = adam.gradient.clone()
        adam.step()
        reference.step()
    torch.testing.assert_close(mine, theirs.detach())


# Whole updates


def random_batch(rows: int, states: int, actions: int, seed: int = 3) -> Batch:
    sizes = ((rows, states), (rows, actions), (rows,), (rows,), (rows, states))
    batch, generator = Batch(*map(torch.zeros, sizes)), torch.Generator().manual_seed(seed)
    batch.states.normal_(generator=generator)
    batch.next_states.normal_(generator=generator)
    batch.actions.uniform_(-1, 1, generator=generator)
    batch.rewards.normal_(generator=generator)
    batch.discounts.fill_(0.97)
    batch.discounts[:: max(1, rows // 5)] = 0.0
    return batch


class _Space(gymnasium.Env[np.ndarray, np.ndarray]):
    """Only the spaces matter: Stable-Baselines3 asks for an environment to build its networks."""

    def __init__(self, states: int, actions: int) -> None:
        self.observation_space = gymnasium.spaces.Box(-5, 5, (states,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (actions,), np.float32)

    def reset(self, **_: object) -> tuple[np.ndarray, dict[str, object]]:  # type: ignore[override]
        return np.zeros(self.observation_space.shape or (), np.float32), {}


class StableBaselines:
    """Stable-Baselines3's SAC with the weights of an updater, trained on one batch with given noise."""

    def __init__(self, updater: SACUpdater, states: int, actions: int, hidden: tuple[int, ...]) -> None:
        sb3 = pytest.importorskip("stable_baselines3")
        logger = pytest.importorskip("stable_baselines3.common.logger")
        kwargs = {"net_arch": list(hidden)}
        self.sac = sb3.SAC(
            "MlpPolicy",
            _Space(states, actions),
            learning_rate=updater.settings.learning_rate,
            policy_kwargs=kwargs,
            ent_coef="auto_0.1",
            buffer_size=1,
            device="cpu",
        )
        self.sac.set_logger(logger.Logger(None, []))
        self._put(updater.weights())

    def _linears(self) -> dict[str, torch.nn.Module]:
        policy, named = self.sac.policy, {}
        for part, networks in (("critics", policy.critic.q_networks), ("targets", policy.critic_target.q_networks)):
            for n, network in enumerate(networks):
                *hidden, head = [module for module in network if isinstance(module, torch.nn.Linear)]
                named |= {f"{part}.{i}/{n}": layer for i, layer in enumerate(hidden)} | {f"{part}.head/{n}": head}
        hidden = [module for module in policy.actor.latent_pi if isinstance(module, torch.nn.Linear)]
        return named | {f"actor.{i}/0": layer for i, layer in enumerate(hidden)}

    @torch.no_grad()
    def _put(self, weights: dict[str, np.ndarray]) -> None:
        for name, parameter, array in self.pairs(weights):
            assert parameter.shape == array.shape, name
            parameter.copy_(torch.from_numpy(array.copy()))

    def pairs(self, weights: dict[str, np.ndarray]) -> list[tuple[str, Tensor, np.ndarray]]:
        """Their parameters beside ours."""
        pairs: list[tuple[str, Tensor, np.ndarray]] = []
        for key, layer in self._linears().items():
            name, n = key.split("/")
            weight, bias = weights[f"{name}.weight"][int(n)], weights[f"{name}.bias"][int(n)]
            weight = weight if name.endswith("head") else weight.T
            pairs += [(f"{key} weight", layer.weight, weight), (f"{key} bias", layer.bias, bias.ravel())]  # type: ignore[list-item]
        actor, size = self.sac.policy.actor, len(self.sac.policy.actor.mu.bias)
        head, bias = weights["actor.head.weight"][0], weights["actor.head.bias"][0, :, 0]
        pairs += [("mu", actor.mu.weight, head[:size]), ("mu bias", actor.mu.bias, bias[:size])]
        pairs += [("std", actor.log_std.weight, head[size:]), ("std bias", actor.log_std.bias, bias[size:])]
        return [*pairs, ("log_alpha", self.sac.log_ent_coef, weights["log_alpha"])]

    def train(self, batch: Batch, noise: Tensor, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
        """One update; returns its losses."""
        from stable_baselines3.common.type_aliases import ReplayBufferSamples

        rows, drawn = len(batch.rewards), iter(noise.split(len(batch.rewards), 1))
        samples = ReplayBufferSamples(
            batch.states, batch.actions, batch.next_states, torch.zeros(rows, 1), batch.rewards[:, None],
            batch.discounts[:, None],
        )  # fmt: skip
        monkeypatch.setattr(self.sac.replay_buffer, "sample", lambda *_, **__: samples)
        monkeypatch.setattr(
            torch.distributions.Normal, "rsample", lambda self, shape=None: self.loc + self.scale * next(drawn).t()
        )
        self.sac.train(1, rows)
        logged = self.sac.logger.name_to_value
        return {name: logged[f"train/{theirs}"] for name, theirs in LOSSES.items()}


LOSSES = {"critic_loss": "critic_loss", "actor_loss": "actor_loss", "alpha_loss": "ent_coef_loss", "alpha": "ent_coef"}


@pytest.mark.parametrize(("actions", "hidden"), [(2, (64, 64)), (6, (48, 32, 16))])
def test_updates_are_those_of_stable_baselines(
    actions: int, hidden: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    # Adam turns rounding of the tiniest gradients into steps of the learning rate: a small one keeps them below 1e-5.
    chosen = SACSettings(learning_rate=5e-5, hidden=hidden, layer_norm=False)
    updater = SACUpdater(11, actions, chosen, seed=0)
    theirs = StableBaselines(updater, 11, actions, hidden)
    for step in range(5):
        batch = random_batch(32, 11, actions, step)
        noise = torch.randn(actions, 64, generator=torch.Generator().manual_seed(step))
        updater.update_with_noise(batch, noise.numpy())
        expected = theirs.train(batch, noise, monkeypatch)
        mine = updater.losses()
        assert {name: mine[name] for name in LOSSES} == pytest.approx(expected, rel=1e-5, abs=1e-5)
    for name, parameter, array in theirs.pairs(updater.weights()):
        np.testing.assert_allclose(array, parameter.detach().numpy(), rtol=1e-5, atol=1e-5, err_msg=name)


def test_rows_of_peers_take_their_values_and_the_own_entropy_coefficient() -> None:
    updater, batch = SACUpdater(5, 2, SMALL, seed=1), random_batch(8, 5, 2)
    values, log_probs = np.array([3.0, -2.0], np.float32), np.array([0.5, 1.5], np.float32)
    own = SACUpdater(5, 2, SMALL, seed=1)
    updater.update(batch, PeerSoftValues(np.array([2, 6]), values, log_probs))
    own.update(batch)
    expected = own.targets.copy()
    expected[[2, 6]] = batch.rewards.numpy()[[2, 6]] + batch.discounts.numpy()[[2, 6]] * (values - 0.1 * log_probs)
    np.testing.assert_allclose(updater.targets, expected, rtol=1e-6)


def test_a_terminal_row_takes_nothing_from_a_peer() -> None:
    updater, batch = SACUpdater(5, 2, SMALL, seed=1), random_batch(8, 5, 2)
    batch.discounts[3] = 0.0
    updater.update(batch, PeerSoftValues(np.array([3]), np.array([1e6], np.float32), np.array([1e3], np.float32)))
    assert updater.targets[3] == batch.rewards[3]


def test_soft_values_are_the_smaller_target_critic_of_an_action_drawn_by_the_actor() -> None:
    updater = SACUpdater(5, 2, SMALL, seed=1)
    for step in range(3):
        updater.update(random_batch(8, 5, 2, step))
    states = random_batch(20, 5, 2).states
    state, weights = updater.optimiser_state(), updater.weights()
    values, log_probs = updater.soft_values(states.numpy())
    updater.load_optimiser_state(state)
    actions = updater.act(states.numpy(), deterministic=False)
    target = Stack(StackShape(2, 7, SMALL.hidden, 1, SMALL.layer_norm))
    target.load({name[8:]: array for name, array in weights.items() if name.startswith("targets.")})
    expected = plain_evaluation(target.layers, torch.cat((states, torch.from_numpy(actions)), 1)).amin(0)[0]
    np.testing.assert_allclose(values, expected.numpy(), rtol=1e-5, atol=1e-6)
    assert log_probs.shape == (20,)
    assert np.isfinite(log_probs).all()


def test_what_was_asked_before_does_not_change_actions() -> None:
    updater, states = SACUpdater(5, 2, SMALL, seed=1), random_batch(9, 5, 2).states.numpy()
    together = updater.act(states, deterministic=True)
    apart = [updater.act(states[first:last], deterministic=True) for first, last in ((0, 2), (2, 3), (3, 9))]
    np.testing.assert_allclose(np.concatenate(apart), together, rtol=1e-5, atol=1e-7)


def test_actions_lie_within_bounds_and_the_deterministic_one_is_the_mode() -> None:
    updater, states = SACUpdater(5, 2, SMALL, seed=1), np.full((2000, 5), 0.3, np.float32)
    mode, drawn = updater.act(states, deterministic=True), updater.act(states, deterministic=False)
    assert (np.abs(drawn) <= 1).all()
    np.testing.assert_allclose(mode, np.broadcast_to(mode[0], mode.shape), rtol=1e-5)
    np.testing.assert_allclose(np.median(drawn, axis=0), mode[0], atol=0.1)


def test_the_targets_follow_the_critics_by_tau() -> None:
    updater = SACUpdater(5, 2, SMALL, seed=1)
    before = updater.weights()
    updater.update(random_batch(8, 5, 2))
    after = updater.weights()
    for name in (name for name in before if name.startswith("targets.")):
        moved = 0.995 * before[name] + 0.005 * after[name.replace("targets", "critics")]
        np.testing.assert_allclose(after[name], moved, atol=1e-7)


def test_a_resumed_updater_goes_on_bit_for_bit() -> None:
    updater, resumed = SACUpdater(5, 2, SMALL, seed=1), SACUpdater(5, 2, SMALL, seed=2)
    for step in range(4):
        updater.update(random_batch(8, 5, 2, step))
    resumed.load(updater.weights())
    resumed.load_optimiser_state(updater.optimiser_state())
    for each in (updater, resumed):
        each.act(np.zeros((3, 5), np.float32), deterministic=False)
        each.update(random_batch(8, 5, 2, 9))
    after = resumed.weights()
    assert all((array == after[name]).all() for name, array in updater.weights().items())


def test_the_actor_is_updated_as_rarely_as_is_asked_for_across_a_resume_too() -> None:
    chosen = dataclasses.replace(SMALL, actor_every=3, actor_average=0.3)
    parts = ("actor.0.weight", "average.0.weight", "log_alpha")
    updater, changes = SACUpdater(5, 2, chosen, seed=1), []
    for step in range(8):
        before = updater.weights()
        updater.update(random_batch(8, 5, 2, step))
        after, resumed = updater.weights(), SACUpdater(5, 2, chosen, seed=2)
        changes.append({part: (before[part] != after[part]).any() for part in parts})
        assert (before["critics.0.weight"] != after["critics.0.weight"]).any()
        resumed.load(after)
        resumed.load_optimiser_state(updater.optimiser_state())
        updater = resumed
    assert changes == [dict.fromkeys(parts, step % 3 == 0) for step in range(8)]


@pytest.mark.parametrize("share", [0.3, 1.0])
@pytest.mark.parametrize("every", [1, 2])
def test_the_average_is_a_mean_of_the_first_actors_and_then_follows_them(share: float, every: int) -> None:
    updater = SACUpdater(5, 2, dataclasses.replace(SMALL, actor_average=share, actor_every=every), seed=1)
    actors = []
    for step in range(6 * every):
        updater.update(random_batch(8, 5, 2, step))
        if step % every == 0:
            actors.append(updater.weights()["actor.0.weight"])
    expected = np.mean(actors[:3], axis=0) if share < 1.0 else actors[2]
    for actor in actors[3:]:
        expected = (1 - share) * expected + share * actor
    np.testing.assert_allclose(updater.weights()["average.0.weight"], expected, atol=1e-6)


def test_an_average_that_came_with_weights_is_gone_on_from() -> None:
    settings = dataclasses.replace(SMALL, actor_average=0.01)
    old, new = SACUpdater(5, 2, settings, seed=1), SACUpdater(5, 2, settings, seed=2)
    for step in range(30):
        old.update(random_batch(8, 5, 2, step))
    before = old.weights()
    new.load(before)
    new.update(random_batch(8, 5, 2, 31))
    after = new.weights()
    expected = 0.99 * before["average.0.weight"] + 0.01 * after["actor.0.weight"]
    np.testing.assert_allclose(after["average.0.weight"], expected, atol=1e-7)
    assert np.abs(before["average.0.weight"] - before["actor.0.weight"]).max() > 1e-3, "or there was nothing to lose"


def test_updates_without_the_actor_move_the_critics_as_updates_with_it_do() -> None:
    batch, noise = random_batch(8, 5, 2), np.random.default_rng(0).standard_normal((2, 16), np.float32)
    both, rarely = (SACUpdater(5, 2, dataclasses.replace(SMALL, actor_every=every), seed=1) for every in (1, 2))
    for updater in (both, rarely):
        updater.update_with_noise(batch, noise)
    rarely.load({**both.weights()})
    for updater in (both, rarely):
        updater.update_with_noise(batch, noise)
    np.testing.assert_allclose(rarely.weights()["critics.1.weight"], both.weights()["critics.1.weight"], atol=1e-6)


def test_batches_may_change_their_size() -> None:
    updater = SACUpdater(5, 2, SMALL, seed=1)
    for size in (8, 3, 8, 1):
        updater.update(random_batch(size, 5, 2))
        assert all(math.isfinite(loss) for loss in updater.losses().values())


def test_weights_of_another_shape_are_refused_by_name() -> None:
    updater = SACUpdater(5, 2, SMALL, seed=1)
    with pytest.raises(PolicyError, match=r"0\.weight"):
        updater.load(SACUpdater(6, 2, SMALL, seed=1).weights())


@pytest.mark.slow
@pytest.mark.parametrize("layer_norm", [False, True])
def test_critics_learn_the_rewards_of_a_batch_of_terminals(layer_norm: bool) -> None:
    chosen = SACSettings(learning_rate=3e-3, hidden=(32, 32), layer_norm=layer_norm)
    updater, batch = SACUpdater(5, 2, chosen, seed=1), random_batch(64, 5, 2)
    batch.discounts.zero_()
    updater.update(batch)
    first = updater.losses()["critic_loss"]
    for _ in range(300):
        updater.update(batch)
    assert updater.losses()["critic_loss"] < 0.02 * first


@given(st.floats(1e-4, 2.0), st.floats(0.0, 2.0))
def test_the_entropy_coefficient_is_raised_to_a_floor_and_never_lowered(initial: float, floor: float) -> None:
    updater = SACUpdater(3, 2, dataclasses.replace(SMALL, initial_alpha=initial), seed=0)
    updater.keep_alpha_above(floor)
    assert math.exp(updater.weights()["log_alpha"][0]) == pytest.approx(max(initial, floor), rel=1e-5)


@given(st.floats(0.1, 1.0))
def test_a_step_is_as_long_as_the_learning_rate_says(factor: float) -> None:
    """Adam's first step changes every weight by the learning rate, whatever the gradient."""
    full, less = (SACUpdater(5, 2, dataclasses.replace(SMALL, learning_rate=0.01), seed=1) for _ in range(2))
    before, batch = full.weights(), random_batch(16, 5, 2)
    less.scale_learning_rate(factor)
    for updater in (full, less):
        updater.update_with_noise(batch, np.zeros((2, 32), np.float32))
    for name in ("critics.head.bias", "log_alpha"):  # the gradient of the actor follows the critics
        steps = [updater.weights()[name] - before[name] for updater in (full, less)]
        assert np.abs(steps[0]).max() > 1e-3
        np.testing.assert_allclose(steps[1], factor * steps[0], rtol=1e-3, atol=1e-6)
