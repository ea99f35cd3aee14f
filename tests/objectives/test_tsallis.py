from __future__ import annotations

import functools
import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import CompositeDistribution, TensorDictModule, set_composite_lp_aggregate
from torch import nn
from torchrl.data import Bounded, Composite, MultiStep
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.modules.distributions.utils import rsample_and_log_prob
from torchrl.objectives import SACLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE, TD0Estimator, TD1Estimator, TDLambdaEstimator
from torchrl.testing import get_default_devices

from torchrl_safe import GMMTanhPolicy, RetraceEstimator, TsallisLoss
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


class TestEntropicIndex:
    """It may be changed: what follows from it follows."""

    @pytest.fixture
    def make(self, blocks):
        def make(index, **options):
            return TsallisLoss(*blocks, entropic_index=index, delay_qvalue=False, **options)

        return make

    @pytest.mark.parametrize("read_first", [False, True])
    def test_it_is_set(self, make, read_first):
        loss, data = make(1.0), make_data()
        if read_first:
            assert loss.target_entropy == -ACT
        for index in (2.0, 1.5):  # scheduled
            loss.entropic_index = index
            volume = math.exp(-ACT)
            expected = (1 - volume ** (1 - index)) / (index - 1)
            assert loss.target_entropy.item() == pytest.approx(expected, rel=1e-5)
        fresh = make(1.5)
        fresh.load_state_dict(loss.state_dict())
        outs = []
        for each in (loss, fresh):
            torch.manual_seed(1)
            outs.append(each(data))
        for key in outs[0].keys():
            assert torch.equal(outs[0][key], outs[1][key])

    def test_it_is_loaded(self, make):
        saved, loss = make(1.2), make(1.7)
        loss.load_state_dict(saved.state_dict())
        assert loss.entropic_index == 1.2
        assert torch.equal(loss.target_entropy, saved.target_entropy)
        loss.entropic_index = 1.7
        assert torch.equal(loss.target_entropy, make(1.7).target_entropy)

    def test_a_target_that_was_given_stays(self, make):
        loss = make(1.2, target_entropy=-0.3)
        loss.entropic_index = 2.0
        other = make(3.0, target_entropy=-0.3)
        other.load_state_dict(loss.state_dict())
        for each in (loss, other):
            assert each.entropic_index == 2.0
            assert each.target_entropy.item() == pytest.approx(-0.3)

    @pytest.mark.parametrize("index", [0.0, -3, math.nan, math.inf, True, "2", torch.ones(())])
    def test_it_is_checked(self, make, index):
        loss = make(1.2)
        before = loss.target_entropy.clone()
        with pytest.raises(ValueError, match="entropic_index must be a positive finite number"):
            loss.entropic_index = index
        assert loss.entropic_index == 1.2
        assert torch.equal(loss.target_entropy, before)


