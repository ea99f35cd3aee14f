from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.stats
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ExcludeTransform, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, check_env_specs, exploration_type

from torchrl_safe.record import (
    batch_metrics,
    bootstrap_interval,
    count_violations,
    describe,
    evaluate,
    proportion_interval,
    score,
    summarize,
)

DETERMINISTIC, RANDOM = ExplorationType.DETERMINISTIC, ExplorationType.RANDOM


class ScriptedEnv(EnvBase):
    """Plays tables: row t, column n is what environment n writes at step t of its episode.

    The action is added to the reward, so a test sees what the policy did. Every episode of an
    environment replays its column: whatever is counted after the first ``done`` shows.
    """

    def __init__(self, **tables: torch.Tensor) -> None:
        self.tables = tables
        super().__init__(batch_size=tables["reward"].shape[1:])
        shape = (*self.batch_size, 1)

        def flag() -> Binary:
            return Binary(1, shape=shape, dtype=torch.bool)

        self.observation_spec = Composite(
            observation=Unbounded(shape),
            violation=flag(),
            goal_met=flag(),
            shape=self.batch_size,
        )
        if "violations" in tables:
            self.observation_spec["violations"] = Unbounded(shape, dtype=torch.int64)
        self.action_spec = Bounded(-1, 1, shape=shape)
        self.full_reward_spec = Composite(
            reward=Unbounded(shape), cost=Unbounded(shape), shape=self.batch_size
        )
        self.full_done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=self.batch_size
        )
        self.seed = None
        self.time = torch.zeros(self.batch_size, dtype=torch.long)

    def _observation(self) -> dict[str, torch.Tensor]:
        no = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        counts = {"violations": no.long()} if "violations" in self.tables else {}
        return counts | {
            "observation": self.time[..., None].float(),
            "violation": no,
            "goal_met": no.clone(),
            "done": no.clone(),
            "terminated": no.clone(),
            "truncated": no.clone(),
        }

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            self.time = torch.zeros_like(self.time)
        else:
            self.time = self.time.masked_fill(mask.squeeze(-1), 0)
        return TensorDict(self._observation(), batch_size=self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        length = len(self.tables["reward"])
        row = (self.time % length)[None]
        now = {name: table.gather(0, row)[0][..., None] for name, table in self.tables.items()}
        self.time = self.time + 1
        out = self._observation() | now
        out["reward"] = out["reward"] + tensordict["action"]
        out["done"] = out["terminated"] | out["truncated"]
        return TensorDict(out, batch_size=self.batch_size)

    def _set_seed(self, seed: int | None) -> None:
        self.seed = seed


def tables(steps: int, batch: tuple[int, ...] = (3,), seed: int = 0) -> dict[str, torch.Tensor]:
    rng = np.random.default_rng(seed)
    shape = (steps, *batch)
    return {
        "reward": torch.tensor(rng.normal(size=shape), dtype=torch.float32),
        "cost": torch.tensor(rng.uniform(size=shape), dtype=torch.float32),
        "violation": torch.tensor(rng.uniform(size=shape) < 0.3),
        "goal_met": torch.tensor(rng.uniform(size=shape) < 0.2),
        "terminated": torch.zeros(shape, dtype=torch.bool),
        "truncated": torch.zeros(shape, dtype=torch.bool),
    }


def constant_policy(value: float) -> Callable[[TensorDictBase], TensorDictBase]:
    def policy(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.full((*td.batch_size, 1), value))

    return policy


def noisy_policy(td: TensorDictBase) -> TensorDictBase:
    noise = torch.randn(*td.batch_size, 1) if exploration_type() is RANDOM else 0.5
    return td.set("action", torch.zeros(*td.batch_size, 1) + noise)


def brute_force(script: dict[str, torch.Tensor], n: int, num_steps: int, action: float) -> dict:
    total, cost, discounted, cv, entries, goals, length = 0.0, 0.0, 0.0, 0, 0, 0, 0
    terminated = truncated = before = False
    row = longest = 0
    for t in range(num_steps):
        total += script["reward"][t, n].item() + action
        cost += script["cost"][t, n].item()
        discounted += 0.9**t * script["cost"][t, n].item()
        entries += int(script["violation"][t, n].item() and not before)
        before = script["violation"][t, n].item()
        row = row + 1 if before else 0
        longest = max(longest, row)
        cv += int(script["violation"][t, n].item())
        goals += int(script["goal_met"][t, n].item())
        length += 1
        terminated, truncated = (script[name][t, n].item() for name in ("terminated", "truncated"))
        if terminated or truncated:
            break
    return {
        "episode_return": total,
        "violations": cv,
        "entries": entries,
        "longest_violation": longest,
        "cost": cost,
        "discounted_cost": discounted,
        "terminated": terminated,
        "truncated": truncated,
        "cv_rate": cv / length,
        "score": total / (1 + cv),
        "cost_rate": cost / length,
        "goals": goals,
        "length": length,
    }


def test_scripted_env_is_a_torchrl_env():
    check_env_specs(ScriptedEnv(**tables(5)))


def test_score_literal():
    returns = torch.tensor([10.0, 10.0, -6.0, 0.0], dtype=torch.float64)
    cvs = torch.tensor([0, 4, 2, 100])
    assert score(returns, cvs).tolist() == [10.0, 2.0, -2.0, 0.0]
    with pytest.raises(ValueError, match=r"\(4,\) and \(4, 1\)"):
        score(returns, cvs[:, None])


@pytest.mark.parametrize("num_steps", [1, 7, 12])
def test_evaluate_against_brute_force(num_steps):
    script = tables(12, batch=(5,))
    script["terminated"][3, 0] = True
    script["truncated"][5, 1] = True
    script["terminated"][0, 2] = True
    # Environment 3 ends twice: only the first counts. Environment 4 never ends.
    script["truncated"][6, 3] = script["terminated"][9, 3] = True
    episodes = evaluate(
        ScriptedEnv(**script),
        constant_policy(0.25),
        num_steps=num_steps,
        exploration_type=DETERMINISTIC,
        cost_gamma=0.9,
    )
    described = describe(episodes)
    assert episodes.batch_size == (5,)
    for n in range(5):
        expected = brute_force(script, n, num_steps, 0.25)
        assert set(episodes.keys()) == set(expected)
        for name, value in expected.items():
            assert episodes[name][n].item() == pytest.approx(value, rel=1e-6, abs=1e-6), (name, n)
        ends = {(True, False): "terminated", (False, True): "truncated", (False, False): "running"}
        assert described[n]["end"] == ends[expected["terminated"], expected["truncated"]]
        assert described[n]["return"] == episodes["episode_return"][n].item()
        for name in ("violations", "entries", "goals", "length"):
            assert described[n][name] == expected[name]
            assert isinstance(described[n][name], int)
        for name in ("score", "cost", "discounted_cost"):
            assert described[n][name] == pytest.approx(expected[name], rel=1e-6, abs=1e-6)


def test_a_step_can_count_for_many_violations():
    """Environment 0 collides at its third step of ten, environment 1 is near at two of ten."""
    script = tables(10, batch=(2,))
    script["violations"] = torch.zeros(10, 2, dtype=torch.int64)
    script["violations"][2, 0] = 8
    script["terminated"][2, 0] = True
    script["violations"][3:5, 1] = 1
    script["violation"] = torch.ones(10, 2, dtype=torch.bool)  # the counts are read instead
    env = ScriptedEnv(**script)
    check_env_specs(env)
    episodes = evaluate(env, constant_policy(0.0), num_steps=10, exploration_type=DETERMINISTIC)
    assert episodes["violations"].tolist() == [8, 2]
    assert episodes["length"].tolist() == [3, 10]
    # Both episodes are ten steps long, had one not ended.
    assert episodes["cv_rate"].tolist() == pytest.approx([0.8, 0.2])
    for n, steps in ((0, 3), (1, 10)):
        cost, reward = (script[name][:steps, n].sum().item() for name in ("cost", "reward"))
        assert episodes["cost_rate"][n].item() == pytest.approx(cost / 10, rel=1e-6)
        assert episodes["score"][n].item() == pytest.approx(reward / (9, 3)[n], rel=1e-6)

    batch = TensorDict({"next": {k: v[:3, 0, None] for k, v in script.items()}}, [3])
    assert count_violations(batch) == 8
    metrics = batch_metrics(batch)
    assert metrics["train/cv_rate"] == pytest.approx(0.8)
    assert metrics["train/cost_rate"] == pytest.approx(script["cost"][:3, 0].sum().item() / 10)
    reward = script["reward"][:3, 0].sum().item()
    assert metrics["train/reward_per_1000"] == pytest.approx(100 * reward)


def test_evaluate_stops_when_all_are_done():
    script = tables(50)
    script["truncated"][4] = True
    steps = 0

    def counting_policy(td):
        nonlocal steps
        steps += 1
        return constant_policy(0.0)(td)

    evaluate(ScriptedEnv(**script), counting_policy, exploration_type=DETERMINISTIC)
    assert steps == 5


@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_evaluate_any_batch_size_and_transforms(batch):
    script = tables(6, batch=batch)
    env = TransformedEnv(ScriptedEnv(**script), RewardSum())
    episodes = evaluate(env, constant_policy(0.0), num_steps=6, exploration_type=DETERMINISTIC)
    torch.testing.assert_close(episodes["episode_return"], script["reward"].double().sum(0))
    torch.testing.assert_close(episodes["cost_rate"], script["cost"].double().mean(0))
    assert set(summarize(episodes)) >= {"eval/score", "eval/return"}


def test_exploration_type_reaches_the_policy_and_no_gradients():
    env = ScriptedEnv(**tables(4))
    modes = []

    def policy(td):
        modes.append((exploration_type(), torch.is_grad_enabled()))
        return constant_policy(0.0)(td)

    for mode in (RANDOM, DETERMINISTIC):
        evaluate(env, policy, num_steps=1, exploration_type=mode)
    assert modes == [(RANDOM, False), (DETERMINISTIC, False)]
    assert torch.is_grad_enabled()


def test_seed_reproduces_and_global_random_state_is_kept():
    env = ScriptedEnv(**tables(20))
    before = torch.get_rng_state()
    kwargs = {"num_steps": 20, "exploration_type": RANDOM}
    first = evaluate(env, noisy_policy, seed=7, **kwargs)
    assert torch.equal(before, torch.get_rng_state())
    assert env.seed == 7
    torch.randn(3)
    again = evaluate(env, noisy_policy, seed=7, **kwargs)
    other = evaluate(env, noisy_policy, seed=8, **kwargs)
    assert torch.equal(first["episode_return"], again["episode_return"])
    assert not torch.equal(first["episode_return"], other["episode_return"])


def test_evaluate_rejects():
    env = ScriptedEnv(**tables(4))
    with pytest.raises(ValueError, match="num_steps must be at least 1, got 0"):
        evaluate(env, constant_policy(0.0), num_steps=0, exploration_type=RANDOM)
    with pytest.raises(ValueError, match=r"cost_gamma must be in \[0, 1\], got 1.5"):
        evaluate(env, constant_policy(0.0), cost_gamma=1.5, exploration_type=RANDOM)
    env = TransformedEnv(ScriptedEnv(**tables(4)), ExcludeTransform("cost"))
    with pytest.raises(KeyError, match=r"cost.* is missing"):
        evaluate(env, constant_policy(0.0), exploration_type=RANDOM)


def test_summarize_literal():
    episodes = TensorDict(
        {
            "episode_return": torch.tensor([4.0, 8.0]),
            "violations": torch.tensor([0.0, 3.0]),
            "score": torch.tensor([4.0, 2.0]),
        },
        batch_size=[2],
    )
    metrics = summarize(episodes, "eval/det/")
    assert metrics["eval/det/return"] == 6.0
    assert metrics["eval/det/violations"] == 1.5
    # The mean of the scores, not the score of the means (2.4).
    assert metrics["eval/det/score"] == 3.0
    # Resampling two values gives the lower, the middle and the upper mean.
    assert (metrics["eval/det/score_low"], metrics["eval/det/score_high"]) == (2.0, 4.0)
    assert all(type(value) is float for value in metrics.values())
    with pytest.raises(ValueError, match="at least one"):
        summarize(episodes[:0])


def test_bootstrap_interval_against_scipy():
    values = np.random.default_rng(3).exponential(size=60)
    expected = scipy.stats.bootstrap(
        (values,), np.mean, n_resamples=50_000, method="percentile", rng=0
    ).confidence_interval
    before = torch.get_rng_state()
    low, high = bootstrap_interval(torch.tensor(values))
    assert torch.equal(before, torch.get_rng_state())
    # 2,000 resamples place a 2.5 % quantile to within a few hundredths of the width.
    width = expected.high - expected.low
    assert low == pytest.approx(expected.low, abs=0.06 * width)
    assert high == pytest.approx(expected.high, abs=0.06 * width)
    assert bootstrap_interval(torch.tensor(values)) == (low, high)


def test_bootstrap_interval_edges():
    assert all(map(math.isnan, bootstrap_interval(torch.tensor([1.0]))))
    with pytest.raises(ValueError, match=r"\[N\], got \(2, 2\)"):
        bootstrap_interval(torch.zeros(2, 2))


@pytest.mark.parametrize("batch", [(12,), (3, 4)])
def test_batch_metrics_against_brute_force(batch):
    script = {name: table.reshape(*batch, 1) for name, table in tables(12, batch=()).items()}
    td = TensorDict({"next": script}, batch_size=batch)
    rewards, costs, cvs = (script[k].flatten().tolist() for k in ("reward", "cost", "violation"))
    assert count_violations(td) == sum(cvs) > 0
    assert type(count_violations(td)) is int
    metrics = batch_metrics(td, "x/")
    assert metrics == {
        "x/reward_per_1000": pytest.approx(1_000 * math.fsum(rewards) / 12),
        "x/cost_rate": pytest.approx(math.fsum(costs) / 12),
        "x/cv_rate": pytest.approx(sum(cvs) / 12),
    }
    assert all(type(value) is float for value in metrics.values())


def test_batch_metrics_rejects():
    td = TensorDict({"next": {"reward": torch.zeros(3, 1), "cost": torch.zeros(3)}}, [3])
    with pytest.raises(ValueError, match=r"cost.*must have shape \(3, 1\).*got \(3,\)"):
        batch_metrics(td)
    with pytest.raises(KeyError, match=r"violation.* is missing"):
        count_violations(td)
    with pytest.raises(ValueError, match="at least one step"):
        batch_metrics(td[:0])


class TestProportionInterval:
    @pytest.mark.parametrize(("successes", "trials"), [(0, 100), (3, 7), (50, 100), (20, 20)])
    def test_is_wilsons(self, successes, trials):
        expected = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
        assert proportion_interval(successes, trials) == pytest.approx(
            (expected.low, expected.high), abs=1e-12
        )

    @pytest.mark.parametrize(
        ("successes", "trials", "message"),
        [
            (0, 0, "trials must be at least 1, got 0"),
            (5, 4, r"successes must be in \[0, 4\], got 5"),
            (-1, 4, r"successes must be in \[0, 4\], got -1"),
        ],
    )
    def test_misuse(self, successes, trials, message):
        with pytest.raises(ValueError, match=message):
            proportion_interval(successes, trials)
