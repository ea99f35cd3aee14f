"""The estimator: what it reads and computes, alone and inside TorchRL's losses."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import nullcontext

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictSequential,
    set_skip_existing,
)
from torch import Tensor, nn
from torchrl.data import (
    Bounded,
    Categorical,
    LazyTensorStorage,
    OneHot,
    SliceSampler,
    TensorDictReplayBuffer,
)
from torchrl.modules import (
    MLP,
    GRUModule,
    LSTMModule,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import (
    DDPGLoss,
    DiscreteIQLLoss,
    DiscreteSACLoss,
    DQNLoss,
    IQLLoss,
    LossModule,
    SACLoss,
    SoftUpdate,
    TD3Loss,
)
from torchrl.objectives.value import TD0Estimator, TDLambdaEstimator
from torchrl.testing import get_default_devices

from torchrl_safe.objectives.value import RetraceEstimator, trace_lambda_return_estimate

RETRACE = "retrace"
GAMMA, LMBDA = 0.99, 0.9
OBS, ACT = 3, 2


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(0)


def make_actor(observation="observation", action="action") -> ProbabilisticActor:
    net = nn.Sequential(MLP(OBS, 2 * ACT, num_cells=[8]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=[observation], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        out_keys=[action],
        spec=Bounded(-1, 1, (ACT,)) if action == "action" else None,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_critic(observation="observation", action="action", **kwargs) -> ValueOperator:
    return ValueOperator(MLP(OBS + ACT, 1, num_cells=[8]), in_keys=[observation, action], **kwargs)


def make_data(*batch: int) -> TensorDict:
    done = torch.rand(*batch, 1) < 0.3
    return TensorDict(
        {
            "observation": torch.randn(*batch, OBS),
            "action": torch.rand(*batch, ACT) * 1.8 - 0.9,
            "action_log_prob": torch.randn(batch) - 1,
            "next": {
                "observation": torch.randn(*batch, OBS),
                "reward": torch.randn(*batch, 1),
                "done": done,
                "terminated": done & (torch.rand(*batch, 1) < 0.5),
            },
        },
        batch,
    )


def make_precomputed(*batch: int) -> TensorDict:
    """Data with every input in it: no network is needed."""
    data = make_data(*batch)
    data["policy_log_prob"] = torch.randn(batch)
    data["state_action_value"] = torch.randn(*batch, 1)
    data["next", "state_value"] = torch.randn(*batch, 1)
    return data


def reference(data: TensorDictBase, lmbda: float = LMBDA, gamma: float = GAMMA, **overrides):
    """The functional on precomputed entries; time last."""
    inputs = {
        "log_pi": data.get("policy_log_prob", None),
        "log_mu": data["action_log_prob"],
        "action_value": data.get("state_action_value", None),
        "next_state_value": data.get(("next", "state_value"), None),
        **overrides,
    }
    for name in ("log_pi", "log_mu"):
        inputs[name] = inputs[name].reshape(*data.batch_size, 1)
    flags = {name: data["next", name] for name in ("reward", "done", "terminated")}
    return trace_lambda_return_estimate(gamma, lmbda, **inputs, **flags)


class Forbidden(nn.Module):
    def forward(self, *args: Tensor) -> Tensor:
        raise AssertionError("this network was not to be called")


# Alone ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", [(7,), (4, 7), (2, 3, 7)])
def test_precomputed(batch: tuple[int, ...]) -> None:
    data = make_precomputed(*batch)
    expected = reference(data)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    torch.testing.assert_close(estimator.value_estimate(data.copy()), expected)
    out = estimator(data)
    assert out is data
    torch.testing.assert_close(out["value_target"], expected)
    torch.testing.assert_close(out["advantage"], expected - data["state_action_value"])


def test_log_densities_with_a_feature_dimension() -> None:
    data = make_precomputed(4, 7)
    expected = reference(data)
    for key in ("policy_log_prob", "action_log_prob"):
        data[key] = data[key].unsqueeze(-1)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    torch.testing.assert_close(estimator.value_estimate(data), expected)


def test_networks_compute_what_is_missing() -> None:
    actor, critic, data = make_actor(), make_critic(), make_data(4, 7)
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=actor, qvalue_network=critic
    )
    keys = set(data.keys(True, True))
    torch.manual_seed(1)
    out = estimator(data.copy())
    assert set(out.keys(True, True)) == keys | {"advantage", "value_target"}

    # The log-density of the stored action, by the change of variables.
    with torch.no_grad():
        loc, scale = actor.module[0].module(data["observation"])
        normal = torch.distributions.Normal(loc, scale)
        raw = data["action"].atanh()
        log_pi = (normal.log_prob(raw) - (1 - data["action"].square()).log()).sum(-1)
        value = critic.module(data["observation"], data["action"])
        torch.manual_seed(1)
        next_action = actor.get_dist(data["next"]).sample()
        next_value = critic.module(data["next", "observation"], next_action)
    expected = reference(data, log_pi=log_pi, action_value=value, next_state_value=next_value)
    torch.testing.assert_close(out["value_target"], expected, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(out["advantage"], expected - value, rtol=1e-4, atol=1e-4)
    assert not out["value_target"].requires_grad


@pytest.mark.parametrize("how", ["argument", "context", "no network"])
def test_existing_entries_are_used(how: str) -> None:
    data = make_precomputed(4, 7)
    networks = {}
    if how != "no network":
        actor, critic = make_actor(), make_critic()
        actor.module[0].module, critic.module = Forbidden(), Forbidden()
        networks = {"actor_network": actor, "qvalue_network": critic}
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, **networks, skip_existing=True if how == "argument" else None
    )
    with set_skip_existing(True) if how == "context" else nullcontext():
        torch.testing.assert_close(estimator.value_estimate(data), reference(data))
        torch.testing.assert_close(estimator(data)["value_target"], reference(data))


@pytest.mark.parametrize("skip_existing", [None, False])
def test_networks_win_by_default(skip_existing: bool | None) -> None:
    data = make_precomputed(4, 7)
    settings = {
        "gamma": GAMMA,
        "lmbda": LMBDA,
        "actor_network": make_actor(),
        "qvalue_network": make_critic(),
    }
    estimator = RetraceEstimator(**settings, skip_existing=skip_existing)
    fresh = data.exclude("state_action_value", ("next", "state_value"))
    if skip_existing is False:
        del fresh["policy_log_prob"]
    targets = []
    for each in (fresh, data):
        torch.manual_seed(1)
        targets.append(estimator.value_estimate(each))
    torch.testing.assert_close(*targets)
    assert not torch.allclose(targets[0], reference(data))


def test_params_and_target_params() -> None:
    data = make_precomputed(4, 7).exclude("state_action_value")
    critics = [make_critic() for _ in range(3)]
    values = [critic(data.copy())["state_action_value"].detach() for critic in critics]
    params = [TensorDict.from_module(critic).detach() for critic in critics]
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, qvalue_network=make_critic())

    target = reference(data, action_value=values[0])
    torch.testing.assert_close(estimator.value_estimate(data, target_params=params[0]), target)
    out = estimator(data.copy(), params=params[0])
    torch.testing.assert_close(out["value_target"], target)
    torch.testing.assert_close(out["advantage"], target - values[0])
    out = estimator(data.copy(), params=params[1], target_params=params[0])
    torch.testing.assert_close(out["value_target"], target)
    torch.testing.assert_close(out["advantage"], target - values[1])

    # Parameters with a batch dimension are an ensemble: the smallest value counts.
    smallest = torch.stack(values).min(0).values
    for deactivate_vmap in (False, True):
        estimator.deactivate_vmap = deactivate_vmap
        out = estimator.value_estimate(data, target_params=torch.stack(params))
        torch.testing.assert_close(out, reference(data, action_value=smallest))


CHUNKS = [
    {"value_chunk_size": 2},
    {"num_chunks": 3},
    {"value_chunk_size": 3, "value_chunk_dim": 1},
    {"num_chunks": 3, "value_chunk_dim": 1},
]


@pytest.mark.parametrize("chunks", CHUNKS)
def test_chunks(chunks: dict[str, int]) -> None:
    data = make_precomputed(5, 7).exclude("state_action_value")
    critic = make_critic()
    sizes = []
    critic.register_forward_pre_hook(lambda module, args: sizes.append(args[0].batch_size))
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "qvalue_network": critic}
    expected = RetraceEstimator(**settings).value_estimate(data)
    assert sizes.pop() == (5, 7)
    torch.testing.assert_close(
        RetraceEstimator(**settings, **chunks).value_estimate(data), expected
    )
    dim = chunks.get("value_chunk_dim", 0)
    assert len(sizes) == 3
    assert sum(size[dim] for size in sizes) == data.shape[dim]


@pytest.mark.parametrize("chunks", CHUNKS)
@pytest.mark.parametrize("deactivate_vmap", [False, True])
@pytest.mark.parametrize("call", ["forward", "shifted", "ensemble", "value_estimate"])
def test_chunks_everywhere(call: str, deactivate_vmap: bool, chunks: dict[str, int]) -> None:
    data, actor = make_data(4, 5), make_actor()
    critics = [make_critic() for _ in range(2)]
    params = torch.stack([TensorDict.from_module(critic).detach() for critic in critics])
    results = []
    for extra in ({}, chunks):
        estimator = RetraceEstimator(
            gamma=GAMMA,
            lmbda=LMBDA,
            actor_network=actor,
            qvalue_network=critics[0],
            shifted=call == "shifted",
            deactivate_vmap=deactivate_vmap,
            **extra,
        )
        torch.manual_seed(1)
        if call == "value_estimate":
            results.append(estimator.value_estimate(data, target_params=params))
        elif call == "ensemble":
            out = estimator(data.copy(), params=params, target_params=params.flip(0))
            results.append(out["advantage"])
        else:
            results.append(estimator(data.copy())["advantage"])
    torch.testing.assert_close(*results)


def test_chunk_settings_exclude_each_other() -> None:
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "qvalue_network": make_critic()}
    with pytest.raises(ValueError, match="value_chunk_size and num_chunks"):
        RetraceEstimator(**settings, value_chunk_size=3, num_chunks=2)
    estimator = RetraceEstimator(**settings, num_chunks=2, value_chunk_dim=2)
    with pytest.raises(ValueError, match="value_chunk_dim"):
        estimator(make_precomputed(4, 7))


def test_next_value_argument() -> None:
    data = make_precomputed(4, 7)
    next_value = torch.randn(4, 7, 1)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data, next_value=next_value)
    torch.testing.assert_close(target, reference(data, next_state_value=next_value))


def test_missing_terminated_is_done() -> None:
    data = make_precomputed(4, 7)
    del data["next", "terminated"]
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data)
    data["next", "terminated"] = data["next", "done"]
    torch.testing.assert_close(target, reference(data))


@pytest.mark.parametrize("how", ["constructor", "call", "name"])
def test_time_dim(how: str) -> None:
    data = make_precomputed(4, 7)
    expected = reference(data)
    moved = data.transpose(0, 1).contiguous()
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, time_dim=0 if how == "constructor" else None
    )
    if how == "name":
        moved.names = ["time", None]
    target = estimator.value_estimate(moved, time_dim=-2 if how == "call" else None)
    torch.testing.assert_close(target, expected.transpose(0, 1))


def test_flat_slices() -> None:
    """A flat sample of slices has the targets of the same slices side by side."""
    num_slices, steps = 4, 5
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(40),
        sampler=SliceSampler(slice_len=steps, traj_key="episode", strict_length=True),
        batch_size=num_slices * steps,
    )
    stored = make_precomputed(40)
    stored["episode"] = torch.arange(40) // 10
    stored["next", "done"] = stored["next", "terminated"] = torch.zeros(40, 1, dtype=torch.bool)
    buffer.extend(stored)
    flat = buffer.sample()
    assert flat.shape == (num_slices * steps,)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    target = estimator.value_estimate(flat)
    apart = flat.reshape(num_slices, steps)
    apart["next", "done"] = torch.zeros_like(apart["next", "done"])
    torch.testing.assert_close(target, reference(apart).flatten(0, 1))


def test_keys() -> None:
    data = make_precomputed(4, 7)
    renamed = TensorDict(
        {
            "critic": {"q": data["state_action_value"]},
            "agent": {"log_mu": data["action_log_prob"], "log_pi": data["policy_log_prob"]},
            "next": {
                "v": data["next", "state_value"],
                "cost": data["next", "reward"],
                "flags": data["next"].select("done", "terminated"),
            },
        },
        data.batch_size,
    )
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    estimator.set_keys(
        advantage=("out", "advantage"),
        value_target=("out", "target"),
        value="v",
        state_action_value=("critic", "q"),
        reward="cost",
        done=("flags", "done"),
        terminated=("flags", "terminated"),
        sample_log_prob=("agent", "log_mu"),
        policy_log_prob=("agent", "log_pi"),
    )
    out = estimator(renamed)
    torch.testing.assert_close(out["out", "target"], reference(data))
    assert estimator.out_keys == [("out", "advantage"), ("out", "target")]
    assert ("out", "advantage") in out.keys(True)


def test_nested_keys_of_networks() -> None:
    observation, action = ("agent", "obs"), ("agent", "act")
    actor = make_actor(observation, action)
    critic = make_critic(observation, action, out_keys=[("agent", "q")])
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=actor, qvalue_network=critic
    )
    estimator.set_keys(state_action_value=("agent", "q"))
    assert estimator.tensor_keys.action == action
    assert estimator.tensor_keys.sample_log_prob == ("agent", "act_log_prob")
    data = make_data(4, 7)
    nested = TensorDict({"next": data["next"].exclude("observation")}, data.batch_size)
    nested["next", "agent", "obs"] = data["next", "observation"]
    nested["agent", "obs"], nested["agent", "act"] = data["observation"], data["action"]
    nested["agent", "act_log_prob"] = data["action_log_prob"]

    plain = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=make_actor(), qvalue_network=make_critic()
    )
    plain.actor_network.load_state_dict(actor.state_dict())
    plain.qvalue_network.load_state_dict(critic.state_dict())
    targets = []
    for each, inputs in ((plain, data), (estimator, nested)):
        torch.manual_seed(1)
        targets.append(each.value_estimate(inputs))
    torch.testing.assert_close(*targets)


def test_set_keys_rejects() -> None:
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    before = estimator.tensor_keys
    with pytest.raises(KeyError, match="cost is not an accepted tensordict key"):
        estimator.set_keys(reward="r", cost="c")
    with pytest.raises(ValueError, match="tensordict keys cannot be None"):
        estimator.set_keys(reward=None)
    with pytest.raises(ValueError, match="key name must be of type NestedKey"):
        estimator.set_keys(reward=3)
    assert estimator.tensor_keys == before


def test_dispatch() -> None:
    data = make_data(4, 7)
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=make_actor(), qvalue_network=make_critic()
    )
    torch.manual_seed(1)
    expected = estimator(data.copy())
    torch.manual_seed(1)
    advantage, target = estimator(
        observation=data["observation"],
        action=data["action"],
        action_log_prob=data["action_log_prob"],
        **{f"next_{key}": value for key, value in data["next"].items()},
    )
    torch.testing.assert_close(target, expected["value_target"])
    torch.testing.assert_close(advantage, expected["advantage"])


def test_one_call_of_the_critic_per_state() -> None:
    data, critic, calls = make_precomputed(4, 7), make_critic(), []
    critic.register_forward_hook(lambda *args: calls.append(args))
    RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, qvalue_network=critic)(
        data.exclude("state_action_value")
    )
    assert len(calls) == 1


def test_in_keys_suffice() -> None:
    data = make_precomputed(4, 7)
    networks = {"actor_network": make_actor(), "qvalue_network": make_critic()}
    for chosen in ({}, {"actor_network": networks["actor_network"]}, networks):
        estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, **chosen)
        estimator(data.select(*estimator.in_keys))
        needed = data.select(*estimator.in_keys)
        assert set(estimator.in_keys) == set(needed.keys(True, True))


@pytest.mark.parametrize("differentiable", [True, False])
def test_differentiable(differentiable: bool) -> None:
    data = make_precomputed(4, 7)
    reward = data["next", "reward"].requires_grad_()
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, differentiable=differentiable)
    out = estimator(data)
    assert out["value_target"].requires_grad is differentiable
    assert out["advantage"].requires_grad is differentiable
    if differentiable:
        (gradient,) = torch.autograd.grad(out["value_target"].sum(), reward)
        (expected,) = torch.autograd.grad(reference(data).sum(), reward)
        torch.testing.assert_close(gradient, expected)


def test_networks_get_no_gradient() -> None:
    data, actor, critic = make_data(4, 7), make_actor(), make_critic()
    data["next", "reward"].requires_grad_()
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=actor, qvalue_network=critic, differentiable=True
    )
    estimator(data)["advantage"].sum().backward()
    assert all(p.grad is None for net in (actor, critic) for p in net.parameters())


def test_average_rewards() -> None:
    data = make_precomputed(4, 7)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, average_rewards=True).value_estimate(data)
    reward = data["next", "reward"]
    data["next", "reward"] = (reward - reward.mean()) / reward.std()
    torch.testing.assert_close(target, reference(data))


def test_settings_are_not_state() -> None:
    actor, critic = make_actor(), make_critic()
    estimator = RetraceEstimator(
        gamma=torch.tensor([0.5]), lmbda=1, actor_network=actor, qvalue_network=critic
    )
    assert not estimator.state_dict()
    assert not list(estimator.parameters())
    assert estimator.gamma.shape == estimator.lmbda.shape == ()
    assert estimator.to(torch.float64).gamma.item() == 0.5


@pytest.mark.parametrize("name", ["gamma", "lmbda"])
@pytest.mark.parametrize("value", [-0.1, 1.01, float("nan"), torch.tensor(2.0), torch.ones(2)])
def test_bad_coefficients(name: str, value: float | Tensor) -> None:
    with pytest.raises(ValueError, match=rf"{name} must be one number in \[0, 1\]"):
        RetraceEstimator(**{"gamma": GAMMA, "lmbda": LMBDA, name: value})


@pytest.mark.parametrize(
    "key",
    [
        "policy_log_prob",
        "state_action_value",
        "action_log_prob",
        ("next", "state_value"),
        ("next", "reward"),
        ("next", "done"),
    ],
)
def test_missing_entries(key: str | tuple[str, str]) -> None:
    data = make_precomputed(4, 7).exclude(key)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    with pytest.raises(KeyError) as error:
        estimator(data)
    assert repr(key) in str(error.value)
    assert "value_target" not in data


@pytest.mark.parametrize("key", ["observation", "action", ("next", "observation")])
def test_missing_inputs_of_networks(key: str | tuple[str, str]) -> None:
    data = make_data(4, 7).exclude(key)
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=make_actor(), qvalue_network=make_critic()
    )
    with pytest.raises(KeyError, match=key if isinstance(key, str) else key[-1]):
        estimator(data)


def test_critic_that_writes_another_key() -> None:
    critic = make_critic(out_keys=["q"])
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, qvalue_network=critic)
    data = make_precomputed(4, 7).exclude("state_action_value")
    with pytest.raises(KeyError, match="state_action_value"):
        estimator(data)


def test_bad_data() -> None:
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    with pytest.raises(RuntimeError, match="no dimension of time"):
        estimator(make_precomputed(1)[0])
    data = make_precomputed(4, 7)
    data["policy_log_prob"] = torch.randn(4, 7, ACT)
    with pytest.raises(ValueError, match=r"'policy_log_prob'.*\(4, 7, 2\).*reward's \(4, 7, 1\)"):
        estimator(data)


@pytest.mark.parametrize("part", ["value_estimate", "forward"])
def test_compile(part: str) -> None:
    data = make_precomputed(4, 7)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    expected = estimator(data.copy())["value_target"]
    if part == "forward":
        compiled = torch.compile(estimator, backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(data)["value_target"], expected)
    else:
        compiled = torch.compile(estimator.value_estimate, backend="eager", fullgraph=True)
        torch.testing.assert_close(compiled(data), expected)


def test_vmap() -> None:
    data = make_precomputed(3, 4, 7)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    target = torch.vmap(estimator.value_estimate)(data)
    torch.testing.assert_close(target, reference(data))


def test_vectorized() -> None:
    data = make_precomputed(4, 7)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, vectorized=False).value_estimate(data)
    torch.testing.assert_close(target, reference(data))


def test_bfloat16() -> None:
    data = make_precomputed(4, 50)
    half = data.apply(lambda x: x.bfloat16() if x.is_floating_point() else x)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(half)
    assert target.dtype == torch.bfloat16
    torch.testing.assert_close(target.float(), reference(data), rtol=0.02, atol=0.05)


def test_group_key() -> None:
    """Rewards of one task on another scale do not weigh more."""
    data = make_precomputed(4, 7)
    data["task"] = torch.tensor([[3], [1], [3], [1]]).expand(4, 7)
    data["next", "reward"][::2] *= 100
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, average_rewards=True, group_key="task")
    assert "task" in estimator.in_keys
    target = estimator.value_estimate(data)
    reward = data["next", "reward"].clone()
    for rows in (slice(0, None, 2), slice(1, None, 2)):
        reward[rows] = (reward[rows] - reward[rows].mean()) / reward[rows].std()
    data["next", "reward"] = reward
    torch.testing.assert_close(target, reference(data), rtol=1e-4, atol=1e-4)
    with pytest.raises(KeyError, match="group_key 'task' is missing"):
        estimator.value_estimate(data.exclude("task"))


def test_steps_to_next_obs() -> None:
    """The discount of n-step transitions; on-policy, where Q(s, a) = V(s), they are TD(lambda)."""
    data = make_precomputed(4, 7)
    steps = torch.randint(1, 4, (4, 7, 1))
    expected = reference(data, gamma=torch.tensor(GAMMA) ** steps)
    data["steps_to_next_obs"] = steps
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data)
    torch.testing.assert_close(target, expected)

    data["action_log_prob"] = data["policy_log_prob"]
    follows = ~data["next", "done"][:, :-1]
    next_value = data["next", "state_value"]
    next_value[:, :-1] = torch.where(follows, data["state_action_value"][:, 1:], next_value[:, :-1])
    expected = TDLambdaEstimator(
        gamma=GAMMA, lmbda=LMBDA, value_network=None, vectorized=False
    ).value_estimate(data, next_value=next_value)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data)
    torch.testing.assert_close(target, expected)


def test_value_network() -> None:
    data = make_precomputed(4, 7)
    values = [ValueOperator(MLP(OBS, 1, num_cells=[8]), in_keys=["observation"]) for _ in range(2)]
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, value_network=values[0])
    next_values = [value.module(data["next", "observation"]).detach() for value in values]
    expected = [reference(data, next_state_value=value) for value in next_values]
    torch.testing.assert_close(estimator.value_estimate(data), expected[0])
    torch.testing.assert_close(estimator(data.copy())["value_target"], expected[0])
    params = TensorDict.from_module(values[1]).detach()
    torch.testing.assert_close(estimator.value_estimate(data, params), expected[1])
    out = estimator(data.copy(), target_params=params)
    torch.testing.assert_close(out["value_target"], expected[1])


def test_num_next_actions() -> None:
    data, actor, critic = make_data(4, 7), make_actor(), make_critic()
    settings = {"gamma": GAMMA, "lmbda": 0.0, "actor_network": actor, "qvalue_network": critic}
    torch.manual_seed(1)
    target = RetraceEstimator(**settings, num_next_actions=3).value_estimate(data)
    torch.manual_seed(1)
    dist = actor.get_dist(data["next"])
    observation = data["next", "observation"]
    values = [critic.module(observation, dist.sample()).detach() for _ in range(3)]
    mean = sum(values) / 3 * ~data["next", "terminated"]
    torch.testing.assert_close(target, data["next", "reward"] + GAMMA * mean)
    with pytest.raises(ValueError, match="num_next_actions must be at least 1, got 0"):
        RetraceEstimator(**settings, num_next_actions=0)


def make_shifted_data(truncations: int) -> TensorDict:
    """One rollout of 8 steps: a step's next observation is the following step's."""
    data = make_data(8)
    done = torch.zeros(8, 1, dtype=torch.bool)
    done[[2, 4][:truncations]] = True
    data["next"].update({"done": done, "terminated": torch.zeros_like(done)})
    follows = ~done[:-1]
    data["next", "observation"][:-1] = torch.where(
        follows, data["observation"][1:], data["next", "observation"][:-1]
    )
    return data


class StateCritic(nn.Module):
    """A critic that ignores the action: its targets do not depend on the draws."""

    def __init__(self) -> None:
        super().__init__()
        self.net = MLP(OBS, 1, num_cells=[8])

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.net(observation)


@pytest.mark.parametrize(("truncations", "budget", "kept"), [(0, 1, 8), (2, 3, 8), (2, 1, 6)])
def test_shifted(truncations: int, budget: int, kept: int) -> None:
    data, actor = make_shifted_data(truncations), make_actor()
    critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
    actor_states = []
    actor.module[0].register_forward_pre_hook(
        lambda module, args: actor_states.append(args[0].shape[0])
    )
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "actor_network": actor, "qvalue_network": critic}
    expected = RetraceEstimator(**settings)(data.copy())
    assert sum(actor_states) == 16
    actor_states.clear()
    estimator = RetraceEstimator(**settings, shifted=True, shifted_budget=budget)
    out = estimator(data.copy())
    assert sum(actor_states) == 8 + budget
    assert out["shifted_valid"].sum() == kept
    assert out["shifted_valid"][:kept].all()
    if kept == 8:
        torch.testing.assert_close(out["value_target"], expected["value_target"])
        torch.testing.assert_close(out["advantage"], expected["advantage"])
    else:
        # What fits is a shorter slice: its last step bootstraps, and no trace comes from beyond.
        short = RetraceEstimator(**settings)(data[:kept].copy())
        torch.testing.assert_close(out["value_target"][:kept], short["value_target"])
        assert not out["value_target"][kept:].any()


def make_rows() -> TensorDict:
    """Rows of 8 steps with two truncations, two terminations, none, and one of each."""
    rows = torch.stack([make_shifted_data(2), *(make_shifted_data(0) for _ in range(2))])
    rows = torch.cat([rows, make_shifted_data(1)[None]])
    done, terminated = rows["next", "done"], rows["next", "terminated"]
    done[1, [2, 4]] = terminated[1, [2, 4]] = True
    done[3, 5] = terminated[3, 5] = True
    return rows


@pytest.mark.parametrize("time_dim", [0, 1])
@pytest.mark.parametrize("budget", [1, 2, 3])
def test_shifted_rows(budget: int, time_dim: int) -> None:
    """Only truncations use up the budget, row by row; what is kept is as without."""
    data, actor = make_rows(), make_actor()
    critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "actor_network": actor, "qvalue_network": critic}
    lost = torch.tensor([2, 0, 0, 1]) + 1 - budget
    lost = lost.where(torch.tensor([True, False, False, True]), 0).clamp_min(0)
    valid = torch.zeros(4, 8, dtype=torch.bool)
    short = data.copy()
    for row, number in enumerate(lost.tolist()):
        valid[row, : 8 - number] = True
        if number:
            # The last step that fits ends a slice.
            short["next", "done"] = short["next", "done"].clone()
            short["next", "done"][row, 7 - number] = True
    expected = RetraceEstimator(**settings)(short)
    estimator = RetraceEstimator(**settings, shifted=True, shifted_budget=budget)
    rows = data.copy()
    if time_dim == 0:
        rows = rows.transpose(0, 1)
        assert not rows["observation"].is_contiguous()
        rows.names = ["time", None]
    out = estimator(rows)
    out = out.transpose(0, 1) if time_dim == 0 else out
    assert out["shifted_valid"].equal(valid)
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(out[key][valid], expected[key][valid])
        assert not out[key][~valid].any()


def test_shifted_mask_is_that_of_the_call() -> None:
    critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, actor_network=make_actor(), qvalue_network=critic, shifted=True
    )
    assert not estimator(make_shifted_data(2))["shifted_valid"].all()
    assert estimator(make_shifted_data(0))["shifted_valid"].all()


def test_shifted_without_next_observations() -> None:
    """The states of a rollout are enough, but for one beyond its end."""
    data, actor = make_shifted_data(0), make_actor()
    data["next", "done"][[2, 7]] = data["next", "terminated"][[2, 7]] = True
    critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "actor_network": actor, "qvalue_network": critic}
    expected = RetraceEstimator(**settings)(data.copy())
    del data["next", "observation"]
    out = RetraceEstimator(**settings, shifted=True)(data)
    assert ("next", "observation") not in data.keys(True)
    torch.testing.assert_close(out["value_target"], expected["value_target"])
    torch.testing.assert_close(out["advantage"], expected["advantage"])


@pytest.mark.parametrize("networks", ["actor and critic", "value", "discrete"])
@pytest.mark.parametrize("shifted", [False, True])
def test_next_observations_that_are_nan(networks: str, shifted: bool) -> None:
    """What a compact collector leaves at the end: never read if terminal, else the state before."""
    if networks == "value" and shifted:
        pytest.skip("shifted takes no value_network")
    data = make_shifted_data(0)
    data["next", "done"][[3, 7]] = True
    data["next", "terminated"][3] = True
    if networks == "value":
        data["policy_log_prob"], data["state_action_value"] = torch.randn(8), torch.randn(8, 1)
        value = ValueOperator(MLP(OBS, 1, num_cells=[8]), in_keys=["observation"])
        chosen = {"value_network": value}
    elif networks == "discrete":
        actor, critic = make_discrete("categorical")
        data["action"] = torch.randint(NUM_ACTIONS, (8,))
        chosen = {"actor_network": actor, "qvalue_network": critic, "action_space": "categorical"}
    else:
        critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
        chosen = {"actor_network": make_actor(), "qvalue_network": critic}
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, **chosen, shifted=shifted)
    data["next", "observation"][7] = data["observation"][7]
    expected = estimator(data.copy())
    data["next", "observation"][[3, 7]] = float("nan")
    out = estimator(data.copy())
    for key in ("advantage", "value_target"):
        torch.testing.assert_close(out[key], expected[key])
    torch.testing.assert_close(out["value_target"][3], data["next", "reward"][3])
    assert data["next", "observation"][[3, 7]].isnan().all()
    if not shifted:
        target = estimator.value_estimate(data)
        torch.testing.assert_close(target, expected["value_target"])


@pytest.mark.parametrize("module", ["lstm", "gru"])
def test_recurrent_networks(module: str) -> None:
    """Over whole sequences as step by step, with or without a second pass over the states."""
    hidden, batch, steps = 5, 2, 8
    states = ["h", "c"] if module == "lstm" else ["h"]
    make = LSTMModule if module == "lstm" else GRUModule
    core = make(
        input_size=OBS,
        hidden_size=hidden,
        in_keys=["observation", *states],
        out_keys=["features", *(("next", name) for name in states)],
        python_based=True,
    )
    critic = TensorDictSequential(
        core,
        TensorDictModule(
            nn.Linear(hidden, NUM_ACTIONS), in_keys=["features"], out_keys=["action_value"]
        ),
    )
    actor, _ = make_discrete("categorical")
    data = torch.stack([make_shifted_data(0) for _ in range(batch)])
    data["action"] = torch.randint(NUM_ACTIONS, (batch, steps))
    data["next", "done"][0, 3] = True
    init = torch.zeros(batch, steps + 1, 1, dtype=torch.bool)
    init[:, 0] = init[0, 4] = True
    data["is_init"], data["next", "is_init"] = init[:, :-1], torch.zeros_like(init[:, 1:])
    # Step by step, as a collector would; the value of the next state goes on from its own state.
    values, next_values = [], []
    state = {name: torch.zeros(batch, 1, hidden) for name in states}
    with torch.no_grad():
        for t in range(steps):
            step = TensorDict({"observation": data["observation"][:, t], **state}, [batch])
            step["is_init"] = init[:, t]
            state = {k: x.masked_fill(init[:, t, :, None], 0) for k, x in state.items()}
            for name in states:
                data.set(name, torch.zeros(batch, steps, 1, hidden)) if t == 0 else None
                data[name][:, t] = state[name]
            out = critic(step)
            values.append(out["action_value"])
            state = {name: out["next", name] for name in states}
            following = TensorDict({**state, "is_init": torch.zeros(batch, 1, dtype=bool)}, [batch])
            following["observation"] = data["next", "observation"][:, t]
            for name in states:
                if t == 0:
                    data["next", name] = torch.zeros(batch, steps, 1, hidden)
                data["next", name][:, t] = state[name]
            next_values.append(critic(following)["action_value"])
        prob = actor.module[0].module(data["next", "observation"]).softmax(-1)
        log_prob = actor.module[0].module(data["observation"]).log_softmax(-1)
    index = data["action"].unsqueeze(-1)
    expected = reference(
        data,
        log_pi=log_prob.gather(-1, index),
        action_value=torch.stack(values, 1).gather(-1, index),
        next_state_value=(prob * torch.stack(next_values, 1)).sum(-1, keepdim=True),
    )
    for shifted in (False, True):
        estimator = RetraceEstimator(
            gamma=GAMMA,
            lmbda=LMBDA,
            actor_network=actor,
            qvalue_network=critic,
            action_space="categorical",
            shifted=shifted,
            shifted_budget=2,
        )
        with set_recurrent_mode(True):
            out = estimator(data.copy())
        torch.testing.assert_close(out["value_target"], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("skip_existing", [None, False, True])
@pytest.mark.parametrize("has_networks", [False, True])
def test_skip_existing_shifted(has_networks: bool, skip_existing, shifted: bool) -> None:
    data = make_shifted_data(0)
    existing = make_precomputed(8).select("policy_log_prob", "state_action_value")
    data.update(existing)
    data["next", "state_value"] = torch.randn(8, 1)
    networks = {}
    if has_networks:
        critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
        networks = {"actor_network": make_actor(), "qvalue_network": critic}
    estimator = RetraceEstimator(
        gamma=GAMMA, lmbda=LMBDA, **networks, shifted=shifted, skip_existing=skip_existing
    )
    target = estimator(data.copy())["value_target"]
    uses_existing = skip_existing or not has_networks
    assert torch.allclose(target, reference(data)) is bool(uses_existing)


@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("named", [False, True])
def test_time_dim_with_networks(named: bool, shifted: bool) -> None:
    data = torch.stack([make_shifted_data(0) for _ in range(3)])
    critic = ValueOperator(StateCritic(), in_keys=["observation", "action"])
    settings = {"gamma": GAMMA, "lmbda": LMBDA, "actor_network": make_actor()}
    settings |= {"qvalue_network": critic, "shifted": shifted}
    expected = RetraceEstimator(**settings)(data.copy())
    assert not expected["advantage"].requires_grad
    first = data.transpose(0, 1)
    if named:
        first.names = ["time", None]
    calls = [(RetraceEstimator(**settings, time_dim=0), {})]
    calls.append((RetraceEstimator(**settings), {} if named else {"time_dim": 0}))
    calls.append((RetraceEstimator(**settings, time_dim=1), {"time_dim": -2}))
    for estimator, arguments in calls:
        out = estimator(first.copy(), **arguments)
        for key in ("advantage", "value_target"):
            torch.testing.assert_close(out[key].transpose(0, 1), expected[key])


@pytest.mark.parametrize("key", ["state_value", "v", ("critic", "v")])
def test_key_of_the_value_network(key: str | tuple[str, str]) -> None:
    data = make_precomputed(4, 7)
    network = TensorDictModule(nn.Linear(OBS, 1), in_keys=["observation"], out_keys=[key])
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, value_network=network)
    estimator.set_keys(value=key)
    assert estimator.tensor_keys.value == key
    next_value = network.module(data["next", "observation"]).detach()
    expected = reference(data, next_state_value=next_value)
    torch.testing.assert_close(estimator(data.copy())["value_target"], expected)


@pytest.mark.parametrize("device", get_default_devices())
@pytest.mark.parametrize("dtype", [torch.float, torch.double])
def test_device_and_dtype(dtype: torch.dtype, device: torch.device) -> None:
    data = make_data(4, 7).to(device)
    data = data.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    networks = [net.to(device).to(dtype) for net in (make_actor(), make_critic())]
    estimator = RetraceEstimator(
        gamma=GAMMA,
        lmbda=LMBDA,
        actor_network=networks[0],
        qvalue_network=networks[1],
        device=device,
    )
    assert estimator.gamma.device.type == estimator.lmbda.device.type == torch.device(device).type
    out = estimator(data)
    for key in ("advantage", "value_target"):
        assert out[key].dtype == dtype
        assert out[key].device.type == torch.device(device).type


def test_shifted_misuse() -> None:
    data = make_shifted_data(0)
    critic = make_critic()
    networks = {"actor_network": make_actor(), "qvalue_network": critic}
    with pytest.raises(ValueError, match="shifted=True needs actor_network and qvalue_network"):
        RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, qvalue_network=critic, shifted=True)(data)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, **networks, shifted=True)
    with pytest.raises(ValueError, match="leave out target_params"):
        estimator(data, target_params=TensorDict.from_module(critic))
    with pytest.raises(ValueError, match="shifted must be a boolean"):
        RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, shifted="yes")


# Discrete actions -------------------------------------------------------------------------------

NUM_ACTIONS = 4


def make_discrete(action_space: str, out_key: str = "action_value"):
    one_hot = action_space == "one-hot"
    actor = ProbabilisticActor(
        TensorDictModule(
            MLP(OBS, NUM_ACTIONS, num_cells=[8]), in_keys=["observation"], out_keys=["logits"]
        ),
        in_keys=["logits"],
        distribution_class=OneHotCategorical if one_hot else torch.distributions.Categorical,
        return_log_prob=True,
    )
    critic = TensorDictModule(
        MLP(OBS, NUM_ACTIONS, num_cells=[8]), in_keys=["observation"], out_keys=[out_key]
    )
    return actor, critic


def make_discrete_data(action_space: str, *batch: int) -> tuple[TensorDict, Tensor]:
    data = make_data(*batch)
    index = torch.randint(NUM_ACTIONS, batch)
    one_hot = torch.nn.functional.one_hot(index, NUM_ACTIONS)
    data["action"] = one_hot if action_space == "one-hot" else index
    return data, index


@pytest.mark.parametrize("how", ["name", "spec"])
@pytest.mark.parametrize("shifted", [False, True])
@pytest.mark.parametrize("action_space", ["one-hot", "categorical"])
def test_discrete_actions(action_space: str, shifted: bool, how: str) -> None:
    """The expectation over next actions is exact."""
    actor, critic = make_discrete(action_space)
    data, index = make_discrete_data(action_space, 8)
    shifted_data = make_shifted_data(0)
    data["next"].update(shifted_data["next"])
    data["observation"] = shifted_data["observation"]
    specs = {"one-hot": OneHot(NUM_ACTIONS), "categorical": Categorical(NUM_ACTIONS)}
    estimator = RetraceEstimator(
        gamma=GAMMA,
        lmbda=LMBDA,
        actor_network=actor,
        qvalue_network=critic,
        action_space=action_space if how == "name" else specs[action_space],
        shifted=shifted,
    )
    with torch.no_grad():
        logits = actor.module[0].module(data["observation"]).log_softmax(-1)
        next_prob = actor.module[0].module(data["next", "observation"]).softmax(-1)
        next_values = critic.module(data["next", "observation"])
        value = critic.module(data["observation"]).gather(-1, index[:, None])
        expected = reference(
            data,
            log_pi=logits.gather(-1, index[:, None]),
            action_value=value,
            next_state_value=(next_prob * next_values).sum(-1, keepdim=True),
        )
    out = estimator(data.copy())
    torch.testing.assert_close(out["value_target"], expected, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(out["advantage"], expected - value, rtol=1e-4, atol=1e-5)
    if not shifted:
        torch.testing.assert_close(estimator.value_estimate(data), out["value_target"])


@pytest.mark.parametrize("action_space", ["binary", Bounded(-1, 1, (2,))])
def test_other_action_spaces(action_space: object) -> None:
    with pytest.raises(ValueError, match="action_space must be 'one-hot', 'categorical'"):
        RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, action_space=action_space)


# In a loss --------------------------------------------------------------------------------------


def make_sac(**kwargs) -> SACLoss:
    loss = SACLoss(make_actor(), make_critic(), **kwargs)
    SoftUpdate(loss, eps=0.5)
    return loss


def make_td3(**kwargs) -> TD3Loss:
    loss = TD3Loss(make_actor(), make_critic(), bounds=(-1, 1), delay_actor=True, **kwargs)
    SoftUpdate(loss, eps=0.5)
    return loss


def make_ddpg() -> DDPGLoss:
    loss = DDPGLoss(make_actor(), make_critic(), delay_actor=True)
    SoftUpdate(loss, eps=0.5)
    return loss


def make_sac_v1() -> SACLoss:
    value = ValueOperator(MLP(OBS, 1, num_cells=[8]), in_keys=["observation"])
    loss = SACLoss(make_actor(), make_critic(), value)
    SoftUpdate(loss, eps=0.5)
    return loss


def with_retrace(loss: LossModule, **kwargs) -> LossModule:
    settings = {"gamma": GAMMA, "lmbda": LMBDA, **kwargs}
    loss.make_value_estimator(RetraceEstimator.for_loss(loss, **settings))
    if isinstance(loss, IQLLoss):
        loss.value_estimator.set_keys(sample_log_prob=("next", "action_log_prob"))
    return loss


def make_iql() -> IQLLoss:
    value = ValueOperator(MLP(OBS, 1, num_cells=[8]), in_keys=["observation"])
    loss = IQLLoss(make_actor(), make_critic(), value)
    SoftUpdate(loss, eps=0.5)
    return loss


def make_discrete_sac() -> DiscreteSACLoss:
    loss = DiscreteSACLoss(
        *make_discrete("categorical"), action_space="categorical", num_actions=NUM_ACTIONS
    )
    SoftUpdate(loss, eps=0.5)
    return loss


def make_discrete_iql() -> DiscreteIQLLoss:
    value = ValueOperator(MLP(OBS, 1, num_cells=[8]), in_keys=["observation"])
    actor, critic = make_discrete("categorical", "state_action_value")
    loss = DiscreteIQLLoss(actor, critic, value, action_space="categorical")
    SoftUpdate(loss, eps=0.5)
    return loss


def make_loss_data(make_loss: Callable[[], LossModule], *batch: int) -> TensorDict:
    data = make_data(*batch)
    if "discrete" in make_loss.__name__:
        data, _ = make_discrete_data("categorical", *batch)
    if "iql" in make_loss.__name__:
        # IQLLoss hands its estimator "next", the actor's inputs and the action, nothing else.
        data["next", "action_log_prob"] = data["action_log_prob"]
    return data


LOSSES = [
    make_sac,
    make_td3,
    make_ddpg,
    make_sac_v1,
    make_iql,
    make_discrete_sac,
    make_discrete_iql,
]


@pytest.mark.parametrize("make_loss", LOSSES)
def test_lambda_zero_is_the_loss_with_td0(make_loss: Callable[[], LossModule]) -> None:
    loss, data = make_loss(), make_loss_data(make_loss, 4, 6)
    outputs = []
    for prepare in (
        lambda: loss.make_value_estimator(gamma=GAMMA),
        lambda: with_retrace(loss, lmbda=0.0),
        lambda: with_retrace(loss, lmbda=0.9),
    ):
        prepare()
        torch.manual_seed(1)
        outputs.append(loss(data.copy()))
    td0, retrace0, retrace = outputs
    torch.testing.assert_close(td0, retrace0)
    name = "loss_value" if make_loss is make_ddpg else "loss_qvalue"
    assert abs(retrace[name] - td0[name]) > 1e-4


@pytest.mark.parametrize("make_loss", LOSSES)
def test_parameters_and_state_of_the_loss(make_loss: Callable[[], LossModule]) -> None:
    loss = make_loss()
    parameters, state, modules = dict(loss.named_parameters()), loss.state_dict(), {*loss.modules()}
    with_retrace(loss)
    loss(make_loss_data(make_loss, 4, 6))
    assert loss.state_dict().keys() == state.keys()
    after = dict(loss.named_parameters())
    assert after.keys() == parameters.keys()
    assert all(after[name] is parameters[name] for name in parameters)
    assert {*loss.modules()} - modules == {loss.value_estimator}
    loss.load_state_dict(state)


def sac_target(loss: SACLoss, data: TensorDictBase, next_value: Tensor) -> Tensor:
    """The target from networks rebuilt with the loss's present parameters."""
    actor, critics = make_actor(), [make_critic() for _ in range(loss.num_qvalue_nets)]
    loss.actor_network_params.data.to_module(actor)
    values = []
    for critic, params in zip(critics, loss.target_qvalue_network_params.unbind(0), strict=True):
        params.data.to_module(critic)
        values.append(critic(data.copy())["state_action_value"])
    log_pi = actor.get_dist(data.copy()).log_prob(data["action"])
    return reference(
        data,
        log_pi=log_pi.detach(),
        action_value=torch.stack(values).min(0).values.detach(),
        next_state_value=next_value,
    )


