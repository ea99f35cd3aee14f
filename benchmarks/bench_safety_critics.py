"""What safety critics predict of a fixed policy, beside what happens on layouts they have not seen.

    python benchmarks/bench_safety_critics.py [--robot point] [--envs 300] [--steps 260] [--seed 0]

The policy drives ahead and turns at random. Every critic learns from the same steps for as many
gradient steps. Printed are the mean predicted and realised CVaR over the first 100 steps of new
layouts: the realised one is the mean over tenths of the predictions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

from torchrl_safe import CVaRCostLoss
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.objectives import QuantileCostLoss
from torchrl_safe.objectives.common import CriticCostLoss
from torchrl_safe.record import calibrate

GAMMA, RISK_LEVEL, START = 0.99, 0.125, 100


class Ahead(nn.Module):
    """Parameters of a policy that drives ahead, whatever it sees."""

    def __init__(self, action_dim: int) -> None:
        super().__init__()
        params = torch.tensor([0.8, *[0.0] * (action_dim - 1), *[0.0] * action_dim])
        self.params = nn.Parameter(params)

    def forward(self, observation: Tensor) -> Tensor:
        """The parameters, for every observation."""
        return self.params.expand(*observation.shape[:-1], -1)


def make_policy(env: SafeGoalEnv) -> ProbabilisticActor:
    action_dim = env.action_spec.shape[-1]
    net = nn.Sequential(Ahead(action_dim), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=env.action_spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_losses(env: SafeGoalEnv, policy: ProbabilisticActor) -> dict[str, CriticCostLoss]:
    inputs = env.observation_spec["observation"].shape[-1] + env.action_spec.shape[-1]

    def critic(key: str, outputs: int, *last: nn.Module) -> ValueOperator:
        net = MLP(inputs, outputs, num_cells=[128, 128], activation_class=nn.ReLU).extend(last)
        return ValueOperator(net, in_keys=["observation", "action"], out_keys=[key])

    options = {"cost_limit": 5.0, "risk_level": RISK_LEVEL}
    gaussian = CVaRCostLoss(
        policy, critic("cost_value", 1), critic("cost_std", 1, nn.Softplus()), **options
    )
    gaussian.make_value_estimator("retrace", gamma=GAMMA, lmbda=0.97)
    losses: dict[str, CriticCostLoss] = {"Gaussian, Retrace": gaussian}
    for name, kind, lmbda in (
        ("64 quantiles, sums of real costs", "td1", {}),
        ("64 quantiles, TD(.97)", "tdlambda", {"lmbda": 0.97}),
    ):
        loss = QuantileCostLoss(policy, critic("cost_quantiles", 64), **options)
        losses[name] = loss.make_value_estimator(kind, gamma=GAMMA, **lmbda)
    return losses


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    for index in torch.randperm(data.numel()).split(size):
        yield data[index]


def fit(loss: CriticCostLoss, data: TensorDictBase, rounds: int, steps_per_round: int) -> None:
    """Targets of all steps once a round, and gradient steps on them, as in training."""
    optim = torch.optim.Adam(loss.parameters(), lr=1e-3)
    keys = loss.tensor_keys
    names = (keys.cost_target, getattr(keys, "std_target", getattr(keys, "target_weight", None)))
    flat = data.select("observation", "action").flatten()
    for step in range(rounds):
        optim.param_groups[0]["lr"] = 1e-3 * (1 - step / rounds)
        for name, target in zip(names, loss.compute_target(data), strict=True):
            flat[name] = target.flatten(0, 1)
        for batch, _ in zip(minibatches(flat, 1024), range(steps_per_round), strict=False):
            losses = loss(batch)
            optim.zero_grad()
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            optim.step()


def play(env: SafeGoalEnv, policy: ProbabilisticActor, steps: int) -> TensorDict:
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        return env.rollout(steps, policy, break_when_any_done=False)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--robot", default="point")
    parser.add_argument("--envs", type=int, default=300)
    parser.add_argument("--steps", type=int, default=260)
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--gradient-steps", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    torch.manual_seed(args.seed)
    options = {"num_envs": args.envs, "num_threads": 1}
    env = SafeGoalEnv(args.robot, seed=args.seed, **options)
    policy = make_policy(env)
    data = play(env, policy, args.steps)
    unseen = play(SafeGoalEnv(args.robot, seed=args.seed + 1000, **options), policy, START + 400)
    cost = unseen["next", "cost"].squeeze(-1)
    print(f"{data.numel()} steps, {args.envs} layouts; mean cost {data['next', 'cost'].mean():.4f}")
    for name, loss in make_losses(env, policy).items():
        start = time.process_time()
        fit(loss, data, args.rounds, args.gradient_steps)
        seconds = time.process_time() - start
        with torch.no_grad():
            mean, _ = loss.predict(unseen, unseen["action"])
            cvar = loss.cvar(unseen, unseen["action"])
        bins = calibrate(
            mean, cvar, cost, gamma=GAMMA, risk_level=RISK_LEVEL, tail=GAMMA ** (400 - 1)
        )
        share = bins["predicted_cvar"] / bins["realised_cvar"]
        predicted, realised = bins["predicted_cvar"].mean(), bins["realised_cvar"].mean()
        print(
            f"{name:34s} mean {bins['predicted_mean'].mean():6.2f} of "
            f"{bins['realised_mean'].mean():6.2f}   CVaR {predicted:6.2f} of {realised:6.2f} = "
            f"{predicted / realised:.2f}   tenths {share.min():.2f} to {share.max():.2f}   "
            f"{seconds:.0f} s"
        )


if __name__ == "__main__":
    main()
