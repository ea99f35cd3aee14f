"""A network called with several sets of its parameters, one by one or by vmap."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, from_modules
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import ValueOperator

from torchrl_safe.objectives.utils import ensemble


def make_module() -> TensorDictModule:
    net = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.BatchNorm1d(4), nn.Linear(4, 2))
    net.extend([nn.Unflatten(-1, (2, 1))])
    out_keys = ["first", ("agent", "second")]
    return TensorDictModule(
        nn.Sequential(net, _Unbind()), in_keys=[("agent", "state")], out_keys=out_keys
    ).double()


class _Unbind(nn.Module):
    def forward(self, x):
        return x.unbind(-2)


def make_members(count: int) -> list[TensorDictModule]:
    """In evaluation mode, with statistics of their own: buffers count as much as parameters."""
    members = [make_module().eval() for _ in range(count)]
    for i, member in enumerate(members):
        for name, buffer in member.named_buffers():
            if name.endswith("running_mean"):
                buffer.fill_(i)
    return members


def make_data() -> TensorDict:
    return TensorDict({"agent": {"state": torch.randn(5, 3).double()}}, [5])


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_outputs_are_those_of_the_members(count, deactivate_vmap):
    members, data = make_members(count), make_data()
    params = from_modules(*members, as_module=True)
    call = ensemble(make_module().eval(), randomness="error", deactivate_vmap=deactivate_vmap)
    for key in ("first", ("agent", "second")):
        out = call(data, params, key)
        assert out.shape == (count, 5, 1)
        for value, member in zip(out, members, strict=True):
            expected = member(data.clone())[key]
            torch.testing.assert_close(value, expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_an_output_that_is_not_written(deactivate_vmap):
    module = make_module().eval()
    call = ensemble(module, randomness="error", deactivate_vmap=deactivate_vmap)
    data = make_data().set("third", torch.zeros(5))  # that it is there already is no help
    with pytest.raises(KeyError, match="third"):
        call(data, from_modules(module, as_module=True), "third")


def test_modules_that_are_shared():
    """A layer that is used twice is there twice, or its second use would keep the first weights."""
    layer = nn.Linear(3, 3).double()
    module = TensorDictModule(nn.Sequential(layer, nn.Tanh(), layer), ["x"], ["y"])
    data = TensorDict({"x": torch.randn(5, 3).double()}, [5])
    expected = module(data.clone())["y"]
    params = from_modules(module, as_module=True)
    with torch.no_grad():
        layer.weight.zero_()
    call = ensemble(module, randomness="error", deactivate_vmap=True)
    torch.testing.assert_close(call(data, params, "y")[0], expected)


class _Critic(nn.Module):
    """Names of its arguments are in another order than those of the keys."""

    def __init__(self):
        super().__init__()
        self.net = nn.Linear(5, 1).double()

    def forward(self, state, action):
        return self.net(torch.cat([state, action.exp()], -1))


@pytest.mark.parametrize(
    "in_keys",
    [["state", ("agent", "action")], {"action": ("agent", "action"), "state": "state"}],
    ids=["by_position", "by_name"],
)
def test_value_operators(in_keys):
    members = [ValueOperator(_Critic(), in_keys=in_keys, out_keys=["value"]) for _ in range(2)]
    data = TensorDict(
        {"state": torch.randn(5, 3).double(), "agent": {"action": torch.randn(5, 2).double()}}, [5]
    )
    call = ensemble(
        ValueOperator(_Critic(), in_keys=in_keys, out_keys=["value"]),
        randomness="error",
        deactivate_vmap=True,
    )
    out = call(data, from_modules(*members, as_module=True), "value")
    assert set(data.keys()) == {"state", "agent"}
    for value, member in zip(out, members, strict=True):
        torch.testing.assert_close(value, member(data.clone())["value"], rtol=0, atol=1e-14)


def test_gradients_are_those_of_the_members():
    members, data = make_members(2), make_data()
    params = from_modules(*members, as_module=True)
    call = ensemble(make_module().eval(), randomness="error", deactivate_vmap=True)
    weight = torch.randn(2, 5, 1).double()
    (call(data, params, "first") * weight).sum().backward()
    for i, member in enumerate(members):
        (member(data.clone())["first"] * weight[i]).sum().backward()
        for name, parameter in member.named_parameters():
            stacked = params.get(tuple(name.split("."))).grad
            torch.testing.assert_close(stacked[i], parameter.grad, rtol=0, atol=1e-14)


@pytest.mark.parametrize("fails", [False, True])
def test_arguments_and_module_are_left_alone(fails):
    """Also by a call that raises."""
    module, data = make_module().eval(), make_data()
    params = from_modules(*make_members(2), as_module=True)
    before = {name: (value, value.clone()) for name, value in module.state_dict().items()}
    call = ensemble(module, randomness="error", deactivate_vmap=True)
    if fails:
        data["agent", "state"] = torch.randn(5, 7).double()
        with pytest.raises(RuntimeError, match="mat1 and mat2"):
            call(data, params, "first")
    else:
        call(data, params, "first")
    assert set(data.keys(True, True)) == {("agent", "state")}
    for name, value in module.state_dict().items():
        assert value.data_ptr() == before[name][0].data_ptr()
        assert torch.equal(value, before[name][1])


def test_random_layers_draw_for_each_member():
    linear = TensorDictModule(
        nn.Sequential(nn.Linear(1, 64), nn.Dropout(0.5)), in_keys=["x"], out_keys=["y"]
    )
    params = from_modules(linear, linear, as_module=True)
    call = ensemble(linear, randomness="different", deactivate_vmap=True)
    first, second = call(TensorDict({"x": torch.ones(1, 1)}, [1]), params, "y")
    assert not torch.equal(first == 0, second == 0)


@pytest.mark.parametrize("deactivate_vmap", [False, True])
def test_one_network_without_a_dimension_of_members(deactivate_vmap):
    (member,), data = make_members(1), make_data()
    params = from_modules(member, as_module=True)
    call = ensemble(make_module().eval(), randomness="error", deactivate_vmap=deactivate_vmap)
    assert not params[0].batch_dims
    torch.testing.assert_close(call(data, params[0], "first"), call(data, params, "first"))
