"""What became of a run: scores, failures, a map, a film, and whether its safety critic is right.

    torchrl-safe evaluate runs/safetac_point/seed_0
    torchrl-safe evaluate runs/safetac_point/seed_0 --episodes 400 --seed 7
    torchrl-safe evaluate runs/jackal --randomization jackal_real

Writes ``evaluation/`` in the run's folder and prints a table. The layouts are others than those of
training and of the run's own evaluations. The robot can be another one, too: of a profile of mass,
friction, delay and noise (``torchrl_safe.envs.RANDOMIZATIONS``), into ``evaluation_<profile>/``.
The map is drawn where there is one, goals are counted where there are any.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe import CVaRCostLoss
from torchrl_safe._files import expand, make_folder, printable
from torchrl_safe.envs import RANDOMIZATIONS
from torchrl_safe.objectives import QuantileCostLoss
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
from torchrl_safe.trainers.commands import add_env_arguments, env_maker
from torchrl_safe.trainers.off_policy import as_components
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.run import cost_gamma, write_results
from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.saved_policies import Policy, saved_policy
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.tasks import RUNNERS
from torchrl_safe.trainers.terminal import say

NUM_FILMED = 9
SEED = 0  # of layouts that neither training nor its evaluations see, whatever the number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of :func:`main`."""
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=SEED, help="of the layouts")
    parser.add_argument("--randomization", choices=RANDOMIZATIONS, help="of the robot")
    parser.add_argument("--film", action=argparse.BooleanOptionalAction, default=True)
    add_env_arguments(parser)


def main(
    run_dir: Path,
    episodes: int = 100,
    seed: int = SEED,
    film: bool = True,
    randomization: str | None = None,
    env: str | None = None,
    trust: bool = False,
) -> dict[str, float]:
    """Evaluate, draw, and return the numbers.

    Args:
        run_dir (path): the run's folder.
        episodes (int): how many are played, with sampled and with deterministic actions.
        seed (int): of the layouts and of the draws.
        film (bool): whether to film some of them.
        randomization (str, optional): a profile of the robot.
        env (str, optional): ``module:function`` that makes the environment.
        trust (bool): whether functions that the run's options name may be imported.

    Returns:
        dict: the numbers of ``results.json``.

    Raises:
        ValueError: if a robot of another profile is asked for where there is no robot.
    """
    run_dir = expand(run_dir)
    # Before the episodes: a run that still trains replaces its checkpoint meanwhile.
    make = env_maker(env, trust)
    options, policy, cost_losses = from_newest(run_dir, partial(load, make=make))
    if randomization and (env or options.env.name != "robot" or options.env.task in RUNNERS):
        raise ValueError(f"randomization={randomization} is of a robot, and this run has none.")
    num_steps = options.eval.num_steps
    seed = stream_seed("evaluate.py", seed)
    out = run_dir / (f"evaluation_{randomization}" if randomization else "evaluation")
    make_folder(out)
    how = {"randomization": RANDOMIZATIONS[randomization]} if randomization else {}
    envs = make(options, episodes, seed, **how)
    goals = "goal_met" in envs.full_observation_spec.keys()
    metrics: dict[str, float] = {}
    episodes_played = {}
    for prefix, kind in (("det/", "DETERMINISTIC"), ("sampled/", "RANDOM")):
        played = evaluate(
            envs,
            policy,
            num_steps=num_steps,
            exploration_type=ExplorationType[kind],
            seed=seed,
            cost_gamma=cost_gamma(options),
        )
        episodes_played[prefix] = describe(played)
        metrics |= summarize(played, prefix) | shares(played, prefix, goals)
    filmed = min(episodes, NUM_FILMED)
    if hasattr(envs, "layout"):
        plot_trajectories(
            record_trajectories(envs, policy, num_steps=num_steps, num_episodes=filmed, seed=seed),
            out / "trajectories.png",
        )
    if not cost_losses:
        say("no calibration: only SafeTAC's safety critics are judged here")
    for cost, loss in cost_losses.items():
        suffix = "" if len(cost_losses) == 1 else f"_{cost}"
        try:
            bins = calibration(envs, policy, loss, num_steps, seed)
        except ValueError as error:
            say(f"no calibration{suffix}: {error}")
            continue
        plot_calibration(bins, out / f"calibration{suffix}.png")
        for name in ("mean", "cvar"):
            bias = bins[f"predicted_{name}"] - bins[f"realised_{name}"]
            metrics[f"calibration{suffix}/{name}_bias"] = bias.mean().item()
            metrics[f"calibration{suffix}/{name}_error"] = bias.abs().mean().item()
            total = bins[f"predicted_{name}"].mean() / bins[f"realised_{name}"].mean()
            metrics[f"calibration{suffix}/{name}_predicted_over_realised"] = total.item()
    write_results(out / "results.json", {**metrics, "episodes": episodes_played})
    say(format_table(metrics))
    envs.close()
    if film:
        small = make(options, filmed, seed, **how)
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
        except Exception as error:  # whatever it is, the results are written
            say(f"no video: {error}")
        small.close()
    say(f"written to {printable(out)}")
    return metrics


class Subject(NamedTuple):
    """What is evaluated, all of one checkpoint.

    Attributes:
        options: the run's.
        policy: the policy.
        cost_losses: the safety critics of a run of SafeTAC, by cost; none of the other methods'.
    """

    options: MethodOptions
    policy: Policy
    cost_losses: Mapping[str, CVaRCostLoss | QuantileCostLoss]


def load(options: MethodOptions, checkpoint: Path, make: Callable[..., EnvBase]) -> Subject:
    """Read a checkpoint."""
    policy = saved_policy(options, checkpoint, make)
    if not isinstance(options, SafeTAC.Options):
        return Subject(options, policy, {})
    trainer = SafeTAC(options=options)
    trainer.build(make(options, num_envs=1, seed=0))
    load_components(checkpoint, **as_components(trainer, "cost_loss", trainer.cost_losses))
    return Subject(options, policy, trainer.cost_losses)


def shares(episodes: TensorDictBase, prefix: str, goals: bool) -> dict[str, float]:
    """How many episodes violated and, of goals, met one, each with its 95 % interval."""
    metrics: dict[str, float] = {}
    outcomes = {"success": episodes["goals"] > 0} if goals else {}
    for name, met in {**outcomes, "failure": episodes["violations"] > 0}.items():
        count, total = int(met.sum()), met.numel()
        low, high = proportion_interval(count, total)
        metrics |= {
            f"{prefix}{name}_rate": count / total,
            f"{prefix}{name}_rate_low": low,
            f"{prefix}{name}_rate_high": high,
        }
    return metrics


def calibration(
    env: EnvBase,
    policy: Policy,
    cost_loss: CVaRCostLoss | QuantileCostLoss,
    num_steps: int,
    seed: int,
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
        steps["next", cost_loss.tensor_keys.cost].squeeze(-1),
        gamma=float(cost_loss.value_estimator.gamma),
        risk_level=cost_loss.risk_level,
    )
