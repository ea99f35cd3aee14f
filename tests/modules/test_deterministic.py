"""The deterministic policy with noise, and the distribution of what it does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import integrate, stats
from tensordict import TensorDict
from torch import nn
from torchrl.data import Bounded
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import ValueOperator
from torchrl.objectives import TD3Loss

from torchrl_safe.modules import ClippedGaussian, DeterministicPolicy, export_policy

LOW, HIGH = -1.0, 2.0


def make(loc, scale=0.7):
    loc = torch.tensor([loc], dtype=torch.float64)
    return ClippedGaussian(loc, torch.tensor(scale), torch.tensor(LOW), torch.tensor(HIGH))


class TestClippedGaussian:
    @pytest.mark.parametrize("loc", [-1.0, -0.3, 0.5, 1.9])
    def test_is_all_of_the_probability(self, loc):
        """By quadrature inside, and scipy's tails on the bounds."""
        dist = make(loc)

        def probability(value):
            return dist.log_prob(torch.tensor([value], dtype=torch.float64)).exp().item()

        inside, _ = integrate.quad(probability, LOW + 1e-9, HIGH - 1e-9)
        gaussian = stats.norm(loc, 0.7)
        assert probability(LOW) == pytest.approx(gaussian.cdf(LOW), rel=1e-6)
        assert probability(HIGH) == pytest.approx(gaussian.sf(HIGH), rel=1e-6)
        assert inside + probability(LOW) + probability(HIGH) == pytest.approx(1, abs=1e-6)

    def test_draws_are_distributed_like_this(self):
        torch.manual_seed(0)
        draws = make(0.5).sample((100_000,)).squeeze(-1).numpy()
        gaussian = stats.norm(0.5, 0.7)
        for bound, share in ((LOW, gaussian.cdf(LOW)), (HIGH, gaussian.sf(HIGH))):
            assert (draws == bound).mean() == pytest.approx(share, abs=0.003)
        inside = draws[(draws > LOW) & (draws < HIGH)]
        cut = stats.truncnorm((LOW - 0.5) / 0.7, (HIGH - 0.5) / 0.7, 0.5, 0.7)
        assert stats.kstest(inside, cut.cdf).pvalue > 0.01

    def test_dimensions_are_independent(self):
        loc, value = torch.tensor([[0.0, 1.0], [0.5, -0.5]]), torch.tensor([[0.1, 1.0], [2.0, 0.0]])
        scale, low, high = torch.tensor([0.1, 0.4]), -torch.ones(2), torch.ones(2)
        together = ClippedGaussian(loc, scale, low, high).log_prob(value)
        alone = [
            ClippedGaussian(loc[:, i, None], scale[i], low[i], high[i]).log_prob(value[:, i, None])
            for i in range(2)
        ]
        torch.testing.assert_close(together, sum(alone))
        assert together.shape == (2,)

    def test_gradient_of_draws(self):
        loc = torch.zeros(1000, 1, requires_grad=True)
        draws = ClippedGaussian(loc, torch.ones(()), -torch.ones(()), torch.ones(())).rsample()
        draws.sum().backward()
        assert torch.equal(loc.grad.squeeze(-1), (draws.abs() < 1).float().squeeze(-1))


class TestDeterministicPolicy:
    spec = Bounded(torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 10.0]))

    def make(self, **how):
        torch.manual_seed(0)
        return DeterministicPolicy(nn.Linear(3, 2), self.spec, **how)

    def test_action_fills_the_bounds(self):
        policy = self.make()
        states = TensorDict(observation=1e3 * torch.randn(500, 3), batch_size=500)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = policy(states.clone())["action"]
        low, high = action.min(0).values, action.max(0).values
        torch.testing.assert_close(low, self.spec.space.low)
        torch.testing.assert_close(high, self.spec.space.high)

    def test_noise_is_a_share_of_half_the_range(self):
        states = TensorDict(observation=torch.zeros(20_000, 3), batch_size=20_000)
        policy = self.make(noise=0.05)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            td = policy(states)
            log_prob = policy.get_dist(td).log_prob(td["action"])
        assert np.allclose(td["action"].std(0).numpy(), [0.05, 0.25], rtol=0.03)
        torch.testing.assert_close(td["action_log_prob"], log_prob)
        assert sorted(td.keys()) == ["action", "action_log_prob", "observation"]

    def test_td3_sees_no_noise(self):
        """The gradient of TorchRL's loss is that of a critic at the deterministic action."""
        policy = self.make(noise=0.5)
        critic = ValueOperator(
            nn.Bilinear(3, 2, 1),
            in_keys=["observation", "action"],
            out_keys=["state_action_value"],
        )
        loss = TD3Loss(
            policy, critic, action_spec=self.spec, num_qvalue_nets=1, deactivate_vmap=True
        )
        states = TensorDict(observation=torch.randn(10, 3), batch_size=10)
        loss.actor_loss(states)[0].backward()
        found = [p.grad.clone() for p in policy.parameters()]
        policy.zero_grad()
        weights = (p.detach().squeeze(0) for p in loss.qvalue_network_params.parameters())
        bias, weight = sorted(weights, key=lambda w: w.ndim)
        action = policy.get_dist(states).deterministic_sample
        value = nn.functional.bilinear(states["observation"], action, weight, bias)
        (-value.mean()).backward()
        for param, grad in zip(policy.parameters(), found, strict=True):
            torch.testing.assert_close(param.grad, grad)

    def test_is_exported(self, tmp_path):
        policy = self.make()
        example = TensorDict(observation=torch.randn(4, 3), batch_size=4)
        path = export_policy(policy, tmp_path / "policy.pt2", example)
        act = torch.export.load(path).module()
        expected = policy.get_dist(example).deterministic_sample
        torch.testing.assert_close(act(example["observation"]), expected)

    def test_rejects(self):
        with pytest.raises(ValueError, match="noise must be a positive finite number, got 0"):
            self.make(noise=0.0)
        with pytest.raises(TypeError, match="action_spec must be a Bounded spec"):
            DeterministicPolicy(nn.Linear(3, 2), None)
