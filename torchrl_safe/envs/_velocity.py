"""The simulator behind every face of the velocity tasks: numpy in, numpy out, N at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from torchrl_safe.envs._core import (
    Mask,
    Rows,
    SimulationPool,
    check_action,
    check_counts,
    check_snapshot,
)
from torchrl_safe.envs._random import RandomStreams
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


class VelocityCore:
    """A velocity task on N robots: episodes, resets, state. Everything else is the task's.

    A simulation that diverges is put back where it was, and its episode is truncated: it repeats
    its last observation and cost without a reward, and nothing non-finite reaches a learner.
    The frame's ``diverged`` says which did in the last step, ``instabilities`` counts them.

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
        self.num_envs = num_envs
        self.episode_length = episode_length
        self.stagger = stagger
        self.instabilities = 0
        self.started = False
        self._robots = RunnerBatch(task, num_envs, num_threads)
        model = self._robots.model
        self.action_range: tuple[Array, Array] = tuple(model.actuator_ctrlrange.T.copy())
        self.seconds: float = model.opt.timestep * task.frame_skip
        start = self._robots.blank()
        self._position = task.position(start, model.body_mass).copy()
        self._elapsed = np.zeros(num_envs, np.int64)
        zero, no = np.zeros(num_envs), np.zeros(num_envs, bool)
        self.frame = VelocityFrame(task.observe(start), zero, zero, no, no, no, no)
        self.seed(seed)

    @property
    def observation_size(self) -> int:
        """Length D of the observation."""
        return self.frame.observation.shape[1]

    @property
    def action_dim(self) -> int:
        """Size A of the action."""
        return len(self.action_range[0])

    def seed(self, seed: int | None) -> None:
        """Restarts the random streams; the current episodes stay until they are reset."""
        self._streams = RandomStreams(seed, self.num_envs)

    def rewind(self, mask: Mask, random_state: NDArray[np.uint64]) -> None:
        """Puts the streams of the environments in ``mask`` [N] where others stand."""
        self._streams.state[mask] = random_state[mask]

    def reset(self, mask: Mask | None = None) -> VelocityFrame:
        """Starts new episodes.

        Args:
            mask (array, optional): [N], the environments to reset; the others keep their state and
                show their current frame. All are reset if there is no mask, or nothing to keep yet.

        Returns:
            VelocityFrame: reward and cost zero where reset.
        """
        if mask is None or not self.started:
            rows = np.arange(self.num_envs)
        else:
            rows = np.flatnonzero(mask)
        if not rows.size:
            return self.frame
        task, model = self.task, self._robots.model
        qpos, qvel = task.sample(model.qpos0, model.nv, self._streams, rows)
        readings = self._robots.place(rows, qpos, qvel)
        self._position[rows] = task.position(readings, model.body_mass)
        staggered = self.stagger and mask is None
        self._elapsed[rows] = rows * self.episode_length // self.num_envs if staggered else 0
        self.started = True
        frame = VelocityFrame(*(value.copy() for value in self.frame))
        for value in frame:
            value[rows] = 0
        frame.observation[rows] = task.observe(readings)
        self.frame = frame
        return frame

    def step(self, action: Array) -> VelocityFrame:
        """Advances all environments by one step; episodes that are over go on until they are reset.

        Args:
            action (array): [N, A]; components outside the actuators' range are clipped.

        Returns:
            VelocityFrame: after the step.

        Raises:
            ValueError: if the action has another shape or is not finite; nothing has moved then.
            RuntimeError: before the first reset.
        """
        if not self.started:
            raise RuntimeError("reset the environment before its first step.")
        check_action(action, (self.num_envs, self.action_dim))
        low, high = self.action_range
        ctrl = np.minimum(np.maximum(action, low, dtype=np.float64), high)
        task, robots = self.task, self._robots
        diverged = robots.advance(ctrl, task.frame_skip)
        readings = robots.read()
        position = task.position(readings, robots.model.body_mass).copy()
        velocity = (position - self._position) / self.seconds
        violation = task.speed(velocity) > task.velocity_threshold
        self._elapsed += 1
        frame = VelocityFrame(
            task.observe(readings),
            task.reward(velocity, ctrl),
            violation.astype(np.float64),
            violation,
            diverged,
            ~task.healthy(readings["qpos"], readings["qvel"]),
            (self._elapsed >= self.episode_length) | diverged,
        )
        if diverged.any():
            self.instabilities += int(diverged.sum())
            position[diverged] = self._position[diverged]
            frame.reward[diverged], frame.terminated[diverged] = 0.0, False
            for name in ("observation", "cost", "violation"):
                getattr(frame, name)[diverged] = getattr(self.frame, name)[diverged]
        self._position, self.frame = position, frame
        return frame

    def close(self) -> None:
        """Ends the simulator's threads; steps, resets and snapshots raise from then on."""
        self._robots.close()

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of everything the future depends on: physics, clocks, random streams."""
        state = {
            "physics": self._robots.state,
            "position": self._position,
            "elapsed": self._elapsed,
            "random": self._streams.state,
            "started": np.array(self.started),
            "instabilities": np.array(self.instabilities),
        }
        frame = {f"frame_{name}": value for name, value in self.frame._asdict().items()}
        return {name: np.array(value) for name, value in (state | frame).items()}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Puts a snapshot back; what follows is what followed it.

        Raises:
            ValueError: if the snapshot is of another number of environments or another task;
                nothing has changed then.
        """
        check_snapshot(snapshot, self.snapshot())
        copy = {name: np.array(value) for name, value in snapshot.items()}
        self._robots.state[:] = copy["physics"]
        self._position = copy["position"]
        self._elapsed = copy["elapsed"]
        self._streams.state = copy["random"]
        self.started = bool(copy["started"])
        self.instabilities = int(copy["instabilities"])
        fields = VelocityFrame._fields
        self.frame = VelocityFrame(*(copy[f"frame_{name}"] for name in fields))
