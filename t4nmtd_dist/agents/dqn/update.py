"""DQN's gradient step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from t4nmtd_dist.agents.common.batches import Batch
from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.common.peer_values import PeerValues
from t4nmtd_dist.agents.dqn.config import DQNConfig
from t4nmtd_dist.agents.dqn.losses import double_q_target, q_loss
from t4nmtd_dist.agents.dqn.networks import QNetworks


class DQNUpdate:
    """Performs DQN's gradient steps.

    Attributes:
        loss: Huber loss of the last step, on the device; None before the first.
    """

    def __init__(self, networks: QNetworks, config: DQNConfig, device: str) -> None:
        self._networks, self._config, self._device = networks, config, device
        self._optimiser = FlatAdam.of_module(networks.actor, config.learning_rate)
        self.loss: Tensor | None = None

    def step(self, batch: Batch, answers: PeerValues) -> None:
        """One gradient step of Q, and a Polyak step of Q' towards it.

        Args:
            batch: B transitions, on the CPU.
            answers: peers' max_a Q'(s', a) for some rows.
        """
        states, actions = batch.states.to(self._device), batch.actions.to(self._device).long()
        loss = q_loss(self._networks.actor(states), actions, self.targets(batch, answers))
        self._optimiser.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._networks.actor.parameters(), self._config.max_grad_norm)
        self._optimiser.step()
        self._move_target()
        self.loss = loss.detach()

    @torch.no_grad()
    def targets(self, batch: Batch, answers: PeerValues) -> Tensor:
        """Targets of Q(s, a), on the device [B]; arguments as for ``step``."""
        columns = (batch.rewards, batch.discounts, batch.next_states, *_by_row(answers, len(batch.rewards)))
        rewards, discounts, next_states, peer_values, answered = (each.to(self._device) for each in columns)
        next_q, next_target_q = self._networks.actor(next_states), self._networks.target(next_states)
        return double_q_target(rewards, discounts, next_q, next_target_q, peer_values, answered)

    @torch.no_grad()
    def _move_target(self) -> None:
        targets: list[Tensor] = list(self._networks.target.parameters())
        sources: list[Tensor] = list(self._networks.actor.parameters())
        torch._foreach_lerp_(targets, sources, self._config.tau)

    def state_dict(self) -> dict[str, Any]:
        """The optimiser's state and the last loss, for a checkpoint."""
        return {
            "optimiser": self._optimiser.state_dict(),
            "loss": None if self.loss is None else float(self.loss),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore from ``state_dict``."""
        self._optimiser.load_state_dict(state["optimiser"])
        self.loss = None if state["loss"] is None else torch.tensor(state["loss"])


def _by_row(answers: PeerValues, rows: int) -> tuple[Tensor, Tensor]:
    """Peers' values by row, 0 where missing, and a mask of them [B]."""
    values, answered = np.zeros(rows, np.float32), np.zeros(rows, np.bool_)
    values[answers.rows], answered[answers.rows] = answers.values, True
    return torch.from_numpy(values), torch.from_numpy(answered)
