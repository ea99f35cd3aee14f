"""A constrained MDP with continuous actions whose optimum is the solution of a linear program.

Transitions, rewards and costs are linear in the action ``a`` in [-1, 1]: a mixture of those of two
extreme actions, with weights ``(1 ± a) / 2``. A policy therefore is worth what its mean action is
worth, and the best policy is the best randomised policy over the two extremes: a linear program
over occupancies (Altman 1999).

Each step ends the episode with probability ``1 - gamma``, as a truncation. The visited states
then are distributed as the discounted occupancy, exactly, and the mean cost per step over
``1 - gamma`` is the discounted cost sum.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import linprog
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase

GAMMA = 0.8
COSTS = ("cost", "second_cost")


class LinearCMDP(EnvBase):
    """``num_envs`` copies of one random CMDP with two costs; the observation is a one-hot state."""

    num_states = 4

    def __init__(self, num_envs: int, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        rng = np.random.default_rng(3)
        n = self.num_states
        self.transition = torch.tensor(rng.dirichlet(np.full(n, 0.5), (2, n)), dtype=torch.float32)
        # The extreme action 1 earns more and costs more, to a degree that differs between states.
        gain = rng.uniform(0.2, 1.0, (3, n))
        table = np.stack([np.zeros((3, n)), gain]) + rng.uniform(0, 0.1, (2, 3, n))
        self.reward, self.cost, self.second_cost = (
            torch.tensor(table[:, i], dtype=torch.float32) for i in range(3)
        )
        shape = (num_envs,)
        self.observation_spec = Composite(
            observation=OneHot(n, shape=(num_envs, n), dtype=torch.float32),
            shape=shape,
        )
        self.action_spec = Bounded(-1, 1, (num_envs, 1))
        self.full_reward_spec = Composite(
            {key: Unbounded((num_envs, 1)) for key in ("reward", *COSTS)}, shape=shape
        )
        self.full_done_spec = Composite(
            {
                key: Binary(1, shape=(num_envs, 1), dtype=torch.bool)
                for key in ("done", "terminated", "truncated")
            },
            shape=shape,
        )
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)

    def _observe(self, state: Tensor) -> Tensor:
        return torch.nn.functional.one_hot(state, self.num_states).float()

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        start = torch.randint(self.num_states, self.batch_size, generator=self.generator)
        return TensorDict({"observation": self._observe(start)}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        state = tensordict["observation"].argmax(-1)
        high = (1 + tensordict["action"]) / 2

        def mix(table: Tensor) -> Tensor:
            return table[0, state] + high * (table[1, state] - table[0, state])

        probs = mix(self.transition)
        state_index = torch.multinomial(probs, 1, generator=self.generator).squeeze(-1)
        truncated = torch.rand(*self.batch_size, 1, generator=self.generator) < 1 - GAMMA
        out = {
            "observation": self._observe(state_index),
            "done": truncated,
            "truncated": truncated,
            "terminated": torch.zeros_like(truncated),
        }
        for key in ("reward", *COSTS):
            out[key] = mix(getattr(self, key)[..., None])
        return TensorDict(out, self.batch_size)

    def values(self, mean_action: Tensor) -> dict[str, float]:
        """Exact discounted sums of reward and costs of a policy with mean actions [num_states]."""
        high = ((1 + mean_action) / 2).double()

        def mix(table: Tensor) -> Tensor:
            low, top = table.double()
            weight = high.reshape(-1, *[1] * (low.ndim - 1))
            return low + weight * (top - low)

        inverse = torch.linalg.inv(
            torch.eye(self.num_states, dtype=torch.float64) - GAMMA * mix(self.transition)
        )
        return {
            key: (inverse @ mix(getattr(self, key))).mean().item() for key in ("reward", *COSTS)
        }

    def optimum(self, limits: dict[str, float]) -> float:
        """The largest return under limits on the discounted costs."""
        n = self.num_states
        reward, *costs = (getattr(self, key).double().flatten() for key in ("reward", *limits))
        flow = torch.eye(n).repeat(1, 2) - GAMMA * self.transition.flatten(0, 1).T
        solution = linprog(
            -reward.numpy(),
            A_ub=torch.stack(costs).numpy(),
            b_ub=np.array(list(limits.values())),
            A_eq=flow.double().numpy(),
            b_eq=np.full(n, 1 / n),
        )
        assert solution.status == 0, solution.message
        return -solution.fun
