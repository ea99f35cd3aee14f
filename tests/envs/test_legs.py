"""Doggo on its legs: the shipped controller walks, stays up, and is what the script exports."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import torch
from doggo_controller import Legs, export, make_actor
from safetensors import safe_open
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from walking import Walking

from torchrl_safe.envs import GoalTask, SafeRobotEnv, get_robot
from torchrl_safe.envs.legs import INPUT_SIZE, controller_input, load_legs, torques

ASSET = get_robot("doggo").asset_path.parent / "doggo_legs.safetensors"
MOTORS = [
    f"{leg}_{joint}"
    for joint in ("hip_z", "hip_y", "ankle")
    for leg in ("front_left", "rear_left", "rear_right", "front_right")
]


def walk(num_robots: int, num_steps: int, length: float = 1.0, threads: int = 2):
    """Displacement along each robot's own way [N]; has it ever tipped, has it at the end [N]."""
    env = SafeRobotEnv(
        "doggo", num_envs=num_robots, num_threads=threads, task=GoalTask(num_hazards=0), seed=3
    )
    env.reset()
    qpos = env._core._robots.batch.bind("qpos")
    way = np.exp(2j * np.pi * np.arange(num_robots) / num_robots)
    start = qpos[:, :2].copy()
    ever = np.zeros(num_robots, bool)
    for _ in range(num_steps):
        w, x, y, z = qpos[:, 3:7].T
        heading = 1 - 2 * (y * y + z * z) + 2j * (x * y + w * z)
        local = length * way * heading.conj() / abs(heading)
        action = torch.from_numpy(np.stack((local.real, local.imag), 1)).float()
        env.step(TensorDict({"action": action}, [num_robots]))
        tipped = 1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) < 0.3
        ever |= tipped
    moved = qpos[:, :2] - start
    return moved[:, 0] * way.real + moved[:, 1] * way.imag, ever, tipped


class TestWalking:
    def test_every_direction(self):
        """Sixteen ways, over 20 s, the turn included: faster than .15 m/s, on its legs."""
        along, ever, _ = walk(16, 200)
        assert (along / 20.0 > 0.15).all()
        assert not ever.any()

    @pytest.mark.slow
    def test_a_whole_episode(self):
        """Sixty-four robots for 100 s."""
        along, ever, tipped = walk(64, 1000)
        assert (along[~ever] / 100.0 > 0.15).all()
        assert ever.mean() <= 0.05
        assert tipped.mean() <= 0.02

    def test_half_a_command_is_slower(self):
        fast, slow = (walk(16, 100, length)[0].mean() for length in (1.0, 0.5))
        assert 0.2 * fast < slow < 0.8 * fast

    def test_stands_without_a_command(self):
        along, ever, _ = walk(4, 50, 0.0)
        assert abs(along).max() < 0.5
        assert not ever.any()

    def test_threads(self):
        assert (walk(5, 30, threads=1)[0] == walk(5, 30, threads=2)[0]).all()

    def test_a_snapshot_knows_the_beat(self):
        """Taken at each of a period's steps; what follows is what followed."""
        env = SafeRobotEnv("doggo", num_envs=3, num_threads=1)
        env.reset()
        td = TensorDict({"action": torch.tensor([[1.0, 0.0], [-1.0, 0.5], [0.0, -1.0]])}, [3])
        for _ in range(4):
            env.step(td.clone())
            state = env.state_dict()
            following = [env.step(td.clone())["next", "observation"] for _ in range(5)]
            # Another beat and other readings; all of it must be put back.
            env.reset()
            env.load_state_dict(state)
            for observation in following:
                assert (env.step(td.clone())["next", "observation"] == observation).all()
            env.load_state_dict(state)

    def test_a_reset_starts_the_beat_again(self):
        """Two robots, one of them put down later: the same torques from then on."""
        control = get_robot("doggo").control
        env = SafeRobotEnv("doggo", num_envs=2, num_threads=1)
        td = env.reset()
        for _ in range(3):
            env.step(TensorDict({"action": torch.ones(2, 2)}, [2]))
        td["_reset"] = torch.tensor([[False], [True]])
        env.reset(td)
        time = env._core._robots.batch.bind("time")
        assert time.tolist() == pytest.approx([0.3, 0.0])
        qpos = get_robot("doggo").place(np.zeros((4, 2)), np.zeros(4))
        beat = control(np.ones((4, 2)), qpos, np.zeros((4, 19)), np.array([0.0, 0.1, 0.2, 0.4]))
        assert (beat[0] == beat[3]).all()
        assert abs(beat[0] - beat[1]).max() > 0.1
        assert abs(beat[0] - beat[2]).max() > 0.1


