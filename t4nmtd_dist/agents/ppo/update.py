"""PPO's gradient steps on one trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from t4nmtd_dist.agents.common.flat_adam import FlatAdam
from t4nmtd_dist.agents.ppo.config import PPOConfig
from t4nmtd_dist.agents.ppo.losses import clipped_surrogate, entropy_of, value_loss
from t4nmtd_dist.agents.ppo.networks import ActorCritic
from t4nmtd_dist.agents.ppo.trajectory import Trajectory

Floats = NDArray[np.float32]

CLIP = 0.2
VALUE_COEFFICIENT = 0.5
MAX_GRAD_NORM = 0.5


class PPOUpdate:
    """Runs PPO's epochs over a trajectory.

    Args:
        rng: shuffles the rows of an epoch.

    Attributes:
        gradient_steps: number of steps taken.
        losses: entropy (nats) and value loss of the last step, on the device; None before the first.
    """

    def __init__(self, network: ActorCritic, config: PPOConfig, device: str, rng: np.random.Generator) -> None:
        self._network, self._config, self._device, self._rng = network, config, device, rng
        self._optimiser = FlatAdam.of_module(network, config.learning_rate, epsilon=1e-5)
        self.gradient_steps = 0
        self.losses: tuple[Tensor, Tensor] | None = None

    def epochs(self, trajectory: Trajectory, advantages: Floats, returns: Floats, entropy_coefficient: float) -> None:
        """Run all epochs over T * N rows; advantages and returns are flat."""
        config = self._config
        columns = [column.to(self._device) for column in _columns(trajectory, self._normalised(advantages), returns)]
        for _ in range(config.epochs):
            order = torch.from_numpy(self._rng.permutation(len(advantages))).to(self._device)
            for rows in torch.split(order, config.minibatch):
                self._gradient_step(*(column[rows] for column in columns), entropy_coefficient=entropy_coefficient)

    def _normalised(self, advantages: Floats) -> Floats:
        spread = max(float(advantages.std()), self._config.advantage_floor)
        normal: Floats = (advantages - advantages.mean()) / spread
        return normal

    def _gradient_step(
        self,
        states: Tensor,
        actions: Tensor,
        old_log_probs: Tensor,
        advantages: Tensor,
        returns: Tensor,
        *,
        entropy_coefficient: float,
    ) -> None:
        all_log_probs = torch.log_softmax(self._network.actor(states), -1)
        log_probs = all_log_probs.gather(1, actions[:, None]).squeeze(1)
        policy_loss = clipped_surrogate(log_probs, old_log_probs, advantages, CLIP)
        entropy = entropy_of(all_log_probs)
        critic_loss = value_loss(self._network.value(states), returns)
        loss = policy_loss + VALUE_COEFFICIENT * critic_loss - entropy_coefficient * entropy
        self._optimiser.gradient.zero_()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(self._network.parameters(), MAX_GRAD_NORM)
        self._optimiser.step()
        self.gradient_steps += 1
        self.losses = entropy.detach(), critic_loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, step count and last losses, for a checkpoint."""
        return {
            "optimiser": self._optimiser.state_dict(),
            "gradient_steps": self.gradient_steps,
            "losses": None if self.losses is None else [float(loss) for loss in self.losses],
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore from ``state_dict``."""
        self._optimiser.load_state_dict(state["optimiser"])
        self.gradient_steps = state["gradient_steps"]
        losses = state["losses"]
        self.losses = None if losses is None else (torch.tensor(losses[0]), torch.tensor(losses[1]))


def _columns(trajectory: Trajectory, advantages: Floats, returns: Floats) -> list[Tensor]:
    """The T * N rows of a gradient step's inputs."""
    rows = len(advantages)
    columns = (trajectory.states.reshape(rows, -1), trajectory.actions.reshape(-1), trajectory.log_probs.reshape(-1))
    return [torch.from_numpy(column) for column in (*columns, advantages, returns)]
