"""Targets of a whole distribution against chains whose return distribution is enumerated."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from torchrl_safe.objectives.value import (
    distributional_retrace_estimate,
    sampled_lambda_return_estimate,
    trace_lambda_return_estimate,
)

GAMMA = 0.9


class Tree:
    """Two states and two actions for three steps, then the episode terminates.

    Its probabilities are fourths, so that a return's distribution is a list of equally likely
    values: ``atoms(t, s, a)``.
    """

    depth = 3
    pi = np.array([[1, 3], [2, 2]]) / 4  # [state, action]
    mu = np.array([[3, 1], [1, 3]]) / 4
    move = np.array([[[2, 2], [1, 3]], [[4, 0], [3, 1]]]) / 4  # [state, action, next state]
    cost = np.array([[0.0, 1.0], [0.3, 2.0]])

    def distribution(self, t, s, a):
        """Values and probabilities of the return, by recursion over everything that can happen."""
        if t == self.depth - 1:
            return {self.cost[s, a]: 1.0}
        out = {}
        for ss, aa in itertools.product(range(2), range(2)):
            chance = self.move[s, a, ss] * self.pi[ss, aa]
            if chance:
                for value, p in self.distribution(t + 1, ss, aa).items():
                    total = round(self.cost[s, a] + GAMMA * value, 10)
                    out[total] = out.get(total, 0) + chance * p
        return out

    def next_distribution(self, t, s):
        """The same at a state, for an action of pi."""
        out = {}
        for a in range(2):
            for value, p in self.distribution(t, s, a).items():
                out[value] = out.get(value, 0) + self.pi[s, a] * p
        return out

    def trajectories(self, s, a, policy):
        """Every way from a state and an action to the end, with its probability."""
        paths = [(1.0, [(s, a)])]
        for _ in range(self.depth - 1):
            paths = [
                (p * self.move[path[-1]][ss] * policy[ss, aa], [*path, (ss, aa)])
                for p, path in paths
                for ss, aa in itertools.product(range(2), range(2))
            ]
        return [path for path in paths if path[0] > 0]


def listed(distribution, count=16**2):
    """A distribution as equally likely values; 1 / count divides its probabilities."""
    values, repeats = zip(*distribution.items(), strict=True)
    repeats = np.array(repeats) * count
    np.testing.assert_allclose(repeats, repeats.round(), atol=1e-6)
    return torch.tensor(np.repeat(values, repeats.round().astype(int)), dtype=torch.float64)


def measure(values, weights):
    """Weight of every value."""
    out = {}
    for value, weight in zip(values.flatten().tolist(), weights.flatten().tolist(), strict=True):
        out[round(value, 6)] = out.get(round(value, 6), 0) + weight
    return {value: weight for value, weight in out.items() if abs(weight) > 1e-9}


def assert_same(measured, distribution):
    expected = measure(
        torch.tensor(list(distribution), dtype=torch.float64),
        torch.tensor(list(distribution.values())),
    )
    assert measured.keys() == expected.keys()
    for value, weight in expected.items():
        assert measured[value] == pytest.approx(weight, abs=1e-9)


def batch(tree, paths):
    """Costs, next states and ends of whole episodes."""
    steps = np.array([path for _, path in paths])  # [B, T, 2]
    cost = torch.tensor(tree.cost[steps[..., 0], steps[..., 1]])[..., None]
    terminated = torch.zeros(*steps.shape[:2], 1, dtype=torch.bool)
    terminated[:, -1] = True
    return steps, cost, terminated


def log_prob(policy, steps):
    return torch.tensor(policy[steps[..., 0], steps[..., 1]]).log()[..., None]


class TestOnPolicy:
    @pytest.mark.parametrize("cut", [None, 0, 1])
    def test_sums_have_the_exact_distribution(self, cut):
        """Over all trajectories; truncated anywhere, what follows is drawn from what is right."""
        tree = Tree()
        paths = tree.trajectories(0, 1, tree.pi)
        steps, cost, terminated = batch(tree, paths)
        done = terminated.clone()
        next_samples = torch.full((*cost.shape[:2], 16**2), torch.nan, dtype=torch.float64)
        if cut is not None:
            done[:, cut] = True
            for row, (_, path) in enumerate(paths):
                next_samples[row, cut] = listed(tree.next_distribution(cut + 1, path[cut + 1][0]))
        samples = sampled_lambda_return_estimate(GAMMA, 1.0, next_samples, cost, done, terminated)[
            :, 0
        ]
        chance = torch.tensor([p for p, _ in paths])[:, None].expand(samples.shape)
        actual = measure(samples, chance / samples.shape[-1])
        assert_same(actual, tree.distribution(0, 0, 1))
        assert len(steps) == len(paths) > 10

    def test_termination_asks_no_critic_and_truncation_reads_no_other_trajectory(self):
        cost = torch.tensor([1.0, 2.0, 3.0, 4.0])[:, None]
        done = torch.tensor([False, True, True, False])[:, None]
        terminated = torch.tensor([False, False, True, False])[:, None]
        next_samples = torch.full((4, 2), torch.nan)
        next_samples[1] = torch.tensor([10.0, 20.0])
        next_samples[3] = torch.tensor([0.0, 2.0])
        actual = sampled_lambda_return_estimate(0.5, 1.0, next_samples, cost, done, terminated)
        expected = torch.tensor([[4.5, 7.0], [7.0, 12.0], [3.0, 3.0], [4.0, 5.0]])
        torch.testing.assert_close(actual, expected)

    @pytest.mark.parametrize("lmbda", [0.0, 0.3, 0.9])
    def test_lambda_mixes_n_step_returns(self, lmbda):
        """How often a sample is which n-step return: geometric, the rest at the end."""
        steps, draws = 6, 200_000
        generator = torch.Generator().manual_seed(0)
        cost = torch.zeros(1, steps, 1, dtype=torch.float64)
        # A sum of n steps is the power of two of its own.
        value = 2.0 ** torch.arange(steps).double()[:, None].expand(1, steps, draws)
        done = torch.zeros(1, steps, 1, dtype=torch.bool)
        samples = sampled_lambda_return_estimate(
            1.0, lmbda, value, cost, done, generator=generator
        )[0, 0]
        for n in range(1, steps + 1):
            share = (samples == 2.0 ** (n - 1)).double().mean().item()
            expected = (1 - lmbda) * lmbda ** (n - 1) if n < steps else lmbda ** (n - 1)
            assert share == pytest.approx(expected, abs=0.005)

    def test_mean_is_that_of_q_lambda_where_it_telescopes(self):
        generator = torch.Generator().manual_seed(1)

        def rand(*shape):
            return torch.rand(*shape, generator=generator, dtype=torch.float64)

        cost, value = rand(3, 7, 1), rand(3, 7, 1)
        done = rand(3, 7, 1) < 0.3
        terminated = done & (rand(3, 7, 1) < 0.5)
        value_of_state = torch.cat([torch.zeros(3, 1, 1), value[:, :-1]], 1)
        expected = trace_lambda_return_estimate(
            *(GAMMA, 0.7, None, None, value_of_state, value, cost, done, terminated),
            trace="q_lambda",
        )
        samples = sampled_lambda_return_estimate(
            GAMMA, 0.7, value.expand(3, 7, 100_000), cost, done, terminated, generator=generator
        )
        torch.testing.assert_close(samples.mean(-1, keepdim=True), expected, atol=0.01, rtol=0)

    def test_time_dim_and_discounts_of_steps(self):
        generator = torch.Generator().manual_seed(2)
        cost, value = torch.rand(2, 5, 1, generator=generator), torch.rand(2, 5, 4)
        done = torch.rand(2, 5, 1, generator=generator) < 0.3
        gamma = torch.rand(2, 5, 1, generator=generator)
        expected = sampled_lambda_return_estimate(gamma, 1.0, value, cost, done)
        actual = sampled_lambda_return_estimate(
            *(gamma.transpose(0, 1), 1.0),
            *(x.transpose(0, 1) for x in (value, cost, done)),
            time_dim=0,
        )
        torch.testing.assert_close(actual.transpose(0, 1), expected)
        loop = torch.zeros(2, 4)
        for t in reversed(range(5)):
            following = torch.where(done[:, t], 0.0, value[:, t] if t == 4 else loop)
            loop = cost[:, t] + gamma[:, t] * following
            torch.testing.assert_close(loop, expected[:, t])

    def test_costs_that_are_counted(self):
        cost, done = torch.ones(3, 1, dtype=torch.int64), torch.zeros(3, 1, dtype=torch.bool)
        actual = sampled_lambda_return_estimate(0.5, 1.0, torch.zeros(3, 2), cost, done)
        torch.testing.assert_close(actual[:, 0], torch.tensor([1.75, 1.5, 1.0]))


class TestOffPolicy:
    @pytest.mark.parametrize("lmbda", [0.0, 0.5, 1.0])
    @pytest.mark.parametrize("cut", [None, 1])
    @pytest.mark.parametrize("start", [(0, 1), (1, 0)])
    def test_the_distribution_of_the_policy_is_the_fixed_point(self, lmbda, cut, start):
        """From trajectories of mu, all of them: not in each one, but in their average, exactly."""
        tree = Tree()
        paths = tree.trajectories(*start, tree.mu)
        steps, cost, terminated = batch(tree, paths)
        done = terminated.clone()
        count = 16**2
        samples = torch.zeros(*cost.shape[:2], count, dtype=torch.float64)
        next_samples = torch.full_like(samples, torch.nan)
        for row, (_, path) in enumerate(paths):
            for t, (s, a) in enumerate(path):
                samples[row, t] = listed(tree.distribution(t, s, a), count)
                if t + 1 < tree.depth:
                    following = tree.next_distribution(t + 1, path[t + 1][0])
                    next_samples[row, t] = listed(following, count)
        if cut is not None:
            done[:, cut] = True
        values, weights = distributional_retrace_estimate(
            GAMMA,
            lmbda,
            log_prob(tree.pi, steps),
            log_prob(tree.mu, steps),
            samples,
            next_samples,
            cost,
            done,
            terminated,
        )
        torch.testing.assert_close(weights.sum(-1), torch.ones_like(weights[..., 0]))
        chance = torch.tensor([p for p, _ in paths])[:, None]
        actual = measure(values[:, 0], chance * weights[:, 0])
        assert_same(actual, tree.distribution(0, *start))

    def test_weights_are_signed_where_policies_differ(self):
        tree = Tree()
        steps, cost, terminated = batch(tree, tree.trajectories(0, 0, tree.mu))
        zeros = torch.zeros_like(cost)
        _, weights = distributional_retrace_estimate(
            GAMMA, 1.0, log_prob(tree.pi, steps), log_prob(tree.mu, steps), zeros, zeros, cost,
            terminated,
        )  # fmt: skip
        assert (weights < 0).any()

    @pytest.mark.parametrize("time_dim", [1, 0])
    def test_against_retrace_and_a_double_loop(self, time_dim):
        generator = torch.Generator().manual_seed(3)

        def rand(*shape):
            return torch.rand(*shape, generator=generator, dtype=torch.float64)

        rows, steps, draws, lmbda = 3, 6, 2, 0.8
        cost, log_pi, log_mu, gamma = (rand(rows, steps, 1) for _ in range(4))
        y, z = rand(rows, steps, draws), rand(rows, steps, draws)
        done = rand(rows, steps, 1) < 0.3
        terminated = done & (rand(rows, steps, 1) < 0.5)
        z[terminated.expand_as(z)] = torch.nan
        tensors = [log_pi, log_mu, y, z, cost, done, terminated]
        turned = [x.movedim(1, time_dim) for x in tensors]
        values, weights = (
            x.movedim(time_dim, 1)
            for x in distributional_retrace_estimate(
                gamma.movedim(1, time_dim), lmbda, *turned, time_dim=time_dim
            )
        )
        mean = (values * weights).sum(-1, keepdim=True)
        expected = trace_lambda_return_estimate(
            gamma,
            lmbda,
            log_pi,
            log_mu,
            y.mean(-1, keepdim=True),
            z.mean(-1, keepdim=True),
            *tensors[-3:],
        )
        torch.testing.assert_close(mean, expected)
        for b, t in itertools.product(range(rows), range(steps)):
            loop, trace, paid, discount = {}, 1.0, 0.0, 1.0
            for n in range(t, steps):
                paid = paid + discount * cost[b, n, 0].item()
                discount = discount * gamma[b, n, 0].item()
                for k in range(draws):
                    follows = 0.0 if terminated[b, n] else z[b, n, k].item()
                    key = round(paid + discount * follows, 6)
                    loop[key] = loop.get(key, 0) + trace / draws
                if done[b, n] or n + 1 == steps:
                    break
                trace = trace * lmbda * min(1.0, (log_pi - log_mu)[b, n + 1, 0].exp().item())
                for k in range(draws):
                    key = round(paid + discount * y[b, n + 1, k].item(), 6)
                    loop[key] = loop.get(key, 0) - trace / draws
            actual = measure(values[b, t], weights[b, t])
            assert actual.keys() == {key for key, weight in loop.items() if abs(weight) > 1e-9}
            for key, weight in actual.items():
                assert weight == pytest.approx(loop[key], abs=1e-9)

    def test_nothing_is_read_across_an_end(self):
        """Padding behind a terminated trajectory may be NaN."""
        zeros = torch.zeros(1, 3, 1)
        nan = zeros.clone()
        nan[:, 2] = torch.nan
        done = torch.tensor([[[False], [True], [True]]])
        values, weights = distributional_retrace_estimate(
            0.9, 1.0, nan, nan, nan, nan, 1 + nan, done
        )
        mean = (values * weights).sum(-1)[0, :2]
        torch.testing.assert_close(mean, torch.tensor([1.9, 1.0]))


class TestMisuse:
    @pytest.mark.parametrize("lmbda", [-0.1, 1.5])
    def test_lmbda(self, lmbda):
        zeros, done = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        with pytest.raises(ValueError, match=r"lmbda must be in \[0, 1\], got"):
            sampled_lambda_return_estimate(0.9, lmbda, zeros, zeros, done)
        with pytest.raises(ValueError, match=r"lmbda must be in \[0, 1\], got"):
            distributional_retrace_estimate(0.9, lmbda, zeros, zeros, zeros, zeros, zeros, done)

    def test_shapes_and_types(self):
        zeros, done = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        with pytest.raises(ValueError, match=r"reward must have shape \(2, 1\), .* got \(2, 4\)"):
            sampled_lambda_return_estimate(0.9, 1.0, torch.zeros(2, 4), torch.zeros(2, 4), done)
        with pytest.raises(TypeError, match="done must be boolean"):
            sampled_lambda_return_estimate(0.9, 1.0, zeros, zeros, zeros)
        with pytest.raises(ValueError, match="time_dim must be a dimension of next_samples"):
            sampled_lambda_return_estimate(0.9, 1.0, zeros, zeros, done, time_dim=-1)
        with pytest.raises(ValueError, match=r"next_samples must have shape \(2, 3\), that of s"):
            distributional_retrace_estimate(
                0.9, 1.0, zeros, zeros, torch.zeros(2, 3), zeros, zeros, done
            )
