"""Properties that hold for all arguments, tried on many (hypothesis)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from scipy.stats import kstwobign, norm

from torchrl_safe.envs import GoalTask, NavigationTask, SafeGoalEnv, get_robot
from torchrl_safe.modules import TanhGaussianMixture
from torchrl_safe.objectives.functional import cvar_factor, gaussian_cvar, q_logarithm
from torchrl_safe.objectives.value import trace_lambda_return_estimate

settings.register_profile(
    "reproducible",
    derandomize=True,
    deadline=None,
    max_examples=60,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("reproducible")


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


SEEDS = st.integers(0, 2**31 - 1)


class TestMixture:
    """Against a distribution function built from scipy's, in one dimension."""

    @staticmethod
    def make(seed: int, components: int, low: float, width: float, relaxation: str):
        generator = torch.Generator().manual_seed(seed)
        logits = torch.randn(components, generator=generator, dtype=torch.float64)
        loc = torch.randn(components, 1, generator=generator, dtype=torch.float64)
        scale = torch.rand(components, 1, generator=generator, dtype=torch.float64) + 0.1
        dist = TanhGaussianMixture(
            logits, loc, scale, low=low, high=low + width, relaxation=relaxation
        )
        weights = torch.softmax(logits, -1).numpy()

        def cdf(action: np.ndarray) -> np.ndarray:
            unit = np.clip(2 * (action - low) / width - 1, -1, 1)
            with np.errstate(divide="ignore"):
                latent = np.arctanh(unit)
            z = (latent[:, None] - loc[:, 0].numpy()) / scale[:, 0].numpy()
            return norm.cdf(z) @ weights

        return dist, cdf

    @given(SEEDS, st.integers(1, 5), numbers(-5, 5), numbers(0.1, 10))
    def test_density_integrates_to_the_distribution_function(self, seed, k, low, width):
        dist, cdf = self.make(seed, k, low, width, "implicit")
        # Points dense where tanh squeezes the density; the trapezoidal rule between them.
        latent = torch.linspace(-7, 7, 20_001, dtype=torch.float64)
        action = low + width * (latent.tanh() + 1) / 2
        density = dist.log_prob(action[:, None]).exp()
        parts = (density[1:] + density[:-1]) / 2 * action.diff()
        expected = np.diff(cdf(action.numpy()[[0, -1]]))[0]
        assert abs(parts.sum().item() - expected) < 1e-4
        assert expected > 1 - 1e-3
        half = 10_000
        left = np.diff(cdf(action.numpy()[[0, half]]))[0]
        assert abs(parts[:half].sum().item() - left) < 1e-4

    @settings(max_examples=20)
    @given(SEEDS, st.integers(1, 5), numbers(-5, 5), numbers(0.1, 10))
    @pytest.mark.parametrize("draw", ["sample", "implicit", "straight_through"])
    def test_draws_have_the_distribution(self, draw, seed, k, low, width):
        """Kolmogorov and Smirnov, at a level that sixty tests exceed once in a million."""
        relaxation = "gumbel_softmax" if draw == "sample" else draw
        dist, cdf = self.make(seed, k, low, width, relaxation)
        torch.manual_seed(seed)
        count = 2000
        drawn = dist.sample((count,)) if draw == "sample" else dist.rsample((count,))
        values = np.sort(cdf(drawn[:, 0].numpy()))
        steps = np.arange(count + 1) / count
        distance = max(np.abs(values - steps[1:]).max(), np.abs(values - steps[:-1]).max())
        assert distance < kstwobign.isf(1e-8) / math.sqrt(count)


class TestQLogarithm:
    @given(numbers(0.05, 3), numbers(-20, 20), numbers(1e-3, 5))
    def test_rises(self, q, log_prob, more):
        low, high = q_logarithm(torch.tensor([log_prob, log_prob + more], dtype=torch.float64), q)
        assert high > low

    @given(numbers(-10, 10), numbers(1e-9, 0.05), st.sampled_from([-1, 1]))
    def test_continuous_at_one(self, log_prob, distance, side):
        """Taylor's remainder around q = 1, where it is the logarithm."""
        log_prob = torch.tensor(log_prob, dtype=torch.float64)
        near = q_logarithm(log_prob, 1 + side * distance)
        bound = distance * log_prob**2 / 2 * torch.exp(distance * log_prob.abs())
        assert abs(near - q_logarithm(log_prob, 1.0)) <= bound + 1e-6

    @given(numbers(0.05, 3), numbers(-3, 3))
    def test_is_the_power_it_stands_for(self, q, log_prob):
        assume(abs(q - 1) > 1e-3)
        got = q_logarithm(torch.tensor(log_prob, dtype=torch.float64), q).item()
        assert got == pytest.approx((math.exp(log_prob) ** (q - 1) - 1) / (q - 1), rel=1e-9)


