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
from t4nmtd_dist.learners.sac_networks import Activations, Stack, StackShape, evaluate, layers_of
from t4nmtd_dist.learners.squashed_gaussian import (
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
        layer_norm: normalise the critics' hidden layers.
        hidden: widths of the hidden layers of actor and critics.
    """

    learning_rate: float = 3e-4
    tau: float = 0.005
    initial_alpha: float = 0.1
    target_entropy: float | None = None
    layer_norm: bool = True
    hidden: tuple[int, ...] = (256, 256)


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

    @classmethod
    def empty(cls, rows: int, state_size: int, action_size: int) -> SACBatch:
        """Room for a batch, to be filled by a replay buffer."""
        return cls(
            torch.zeros(rows, state_size),
            torch.zeros(rows, action_size),
            torch.zeros(rows),
            torch.zeros(rows),
            torch.zeros(rows, state_size),
        )


class _Room:
    """Buffers for the update of a batch of a given size.

    ``inputs`` [2 B, d + A] holds <s, a> above <s', a'>: its columns up to d are what the actor sees.
    """

    def __init__(self, rows: int, state_size: int, actor: StackShape, critics: StackShape) -> None:
        self.rows = rows
        self.inputs = torch.zeros(2 * rows, critics.inputs)
        self.states = self.inputs[:, :state_size]
        self.current, self.following = self.inputs[:rows], self.inputs[rows:]
        self.actor = Activations(actor, 2 * rows)
        self.critics = Activations(critics, rows)
        self.errors = torch.zeros(critics.count, 1, rows)
        self.d_outputs = torch.zeros_like(self.errors)


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
        self._room: _Room | None = None
        self._last: tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None = None

    # Acting

    @torch.no_grad()
    def act(self, states: Floats, *, deterministic: bool) -> Floats:
        """Actions [N, A] within [-1, 1] for product states [N, d]: drawn, or the mode's."""
        room = Activations(self._actor.shape, len(states))
        outputs = evaluate(self._actor.layers, torch.from_numpy(states), room)[0]
        drawn = deterministic_actions(outputs) if deterministic else self._sample(outputs).actions
        actions: Floats = drawn.t().contiguous().numpy()
        return actions

    def _sample(self, outputs: Tensor) -> SquashedSample:
        noise = torch.randn(self._action_size, outputs.shape[1], generator=self._generator)
        return squashed_sample(outputs, noise)

    @torch.no_grad()
    def soft_values(self, states: Floats) -> tuple[Floats, Floats]:
        """What a peer is asked for: min_i Q'_i(s, a) and log pi(a|s), each [N], with a drawn from the own actor."""
        rows = len(states)
        inputs = torch.empty(rows, self._state_size + self._action_size)
        inputs[:, : self._state_size] = torch.from_numpy(states)
        room = Activations(self._actor.shape, rows)
        sample = self._sample(evaluate(self._actor.layers, inputs[:, : self._state_size], room)[0])
        inputs[:, self._state_size :] = sample.actions.t()
        values = evaluate(self._targets.layers, inputs, Activations(self._targets.shape, rows))
        return values.amin(0)[0].numpy(), sample.log_probs.numpy()

    # Learning

    def update(
        self,
        batch: SACBatch,
        peer_rows: NDArray[np.int64] | None = None,
        peer_values: Floats | None = None,
        peer_log_probs: Floats | None = None,
    ) -> None:
        """One gradient step of critics, actor and entropy coefficient, and of the targets towards the critics.

        Args:
            batch: B experiences.
            peer_rows: rows [k] whose next state belongs to a peer; None for none.
            peer_values: the peers' min_i Q'_i(s', a') of those rows [k].
            peer_log_probs: the peers' log pi(a'|s') of those rows [k].
        """
        noise = torch.randn(self._action_size, 2 * len(batch.rewards), generator=self._generator)
        peers = None
        if peer_rows is not None and peer_values is not None and peer_log_probs is not None:
            peers = (torch.from_numpy(peer_rows), torch.from_numpy(peer_values), torch.from_numpy(peer_log_probs))
        self.update_with_noise(batch, noise, peers)

    @torch.no_grad()
    def update_with_noise(
        self, batch: SACBatch, noise: Tensor, peers: tuple[Tensor, Tensor, Tensor] | None = None
    ) -> None:
        """``update`` with given noise: standard normal [A, 2 B], for the actions in s and then for those in s'."""
        room = self._load(batch)
        rows = room.rows
        sample = squashed_sample(evaluate(self._actor.layers, room.states, room.actor)[0], noise)
        own = sample.first(rows)
        alpha = self._log_alpha.exp()
        self._step_alpha(own.log_probs)
        targets = self._soft_targets(batch, room, sample, alpha, peers)
        self._step_critics(room, targets)
        chosen = self._step_actor(room, own, alpha)
        self._targets.flat.lerp_(self._critics.flat, self.settings.tau)
        self._last = (room.errors, own.log_probs, chosen, alpha, targets)

    def _load(self, batch: SACBatch) -> _Room:
        rows, size = len(batch.rewards), self._state_size
        if self._room is None or self._room.rows != rows:
            self._room = _Room(rows, size, self._actor.shape, self._critics.shape)
        room = self._room
        room.current[:, :size] = batch.states
        room.current[:, size:] = batch.actions
        room.following[:, :size] = batch.next_states
        return room

    def _step_alpha(self, log_probs: Tensor) -> None:
        optimiser = self._optimisers["alpha"]
        optimiser.gradient.copy_((log_probs.mean() + self._target_entropy).neg_())
        optimiser.step()

    def _soft_targets(
        self,
        batch: SACBatch,
        room: _Room,
        sample: SquashedSample,
        alpha: Tensor,
        peers: tuple[Tensor, Tensor, Tensor] | None,
    ) -> Tensor:
        """Soft targets y [B]."""
        rows = room.rows
        room.following[:, self._state_size :] = sample.actions[:, rows:].t()
        values = evaluate(self._targets.layers, room.following, room.critics).amin(0)[0]
        log_probs = sample.log_probs[rows:]
        if peers is not None:
            values[peers[0]] = peers[1]
            log_probs[peers[0]] = peers[2]
        values.addcmul_(alpha, log_probs, value=-1.0)
        return torch.addcmul(batch.rewards, batch.discounts, values)

    def _step_critics(self, room: _Room, targets: Tensor) -> None:
        values = evaluate(self._critics.layers, room.current, room.critics)
        torch.sub(values, targets, out=room.errors)
        torch.div(room.errors, room.rows, out=room.d_outputs)
        weight_gradients(self._critics.layers, self._critic_gradients, room.current, room.critics, room.d_outputs)
        self._optimisers["critics"].step()

    def _step_actor(self, room: _Room, sample: SquashedSample, alpha: Tensor) -> Tensor:
        """Step the actor; returns min_i Q_i(s, a) of its actions [B]."""
        rows = room.rows
        room.current[:, self._state_size :] = sample.actions.t()
        chosen, choice = evaluate(self._critics.layers, room.current, room.critics)[:, 0].min(0)
        d_values = chosen_input_gradient(self._critics.layers, room.critics, choice, self._state_size)
        d_outputs = output_gradient(sample, d_values.div_(-rows), alpha / rows)
        states, activations = room.states[:rows], room.actor.first(rows)
        weight_gradients(self._actor.layers, self._actor_gradients, states, activations, d_outputs[None])
        self._optimisers["actor"].step()
        return chosen

    def losses(self) -> dict[str, float]:
        """Losses of the last update, and what they are made of; empty before the first.

        Returns:
            ``critic_loss``, ``actor_loss``, ``alpha_loss``, ``alpha`` (as used in the update), ``entropy`` (nats),
            ``value`` (mean of min_i Q_i(s, a), a from the actor) and ``target`` (mean of y).
        """
        if self._last is None:
            return {}
        errors, log_probs, chosen, alpha, targets = (tensor.double() for tensor in self._last)
        log_prob = log_probs.mean()
        return {
            "critic_loss": float(0.5 * errors.square().mean((1, 2)).sum()),
            "actor_loss": float((alpha * log_probs - chosen).mean()),
            "alpha_loss": float(-(alpha.log() * (log_prob + self._target_entropy))),
            "alpha": float(alpha),
            "entropy": float(-log_prob),
            "value": float(chosen.mean()),
            "target": float(targets.mean()),
        }

    @property
    def targets(self) -> Tensor:
        """The soft targets y of the last update [B].

        Raises:
            RuntimeError: before the first update.
        """
        if self._last is None:
            raise RuntimeError("no update yet: targets are those of the last one")
        return self._last[4]

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
