"""Options of whole training runs of about a second, of every method."""

from __future__ import annotations

from torchrl_safe.trainers import cli

COMMON = [
    "num_threads=1",
    "env.num_envs=4",
    "env.episode_length=50",
    "env.standardize_frames=0",  # of a task it would be longer than the run
    "collector.frames_per_batch=200",
    "collector.init_frames=0",
    "collector.total_frames=400",
    "policy.num_cells=[8]",
    "critic.num_cells=[8]",
    "eval.interval=400",
    "eval.num_episodes=2",
    "eval.final_episodes=2",
    "eval.num_steps=20",
    "checkpoint.interval=200",
    "video.num_steps=0",
]
GRADIENT = ["replay_buffer.size=2000", "optim.num_updates=2", "optim.minibatch_size=50"]
SURROGATE = ["optim.critic_rounds=1", "optim.minibatch_size=100"]
REPLAY = ["replay_buffer.size=2000", "optim.critic_frames=200", "optim.policy_frames=200"]
OF_METHOD = {
    "safetac": [*SURROGATE, *REPLAY],
    "tac": GRADIENT,
    "wcsac": GRADIENT,
    "sac_lagrangian": GRADIENT,
    "sac_pid": GRADIENT,
    "td3_lagrangian": GRADIENT,
    "trc": SURROGATE,
    "cpo": SURROGATE,
    "ppo_lagrangian": SURROGATE,
    "ppo_pid": SURROGATE,
    "trpo_lagrangian": SURROGATE,
    "trpo_pid": SURROGATE,
    "focops": SURROGATE,
    "cup": SURROGATE,
    "p3o": SURROGATE,
    "crpo": SURROGATE,
    "pcpo": SURROGATE,
    **{
        f"{base}_{how}": SURROGATE
        for base in ("ppo", "trpo")
        for how in ("saute", "early_terminated")
    },
    "offpolicy_trc": [*SURROGATE, *REPLAY],
}


def options(method, *overrides, run_dir):
    """Of a small run."""
    return cli.compose(
        method, [*COMMON, *OF_METHOD[method], f"run_dir={run_dir}", *map(str, overrides)]
    )
