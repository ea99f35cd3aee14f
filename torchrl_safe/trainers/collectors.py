"""Who acts: one process or several, by ``collector.backend``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from queue import Empty
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import (
    BaseCollector,
    Collector,
    MultiAsyncCollector,
    MultiSyncCollector,
)
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.weight_update import SharedMemWeightSyncScheme

from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.streams import stream_seed


def make_collector(
    options: MethodOptions,
    make_env: Callable[..., EnvBase],
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    seed: int,
    total_frames: int = -1,
) -> BaseCollector:
    """A collector of batches ``[N, T]`` from ``env.num_envs`` environments.

    * ``single``: in this process, before each update. Its state can be saved and resumed exactly.
    * ``multi_sync``: in ``collector.num_workers`` processes, which wait during an update.
    * ``multi_async``: the same without waiting: an update sees the batch of one worker,
      ``[N / num_workers, T]``, begun before the update that came before it.
    * ``ray``: as ``multi_sync``, in actors of the Ray cluster that ``RAY_ADDRESS`` or this machine
      has, else of one started here. Its machines need this library.

    Call ``update_policy_weights_`` on it after every update. If a worker dies, it or the next batch
    raises :class:`WorkerDied` within seconds, with the other workers stopped.

    Args:
        options (MethodOptions): the run's.
        make_env (callable): makes environments from the keywords ``num_envs`` and ``seed``. Workers
            receive a pickled copy.
        policy (callable): acts.

    Keyword Args:
        seed (int): of the environments; workers derive theirs from it.
        total_frames (int): when to stop, which closes the environment. Defaults to never.

    Raises:
        ValueError: if the backend is unknown, or the workers cannot share the environments equally.
    """
    backend, num_workers = options.collector.backend, options.collector.num_workers
    how = {
        "frames_per_batch": options.collector.frames_per_batch,
        "total_frames": total_frames,
        "exploration_type": ExplorationType.RANDOM,
        "auto_register_policy_transforms": False,
    }
    if backend == "single":
        env = make_env(num_envs=options.env.num_envs, seed=seed)
        return ResumableCollector(env, policy, **how)
    if num_workers < 1 or options.env.num_envs % num_workers:
        raise ValueError(
            f"collector.num_workers={num_workers} must divide env.num_envs={options.env.num_envs}."
        )
    share = options.env.num_envs // num_workers
    creators: list[Callable[[], EnvBase]] = [
        partial(_in_worker, make_env, share, worker_seed(seed, i)) for i in range(num_workers)
    ]
    if backend == "ray":
        return _ray_collector(creators, policy, how)
    how["weight_sync_schemes"] = {"policy": _Weights()}
    if backend == "multi_sync":
        return _SyncCollector(creators, policy, cat_results="stack", postproc=_joined, **how)
    return _AsyncCollector(creators, policy, **how)


def envs_per_batch(settings: Mapping[str, Any]) -> int:
    """How many environments a batch of :func:`make_collector` is of, by a run's settings."""
    collector = settings["collector"]
    shared = collector.get("backend") == "multi_async"
    return settings["env"]["num_envs"] // (collector["num_workers"] if shared else 1)


