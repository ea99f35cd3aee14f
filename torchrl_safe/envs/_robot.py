"""Robots and their tasks on the simulator.

What is around the robots belongs to the task: arrays, which for a task with bodies say where in the
physics model these start.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from torchrl_safe.envs._core import Core, check_counts, with_rows
from torchrl_safe.envs._model import compile_model, pose, state_addresses
from torchrl_safe.envs._pool import Mask, Rows, SimulationPool
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.randomization import (
    Randomization,
    Variation,
    add_noise,
    drop_readings,
)
from torchrl_safe.envs.robots import Array, Motion, Robot, get_robot
from torchrl_safe.envs.tasks import TASKS, Objects, Sensed, Task
from torchrl_safe.envs.tasks.bodies import Bodies

# MuJoCo's derived fields lag behind the state by one physics step, unless it is asked for them.
_ACCELERATION = mujoco.mjtStage.mjSTAGE_ACC.value
_PHYSICS = ("time", "qpos", "qvel", "act")


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

    def physics(self) -> dict[str, Array]:
        """The live state of the robots by MuJoCo's names, [N, ...] each; bodies come behind it."""
        batch, bodies = self.batch, sum(body.count for body in self.bodies if body.hold != "fixed")
        live = {name: batch.bind(name) for name in _PHYSICS}
        return live | {
            "qpos": live["qpos"][:, : self._model.nq - 7 * bodies],
            "qvel": live["qvel"][:, : self._model.nv - 6 * bodies],
        }

    def vary(self, rows: Rows, variation: Variation) -> None:
        """Makes the robots ``rows`` differ from their model, without compiling another one."""
        assert self.variation is not None
        batch, model = self.batch, self._model
        pairs = zip(self.variation, variation, strict=True)
        self.variation = Variation(*(with_rows(old, rows, new) for old, new in pairs))
        mass, friction, gain, *_ = (factor[:, None] for factor in variation)
        batch.expand("body_mass")[rows] = model.body_mass * mass
        batch.expand("body_inertia")[rows] = model.body_inertia * mass[..., None]
        batch.expand("dof_damping")[rows] = model.dof_damping * friction
        batch.expand("geom_friction")[rows] = model.geom_friction * friction[..., None]
        batch.expand("actuator_gainprm")[rows] = model.actuator_gainprm * gain[..., None]
        batch.set_const(rows)

    def place(
        self,
        rows: Rows,
        position: Array,
        yaw: Array,
        objects: Objects | None = None,
        bend: Array | None = None,
    ) -> None:
        """Puts the robots ``rows`` at rest at position [n, 2] and yaw [n], and bodies around.

        ``bend`` [n, J] is added to the coordinates of the joints behind the base.
        """
        batch = self.batch
        batch.state[rows] = self._initial
        qpos = self.robot.place(position, yaw)
        if bend is not None:
            qpos[:, -bend.shape[1] :] += bend
        self._qpos[rows, : qpos.shape[1]] = qpos
        self._place_bodies(rows, objects or {})
        if self.commands is not None:
            self.commands = with_rows(self.commands, rows, np.zeros(1))
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
        self.motion = Motion(*(with_rows(old, rows, new) for old, new in pairs))

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
            sensed = Motion(*(with_rows(new, failed, old[failed]) for new, old in pairs))
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


class RobotFrame(NamedTuple):
    """What N environments show after a step or a reset: [N, D] float32, and [N] each.

    Of m costs, ``cost``, ``violation`` and ``violations`` are [N, m]; ``due``, [N, S] bool, says
    which of the task's sources of cost were.
    """

    observation: NDArray[np.float32]
    reward: Array
    cost: Array
    violation: Mask
    violations: NDArray[np.int64]
    due: Mask
    goal_met: Mask
    diverged: Mask
    terminated: Mask
    truncated: Mask