class TestCVaR:
    MOMENTS = (numbers(-100, 100), numbers(0, 100))

    @given(*MOMENTS, numbers(0.001, 1), numbers(0.001, 1))
    def test_falls_as_more_outcomes_are_averaged(self, mean, std, one, other):
        mean, std = torch.tensor([mean, std], dtype=torch.float64)
        low, high = sorted((one, other))
        assert gaussian_cvar(mean, std, low) >= gaussian_cvar(mean, std, high) - 1e-9
        assert gaussian_cvar(mean, std, high) >= mean - 1e-9

    @given(*MOMENTS, numbers(0.001, 1), numbers(-50, 50), numbers(0, 10))
    def test_moves_and_scales_with_the_outcomes(self, mean, std, level, shift, factor):
        mean, std = torch.tensor([mean, std], dtype=torch.float64)
        cvar = gaussian_cvar(mean, std, level)
        moved = gaussian_cvar(factor * mean + shift, factor * std, level)
        assert moved.item() == pytest.approx((factor * cvar + shift).item(), rel=1e-9, abs=1e-9)

    @given(numbers(0.01, 1))
    def test_is_the_mean_of_the_worst_outcomes(self, level):
        """The quantile function, averaged over the worst share by the midpoint rule."""
        middles = (np.arange(200_000) + 0.5) / 200_000 * level
        assert cvar_factor(level) == pytest.approx(norm.isf(middles).mean(), abs=1e-4)


class TestRetrace:
    @staticmethod
    def make(seed: int, batch: int, steps: int) -> dict[str, torch.Tensor]:
        generator = torch.Generator().manual_seed(seed)
        shape = (batch, steps, 1)

        def normal() -> torch.Tensor:
            return torch.randn(shape, generator=generator, dtype=torch.float64)

        terminated = torch.rand(shape, generator=generator) < 0.1
        done = terminated | (torch.rand(shape, generator=generator) < 0.1)
        return {
            "log_pi": normal(),
            "log_mu": normal(),
            "action_value": normal(),
            "next_state_value": normal(),
            "reward": normal(),
            "done": done,
            "terminated": terminated,
        }

    CASES = (SEEDS, st.integers(1, 4), st.integers(1, 20), numbers(0, 1), numbers(0, 1))

    @given(*CASES)
    def test_contracts(self, seed, batch, steps, gamma, lmbda):
        """Where the next value is that of the action taken: two critics come together by gamma."""
        one, other = self.make(seed, batch, steps), self.make(seed, batch, steps)
        for data, offset in ((one, 1), (other, 2)):
            critic = self.make(seed + offset, batch, steps + 1)["action_value"]
            data["action_value"], data["next_state_value"] = critic[:, :-1], critic[:, 1:]
        apart = max(
            (one[key] - other[key]).abs().max().item()
            for key in ("action_value", "next_state_value")
        )
        targets = [trace_lambda_return_estimate(gamma, lmbda, **d) for d in (one, other)]
        assert (targets[0] - targets[1]).abs().max().item() <= gamma * apart + 1e-9

    @given(*CASES)
    def test_rows_do_not_see_each_other(self, seed, batch, steps, gamma, lmbda):
        data = self.make(seed, batch, steps)
        whole = trace_lambda_return_estimate(gamma, lmbda, **data)
        for i in range(batch):
            row = {key: value[i] for key, value in data.items()}
            alone = trace_lambda_return_estimate(gamma, lmbda, **row)
            torch.testing.assert_close(whole[i], alone, rtol=1e-9, atol=1e-9)

    @given(*CASES, st.integers(1, 19))
    def test_the_past_is_not_seen_and_a_cut_is_a_cut(self, seed, batch, steps, gamma, lmbda, at):
        assume(at < steps)
        data = self.make(seed, batch, steps)
        data["done"][:, at - 1] = True
        whole = trace_lambda_return_estimate(gamma, lmbda, **data)
        for part in (slice(None, at), slice(at, None)):
            cut = {key: value[:, part] for key, value in data.items()}
            alone = trace_lambda_return_estimate(gamma, lmbda, **cut)
            torch.testing.assert_close(whole[:, part], alone, rtol=1e-9, atol=1e-9)


