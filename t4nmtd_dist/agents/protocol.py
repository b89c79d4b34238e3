"""What an agent is: its learner, its actor, and what the other processes know of its parameters.

An agent is a folder with the same few modules: ``config`` (settings and defaults), ``shapes`` (``AgentShapes``),
``losses``, ``networks``, ``actor`` (``AgentActor``) and ``agent`` (``AgentBuilder``). ``core.registry.AGENTS`` names
the folder; ``config`` and ``shapes`` import no torch, since the coordinator reads them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from t4nmtd_dist.agents.common.context import AgentContext
from t4nmtd_dist.agents.common.peer_values import PeerCritics, Values
from t4nmtd_dist.agents.common.rehearsal import GreedyActor
from t4nmtd_dist.agents.common.replay_buffer import ReplayBuffer
from t4nmtd_dist.agents.common.rollout import Rollout
from t4nmtd_dist.agents.weights import Shapes, Weights
from t4nmtd_dist.core.config import TaskConfig
from t4nmtd_dist.core.state_dict import State
from t4nmtd_dist.environments.batched import Observations

Actions = NDArray[Any]


class Actor(Protocol):
    """The trained policy of one sub-task.

    The loop it is meant for::

        actor = make_actor(config.learner, weights)
        while not episode_is_over:
            observations, q = step(actor.act(product_states(observations, q, dfa.states)))
    """

    inputs: int
    """Length of a product state, d + |Q|."""

    def act(self, states: NDArray[np.float32], rng: np.random.Generator | None = None) -> Actions:
        """Actions of product states [N, inputs]: int64 [N], or float32 [N, A] within the action space's bounds.

        Args:
            states: product states.
            rng: draws the actions from the policy's distribution; without it they are the most likely ones.
        """


class AgentShapes(Protocol):
    """Module ``shapes`` of an agent: names and shapes of its parameters.

    The network that acts is named ``actor.*``, or ``average.*`` where an average of it acts.

    The check it is meant for::

        inputs_of, actions_of = shapes.size_parameters(config.learner.hidden)
        inputs, actions = weights[inputs_of].shape[1], weights[actions_of].shape[0]
        expected = shapes.parameter_shapes(config, inputs, actions)
    """

    def parameter_shapes(self, config: TaskConfig, inputs: int, actions: int) -> Shapes:
        """Names and shapes of all parameters of a learner, statistics of observations excepted.

        Args:
            config: the task.
            inputs: length of a product state.
            actions: number of discrete actions, or length of a continuous one.
        """

    def size_parameters(self, hidden: Sequence[int]) -> tuple[str, str]:
        """Names of two parameters, one of shape [., inputs, ..] and one of shape [actions, ..] or [actions]."""


class AgentActor(Protocol):
    """Module ``actor`` of an agent."""

    def make_actor(self, hidden: tuple[int, ...], weights: Weights) -> Actor:
        """The actor with these parameters, named as in the learner's weights without ``actor.`` or ``average.``.

        Raises:
            PolicyError: if parameters are missing or do not fit.
        """


class PublishedValues(Protocol):
    """A copy of the critic that another thread may ask while the learner trains, or that a peer holds."""

    def values(self, arrays: Mapping[str, NDArray[Any]]) -> tuple[Values, int]:
        """Values of the product states in a value request, and the version of the copy.

        Raises:
            ProtocolError: if the arrays do not fit.
        """

    def weights(self) -> tuple[Weights, int]:
        """What the values are computed from, and its version."""

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Answer from the ``weights`` of another copy from now on.

        Raises:
            PolicyError: if names or shapes differ; the copy is of no use then.
            ProtocolError: if they are not finite.
        """


class Learner(Protocol):
    """Learns one sub-task from its own attempts.

    The loop it is meant for::

        while True:
            if not learner.iterate(peers):
                wait_for_start_states()
            tell(learner.rollout.take_progress(), learner.weights(), learner.version)
    """

    pid: str
    rollout: Rollout
    version: int
    gradient_steps: int
    value_shape: tuple[int, ...]
    peer_steps: int
    """How many steps of each peer in another process are worth keeping; 0 where peers' experience is not used."""

    @property
    def replay_buffer(self) -> ReplayBuffer | None:
        """What it has lived through, for peers to learn from as well; None where nothing is kept."""

    @property
    def peer_rows(self) -> int:
        """Experiences of peers that it can learn from now."""

    def learn_from(self, others: Mapping[str, ReplayBuffer]) -> None:
        """Learn from these experiences of peers too, by pid, looked into anew at every draw; the own is left out."""

    @property
    def published(self) -> PublishedValues:
        """What peers are answered from."""

    def replica(self) -> PublishedValues:
        """A network of the same shape, to be loaded with a peer's weights."""

    def iterate(self, peers: PeerCritics) -> bool:
        """Some steps and the updates they call for; False while there is no state to start from."""

    def rehearse(self, actor: GreedyActor) -> bool:
        """One whole attempt of every copy by ``actor``, from which nothing is learned; False without a start state."""

    def critic_values(self, observations: Observations, q: NDArray[np.int32]) -> Values:
        """What a peer in the same process is told of product states, float32 [k] or [k, 2]."""

    def weights(self) -> Weights:
        """Copies of all parameters by name."""

    def load(self, weights: Mapping[str, NDArray[Any]], version: int) -> None:
        """Go on from weights learned before."""

    def losses(self) -> tuple[float | None, float | None]:
        """Entropy (nats) and critic loss of the last update; None before the first."""

    def state_dict(self) -> State:
        """Everything that decides how learning goes on after an iteration, for a checkpoint.

        Arrays may be views of what is learned with: write or copy them before the next iteration.
        """

    def load_state_dict(self, state: State) -> None:
        """Go on from a ``state`` of a learner of the same sub-task and settings, exactly as that one would have.

        Raises:
            RunError, PolicyError: if it is of a learner of another shape.
        """


class AgentBuilder(Protocol):
    """Module ``agent`` of an agent.

    The use it is meant for::

        env = make_task_env(config, config.agent.num_envs)
        learner = agent.build(AgentContext(..., rollout=Rollout(env, ...)))
    """

    def build(self, context: AgentContext) -> Learner:
        """A learner.

        Raises:
            EnvError: if it cannot act in the environment's action space.
        """