class RobotCore(Core[RobotFrame]):
    """A task on N robots. Built by :func:`make_core`."""

    reports = ("cost", "violation", "violations", "goal_met")

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
        self.randomization = randomization
        self.cost_names = getattr(task, "cost_names", ())
        self.max_cost = task.max_cost
        self._sources: tuple[str, ...] = getattr(task, "sources", ())
        max_delay = None if randomization is None else randomization.actuator_delay[1]
        bodies = getattr(task, "bodies", None)
        self._robots = RobotBatch(robot, num_envs, num_threads, max_delay, bodies)
        self._objects: Objects = {
            name: np.zeros((num_envs, *value.shape[1:])) for name, value in objects.items()
        }
        no = np.zeros(num_envs, bool)
        costs = np.zeros((num_envs, len(self.cost_names)) if self.cost_names else num_envs)
        frame = RobotFrame(
            observation=np.zeros((num_envs, task.observation_size(robot)), np.float32),
            reward=np.zeros(num_envs),
            cost=costs,
            violation=costs.astype(bool),
            violations=costs.astype(np.int64),
            due=np.zeros((num_envs, len(self._sources)), bool),
            goal_met=no,
            diverged=no,
            terminated=no,
            truncated=no,
        )
        limit = np.broadcast_to(np.asarray(robot.action_limit, float), robot.action_dim)
        super().__init__(
            self._robots,
            frame,
            (-limit, limit),
            seed=seed,
            episode_length=episode_length,
            stagger=stagger,
        )

    def _begin(self, rows: Rows) -> RobotFrame:
        position, yaw, objects = self.task.sample(self.robot, self._streams, rows)
        if self.randomization is not None:
            self._robots.vary(rows, self.randomization.sample(self._streams, rows))
        self._robots.place(rows, position, yaw, objects, self._bend(rows))
        self._objects = {
            name: with_rows(old, rows, objects[name]) for name, old in self._objects.items()
        }
        motion = Motion(*(part[rows] for part in self._robots.motion))
        sensed = self.task.sense(self.robot, motion, objects)
        no = np.zeros(len(rows), bool)
        return RobotFrame(
            self._observe(rows, motion, objects, sensed.scan),
            reward=np.zeros(len(rows)),
            cost=sensed.cost,
            violation=sensed.violation,
            violations=sensed.violation.astype(np.int64),
            due=self._due(sensed),
            goal_met=no,
            diverged=no,
            terminated=no,
            truncated=no,
        )

    def _bend(self, rows: Rows) -> Array | None:
        """How far from their rest the joints of the robots ``rows`` start."""
        noise = self.robot.joint_noise
        if not noise:
            return None
        joints = self._robots.physics()["qpos"].shape[1] - 7
        return noise * (2.0 * self._streams.uniform(rows, joints) - 1.0)

    def _simulate(self, action: Array) -> Mask:
        return self._robots.step(action)

    def _judge(self, diverged: Mask) -> RobotFrame:
        # A reached goal moves within the step: the reward is measured to the old one, the
        # observation shows the new one.
        robot, motion, remaining = self.robot, self._robots.motion, self.remaining
        sensed = self.task.sense(robot, motion, self._objects)
        outcome = self.task.advance(robot, motion, self._objects, sensed, remaining, self._streams)
        self._objects = outcome.objects
        return RobotFrame(
            self._observe(self._rows, motion, self._objects, sensed.scan),
            outcome.reward,
            outcome.cost,
            outcome.violations > 0,
            outcome.violations,
            self._due(sensed),
            outcome.goal_met,
            diverged,
            outcome.terminated,
            truncated=(remaining == 0) | diverged,
        )

    def _due(self, sensed: Sensed) -> Mask:
        """Which sources of cost are due, [n, S]."""
        return np.zeros((len(sensed.scan), 0), bool) if sensed.due is None else sensed.due

    def sources(self, frame: RobotFrame) -> dict[str, NDArray[Any]]:
        """``cost_hazards`` and the like, [N] each, and ``cost_sum``, 1 where any was due."""
        if not self._sources:
            return {}
        due = frame.due.astype(float)
        each = {f"cost_{name}": due[:, k] for k, name in enumerate(self._sources)}
        return each | {"cost_sum": due.max(1)}

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

    def physics(self) -> dict[str, Array]:
        """Copies of what the robots go on from, [N, ...] each, by MuJoCo's names.

        The bodies around them are not in it.
        """
        return {name: np.array(value) for name, value in self._robots.physics().items()}

    def move(self, physics: dict[str, Array]) -> None:
        """Puts the robots somewhere else; the frame shows what they meet there.

        The way there is not judged: a reached goal moves without a reward.

        Args:
            physics (dict of arrays): as :meth:`physics` returns it.
        """
        live = self._robots.physics()
        for name, value in physics.items():
            live[name][:] = value
        self._robots.perceive(self._rows)
        robot, motion = self.robot, self._robots.motion
        sensed = self.task.sense(robot, motion, self._objects)
        moved = self.task.advance(
            robot, motion, self._objects, sensed, self.remaining, self._streams
        )
        self._objects = moved.objects
        self.frame = self.frame._replace(
            observation=self._observe(self._rows, motion, self._objects, sensed.scan),
            cost=sensed.cost,
            violation=sensed.violation,
            violations=sensed.violation.astype(np.int64),
            due=self._due(sensed),
        )

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
        return self._robots.physics()["qpos"][index].copy()

    def scan(self, index: int) -> Array:
        """The lidar's readings [R] in one environment, without noise."""
        row = slice(index, index + 1)
        motion = Motion(*(part[row] for part in self._robots.motion))
        objects = {name: value[row] for name, value in self._objects.items()}
        return self.task.sense(self.robot, motion, objects).scan[0]

    def _snapshot(self) -> dict[str, NDArray[Any]]:
        state = {**self._robots.motion._asdict(), **self._objects}
        variation, commands = self._robots.variation, self._robots.commands
        if variation is not None and commands is not None:
            state["commands"] = commands
            state |= {f"variation_{name}": value for name, value in variation._asdict().items()}
        return state

    def _restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        if self._robots.variation is not None:
            variation = Variation(*(snapshot[f"variation_{name}"] for name in Variation._fields))
            self._robots.vary(self._rows, variation)
            self._robots.commands = snapshot["commands"]
        self._robots.motion = Motion(*(snapshot[name] for name in Motion._fields))
        self._objects = {name: snapshot[name] for name in self._objects}


