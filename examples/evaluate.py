"""What became of a run: scores, failures, a map, a film, and whether its safety critic is right.

    python examples/evaluate.py runs/safetac_point/seed_0
    python examples/evaluate.py runs/safetac_point/seed_0 --episodes 400 --seed 7
    python examples/evaluate.py runs/jackal --randomization jackal_real

Writes ``evaluation/`` in the run's folder and prints a table. The layouts are others than those of
training and of the run's own evaluations. The robot can be another one, too: of a profile of mass,
friction, delay and noise (``torchrl_safe.envs.RANDOMIZATIONS``), into ``evaluation_<profile>/``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl_safe.trainers.critics import make_losses
from torchrl_safe.trainers.utils import make_env, saved_policy

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy
from torchrl_safe._files import expand, make_folder, printable
from torchrl_safe.envs import RANDOMIZATIONS, SafeGoalEnv
from torchrl_safe.record import (
    calibrate,
    describe,
    evaluate,
    format_table,
    plot_calibration,
    plot_trajectories,
    proportion_interval,
    record_trajectories,
    record_video,
    summarize,
)
from torchrl_safe.trainers.checkpoints import load_components
from torchrl_safe.trainers.run import write_results
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.streams import stream_seed

NUM_FILMED = 9
SEED = 0  # of layouts that neither training nor its evaluations see, whatever the number


class Subject(NamedTuple):
    """What is evaluated, all of one checkpoint.

    Attributes:
        cfg: the configuration.
        policy: the policy.
        cost_loss: the safety critics of a run of safetac_point.py; None for the other methods'.
    """

    cfg: DictConfig
    policy: GMMTanhPolicy
    cost_loss: CVaRCostLoss | None


def load(cfg: DictConfig, checkpoint: Path) -> Subject:
    """Read a checkpoint."""
    policy = saved_policy(cfg, checkpoint)
    if "variance_reward" not in cfg.loss:
        return Subject(cfg, policy, None)
    _, cost_loss = make_losses(cfg, make_env(cfg, num_envs=1, seed=0), policy)
    load_components(checkpoint, cost_loss=cost_loss)
    return Subject(cfg, policy, cost_loss)


def shares(episodes: TensorDictBase, prefix: str) -> dict[str, float]:
    """How many episodes met a goal, and how many violated, each with its 95 % interval."""
    metrics = {}
    for name, met in (("success", episodes["goals"] > 0), ("failure", episodes["violations"] > 0)):
        count, total = int(met.sum()), met.numel()
        low, high = proportion_interval(count, total)
        metrics |= {
            f"{prefix}{name}_rate": count / total,
            f"{prefix}{name}_rate_low": low,
            f"{prefix}{name}_rate_high": high,
        }
    return metrics


def calibration(
    env: SafeGoalEnv, policy: GMMTanhPolicy, cost_loss: CVaRCostLoss, num_steps: int, seed: int
) -> TensorDictBase:
    """The critics' predictions beside realised cost sums, under the policy they describe."""
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        env.set_seed(seed)
        torch.manual_seed(seed)
        steps = env.rollout(num_steps, policy, break_when_any_done=False)
        mean, _ = cost_loss.predict(steps, steps["action"])
        cvar = cost_loss.cvar(steps, steps["action"])
    return calibrate(
        mean,
        cvar,
        steps["next", "cost"].squeeze(-1),
        gamma=float(cost_loss.value_estimator.gamma),
        risk_level=cost_loss.risk_level,
    )


def main(
    run_dir: Path, episodes: int, seed: int, film: bool, randomization: str | None = None
) -> dict[str, float]:
    """Evaluate, draw, and return the numbers."""
    run_dir = expand(run_dir)
    # Before the episodes: a run that still trains replaces its checkpoint meanwhile.
    cfg, policy, cost_loss = from_newest(run_dir, load)
    num_steps = cfg.eval.num_steps
    seed = stream_seed("evaluate.py", seed)
    out = run_dir / (f"evaluation_{randomization}" if randomization else "evaluation")
    make_folder(out)
    options = {"episode_length": num_steps, "randomization": RANDOMIZATIONS.get(randomization)}
    env = make_env(cfg, episodes, seed, **options)
    metrics: dict[str, float] = {}
    episodes_played = {}
    for prefix, kind in (("det/", "DETERMINISTIC"), ("sampled/", "RANDOM")):
        played = evaluate(
            env,
            policy,
            num_steps=num_steps,
            exploration_type=ExplorationType[kind],
            seed=seed,
            cost_gamma=cfg.loss.get("cost_gamma", cfg.loss.gamma),
        )
        episodes_played[prefix] = describe(played)
        metrics |= summarize(played, prefix) | shares(played, prefix)
    filmed = min(episodes, NUM_FILMED)
    plot_trajectories(
        record_trajectories(env, policy, num_steps=num_steps, num_episodes=filmed, seed=seed),
        out / "trajectories.png",
    )
    if cost_loss is None:
        print("no calibration: only SafeTAC's safety critics are judged here")
    else:
        try:
            bins = calibration(env, policy, cost_loss, num_steps, seed)
        except ValueError as error:
            print(f"no calibration: {error}")
        else:
            plot_calibration(bins, out / "calibration.png")
            for name in ("mean", "cvar"):
                error = bins[f"predicted_{name}"] - bins[f"realised_{name}"]
                metrics[f"calibration/{name}_bias"] = error.mean().item()
                metrics[f"calibration/{name}_error"] = error.abs().mean().item()
    write_results(out / "results.json", {**metrics, "episodes": episodes_played})
    print(format_table(metrics))
    if film:
        small = make_env(cfg, filmed, seed, **options)
        try:
            record_video(
                small,
                policy,
                out / "video.mp4",
                num_steps=num_steps,
                every=4,
                width=320,
                height=240,
                index=range(filmed),
                seed=seed,
            )
        except RuntimeError as error:
            print(f"no video: {error}")
        small.close()
    env.close()
    print(f"written to {printable(out)}")
    return metrics


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=SEED, help="of the layouts")
    parser.add_argument("--randomization", choices=RANDOMIZATIONS, help="of the robot")
    parser.add_argument("--film", action=argparse.BooleanOptionalAction, default=True)
    main(**vars(parser.parse_args()))
