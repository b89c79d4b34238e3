"""One gradient step of soft actor-critic (Haarnoja et al., 2018), with the peer's soft value in its target.

The losses are those of Stable-Baselines3's SAC; the gradients are written by hand and tested against autograd. In the
symbols of the paper: y = r + discount * (min_i Q'_i(s', a') - alpha * log pi(a'|s')), where for experiences that cross
a sub-task boundary min Q' and log pi come from the peer (T4NMTD, Algorithm 2, line 12) and alpha is the own one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from t4nmtd_dist.errors import PolicyError
from t4nmtd_dist.learners.flat_adam import FlatAdam
from t4nmtd_dist.learners.networks import Weights
from t4nmtd_dist.learners.sac_backward import chosen_input_gradient, weight_gradients
from t4nmtd_dist.learners.sac_networks import Activations, GrowingRoom, Stack, StackShape, evaluate, layers_of
from t4nmtd_dist.learners.squashed_gaussian import (
    Reals,
    SquashedSample,
    deterministic_actions,
    output_gradient,
    squashed_sample,
)

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class SACSettings:
    """Settings of a SAC learner's gradient step; the defaults are Stable-Baselines3's unless noted.

    Attributes:
        learning_rate: of the three optimisers.
        tau: share of the critics that enters their targets at every step.
        initial_alpha: entropy coefficient to begin with; 0.1 rather than 1, which would dwarf a sparse reward.
        target_entropy: nats per action; None for minus the number of action dimensions.
        actor_every: updates of the critics for one of actor and entropy coefficient; 1 as usual, more where critics
            need many updates per interaction and the actor does not (Chen et al., 2021: REDQ).
        layer_norm: normalise the critics' hidden layers.
        hidden: widths of the hidden layers of actor and critics.
    """

    learning_rate: float = 3e-4
    tau: float = 0.005
    initial_alpha: float = 0.1
    target_entropy: float | None = None
    actor_every: int = 1
    layer_norm: bool = True
    hidden: tuple[int, ...] = (256, 256)


@dataclass(frozen=True)
class PeerSoftValues:
    """Peers' answers for some rows of a batch.

    Attributes:
        rows: which rows of the batch [k].
        values: min_i Q'_i(s', a') of the peers' target critics, a' drawn from the peers' actors [k].
        log_probs: log pi(a'|s') of the peers' actors [k].
    """

    rows: NDArray[np.int64]
    values: Floats
    log_probs: Floats


@dataclass
class SACBatch:
    """Experiences, float32: what one gradient step learns from.

    Attributes:
        states: product states [B, d].
        actions: actions within [-1, 1] [B, A].
        rewards: sums of the discounted scaled rewards of the n steps [B].
        discounts: gamma**n, or 0 where the experience ends in a terminal [B].
        next_states: product states n steps later [B, d].
    """

    states: Tensor
    actions: Tensor
    rewards: Tensor
    discounts: Tensor
    next_states: Tensor


class _Room:
    """Buffers for the update of a batch of a given size; names ending in ``array`` are numpy views of tensors.

    ``inputs`` [2 B, d + A] holds <s, a> above <s', a'>: its columns up to d are what the actor sees.
    """

    def __init__(self, rows: int, state_size: int, actor: StackShape, critics: StackShape) -> None:
        self.rows = rows
        self.inputs = torch.zeros(2 * rows, critics.inputs)
        self.states = self.inputs[:, :state_size]
        self.current, self.following = self.inputs[:rows], self.inputs[rows:]
        self.current_array: Floats = self.current.numpy()
        self.following_array: Floats = self.following.numpy()
        self.actor = Activations(actor, 2 * rows)
        self.critics = Activations(critics, rows)
        self.values_array: Floats = self.critics.outputs[:, 0].numpy()
        self.d_values = torch.zeros(critics.count, 1, rows)
        self.d_values_array: Floats = self.d_values[:, 0].numpy()


@dataclass(frozen=True)
class _LastUpdate:
    """What losses are computed from when somebody asks."""

    errors: Reals
    targets: Reals
    log_probs: Reals
    values: Reals
    alpha: float


class SACUpdater:
    """Actor, twin critics, their targets and the entropy coefficient of one sub-task, and how a batch changes them.

    Args:
        state_size: d, the length of a product state.
        action_size: A.
        settings: learning rates and sizes.
        seed: seeds weights and noise.
    """

    def __init__(self, state_size: int, action_size: int, settings: SACSettings, seed: int) -> None:
        self.settings = settings
        self._state_size, self._action_size = state_size, action_size
        self._generator = torch.Generator().manual_seed(seed)
        actor = StackShape(1, state_size, settings.hidden, 2 * action_size, layer_norm=False)
        critics = StackShape(2, state_size + action_size, settings.hidden, 1, layer_norm=settings.layer_norm)
        self._actor, self._critics = Stack(actor, self._generator), Stack(critics, self._generator)
        self._targets = Stack(critics)
        self._targets.flat.copy_(self._critics.flat)
        self._log_alpha = torch.full((1,), math.log(settings.initial_alpha))
        self._log_alpha_array: Floats = self._log_alpha.numpy()
        rate = settings.learning_rate
        self._optimisers = {
            "actor": FlatAdam(self._actor.flat, rate),
            "critics": FlatAdam(self._critics.flat, rate),
            "alpha": FlatAdam(self._log_alpha, rate),
        }
        self._actor_gradients = layers_of(self._optimisers["actor"].gradient, actor)
        self._critic_gradients = layers_of(self._optimisers["critics"].gradient, critics)
        entropy = settings.target_entropy
        self._target_entropy = -float(action_size) if entropy is None else entropy
        self._acting_room, self._valuing_room = GrowingRoom(actor), GrowingRoom(critics)
        self._room: _Room | None = None
        self._last: _LastUpdate | None = None

    # Acting

    @torch.no_grad()
    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """Actions [N, A] within [-1, 1] for product states [N, d]: drawn, or the mode's."""
        outputs = self._actor_outputs(torch.from_numpy(states))
        drawn = deterministic_actions(outputs) if deterministic else self._sample(outputs).actions
        return np.ascontiguousarray(drawn.T, np.float32)

    def _actor_outputs(self, states: Tensor) -> Reals:
        outputs: Reals = evaluate(self._actor.layers, states, self._acting_room.of(len(states)))[0].numpy()
        return outputs

    def _sample(self, outputs: Reals) -> SquashedSample:
        return squashed_sample(outputs, self._noise(outputs.shape[1]))

    def _noise(self, rows: int) -> Floats:
        noise: Floats = torch.randn(self._action_size, rows, generator=self._generator).numpy()
        return noise

    @torch.no_grad()
    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """What a peer is asked for: min_i Q'_i(s, a) and log pi(a|s), each [N], with a drawn from the own actor."""
        inputs = torch.empty(len(states), self._state_size + self._action_size)
        inputs[:, : self._state_size] = torch.from_numpy(states)
        sample = self._sample(self._actor_outputs(inputs[:, : self._state_size]))
        inputs[:, self._state_size :] = torch.from_numpy(sample.actions.T)
        values = evaluate(self._targets.layers, inputs, self._valuing_room.of(len(states)))[:, 0].numpy()
        return values.min(0), sample.log_probs.astype(np.float32, copy=False)

    # Learning

    def update(self, batch: SACBatch, peers: PeerSoftValues | None = None) -> None:
        """One gradient step of critics, actor and entropy coefficient, and of the targets towards the critics.

        Args:
            batch: B experiences.
            peers: the soft values of rows whose next state belongs to a peer; None for none.
        """
        self.update_with_noise(batch, self._noise(2 * len(batch.rewards)), peers)

    @torch.no_grad()
    def update_with_noise(self, batch: SACBatch, noise: Floats, peers: PeerSoftValues | None = None) -> None:
        """``update`` with given noise: standard normal [A, 2 B], for the actions in s and then for those in s'."""
        room = self._load(batch)
        alpha = math.exp(self._log_alpha_array[0])
        if self._optimisers["critics"].steps % self.settings.actor_every:
            following = self._sample_from(room, noise, slice(room.rows, None))
            targets = self._soft_targets(batch, room, following, alpha, peers)
            self._step_critics(room, targets)
        else:
            sample = self._sample_from(room, noise, slice(None))
            own = sample.part(slice(room.rows))
            self._step_alpha(own.log_probs)
            targets = self._soft_targets(batch, room, sample.part(slice(room.rows, None)), alpha, peers)
            errors = self._step_critics(room, targets)
            values = self._step_actor(room, own, alpha)
            self._last = _LastUpdate(errors, targets, own.log_probs, values, alpha)
        self._targets.flat.lerp_(self._critics.flat, self.settings.tau)

    def _sample_from(self, room: _Room, noise: Floats, rows: slice) -> SquashedSample:
        states = room.states[rows]
        outputs = evaluate(self._actor.layers, states, room.actor.first(len(states)))
        return squashed_sample(outputs[0].numpy(), noise[:, rows])

    def _load(self, batch: SACBatch) -> _Room:
        rows, size = len(batch.rewards), self._state_size
        if self._room is None or self._room.rows != rows:
            self._room = _Room(rows, size, self._actor.shape, self._critics.shape)
        room = self._room
        room.current_array[:, :size] = batch.states.numpy()
        room.current_array[:, size:] = batch.actions.numpy()
        room.following_array[:, :size] = batch.next_states.numpy()
        return room

    def _step_alpha(self, log_probs: Reals) -> None:
        optimiser = self._optimisers["alpha"]
        optimiser.gradient.fill_(-float(log_probs.mean()) - self._target_entropy)
        optimiser.step()

    def _soft_targets(
        self, batch: SACBatch, room: _Room, following: SquashedSample, alpha: float, peers: PeerSoftValues | None
    ) -> Reals:
        """Soft targets y [B]."""
        room.following_array[:, self._state_size :] = following.actions.T
        evaluate(self._targets.layers, room.following, room.critics)
        values: Reals = room.values_array.min(0)
        log_probs = following.log_probs
        if peers is not None:
            values[peers.rows], log_probs[peers.rows] = peers.values, peers.log_probs
        values -= alpha * log_probs
        values *= batch.discounts.numpy()
        values += batch.rewards.numpy()
        return values

    def _step_critics(self, room: _Room, targets: Reals) -> Reals:
        """Step the critics; returns their errors Q_i - y [2, B]."""
        evaluate(self._critics.layers, room.current, room.critics)
        errors: Reals = room.values_array - targets
        np.divide(errors, room.rows, out=room.d_values_array)
        weight_gradients(self._critics.layers, self._critic_gradients, room.current, room.critics, room.d_values)
        self._optimisers["critics"].step()
        return errors

    def _step_actor(self, room: _Room, sample: SquashedSample, alpha: float) -> Reals:
        """Step the actor; returns min_i Q_i(s, a) of its actions [B]."""
        rows, layers = room.rows, self._critics.layers
        room.current_array[:, self._state_size :] = sample.actions.T
        evaluate(layers, room.current, room.critics)
        d_actions = chosen_input_gradient(layers, room.critics, room.values_array.argmin(0), self._state_size)
        d_actions /= -rows
        d_outputs = torch.from_numpy(output_gradient(sample, d_actions, alpha / rows))[None]
        states, activations = room.states[:rows], room.actor.first(rows)
        weight_gradients(self._actor.layers, self._actor_gradients, states, activations, d_outputs)
        self._optimisers["actor"].step()
        values: Reals = room.values_array.min(0)
        return values

    def keep_alpha_above(self, floor: float) -> None:
        """Raise the entropy coefficient to ``floor`` if it has fallen below."""
        if floor > 0.0:
            self._log_alpha.clamp_(min=math.log(floor))

    def losses(self) -> dict[str, float]:
        """Losses of the last update of critics and actor, and what they are made of; empty before the first.

        Returns:
            ``critic_loss``, ``actor_loss``, ``alpha_loss``, ``alpha`` (as used in the update), ``entropy`` (nats),
            ``value`` (mean of min_i Q_i(s, a), a from the actor) and ``target`` (mean of y).
        """
        last = self._last
        if last is None:
            return {}
        log_prob = float(last.log_probs.mean())
        return {
            "critic_loss": float(0.5 * np.square(last.errors).mean(1).sum()),
            "actor_loss": float((last.alpha * last.log_probs - last.values).mean()),
            "alpha_loss": -math.log(last.alpha) * (log_prob + self._target_entropy),
            "alpha": last.alpha,
            "entropy": -log_prob,
            "value": float(last.values.mean()),
            "target": float(last.targets.mean()),
        }

    @property
    def targets(self) -> Reals:
        """The soft targets y of the last update of critics and actor [B].

        Raises:
            RuntimeError: before the first update.
        """
        if self._last is None:
            raise RuntimeError("no update yet: targets are those of the last one")
        return self._last.targets

    # State

    def _stacks(self) -> dict[str, Stack]:
        return {"actor": self._actor, "critics": self._critics, "targets": self._targets}

    def weights(self) -> Weights:
        """Copies of everything learned: ``actor.*``, ``critics.*``, ``targets.*`` and ``log_alpha`` [1]."""
        named = {
            f"{part}.{name}": array for part, stack in self._stacks().items() for name, array in stack.weights().items()
        }
        return named | {"log_alpha": self._log_alpha.numpy().copy()}

    def load(self, weights: Mapping[str, NDArray[Any]]) -> None:
        """Put arrays from ``weights`` into the networks.

        Raises:
            PolicyError: if names or shapes differ.
        """
        if "log_alpha" not in weights:
            raise PolicyError("weights do not fit a SAC learner: log_alpha is missing")
        for part, stack in self._stacks().items():
            stack.load(part_of(weights, part))
        self._log_alpha.copy_(torch.from_numpy(np.asarray(weights["log_alpha"])))

    def optimiser_state(self) -> Weights:
        """Copies of the optimisers' moments and steps and of the noise generator's state, for an exact resume."""
        named = {
            f"{part}.{name}": array
            for part, optimiser in self._optimisers.items()
            for name, array in optimiser.state().items()
        }
        return named | {"generator": self._generator.get_state().numpy().copy()}

    def load_optimiser_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from an ``optimiser_state``."""
        for part, optimiser in self._optimisers.items():
            optimiser.load_state(part_of(state, part))
        self._generator.set_state(torch.from_numpy(np.asarray(state["generator"], np.uint8)))


def part_of(arrays: Mapping[str, NDArray[Any]], part: str) -> Weights:
    """The arrays named ``part.*``, without that prefix."""
    prefix = part + "."
    return {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