def make_core(
    robot: str | Robot,
    task: str | Task | None = None,
    *,
    num_envs: int,
    num_threads: int,
    seed: int | None,
    episode_length: int,
    stagger: bool = False,
    randomization: Randomization | None = None,
) -> RobotCore:
    """N environments of one robot and one task: what every interface of ours wraps.

    Args:
        robot (str or Robot): the robot, or its name.
        task (str or Task, optional): the task with its options, or its name in ``TASKS``. Default:
            that of the robot.
        num_envs (int): number of environments, N.
        num_threads (int): threads of the simulator.
        seed (int or None): seed of the random streams, one per environment.
        episode_length (int): steps after which an episode is truncated.
        stagger (bool): whether a reset of all environments starts them at different phases of an
            episode.
        randomization (Randomization, optional): how the robots differ from their model.

    Raises:
        TypeError: if the task or the randomization is something else.
        ValueError: if robot or task is unknown, an option is out of range or the objects do not
            fit.
    """
    if not isinstance(robot, Robot):
        robot = get_robot(robot)
    if task is None:
        task = robot.task
    if isinstance(task, str):
        if task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(TASKS)}, got {task!r}.")
        task = TASKS[task]()
    if isinstance(task, type) or not hasattr(task, "sample"):
        raise TypeError(f"task must be a task with its options, such as GoalTask(), got {task!r}.")
    if randomization is not None and not isinstance(randomization, Randomization):
        raise TypeError(f"randomization must be a Randomization or None, got {randomization!r}.")
    return RobotCore(
        robot,
        task,
        num_envs=num_envs,
        num_threads=num_threads,
        seed=seed,
        episode_length=episode_length,
        stagger=stagger,
        randomization=randomization,
    )
