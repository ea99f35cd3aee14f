from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import pytest
import torch
from cost_losses import ACT, OBS, make_actor, make_data
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate, ValueEstimators
from torchrl.objectives.value import GAE, TDLambdaEstimator

from torchrl_safe import CVaRCostLoss, RetraceEstimator
from torchrl_safe.objectives import MeasuredCVaR, QuantileCostLoss
from torchrl_safe.objectives.distribution import (
    quantile_cvar,
    quantile_loss,
    spectral_risk,
    spectral_weights,
)
from torchrl_safe.objectives.value import (
    PolicyEvaluation,
    distributional_retrace_estimate,
    evaluate_policy,
    visited_value_estimate,
)

N = 8


def make_critic(num_quantiles=N):
    net = MLP(OBS + ACT, num_quantiles, num_cells=[16])
    keys = {"in_keys": ["observation", "action"], "out_keys": ["cost_quantiles"]}
    return ValueOperator(net, **keys).double()


class Constant(nn.Module):
    """A critic that says the same of every state and action; its values can be learned."""

    def __init__(self, values):
        super().__init__()
        self.values = nn.Parameter(torch.as_tensor(values, dtype=torch.float64))

    def forward(self, observation, action):
        return self.values.expand(*observation.shape[:-1], -1)


def constant_critic(values):
    keys = {"in_keys": ["observation", "action"], "out_keys": ["cost_quantiles"]}
    return ValueOperator(Constant(values), **keys)


class Spread(nn.Module):
    """Quantiles around the first number of the observation."""

    def __init__(self):
        super().__init__()
        self.around = nn.Parameter(torch.tensor([0.5, 1.5], dtype=torch.float64))

    def forward(self, observation, action):
        return observation[..., :1] * self.around


def make_loss(cost_limit=2.5, gamma=0.9, critic=None, estimator=None, **kwargs):
    torch.manual_seed(0)
    critic = make_critic() if critic is None else critic
    loss = QuantileCostLoss(make_actor(), critic, cost_limit=cost_limit, **kwargs)
    options = {"lmbda": 0.8} if estimator in ("retrace", "tdlambda") else {}
    return loss.make_value_estimator(estimator, gamma=gamma, **options)


def predictions(loss, data, action):
    """Sorted quantiles of every network, by plain modules, not by the loss's functional calls."""
    params, network = loss.cost_network_params, loss.cost_network
    values = []
    for member in params.unbind(0) if params.batch_dims else [params]:
        with member.to_module(network):
            values.append(network.module(torch.cat([data["observation"], action], -1)))
    return torch.stack(values).sort(-1).values


def close(actual, expected, **options):
    """The discount is a float32 buffer of TorchRL's estimators."""
    torch.testing.assert_close(actual, expected, **{"rtol": 1e-6, "atol": 1e-6, **options})