class TestValueEstimators:
    BY_NAME = (
        ("td0", TD0Estimator),
        ("TD0", TD0Estimator),
        ("TDLambda", TDLambdaEstimator),
        ("tdlambda", TDLambdaEstimator),
        ("td1", TD1Estimator),
        ("retrace", RetraceEstimator),
        ("RETRACE", RetraceEstimator),
        (ValueEstimators.TDLambda, TDLambdaEstimator),
        (TD0Estimator, TD0Estimator),
        (RetraceEstimator, RetraceEstimator),
        (None, TD0Estimator),
    )

    @pytest.mark.parametrize(("value_type", "kind"), BY_NAME)
    def test_by_name_member_and_class(self, blocks, value_type, kind):
        """Any spelling gives the same target, under keys that were set before or after."""
        data = make_data((4, 6))
        data["next", "bonus"] = data["next"].pop("reward")
        hyperparams = {"gamma": 0.8}
        if kind in (TDLambdaEstimator, RetraceEstimator):
            hyperparams["lmbda"] = 0.5
        targets = []
        for keys_first in (False, True):
            torch.manual_seed(0)
            loss = TsallisLoss(*blocks, delay_qvalue=False)
            if keys_first:
                loss.set_keys(reward="bonus")
            assert loss.make_value_estimator(value_type, **hyperparams) is loss
            assert type(loss.value_estimator) is kind
            loss.set_keys(reward="bonus")
            torch.manual_seed(5)
            targets.append(loss.compute_target(data))
        torch.manual_seed(0)
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        if kind is RetraceEstimator:
            estimator = RetraceEstimator.for_loss(loss, **hyperparams)
        else:
            estimator = kind(value_network=None, **hyperparams)
        loss.make_value_estimator(estimator)
        assert loss.value_estimator is estimator
        loss.set_keys(reward="bonus")
        torch.manual_seed(5)
        targets.append(loss.compute_target(data))
        for target in targets[1:]:
            assert torch.equal(target, targets[0])

    @pytest.mark.parametrize("value_type", ["gae", "td", ValueEstimators.GAE, 3, nn.Linear])
    def test_of_an_unknown_kind(self, blocks, value_type):
        loss = TsallisLoss(*blocks)
        before = loss.value_estimator, loss.value_type
        message = "value_type must be one of 'td0', 'td1', 'tdlambda', 'retrace', .* got"
        with pytest.raises(ValueError, match=message):
            loss.make_value_estimator(value_type)
        assert (loss.value_estimator, loss.value_type) == before

    @pytest.mark.parametrize("estimator", ["td0", "tdlambda", "retrace"])
    @pytest.mark.parametrize("dtype", [torch.int64, torch.int8, torch.bool])
    def test_rewards_that_are_no_floats(self, blocks, estimator, dtype):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        loss.make_value_estimator(estimator, gamma=0.9)
        data = make_data((4, 6))
        data["next", "reward"] = (data["next", "reward"] > 0).to(dtype)
        torch.manual_seed(5)
        target = loss.compute_target(data)
        assert data["next", "reward"].dtype == dtype
        data["next", "reward"] = data["next", "reward"].double()
        torch.manual_seed(5)
        torch.testing.assert_close(target, loss.compute_target(data))

    @pytest.mark.parametrize("estimator", ["td0", "tdlambda", "retrace"])
    @pytest.mark.parametrize("end", ["done", "terminated"])
    def test_nan_behind_an_end(self, blocks, estimator, end):
        """The state before it takes its place; what has terminated does not look at it."""
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        loss.make_value_estimator(estimator, gamma=0.9)
        data = make_data((4, 6))
        data["next", "done"][:, 2] = True
        data["next", end][:, 2] = True
        plain = data.clone()
        plain["next", "observation"][:, 2] = plain["observation"][:, 2]
        data["next", "observation"][:, 2] = math.nan
        torch.manual_seed(5)
        target = loss.compute_target(data)
        torch.manual_seed(5)
        assert torch.equal(target, loss.compute_target(plain))
        assert data["next", "observation"][:, 2].isnan().all()
        if end == "terminated":
            torch.testing.assert_close(target[:, 2], data["next", "reward"][:, 2])

    def test_a_value_target_of_others_is_not_read(self, blocks):
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data((4, 6))
        torch.manual_seed(5)
        expected, _ = loss.qvalue_v2_loss(data)
        state_value = ValueOperator(MLP(OBS, 1, num_cells=[4]).double())
        GAE(gamma=0.9, lmbda=0.9, value_network=state_value)(data)
        assert "value_target" in data.keys()
        torch.manual_seed(5)
        assert torch.equal(loss.qvalue_v2_loss(data)[0], expected)


class TestMasks:
    @pytest.mark.parametrize("shape", [(4, 6), (4, 6, 1)])
    def test_padding_counts_nowhere(self, blocks, shape):
        """Losses and entropy are means over the steps that the mask keeps."""
        loss = TsallisLoss(*blocks, delay_qvalue=False)
        data = make_data((4, 6))
        data["qvalue_target"] = loss.compute_target(data)
        mask = torch.ones(4, 6, dtype=torch.bool)
        mask[1, 4:] = mask[3, 1:] = False
        data["observation"][~mask] = 30.0
        data["collector", "mask"] = mask.view(shape)
        torch.manual_seed(1)
        out = loss(data)
        torch.manual_seed(1)
        log_prob = loss.actor_loss(data)[1]["log_prob"]
        torch.testing.assert_close(out["entropy"], -log_prob[mask].mean())
        expected = -(loss.log_alpha * (log_prob[mask] + loss.target_entropy)).mean()
        torch.testing.assert_close(out["loss_alpha"], expected)
        valid = data[mask].exclude("collector")
        torch.testing.assert_close(out["loss_qvalue"], loss.qvalue_v2_loss(valid)[0])


