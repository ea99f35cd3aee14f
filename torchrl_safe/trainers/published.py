"""Settings with which methods were published, beside defaults that are tuned here.

``torchrl-safe train METHOD published=NAME`` takes them; what is given beside it wins. They say how
a method learns, never what problem it solves: limit, risk level, discount of the cost and length of
evaluation episodes stay the run's. ``optim.max_grad_norm`` of a million stands for none.

To add some: a :class:`Published` in :data:`PUBLISHED`. Each value stands beside its name in the
source, which a reader can look up.
"""

from __future__ import annotations

from typing import Any, NamedTuple

Values = dict[str, tuple[Any, str]]


class Published(NamedTuple):
    """Settings of somebody else's.

    Attributes:
        source: where they are from.
        values: by the dotted names of options, each with its name in the source.
        differs: what these options cannot say.
    """

    source: str
    values: Values
    differs: str


def _widths(widths: list[int], name: str) -> Values:
    return {"policy.num_cells": (widths, name), "critic.num_cells": (widths, name)}


def _episodes(frames: int, name: str) -> Values:
    """Batches of whole episodes of 1,000 steps, in as many environments."""
    return {
        "env.num_envs": (frames // 1000, f"{name} / max_ep_len"),
        "env.episode_length": (1000, "max_ep_len"),
        "collector.frames_per_batch": (frames, name),
    }


# No source moves its limit.
STILL: Values = {"loss.anneal_frames": (0, "the limit does not move")}


STARTER_AGENTS = (
    "Ray et al. 2019, Benchmarking Safe Exploration in Deep Reinforcement Learning: "
    "github.com/openai/safety-starter-agents, scripts/experiment.py (Point and Car), "
    "safe_rl/pg/run_agent.py and agents.py"
)
RAY: Values = {
    **_episodes(30_000, "steps_per_epoch"),
    **STILL,
    **_widths([256, 256], "hidden_sizes"),
    "policy.num_components": (1, "mlp_actor_critic"),
    "loss.gamma": (0.99, "gamma"),
    "loss.lmbda": (0.97, "lam, cost_lam"),
    "optim.critic_lr": (1e-3, "vf_lr"),
    "optim.critic_rounds": (80, "vf_iters"),
    "optim.minibatch_size": (30_000, "steps_per_epoch: whole batches"),
    "optim.max_grad_norm": (1e6, "none"),
}
RAY_TRUST_REGION: Values = {
    **RAY,
    "optim.max_kl": (0.01, "target_kl"),
    "optim.damping": (0.1, "damping_coeff"),
    "optim.cg_iters": (10, "cg_iters"),
    "optim.backtrack_ratio": (0.8, "backtrack_coeff"),
    "optim.max_backtracks": (9, "backtrack_iters, the first candidate included"),
}
RAY_MULTIPLIER: Values = {
    "lagrangian.init": (1.0, "penalty_init"),
    "lagrangian.lr": (0.05, "penalty_lr"),
}
RAY_DIFFERS = (
    "There the deviation of actions does not depend on the state, networks have tanh units, and "
    "critics' targets are computed once per batch."
)
RAY_PRICE_DIFFERS = f"{RAY_DIFFERS} The rate moves the softplus of a weight, here the price."

OMNISAFE = (
    "OmniSafe 0.5 (Ji et al. 2024, JMLR 25(285)): github.com/PKU-Alignment/omnisafe, "
    "omnisafe/configs"
)
OMNISAFE_ON_POLICY: Values = {
    **_episodes(20_000, "steps_per_epoch"),
    **_widths([64, 64], "hidden_sizes"),
    "policy.num_components": (1, "gaussian_learning"),
    "loss.gamma": (0.99, "gamma"),
    "loss.lmbda": (0.95, "lam, lam_c"),
    "optim.max_grad_norm": (40.0, "max_grad_norm"),
}
OMNISAFE_PPO_STEPS: Values = {
    **OMNISAFE_ON_POLICY,
    "optim.critic_lr": (3e-4, "critic lr"),
    "optim.critic_rounds": (40, "update_iters"),
    "optim.minibatch_size": (64, "batch_size"),
    "optim.policy_lr": (3e-4, "actor lr"),
    "optim.num_epochs": (40, "update_iters"),
    "optim.max_kl": (0.02, "target_kl"),
}
OMNISAFE_PPO: Values = {**OMNISAFE_PPO_STEPS, "loss.clip_epsilon": (0.2, "clip")}
OMNISAFE_TRUST_REGION: Values = {
    **OMNISAFE_ON_POLICY,
    "optim.critic_lr": (1e-3, "critic lr"),
    "optim.critic_rounds": (10, "update_iters"),
    "optim.minibatch_size": (128, "batch_size"),
    "optim.max_kl": (0.01, "target_kl"),
    "optim.damping": (0.1, "cg_damping"),
    "optim.cg_iters": (15, "cg_iters"),
    "optim.backtrack_ratio": (0.8, "decay of the line search"),
    "optim.max_backtracks": (14, "total_steps of it, the first candidate included"),
}
OMNISAFE_MULTIPLIER: Values = {
    **STILL,
    "lagrangian.init": (0.001, "lagrangian_multiplier_init"),
    "lagrangian.lr": (0.035, "lambda_lr"),
}
# There the error is the cost of an episode of 1,000 steps: ten times the discounted sum of gamma
# 0.99, which it is here.
OMNISAFE_PID: Values = {
    **STILL,
    "lagrangian.init": (0.001, "lagrangian_multiplier_init"),
    "pid.kp": (1.0, "pid_kp 0.1, of an episode's cost"),
    "pid.ki": (0.1, "pid_ki 0.01, likewise"),
    "pid.kd": (0.1, "pid_kd 0.01, likewise"),
}
OMNISAFE_SAUTE: Values = {
    "budget.budget_gamma": (0.9999, "saute_gamma"),
    "budget.unsafe_reward": (-0.2, "unsafe_reward"),
}
OMNISAFE_TERMINATED: Values = {
    "budget.budget_gamma": (1.0, "the plain sum"),
    "budget.termination_reward": (0.0, "EarlyTerminatedAdapter.step"),
}
OMNISAFE_DIFFERS = (
    "There the deviation of actions does not depend on the state, networks have tanh units, "
    "observations are standardised, weights of critics decay by 0.001, learning rates of PPO fall "
    "linearly, and critics' targets are computed once per batch."
)
OMNISAFE_CAPPED = "The multiplier is 2 at most."
OMNISAFE_PID_DIFFERS = (
    f"{OMNISAFE_DIFFERS} The controller's error is smoothed, its derivative over ten batches."
)
OMNISAFE_SAUTE_DIFFERS = f"{OMNISAFE_DIFFERS} A budget that is just spent counts as overdrawn."
OMNISAFE_TERMINATED_DIFFERS = f"{OMNISAFE_DIFFERS} What is left of the budget is not observed."

WCSAC_SETTINGS: Values = {
    "env.num_envs": (1, "one environment per process"),
    "env.episode_length": (1000, "max_ep_len"),
    "collector.frames_per_batch": (100, "update_freq"),
    "collector.init_frames": (500, "local_start_steps"),
    **_widths([256, 256], "hid, l"),
    "policy.num_components": (1, "mlp_actor"),
    "replay_buffer.size": (1_000_000, "replay_size"),
    "loss.gamma": (0.99, "gamma"),
    "loss.entropic_index": (1.0, "Shannon entropy"),
    "loss.alpha": (0.69, "softplus of soft_alpha = 0"),
    **STILL,
    "optim.num_updates": (100, "update_freq"),
    "optim.minibatch_size": (256, "batch_size"),
    "optim.lr": (1e-3, "lr"),
    "optim.tau": (0.005, "1 - polyak"),
    "lagrangian.init": (0.69, "softplus of soft_beta = 0"),
}
WCSAC_DIFFERS = (
    "There the multiplier moves in every gradient step, by the critic's cost; here once per batch, "
    "by the measured. Each step is shared by the processes of --cpu; here there is one."
)

KIM_TRUST_REGION: Values = {
    **_widths([512, 512], "hidden_dim"),
    "policy.num_components": (1, "a Gaussian"),
    "loss.gamma": (0.99, "discount_factor"),
    "loss.lmbda": (0.97, "gae_coeff"),
    **STILL,
    "optim.max_kl": (0.001, "max_kl"),
    "optim.damping": (0.01, "damping_coeff"),
    "optim.cg_iters": (10, "num_conjugate"),
    "optim.backtrack_ratio": (0.8, "line_decay"),
    "optim.max_backtracks": (50, "without an end"),
    "optim.recovery_ratio": (1.0, "optim_case 0"),
}

PUBLISHED: dict[str, dict[str, Published]] = {
    "cpo": {
        "ray2019": Published(
            STARTER_AGENTS,
            RAY_TRUST_REGION | {"optim.recovery_ratio": (1.0, "optim_case 0")},
            RAY_DIFFERS,
        ),
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/CPO.yaml",
            {
                **OMNISAFE_TRUST_REGION,
                **STILL,
                "optim.max_backtracks": (19, "total_steps, the first candidate included"),
                "optim.recovery_ratio": (1.0, "optim_case 0"),
            },
            OMNISAFE_DIFFERS,
        ),
    },
    "trc": {
        "kim2022": Published(
            "Kim and Oh 2022, TRC: github.com/rllab-snu/Trust-Region-CVaR, tf1/main.py",
            {
                **_episodes(4000, "n_steps"),
                **KIM_TRUST_REGION,
                "optim.critic_lr": (2e-4, "lr"),
                "optim.critic_rounds": (200, "n_epochs"),
                "optim.minibatch_size": (4000, "n_steps: whole batches"),
                "optim.max_grad_norm": (1e6, "none"),
            },
            "There one environment yields the episodes of a batch one after the other, and the "
            "deviation of actions begins at exp(log_std_init = -1).",
        ),
    },
    "offpolicy_trc": {
        "kim2022": Published(
            "Kim and Oh 2022, Off-Policy TRC: github.com/rllab-snu/Off-Policy-TRC, torch/main.py "
            "and agent.py",
            {
                "env.num_envs": (5, "n_envs"),
                "env.episode_length": (1000, "max_episode_steps"),
                "collector.frames_per_batch": (1000, "n_steps"),
                "collector.init_frames": (0, "none"),
                **KIM_TRUST_REGION,
                "replay_buffer.size": (50_000, "len_replay_buffer"),
                "replay_buffer.slice_len": (200, "n_steps / n_envs"),
                "optim.critic_lr": (3e-4, "lr"),
                "optim.critic_frames": (5000, "n_update_steps"),
                "optim.policy_frames": (5000, "n_update_steps"),
                "optim.critic_rounds": (100, "n_epochs"),
                "optim.minibatch_size": (5000, "n_update_steps: whole batches"),
                "optim.max_grad_norm": (1.0, "max_grad_norm"),
            },
            "There a fifth of an update's frames are the newest, all epochs are on the same frames "
            "and targets, and the region shrinks by the distance to the policies that acted.",
        ),
    },
    "ppo_lagrangian": {
        "ray2019": Published(
            STARTER_AGENTS,
            {
                **RAY,
                "loss.clip_epsilon": (0.2, "clip_ratio"),
                "optim.policy_lr": (3e-4, "pi_lr"),
                "optim.num_epochs": (80, "pi_iters"),
                "optim.max_kl": (0.012, "kl_margin * target_kl"),
                **RAY_MULTIPLIER,
            },
            RAY_PRICE_DIFFERS,
        ),
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/PPOLag.yaml",
            {**OMNISAFE_PPO, **OMNISAFE_MULTIPLIER},
            OMNISAFE_DIFFERS,
        ),
    },
    "ppo_pid": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/CPPOPID.yaml",
            {**OMNISAFE_PPO, **OMNISAFE_PID},
            OMNISAFE_PID_DIFFERS,
        ),
    },
    "trpo_lagrangian": {
        "ray2019": Published(
            STARTER_AGENTS, {**RAY_TRUST_REGION, **RAY_MULTIPLIER}, RAY_PRICE_DIFFERS
        ),
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/TRPOLag.yaml",
            {**OMNISAFE_TRUST_REGION, **OMNISAFE_MULTIPLIER},
            OMNISAFE_DIFFERS,
        ),
    },
    "trpo_pid": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/TRPOPID.yaml",
            {**OMNISAFE_TRUST_REGION, **OMNISAFE_PID},
            OMNISAFE_PID_DIFFERS,
        ),
    },
    "focops": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/FOCOPS.yaml",
            {
                **OMNISAFE_PPO_STEPS,
                "loss.kl_weight": (1.5, "focops_lam"),
                "optim.max_kl": (0.02, "target_kl, focops_eta"),
                **OMNISAFE_MULTIPLIER,
            },
            f"{OMNISAFE_DIFFERS} {OMNISAFE_CAPPED}",
        ),
    },
    "cup": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/CUP.yaml",
            {**OMNISAFE_PPO, "optim.max_kl": (0.01, "target_kl"), **OMNISAFE_MULTIPLIER},
            f"{OMNISAFE_DIFFERS} {OMNISAFE_CAPPED}",
        ),
    },
    "p3o": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/P3O.yaml",
            {
                **OMNISAFE_PPO,
                **STILL,
                "optim.critic_rounds": (10, "update_iters"),
                "optim.num_epochs": (10, "update_iters"),
                "loss.penalty": (20.0, "kappa"),
            },
            f"{OMNISAFE_DIFFERS} The penalty is on the excess of a whole episode beside the "
            "advantage of a step; here both are of a step.",
        ),
    },
    "crpo": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/OnCRPO.yaml",
            {
                **OMNISAFE_TRUST_REGION,
                **STILL,
                "loss.tolerance": (0.2, "distance 2, of an episode's cost"),
            },
            OMNISAFE_DIFFERS,
        ),
    },
    "pcpo": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/PCPO.yaml",
            {
                **OMNISAFE_TRUST_REGION,
                **STILL,
                "optim.max_backtracks": (199, "total_steps, the first candidate included"),
            },
            OMNISAFE_DIFFERS,
        ),
    },
    "ppo_saute": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/PPOSaute.yaml, of Goal and Circle",
            {
                **OMNISAFE_PPO,
                "optim.critic_rounds": (80, "update_iters"),
                "optim.num_epochs": (80, "update_iters"),
                **OMNISAFE_SAUTE,
            },
            OMNISAFE_SAUTE_DIFFERS,
        ),
    },
    "trpo_saute": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/TRPOSaute.yaml, of Goal and Circle",
            {**OMNISAFE_TRUST_REGION, **OMNISAFE_SAUTE},
            OMNISAFE_SAUTE_DIFFERS,
        ),
    },
    "ppo_early_terminated": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/PPOEarlyTerminated.yaml",
            {**OMNISAFE_PPO, **OMNISAFE_TERMINATED},
            OMNISAFE_TERMINATED_DIFFERS,
        ),
    },
    "trpo_early_terminated": {
        "omnisafe": Published(
            f"{OMNISAFE}/on-policy/TRPOEarlyTerminated.yaml",
            {**OMNISAFE_TRUST_REGION, **OMNISAFE_TERMINATED},
            OMNISAFE_TERMINATED_DIFFERS,
        ),
    },
    "wcsac": {
        "yang2021": Published(
            "Yang et al. 2021, WCSAC: github.com/AlgTUDelft/WCSAC, wc_sac/sac/wcsac.py",
            WCSAC_SETTINGS | {"lagrangian.lr": (0.05, "lr * lr_s")},
            f"{WCSAC_DIFFERS} Its damping (damp_s) is none of these options.",
        ),
    },
    "td3_lagrangian": {
        "omnisafe": Published(
            f"{OMNISAFE}/off-policy/TD3Lag.yaml, its defaults",
            {
                "env.num_envs": (1, "vector_env_nums"),
                "env.episode_length": (1000, "the environment's"),
                "collector.frames_per_batch": (2000, "steps_per_epoch, once per multiplier's step"),
                "collector.init_frames": (25_000, "start_learning_steps"),
                **_widths([256, 256], "hidden_sizes"),
                "policy.noise": (0.1, "exploration_noise"),
                "replay_buffer.size": (1_000_000, "size"),
                "loss.gamma": (0.99, "gamma"),
                **STILL,
                "optim.num_updates": (2000, "update_iters / update_cycle: a step per frame"),
                "optim.minibatch_size": (256, "batch_size"),
                "optim.lr": (3e-4, "actor lr, critic lr"),
                "optim.tau": (0.005, "polyak"),
                "optim.policy_delay": (2, "policy_delay"),
                "optim.target_noise": (0.2, "policy_noise"),
                "optim.noise_clip": (0.5, "policy_noise_clip"),
                "lagrangian.init": (0.001, "lagrangian_multiplier_init"),
                "lagrangian.lr": (1e-5, "lambda_lr"),
            },
            "There the multiplier rests for 100 epochs (warmup_epochs), costs are standardised, "
            "and gradient steps spread over an epoch. Point and Car have rates of their own, of "
            "which the policy's (5e-6) is not the critics' (1e-3).",
        ),
    },
    "sac_lagrangian": {
        "ray2019": Published(
            "Ray et al. 2019: github.com/openai/safety-starter-agents, safe_rl/sac/sac.py",
            WCSAC_SETTINGS | {"lagrangian.lr": (1e-3, "lr")},
            WCSAC_DIFFERS,
        ),
    },
}
"""By method and name, which is the paper's or the library's."""