class TestTarget:
    @pytest.mark.parametrize("num_cost_nets", [1, 2])
    @pytest.mark.parametrize("given", [False, True])
    def test_sums_of_real_costs(self, num_cost_nets, given):
        """As many draws as quantiles: every one of them once, in order."""
        loss, data = make_loss(num_cost_nets=num_cost_nets, num_samples=N), make_data()
        policy = evaluate_policy(data, loss.actor_network)
        if given:
            samples, weights = loss.compute_target(data, policy=policy)
            following = predictions(loss, data["next"], policy.next_action).mean(0)
        else:  # a critic that does not look at the action
            for p in loss.cost_network_params.parameters():
                if p.shape[-1] == OBS + ACT:
                    p.data[..., OBS:] = 0
            samples, weights = loss.compute_target(data)
            following = predictions(loss, data["next"], data["action"]).mean(0)
        cost, done, terminated = (data["next", key] for key in ("cost", "done", "terminated"))
        assert samples.shape == weights.shape == (4, 6, N)
        assert not samples.requires_grad
        close(weights, torch.full_like(weights, 1 / N))
        for b in range(4):
            sums = None
            for t in reversed(range(6)):
                if terminated[b, t]:
                    follows = torch.zeros(N).double()
                elif done[b, t] or t == 5:
                    follows = following[b, t]
                else:
                    follows = sums
                sums = cost[b, t] + 0.9 * follows
                close(samples[b, t], sums.detach())

    def test_the_critic_is_asked_at_cuts_alone(self):
        loss, data = make_loss(), make_data((4, 50))
        asked = []
        loss.cost_network.register_forward_hook(
            lambda module, inputs, output: asked.append(output["cost_quantiles"].shape)
        )
        loss.compute_target(data)
        done, terminated = data["next", "done"].clone(), data["next", "terminated"]
        done[:, -1] = True
        assert asked == [((done & ~terminated).sum(), N)]
        asked.clear()
        data["next", "terminated"] = data["next", "done"] = done
        loss.compute_target(data)
        assert asked == []

    def test_td0(self):
        loss, data = make_loss(estimator="td0", num_samples=N), make_data()
        policy = evaluate_policy(data, loss.actor_network)
        samples, _ = loss.compute_target(data, policy=policy)
        following = predictions(loss, data["next"], policy.next_action).mean(0)
        alive = ~data["next", "terminated"]
        close(samples, (data["next", "cost"] + 0.9 * alive * following).detach())

    def test_td_lambda_is_a_mixture(self):
        """The mean over many draws is the lambda-return of the mean."""
        loss, data = make_loss(estimator="tdlambda", num_samples=4000), make_data()
        policy = evaluate_policy(data, loss.actor_network)
        samples, _ = loss.compute_target(data, policy=policy)
        value = predictions(loss, data["next"], policy.next_action).mean((0, -1))[..., None]
        cost, done, terminated = (data["next", key] for key in ("cost", "done", "terminated"))
        for b in range(4):
            mean = None
            for t in reversed(range(6)):
                follows = value[b, t]
                if not done[b, t] and t < 5:
                    follows = 0.2 * value[b, t] + 0.8 * mean
                mean = cost[b, t] + 0.9 * (0 if terminated[b, t] else follows)
                close(samples[b, t].mean(), mean[0].detach(), atol=0.02)

    def test_retrace(self):
        loss, data = make_loss(estimator="retrace", num_samples=N), make_data()
        policy = evaluate_policy(data, loss.actor_network)
        actual = loss.compute_target(data, policy=policy)
        done = data["next", "done"].clone()
        done[:, -1] = True
        expected = distributional_retrace_estimate(
            0.9,
            0.8,
            policy.log_prob[..., None],
            data["action_log_prob"][..., None],
            predictions(loss, data, data["action"]).mean(0).detach(),
            predictions(loss, data["next"], policy.next_action).mean(0).detach(),
            data["next", "cost"],
            done,
            data["next", "terminated"],
        )
        assert actual[0].shape == (4, 6, 2 * 6 * N)
        for x, y in zip(actual, expected, strict=True):
            close(x, y)
        torch.manual_seed(1)
        assert loss(data)["loss_cost_quantiles"].isfinite()

    @pytest.mark.parametrize("kind", ["retrace", "td0", "td1", "TDLambda", RetraceEstimator])
    def test_estimators_by_name_and_class(self, kind):
        loss = make_loss().make_value_estimator(kind, gamma=0.9)
        assert loss(make_data())["loss_cost_quantiles"].isfinite()

    def test_an_estimator_that_is_made(self):
        made = TDLambdaEstimator(gamma=0.9, lmbda=0.5, value_network=None)
        assert make_loss().make_value_estimator(made).value_estimator is made

    @pytest.mark.parametrize("kind", [ValueEstimators.GAE, "gae", 3, GAE])
    def test_unsupported_estimators(self, kind):
        loss = make_loss()
        before = loss.value_estimator
        options = {"lmbda": 0.9} if kind is GAE else {}
        with pytest.raises(ValueError, match="value_type must be"):
            loss.make_value_estimator(kind, **options)
        assert loss.value_estimator is before

    @pytest.mark.parametrize("gamma", [1.0, -0.1, math.nan])
    def test_bad_gamma(self, gamma):
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got"):
            make_loss(gamma=gamma)

    @pytest.mark.parametrize("options", [{"average_rewards": True}, {"group_key": "task"}])
    def test_costs_are_not_standardised(self, options):
        with pytest.raises(ValueError, match=r"must be left out, got .* unit of cost_limit"):
            make_loss().make_value_estimator("retrace", **options)


