"""N simulations of a model on MuJoCo's thread pool: the only file that steps it."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from torchrl_safe.envs._process import keep_forever
from torchrl_safe.envs.robots import Array

Rows = NDArray[np.integer]
Mask = NDArray[np.bool_]

# MuJoCo resets a simulation whose position, velocity or acceleration is huge or NaN, and counts it.
_WARNING = mujoco.mjtWarning
_DIVERGED = [
    int(w) for w in (_WARNING.mjWARN_BADQPOS, _WARNING.mjWARN_BADQVEL, _WARNING.mjWARN_BADQACC)
]
# MuJoCo's derived fields lag behind the state by one physics step, unless it is asked for them.
_NOTHING = mujoco.mjtStage.mjSTAGE_NONE.value


class SimulationPool:
    """N simulations of a model on a thread pool.

    The pool is built at first use. Copies, pickles and forked processes leave it behind, keep the
    simulations' state and build their own; what a simulation does never depends on the number of
    threads.

    Args:
        model (MjModel): the model of all.
        num_envs (int): how many, N.
        num_threads (int): threads that step them, this one included.
        persistent (bool): whether each keeps what MuJoCo derived in its last step, to be asked for.
    """

    _bound: tuple[str, ...] = (
        "_initial",
        "_qpos",
        "_qvel",
        "_qacc",
        "_ctrl",
        "_warning",
        "_before",
    )

    def __init__(
        self, model: mujoco.MjModel, num_envs: int, num_threads: int, *, persistent: bool = False
    ) -> None:
        self.num_envs = num_envs
        self.num_threads = num_threads
        self.persistent = persistent
        self._model = model
        self._batch: Batch | None = None
        self._saved: Array | None = None
        self._closed = False

    @property
    def batch(self) -> Batch:
        """The thread pool.

        Raises:
            RuntimeError: if the simulations are closed.
        """
        if self._closed:
            raise RuntimeError("the environment is closed: make another one.")
        if self._batch is None:
            self._batch = Batch(self._model, self.num_envs, self.num_threads, self.persistent)
            _POOLS.add(self)
            self._bind(self._batch)
            if self._saved is not None:
                self._batch.state[:] = self._saved
                self._saved = None
        return self._batch

    def _bind(self, batch: Batch) -> None:
        """Looks up the arrays of a new pool; what is named in ``_bound`` is not copied with it."""
        self._initial = batch.state[0].copy()
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._ctrl, self._qacc = batch.bind("ctrl"), batch.bind("qacc")
        self._warning = batch.warning
        self._before = np.empty_like(batch.state)

    def __getstate__(self) -> dict[str, Any]:
        kept = {name: value for name, value in self.__dict__.items() if name not in self._bound}
        saved = self._saved if self._batch is None else self._batch.state.copy()
        return kept | {"_batch": None, "_saved": saved}

    def close(self) -> None:
        """Ends the threads and frees the simulations."""
        self.__dict__ = self.__getstate__() | {"_saved": None, "_closed": True}

    def leave_pool(self) -> None:
        """Goes on with a pool of its own: that of the process this one was forked from is dead."""
        keep_forever(self._batch)
        self.__dict__ = self.__getstate__()

    @property
    def state(self) -> Array:
        """The live state, [N, S]: writing it is setting the simulations."""
        return self.batch.state

    def advance(
        self,
        ctrl: Array,
        substeps: int,
        stage: int = _NOTHING,
        *,
        before_each: Callable[[], None] | None = None,
    ) -> Mask:
        """Makes some physics steps under the controls [N, nu], then evaluates a stage.

        Args:
            ctrl (array): [N, nu].
            substeps (int): how many.
            stage (int): what is evaluated at the state that they led to.

        Keyword Args:
            before_each (callable, optional): what else is set before each of the steps.

        Returns:
            array: [N], the simulations that diverged; they are put back where they were.
        """
        batch = self.batch
        np.copyto(self._before, batch.state)
        self._ctrl[:] = ctrl
        failed = np.zeros(self.num_envs, bool)
        calls, per_call = (1, substeps) if before_each is None else (substeps, 1)
        for call in range(calls):
            if before_each is not None:
                before_each()
            try:
                batch.step(nstep=per_call, stage=stage if call == calls - 1 else _NOTHING)
            except SimulationError:
                failed |= batch.status != 0
        if self._warning.any():  # hardly ever: what follows is left out
            failed |= self._warning[:, _DIVERGED, 1].any(-1)
        for value in (self._qpos, self._qvel, self._qacc):
            # MuJoCo looks at the states that physics steps start from only. NaN compares false.
            if not np.abs(value).max() < mujoco.mjMAXVAL:
                failed |= ~(np.abs(value).max(-1) < mujoco.mjMAXVAL)
        if failed.any():
            batch.state[failed] = self._before[failed]
            self._warning[failed] = 0
        return failed


_POOLS: weakref.WeakSet[SimulationPool] = weakref.WeakSet()


def _leave_pools() -> None:
    for simulations in list(_POOLS):
        simulations.leave_pool()
    _POOLS.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_pools)