class TestActions:
    def test_parts_of_a_composite_action(self):
        """The density is the joint one: the product of those of the parts."""
        torch.manual_seed(0)
        q, alpha = 1.7, 0.3
        actor, qvalue = make_composite_actor(), make_composite_critic()
        loss = TsallisLoss(
            actor,
            qvalue,
            entropic_index=q,
            alpha_init=alpha,
            action_spec=COMPOSITE_SPEC,
            delay_qvalue=False,
            num_qvalue_nets=1,
        )
        assert loss.target_entropy.item() == pytest.approx((1 - math.exp(5 * (q - 1))) / (q - 1))
        loss.make_value_estimator("td0", gamma=0.9)
        data = make_data((4, 6))
        data["action"] = actor.get_dist(data).sample()

        def value_and_log_q(states):
            params = actor.module[0](states.select("observation"))["params"]
            action = actor.get_dist(states).sample()
            log_prob = sum(
                TanhNormal(**params[part].to_dict()).log_prob(action[part]) for part in ("a", "b")
            )
            inputs = [states["observation"], action["a"], action["b"]]
            value = qvalue.module.net(torch.cat(inputs, -1)).squeeze(-1)
            return value, (log_prob.exp() ** (q - 1) - 1) / (q - 1)

        close = {"rtol": 1e-5, "atol": 1e-6}  # the inverse of tanh
        torch.manual_seed(1)
        target = loss.compute_target(data)
        torch.manual_seed(1)
        value, log_q = value_and_log_q(data["next"])
        following = (value - alpha * log_q).unsqueeze(-1) * ~data["next", "terminated"]
        torch.testing.assert_close(target, data["next", "reward"] + 0.9 * following, **close)
        torch.manual_seed(1)
        actor_loss, metadata = loss.actor_loss(data)
        torch.manual_seed(1)
        value, log_q = value_and_log_q(data)
        torch.testing.assert_close(metadata["log_prob"], log_q, **close)
        torch.testing.assert_close(actor_loss, (alpha * log_q - value).mean(), **close)
        out = loss(data)
        (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
        assert all(p.grad is not None for p in loss.parameters())

        # Retrace without traces is TD(0), also of composite actions.
        loss.make_value_estimator("retrace", gamma=0.9, lmbda=0.0)
        torch.manual_seed(1)
        torch.testing.assert_close(loss.compute_target(data), target)

    def test_densities_of_parts_are_refused(self):
        actor = make_composite_actor()
        loss = TsallisLoss(actor, make_composite_critic(), delay_qvalue=False)
        data = make_data()
        action, parts = rsample_and_log_prob(actor.get_dist(data))
        with pytest.raises(ValueError, match=r"log_prob, a tensor, .* got TensorDict"):
            loss.objective(data, action, parts)
        with set_composite_lp_aggregate(True):
            action, log_prob = rsample_and_log_prob(actor.get_dist(data))
        assert loss.objective(data, action, log_prob).shape == (8,)

    @pytest.mark.parametrize("estimator", ["td0", "retrace"])
    def test_matrices(self, estimator):
        """A matrix of four actions is the vector of the four."""
        data, outs = make_data((4, 6)), []
        data["action"] = torch.rand(4, 6, 4).double()
        for matrix in (False, True):
            torch.manual_seed(0)
            shape = (2, 2) if matrix else (4,)
            net = nn.Sequential(MLP(OBS, 8, num_cells=[16]), NormalParamExtractor()).double()
            actor = ProbabilisticActor(
                TensorDictModule(_Shaped(net, shape), ["observation"], ["loc", "scale"]),
                in_keys=["loc", "scale"],
                spec=Bounded(-1, 1, shape, dtype=torch.float64),
                distribution_class=TanhNormal,
                distribution_kwargs={"event_dims": len(shape)},
            )
            critic = _Flat(MLP(OBS + 4, 1, num_cells=[16]).double())
            qvalue = ValueOperator(critic, in_keys=["observation", "action"])
            loss = TsallisLoss(actor, qvalue, delay_qvalue=False)
            loss.make_value_estimator(estimator, gamma=0.9)
            inputs = data.clone()
            inputs["action"] = data["action"].unflatten(-1, shape)
            torch.manual_seed(1)
            outs.append(loss(inputs))
        for key in outs[0].keys():
            torch.testing.assert_close(outs[0][key], outs[1][key])


class _Shaped(nn.Module):
    def __init__(self, net, shape):
        super().__init__()
        self.net, self.shape = net, shape

    def forward(self, observation):
        return tuple(x.unflatten(-1, self.shape) for x in self.net(observation))


class _Flat(nn.Module):
    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action.reshape(*observation.shape[:-1], -1)], -1))


class _Parts(nn.Module):
    """Locations and scales of an action of two parts, of two and of three dimensions."""

    def __init__(self):
        super().__init__()
        self.net = nn.Sequential(nn.Linear(OBS, 10), NormalParamExtractor())

    def forward(self, observation):
        loc, scale = self.net(observation)
        return loc[..., :2], scale[..., :2], loc[..., 2:], scale[..., 2:]


COMPOSITE_SPEC = Composite(
    action=Composite(
        a=Bounded(-1, 1, (2,), dtype=torch.float64), b=Bounded(-1, 1, (3,), dtype=torch.float64)
    )
)


def make_composite_actor():
    keys = [("params", part, name) for part in ("a", "b") for name in ("loc", "scale")]
    return ProbabilisticActor(
        TensorDictModule(_Parts().double(), ["observation"], keys),
        in_keys=["params"],
        out_keys=["action"],
        spec=COMPOSITE_SPEC,
        distribution_class=functools.partial(
            CompositeDistribution, distribution_map={"a": TanhNormal, "b": TanhNormal}
        ),
    )


class _OfParts(nn.Module):
    def __init__(self):
        super().__init__()
        self.net = MLP(OBS + 5, 1, num_cells=[8]).double()

    def forward(self, observation, action):
        return self.net(torch.cat([observation, action["a"], action["b"]], -1))


def make_composite_critic():
    return TensorDictModule(_OfParts(), ["observation", "action"], ["state_action_value"])


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