class TestCritic:
    def test_regression(self):
        loss, data = make_loss(num_cost_nets=2, kappa=0.3), make_data()
        data["cost_target"], data["target_weight"] = loss.compute_target(data)
        out = loss(data)
        quantiles = predictions(loss, data, data["action"])
        expected = sum(
            quantile_loss(member, data["cost_target"], kappa=0.3).mean() for member in quantiles
        )
        # The critic's own order decides which output is which quantile: the same up to crossings.
        assert out["loss_cost_quantiles"] >= expected - 1e-9
        mean = quantiles.mean(0)
        close(out["cost_value"], mean.mean().detach())
        close(out["cost_std"], mean.std(-1, unbiased=False).mean().detach())
        assert not out["cost_value"].requires_grad

    def test_precomputed_targets(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        expected = loss(data)
        torch.manual_seed(7)
        data["cost_target"], data["target_weight"] = loss.compute_target(data)
        flat = data.select("observation", "action", "cost_target", "target_weight").flatten()
        torch.testing.assert_close(loss(flat), expected)
        del flat["target_weight"]
        torch.testing.assert_close(loss(flat), expected)

    def test_targets_of_somebody_else(self):
        loss, data = make_loss(), make_data()
        data["cost_target"] = torch.zeros(4, 6, dtype=torch.float64)
        with pytest.raises(ValueError, match=r"'cost_target' must be samples .* \(4, 6\)"):
            loss(data)
        data["cost_target"] = torch.zeros(4, 6, 3, dtype=torch.float64)
        data["target_weight"] = torch.zeros(4, 6, 1, dtype=torch.float64)
        with pytest.raises(ValueError, match=r"'target_weight' must have shape \(4, 6, 3\)"):
            loss(data)

    @pytest.mark.parametrize("estimator", ["td1", "tdlambda", "retrace"])
    def test_learns_the_distribution_of_a_known_chain(self, estimator):
        """Each step costs an exponential draw, and with a chance of .4 the episode ends.

        The quantiles are those of 200,000 simulated sums; the tail is far from a Gaussian's.
        """
        gamma, ends, num = 0.9, 0.4, 8
        rng = np.random.default_rng(0)
        alive, sums, discount = np.ones(200_000, bool), np.zeros(200_000), 1.0
        for _ in range(60):
            sums += discount * alive * rng.exponential(0.5, 200_000)
            alive &= rng.random(200_000) >= ends
            discount *= gamma
        exact = torch.tensor(np.quantile(sums, (np.arange(num) + 0.5) / num))

        torch.manual_seed(0)
        critic = constant_critic(torch.linspace(0, 1, num))
        loss = make_loss(gamma=gamma, critic=critic, estimator=estimator, num_samples=2)
        optim = torch.optim.Adam(loss.cost_network_params.parameters(), lr=0.2)
        data = make_data((128, 8))
        for step in range(200):
            optim.param_groups[0]["lr"] = 0.2 * 0.98**step
            with torch.no_grad():
                loss.actor_network(data)
            data["next", "cost"] = torch.empty(128, 8, 1).exponential_(2.0).double()
            terminated = torch.rand(128, 8, 1) < ends
            data["next", "terminated"] = data["next", "done"] = terminated
            optim.zero_grad()
            loss(data)["loss_cost_quantiles"].backward()
            optim.step()
        learned = critic.module.values.detach().sort().values
        assert (learned - exact).abs().max() < 0.1
        assert quantile_cvar(learned, 0.25).item() == pytest.approx(
            exact[-2:].mean().item(), rel=0.03
        )

    def test_gradient_isolation(self):
        loss = make_loss()
        loss(make_data())["loss_cost_quantiles"].backward()
        touched = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None}
        assert touched == {"cost_network_params"}

    def test_reduction_none(self):
        out = make_loss(reduction="none")(make_data())
        assert out["loss_cost_quantiles"].shape == out["cost_std"].shape == (4, 6)

    @pytest.mark.parametrize("use", ["auto", True, False])
    def test_priority_weights(self, use):
        loss, data = make_loss(use_prioritized_weights=use), make_data()
        data["cost_target"], _ = loss.compute_target(data)
        data = data.flatten()
        weight = torch.rand(24, dtype=torch.float64)
        data["priority_weight"] = weight
        each = torch.stack([loss(data[i : i + 1])["loss_cost_quantiles"] for i in range(24)])
        expected = each.mean() if use is False else (weight * each).sum() / weight.sum()
        torch.testing.assert_close(loss(data)["loss_cost_quantiles"], expected)

    def test_target_networks(self):
        loss, data = make_loss(delay_cost=True), make_data()
        updater = SoftUpdate(loss, eps=0.5)
        torch.manual_seed(7)
        before, _ = loss.compute_target(data)
        with torch.no_grad():
            for p in loss.cost_network_params.parameters():
                p.add_(0.1)
        torch.manual_seed(7)
        torch.testing.assert_close(loss.compute_target(data)[0], before)
        updater.step()
        torch.manual_seed(7)
        assert not torch.allclose(loss.compute_target(data)[0], before)

    def test_vmap_and_loop_agree(self):
        loss, looped = make_loss(num_cost_nets=2), make_loss(num_cost_nets=2, deactivate_vmap=True)
        looped.load_state_dict(loss.state_dict())
        outs = []
        for module in (loss, looped):
            torch.manual_seed(2)
            outs.append(module(make_data()))
        torch.testing.assert_close(*outs)

    def test_dispatch_and_keys(self):
        loss, data = make_loss(), make_data()
        torch.manual_seed(7)
        expected = loss(data)
        loss.set_keys(cost=("agents", "price"))
        data["next", "agents", "price"] = data["next"].pop("cost")
        torch.manual_seed(7)
        torch.testing.assert_close(loss(data), expected)
        torch.manual_seed(7)
        kwargs = {key.replace(".", "_"): value for key, value in data.flatten_keys(".").items()}
        loss.select_out_keys("loss_cost_quantiles")
        kwargs.pop("action_log_prob")
        torch.testing.assert_close(loss(**kwargs), expected["loss_cost_quantiles"])

    def test_what_was_given_is_kept(self):
        critics = [make_critic() for _ in range(2)]
        data = make_data()
        expected = [net(data.clone())["cost_quantiles"].sort(-1).values for net in critics]
        alone = QuantileCostLoss(make_actor(), critics[0], cost_limit=1.0)
        torch.testing.assert_close(alone.quantiles(data, data["action"]), expected[0])
        both = QuantileCostLoss(make_actor(), critics, cost_limit=1.0, num_cost_nets=2)
        torch.testing.assert_close(
            both.quantiles(data, data["action"]), torch.stack(expected).mean(0)
        )

    def test_state_dict(self):
        loss, other = make_loss(risk_level=0.5), make_loss(cost_limit=1.0)
        other.load_state_dict(deepcopy(loss.state_dict()))
        assert (other.cost_limit, other.risk_level) == (2.5, 0.5)


