from __future__ import annotations

import math
from copy import deepcopy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy
from torchrl_safe.objectives.functional import cvar_factor, discounted_cost_limit

OBS, ACT = 3, 2


def make_actor():
    net = MLP(OBS, 3 * (1 + 2 * ACT), num_cells=[16])
    return GMMTanhPolicy(
        net, Bounded(-1, 1, (ACT,), dtype=torch.float64), num_components=3
    ).double()


def make_critic(key, *last):
    net = MLP(OBS + ACT, 1, num_cells=[16]).extend(last)
    return ValueOperator(net, in_keys=["observation", "action"], out_keys=[key]).double()


def make_loss(cost_limit=2.5, gamma=0.9, lmbda=0.8, **kwargs):
    torch.manual_seed(0)
    loss = CVaRCostLoss(
        make_actor(),
        make_critic("cost_value"),
        make_critic("cost_std", nn.Softplus()),
        cost_limit=cost_limit,
        **kwargs,
    )
    loss.make_value_estimator(gamma=gamma, lmbda=lmbda)
    return loss


def make_data(batch=(4, 6)):
    generator = torch.Generator().manual_seed(3)

    def rand(*shape):
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    done = torch.rand(*batch, 1, generator=generator) < 0.2
    terminated = done & (torch.rand(*batch, 1, generator=generator) < 0.5)
    return TensorDict(
        {
            "observation": rand(OBS),
            "action": rand(ACT).tanh(),
            "action_log_prob": rand(),
            "next": {
                "observation": rand(OBS),
                "cost": rand(1).sigmoid(),
                "done": done,
                "terminated": terminated,
            },
        },
        batch_size=batch,
    )


def predictions(loss, data, action):
    """Mean and standard deviation, by plain modules and not by the loss's own functional calls."""
    out = []
    for name in ("cost_network", "std_network"):
        params, network = getattr(loss, f"{name}_params"), getattr(loss, name)
        values = []
        for index in range(params.batch_size[0]):
            with params[index].to_module(network):
                values.append(network.module(torch.cat([data["observation"], action], -1)))
        out.append(torch.stack(values).mean(0))
    return out


class TestTarget:
    @pytest.mark.parametrize("num_cost_nets", [1, 2])
    @pytest.mark.parametrize("variance_reward", ["td_error", "second_moment"])
    def test_double_loop(self, num_cost_nets, variance_reward):
        gamma, lmbda = 0.9, 0.8
        loss = make_loss(
            gamma=gamma,
            lmbda=lmbda,
            num_cost_nets=num_cost_nets,
            variance_reward=variance_reward,
        )
        data = make_data()
        torch.manual_seed(7)
        mean_target, std_target = loss.compute_target(data)

        torch.manual_seed(7)
        actor = loss.actor_network
        with torch.no_grad():
            next_action, _ = actor.get_dist(data["next"]).sample_and_log_prob()
            ratio = actor.get_dist(data).log_prob(data["action"]) - data["action_log_prob"]
            rho = ratio.exp().clamp(max=1)
            mean, std = predictions(loss, data, data["action"])
            next_mean, next_std = predictions(loss, data["next"], next_action)
        cost, done, terminated = (data["next", key] for key in ("cost", "done", "terminated"))
        batch, steps = data.batch_size
        for b in range(batch):
            mean_trace = variance_trace = 0.0
            for t in reversed(range(steps)):
                alive = 0.0 if terminated[b, t] else 1.0
                q, v = mean[b, t, 0], std[b, t, 0] ** 2
                backup = cost[b, t, 0] + gamma * alive * next_mean[b, t, 0]
                # (18): the trace is cut at the end of an episode and of the slice.
                linked = t + 1 < steps and not done[b, t]
                coefficient = lmbda * rho[b, t + 1] if linked else 0.0
                q_ret = backup + gamma * coefficient * mean_trace
                reward = (backup - q) ** 2
                if variance_reward == "second_moment":  # as (18) has it
                    reward = backup**2 - q**2
                v_ret = reward + gamma**2 * alive * next_std[b, t, 0] ** 2
                v_ret = v_ret + gamma**2 * coefficient * variance_trace
                torch.testing.assert_close(mean_target[b, t, 0], q_ret)
                torch.testing.assert_close(std_target[b, t, 0], v_ret.clamp(min=0).sqrt())
                mean_trace, variance_trace = q_ret - q, v_ret - v

    def test_no_gradient_and_input_untouched(self):
        loss, data = make_loss(), make_data()
        before = data.clone()
        mean_target, std_target = loss.compute_target(data)
        assert not mean_target.requires_grad
        assert not std_target.requires_grad
        assert (data == before).all()
        assert set(data.keys(True, True)) == set(before.keys(True, True))

    @pytest.mark.parametrize(
        "value_type", [ValueEstimators.TD0, ValueEstimators.TDLambda, TD0Estimator]
    )
    def test_other_estimators(self, value_type):
        loss, data = make_loss(), make_data()
        loss.make_value_estimator(value_type, gamma=0.9)
        torch.manual_seed(7)
        mean_target, std_target = loss.compute_target(data)
        assert mean_target.isfinite().all()
        assert std_target.isfinite().all()
        if value_type is not ValueEstimators.TDLambda:
            retrace = make_loss(gamma=0.9, lmbda=0.0)
            torch.manual_seed(7)
            expected = retrace.compute_target(data)
            torch.testing.assert_close((mean_target, std_target), expected)

    def test_unsupported_estimator(self):
        with pytest.raises(NotImplementedError, match="TD0"):
            make_loss().make_value_estimator(ValueEstimators.GAE)

    @pytest.mark.parametrize("gamma", [1.0, -0.1, math.nan])
    def test_bad_gamma(self, gamma):
        loss = make_loss()
        estimator = loss.value_estimator
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got"):
            loss.make_value_estimator(gamma=gamma)
        assert loss.value_estimator is estimator


