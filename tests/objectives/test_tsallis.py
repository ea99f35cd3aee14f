from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded, Composite, MultiStep
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators
from torchrl.testing import get_default_devices

from torchrl_safe import GMMTanhPolicy, TsallisLoss
from torchrl_safe.modules import GMMParamExtractor

OBS, ACT = 3, 2


def make_actor(spec):
    net = nn.Sequential(MLP(OBS, 2 * ACT, num_cells=[16]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def make_mixture(spec):
    net = MLP(OBS, GMMParamExtractor(3, ACT).num_features, num_cells=[16])
    return GMMTanhPolicy(net, spec, num_components=3)


def make_qvalue(out_key="state_action_value"):
    net = MLP(OBS + ACT, 1, num_cells=[16])
    return ValueOperator(net, in_keys=["observation", "action"], out_keys=[out_key])


def make_on_one_trunk():
    """An actor and a critic that read the observation through one layer."""
    trunk = nn.Linear(OBS, OBS, dtype=torch.float64)
    heads = (MLP(OBS, 2 * ACT, num_cells=[]).double(), MLP(OBS + ACT, 1, num_cells=[]).double())
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(trunk, heads[0], NormalParamExtractor()),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=Bounded(-1, 1, (ACT,), dtype=torch.float64),
        distribution_class=TanhNormal,
    )

    class Critic(nn.Module):
        def __init__(self):
            super().__init__()
            self.trunk, self.head = trunk, heads[1]

        def forward(self, observation, action):
            return self.head(torch.cat([self.trunk(observation), action], -1))

    return actor, ValueOperator(Critic(), in_keys=["observation", "action"]), trunk


def make_data(batch=(8,), dtype=torch.float64):
    generator = torch.Generator().manual_seed(3)

    def rand(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=dtype)

    flag = torch.zeros(*batch, 1, dtype=torch.bool)
    terminated = flag.clone()
    terminated[0] = True
    return TensorDict(
        {
            "observation": rand(OBS),
            "action": rand(ACT).tanh(),
            "action_log_prob": rand(),
            "next": {
                "observation": rand(OBS),
                "reward": rand(1),
                "done": terminated.clone(),
                "terminated": terminated,
            },
        },
        batch_size=batch,
    )


@pytest.fixture
def blocks():
    torch.manual_seed(0)
    spec = Bounded(-1, 1, (ACT,), dtype=torch.float64)
    return make_actor(spec).double(), make_qvalue().double()


class TestEqualsSAC:
    @pytest.mark.parametrize("td_est", [ValueEstimators.TD0, ValueEstimators.TDLambda])
    @pytest.mark.parametrize("fixed_alpha", [True, False])
    @pytest.mark.parametrize("delay_qvalue", [True, False])
    @pytest.mark.parametrize("loss_function", ["l2", "smooth_l1"])
    def test_losses_and_gradients(self, blocks, td_est, fixed_alpha, delay_qvalue, loss_function):
        actor, qvalue = blocks
        common = {
            "alpha_init": 0.3,
            "fixed_alpha": fixed_alpha,
            "delay_qvalue": delay_qvalue,
            "loss_function": loss_function,
        }
        results = []
        for kind, extra in ((SACLoss, {}), (TsallisLoss, {"entropic_index": 1.0})):
            torch.manual_seed(1)
            loss = kind(deepcopy(actor), deepcopy(qvalue), **common, **extra)
            if delay_qvalue:
                SoftUpdate(loss, eps=0.99)
            loss.make_value_estimator(td_est, gamma=0.9)
            torch.manual_seed(2)
            out = loss(make_data((4, 6)))
            sum(value for key, value in out.items() if key.startswith("loss_")).backward()
            grads = {name: p.grad for name, p in loss.named_parameters()}
            results.append((out, grads))
        (sac, sac_grads), (tsallis, tsallis_grads) = results
        assert set(sac.keys()) == set(tsallis.keys())
        for key in sac.keys():
            torch.testing.assert_close(tsallis[key], sac[key], rtol=1e-6, atol=1e-6)
        assert sac_grads.keys() == tsallis_grads.keys()
        assert any(grad is not None and grad.abs().max() > 0 for grad in sac_grads.values())
        for name, grad in sac_grads.items():
            torch.testing.assert_close(tsallis_grads[name], grad, rtol=1e-6, atol=1e-6)

    def test_target_entropy(self, blocks):
        actor, qvalue = blocks
        assert TsallisLoss(actor, qvalue, entropic_index=1.0).target_entropy == -ACT
        # S_2 of the uniform density whose Shannon entropy is -ACT, a density of exp(ACT).
        target = TsallisLoss(actor, qvalue, entropic_index=2.0).target_entropy
        assert target.item() == pytest.approx(1 - math.exp(ACT), rel=1e-6)
        assert TsallisLoss(
            actor, qvalue, target_entropy=-0.7
        ).target_entropy.item() == pytest.approx(-0.7)


class TestEquations:
    @pytest.mark.parametrize("q", [0.5, 1.3, 2.0])
    def test_target_is_the_bellman_equation(self, blocks, q):
        actor, qvalue = blocks
        loss = TsallisLoss(
            actor, qvalue, entropic_index=q, alpha_init=0.3, fixed_alpha=True, delay_qvalue=False
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        data = make_data()
        torch.manual_seed(5)
        target = loss.compute_target(data)

        torch.manual_seed(5)
        dist = actor.get_dist(data["next"])
        action, log_prob = dist.sample_and_log_prob()
        inputs = torch.cat([data["next", "observation"], action], -1)
        values = []
        for index in range(2):
            with loss.qvalue_network_params[index].to_module(qvalue):
                values.append(qvalue.module(inputs))
        density = log_prob.exp()
        entropy_term = 0.3 * (density ** (q - 1) - 1) / (q - 1)
        value = torch.minimum(*values) - entropy_term.unsqueeze(-1)
        expected = data["next", "reward"] + 0.9 * (~data["next", "terminated"]) * value
        torch.testing.assert_close(target, expected.detach())
        assert not target.requires_grad

    def test_objective_is_minus_the_actor_loss(self, blocks):
        actor, qvalue = blocks
        loss = TsallisLoss(actor, qvalue, entropic_index=1.4, alpha_init=0.2, delay_qvalue=False)
        data = make_data()
        torch.manual_seed(5)
        expected, _ = loss.actor_loss(data)
        torch.manual_seed(5)
        action, log_prob = actor.get_dist(data).rsample_and_log_prob()
        objective = loss.objective(data, action, log_prob).mean()
        torch.testing.assert_close(objective, -expected)
        objective.backward()
        assert all(p.grad is not None for p in actor.parameters())
        assert all(p.grad is None for p in loss.qvalue_network_params.parameters())

    def test_alpha_raises_too_low_an_entropy(self, blocks):
        actor, qvalue = blocks
        for target, sign in ((1e3, -1), (-1e3, 1)):
            loss = TsallisLoss(
                actor, qvalue, entropic_index=1.4, target_entropy=target, delay_qvalue=False
            )
            loss(make_data())["loss_alpha"].backward()
            # Gradient descent: a negative gradient raises the weight.
            assert loss.log_alpha.grad.sign() == sign


class TestLossModule:
    def test_gradient_isolation(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        out = loss(make_data())
        owners = {
            "loss_actor": "actor_network_params",
            "loss_qvalue": "qvalue_network_params",
            "loss_alpha": "log_alpha",
        }
        for key, owner in owners.items():
            loss.zero_grad()
            out[key].backward(retain_graph=True)
            touched = {
                name.split(".")[0]
                for name, p in loss.named_parameters()
                if p.grad is not None and p.grad.abs().max() > 0
            }
            assert touched == {owner}

    def test_precomputed_target(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data()
        torch.manual_seed(0)
        expected, _ = loss.qvalue_v2_loss(data)
        torch.manual_seed(0)
        data["qvalue_target"] = loss.compute_target(data)
        flat = data.select("observation", "action", "qvalue_target")
        torch.testing.assert_close(loss.qvalue_v2_loss(flat)[0], expected)

    def test_vmap_and_loop_agree(self, blocks):
        torch.manual_seed(1)
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        torch.manual_seed(1)
        looped = TsallisLoss(*blocks, delay_qvalue=False, deactivate_vmap=True)
        looped.load_state_dict(loss.state_dict())
        for module in (loss, looped):
            torch.manual_seed(2)
            module.out = module(make_data())
        for key in loss.out.keys():
            torch.testing.assert_close(loss.out[key], looped.out[key])

    def test_skip_done_states(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False, skip_done_states=True)
        data = make_data()
        data["next", "observation"][0] = torch.nan
        out = loss(data)
        assert out["loss_qvalue"].isfinite()

    @pytest.mark.filterwarnings("ignore:SACLoss with reduction")
    def test_reduction_none(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False, reduction="none")
        out = loss(make_data())
        assert out["loss_actor"].shape == out["loss_qvalue"].shape == (8,)

    def test_priority_weights(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data()
        data["qvalue_target"] = loss.compute_target(data)
        data["priority_weight"] = torch.zeros(8)
        data["priority_weight"][2] = 1.0
        weighted, _ = loss.qvalue_v2_loss(data)
        single, _ = loss.qvalue_v2_loss(data[2:3].exclude("priority_weight"))
        torch.testing.assert_close(weighted, single)
        unweighted = TsallisLoss(*blocks, delay_qvalue=False, use_prioritized_weights=False)
        unweighted.make_value_estimator()
        unweighted.load_state_dict(loss.state_dict())
        plain, _ = loss.qvalue_v2_loss(data.exclude("priority_weight"))
        torch.testing.assert_close(unweighted.qvalue_v2_loss(data)[0], plain)

    @pytest.mark.parametrize(("init", "kept"), [(0.05, 0.2), (0.3, 0.3), (2.0, 0.4)])
    def test_alpha_stays_between_its_bounds(self, blocks, init, kept):
        """Where it is used: in the policy's loss, which is linear in it."""
        losses = []
        for options in (
            {"alpha_init": init, "min_alpha": 0.2, "max_alpha": 0.4},
            {"alpha_init": kept},
        ):
            torch.manual_seed(0)
            loss = TsallisLoss(*blocks, delay_qvalue=False, **options)
            losses.append(loss(make_data()))
        assert losses[0]["alpha"].item() == pytest.approx(kept, rel=1e-6)
        torch.testing.assert_close(losses[0]["loss_actor"], losses[1]["loss_actor"])

    def test_keys(self, blocks):
        actor, _ = blocks
        qvalue = make_qvalue("other_value").double()
        loss = TsallisLoss(actor, qvalue, delay_qvalue=False)
        loss.set_keys(
            state_action_value="other_value", reward="bonus", qvalue_target=("my", "target")
        )
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        data = make_data()
        data["next", "bonus"] = data["next"].pop("reward")
        assert loss(data)["loss_qvalue"].isfinite()
        data["my", "target"] = torch.zeros(8, 1, dtype=torch.float64)
        prediction = loss._vmap_qnetworkN0(data, loss.qvalue_network_params, "other_value")
        expected = prediction.square().sum(0).mean()
        torch.testing.assert_close(loss.qvalue_v2_loss(data)[0], expected)

    def test_nested_keys(self, blocks):
        """The losses of nested entries are those of the same entries at the top."""
        data, nested = make_data(), TensorDict(batch_size=[8])
        for key in ("observation", "action"):
            nested["agent", key] = data[key]
        nested["next", "agent", "observation"] = data["next", "observation"]
        flags = data["next"].select("reward", "done", "terminated")
        nested["next", "signals"] = flags.rename_key_("done", "end").rename_key_(
            "terminated", "stop"
        )
        actor, qvalue = blocks
        spec = Composite(agent=Composite(action=Bounded(-1, 1, (ACT,), dtype=torch.float64)))
        actor = ProbabilisticActor(
            TensorDictModule(
                actor.module[0].module,
                in_keys=[("agent", "observation")],
                out_keys=["loc", "scale"],
            ),
            in_keys=["loc", "scale"],
            out_keys=[("agent", "action")],
            spec=spec,
            distribution_class=TanhNormal,
        )
        qvalue = ValueOperator(
            qvalue.module,
            in_keys=[("agent", "observation"), ("agent", "action")],
            out_keys=[("agent", "q")],
        )
        losses = []
        for networks, inputs in ((blocks, data), ((actor, qvalue), nested)):
            torch.manual_seed(1)
            loss = TsallisLoss(*networks, delay_qvalue=False, target_entropy=-1.0)
            if inputs is nested:
                loss.set_keys(
                    action=("agent", "action"),
                    state_action_value=("agent", "q"),
                    reward=("signals", "reward"),
                    done=("signals", "end"),
                    terminated=("signals", "stop"),
                    priority=("agent", "priority"),
                )
            torch.manual_seed(2)
            losses.append(loss(inputs))
        assert nested["agent", "priority"].shape == (8,)
        for key in losses[0].keys():
            torch.testing.assert_close(losses[1][key], losses[0][key])

    def test_dispatch(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data()
        torch.manual_seed(2)
        expected = loss(data)
        torch.manual_seed(2)
        outputs = loss(
            observation=data["observation"],
            action=data["action"],
            **{f"next_{key}": value for key, value in data["next"].items()},
        )
        for key, value in zip(loss.out_keys, outputs, strict=True):
            torch.testing.assert_close(value, expected[key])

    @pytest.mark.parametrize("separate_losses", [False, True])
    def test_one_critic_is_the_network_itself(self, separate_losses):
        """Its weights and the trunk it shares with the actor; separate losses do not move that."""
        actor, qvalue, trunk = make_on_one_trunk()
        weights = {name: p.clone() for name, p in qvalue.named_parameters()}
        data = make_data()
        expected = qvalue(data.clone())["state_action_value"].squeeze(-1)
        loss = TsallisLoss(
            actor,
            qvalue,
            num_qvalue_nets=1,
            delay_qvalue=False,
            separate_losses=separate_losses,
            alpha_init=1e-12,
        )
        for name, p in qvalue.named_parameters():
            assert torch.equal(p, weights[name])
        value = loss.objective(data, data["action"], data["action_log_prob"])
        torch.testing.assert_close(value, expected)
        # Every parameter once: 12 of the trunk, 16 of the actor's head, 6 of the critic's, alpha.
        assert sum(p.numel() for p in loss.parameters()) == 12 + 16 + 6 + 1
        loss(data)["loss_qvalue"].backward()
        assert qvalue.module.head[0].weight.grad.any()
        assert (trunk.weight.grad is None) is separate_losses

    def test_copies_do_not_lose_in_silence_what_is_shared(self):
        actor, qvalue, trunk = make_on_one_trunk()
        with pytest.raises(ValueError, match=r"num_qvalue_nets=2 makes copies, and qvalue_network"):
            TsallisLoss(actor, qvalue)
        loss = TsallisLoss(actor, qvalue, separate_losses=True, delay_qvalue=False)
        borrowed = loss.qvalue_network_params["module", "trunk", "weight"]
        assert borrowed.data_ptr() == trunk.weight.data_ptr()

    @pytest.mark.parametrize("deactivate_vmap", [False, True])
    def test_a_list_of_critics_keeps_their_weights(self, blocks, deactivate_vmap):
        actor, _ = blocks
        critics = [make_qvalue().double() for _ in range(3)]
        data = make_data()
        expected = torch.stack([each(data.clone())["state_action_value"] for each in critics])
        loss = TsallisLoss(
            actor,
            critics,
            num_qvalue_nets=3,
            delay_qvalue=False,
            deactivate_vmap=deactivate_vmap,
            alpha_init=1e-12,
        )
        value = loss.objective(data, data["action"], data["action_log_prob"])
        torch.testing.assert_close(value, expected.squeeze(-1).min(0)[0])

    @pytest.mark.parametrize("deactivate_vmap", [False, True])
    @pytest.mark.parametrize("count", [1, 2])
    def test_hooks_of_critics_are_called(self, blocks, count, deactivate_vmap):
        """A hook that doubles what the critic writes doubles its prediction."""
        loss = TsallisLoss(
            *blocks,
            num_qvalue_nets=count,
            deactivate_vmap=deactivate_vmap,
            delay_qvalue=False,
            alpha_init=1e-12,
        )
        data = make_data()

        def value():
            return loss.objective(data, data["action"], data["action_log_prob"])

        def double(module, args, output):
            output["state_action_value"] = 2 * output["state_action_value"]

        before = value()
        handle = loss.qvalue_network.register_forward_hook(double)
        torch.testing.assert_close(value(), 2 * before)
        handle.remove()
        torch.testing.assert_close(value(), before)

    def test_multi_step_batch(self, blocks):
        """The target of 3-step transitions: three rewards, then the value of the third state."""
        loss = TsallisLoss(*blocks, alpha_init=0.3, fixed_alpha=True, delay_qvalue=False)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        data = make_data((2, 6))
        data["next", "done"][:] = data["next", "terminated"][:] = False
        data["collector", "mask"] = torch.ones(2, 6, dtype=torch.bool)
        batch = MultiStep(gamma=0.9, n_steps=3)(data.clone())
        torch.manual_seed(5)
        target = loss.compute_target(batch)[:, 0]
        one_step = data.clone()
        one_step["next", "observation"] = batch["next", "observation"]
        one_step["next", "reward"] = torch.zeros_like(one_step["next", "reward"])
        torch.manual_seed(5)
        bootstrap = loss.compute_target(one_step)[:, 0] / 0.9
        rewards = data["next", "reward"]
        expected = sum(0.9**k * rewards[:, k] for k in range(3)) + 0.9**3 * bootstrap
        torch.testing.assert_close(target, expected)

    def test_reset_parameters_recursive(self, blocks):
        loss = TsallisLoss(*blocks)
        before = {name: p.clone() for name, p in loss.named_parameters()}
        loss.reset_parameters_recursive()
        after = dict(loss.named_parameters())
        assert after.keys() == before.keys()
        for name, parameter in after.items():
            assert isinstance(parameter, nn.Parameter)
            if name.endswith("weight"):
                assert not torch.equal(parameter, before[name])

    def test_state_dict(self, blocks):
        loss = TsallisLoss(*blocks)
        other = TsallisLoss(*(deepcopy(block) for block in blocks))
        other.load_state_dict(loss.state_dict())
        for name, value in loss.state_dict().items():
            torch.testing.assert_close(other.state_dict()[name], value)

    def test_mixture(self):
        torch.manual_seed(0)
        spec = Bounded(-1, 1, (ACT,))
        loss = TsallisLoss(make_mixture(spec), make_qvalue(), delay_qvalue=False)
        out = loss(make_data(dtype=torch.float32))
        (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
        assert all(p.grad.isfinite().all() for p in loss.parameters())

    def test_retrace(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        loss.make_value_estimator("retrace", gamma=0.9, lmbda=0.0)
        data = make_data((4, 6))
        torch.manual_seed(5)
        actual = loss.compute_target(data)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=0.9)
        torch.manual_seed(5)
        torch.testing.assert_close(actual, loss.compute_target(data))

    @pytest.mark.filterwarnings(
        "ignore:.*inline_inbuilt_nn_modules:FutureWarning",
        "ignore:.*autograd.Function:DeprecationWarning",
    )
    def test_compiles(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False, fixed_alpha=True, alpha_init=0.1)
        data = make_data()
        data["qvalue_target"] = loss.compute_target(data)
        compiled = torch.compile(lambda td: loss.qvalue_v2_loss(td)[0], backend="eager")
        torch.testing.assert_close(compiled(data), loss.qvalue_v2_loss(data)[0])


class TestAsUpstreamAsksOfALoss:
    """What TorchRL's tests ask of each of its losses, beyond equality with SAC."""

    OUT = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")

    @pytest.mark.parametrize("chosen", [("loss_actor",), ("loss_qvalue", "loss_alpha"), OUT])
    def test_keys_in_and_out(self, blocks, chosen):
        loss, data = TsallisLoss(*blocks, delay_qvalue=False), make_data()
        assert set(loss.out_keys) == set(self.OUT)
        inputs = {key if isinstance(key, str) else "_".join(key): data[key] for key in loss.in_keys}
        assert set(data.select(*loss.in_keys).keys(True, True)) == set(loss.in_keys)
        torch.manual_seed(1)
        expected = loss(data.select(*loss.in_keys))
        torch.manual_seed(1)
        outputs = loss.select_out_keys(*chosen)(**inputs)
        outputs = outputs if isinstance(outputs, tuple) else (outputs,)
        for name, value in zip(chosen, outputs, strict=True):
            torch.testing.assert_close(value, expected[name])

    @pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
    def test_reduction(self, blocks, reduction):
        """The mean and the sum are those of the terms that "none" leaves apart."""
        exclude = {"scalar_output_mode": "exclude"} if reduction == "none" else {}
        apart = TsallisLoss(
            *blocks, delay_qvalue=False, reduction="none", scalar_output_mode="exclude"
        )
        loss = TsallisLoss(*blocks, delay_qvalue=False, reduction=reduction, **exclude)
        loss.load_state_dict(apart.state_dict())
        outs = []
        for each in (apart, loss):
            torch.manual_seed(1)
            outs.append(each(make_data()))
        for name in ("loss_actor", "loss_qvalue", "loss_alpha"):
            expected = outs[0][name]
            assert expected.shape == (8,)
            if reduction != "none":
                expected = getattr(expected, reduction)()
            torch.testing.assert_close(outs[1][name], expected)

    @pytest.mark.parametrize("kind", list(ExplorationType))
    def test_draws_whatever_the_exploration_type(self, blocks, kind):
        """The loss is an expectation over actions: the caller's mode does not turn it off."""
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        outs = []
        for _ in range(2):
            with set_exploration_type(kind):
                outs.append(loss(make_data()))
        for name in ("loss_actor", "loss_qvalue"):
            assert abs(outs[0][name] - outs[1][name]) > 1e-6
        torch.manual_seed(1)
        expected = loss(make_data())
        torch.manual_seed(1)
        with set_exploration_type(kind):
            torch.testing.assert_close(loss(make_data()), expected)

    def test_members_draw_apart_under_vmap(self, blocks):
        """A random layer of the critics is drawn anew for each of them, without an error."""
        net = nn.Sequential(nn.Linear(OBS + ACT, 64), nn.Dropout(0.5), nn.Linear(64, 1)).double()
        critic = ValueOperator(_Concatenated(net), in_keys=["observation", "action"])
        loss = TsallisLoss(blocks[0], critic, num_qvalue_nets=2, delay_qvalue=False)
        twin = loss.qvalue_network_params.data
        twin.apply_(lambda x: x.copy_(x[:1].expand_as(x)))  # the same weights in both
        params = loss.qvalue_network_params
        first, second = loss._vmap_qnetworkN0(make_data(), params, "state_action_value")
        assert not torch.allclose(first, second)

    @pytest.mark.parametrize("delay_actor", [False, True])
    @pytest.mark.parametrize("delay_qvalue", [False, True])
    def test_target_parameters(self, blocks, delay_qvalue, delay_actor):
        loss = TsallisLoss(*blocks, delay_qvalue=delay_qvalue, delay_actor=delay_actor)
        delayed = {"actor_network": delay_actor, "qvalue_network": delay_qvalue}
        updater = SoftUpdate(loss, eps=0.75) if delay_actor or delay_qvalue else None
        trained = {id(p) for p in loss.parameters()}
        for name, is_delayed in delayed.items():
            own, target = (getattr(loss, f"{kind}{name}_params") for kind in ("", "target_"))
            for old, new in zip(own.values(True, True), target.values(True, True), strict=True):
                assert id(old) in trained
                assert id(new) not in trained
                assert (old.data_ptr() != new.data_ptr()) is is_delayed
        if updater is not None:
            for parameter in loss.parameters():
                parameter.data.add_(1.0)
            updater.step()
            for name, is_delayed in delayed.items():
                own, target = (getattr(loss, f"{kind}{name}_params") for kind in ("", "target_"))
                for new, old in zip(target.values(True, True), own.values(True, True), strict=True):
                    torch.testing.assert_close(new, old.data - (0.75 if is_delayed else 0.0))

    @pytest.mark.filterwarnings(
        "ignore:.*inline_inbuilt_nn_modules:FutureWarning",
        "ignore:.*autograd.Function:DeprecationWarning",
    )
    @pytest.mark.parametrize("term", ["actor_loss", "qvalue_v2_loss"])
    def test_terms_compile_without_a_break(self, blocks, term):
        loss = TsallisLoss(*blocks, delay_qvalue=False, fixed_alpha=True, deactivate_vmap=True)
        data = make_data()
        data["qvalue_target"] = loss.compute_target(data)
        method = getattr(loss, term)
        compiled = torch.compile(lambda td: method(td)[0], backend="eager", fullgraph=True)
        torch.manual_seed(1)
        expected = method(data)[0]
        torch.manual_seed(1)
        torch.testing.assert_close(compiled(data), expected)

    @pytest.mark.parametrize("device", get_default_devices())
    def test_device(self, blocks, device):
        loss = TsallisLoss(*blocks, delay_qvalue=False).to(device)
        out = loss(make_data().to(device))
        assert {value.device.type for value in out.values()} == {torch.device(device).type}


class _Concatenated(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, *inputs):
        return self.net(torch.cat(inputs, -1))


class TestMisuse:
    @pytest.mark.parametrize("q", [0.0, -2.0, math.nan, math.inf])
    def test_entropic_index(self, blocks, q):
        with pytest.raises(ValueError, match="entropic_index must be"):
            TsallisLoss(*blocks, entropic_index=q)

    @pytest.mark.parametrize("count", [0, -2, 1.0, True])
    def test_num_qvalue_nets(self, blocks, count):
        with pytest.raises(
            ValueError, match=f"num_qvalue_nets must be an integer, at least 1, got {count}"
        ):
            TsallisLoss(*blocks, num_qvalue_nets=count)

    def test_a_list_of_another_length(self, blocks):
        actor, qvalue = blocks
        with pytest.raises(ValueError, match=r"as many networks as num_qvalue_nets .*=2"):
            TsallisLoss(actor, [qvalue, make_qvalue(), make_qvalue()], num_qvalue_nets=2)

    def test_a_list_of_one_network_twice(self, blocks):
        actor, qvalue = blocks
        with pytest.raises(ValueError, match="qvalue_network shares parameters"):
            TsallisLoss(actor, [qvalue, qvalue])

    def test_a_list_of_unlike_networks(self, blocks):
        actor, qvalue = blocks
        other = ValueOperator(MLP(OBS + ACT, 1, num_cells=[5]), in_keys=qvalue.in_keys)
        with pytest.raises(ValueError, match="qvalue_network: networks of a list must have"):
            TsallisLoss(actor, [qvalue, other])

    @pytest.mark.parametrize("value", [-1.0, 0.0, math.inf, math.nan, True, "1"])
    def test_alpha(self, blocks, value):
        message = f"alpha_init must be a positive finite number, got {value!r}"
        with pytest.raises(ValueError, match=message):
            TsallisLoss(*blocks, alpha_init=value)

    def test_log_prob_shape(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data()
        with pytest.raises(
            ValueError, match=r"log_prob, a tensor, and the critic's value .* \(8, 1\) and \(8,\)"
        ):
            loss.objective(data, data["action"], data["action_log_prob"].unsqueeze(-1))
