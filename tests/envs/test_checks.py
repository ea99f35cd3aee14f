"""The contract: all of ours keep it, and each clause can fail."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import RewardSum, SerialEnv, StepCounter, TransformedEnv

from torchrl_safe.envs import ROBOTS, GoalTask, SafeRobotEnv, check_safe_env


def make(cls=SafeRobotEnv, num_envs=4, num_threads=1, episode_length=9, **options):
    return cls(
        "point",
        num_envs=num_envs,
        num_threads=num_threads,
        episode_length=episode_length,
        **options,
    )


@pytest.mark.parametrize("robot", ROBOTS)
def test_ours(robot):
    env, twin = (
        SafeRobotEnv(robot, num_envs=3, num_threads=threads, episode_length=9) for threads in (1, 2)
    )
    check_safe_env(env, twins=[twin], time_limit=9)
    check_safe_env(SafeRobotEnv(robot, num_envs=1, num_threads=1))


def test_transformed_and_nested():
    sums = RewardSum(in_keys=["reward", "cost"], out_keys=["return", "costs"])
    check_safe_env(TransformedEnv(make(), sums), time_limit=9)
    check_safe_env(SerialEnv(2, make), time_limit=9)


def test_says_nothing(capfd):
    check_safe_env(make())
    assert capfd.readouterr() == ("", "")


class NoCost(SafeRobotEnv):
    """The cost is an observation, as in TorchRL's SafetyGymnasiumEnv."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.observation_spec["cost"] = Unbounded((*self.batch_size, 1))
        self.full_reward_spec = Composite(
            reward=self.full_reward_spec["reward"], shape=self.batch_size
        )

    def _reset(self, tensordict=None, **kwargs):
        td = super()._reset(tensordict, **kwargs)
        return td.set("cost", torch.zeros(*self.batch_size, 1))


class DoubleCost(SafeRobotEnv):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        spec = Unbounded((*self.batch_size, 1), dtype=torch.float64)
        self.full_reward_spec = Composite(
            reward=self.full_reward_spec["reward"], cost=spec, shape=self.batch_size
        )

    def _step(self, tensordict):
        td = super()._step(tensordict)
        return td.set("cost", td["cost"].double())


class NoViolation(SafeRobotEnv):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        del self.observation_spec["violation"]

    def _to_tensordict(self, frame, *, stepped):
        return super()._to_tensordict(frame, stepped=stepped).exclude("violation")


class NumberViolation(SafeRobotEnv):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.observation_spec["violation"] = Binary(1, (*self.batch_size, 1), dtype=torch.int64)

    def _to_tensordict(self, frame, *, stepped):
        td = super()._to_tensordict(frame, stepped=stepped)
        return td.set("violation", td["violation"].long())


class Stepping(SafeRobotEnv):
    """Lets ``spoil`` change what every step returns."""

    def _step(self, tensordict):
        return self.spoil(super()._step(tensordict))


class NotFinite(Stepping):
    def spoil(self, td):
        return td.set("observation", td["observation"].log())


class NaNCost(Stepping):
    def spoil(self, td):
        return td.set("cost", td["cost"].log() * 0.0 / 0.0)