class TestCritics:
    def test_regression(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        out = loss(data)
        torch.manual_seed(7)
        mean_target, std_target = loss.compute_target(data)
        mean, std = predictions(loss, data, data["action"])
        # With one mean, the Wasserstein-2 distance of two Gaussians is that of their deviations.
        torch.testing.assert_close(out["loss_cost_value"], (mean - mean_target).square().mean())
        torch.testing.assert_close(out["loss_cost_std"], (std - std_target).square().mean())
        torch.testing.assert_close(out["cost_value"], mean.mean())
        torch.testing.assert_close(out["cost_std"], std.mean())

    def test_precomputed_targets(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        expected = loss(data)
        torch.manual_seed(7)
        data["cost_target"], data["std_target"] = loss.compute_target(data)
        flat = data.select("observation", "action", "cost_target", "std_target").flatten()
        torch.testing.assert_close(loss(flat), expected)

    @pytest.mark.parametrize(
        ("variance_reward", "low", "high"), [("td_error", 0.85, 1.1), ("second_moment", 1.4, 3.0)]
    )
    def test_learns_the_distribution_of_a_known_chain(self, variance_reward, low, high):
        """Costs of independent N(0.5, 0.2^2) steps: mean 5, variance .04 / (1 - gamma^2).

        Targets of (18) as written have a noise that dwarfs this variance, and the root of their
        positive part is too large by far; it is why they are not the default.
        """
        torch.manual_seed(0)
        gamma = 0.9
        loss = make_loss(gamma=gamma, lmbda=0.9, variance_reward=variance_reward)
        optim = torch.optim.Adam(loss.parameters(), lr=1e-2)
        for step in range(300):
            data = make_data((32, 10))
            data["observation"].zero_()
            data["next", "observation"].zero_()
            with torch.no_grad():
                loss.actor_network(data)
            data["next", "cost"] = 0.5 + 0.2 * torch.randn(32, 10, 1, dtype=torch.float64)
            data["next", "done"].zero_()
            data["next", "terminated"].zero_()
            out = loss(data)
            optim.zero_grad()
            (out["loss_cost_value"] + out["loss_cost_std"]).backward()
            optim.step()
            for group in optim.param_groups:
                group["lr"] = 1e-2 * (1 - step / 300)
        assert out["cost_value"].item() == pytest.approx(0.5 / (1 - gamma), rel=0.03)
        exact = 0.2 / math.sqrt(1 - gamma**2)
        assert low * exact < out["cost_std"].item() < high * exact

    def test_gradient_isolation(self):
        loss = make_loss()
        out = loss(make_data())
        for key, owner in (
            ("loss_cost_value", "cost_network_params"),
            ("loss_cost_std", "std_network_params"),
        ):
            loss.zero_grad()
            out[key].backward(retain_graph=True)
            touched = {
                name.split(".")[0]
                for name, p in loss.named_parameters()
                if p.grad is not None and p.grad.abs().max() > 0
            }
            assert touched == {owner}

    def test_reduction_none(self):
        out = make_loss(reduction="none")(make_data())
        assert out["loss_cost_value"].shape == out["cost_std"].shape == (4, 6)

    @pytest.mark.parametrize("use", ["auto", True, False])
    def test_priority_weights(self, use):
        loss = make_loss(use_prioritized_weights=use)
        data = make_data()
        data["cost_target"], data["std_target"] = loss.compute_target(data)
        data = data.flatten()
        weight = torch.rand(24, dtype=torch.float64)
        data["priority_weight"] = weight
        for name in ("loss_cost_value", "loss_cost_std"):
            each = torch.stack([loss(data[i : i + 1])[name] for i in range(24)])
            expected = each.mean() if use is False else (weight * each).sum() / weight.sum()
            torch.testing.assert_close(loss(data)[name], expected)

    def test_target_networks(self):
        loss = make_loss(delay_cost=True)
        updater = SoftUpdate(loss, eps=0.5)
        data = make_data()
        torch.manual_seed(7)
        before = loss.compute_target(data)
        with torch.no_grad():
            for p in loss.cost_network_params.parameters():
                p.add_(0.1)
        torch.manual_seed(7)
        torch.testing.assert_close(loss.compute_target(data), before)
        updater.step()
        torch.manual_seed(7)
        assert not torch.allclose(loss.compute_target(data)[0], before[0])

    def test_vmap_and_loop_agree(self):
        loss, looped = make_loss(num_cost_nets=2), make_loss(num_cost_nets=2, deactivate_vmap=True)
        looped.load_state_dict(loss.state_dict())
        outs = []
        for module in (loss, looped):
            torch.manual_seed(2)
            outs.append(module(make_data()))
        torch.testing.assert_close(*outs)

    def test_state_dict(self):
        loss, other = make_loss(), make_loss()
        with torch.no_grad():
            for p in loss.parameters():
                p.add_(1.0)
        other.load_state_dict(deepcopy(loss.state_dict()))
        torch.testing.assert_close(
            other(make_data())["cost_value"], loss(make_data())["cost_value"]
        )

    def test_dispatch(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        expected = loss(data)
        torch.manual_seed(7)
        kwargs = {key.replace(".", "_"): value for key, value in data.flatten_keys(".").items()}
        loss.select_out_keys("loss_cost_value", "loss_cost_std")
        value, std = loss(**kwargs)
        torch.testing.assert_close(value, expected["loss_cost_value"])
        torch.testing.assert_close(std, expected["loss_cost_std"])

    def test_keys(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        expected = loss(data)
        loss.set_keys(cost=("agents", "price"))
        data["next", "agents", "price"] = data["next"].pop("cost")
        torch.manual_seed(7)
        torch.testing.assert_close(loss(data), expected)


class TestConstraint:
    @pytest.mark.parametrize("risk_level", [0.125, 1.0])
    def test_value(self, risk_level):
        loss, data = make_loss(cost_limit=1.5, risk_level=risk_level), make_data()
        mean, std = predictions(loss, data, data["action"])
        gamma = mean + cvar_factor(risk_level) * std
        torch.testing.assert_close(loss.cvar(data, data["action"]), gamma.squeeze(-1))
        torch.testing.assert_close(loss.constraint(data, data["action"]), gamma.mean() - 1.5)

    def test_predictions(self):
        loss, data = make_loss(num_cost_nets=2), make_data()
        expected = predictions(loss, data, data["action"])
        for got, value in zip(loss.predict(data, data["action"]), expected, strict=True):
            torch.testing.assert_close(got, value.squeeze(-1))

    def test_gradient_reaches_the_policy_alone(self):
        loss, data = make_loss(), make_data()
        action = loss.actor_network.get_dist(data).rsample()
        loss.constraint(data, action).backward()
        touched = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None}
        assert touched == {"actor_network_params"}

    def test_reference_scales_the_change_and_not_the_level(self):
        loss, data = make_loss(cost_limit=1.5, gamma=0.9), make_data()
        action = data["action"].clone().requires_grad_()
        plain = loss.constraint(data, action)
        (plain_grad,) = torch.autograd.grad(plain, action)
        reference = loss.cvar(data, action).mean().detach()
        scaled = loss.constraint(data, action, reference=reference)
        (scaled_grad,) = torch.autograd.grad(scaled, action)
        torch.testing.assert_close(scaled, plain)
        torch.testing.assert_close(scaled_grad, 10 * plain_grad)

    def test_level(self):
        loss, data = make_loss(cost_limit=1.5, gamma=0.9, risk_level=0.5), make_data()
        _, std = predictions(loss, data, data["action"])
        mean_cost = data["next", "cost"].mean()
        level = loss.on_policy_cvar(data)
        assert not level.requires_grad
        expected = mean_cost * 10 + 0.79788456 * std.mean().detach()
        torch.testing.assert_close(level, expected, rtol=1e-6, atol=1e-6)
        reference = loss.cvar(data, data["action"]).mean()
        actual = loss.constraint(data, data["action"], reference=reference, level=level)
        torch.testing.assert_close(actual, level - 1.5)
        with pytest.raises(ValueError, match="needs the reference"):
            loss.constraint(data, data["action"], level=level)

    def test_level_is_the_mean_value_of_visited_states(self):
        """A two-state chain that costs 1 in one state and 0 in the other, solved exactly."""
        gamma = 0.9
        transition = torch.tensor([[0.8, 0.2], [0.6, 0.4]], dtype=torch.float64)
        cost = torch.tensor([0.0, 1.0], dtype=torch.float64)
        value = torch.linalg.solve(torch.eye(2).double() - gamma * transition, cost)
        visited = torch.tensor([0.75, 0.25], dtype=torch.float64)
        torch.testing.assert_close(visited @ transition, visited)  # stationary

        data = make_data((100, 200))
        state = torch.multinomial(visited, 100, replacement=True)
        for t in range(200):
            data["next", "cost"][:, t, 0] = cost[state]
            state = torch.multinomial(transition[state], 1).squeeze(-1)
        loss = make_loss(gamma=gamma, risk_level=1.0)
        assert loss.on_policy_cvar(data).item() == pytest.approx((visited @ value).item(), rel=0.02)

    def test_units_agree(self):
        """In a chain that costs c at each step, constraint and limit are both c / (1 - gamma).

        The cost depends on the action alone, c = a: following the action a at every step costs
        a / (1 - gamma), which is what the constraint must say to first order.
        """
        gamma, rate = 0.9, 0.3
        loss = make_loss(cost_limit=discounted_cost_limit(rate, gamma), gamma=gamma, risk_level=1.0)

        class Critic(nn.Module):
            """Q_C(s, a) = a + gamma * rate / (1 - gamma): the critic of the policy a = rate."""

            def __init__(self):
                super().__init__()
                self.offset = nn.Parameter(torch.tensor(gamma * rate / (1 - gamma)).double())

            def forward(self, observation, action):
                return action[..., :1] + self.offset

        keys = {"in_keys": ["observation", "action"]}
        exact = CVaRCostLoss(
            loss.actor_network,
            ValueOperator(Critic(), **keys, out_keys=["cost_value"]),
            make_critic("cost_std", nn.Softplus()),
            cost_limit=discounted_cost_limit(rate, gamma),
            risk_level=1.0,
        )
        # Fresh copies of the parameters are drawn for ensembles: put the critic's own back.
        exact.cost_network_params.apply_(lambda p: p.data.fill_(gamma * rate / (1 - gamma)))
        exact.make_value_estimator(gamma=gamma)
        data = make_data()
        old = torch.full((4, 6, ACT), rate, dtype=torch.float64)
        reference = exact.cvar(data, old).mean()
        torch.testing.assert_close(reference, exact.cost_limit.double(), rtol=1e-6, atol=1e-6)
        new_rate = rate + 0.05
        new = torch.full_like(old, new_rate)
        actual = exact.constraint(data, new, reference=reference)
        assert actual.item() == pytest.approx((new_rate - rate) / (1 - gamma), rel=1e-5)


class TestMisuse:
    @pytest.mark.parametrize("cost_limit", [-1.0, math.nan, math.inf])
    def test_cost_limit(self, cost_limit):
        with pytest.raises(ValueError, match="cost_limit must be finite and at least 0, got"):
            make_loss(cost_limit=cost_limit)

    @pytest.mark.parametrize("risk_level", [0.0, 1.5, -1.0, math.nan])
    def test_risk_level(self, risk_level):
        with pytest.raises(ValueError, match=r"risk_level must be in \(0, 1\], got"):
            make_loss(risk_level=risk_level)

    def test_variance_reward(self):
        with pytest.raises(ValueError, match=r"variance_reward must be one of .* got 'exact'"):
            make_loss(variance_reward="exact")

    def test_num_cost_nets(self):
        with pytest.raises(ValueError, match="num_cost_nets must be at least 1, got 0"):
            make_loss(num_cost_nets=0)

    def test_missing_log_prob(self):
        with pytest.raises(KeyError, match="action_log_prob"):
            make_loss()(make_data().exclude("action_log_prob"))
