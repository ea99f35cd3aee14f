"""Retrace targets in TorchRL's own ``SACLoss``, on Pendulum-v1: three changes.

python examples/compose_retrace.py   # about 3 minutes

Beside compose_tsallis.py, the actor writes the density of its actions, the buffer gives back slices
of trajectories, and the loss is given another value estimator. retrace_sac.py measures what that
does on Reacher-v5.
"""

from __future__ import annotations

import argparse

import torch
from compose_tsallis import learn, make_env, make_networks
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.objectives import SACLoss

from torchrl_safe import RetraceEstimator


def train(lmbda: float, seed: int, total_frames: int) -> list[tuple[int, float]]:
    """Train, and return (frames, return) of every training episode."""
    torch.manual_seed(seed)
    env = make_env(seed)
    actor, qvalue = make_networks(env, return_log_prob=True)  # writes action_log_prob
    loss_module = SACLoss(actor, qvalue)
    retrace = RetraceEstimator.for_loss(loss_module, gamma=0.98, lmbda=lmbda)
    loss_module.make_value_estimator(retrace)
    # Slices come flat, [B * T], with done at the end of each: that is where the traces stop.
    sampler = SliceSampler(slice_len=8, traj_key=("collector", "traj_ids"), strict_length=False)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(total_frames), sampler=sampler, batch_size=128
    )
    # No random frames first: they would have no density.
    budget = {"frames_per_batch": 50, "total_frames": total_frames}
    collector = Collector(env, actor, **budget, auto_register_policy_transforms=False)
    return learn(collector, buffer, loss_module)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--lmbda", type=float, default=0.9, help="trace decay; 0 is one step")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-frames", type=int, default=12_000)
    arguments = parser.parse_args()
    for frames, episode_return in train(**vars(arguments)):
        print(f"{frames:6d} frames  return {episode_return:8.1f}")
