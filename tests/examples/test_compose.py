"""The composing scripts on tiny budgets: they run, and what they show is so."""

from __future__ import annotations

from pathlib import Path

import compose_constraint
import compose_retrace
import compose_tsallis
import pytest
import torch
from compose_trpo import TRPOStepper, make_env, make_trainer
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MLP

from torchrl_safe import GMMTanhPolicy
from torchrl_safe.record import read_metrics


@pytest.fixture
def policy():
    torch.manual_seed(0)
    return GMMTanhPolicy(MLP(3, 3, num_cells=[64, 64]), make_env(0).action_spec, num_components=1)


def test_scripts_are_short():
    for path in Path(compose_tsallis.__file__).parent.glob("compose_*.py"):
        lines = [line for line in path.read_text().splitlines() if line.strip()]
        assert len(lines) <= 80, f"{path.name} has {len(lines)} lines"


def test_tsallis():
    episodes = compose_tsallis.train(entropic_index=1.4, seed=0, total_frames=1_050)
    assert [frames for frames, _ in episodes] == [200, 400, 600, 800, 1000]
    assert all(-2_000 < episode_return < 0 for _, episode_return in episodes)


def test_retrace(monkeypatch):
    """The targets that SACLoss regresses on are those of the estimator, slice by slice."""
    seen = []
    estimate = compose_retrace.RetraceEstimator.value_estimate

    def spy(self, tensordict, *args, **kwargs):
        seen.append(tensordict)
        return estimate(self, tensordict, *args, **kwargs)

    monkeypatch.setattr(compose_retrace.RetraceEstimator, "value_estimate", spy)
    episodes = compose_retrace.train(lmbda=0.9, seed=0, total_frames=1_050)
    assert [frames for frames, _ in episodes] == [200, 400, 600, 800, 1000]
    assert len(seen) == 50
    assert all((sample["action_log_prob"] != 0).all() for sample in seen)
    assert all(sample["next", "done"].view(-1, 8)[:, -1].all() for sample in seen)  # cut there


def test_trpo(policy, tmp_path):
    before = torch.nn.utils.parameters_to_vector(policy.parameters()).detach().clone()
    make_trainer(make_env(0), TRPOStepper(policy), 6_400, str(tmp_path)).train()
    metrics = read_metrics(tmp_path / "log")
    steps, kl = metrics["update/kl"]
    assert steps.tolist() == [3_200, 6_400]
    assert ((kl > 0) & (kl <= 0.02 * 1.01)).all()
    assert metrics["update/case_code"][1].tolist() == [0, 0]  # unconstrained
    assert (metrics["update/accepted"][1] == 1).all()
    assert not before.equal(torch.nn.utils.parameters_to_vector(policy.parameters()))


def test_constraint(policy, tmp_path):
    env = TransformedEnv(make_env(0), compose_constraint.SpeedCost())
    check_env_specs(env)
    steps = env.rollout(30)
    speed = steps["next", "observation"][..., 2:].abs()
    assert steps["next", "cost"].equal((speed > 4).float())

    stepper = compose_constraint.ConstrainedStepper(policy, limit=0.05)
    make_trainer(env, stepper, 6_400, str(tmp_path)).train()
    metrics = read_metrics(tmp_path / "log")
    # A random policy is above 4 rad/s in more than a tenth of the steps: the constraint is
    # violated, the step repairs it, and by its own measure succeeds.
    constraint = metrics["update/constraint"][1]
    assert constraint[0] > 0
    assert metrics["update/case_code"][1].tolist()[0] in (3, 4)
    assert metrics["update/constraint_change"][1][0] < 0
