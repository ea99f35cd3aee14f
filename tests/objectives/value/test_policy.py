from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.tensordict_module import SafeModule
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, RetraceEstimator, TsallisLoss
from torchrl_safe.objectives import ReturnSurrogateLoss
from torchrl_safe.objectives.value import evaluate_policy
from torchrl_safe.objectives.value.utils import behaviour_log_prob

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
def test_terms_are_those_of_the_policy(slices, make_actor, shifted):
    actor = make_actor()
    before = slices.clone()
    log_prob, next_action, next_log_prob = evaluate_policy(slices, actor, shifted=shifted)
    assert (slices == before).all()
    assert set(slices.keys(True)) == set(before.keys(True))
    with torch.no_grad():
        expected = actor.get_dist(slices).log_prob(slices["action"])
        next_dist = actor.get_dist(slices["next"])
    torch.testing.assert_close(log_prob, expected)
    torch.testing.assert_close(next_log_prob, next_dist.log_prob(next_action), rtol=1e-3, atol=1e-3)
    assert not log_prob.requires_grad


def make_loss(loss_class, actor):
    if loss_class is TsallisLoss:
        loss = TsallisLoss(actor, critic("state_action_value"), delay_qvalue=False)
        loss.make_value_estimator("retrace", gamma=0.9, lmbda=0.8)
    else:
        last = nn.Softplus()
        loss = CVaRCostLoss(actor, critic("cost_value"), critic("cost_std", last), cost_limit=1.0)
        loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    return loss


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("loss_class", [TsallisLoss, CVaRCostLoss])
def test_targets_are_the_same(slices, loss_class, shifted):
    """With one draw of the next actions: each loss's own evaluation is the reference."""
    actor = mixture_actor()
    loss = make_loss(loss_class, actor)
    torch.manual_seed(1)
    expected = loss.compute_target(slices)
    torch.manual_seed(1)
    policy = evaluate_policy(slices, actor, shifted=shifted)
    state = torch.get_rng_state()
    target = loss.compute_target(slices, policy=policy)
    torch.testing.assert_close(target, expected)
    assert (torch.get_rng_state() == state).all()  # no draw of its own


def test_a_target_of_one_step_takes_the_draws(slices):
    actor = mixture_actor()
    loss = TsallisLoss(actor, critic("state_action_value"), delay_qvalue=False)
    loss.make_value_estimator(gamma=0.9)
    policy = evaluate_policy(slices, actor)
    target = loss.compute_target(slices, policy=policy)
    expected = slices["next", "reward"] + 0.9 * (
        loss.objective(slices["next"], policy.next_action, policy.next_log_prob).unsqueeze(-1)
    )
    torch.testing.assert_close(target, expected)


@pytest.mark.parametrize("loss_class", [TsallisLoss, CVaRCostLoss])
def test_entries_of_a_past_policy_are_not_read(slices, loss_class):
    """Whatever evaluations are stored, a target follows the policy of now."""
    actor = mixture_actor()
    loss = make_loss(loss_class, actor)
    past = evaluate_policy(slices, actor)
    stale = slices.copy()
    stale["policy_log_prob"] = past.log_prob - 3.0
    stale["next", "policy_action"] = past.next_action
    stale["next", "policy_log_prob"] = past.next_log_prob
    torch.manual_seed(1)
    expected = loss.compute_target(slices)
    torch.manual_seed(1)
    torch.testing.assert_close(loss.compute_target(stale), expected)


def test_a_shift_across_episodes_would_differ(slices):
    """What ``shifted`` promises is needed: elsewhere the next states are not those that follow."""
    actor = mixture_actor()
    slices["next", "observation"][:, 3] += 1.0
    torch.manual_seed(1)
    one = evaluate_policy(slices, actor)
    torch.manual_seed(1)
    two = evaluate_policy(slices, actor, shifted=True)
    assert (one.next_action != two.next_action)[:, 3].any()