class NegativeCost(Stepping):
    """A cost with the sign of a reward."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.full_reward_spec = Composite(
            {key: Unbounded((*self.batch_size, 1)) for key in ("reward", "cost")},
            shape=self.batch_size,
        )

    def spoil(self, td):
        return td.set("cost", -td["cost"])


class CostAlone(SafeRobotEnv):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.full_reward_spec = Composite(cost=self.full_reward_spec["cost"], shape=self.batch_size)

    def _step(self, tensordict):
        return super()._step(tensordict).exclude("reward")


class BadStart(SafeRobotEnv):
    """Nothing to see before the first step."""

    def _reset(self, tensordict=None, **kwargs):
        td = super()._reset(tensordict, **kwargs)
        return td.set("observation", torch.full_like(td["observation"], torch.nan))


class DoneAlone(Stepping):
    def spoil(self, td):
        return td.set("truncated", torch.zeros_like(td["done"]))


class Terminates(Stepping):
    """A time limit that is passed off as an end of the task."""

    def spoil(self, td):
        td["terminated"] = td["terminated"] | td["truncated"]
        return td.set("truncated", torch.zeros_like(td["done"]))


class TerminatesToo(Stepping):
    def spoil(self, td):
        return td.set("terminated", td["terminated"] | td["truncated"])


class Unseeded(SafeRobotEnv):
    def _set_seed(self, seed):
        pass


class Remembers(Stepping):
    """Noise from a generator that no seed reaches."""

    def spoil(self, td):
        if not hasattr(self, "noise"):
            self.noise = torch.Generator().manual_seed(0)
        noise = torch.rand(td["reward"].shape, generator=self.noise)
        return td.set("reward", td["reward"] + noise)


class Reuses(Stepping):
    """One buffer for all observations."""

    def spoil(self, td):
        if not hasattr(self, "buffer"):
            self.buffer = torch.empty_like(td["observation"])
        return td.set("observation", self.buffer.copy_(td["observation"]))


class ResetsAll(SafeRobotEnv):
    def _reset(self, tensordict=None, **kwargs):
        return super()._reset(None, **kwargs)


class ResetsNone(SafeRobotEnv):
    def _reset(self, tensordict=None, **kwargs):
        if tensordict is not None and not tensordict["_reset"].all():
            tensordict = tensordict.set("_reset", torch.zeros_like(tensordict["_reset"]))
        return super()._reset(tensordict, **kwargs)


class SharedStream(SafeRobotEnv):
    """A reset of some takes a draw from the streams of the others."""

    def _reset(self, tensordict=None, **kwargs):
        td = super()._reset(tensordict, **kwargs)
        self._core._streams.state += 1
        return td


class HalfAState(SafeRobotEnv):
    def load_state_dict(self, state_dict, **kwargs):
        kept = dict(self.state_dict())
        super().load_state_dict({**state_dict, "elapsed": kept["elapsed"]})


BROKEN = [
    (NoCost, r"'cost' must be among \['reward'\]"),
    (DoubleCost, r"'cost' must be torch.float32 \(4, 1\), its spec says torch.float64"),
    (NoViolation, "'violation' must be among"),
    (NumberViolation, r"'violation' must be torch.bool \(4, 1\), its spec says torch.int64"),
    (NotFinite, "'observation' must be finite, it is not at"),
    (NaNCost, "cost"),
    (NegativeCost, "'cost' must not be negative, it is at"),
    (CostAlone, "there must be a reward beside 'cost'"),
    (BadStart, "'observation' must be finite, it is not at"),
    (DoneAlone, r"done must be terminated \| truncated, it is not in"),
    (Terminates, "a time limit of 9 must truncate at step 9"),
    (TerminatesToo, "a time limit truncates and does not terminate"),
    (Remembers, "the same seed and actions give another rollout: .*reward"),
    (Unseeded, "the same seed and actions give another rollout"),
    (Reuses, "returned tensors are written to by later steps"),
    (ResetsAll, "a partial reset after step 10 changes step .* of those it leaves alone"),
    (ResetsNone, "a partial reset changes nothing where it was asked to reset"),
    (SharedStream, "a partial reset after step 10 changes step .* of those it leaves alone"),
    (HalfAState, r"load_state_dict\(state_dict\(\)\) is no way back"),
]


@pytest.mark.parametrize(("cls", "message"), BROKEN)
def test_each_clause_can_fail(cls, message):
    with pytest.raises(AssertionError, match=message):
        check_safe_env(make(cls), time_limit=9)


def test_each_clause_can_fail_without_assertions():
    """Under ``python -O``, which leaves assert statements out."""
    code = """if True:
        from torchrl_safe.envs import check_safe_env
        from test_checks import BROKEN, make
        if __debug__:
            raise SystemExit("not optimised")
        for cls, _ in BROKEN:
            try:
                check_safe_env(make(cls), time_limit=9)
                print(cls.__name__, "approved")
            except AssertionError as error:
                print(cls.__name__, *str(error).split())
    """
    path = Path(__file__).parent
    out = subprocess.run(
        [sys.executable, "-O", "-c", code], cwd=path, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert len(out) == len(BROKEN)
    for line, (cls, message) in zip(out, BROKEN, strict=True):
        assert re.search(f"{cls.__name__} .*{message}", line), line


def test_random_state_is_left_alone():
    before = torch.get_rng_state()
    check_safe_env(make())
    assert torch.equal(torch.get_rng_state(), before)


def test_torchrls_own_check_comes_first():
    class WrongShape(Stepping):
        def spoil(self, td):
            return td.set("goal_met", td["goal_met"].float())

    with pytest.raises(AssertionError):
        check_safe_env(make(WrongShape))


@pytest.mark.parametrize(
    ("twin", "difference"),
    [
        (lambda: make(episode_length=5), "differs at"),
        (lambda: make(task=GoalTask(lidar_bins=8)), r"\(20, 4, 16\) and .*\(20, 4, 24\)"),
        (lambda: TransformedEnv(make(), StepCounter()), "only one has the entries .*step_count"),
    ],
)
def test_twins(twin, difference):
    with pytest.raises(AssertionError, match=f"twin 1 gives another rollout: .*{difference}"):
        check_safe_env(make(), twins=[make(), twin()])


def test_early_time_limit():
    with pytest.raises(AssertionError, match="before the limit of 9"):
        check_safe_env(make(episode_length=9, stagger=True), time_limit=9)
    with pytest.raises(AssertionError, match="must truncate at step 5"):
        check_safe_env(make(episode_length=9), time_limit=5)


def test_options():
    check_safe_env(make(NoViolation), violation_key=None)
    for bad in ({"num_steps": 0}, {"time_limit": 0}):
        with pytest.raises(ValueError, match="must be positive, got 0"):
            check_safe_env(make(), **bad)
