"""Budgets of an episode's cost, against their recursions in Python's own numbers."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import Compose, EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import (
    EarlyTermination,
    SafeRobotEnv,
    SafetyBudget,
    Saute,
    check_safe_env,
)


class Payments(EnvBase):
    """Each environment pays what is written, [N][T], over and over, and earns 1 per step."""

    def __init__(self, *payments):
        super().__init__(batch_size=[len(payments)])
        shape = self.batch_size
        self.payments = torch.tensor(payments)
        number = Unbounded((*shape, 1))
        self.observation_spec = Composite(observation=Unbounded((*shape, 2)), shape=shape)
        self.action_spec = Bounded(-1, 1, (*shape, 1))
        self.full_reward_spec = Composite(reward=number, cost=number, shape=shape)
        flag = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=shape)

    def _observe(self):
        return {"observation": torch.stack([self.count, -self.count], -1).float()}

    def _reset(self, tensordict=None):
        if tensordict is None or "_reset" not in tensordict.keys():
            self.count = torch.zeros(self.batch_size, dtype=torch.int64)
        else:
            self.count = self.count.masked_fill(tensordict["_reset"].squeeze(-1), 0)
        return TensorDict(self._observe(), self.batch_size)

    def _step(self, tensordict):
        row = torch.arange(len(self.count))
        cost = self.payments[row, self.count % self.payments.shape[1]]
        self.count = self.count + 1
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        signals = {"reward": torch.ones(*self.batch_size, 1), "cost": cost[:, None]}
        flags = {"done": no, "terminated": no.clone(), "truncated": no.clone()}
        return TensorDict({**self._observe(), **signals, **flags}, self.batch_size)

    def _set_seed(self, seed):
        pass


def column(td, *key):
    return td[key].squeeze(-1)


@pytest.mark.parametrize("gamma", [1.0, 0.999, 0.9])
class TestRecursion:
    payments = ((1.0, 0.0, 2.0, 0.5, 0.0, 3.0), (0.0, 0.25, 0.0, 0.0, 4.0, 0.0))

    def test_of_what_is_left(self, gamma):
        env = TransformedEnv(Payments(*self.payments), SafetyBudget(5.0, gamma=gamma))
        rollout = env.rollout(6)
        for env_index, costs in enumerate(self.payments):
            left = 5.0
            for step, cost in enumerate(costs):
                before, after = (td[env_index, step] for td in (rollout, rollout["next"]))
                assert before["budget"].item() == pytest.approx(left, rel=1e-5)
                left = (left - cost) / gamma
                assert after["budget"].item() == pytest.approx(left, rel=1e-5)
                # The share comes last; what was there before it is untouched.
                expected = [step + 1, -step - 1, left / 5.0]
                assert after["observation"].tolist() == pytest.approx(expected, rel=1e-5)

    def test_is_the_discounted_sum(self, gamma):
        """It is below 0 from where on the sum exceeds the budget."""
        env = TransformedEnv(Payments(*self.payments), SafetyBudget(3.1, gamma=gamma))
        overdrawn = column(env.rollout(6), "next", "budget") < 0
        for env_index, costs in enumerate(self.payments):
            sums = [sum(gamma**k * c for k, c in enumerate(costs[: t + 1])) for t in range(6)]
            assert overdrawn[env_index].tolist() == [total > 3.1 for total in sums]

    def test_saute_reshapes_the_reward(self, gamma):
        env = TransformedEnv(Payments(*self.payments), Saute(3.1, gamma=gamma, unsafe_reward=-0.25))
        rollout = env.rollout(6)["next"]
        expected = torch.where(rollout["budget"] < 0, -0.25, 1.0)
        assert torch.equal(rollout["reward"], expected)
        assert torch.equal(column(rollout, "cost"), torch.tensor(self.payments))
        assert not rollout["done"].any()


def test_exactly_spent_is_not_overdrawn():
    """A thousand payments of one out of a budget of a thousand, and one more."""
    env = TransformedEnv(Payments([1.0]), EarlyTermination(1000.0, termination_reward=-7.0))
    rollout = env.rollout(2000)["next"]
    assert rollout.shape == (1, 1001)
    ends = [False] * 1000 + [True]
    assert column(rollout, "terminated")[0].tolist() == ends
    assert column(rollout, "done")[0].tolist() == ends
    assert not rollout["truncated"].any()
    assert column(rollout, "reward")[0].tolist() == [1.0] * 1000 + [-7.0]
    assert column(rollout, "budget")[0, -2:].tolist() == [0.0, -1.0]


def test_one_ends_and_the_others_go_on():
    """In a batch each has a budget of its own, which only its own reset fills."""
    env = TransformedEnv(
        Payments([1.0, 1.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]), EarlyTermination(2.0)
    )
    td, steps = env.reset(), []
    for _ in range(9):
        stepped, td = env.step_and_maybe_reset(td.set("action", torch.zeros(3, 1)))
        steps.append(stepped)
    steps = torch.stack(steps, 1)
    # Overdrawn at the third payment: each third step, the ninth, never.
    assert column(steps, "next", "terminated").int().tolist() == [
        [0, 0, 1] * 3,
        [0] * 8 + [1],
        [0] * 9,
    ]
    assert column(steps, "budget").tolist() == [
        [2, 1, 0] * 3,
        [2, 2, 2, 1, 1, 1, 0, 0, 0],
        [2] * 9,
    ]
    # The observation before a step is the one after the last, or a reset's.
    shares = steps["observation"][..., -1]
    assert torch.equal(shares, column(steps, "budget") / 2)
    assert steps["observation"][0, :, 0].tolist() == [0, 1, 2] * 3
    assert column(td, "budget").tolist() == [2, 2, 2]


def test_partial_reset_by_hand():
    env = TransformedEnv(Payments([1.0], [1.0]), SafetyBudget(4.0))
    td = env.rollout(3, break_when_any_done=False)[:, -1]["next"].select("observation", "budget")
    again = env.reset(td.set("_reset", torch.tensor([[True], [False]])))
    assert column(again, "budget").tolist() == [4.0, 1.0]
    assert again["observation"].tolist() == [[0, 0, 1], [3, -3, 0.25]]


class TestRobots:
    def make(self, *transforms, **options):
        env = SafeRobotEnv("point", num_envs=20, num_threads=1, seed=1, **options)
        return TransformedEnv(env, Compose(*transforms))

    @pytest.mark.parametrize(
        "transform", [SafetyBudget(5.0), Saute(5.0, gamma=0.99), EarlyTermination(2.0)]
    )
    def test_contract(self, transform):
        env = self.make(transform.clone(), episode_length=20)
        check_env_specs(env)
        if not isinstance(transform, EarlyTermination):
            check_safe_env(self.make(transform.clone(), episode_length=20), time_limit=20)

    def test_as_a_collector_drives_them(self):
        """Resets come when they come: at time limits, which are staggered, and at terminations."""
        env = self.make(EarlyTermination(0.1, gamma=0.99), episode_length=30, stagger=True)
        collector = Collector(env, env.rand_action, frames_per_batch=20 * 50, total_frames=20 * 100)
        batch = torch.cat([*collector], 1)
        left = torch.full((20,), 0.1)
        for step in batch.unbind(1):
            torch.testing.assert_close(column(step, "budget"), left, rtol=1e-5, atol=1e-6)
            left = (left - column(step, "next", "cost")) / 0.99
            terminated = column(step, "next", "terminated")
            # What is within rounding of the boundary may fall on either side.
            assert torch.equal(terminated[left.abs() > 1e-5], (left < 0)[left.abs() > 1e-5])
            left = torch.where(column(step, "next", "done"), 0.1, left)
        ends = batch["next"]
        assert ends["terminated"].any()
        assert (ends["truncated"] & ~ends["terminated"]).any()

    def test_in_each_of_several_environments(self):
        def make():
            return TransformedEnv(Payments([1.0, 0.0]), EarlyTermination(1.0))

        inside = SerialEnv(2, make).rollout(8, break_when_any_done=False)
        assert column(inside, "next", "terminated")[0, 0].int().tolist() == [0, 0, 1, 0, 0, 1, 0, 0]
        assert column(inside, "budget")[1, 0].tolist() == [1, 0, 0, 1, 0, 0, 1, 0]

    def test_several_costs(self):
        env = SafeRobotEnv("jackal", task="navigation_speed", num_envs=4, num_threads=1)
        budgets = [
            EarlyTermination(1e6, cost=f"{name}_cost", out_key=f"{name}_budget")
            for name in ("collision", "speed")
        ]
        env = TransformedEnv(env, Compose(*budgets))
        width = SafeRobotEnv("jackal", num_envs=1, num_threads=1).observation_spec["observation"]
        rollout = env.rollout(20)["next"]
        assert rollout["observation"].shape[-1] == width.shape[-1] + 2
        for name in ("collision", "speed"):
            spent = rollout[f"{name}_cost"].double().cumsum(1)
            torch.testing.assert_close(rollout[f"{name}_budget"], (1e6 - spent).float())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SafetyBudget(0.0), "budget must be a positive finite number, got 0"),
        (lambda: Saute(1.0, gamma=1.1), "gamma must be a positive finite number, at most 1, got"),
        (lambda: Saute(1.0, unsafe_reward=float("inf")), "unsafe_reward must be a finite number"),
        (
            lambda: EarlyTermination(1.0, termination_reward=float("nan")),
            "termination_reward must be a finite number",
        ),
        (
            lambda: TransformedEnv(Payments([1.0]), SafetyBudget(1.0, cost="fee")).specs,
            "cost must be one of .*'cost', 'reward'.*, got 'fee'",
        ),
        (
            lambda: TransformedEnv(Payments([1.0]), SafetyBudget(1.0, in_keys=["pixels"])).specs,
            "in_keys must be observations, .*'observation'.*, got 'pixels'",
        ),
        (
            lambda: TransformedEnv(Payments([1.0]), SafetyBudget(1.0, out_key="observation")).specs,
            "out_key must be a new entry, the environment has 'observation'",
        ),
    ],
)
def test_rejects(make, message):
    with pytest.raises(ValueError, match=message):
        make()
