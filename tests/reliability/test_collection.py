"""What happens to those who collect: a simulation blows up, a process is killed."""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from tensordict.nn import TensorDictModule
from torch import nn

from torchrl_safe.envs import SafeGoalEnv, get_robot
from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import checkpoints, collectors, trainer

DIE = Path("die")  # whoever deletes it ends itself
STEPS = 12  # that a simulation lives, longer than a replayed slice
PER_BATCH = 4 * (tiny.FRAMES // 4 // STEPS)  # of 4 environments; or of 2, for twice as many steps
LONG = "env.episode_length=200"  # no episode ends otherwise


def explode(action, qpos, qvel, time):
    qvel[np.rint(time / 0.02) == STEPS - 1] = 1e12  # beyond MuJoCo's limit of 1e10
    if DIE.exists() and multiprocessing.parent_process() is not None:
        DIE.unlink()
        os.kill(os.getpid(), signal.SIGKILL)
    return action


def make_unstable_env(options, num_envs, seed, training=False, **_):
    length = {"episode_length": options.env.episode_length, "stagger": True} if training else {}
    robot = replace(get_robot("point"), control=explode)
    return SafeGoalEnv(robot, num_envs=num_envs, num_threads=1, seed=seed, **length)


@pytest.fixture(autouse=True)
def unstable(monkeypatch, tmp_path):
    monkeypatch.setattr(trainer, "make_env", make_unstable_env)
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warnings there


@pytest.fixture
def patience():
    """A test that hangs fails."""

    def give_up(*_):
        raise AssertionError("hung")

    previous = signal.signal(signal.SIGALRM, give_up)
    yield partial(signal.alarm, 300)
    signal.alarm(0)
    signal.signal(signal.SIGALRM, previous)


def logged(run_dir):
    return read_metrics(run_dir / "log")["train/instabilities"][1].tolist()


def test_instabilities_are_reset_counted_and_logged(tmp_path):
    """There are 25 steps per batch; a simulation that was not reset would fail at every step."""
    run_dir = tmp_path / "run"
    tiny.launch(run_dir, LONG, "collector.total_frames=200")
    tiny.launch(run_dir, LONG, "collector.total_frames=400", "resume=true")
    assert logged(run_dir) == [4 * (25 * batch // STEPS) for batch in (1, 2, 3, 4)]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["multi_sync", "multi_async"])
def test_a_killed_worker(tmp_path, monkeypatch, patience, backend):
    """While it waits, so that its receipt of new weights is missing; or in the middle of a step."""
    run_dir, workers, count = tmp_path / "run", [], trainer.count_violations

    def count_and_kill(batch):
        workers[:] = sorted(child.pid for child in multiprocessing.active_children())
        if (run_dir / "log").exists() and any((run_dir / "log").rglob("*.csv")):
            patience()
            if backend == "multi_sync":
                os.kill(workers[1], signal.SIGKILL)
            else:
                DIE.touch()
        return count(batch)

    monkeypatch.setattr(trainer, "count_violations", count_and_kill)
    with pytest.raises(collectors.WorkerDied) as info:
        tiny.launch(run_dir, LONG, "collector.total_frames=2000", f"collector.backend={backend}")
    signal.alarm(0)
    assert re.search(
        r"of the collector.num_workers=2, worker [01] \(killed by SIGKILL\) died, .* Go on with "
        r"the same command and resume=true",
        str(info.value),
    )
    assert backend != "multi_sync" or "worker 1" in str(info.value)
    assert len(workers) == 2
    assert not multiprocessing.active_children()
    assert not any(Path(f"/proc/{pid}").exists() for pid in workers)  # not even as zombies

    # Nothing is lost: it goes on, with fewer workers. A batch of multi_async is one worker's.
    saved = int(checkpoints.latest(run_dir).name.split("-")[1])
    assert saved >= 2 * tiny.FRAMES
    monkeypatch.setattr(trainer, "count_violations", count)
    tiny.launch(
        run_dir,
        LONG,
        f"collector.total_frames={saved + tiny.FRAMES}",
        f"collector.backend={backend}",
        "collector.num_workers=1",
        f"env.num_envs={4 if backend == 'multi_sync' else 2}",
        "resume=true",
    )
    # The update during which it died is not logged, but what it had counted is not lost.
    counts = logged(run_dir)
    assert counts[0] == PER_BATCH
    assert counts[-1] == PER_BATCH * (saved // tiny.FRAMES + 1)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["multi_sync", "multi_async"])
def test_an_error_ends_the_workers(tmp_path, monkeypatch, patience, backend):
    """An update that raises, as on a full disk: the process would wait for them for ever."""

    def fail(batch):
        patience()
        assert len(multiprocessing.active_children()) == 2
        raise OSError("no space left")

    monkeypatch.setattr(trainer, "batch_metrics", fail)
    with pytest.raises(OSError, match="no space left") as info:
        tiny.launch(tmp_path / "run", f"collector.backend={backend}")
    assert not multiprocessing.active_children()
    # An error that is kept, as hydra keeps it, keeps the collector: nothing else would end them.
    assert info.tb is not None


@pytest.mark.parametrize(
    ("overrides", "width"),
    [
        (["env.num_envs=2"], 2),
        (["collector.backend=multi_sync", "env.num_envs=10"], 10),
        (["collector.backend=multi_async"], 2),
    ],
)
def test_resumed_with_other_environments(tmp_path, overrides, width):
    run_dir = tmp_path / "run"
    tiny.launch(run_dir, "collector.total_frames=100")
    before = (run_dir / "config.yaml").read_text()
    with pytest.raises(
        ValueError, match=rf"batches of 4 environments .* batches of {width}: leave env.num_envs"
    ):
        tiny.launch(run_dir, "collector.total_frames=200", "resume=true", *overrides)
    assert (run_dir / "config.yaml").read_text() == before
    tiny.launch(run_dir, "collector.total_frames=200", "resume=true")


@pytest.mark.long
@pytest.mark.parametrize("when", ["weights", "batch"])
def test_a_killed_actor_of_ray(tmp_path, patience, when):
    ray = pytest.importorskip("ray")
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")
    ray.init(address="local", num_cpus=2, include_dashboard=False, object_store_memory=2**27)
    try:
        options = tiny.options(tmp_path / "run", "collector.backend=ray")
        policy = TensorDictModule(
            nn.Sequential(nn.Linear(24, 2), nn.Tanh()), ["observation"], ["action"]
        )
        torch.manual_seed(0)
        collector = collectors.make_collector(
            options, SafeGoalEnv, policy, seed=0, total_frames=10 * tiny.FRAMES
        )
        collector.update_policy_weights_()
        batches = iter(collector)
        next(batches)
        ray.kill(collector.remote_collectors[1])
        patience()
        go_on = collector.update_policy_weights_ if when == "weights" else partial(next, batches)
        with pytest.raises(collectors.WorkerDied, match=r"worker 1 \(.*died.*resume=true"):
            go_on()
    finally:
        ray.shutdown()