class TestRisk:
    @pytest.mark.parametrize("risk_level", [0.125, 0.3, 1.0])
    def test_cvar(self, risk_level):
        loss, data = make_loss(risk_level=risk_level), make_data()
        quantiles = predictions(loss, data, data["action"])[0]
        worst = quantile_cvar(quantiles, risk_level)
        torch.testing.assert_close(loss.cvar(data, data["action"]), worst)
        mean, std = loss.predict(data, data["action"])
        torch.testing.assert_close(mean, quantiles.mean(-1))
        torch.testing.assert_close(std, quantiles.std(-1, unbiased=False))
        if risk_level == 1:
            torch.testing.assert_close(worst, mean)

    def test_another_spectrum(self):
        loss, data = make_loss(distortion=torch.square), make_data()
        quantiles = predictions(loss, data, data["action"])[0]
        expected = spectral_risk(quantiles, spectral_weights(N, torch.square))
        torch.testing.assert_close(loss.cvar(data, data["action"]), expected)

    def test_pessimism(self):
        loss, data = make_loss(num_cost_nets=3, pessimism=1.5), make_data()
        risk = quantile_cvar(predictions(loss, data, data["action"]), 0.125)
        expected = risk.mean(0) + 1.5 * risk.std(0, unbiased=False)
        torch.testing.assert_close(loss.cvar(data, data["action"]), expected)

    def test_networks_that_agree_have_a_gradient(self):
        critics = [constant_critic(torch.ones(4)) for _ in range(2)]
        loss = make_loss(critic=critics, num_cost_nets=2, pessimism=1.0)
        data = make_data()
        action = data["action"].requires_grad_()
        value = loss.cvar(data, action) + loss.predict(data, action)[1] + action.sum(-1)
        value.sum().backward()
        assert action.grad.isfinite().all()

    def test_gradient_reaches_the_policy_alone(self):
        loss, data = make_loss(), make_data()
        action = loss.actor_network.get_dist(data).rsample()
        measured = loss.measure(data, action.detach())
        loss.constraint(data, action, measured).backward()
        touched = {name.split(".")[0] for name, p in loss.named_parameters() if p.grad is not None}
        assert touched == {"actor_network_params"}


