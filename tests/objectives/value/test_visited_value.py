"""The mean value of visited states against exact values of enumerated chains."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from torchrl_safe.objectives.value import visited_value_estimate

GAMMA = 0.95


class Chain:
    """Four states with costs; from each a step may terminate, and a new episode starts."""

    def __init__(self, seed: int, termination: float) -> None:
        self.rng = np.random.default_rng(seed)
        self.cost = self.rng.random(4)
        self.start = self.rng.dirichlet(np.ones(4))
        self.end = termination * 2 * self.rng.random(4)
        self.move = self.rng.dirichlet(np.full(4, 0.5), 4) * (1 - self.end)[:, None]
        self.value = np.linalg.solve(np.eye(4) - GAMMA * self.move, self.cost)
        again = self.move + np.outer(self.end, self.start)
        self.visits = np.linalg.matrix_power(again, 5000)[0]

    def rows(self, rows: int, steps: int, first: np.ndarray) -> tuple[torch.Tensor, ...]:
        """States ``[rows, steps]``, those that follow, and where episodes terminate."""
        states = np.empty((rows, steps), int)
        following = np.empty_like(states)
        terminated = np.empty((rows, steps), bool)
        state = self.rng.choice(4, rows, p=first)
        for t in range(steps):
            states[:, t] = state
            chances = np.cumsum(np.c_[self.move[state], self.end[state]], 1)
            drawn = (self.rng.random((rows, 1)) > chances[:, :-1]).sum(1)
            terminated[:, t] = drawn == 4
            following[:, t] = np.where(terminated[:, t], 0, drawn)
            fresh = self.rng.choice(4, rows, p=self.start)
            state = np.where(terminated[:, t], fresh, drawn)
        return states, following, torch.tensor(terminated)[..., None]

    def tensor(self, table: np.ndarray, states: np.ndarray) -> torch.Tensor:
        return torch.tensor(table[states])[..., None]


@pytest.mark.parametrize("termination", [0.0, 0.01, 0.1, 0.4])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_rows_of_a_collector_that_goes_on(seed, termination):
    """Rows are cut anywhere; in some of them episodes terminate, one after the other."""
    chain = Chain(seed, termination)
    states, following, terminated = chain.rows(20_000, 20, chain.visits)
    exact = chain.visits @ chain.value
    actual = visited_value_estimate(
        GAMMA,
        chain.tensor(chain.cost, states),
        terminated,
        next_value=chain.tensor(chain.value, following),
    )
    assert actual.item() == pytest.approx(exact, rel=0.02)


def test_a_critic_that_is_off_by_a_constant_changes_nothing():
    chain = Chain(3, 0.1)
    states, following, terminated = chain.rows(50, 7, chain.visits)
    cost, value = chain.tensor(chain.cost, states), chain.tensor(chain.value, following)
    one, other = (
        visited_value_estimate(GAMMA, cost, terminated, next_value=v) for v in (value, value + 5)
    )
    torch.testing.assert_close(one, other)


def test_episodes_of_known_length_that_are_cut_anywhere():
    """How long an episode has lasted says what is left of it, which only a critic knows."""
    age = (torch.arange(1000)[:, None] + torch.arange(15)) % 10
    left = 9.0 - age
    done = (left == 0)[..., None]
    value = ((1 - GAMMA**left) / (1 - GAMMA)).double()[..., None]
    exact = sum((1 - GAMMA**k) / (1 - GAMMA) for k in range(1, 11)) / 10
    actual = visited_value_estimate(
        GAMMA, torch.ones(1000, 15, 1, dtype=torch.float64), done, next_value=value
    )
    assert actual.item() == pytest.approx(exact, rel=0.03)


@pytest.mark.parametrize("time_dim", [-2, 0])
def test_episodes_that_terminate_are_summed(time_dim):
    """Ends at different steps, the last at the end of the row; a double loop over what follows."""
    rng = torch.Generator().manual_seed(0)
    cost = torch.rand(6, 9, 1, generator=rng, dtype=torch.float64)
    done = torch.rand(6, 9, 1, generator=rng) < 0.3
    done[:, -1] = True
    sums = []
    for row in range(6):
        for t in range(9):
            total, discount = 0.0, 1.0
            for k in range(t, 9):
                total += discount * cost[row, k].item()
                discount *= GAMMA
                if done[row, k]:
                    break
            sums.append(total)
    if time_dim == 0:
        cost, done = cost.transpose(0, 1), done.transpose(0, 1)
    actual = visited_value_estimate(GAMMA, cost, done, time_dim=time_dim)
    assert actual.item() == pytest.approx(np.mean(sums), rel=1e-12)


@pytest.mark.parametrize("ends", [0.0, 0.2])
def test_without_terminations_it_is_the_mean_over_one_minus_gamma(ends):
    """Wherever trajectories are truncated, and whatever the critic says."""
    cost = torch.rand(6, 9, 2, dtype=torch.float64)
    done = torch.rand(6, 9, 2) < ends
    actual = visited_value_estimate(
        GAMMA, cost, done, torch.zeros_like(done), next_value=torch.randn(6, 9, 2).double()
    )
    torch.testing.assert_close(actual, cost.mean() / (1 - GAMMA))


def test_padding_is_left_out():
    """Rows of different lengths, padded with NaN, against each row's own sums and cuts."""
    cost = torch.rand(3, 5, 1, dtype=torch.float64)
    mask = torch.tensor([5, 2, 3])[:, None] > torch.arange(5)
    terminated = torch.zeros(3, 5, 1, dtype=torch.bool)
    terminated[2, 2] = True
    padded = torch.where(mask[..., None], cost, torch.nan)
    actual = visited_value_estimate(
        GAMMA, padded, terminated, mask=mask[..., None], next_value=padded
    )
    # The same steps in one row, cut where a row ended.
    cut = torch.zeros(1, 10, 1, dtype=torch.bool)
    cut[0, [4, 6, 9]] = True
    flat = cost[mask][None]
    end = torch.zeros_like(cut)
    end[0, 9] = True
    expected = visited_value_estimate(GAMMA, flat, cut, end, next_value=flat)
    torch.testing.assert_close(actual, expected)


def test_misuse():
    cost, done = torch.ones(2, 3, 1), torch.zeros(2, 3, 1, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"mask must have shape \(2, 3, 1\)"):
        visited_value_estimate(GAMMA, cost, done, mask=done[0])
    with pytest.raises(TypeError, match="done must be boolean"):
        visited_value_estimate(GAMMA, cost, cost)
    with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\], got 2"):
        visited_value_estimate(2.0, cost, done)
