"""Gymnasium's runners on the simulator."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from torchrl_safe.envs._core import Core, check_counts
from torchrl_safe.envs._pool import Mask, Rows, SimulationPool
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks.velocity import VelocityTask, get_velocity_task


class VelocityFrame(NamedTuple):
    """What N environments show after a step or a reset: [N, D] float64, and [N] each."""

    observation: Array
    reward: Array
    cost: Array
    violation: Mask
    diverged: Mask
    terminated: Mask
    truncated: Mask


class RunnerBatch(SimulationPool):
    """N robots of a velocity task on a thread pool.

    Args:
        task (VelocityTask): the task.
        num_envs (int): how many, N.
        num_threads (int): threads that step them, this one included.
    """

    _bound = (*SimulationPool._bound, "_outputs", "_data")

    def __init__(self, task: VelocityTask, num_envs: int, num_threads: int) -> None:
        model = mujoco.MjModel.from_xml_path(str(task.asset_path))
        model.geom_margin[:] *= task.margin_scale
        names = (*task.measured, *task.observed)
        # MuJoCo sums up contact forces only if it is asked to, after a step and of its MjData.
        super().__init__(model, num_envs, num_threads, persistent="cfrc_ext" in names)
        self.model = model
        self._names = names

    def _bind(self, batch: Batch) -> None:
        super()._bind(batch)
        self._outputs = {name: batch.bind(name) for name in self._names if name != "cfrc_ext"}
        self._data = mujoco.MjData(self.model)

    def blank(self) -> dict[str, Array]:
        """The readings of robots that nobody has placed yet; the pool is not built for them."""
        data = mujoco.MjData(self.model)
        names = ("qpos", "qvel", *self._names)
        return {name: np.stack([getattr(data, name)] * self.num_envs) for name in names}

    def place(self, rows: Rows, qpos: Array, qvel: Array) -> dict[str, Array]:
        """Puts the robots ``rows`` somewhere and reads them there; contact forces are zero."""
        batch = self.batch
        batch.state[rows] = self._initial
        self._qpos[rows], self._qvel[rows] = qpos, qvel
        batch.forward(rows)
        readings = self._read(rows)
        if self.persistent:
            readings["cfrc_ext"] = np.zeros((len(rows), self.model.nbody, 6))
        return readings

    def read(self) -> dict[str, Array]:
        """What MuJoCo says of all robots after a step.

        As in Gymnasium's environments, what is derived from the joints (positions of bodies,
        forces) is that of the last physics step's own evaluation, not of the state it led to.
        """
        readings = self._read(slice(None))
        if self.persistent:
            readings["cfrc_ext"] = np.empty((self.num_envs, self.model.nbody, 6))
            for row, forces in enumerate(readings["cfrc_ext"]):
                self.batch.get_data(row, self._data)
                mujoco.mj_rnePostConstraint(self.model, self._data)
                forces[:] = self._data.cfrc_ext
        return readings

    def _read(self, rows: Rows | slice) -> dict[str, Array]:
        # Views of what the next step overwrites, where all are read.
        outputs = {name: value[rows] for name, value in self._outputs.items()}
        return {"qpos": self._qpos[rows], "qvel": self._qvel[rows]} | outputs


class VelocityCore(Core[VelocityFrame]):
    """A velocity task on N robots.

    Args:
        task (str or VelocityTask): the task, or its name.
        num_envs (int): number of environments, N.
        num_threads (int): threads of the simulator.
        seed (int or None): seed of the random streams, one per environment.
        episode_length (int): steps after which an episode is truncated.
        stagger (bool): whether a reset of all environments starts them at different phases of an
            episode.

    Raises:
        TypeError: if the task is something else.
        ValueError: if the task is unknown or an option is out of range.
    """

    reports = ("cost", "violation")

    def __init__(
        self,
        task: str | VelocityTask,
        *,
        num_envs: int,
        num_threads: int,
        seed: int | None,
        episode_length: int,
        stagger: bool = False,
    ) -> None:
        check_counts(num_envs=num_envs, num_threads=num_threads, episode_length=episode_length)
        if isinstance(task, str):
            task = get_velocity_task(task)
        if not isinstance(task, VelocityTask):
            raise TypeError(f"task must be a VelocityTask or the name of one, got {task!r}.")
        self.task = task
        self._robots = RunnerBatch(task, num_envs, num_threads)
        model = self._robots.model
        self.seconds: float = model.opt.timestep * task.frame_skip
        start = self._robots.blank()
        self._position = task.position(start, model.body_mass).copy()
        self._ctrl = np.zeros((num_envs, model.nu))
        low, high = model.actuator_ctrlrange.T.copy()
        super().__init__(
            self._robots,
            _still(task.observe(start)),
            (low, high),
            seed=seed,
            episode_length=episode_length,
            stagger=stagger,
        )

    def _begin(self, rows: Rows) -> VelocityFrame:
        task, model = self.task, self._robots.model
        qpos, qvel = task.sample(model.qpos0, model.nv, self._streams, rows)
        readings = self._robots.place(rows, qpos, qvel)
        self._position[rows] = task.position(readings, model.body_mass)
        return _still(task.observe(readings))

    def _simulate(self, action: Array) -> Mask:
        self._ctrl = action
        return self._robots.advance(action, self.task.frame_skip)

    def _judge(self, diverged: Mask) -> VelocityFrame:
        task, robots = self.task, self._robots
        readings = robots.read()
        position = task.position(readings, robots.model.body_mass).copy()
        velocity = (position - self._position) / self.seconds
        violation = task.speed(velocity) > task.velocity_threshold
        frame = VelocityFrame(
            task.observe(readings),
            task.reward(velocity, self._ctrl),
            violation.astype(np.float64),
            violation,
            diverged,
            ~task.healthy(readings["qpos"], readings["qvel"]),
            (self.remaining == 0) | diverged,
        )
        if diverged.any():
            position[diverged] = self._position[diverged]
            frame.reward[diverged], frame.terminated[diverged] = 0.0, False
            for name in ("observation", "cost", "violation"):
                getattr(frame, name)[diverged] = getattr(self.frame, name)[diverged]
        self._position = position
        return frame

    def _snapshot(self) -> dict[str, NDArray[Any]]:
        return {"position": self._position}

    def _restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        self._position = snapshot["position"]


def _still(observation: Array) -> VelocityFrame:
    """A frame of robots that have not moved yet."""
    zero, no = np.zeros(len(observation)), np.zeros(len(observation), bool)
    return VelocityFrame(observation, zero, zero, no, no, no, no)
