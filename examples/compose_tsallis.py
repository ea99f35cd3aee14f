"""TorchRL's SAC on Pendulum-v1, with ``TsallisLoss`` in the place of ``SACLoss``: one line differs.

python examples/compose_tsallis.py --entropic-index 1.4   # 1 is SAC itself; about 3 minutes
"""

from __future__ import annotations

import argparse
from typing import Any

import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase, GymEnv, RewardSum, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_safe import TsallisLoss


def make_env(seed: int) -> EnvBase:
    """The pendulum, with the return of its episodes."""
    env = TransformedEnv(GymEnv("Pendulum-v1"), RewardSum())
    env.set_seed(seed)
    return env


def make_networks(env: EnvBase, **kwargs: Any) -> tuple[ProbabilisticActor, ValueOperator]:
    """SAC's actor and critic."""
    network = MLP(3, 2, num_cells=[64, 64])
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network, NormalParamExtractor()), ["observation"], ["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0, "tanh_loc": False},
        **kwargs,
    )
    return actor, ValueOperator(MLP(4, 1, num_cells=[64, 64]), in_keys=["observation", "action"])


def learn(
    collector: Collector, buffer: TensorDictReplayBuffer, loss_module: SACLoss
) -> list[tuple[int, float]]:
    """One gradient step per frame after the first 1,000: (frames, return) of every episode."""
    target_updater = SoftUpdate(loss_module, tau=0.01)
    optim = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    episodes, frames = [], 0
    for batch in collector:
        frames += batch.numel()
        buffer.extend(batch)
        done = batch["next", "done"].squeeze(-1)
        episodes += [(frames, r) for r in batch["next", "episode_reward"][done].flatten().tolist()]
        for _ in range(batch.numel() if frames > 1000 else 0):
            losses = loss_module(buffer.sample())
            sum(loss for name, loss in losses.items() if name.startswith("loss_")).backward()
            optim.step()
            optim.zero_grad()
            target_updater.step()
    collector.shutdown()
    return episodes


def train(entropic_index: float, seed: int, total_frames: int) -> list[tuple[int, float]]:
    """Train, and return (frames, return) of every training episode."""
    torch.manual_seed(seed)
    env = make_env(seed)
    actor, qvalue = make_networks(env)
    loss_module = TsallisLoss(actor, qvalue, entropic_index=entropic_index)  # was: SACLoss(...)
    loss_module.make_value_estimator(gamma=0.98)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(total_frames), batch_size=128)
    budget = {"frames_per_batch": 50, "total_frames": total_frames, "init_random_frames": 1000}
    collector = Collector(env, actor, **budget, auto_register_policy_transforms=False)
    return learn(collector, buffer, loss_module)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--entropic-index", type=float, default=1.4, help="q; 1 is Shannon entropy")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-frames", type=int, default=12_000)
    arguments = parser.parse_args()
    for frames, episode_return in train(**vars(arguments)):
        print(f"{frames:6d} frames  return {episode_return:8.1f}")