class ResumableCollector(Collector):
    """A collector whose state holds its environment's: loaded, it goes on with the next step.

    TorchRL's own keeps the transforms' state alone, and starts new episodes. The environment must
    have a whole ``state_dict``, as :class:`~torchrl_safe.envs.SafeGoalEnv` does.
    """

    def state_dict(self) -> dict[str, Any]:
        """The collector's state, the environment's, and what the next action will be drawn for."""
        return {
            "collector": super().state_dict(),
            "env": self._stateful_env.state_dict(),
            "carrier": self._carrier.to_dict(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Put everything back."""
        super().load_state_dict(state_dict["collector"], **kwargs)
        self._stateful_env.load_state_dict(state_dict["env"])
        carrier = TensorDict(state_dict["carrier"], self._carrier.batch_size)
        self._carrier.update(carrier.clone(), inplace=False)
        self._traj_pool.load_state_dict(state_dict["collector"]["traj_pool"])

    @property
    def _stateful_env(self) -> EnvBase:
        """What is below transforms, whose own state is the carrier's."""
        return self.env.base_env if isinstance(self.env, TransformedEnv) else self.env


_Collector: Any = object  # one of several processes, whose methods these are


class WorkerDied(RuntimeError):
    """A process that collects has ended; the message says which one, and what to do."""


class _Watched(_Collector):
    """A collector of several processes that says which of them has died."""

    def iterator(self) -> Iterator[TensorDictBase]:
        with self._watch():
            yield from super().iterator()

    def update_policy_weights_(self, *args: Any, **kwargs: Any) -> None:
        with self._watch():
            super().update_policy_weights_(*args, **kwargs)

    def dead(self) -> dict[int, str]:
        """How each worker that has died ended, by its number."""
        # TorchRL closes those that it has stopped because of another one.
        ended = {
            i: process.exitcode
            for i, process in enumerate(self.procs)
            if not process._closed and not process.is_alive()
        }
        return {
            i: f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
            for i, code in ended.items()
        }

    @contextmanager
    def _watch(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            dead = self.dead()
            if not dead:
                raise
            self.shutdown()
            which = ", ".join(f"worker {i} ({how})" for i, how in dead.items())
            raise WorkerDied(
                f"of the collector.num_workers={self.num_workers}, "
                f"{which} died, and the run stopped. A system out of memory kills: then lower "
                "collector.num_workers. Go on with the same command and resume=true."
            ) from error


class _SyncCollector(_Watched, MultiSyncCollector):
    pass


class _AsyncCollector(_Watched, MultiAsyncCollector):
    pass


class _Weights(SharedMemWeightSyncScheme):
    """TorchRL's way of handing out weights, which waits for a dead worker's receipt for ever."""

    def _wait_for_ack(self, worker_ids: Any = None, timeout: float | None = None) -> None:
        for worker, receipts in self._ack_queues.items():
            while True:
                try:
                    receipts.get(timeout=1.0)
                    break
                except Empty:
                    if worker in self.context.dead():
                        raise RuntimeError(f"no receipt from worker {worker}.") from None


def _ray_collector(
    creators: list[Callable[[], EnvBase]],
    policy: Callable[[TensorDictBase], TensorDictBase],
    how: dict[str, Any],
) -> BaseCollector:
    import ray
    from torchrl.collectors.distributed import RayCollector

    class WatchedRayCollector(_Watched, RayCollector):
        def dead(self) -> dict[int, str]:
            ended = {}
            for i, worker in enumerate(self.remote_collectors):
                try:
                    ray.get(worker.__ray_ready__.remote(), timeout=5.0)
                except ray.exceptions.GetTimeoutError:
                    pass  # it is busy
                except ray.exceptions.RayActorError as error:
                    ended[i] = type(error).__name__
            return ended

    transforms = how.pop("auto_register_policy_transforms")
    return WatchedRayCollector(
        creators,
        policy,
        sync=True,
        postproc=_joined,
        collector_kwargs=[{"auto_register_policy_transforms": transforms} for _ in creators],
        remote_configs={"num_cpus": 1},
        ray_init_config={"include_dashboard": False},
        **how,
    )


def worker_seed(seed: int, worker: int) -> int:
    """Seed of a worker's environments and draws."""
    return stream_seed("worker", seed, worker)


def _in_worker(make_env: Callable[..., EnvBase], num_envs: int, seed: int) -> EnvBase:
    """Runs in a worker: what a process of its own needs besides environments."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C stops the learner, which stops workers
    torch.set_num_threads(1)
    torch.manual_seed(seed)  # or all workers would draw the same noise
    return make_env(num_envs=num_envs, seed=seed)


def _joined(batch: TensorDictBase) -> TensorDictBase:
    """The workers' batches ``[W, N / W, T]`` as one, ``[N, T]``."""
    return batch.flatten(0, 1)