def gaps(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=-1)


class TestLayouts:
    """As the options ask for them, at the start and after goals were met."""

    @settings(max_examples=25)
    @given(SEEDS, st.integers(0, 10), numbers(0.05, 0.3), numbers(0.1, 0.4), numbers(1.5, 4))
    def test_goal_task(self, seed, hazards, hazard_keepout, goal_keepout, extent):
        task = GoalTask(
            num_hazards=hazards,
            hazard_keepout=hazard_keepout,
            goal_keepout=goal_keepout,
            extent=extent,
            goal_radius=2.9,  # met wherever it is: the next step draws another one
        )
        try:
            env = SafeGoalEnv("point", task=task, num_envs=3, num_threads=1, seed=seed)
            td = env.reset()
        except ValueError as error:
            if "no legal layout found" not in str(error):
                raise
            return  # it says so, and gives none
        robot_keepout = get_robot("point").keepout
        for step in range(3):
            for i in range(3):
                layout = env.layout(i)
                assert len(layout["hazards"]) == hazards
                assert (np.abs(layout["goal"]) <= extent - goal_keepout + 1e-9).all()
                assert (np.abs(layout["hazards"]) <= extent - hazard_keepout + 1e-9).all()
                to_goal = gaps(layout["hazards"], layout["goal"][None])
                assert (to_goal >= hazard_keepout + goal_keepout - 1e-9).all()
                among = gaps(layout["hazards"], layout["hazards"])[~np.eye(hazards, dtype=bool)]
                assert (among >= 2 * hazard_keepout - 1e-9).all()
                if step == 0:
                    to_robot = gaps(layout["hazards"], layout["robot"][None])
                    assert (to_robot >= hazard_keepout + robot_keepout - 1e-9).all()
            td = env.step(env.rand_action(td))["next"].exclude("reward", "cost")

    @settings(max_examples=25)
    @given(SEEDS, st.integers(0, 12), st.integers(6, 14))
    def test_navigation_task(self, seed, boxes, grid):
        task = NavigationTask(num_boxes=boxes, grid_size=grid)
        env = SafeGoalEnv("jackal", task=task, num_envs=3, num_threads=1, seed=seed)
        env.reset()
        for i in range(3):
            layout = env.layout(i)
            assert layout["boxes"].shape == (boxes, 2)
            placed = np.concatenate([layout["goal"][None], layout["boxes"]])
            assert (np.abs(placed) <= task.grid_extent + 1e-9).all()
            assert (np.abs(placed) >= task.start_clearance - 1e-9).any(1).all()
            apart = gaps(placed, placed)[~np.eye(len(placed), dtype=bool)]
            assert (apart > 0.1).all()
            corner = math.sqrt(2) * task.box_half_size
            to_goal = gaps(layout["boxes"], layout["goal"][None])
            assert (to_goal > task.goal_clearance + corner - 1e-9).all()


@settings(max_examples=12)
@given(SEEDS, st.sampled_from(["point", "car", "jackal"]), st.integers(0, 30), st.integers(1, 30))
def test_snapshot_then_restore_is_the_identity(seed, robot, before, after):
    """Into another environment, whose seed and past are others; the episodes end on the way."""
    env = SafeGoalEnv(robot, num_envs=2, num_threads=1, seed=seed, episode_length=25)
    other = SafeGoalEnv(robot, num_envs=2, num_threads=1, seed=seed + 1, episode_length=25)
    generator = torch.Generator().manual_seed(seed)
    actions = torch.rand(before + after, *env.action_spec.shape, generator=generator) * 2 - 1

    def walk(env, td, actions):
        steps = []
        for action in actions:
            stepped, td = env.step_and_maybe_reset(td.set("action", action))
            steps.append(stepped["next"].clone())
        return torch.stack(steps) if steps else None, td

    _, td = walk(env, env.reset(), actions[:before])
    state, carried = env.state_dict(), td.clone()
    expected, _ = walk(env, td, actions[before:])
    _, _ = walk(other, other.reset(), actions[:1])
    other.load_state_dict(state)
    got, _ = walk(other, carried.clone(), actions[before:])
    env.load_state_dict(state)
    again, _ = walk(env, carried, actions[before:])
    for key in expected.keys(True, True):
        assert torch.equal(got[key], expected[key]), key
        assert torch.equal(again[key], expected[key]), key