class TestLevel:
    @pytest.mark.parametrize("num_cost_nets", [1, 2])
    def test_measured_mean_and_the_critics_tail(self, num_cost_nets):
        loss, data = make_loss(num_cost_nets=num_cost_nets, risk_level=0.5), make_data()
        data["next", "terminated"].zero_()
        quantiles = predictions(loss, data, data["action"])
        excess = (quantile_cvar(quantiles, 0.5) - quantiles.mean(-1)).mean()
        expected = data["next", "cost"].mean() * 10 + excess.detach()
        close(loss.on_policy_cvar(data), expected)
        measured = loss.measure(data, data["action"])
        assert isinstance(measured, MeasuredCVaR)
        close(loss.constraint(data, data["action"], measured), expected - 2.5)

    def test_measured_mean_where_episodes_end(self):
        loss, data = make_loss(risk_level=1.0, critic=constant_critic([1.0, 3.0])), make_data()
        expected = visited_value_estimate(
            0.9,
            *(data["next", key] for key in ("cost", "done", "terminated")),
            next_value=torch.full((4, 6, 1), 2.0).double(),
        )
        close(loss.on_policy_cvar(data), expected)

    def test_realised_against_brute_force(self):
        """Step by step and draw by draw."""
        loss = make_loss(level="realised", num_samples=N, risk_level=0.25)
        for p in loss.cost_network_params.parameters():
            if p.shape[-1] == OBS + ACT:
                p.data[..., OBS:] = 0
        data = make_data()
        samples, _ = loss.compute_target(data)
        quantiles = predictions(loss, data, data["action"])[0]
        total = 0.0
        for b in range(4):
            for t in range(6):
                # 2 of 8: the value at risk lies between the second and the third largest.
                threshold = quantiles[b, t, 5:7].mean().item()
                excess = [max(z - threshold, 0) for z in samples[b, t].tolist()]
                total += threshold + sum(excess) / N / 0.25
        assert loss.on_policy_cvar(data).item() == pytest.approx(total / 24, rel=1e-5)
        assert loss.measure(data, data["action"]).level.item() == pytest.approx(total / 24)

    @pytest.mark.parametrize("level", ["mean", "realised"])
    @pytest.mark.parametrize("right", [True, False])
    def test_what_a_wrong_critic_does_to_the_level(self, level, right):
        """Costs of episodes that end at each step with a chance of .1, against their exact CVaR.

        A critic that is half of the truth halves the tail that it is asked for; what is realised
        shows the cost all the same.
        """
        gamma, ends, alpha, num = 0.9, 0.1, 0.25, 32
        # One cost per step until the end: the sum after k steps is (1 - gamma^k) / (1 - gamma).
        k = np.arange(1, 400)
        chance = ends * (1 - ends) ** (k - 1)
        sums = (1 - gamma**k) / (1 - gamma)
        levels = (np.arange(num) + 0.5) / num
        exact_quantiles = sums[np.searchsorted(chance.cumsum(), levels)]
        left, cvar = alpha, 0.0
        for value, share in zip(sums[::-1], chance[::-1], strict=True):
            cvar, left = cvar + value * min(share, left), left - min(share, left)
        cvar /= alpha
        critic = constant_critic(exact_quantiles * (1.0 if right else 0.5))
        loss = make_loss(critic=critic, gamma=gamma, level=level, risk_level=alpha)
        data = make_data((400, 200))
        terminated = torch.rand(400, 200, 1, generator=torch.Generator().manual_seed(0)) < ends
        data["next", "cost"].fill_(1.0)
        data["next", "terminated"] = data["next", "done"] = terminated
        actual = loss.on_policy_cvar(data).item()
        if right:
            assert actual == pytest.approx(cvar, rel=0.02)
        elif level == "mean":
            assert actual < 0.9 * cvar
        else:
            assert actual > 0.99 * cvar

    def test_n_step_transitions(self):
        data = make_data()
        data["steps_to_next_obs"] = torch.full((4, 6, 1), 3)
        for level in ("mean", "realised"):
            with pytest.raises(ValueError, match="'steps_to_next_obs' must be 1 everywhere"):
                make_loss(level=level).on_policy_cvar(data)
        loss = make_loss(num_samples=N)
        policy = evaluate_policy(data, loss.actor_network)
        samples, _ = loss.compute_target(data[:, -1:], policy=PolicyEvaluation(*(
            x[:, -1:] for x in policy)))  # fmt: skip
        following = predictions(loss, data["next"], policy.next_action)[0][:, -1:]
        alive = ~data["next", "terminated"][:, -1:]
        expected = data["next", "cost"][:, -1:] + 0.9**3 * alive * following
        close(samples, expected.detach())

    def test_the_measurement_belongs_to_its_states(self):
        loss, data = make_loss(), make_data()
        states = data[:2]
        measured = loss.measure(data, states["action"], states=states)
        loss.constraint(states, states["action"], measured)
        with pytest.raises(ValueError, match=r"measured must be of the states .* \(4, 6\), got"):
            loss.constraint(data, data["action"], measured)


