"""A step with its resets in one piece, against TorchRL's own of step, ``step_mdp`` and reset."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_safe.envs import SafeRobotEnv, SafeVelocityEnv
from torchrl_safe.envs.tasks import SafetyGoalTask, get_task


def make(name: str, seed: int = 3) -> EnvBase:
    how = {"num_envs": 6, "num_threads": 1, "stagger": True, "episode_length": 9, "seed": seed}
    if name == "hopper":
        return SafeVelocityEnv(name, **how)
    if name == "separate costs":
        return SafeRobotEnv("point", task=SafetyGoalTask(2, separate_costs=True), **how)
    if name.startswith("Safety"):
        robot, task = get_task(name)
        return SafeRobotEnv(robot, task=task, **how)
    return SafeRobotEnv(name, **how)


def same(ours: TensorDict, theirs: TensorDict) -> None:
    assert type(ours) is type(theirs)
    assert ours.batch_size == theirs.batch_size
    assert ours.device == theirs.device
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    for key in theirs.keys(True, True):
        assert ours[key].dtype == theirs[key].dtype, key
        assert torch.equal(ours[key], theirs[key]), key


ENVS = ["point", "jackal", "hopper", "SafetyAntGoal1", "SafetyPointButton1", "separate costs"]


@pytest.mark.parametrize("name", ENVS)
def test_is_torchrls_own(name):
    """Some, all and no environments end in a step; what else is in the tensordict stays in it."""
    ours, theirs = make(name), make(name)
    generator = torch.Generator().manual_seed(0)
    starts = [ours.reset(), theirs.reset()]
    ended = []
    for t in range(40):
        action = ours.action_spec.rand() if t % 2 else ours.action_spec.space.high.clone()
        noise = torch.randn(6, 2, generator=generator)
        for td in starts:
            td["action"] = action.clone()
            td["loc"] = noise.clone()
            td["collector", "traj_ids"] = torch.arange(6) + t
        steps = (
            ours.step_and_maybe_reset(starts[0]),
            EnvBase.step_and_maybe_reset(theirs, starts[1]),
        )
        assert steps[0][0] is starts[0]
        for one, other in zip(*steps, strict=True):
            same(one, other)
        ended.append(int(steps[0][0]["next", "done"].sum()))
        starts = [step[1] for step in steps]
        starts[0]["collector", "traj_ids"] += 1  # another tensordict than the step's
        starts[1]["collector", "traj_ids"] += 1
        same(steps[0][0], steps[1][0])
    assert 0 in ended
    assert sum(ended) > 6
    assert ours.instabilities == theirs.instabilities


def test_all_end_at_once():
    ours, theirs = (
        SafeRobotEnv("point", num_envs=4, num_threads=1, episode_length=3) for _ in range(2)
    )
    starts = [ours.reset(), theirs.reset()]
    for _ in range(7):
        action = ours.action_spec.rand()
        for td in starts:
            td["action"] = action.clone()
        steps = (
            ours.step_and_maybe_reset(starts[0]),
            EnvBase.step_and_maybe_reset(theirs, starts[1]),
        )
        for one, other in zip(*steps, strict=True):
            same(one, other)
        starts = [step[1] for step in steps]


def test_what_was_put_there_before_the_step():
    """Of a ``"next"`` that is there, TorchRL keeps what the step does not bring."""
    ours, theirs = make("point"), make("point")
    starts = [ours.reset(), theirs.reset()]
    action = ours.action_spec.rand()
    for td in starts:
        td["action"] = action.clone()
        td["next", "hint"] = torch.ones(6, 1)
    steps = ours.step_and_maybe_reset(starts[0]), EnvBase.step_and_maybe_reset(theirs, starts[1])
    assert "hint" in steps[0][0]["next"].keys()
    for one, other in zip(*steps, strict=True):
        same(one, other)
    starts[0]["_step"] = torch.ones(6, 1, dtype=torch.bool)
    with pytest.raises(NotImplementedError, match="steps all of its environments at once"):
        ours.step_and_maybe_reset(starts[0])
    with pytest.raises(RuntimeError, match=r"batch.size|shape"):
        ours.step_and_maybe_reset(starts[1][:3])


@pytest.mark.parametrize("name", ["point", "hopper"])
def test_a_collector_brings_the_same(name):
    """A transformed environment without transforms steps through TorchRL's own path."""
    batches = []
    for wrap in (lambda env: env, TransformedEnv):
        torch.manual_seed(0)
        collector = Collector(wrap(make(name)), frames_per_batch=150, total_frames=600)
        batches.append([batch.clone() for batch in collector])
        collector.shutdown()
    for one, other in zip(*batches, strict=True):
        same(one, other)
    assert one["next", "done"].any()
