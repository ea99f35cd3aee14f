from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.tensordict_module import SafeModule

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TsallisLoss
from torchrl_safe.objectives.value import with_policy

OBS, ACT = 3, 2
SPEC = Bounded(-1, 1, (ACT,))


def mixture_actor():
    return GMMTanhPolicy(MLP(OBS, 3 * (1 + 2 * ACT), num_cells=[16]), SPEC, num_components=3)


def tanh_normal_actor():
    network = nn.Sequential(nn.Linear(OBS, 2 * ACT), NormalParamExtractor())
    return ProbabilisticActor(
        SafeModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=SPEC,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def critic(key, *last):
    network = MLP(OBS + ACT, 1, num_cells=[16]).extend(last)
    return ValueOperator(network, in_keys=["observation", "action"], out_keys=[key])


@pytest.fixture
def slices():
    """Pieces of trajectories: the next state of a step is the state of the following one."""
    torch.manual_seed(0)
    states = torch.randn(5, 9, OBS)
    done = torch.zeros(5, 8, 1, dtype=torch.bool)
    done[:, -1] = True
    return TensorDict(
        {
            "observation": states[:, :-1],
            "action": torch.randn(5, 8, ACT).tanh(),
            "action_log_prob": torch.randn(5, 8),
            "next": {
                "observation": states[:, 1:].clone(),
                "reward": torch.randn(5, 8, 1),
                "cost": torch.rand(5, 8, 1),
                "done": done,
                "terminated": torch.zeros_like(done),
            },
        },
        batch_size=[5, 8],
    )


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("make_actor", [mixture_actor, tanh_normal_actor])
def test_entries_are_those_of_the_policy(slices, make_actor, shifted):
    actor = make_actor()
    before = slices.clone()
    out = with_policy(slices, actor, shifted=shifted)
    assert (slices == before).all()
    assert set(slices.keys(True)) == set(before.keys(True))
    with torch.no_grad():
        log_prob = actor.get_dist(slices).log_prob(slices["action"])
        next_dist = actor.get_dist(slices["next"])
    torch.testing.assert_close(out["policy_log_prob"], log_prob)
    torch.testing.assert_close(
        out["next", "policy_log_prob"],
        next_dist.log_prob(out["next", "policy_action"]),
        rtol=1e-3,
        atol=1e-3,
    )
    assert not out["policy_log_prob"].requires_grad


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("loss_class", [TsallisLoss, CVaRCostLoss])
def test_targets_are_the_same(slices, loss_class, shifted):
    """With one draw of the next actions: each loss's own evaluation is the reference."""
    actor = mixture_actor()
    if loss_class is TsallisLoss:
        loss = TsallisLoss(actor, critic("state_action_value"), delay_qvalue=False)
        loss.make_value_estimator("retrace", gamma=0.9, lmbda=0.8)
    else:
        last = nn.Softplus()
        loss = CVaRCostLoss(actor, critic("cost_value"), critic("cost_std", last), cost_limit=1.0)
        loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    torch.manual_seed(1)
    expected = loss.compute_target(slices)
    torch.manual_seed(1)
    shared = with_policy(slices, actor, shifted=shifted)
    state = torch.get_rng_state()
    target = loss.compute_target(shared)
    torch.testing.assert_close(target, expected)
    assert (torch.get_rng_state() == state).all()  # no draw of its own


def test_a_shift_across_episodes_would_differ(slices):
    """What ``shifted`` promises is needed: elsewhere the next states are not those that follow."""
    actor = mixture_actor()
    slices["next", "observation"][:, 3] += 1.0
    torch.manual_seed(1)
    one = with_policy(slices, actor)
    torch.manual_seed(1)
    two = with_policy(slices, actor, shifted=True)
    assert (one["next", "policy_action"] != two["next", "policy_action"])[:, 3].any()


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_missing_entries(slices, key):
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        with_policy(slices.exclude(key), mixture_actor())