class TestData:
    def test_padding(self):
        data = make_data((2, 6))
        data["next", "done"].zero_()
        data["next", "terminated"].zero_()
        mask = torch.ones(2, 6, 1, dtype=torch.bool)
        mask[1, 2:] = False
        data["next", "cost"][~mask] = math.nan
        data["collector", "mask"] = mask
        for estimator in ("td1", "retrace"):
            loss = make_loss(estimator=estimator, num_samples=N)
            policy = evaluate_policy(data, loss.actor_network)
            alone = PolicyEvaluation(*(x[1:, :2] for x in policy))
            expected = loss.compute_target(data[1:, :2], policy=alone)
            samples, weights = loss.compute_target(data, policy=policy)
            mean = (samples * weights).sum(-1)[1:, :2]
            close(mean, (expected[0] * expected[1]).sum(-1))
            assert loss(data)["loss_cost_quantiles"].isfinite()
        for level in ("mean", "realised"):
            assert make_loss(level=level).on_policy_cvar(data).isfinite()

    @pytest.mark.parametrize("dtype", [torch.int64, torch.bool])
    def test_costs_that_are_counted(self, dtype):
        loss, data = make_loss(num_samples=N), make_data()
        data["next", "cost"] = (data["next", "cost"] > 0.5).double()
        counted = data.clone()
        counted["next", "cost"] = data["next", "cost"].to(dtype)
        policy = evaluate_policy(data, loss.actor_network)
        expected, _ = loss.compute_target(data, policy=policy)
        actual, _ = loss.compute_target(counted, policy=policy)
        close(actual, expected, check_dtype=False)

    def test_time_first(self):
        data = make_data()
        names = data.clone()
        names.names = [None, "time"]
        turned = names.transpose(0, 1).contiguous()
        for estimator in ("td1", "retrace"):
            loss = make_loss(estimator=estimator, num_samples=N)
            policy = evaluate_policy(data, loss.actor_network)
            there = PolicyEvaluation(*(x.transpose(0, 1) for x in policy))
            expected = loss.compute_target(data, policy=policy)
            actual = loss.compute_target(turned, policy=there)
            for x, y in zip(actual, expected, strict=True):
                close(x, y.transpose(0, 1))

    def test_a_next_state_that_is_missing_at_an_end(self):
        loss, data = make_loss(), make_data()
        data["next", "observation"][data["next", "done"].squeeze(-1)] = math.nan
        assert loss.compute_target(data)[0].isfinite().all()

    @pytest.mark.parametrize("shared_ends", [False, True])
    def test_agents(self, shared_ends):
        """Agents that share a network are as many trajectories of one agent each."""
        agents = 3
        loss, alone = make_loss(num_samples=N), make_data((4, agents, 6))
        for key in ("done", "terminated"):
            if shared_ends:
                alone["next", key] = alone["next", key][:, :1].expand(-1, agents, -1, -1)
        together = TensorDict(alone.transpose(1, 2).to_dict(), [4, 6])
        if shared_ends:
            for key in ("done", "terminated"):
                together["next", key] = together["next", key][:, :, 0]
        policy = evaluate_policy(alone, loss.actor_network)
        there = PolicyEvaluation(*(x.transpose(1, 2) for x in policy))
        expected, _ = loss.compute_target(alone, policy=policy)
        actual, _ = loss.compute_target(together, policy=there)
        close(actual, expected.transpose(1, 2))
        for td in (alone, together):
            td["next", "terminated"].zero_()
        close(loss.on_policy_cvar(together), loss.on_policy_cvar(alone))
        assert loss(together)["loss_cost_quantiles"].isfinite()

    @pytest.mark.parametrize("key", ["action", ("next", "cost"), ("next", "observation"), "next"])
    def test_a_missing_entry_is_named(self, key):
        name = key if isinstance(key, str) else key[-1]
        with pytest.raises(KeyError, match=name):
            make_loss()(make_data().exclude(key))

    def test_retrace_needs_the_density(self):
        data = make_data().exclude("action_log_prob")
        make_loss()(data)
        with pytest.raises(KeyError, match="action_log_prob"):
            make_loss(estimator="retrace")(data)


