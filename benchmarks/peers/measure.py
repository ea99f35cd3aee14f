"""One training or one simulator for a number of frames, in a process of its own.

    python benchmarks/peers/measure.py omnisafe CPO 40000 FOLDER  # in the peers' environment
    python benchmarks/peers/measure.py ours cpo 40000 FOLDER      # in ours

It imports what it needs alone: the two environments have nothing in common.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

POINT_GOAL = "SafetyPointGoal1-v0"
# OmniSafe's defaults but for what it would do beside the training, and the frames before it learns.
OMNISAFE = {"logger_cfgs": {"use_wandb": False, "use_tensorboard": False}}
OFF_POLICY = {"algo_cfgs": {"start_learning_steps": 1_000}}


def omnisafe(name: str, frames: int) -> None:
    """OmniSafe's trainer."""
    import omnisafe

    off_policy = "SAC" in name
    train = {"total_steps": frames, "torch_threads": 1, "vector_env_nums": 1, "parallel": 1}
    settings = {"train_cfgs": train, **OMNISAFE, **(OFF_POLICY if off_policy else {})}
    omnisafe.Agent(name, POINT_GOAL, custom_cfgs=settings).learn()


def stepping(name: str, frames: int) -> None:
    """A simulator under random actions."""
    if name == "safety_gymnasium":
        import safety_gymnasium

        env = safety_gymnasium.make(POINT_GOAL)
    else:
        import gymnasium

        env = gymnasium.make(name)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(frames):
        *_, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()


def ours(method: str, frames: int) -> None:
    """Our trainer with its defaults."""
    from torchrl_safe.trainers import METHODS

    METHODS[method]("point").train(
        **{
            "total_frames": frames,
            "run_dir": str(Path("run")),
            "num_threads": 1,
            "eval.interval": 10**9,
            "eval.num_episodes": 1,
            "eval.final_episodes": 2,
            "eval.num_steps": 10,
            "checkpoint.interval": 10**9,
            "video.num_steps": 0,
        }
    )


def ours_stepping(num_envs: str, frames: int) -> None:
    """Our simulator under random actions, N environments at once."""
    from torchrl_safe.envs import SafeRobotEnv

    env = SafeRobotEnv("point", num_envs=int(num_envs), num_threads=1, seed=0, stagger=True)
    state = env.reset()
    for _ in range(frames // int(num_envs)):
        _, state = env.step_and_maybe_reset(env.rand_action(state))


def torchrl_sac(num_envs: str, frames: int) -> None:
    """TorchRL's SAC alone: an update of a batch of 256 per frame, networks as OmniSafe's SAC has.

    No environment, no replay: what is left is the floor of an update per frame.
    """
    import torch
    from tensordict import TensorDict
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torch import nn
    from torchrl.data import Bounded
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import SACLoss, SoftUpdate

    torch.set_num_threads(1)
    size, actions, cells = 60, 2, [256, 256]
    net = nn.Sequential(MLP(size, 2 * actions, num_cells=cells), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        spec=Bounded(-1.0, 1.0, (actions,)),
    )
    critic = ValueOperator(
        MLP(size + actions, 1, num_cells=cells), in_keys=["observation", "action"]
    )
    loss = SACLoss(actor, critic, num_qvalue_nets=2)
    loss.make_value_estimator(gamma=0.99)
    follow = SoftUpdate(loss, tau=0.005)
    adam = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    for _ in range(frames):
        data = TensorDict(
            {
                "observation": torch.randn(256, size),
                "action": torch.rand(256, actions) * 2 - 1,
                "next": {
                    "observation": torch.randn(256, size),
                    "reward": torch.randn(256, 1),
                    "done": torch.zeros(256, 1, dtype=torch.bool),
                    "terminated": torch.zeros(256, 1, dtype=torch.bool),
                },
            },
            [256],
        )
        losses = loss(data)
        adam.zero_grad()
        sum(losses[k] for k in ("loss_actor", "loss_qvalue", "loss_alpha")).backward()
        adam.step()
        follow.step()


KINDS = {f.__name__: f for f in (omnisafe, stepping, ours, ours_stepping, torchrl_sac)}

if __name__ == "__main__":
    kind, name, frames, folder = sys.argv[1:]
    os.chdir(folder)
    KINDS[kind](name, int(frames))
