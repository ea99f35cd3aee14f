"""The simulator behind every face of the environments: numpy in, numpy out, N at a time.

This is the only file that touches MuJoCo's thread pool. It moves robots and keeps episodes; what
is around the robots belongs to the task: arrays, which for a task with bodies say where in the
physics model these start.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from torchrl_safe.envs._model import compile_model, pose, state_addresses
from torchrl_safe.envs._process import keep_forever
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.randomization import (
    Randomization,
    Variation,
    add_noise,
    drop_readings,
)
from torchrl_safe.envs.robots import Array, Motion, Robot, get_robot
from torchrl_safe.envs.tasks import TASKS, Objects, Task
from torchrl_safe.envs.tasks.bodies import Bodies

Rows = NDArray[np.integer]
Mask = NDArray[np.bool_]

# MuJoCo resets a simulation whose position, velocity or acceleration is huge or NaN, and counts it.
_WARNING = mujoco.mjtWarning
_DIVERGED = [
    int(w) for w in (_WARNING.mjWARN_BADQPOS, _WARNING.mjWARN_BADQVEL, _WARNING.mjWARN_BADQACC)
]
# MuJoCo's derived fields lag behind the state by one physics step, unless it is asked for them.
_NOTHING = mujoco.mjtStage.mjSTAGE_NONE.value
_ACCELERATION = mujoco.mjtStage.mjSTAGE_ACC.value
_PHYSICS = ("time", "qpos", "qvel", "act")


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


class RobotBatch(SimulationPool):
    """N copies of a robot on a thread pool.

    Args:
        robot (Robot): the robot.
        num_envs (int): how many, N.
        num_threads (int): threads that step them, this one included.
        max_delay (int, optional): most environment steps a command can be late by. ``None`` for
            robots that are all as their model, which is cheaper.
        bodies (tuple of Body, optional): what is around them in the physics model.

    Attributes:
        motion (Motion): where the robots are and what they sense. Accelerations are evaluated once
            more after the last physics step, at the state it led to and under the same command.
        variation (Variation or None): how the robots differ from their model.
        commands (array or None): [N, max_delay + 1, nu], the last ones, newest first.
    """

    _bound = (*SimulationPool._bound, "_time", "_mocap_pos", "_mocap_quat", "_sensors")

    def __init__(
        self,
        robot: Robot,
        num_envs: int,
        num_threads: int,
        max_delay: int | None = None,
        bodies: Bodies | None = None,
    ) -> None:
        model = compile_model(robot, bodies)
        super().__init__(model, num_envs, num_threads)
        self.robot = robot
        self.bodies = bodies or ()
        self._addresses = [state_addresses(model, body) for body in self.bodies]
        self._towed = any(body.hold == "towed" for body in self.bodies)
        self._has_sensors = bodies is not None
        size = model.nsensordata if self._has_sensors else len(robot.proprioception_scale)
        plane = np.zeros((num_envs, 2))
        self.motion = Motion(plane, plane, np.zeros((num_envs, size)))
        self.variation: Variation | None = None
        self.commands: Array | None = None
        if max_delay is not None:
            one, zero = np.ones(num_envs), np.zeros(num_envs)
            self.variation = Variation(one, one, one, zero, zero, zero)
            self.commands = np.zeros((num_envs, max_delay + 1, model.nu))

    def _bind(self, batch: Batch) -> None:
        super()._bind(batch)
        self._time = batch.bind("time")
        self._mocap_pos, self._mocap_quat = batch.bind("mocap_pos"), batch.bind("mocap_quat")
        if self._has_sensors:
            self._sensors = batch.bind("sensordata")
        if self.variation is not None:
            self.vary(np.arange(self.num_envs), self.variation)

    def vary(self, rows: Rows, variation: Variation) -> None:
        """Makes the robots ``rows`` differ from their model, without compiling another one."""
        assert self.variation is not None
        batch, model = self.batch, self._model
        pairs = zip(self.variation, variation, strict=True)
        self.variation = Variation(*(_with_rows(old, rows, new) for old, new in pairs))
        mass, friction, gain, *_ = (factor[:, None] for factor in variation)
        batch.expand("body_mass")[rows] = model.body_mass * mass
        batch.expand("body_inertia")[rows] = model.body_inertia * mass[..., None]
        batch.expand("dof_damping")[rows] = model.dof_damping * friction
        batch.expand("geom_friction")[rows] = model.geom_friction * friction[..., None]
        batch.expand("actuator_gainprm")[rows] = model.actuator_gainprm * gain[..., None]
        batch.set_const(rows)

    def place(
        self, rows: Rows, position: Array, yaw: Array, objects: Objects | None = None
    ) -> None:
        """Puts the robots ``rows`` at rest at position [n, 2] and yaw [n], and bodies around."""
        batch = self.batch
        batch.state[rows] = self._initial
        qpos = self.robot.place(position, yaw)
        self._qpos[rows, : qpos.shape[1]] = qpos
        self._place_bodies(rows, objects or {})
        if self.commands is not None:
            self.commands = _with_rows(self.commands, rows, np.zeros(1))
        self.perceive(rows)

    def _place_bodies(self, rows: Rows, objects: Objects) -> None:
        """At rest at ``objects[name]`` [n, K, 2], turned by ``objects[name + "_yaw"]`` [n, K]."""
        column = rows[:, None]
        for body, where in zip(self.bodies, self._addresses, strict=True):
            xyz, quaternion = pose(body, objects[body.name], objects.get(f"{body.name}_yaw"))
            if "qpos" in where:
                index = where["qpos"][:, None] + np.arange(7)
                self._qpos[rows[:, None, None], index] = np.concatenate((xyz, quaternion), -1)
            if "anchor" in where:
                xyz[..., 2] = 0.0
                self._mocap_pos[column, where["anchor"]] = xyz
            if "mocap" in where:
                self._mocap_pos[column, where["mocap"]] = xyz
                self._mocap_quat[column, where["mocap"]] = quaternion

    def _tow(self) -> None:
        """Moves what tows bodies to where it is at this time."""
        time = self._time[:, None]
        for body, where in zip(self.bodies, self._addresses, strict=True):
            if body.hold == "towed":
                offset = np.stack(
                    (
                        body.travel * np.sin(time),
                        body.travel * np.cos(time),
                        np.full_like(time, body.lift),
                    ),
                    -1,
                )
                self._mocap_pos[:, where["mocap"]] = self._mocap_pos[:, where["anchor"]] + offset

    def perceive(self, rows: Rows) -> None:
        """Evaluates what the robots ``rows`` sense where they are now."""
        self.batch.forward(rows)
        pairs = zip(self.motion, self._sense(rows), strict=True)
        self.motion = Motion(*(_with_rows(old, rows, new) for old, new in pairs))

    def step(self, action: Array) -> Mask:
        """Advances all by one environment step under the actions [N, A].

        Returns:
            array: [N], the simulations that diverged; they are left as they were before the step.
        """
        _ = self.batch  # builds the pool, whose arrays are read
        command = self.robot.control(action, self._qpos, self._qvel, self._time)
        before_each = self._tow if self._towed else None
        failed = self.advance(
            self._late(command), self.robot.substeps, _ACCELERATION, before_each=before_each
        )
        sensed = self._sense(slice(None))
        if failed.any():
            pairs = zip(sensed, self.motion, strict=True)
            sensed = Motion(*(_with_rows(new, failed, old[failed]) for new, old in pairs))
        self.motion = sensed
        return failed

    def _sense(self, rows: Rows | slice) -> Motion:
        # Copies: what a robot returns may be part of the live state.
        sensed = self.robot.sense(self._qpos[rows], self._qvel[rows], self._qacc[rows])
        if self._has_sensors:
            sensed = sensed._replace(proprioception=self._sensors[rows])
        return Motion(*map(np.array, sensed))

    def _late(self, command: Array) -> Array:
        """The command [N, nu] that arrives when this one is sent."""
        if self.variation is None or self.commands is None:
            return command
        self.commands = np.concatenate((command[:, None], self.commands[:, :-1]), 1)
        delay = self.variation.actuator_delay.astype(np.intp)
        return self.commands[np.arange(self.num_envs), delay]


class Frame(NamedTuple):
    """What N environments show after a step or a reset: [N, D] float32, and [N] each."""

    observation: NDArray[np.float32]
    reward: Array
    cost: Array
    violation: Mask
    violations: NDArray[np.int64]
    goal_met: Mask
    diverged: Mask
    terminated: Mask
    truncated: Mask


class Core:
    """A task on N robots: episodes, resets, state. Everything else is the task's.

    A simulation that diverges is put back where it was, and its episode is truncated: it repeats
    its last observation and cost without a reward, and nothing non-finite reaches a learner.
    The frame's ``diverged`` says which did in the last step, ``instabilities`` counts them.

    Built by :func:`make_core`.
    """

    def __init__(
        self,
        robot: Robot,
        task: Task,
        *,
        num_envs: int,
        num_threads: int,
        seed: int | None,
        episode_length: int,
        stagger: bool,
        randomization: Randomization | None,
    ) -> None:
        check_counts(num_envs=num_envs, num_threads=num_threads, episode_length=episode_length)
        # Fail where the options are given, not at the first reset of a worker process.
        *_, objects = task.sample(robot, RandomStreams(0, 4), np.arange(4))
        self.robot = robot
        self.task = task
        self.num_envs = num_envs
        self.episode_length = episode_length
        self.stagger = stagger
        self.instabilities = 0
        self.action_dim = robot.action_dim
        self.observation_size = task.observation_size(robot)
        self.randomization = randomization
        max_delay = None if randomization is None else randomization.actuator_delay[1]
        bodies = getattr(task, "bodies", None)
        self._robots = RobotBatch(robot, num_envs, num_threads, max_delay, bodies)
        self._started = False
        self._objects: Objects = {
            name: np.zeros((num_envs, *value.shape[1:])) for name, value in objects.items()
        }
        self._elapsed = np.zeros(num_envs, np.int64)
        self._rows: Rows = np.arange(num_envs)
        zero, no = np.zeros(num_envs), np.zeros(num_envs, bool)
        blank = np.zeros((num_envs, self.observation_size), np.float32)
        self._frame = Frame(blank, zero, zero, no, no.astype(np.int64), no, no, no, no)
        self.seed(seed)

    def seed(self, seed: int | None) -> None:
        """Restarts the random streams; the current layouts stay until they are reset."""
        self._streams = RandomStreams(seed, self.num_envs)

    @property
    def random_state(self) -> NDArray[np.uint64]:
        """A copy of where each environment's random stream stands, [N]."""
        return self._streams.state.copy()

    def rewind(self, mask: Mask, random_state: NDArray[np.uint64]) -> None:
        """Puts the streams of the environments in ``mask`` [N] back to where they stood."""
        self._streams.state[mask] = random_state[mask]

    def reset(self, mask: Mask | None = None) -> Frame:
        """Starts new episodes.

        Args:
            mask (array, optional): [N], the environments to reset; the others keep their state and
                show their current frame. All are reset if there is no mask, or nothing to keep yet.

        Returns:
            Frame: reward zero where reset.
        """
        rows = self._rows if mask is None or not self._started else np.flatnonzero(mask)
        if not rows.size:
            return self._frame
        position, yaw, objects = self.task.sample(self.robot, self._streams, rows)
        if self.randomization is not None:
            self._robots.vary(rows, self.randomization.sample(self._streams, rows))
        self._robots.place(rows, position, yaw, objects)
        self._objects = {
            name: _with_rows(old, rows, objects[name]) for name, old in self._objects.items()
        }
        staggered = self.stagger and mask is None
        self._elapsed[rows] = rows * self.episode_length // self.num_envs if staggered else 0
        self._started = True
        motion = Motion(*(part[rows] for part in self._robots.motion))
        sensed = self.task.sense(self.robot, motion, objects)
        no = np.zeros(len(rows), bool)
        fresh = Frame(
            self._observe(rows, motion, objects, sensed.scan),
            reward=np.zeros(len(rows)),
            cost=sensed.cost,
            violation=sensed.violation,
            violations=sensed.violation.astype(np.int64),
            goal_met=no,
            diverged=no,
            terminated=no,
            truncated=no,
        )
        pairs: Iterable[tuple[NDArray[Any], NDArray[Any]]] = zip(self._frame, fresh, strict=True)
        self._frame = Frame(*(_with_rows(old, rows, new) for old, new in pairs))
        return self._frame

    def step(self, action: Array) -> Frame:
        """Advances all environments by one step.

        A reached goal moves within the step: the reward is measured to the old one, the
        observation shows the new one. Episodes that are over go on until they are reset.

        Args:
            action (array): [N, A]; components outside [-1, 1] are clipped.

        Returns:
            Frame: after the step.

        Raises:
            ValueError: if the action has another shape or is not finite; nothing has moved then.
            RuntimeError: before the first reset.
        """
        if not self._started:
            raise RuntimeError("reset the environment before its first step.")
        check_action(action, (self.num_envs, self.action_dim))
        # In float64, whatever the face: a command computed in float32 would be another one.
        command = np.minimum(np.maximum(action, -1.0, dtype=np.float64), 1.0)
        diverged = self._robots.step(command)
        self.instabilities += int(diverged.sum())
        self._elapsed += 1
        remaining = np.maximum(self.episode_length - self._elapsed, 0)
        robot, motion = self.robot, self._robots.motion
        sensed = self.task.sense(robot, motion, self._objects)
        outcome = self.task.advance(robot, motion, self._objects, sensed, remaining, self._streams)
        self._objects = outcome.objects
        self._frame = Frame(
            self._observe(self._rows, motion, self._objects, sensed.scan),
            outcome.reward,
            outcome.cost,
            outcome.violations > 0,
            outcome.violations,
            outcome.goal_met,
            diverged,
            outcome.terminated,
            truncated=(remaining == 0) | diverged,
        )
        return self._frame

    def _observe(
        self, rows: Rows, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """What the robots ``rows`` show, through their sensors."""
        variation = self._robots.variation
        if variation is None:
            return self.task.observe(self.robot, motion, objects, scan)
        scan = drop_readings(scan, variation.lidar_dropout[rows], self._streams, rows)
        observation = self.task.observe(self.robot, motion, objects, scan)
        return add_noise(observation, variation.sensor_noise[rows], self._streams, rows)

    def close(self) -> None:
        """Ends the simulator's threads; steps, resets and snapshots raise from then on."""
        self._robots.close()

    def physics(self) -> dict[str, Array]:
        """Copies of what the simulator goes on from, [N, ...] each, by MuJoCo's names."""
        return {name: np.array(self._robots.batch.bind(name)) for name in _PHYSICS}

    def move(self, physics: dict[str, Array]) -> None:
        """Puts the robots somewhere else; the frame shows what they meet there.

        The way there is not judged: a reached goal moves without a reward.

        Args:
            physics (dict of arrays): as :meth:`physics` returns it.
        """
        for name, value in physics.items():
            self._robots.batch.bind(name)[:] = value
        self._robots.perceive(self._rows)
        robot, motion = self.robot, self._robots.motion
        sensed = self.task.sense(robot, motion, self._objects)
        remaining = np.maximum(self.episode_length - self._elapsed, 0)
        moved = self.task.advance(robot, motion, self._objects, sensed, remaining, self._streams)
        self._objects = moved.objects
        self._frame = self._frame._replace(
            observation=self._observe(self._rows, motion, self._objects, sensed.scan),
            cost=sensed.cost,
            violation=sensed.violation,
            violations=sensed.violation.astype(np.int64),
        )

    @property
    def started(self) -> bool:
        """Whether there was a reset."""
        return self._started

    def layout(self, index: int) -> dict[str, Array]:
        """Copies of robot [2], heading [2] and the task's objects of one environment, metres."""
        motion = self._robots.motion
        return {
            "robot": motion.position[index].copy(),
            "heading": motion.heading[index].copy(),
            **{name: value[index].copy() for name, value in self._objects.items()},
        }

    def qpos(self, index: int) -> Array:
        """A copy of the robot's generalised position [nq] in one environment."""
        position = self._robots.motion.position[:1]
        size = self.robot.place(position, position[:, 0]).shape[1]
        return self._robots.batch.bind("qpos")[index, :size].copy()

    def scan(self, index: int) -> Array:
        """The lidar's readings [R] in one environment, without noise."""
        row = slice(index, index + 1)
        motion = Motion(*(part[row] for part in self._robots.motion))
        objects = {name: value[row] for name, value in self._objects.items()}
        return self.task.sense(self.robot, motion, objects).scan[0]

    @property
    def frame(self) -> Frame:
        """The current frame."""
        return self._frame

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of everything the future depends on: physics, layouts, clocks, random streams."""
        state = {
            "physics": self._robots.state,
            **self._robots.motion._asdict(),
            **self._objects,
            "elapsed": self._elapsed,
            "random": self._streams.state,
            "started": np.array(self._started),
            "instabilities": np.array(self.instabilities),
        }
        variation, commands = self._robots.variation, self._robots.commands
        if variation is not None and commands is not None:
            state["commands"] = commands
            state |= {f"variation_{name}": value for name, value in variation._asdict().items()}
        frame = {f"frame_{name}": value for name, value in self._frame._asdict().items()}
        return {name: np.array(value) for name, value in (state | frame).items()}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Puts a snapshot back; what follows is what followed it.

        Raises:
            ValueError: if the snapshot is of another number of environments, robot or task;
                nothing has changed then.
        """
        check_snapshot(snapshot, self.snapshot())
        copy = {name: np.array(value) for name, value in snapshot.items()}
        if self._robots.variation is not None:
            variation = Variation(*(copy[f"variation_{name}"] for name in Variation._fields))
            self._robots.vary(np.arange(self.num_envs), variation)
            self._robots.commands = copy["commands"]
        self._robots.state[:] = copy["physics"]
        self._robots.motion = Motion(*(copy[name] for name in Motion._fields))
        self._objects = {name: copy[name] for name in self._objects}
        self._elapsed = copy["elapsed"]
        self._streams.state = copy["random"]
        self._started = bool(copy["started"])
        self.instabilities = int(copy["instabilities"])
        self._frame = Frame(*(copy[f"frame_{name}"] for name in Frame._fields))


def make_core(
    robot: str | Robot,
    task: Task | None = None,
    *,
    num_envs: int,
    num_threads: int,
    seed: int | None,
    episode_length: int,
    stagger: bool = False,
    randomization: Randomization | None = None,
) -> Core:
    """N environments of one robot and one task: what every face of ours wraps.

    Args:
        robot (str or Robot): the robot, or its name.
        task (Task, optional): the task with its options. Default: that of the robot.
        num_envs (int): number of environments, N.
        num_threads (int): threads of the simulator.
        seed (int or None): seed of the random streams, one per environment.
        episode_length (int): steps after which an episode is truncated.
        stagger (bool): whether a reset of all environments starts them at different phases of an
            episode.
        randomization (Randomization, optional): how the robots differ from their model.

    Raises:
        TypeError: if the task or the randomization is something else.
        ValueError: if the robot is unknown, an option is out of range or the objects do not fit.
    """
    if not isinstance(robot, Robot):
        robot = get_robot(robot)
    if task is not None and (isinstance(task, type) or not hasattr(task, "sample")):
        raise TypeError(f"task must be a task with its options, such as GoalTask(), got {task!r}.")
    if randomization is not None and not isinstance(randomization, Randomization):
        raise TypeError(f"randomization must be a Randomization or None, got {randomization!r}.")
    return Core(
        robot,
        TASKS[robot.task]() if task is None else task,
        num_envs=num_envs,
        num_threads=num_threads,
        seed=seed,
        episode_length=episode_length,
        stagger=stagger,
        randomization=randomization,
    )


def check_counts(**counts: int) -> None:
    """Raises a ``ValueError`` unless each is an integer of at least 1."""
    for name, value in counts.items():
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} must be an integer >= 1, got {value!r}.")


def check_action(action: Array, shape: tuple[int, int]) -> None:
    """Raises a ``ValueError`` unless actions have the shape [N, A] and are finite."""
    if action.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {action.shape}.")
    if not np.isfinite(action).all():
        bad = np.flatnonzero(~np.isfinite(action).all(-1))
        raise ValueError(f"action must be finite; it is not in environments {bad.tolist()}.")


def check_snapshot(snapshot: dict[str, NDArray[Any]], like: dict[str, NDArray[Any]]) -> None:
    """Raises a ``ValueError`` unless it has the entries of another one, of its types and shapes."""
    if snapshot.keys() != like.keys():
        raise ValueError(f"snapshot must have the entries {sorted(like)}, got {sorted(snapshot)}.")
    for name, value in like.items():
        new = snapshot[name]
        if new.shape != value.shape or new.dtype != value.dtype:
            raise ValueError(
                f"snapshot entry {name!r} must be {value.dtype} of shape {value.shape}, "
                f"got {new.dtype} of shape {new.shape}."
            )


def _with_rows(array: NDArray[Any], rows: Rows | Mask, new: NDArray[Any]) -> NDArray[Any]:
    """A copy of ``array`` with other rows."""
    out = array.copy()
    out[rows] = new
    return out
