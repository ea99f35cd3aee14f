"""What the tests of cost losses share: an actor, and steps of trajectories."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.modules import MLP

from torchrl_safe import GMMTanhPolicy

OBS, ACT = 3, 2


def make_actor():
    net = MLP(OBS, 3 * (1 + 2 * ACT), num_cells=[16])
    return GMMTanhPolicy(
        net, Bounded(-1, 1, (ACT,), dtype=torch.float64), num_components=3
    ).double()


def make_data(batch=(4, 6)):
    generator = torch.Generator().manual_seed(3)

    def rand(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    done = torch.rand(*batch, 1, generator=generator) < 0.2
    terminated = done & (torch.rand(*batch, 1, generator=generator) < 0.5)
    return TensorDict(
        {
            "observation": rand(OBS),
            "action": rand(ACT).tanh(),
            "action_log_prob": rand(),
            "next": {
                "observation": rand(OBS),
                "cost": rand(1).sigmoid(),
                "done": done,
                "terminated": terminated,
            },
        },
        batch_size=batch,
    )
