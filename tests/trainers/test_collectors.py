from __future__ import annotations

import os
from functools import partial
from types import SimpleNamespace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP

from torchrl_safe import GMMTanhPolicy
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.trainers.collectors import make_collector, worker_seed

make_env = partial(SafeGoalEnv, "point", num_threads=1, episode_length=15, stagger=True)
FRAMES = 120


def config(backend, num_envs=6, num_workers=2, frames_per_batch=FRAMES):
    return SimpleNamespace(
        env=SimpleNamespace(num_envs=num_envs),
        collector=SimpleNamespace(
            backend=backend, num_workers=num_workers, frames_per_batch=frames_per_batch
        ),
    )


@pytest.fixture
def policy():
    torch.manual_seed(0)
    spec = make_env(num_envs=1).action_spec
    return GMMTanhPolicy(MLP(24, 5, num_cells=[16]), spec, num_components=1)


def collect(options, policy, seed, batches):
    """Batches, between which the policy changes, as an update would change it."""
    collector = make_collector(
        options,
        make_env,
        policy,
        seed=seed,
        total_frames=batches * options.collector.frames_per_batch,
    )
    collector.update_policy_weights_()
    weights = [param.detach().clone() for param in policy.parameters()]
    out = []
    for batch in collector:
        out.append(batch.clone())
        torch._foreach_mul_([param.data for param in policy.parameters()], 1.5)
        collector.update_policy_weights_()
    collector.shutdown()
    torch._foreach_copy_([param.data for param in policy.parameters()], weights)
    return out


@pytest.fixture
def cluster():
    """Two workers on this machine; a slow one needs long to start."""
    ray = pytest.importorskip("ray")
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")
    ray.init(address="local", num_cpus=2, include_dashboard=False, object_store_memory=2**27)
    yield
    ray.shutdown()


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["multi_sync", "ray"])
def test_workers_see_what_collectors_of_one_process_see(backend, request):
    """Each worker's rows are those of a single collector with its seed, weights up to date."""
    if backend == "ray":
        request.getfixturevalue("cluster")
    torch.manual_seed(0)
    network = nn.Sequential(MLP(24, 2, num_cells=[16]), nn.Tanh())
    policy = TensorDictModule(network, in_keys=["observation"], out_keys=["action"])
    together = collect(config(backend), policy, 5, 3)
    apart = config("single", num_envs=3, frames_per_batch=FRAMES // 2)
    workers = [collect(apart, policy, worker_seed(5, i), 3) for i in range(2)]
    assert len(together) == 3
    for batch, *parts in zip(together, *workers, strict=True):
        assert batch.shape == (6, 20)
        expected = torch.cat(parts)
        for key in ("observation", "action", ("next", "reward"), ("next", "cost")):
            torch.testing.assert_close(batch[key], expected[key], msg=str(key))
        assert (batch["next", "done"] == expected["next", "done"]).all()


@pytest.mark.slow
def test_asynchronous_workers_take_turns_and_draw_different_noise(policy):
    batches = collect(config("multi_async"), policy, 5, 4)
    assert [tuple(batch.shape) for batch in batches] == [(3, 40)] * 4
    first = torch.cat([batch["observation"][:, 0] for batch in batches])
    assert len(first.unique(dim=0)) == len(first)


def test_one_process(policy):
    batches = collect(config("single"), policy, 5, 2)
    assert [tuple(batch.shape) for batch in batches] == [(6, 20)] * 2


@pytest.mark.parametrize("backend", ["multi_sync", "multi_async", "ray"])
def test_workers_must_share_equally(backend, policy):
    with pytest.raises(ValueError, match=r"num_workers=4 must divide env.num_envs=6"):
        make_collector(config(backend, num_workers=4), make_env, policy, seed=0, total_frames=240)