def rand(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


class TestRecalibration:
    """Networks are judged by steps that they have not learned from."""

    def loss(self):
        critics = [constant_critic([1.0, 3.0]), constant_critic([2.0, 6.0])]
        return make_loss(critic=critics, num_cost_nets=2, risk_level=0.5)

    def data(self, learned_by, sums):
        size = len(sums)
        data = TensorDict(
            observation=rand(size, OBS), action=rand(size, ACT).tanh(), batch_size=[size]
        )
        data["cost_target"] = torch.tensor(sums, dtype=torch.float64).unsqueeze(-1)
        data["learned_by"] = torch.tensor(learned_by)
        return data

    def test_those_that_have_not_learned_are_asked(self):
        loss = self.loss()
        data = self.data([[False, True]] * 4, [0.0, 8.0, 0.0, 8.0])
        report = loss.recalibrate(data)
        assert report["predicted_mean"] == 2.0  # of the first network
        assert report["predicted_risk"] == 3.0
        assert report["realised_mean"] == 4.0
        assert report["realised_risk"] == 8.0  # 2 + (8 - 2) / 2 / .5
        torch.testing.assert_close(loss.scales, torch.tensor([2.0, 4.0]), rtol=1e-5, atol=0)
        # What is predicted, by both: mean 3, quantiles 1.5 and 4.5.
        mean, _ = loss.predict(data, data["action"])
        close(mean, torch.full((4,), 6.0).double())
        close(loss.cvar(data, data["action"]), torch.full((4,), 12.0).double(), rtol=1e-5, atol=0)
        again = loss.recalibrate(data)
        assert again["predicted_risk"] == pytest.approx(again["realised_risk"].item(), rel=1e-5)

    def test_stretch(self):
        """A critic of means 1 and 3 where they are 1 and 9: of the centre 2 they stand apart."""
        critic = ValueOperator(
            Spread(), in_keys=["observation", "action"], out_keys=["cost_quantiles"]
        )
        loss = make_loss(critic=critic, risk_level=1.0)
        data = self.data([[False]] * 2, [1.0, 9.0])
        data["observation"] = torch.tensor([[1.0], [3.0]]).expand(2, OBS).double()
        loss.recalibrate(data)
        assert loss.stretch.tolist() == [0.0, 1.0]  # not unasked
        loss.recalibrate(data, stretch=True)
        slope, centre = loss.stretch.tolist()
        assert (slope, centre) == (pytest.approx(1.0, abs=1e-3), 2.0)
        mean, _ = loss.predict(data, data["action"])
        close(mean, torch.tensor([1.0, 9.0]).double(), rtol=1e-2, atol=0)
        close(loss.cvar(data, data["action"]), mean)
        other = make_loss(critic=critic, risk_level=1.0)
        other.load_state_dict(loss.state_dict())
        assert other.stretch.equal(loss.stretch)

    def test_moves_by_its_rate(self):
        loss = self.loss()
        loss.recalibrate(self.data([[False, True]] * 2, [0.0, 8.0]), rate=0.25)
        torch.testing.assert_close(loss.scales, torch.tensor([1.25, 1.75]), rtol=1e-5, atol=0)
        other = self.loss()
        other.load_state_dict(loss.state_dict())
        assert other.scales.equal(loss.scales)

    def test_what_is_not_finite_changes_nothing(self):
        loss = self.loss()
        report = loss.recalibrate(self.data([[False, True]] * 2, [0.0, math.nan]))
        assert report["realised_risk"].isnan()
        assert loss.scales.tolist() == [1.0, 1.0]

    def test_nobody_is_asked(self):
        loss = self.loss()
        assert loss.recalibrate(self.data([[True, True]] * 2, [0.0, 8.0])).is_empty()
        assert loss.scales.tolist() == [1.0, 1.0]

    def test_a_network_learns_only_from_its_steps(self):
        loss = self.loss()
        data = self.data([[False, True], [True, True]], [100.0, 2.5])
        loss(data)["loss_cost_quantiles"].backward()
        (gradient,) = (params.grad for params in loss.cost_network_params.parameters())
        # (1[z < q] - level) of quantiles at 1/4 and 3/4, mean over quantiles and steps
        first, second = [-0.25, 0.25], [-0.25 - 0.25, -0.75 + 0.25]
        close(gradient, torch.tensor([first, second]).double() / 4)
        data["learned_by"] = torch.tensor([[False, False], [False, False]])
        assert loss(data)["loss_cost_quantiles"] == 0

    @pytest.mark.parametrize("rate", [0.0, 1.5, math.nan])
    def test_rate(self, rate):
        with pytest.raises(ValueError, match="rate must be"):
            self.loss().recalibrate(self.data([[False, True]], [1.0]), rate=rate)

    def test_entries(self):
        loss = self.loss()
        data = self.data([[False, True]], [1.0])
        with pytest.raises(KeyError, match="learned_by"):
            loss.recalibrate(data.exclude("learned_by"))
        with pytest.raises(KeyError, match="cost_target"):
            loss.recalibrate(data.exclude("cost_target"))
        data["learned_by"] = torch.ones(1, 3, dtype=torch.bool)
        with pytest.raises(ValueError, match=r"'learned_by' must have shape \(1, 2\)"):
            loss.recalibrate(data)
        assert loss.scales.tolist() == [1.0, 1.0]


class TestMisuse:
    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("cost_limit", -1.0),
            ("cost_limit", math.nan),
            ("risk_level", 0.0),
            ("risk_level", 1.5),
            ("num_cost_nets", 0),
            ("num_samples", 0),
            ("kappa", -1.0),
            ("pessimism", -1.0),
            ("pessimism", 1.0),
            ("level", "median"),
            ("reduction", "median"),
            ("distortion", torch.sqrt),
        ],
    )
    def test_arguments(self, name, value):
        with pytest.raises(ValueError, match=name):
            make_loss(**{name: value})

    def test_limit_and_level_when_they_are_set(self):
        loss = make_loss(cost_limit=1.0, risk_level=0.5)
        with pytest.raises(ValueError, match="cost_limit must be a finite number"):
            loss.cost_limit = -1.0
        with pytest.raises(ValueError, match=r"risk_level must be in \(0, 1\]"):
            loss.risk_level = 2.0
        assert (loss.cost_limit, loss.risk_level) == (1.0, 0.5)


def test_it_takes_the_place_of_the_gaussian_loss():
    """Same calls, same kinds of results."""
    data = make_data()

    def critic(key, *last):
        net = MLP(OBS + ACT, 1, num_cells=[16]).extend(last)
        return ValueOperator(net, in_keys=["observation", "action"], out_keys=[key]).double()

    gaussian = CVaRCostLoss(
        make_actor(), critic("cost_value"), critic("cost_std", nn.Softplus()), cost_limit=2.5
    )
    gaussian.make_value_estimator(gamma=0.9)
    for loss in (gaussian, make_loss()):
        policy = evaluate_policy(data, loss.actor_network)
        assert len(loss.compute_target(data, policy=policy)) == 2
        assert {"cost_value", "cost_std"} <= set(loss(data).keys())
        assert [x.shape for x in loss.predict(data, data["action"])] == [(4, 6)] * 2
        assert loss.cvar(data, data["action"]).shape == (4, 6)
        measured = loss.measure(data, data["action"], states=data)
        assert loss.constraint(data, data["action"], measured).shape == ()
        assert loss.on_policy_cvar(data).shape == ()
