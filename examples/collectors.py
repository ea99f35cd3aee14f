"""Who acts: one process or several, by ``collector.backend``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import (
    BaseCollector,
    Collector,
    MultiAsyncCollector,
    MultiSyncCollector,
)
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

BACKENDS = ("single", "multi_sync", "multi_async", "ray")


def make_collector(
    cfg: DictConfig,
    make_env: Callable[..., EnvBase],
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    seed: int,
    total_frames: int,
) -> BaseCollector:
    """A collector of batches ``[N, T]`` from ``env.num_envs`` environments.

    * ``single``: in this process, before each update. Its state can be saved and resumed exactly.
    * ``multi_sync``: in ``collector.num_workers`` processes, which wait during an update.
    * ``multi_async``: the same without waiting: an update sees the batch of one worker,
      ``[N / num_workers, T]``, begun before the update that came before it.
    * ``ray``: as ``multi_sync``, in actors of the Ray cluster that ``RAY_ADDRESS`` or this machine
      has, else of one started here. Its machines need this library, not the example's files.

    Call ``update_policy_weights_`` on it after every update.

    Args:
        cfg (DictConfig): the run's configuration.
        make_env (callable): makes environments from the keywords ``num_envs`` and ``seed``. Workers
            receive a pickled copy.
        policy (callable): acts.

    Keyword Args:
        seed (int): of the environments; workers derive theirs from it.
        total_frames (int): when to stop.

    Raises:
        ValueError: if the backend is unknown, or the workers cannot share the environments equally.
    """
    backend, num_workers = cfg.collector.backend, cfg.collector.num_workers
    if backend not in BACKENDS:
        raise ValueError(f"collector.backend must be one of {BACKENDS}, got {backend!r}.")
    options = {
        "frames_per_batch": cfg.collector.frames_per_batch,
        "total_frames": total_frames,
        "exploration_type": ExplorationType.RANDOM,
        "auto_register_policy_transforms": False,
    }
    if backend == "single":
        env = make_env(num_envs=cfg.env.num_envs, seed=seed)
        return ResumableCollector(env, policy, **options)
    if num_workers < 1 or cfg.env.num_envs % num_workers:
        raise ValueError(
            f"collector.num_workers={num_workers} must divide env.num_envs={cfg.env.num_envs}."
        )
    share = cfg.env.num_envs // num_workers
    creators: list[Callable[[], EnvBase]] = [
        partial(_in_worker, make_env, share, worker_seed(seed, i)) for i in range(num_workers)
    ]
    if backend == "multi_sync":
        return MultiSyncCollector(
            creators, policy, cat_results="stack", postproc=_joined, **options
        )
    if backend == "ray":
        return _ray_collector(creators, policy, options)
    return MultiAsyncCollector(creators, policy, **options)


class ResumableCollector(Collector):
    """A collector whose state holds its environment's: loaded, it goes on with the next step.

    TorchRL's own keeps the transforms' state alone, and starts new episodes. The environment must
    have a whole ``state_dict``, as :class:`~torchrl_safe.envs.SafeGoalEnv` does.
    """

    def state_dict(self) -> dict[str, Any]:
        """The collector's state, the environment's, and what the next action will be drawn for."""
        return {
            "collector": super().state_dict(),
            "env": self.env.state_dict(),
            "carrier": self._carrier.to_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Put everything back."""
        super().load_state_dict(state_dict["collector"], **kwargs)
        self.env.load_state_dict(state_dict["env"])
        carrier = TensorDict(state_dict["carrier"], self._carrier.batch_size)
        self._carrier.update(carrier.clone(), inplace=False)
        self._traj_pool.load_state_dict(state_dict["collector"]["traj_pool"])


def _ray_collector(
    creators: list[Callable[[], EnvBase]],
    policy: Callable[[TensorDictBase], TensorDictBase],
    options: dict[str, Any],
) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    here = Path(__file__).parent
    for module in list(sys.modules.values()):
        if (path := getattr(module, "__file__", None)) and Path(path).parent == here:
            ray.cloudpickle.register_pickle_by_value(module)
    transforms = options.pop("auto_register_policy_transforms")
    return RayCollector(
        creators,
        policy,
        sync=True,
        postproc=_joined,
        collector_kwargs=[{"auto_register_policy_transforms": transforms} for _ in creators],
        remote_configs={"num_cpus": 1},
        ray_init_config={"include_dashboard": False},
        **options,
    )


def worker_seed(seed: int, worker: int) -> int:
    """Seed of a worker's environments and draws; that of the first is the run's own."""
    return seed + 7_919 * worker


def _in_worker(make_env: Callable[..., EnvBase], num_envs: int, seed: int) -> EnvBase:
    """Runs in a worker: what a process of its own needs besides environments."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the learner, which stops workers
    torch.set_num_threads(1)
    torch.manual_seed(seed)  # or all workers would draw the same noise
    return make_env(num_envs=num_envs, seed=seed)


def _joined(batch: TensorDictBase) -> TensorDictBase:
    """The workers' batches ``[W, N / W, T]`` as one, ``[N, T]``."""
    return batch.flatten(0, 1)