def test_sac_training_stays_in_sync() -> None:
    loss = with_retrace(SACLoss(make_actor(), make_critic(), num_qvalue_nets=3))
    updater = SoftUpdate(loss, eps=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=0.05)
    data = make_data(4, 6)
    next_value = torch.randn(4, 6, 1)
    targets = []
    for _ in range(3):
        probe = data.copy().set(("next", "state_value"), next_value)
        target = loss.value_estimator.value_estimate(probe)
        torch.testing.assert_close(target, sac_target(loss, data, next_value))
        targets.append(target)
        out = loss(data.copy())
        sum(value for name, value in out.items() if name.startswith("loss_")).backward()
        optimizer.step()
        optimizer.zero_grad()
        updater.step()
    assert not torch.allclose(targets[0], targets[1])
    assert not torch.allclose(targets[1], targets[2])


def test_sac_target_is_soft() -> None:
    # One step to a truncation: the target is r + gamma (min Q - alpha log pi) of the next state.
    loss = with_retrace(make_sac(alpha_init=0.7))
    data = make_data(5, 1)
    data["next", "terminated"][:] = False
    next_actor = make_actor()
    loss.actor_network_params.data.to_module(next_actor)
    torch.manual_seed(1)
    target = loss._compute_target_v2(data)
    torch.manual_seed(1)
    dist = next_actor.get_dist(data["next"].copy())
    action = dist.rsample()
    following = TensorDict({**data["next"], "action": action}, data.batch_size)
    values = []
    for params in loss.target_qvalue_network_params.unbind(0):
        critic = make_critic()
        params.data.to_module(critic)
        values.append(critic(following.copy())["state_action_value"])
    soft = torch.stack(values).min(0).values.squeeze(-1) - 0.7 * dist.log_prob(action)
    expected = data["next", "reward"].squeeze(-1) + GAMMA * soft
    torch.testing.assert_close(target, expected.detach(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("make_loss", [make_sac, make_td3])
def test_deactivate_vmap(make_loss: Callable[..., LossModule]) -> None:
    data, targets = make_precomputed(4, 6).exclude("state_action_value"), []
    for deactivate_vmap in (False, True):
        torch.manual_seed(0)
        loss = with_retrace(make_loss(deactivate_vmap=deactivate_vmap))
        assert loss.value_estimator.deactivate_vmap is deactivate_vmap
        loss.value_estimator.set_keys(value="state_value")
        targets.append(loss.value_estimator.value_estimate(data))
    torch.testing.assert_close(*targets)


def test_flat_batch_in_a_loss() -> None:
    loss = with_retrace(make_sac())
    data = make_data(4, 6)
    data["next", "done"][:, -1] = True
    data["next", "state_value"] = torch.randn(4, 6, 1)
    target = loss.value_estimator.value_estimate(data)
    flat = loss.value_estimator.value_estimate(data.flatten(0, 1))
    torch.testing.assert_close(flat, target.flatten(0, 1))


def test_advantage_in_a_loss() -> None:
    loss = with_retrace(make_sac())
    data = make_precomputed(4, 6).exclude("policy_log_prob", "state_action_value")
    target = sac_target(loss, data, data["next", "state_value"])
    params = loss.qvalue_network_params[0].data
    out = loss.value_estimator(data.copy(), params=params)
    torch.testing.assert_close(out["value_target"], target)
    critic = make_critic()
    params.to_module(critic)
    value = critic(data.copy())["state_action_value"]
    torch.testing.assert_close(out["advantage"], (target - value).detach())


def test_copy_of_a_loss_is_on_its_own() -> None:
    loss = with_retrace(make_sac())
    data = make_precomputed(4, 6).exclude("policy_log_prob", "state_action_value")
    before = loss.value_estimator.value_estimate(data)
    twin = copy.deepcopy(loss)
    for parameter in twin.parameters():
        parameter.data.add_(0.3)
    torch.testing.assert_close(loss.value_estimator.value_estimate(data), before)
    assert not torch.allclose(twin.value_estimator.value_estimate(data), before)


def test_loss_forwards_its_keys() -> None:
    loss = with_retrace(make_sac())
    loss.set_keys(reward="cost", done="end", terminated="stop", value="v")
    keys = loss.value_estimator.tensor_keys
    assert (keys.reward, keys.done, keys.terminated, keys.value) == ("cost", "end", "stop", "v")
    data = make_data(4, 6)
    for old, new in (("reward", "cost"), ("done", "end"), ("terminated", "stop")):
        data["next"].rename_key_(old, new)
    assert loss(data)["loss_qvalue"].isfinite()


def test_registry() -> None:
    class RetraceSAC(SACLoss):
        SUPPORTED_VALUE_ESTIMATORS = (*SACLoss.SUPPORTED_VALUE_ESTIMATORS, RETRACE)

    loss = RetraceSAC(make_actor(), make_critic())
    loss.set_keys(reward="cost")
    loss.make_value_estimator("retrace", lmbda=0.5)
    estimator = loss.value_estimator
    assert isinstance(estimator, RetraceEstimator)
    assert estimator.lmbda.item() == 0.5
    assert estimator.gamma.item() == pytest.approx(0.99)
    assert estimator.tensor_keys.reward == "cost"
    data = make_precomputed(4, 6).exclude("policy_log_prob", "state_action_value")
    data["next"].rename_key_("reward", "cost")
    SoftUpdate(loss, eps=0.5)
    assert estimator.value_estimate(data).isfinite().all()


def test_class_without_the_loss_says_what_to_do() -> None:
    # TorchRL builds a class without telling it which loss it is for.
    loss = make_sac()
    loss.make_value_estimator(RetraceEstimator, gamma=GAMMA, lmbda=LMBDA)
    with pytest.raises(KeyError, match=r"RetraceEstimator\.for_loss"):
        loss(make_data(4, 6))


def test_next_value_must_come_from_the_loss() -> None:
    # A plain next value in its place would silently lose the entropy bonus.
    loss = with_retrace(make_sac())
    with pytest.raises(KeyError, match="one tied to a loss expects it from the loss"):
        loss.value_estimator(make_data(4, 6))


def test_deterministic_actor() -> None:
    actor = TensorDictModule(
        MLP(OBS, ACT, num_cells=[8]), in_keys=["observation"], out_keys=["action"]
    )
    loss = TD3Loss(actor, make_critic(), bounds=(-1, 1), delay_actor=True)
    SoftUpdate(loss, eps=0.5)
    with_retrace(loss)
    data = make_data(4, 6)
    with pytest.raises(KeyError, match=r"'policy_log_prob'.*got TensorDictModule"):
        loss(data.copy())
    data["policy_log_prob"] = torch.randn(4, 6)
    assert loss(data)["loss_qvalue"].isfinite()


def test_losses_without_a_critic_of_actions() -> None:
    critic = TensorDictModule(nn.Linear(OBS, ACT), ["observation"], ["action_value"])
    with pytest.raises(ValueError, match="DQNLoss lacks one of them"):
        RetraceEstimator.for_loss(DQNLoss(critic, action_space="one-hot"), gamma=0.9, lmbda=0.9)


def test_estimator_can_be_replaced() -> None:
    loss = with_retrace(make_sac())
    loss.make_value_estimator(TD0Estimator, gamma=GAMMA, value_network=None)
    assert loss(make_data(4, 6))["loss_qvalue"].isfinite()


# Both come from tensordict and TorchRL under torch.compile, with any estimator.
@pytest.mark.filterwarnings("ignore:.*autograd.function.Function.*instantiated:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:torch._dynamo.config.inline_inbuilt_nn_modules:FutureWarning")
def test_compile_in_a_loss() -> None:
    loss = with_retrace(make_sac())
    data = make_precomputed(4, 6).exclude("policy_log_prob", "state_action_value")
    estimate = loss.value_estimator.value_estimate
    expected = estimate(data)
    compiled = torch.compile(estimate, backend="eager", fullgraph=True)
    torch.testing.assert_close(compiled(data), expected)


def split_agents(data: TensorDict, agent: int) -> TensorDict:
    """The trajectories of one agent."""
    one = {key: data[key][:, :, agent] for key in ("policy_log_prob", "action_log_prob")}
    one["state_action_value"] = data["state_action_value"][:, :, agent]
    following = {key: data["next", key][:, :, agent] for key in ("reward", "state_value")}
    ends = {key: data["next", key] for key in ("done", "terminated")}
    shared = data["next", "done"].ndim == 3
    following |= ends if shared else {key: end[:, :, agent] for key, end in ends.items()}
    return TensorDict({**one, "next": following}, data.batch_size)


@pytest.mark.parametrize("shared_ends", [False, True])
@pytest.mark.parametrize("joint_density", [False, True])
def test_agents_are_trajectories_of_their_own(shared_ends: bool, joint_density: bool) -> None:
    """The reference is one estimate per agent."""
    torch.manual_seed(0)
    steps, agents = (4, 7), 3
    done = torch.rand(*steps, *(() if shared_ends else (agents,)), 1) < 0.2
    log_prob = torch.randn(*steps) if joint_density else torch.randn(*steps, agents)
    data = TensorDict(
        {
            "policy_log_prob": log_prob,
            "action_log_prob": torch.randn(*steps, agents),
            "state_action_value": torch.randn(*steps, agents, 1),
            "next": {
                "reward": torch.randn(*steps, agents, 1),
                "state_value": torch.randn(*steps, agents, 1),
                "done": done,
                "terminated": done & (torch.rand(done.shape) < 0.5),
            },
        },
        steps,
    )
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA)
    target = estimator.value_estimate(data)
    if joint_density:
        data["policy_log_prob"] = log_prob.unsqueeze(-1).expand(*steps, agents)
    for agent in range(agents):
        expected = estimator.value_estimate(split_agents(data, agent))
        torch.testing.assert_close(target[:, :, agent], expected)


@pytest.mark.parametrize("agents", [False, True])
@pytest.mark.parametrize("feature", [False, True])
def test_steps_of_several_frames(agents: bool, feature: bool) -> None:
    """Discounts ``gamma ** n`` against a loop, with and without a last dimension of one."""
    torch.manual_seed(0)
    data = make_precomputed(4, 7)
    steps = torch.randint(1, 4, (4, 7))
    data["steps_to_next_obs"] = steps.unsqueeze(-1) if feature else steps
    if agents:
        for key in ("state_action_value", ("next", "reward"), ("next", "state_value")):
            data[key] = torch.randn(4, 7, 2, 1)
    target = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data)
    ratio = LMBDA * (data["policy_log_prob"] - data["action_log_prob"]).clamp(max=0).exp()
    expected, following = torch.zeros_like(target), None
    for t in reversed(range(7)):
        gap = (
            0
            if following is None
            else following * ratio[:, t + 1].view(4, *[1] * (2 + agents))[:, 0]
        )
        end, stop = (
            data["next", key][:, t].view(4, *[1] * (1 + agents)) for key in ("done", "terminated")
        )
        value = torch.where(stop, 0, data["next", "state_value"][:, t])
        discount = (GAMMA ** steps[:, t]).view(4, *[1] * (1 + agents))
        expected[:, t] = data["next", "reward"][:, t] + discount * (
            value + torch.where(end, 0, gap)
        )
        following = expected[:, t] - data["state_action_value"][:, t]
    torch.testing.assert_close(target, expected)