class TestController:
    def test_the_mirror(self):
        """A robot that is another's mirror image does its mirror image, half a period later."""
        robot = get_robot("doggo")
        rng = np.random.default_rng(0)
        qpos, qvel = rng.normal(size=(8, 20)), rng.normal(size=(8, 19))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        action = rng.uniform(-0.7, 0.7, (8, 2))
        # y is -y: rotation vectors turn their x and z, velocities their y, and legs change places.
        joints = np.r_[3:6, 0:3, 6, 10:13, 7:10]
        waist = np.array([1] * 6 + [-1] + [1] * 6)
        mirror_qpos = np.concatenate(
            (
                qpos[:, :3] * (1, -1, 1),
                qpos[:, 3:7] * (1, -1, 1, -1),
                qpos[:, 7:][:, joints] * waist,
            ),
            1,
        )
        mirror_qvel = np.concatenate(
            (
                qvel[:, :3] * (1, -1, 1),
                qvel[:, 3:6] * (-1, 1, -1),
                qvel[:, 6:][:, joints] * waist,
            ),
            1,
        )
        first = robot.control(action, qpos, qvel, np.full(8, 0.1))
        second = robot.control(action * (1, -1), mirror_qpos, mirror_qvel, np.full(8, 0.3))
        other = [
            MOTORS.index(name.replace("left", "?").replace("right", "left").replace("?", "right"))
            for name in MOTORS
        ]
        np.testing.assert_allclose(second, first[:, other], atol=1e-9)
        assert abs(first - second).max() > 0.1

    def test_what_is_exported_is_what_was_trained(self, tmp_path, monkeypatch):
        """Torch in training, numpy in the environments: the same torques."""
        torch.manual_seed(0)
        network = nn.Sequential(
            nn.Linear(INPUT_SIZE, 9), nn.Tanh(), nn.Linear(9, 8), nn.Tanh(), nn.Linear(8, 6)
        )
        legs = Legs(torch.randn(6, 6), network, 0.1)
        command = ["doggo_controller.py", "seed=2", "run_dir=x", "resume=true"]
        monkeypatch.setattr("sys.argv", command)
        export(legs, tmp_path / "legs.safetensors")
        rng = np.random.default_rng(0)
        x = controller_input(
            rng.uniform(-1, 1, (20, 2)), rng.normal(size=(20, 45)), 0.1 * np.arange(20)
        )
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            td = make_actor(legs)(TensorDict({"observation": torch.from_numpy(x).float()}, [20]))
        found = torques(load_legs(tmp_path / "legs.safetensors"), x)
        np.testing.assert_allclose(found, td["action"].numpy(), atol=2e-5)
        with safe_open(tmp_path / "legs.safetensors", "np") as file:
            assert file.metadata() == {"command": "python benchmarks/doggo_controller.py seed=2"}

    def test_trained_on_what_the_robot_sees(self):
        """The task's observation and the robot's own input agree step by step."""
        legs = load_legs(ASSET)
        task = Walking(num_directions=4)
        by_motors = SafeRobotEnv("doggo_torques", num_envs=4, num_threads=1, task=task)
        td = by_motors.reset()
        robots = by_motors._core._robots
        control = get_robot("doggo").control
        for _ in range(6):
            layouts = [by_motors.layout(i) for i in range(4)]
            command = np.stack([each["command"] for each in layouts])
            heading = np.stack([each["heading"] for each in layouts])
            turned = command[:, 0] + 1j * command[:, 1]
            turned = turned * (heading[:, 0] - 1j * heading[:, 1])
            qpos, qvel, time = (robots.batch.bind(key) for key in ("qpos", "qvel", "time"))
            expected = control(np.stack((turned.real, turned.imag), 1), qpos, qvel, time)
            seen = td["observation"].double().numpy()
            seen[:, :2] *= 0.7  # of the full speed it was trained on
            action = torques(legs, seen)
            np.testing.assert_allclose(action, expected, atol=1e-4)
            td["action"] = torch.from_numpy(action).float()
            td = by_motors.step(td)["next"]

    def test_the_asset_is_tensors_and_a_command(self):
        """No pickle: a header in JSON that accounts for every byte behind it."""
        raw = ASSET.read_bytes()
        (size,) = struct.unpack("<Q", raw[:8])
        header = json.loads(raw[8 : 8 + size])
        command = header.pop("__metadata__")["command"]
        assert command.startswith("python examples/doggo_controller.py")
        assert "/" not in command.removeprefix("python examples/doggo_controller.py")
        assert max(entry["data_offsets"][1] for entry in header.values()) == len(raw) - 8 - size
        assert len(raw) < 100_000
        assert load_legs(ASSET).gait.shape == (6, 6)

    def test_long_commands_are_cut(self):
        robot = get_robot("doggo")
        qpos = robot.place(np.zeros((3, 2)), np.zeros(3))
        action = np.array([[1.0, 1.0], [np.sqrt(0.5)] * 2, [0.5, 0.5]])
        long, full, slow = robot.control(action, qpos, np.zeros((3, 19)), np.zeros(3))
        np.testing.assert_allclose(long, full)
        assert abs(full - slow).max() > 0.05