@pytest.mark.parametrize("how", ["name", "argument"])
@pytest.mark.parametrize("shifted", [False, True])
def test_time_may_be_any_dimension(slices, shifted, how):
    actor = mixture_actor()
    last = slices.transpose(0, 1).contiguous()
    last.names = [None, None] if how == "argument" else ["time", None]
    time_dim = 0 if how == "argument" else None
    log_prob, next_action, next_log_prob = evaluate_policy(
        last, actor, shifted=shifted, time_dim=time_dim
    )
    expected = evaluate_policy(slices, actor).log_prob
    torch.testing.assert_close(log_prob, expected.transpose(0, 1))
    # The draws are others, but of the distribution at their own state.
    with torch.no_grad():
        own = actor.get_dist(last["next"]).log_prob(next_action)
    torch.testing.assert_close(next_log_prob, own, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("shifted", [False, True])
def test_next_states_that_were_not_kept(slices, shifted):
    """NaN at a trajectory's end: the state before it takes its place."""
    slices["next", "observation"][:, -1] = torch.nan
    policy = evaluate_policy(slices, mixture_actor(), shifted=shifted)
    assert all(term.isfinite().all() for term in policy)


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_missing_entries(slices, key):
    with pytest.raises(KeyError, match=f"{key[-1] if isinstance(key, tuple) else key}.*(5, 8)"):
        evaluate_policy(slices.exclude(key), mixture_actor())


@pytest.mark.parametrize("make_actor", [mixture_actor, tanh_normal_actor])
@pytest.mark.parametrize("loss_class", [TsallisLoss, CVaRCostLoss])
def test_random_frames_of_a_collector(slices, make_actor, loss_class):
    """Zeros that a collector stored count as the uniform density on the box of the actor's spec."""
    loss = make_loss(loss_class, make_actor())
    random = torch.rand(5, 8) < 0.5
    known = slices.copy()
    known["action_log_prob"] = torch.where(random, -math.log(4.0), slices["action_log_prob"])
    slices["action_log_prob"] = slices["action_log_prob"].masked_fill(random, 0.0)
    policy = evaluate_policy(slices, loss.actor_network)
    target, expected = (loss.compute_target(data, policy=policy) for data in (slices, known))
    torch.testing.assert_close(target, expected)


def test_random_frames_of_agents():
    """A box for each agent."""
    low, high = torch.zeros(3, ACT), torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    actor = tanh_normal_actor()
    actor.spec["action"] = Bounded(low, high, (3, ACT))
    data = TensorDict(
        action=torch.rand(4, 6, 3, ACT), log_mu=torch.zeros(4, 6, 3), batch_size=[4, 6]
    )
    log_mu = behaviour_log_prob(data, "log_mu", actor)
    expected = -torch.tensor([2.0, 12.0, 30.0]).log().expand(4, 6, 3)
    torch.testing.assert_close(log_mu, expected)


def test_random_frames_of_a_real_collector():
    """What the collector stores is what is expected of it."""
    env = ContinuousActionVecMockEnv()
    spec = Bounded(-1.0, 1.0, env.action_spec.shape)
    width = env.observation_spec["observation"].shape[-1]
    policy = GMMTanhPolicy(nn.Linear(width, 1 + 2 * spec.shape[-1]), spec, num_components=1)
    budget = {"frames_per_batch": 20, "total_frames": 20, "init_random_frames": 20}
    collector = Collector(env, policy, **budget, auto_register_policy_transforms=False)
    (data,) = list(collector)
    collector.shutdown()
    assert not data["action_log_prob"].any()
    log_mu = behaviour_log_prob(data, "action_log_prob", policy)
    torch.testing.assert_close(log_mu, torch.full((20,), -spec.shape[-1] * math.log(2.0)))


@pytest.mark.parametrize("bias", [0.0, 12.0])
def test_a_policy_on_its_own_data(bias):
    """However saturated: Retrace(1) is the discounted return, and no step is no change."""
    torch.manual_seed(0)
    actor = GMMTanhPolicy(nn.Linear(OBS, 3), Bounded(-1, 1, (1,)), num_components=1)
    nn.init.constant_(actor[0].module[0].bias[1:2], bias)
    no = torch.zeros(4, 50, 1, dtype=torch.bool)
    following = {"observation": torch.randn(4, 50, OBS), "reward": torch.randn(4, 50, 1)}
    data = TensorDict(
        {"observation": torch.randn(4, 50, OBS), "next": {**following, "done": no}}, [4, 50]
    )
    data = actor(data).detach()
    data["state_action_value"] = data["next", "state_value"] = torch.zeros(4, 50, 1)
    estimator = RetraceEstimator(gamma=0.9, lmbda=1.0, actor_network=actor)
    discounts = 0.9 ** torch.arange(50.0).unsqueeze(-1)
    expected = (discounts * data["next", "reward"]).sum(1)
    torch.testing.assert_close(estimator.value_estimate(data)[:, 0], expected)

    loss = ReturnSurrogateLoss(ValueOperator(MLP(OBS, 1, num_cells=[8])))
    policy = evaluate_policy(data, actor)
    steps = loss.compute_advantage(data, policy_log_prob=policy.log_prob)
    log_prob = actor.get_dist(steps).log_prob(steps["action"])
    change = loss.objective(steps, log_prob)
    assert change.item() == pytest.approx(0, abs=1e-4)
    change.backward()
    assert actor[0].module[0].weight.grad.abs().sum() > 1e-3