@pytest.mark.parametrize("average", [False, True])
@pytest.mark.parametrize("dtype", [torch.int64, torch.uint8, torch.bool])
def test_rewards_that_are_counts_or_flags(dtype: torch.dtype, average: bool) -> None:
    data = make_precomputed(4, 7)
    data["next", "reward"] = torch.rand(4, 7, 1) < 0.5
    exact = data.clone()
    exact["next", "reward"] = data["next", "reward"].float()
    data["next", "reward"] = data["next", "reward"].to(dtype)
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, average_rewards=average)
    torch.testing.assert_close(estimator.value_estimate(data), estimator.value_estimate(exact))


def test_a_density_of_the_past_does_not_replace_the_actor() -> None:
    """An entry beside an actor is used on request, an argument always."""
    data = make_precomputed(4, 7)
    policy = make_actor()
    estimator = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA, actor_network=policy)
    expected = estimator.value_estimate(data.exclude("policy_log_prob"))
    torch.testing.assert_close(estimator.value_estimate(data), expected)
    given = data["policy_log_prob"]
    entry = RetraceEstimator(gamma=GAMMA, lmbda=LMBDA).value_estimate(data)
    assert not torch.allclose(entry, expected)
    bare = data.exclude("policy_log_prob")
    torch.testing.assert_close(estimator.value_estimate(bare, policy_log_prob=given), entry)
    torch.testing.assert_close(estimator(bare, policy_log_prob=given)["value_target"], entry)
