"""A whole training run of SafeTAC in about a second, for tests that break it."""

from __future__ import annotations

from pathlib import Path

from torchrl_safe.trainers import SafeTAC, cli

FRAMES = 100  # per update
OVERRIDES = [
    "num_threads=1",
    "env.num_envs=4",
    "env.episode_length=40",
    f"collector.frames_per_batch={FRAMES}",
    "collector.init_frames=0",
    "replay_buffer.size=1000",
    "replay_buffer.slice_len=10",
    "policy.num_cells=[8]",
    "critic.num_cells=[8]",
    "optim.critic_rounds=1",
    "optim.critic_frames=100",
    "optim.minibatch_size=100",
    "optim.policy_frames=50",
    "optim.cg_iters=3",
    "eval.interval=1000000",
    "eval.num_episodes=1",
    "eval.num_steps=5",
    "eval.final_episodes=1",
    "video.num_steps=0",
]


def options(run_dir: Path, *overrides: str) -> SafeTAC.Options:
    return cli.compose("safetac", [*OVERRIDES, f"run_dir={run_dir}", *overrides])


def launch(run_dir: Path, *overrides: str) -> None:
    SafeTAC(options=options(run_dir, *overrides)).train()
