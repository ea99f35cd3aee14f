"""The Jackal and its task: against slow versions, MuJoCo's rays and contacts, and the robot."""

from __future__ import annotations

import math
import pickle

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import NavigationTask, SafeRobotEnv, get_robot
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Motion
from torchrl_safe.envs.tasks import navigation

TASK = NavigationTask()
JACKAL = get_robot("jackal")
FOOTPRINT = (0.229, 0.208)
# Velocity in [0, 1] m/s is (action + 1) / 2; yaw rate in [-1, 1] rad/s is the action.
STOP, AHEAD = (-1.0, 0.0), (1.0, 0.0)


def make(num_envs: int = 4, num_threads: int = 1, **options) -> SafeRobotEnv:
    return SafeRobotEnv("jackal", num_envs=num_envs, num_threads=num_threads, **options)


def step(env: SafeRobotEnv, action) -> TensorDict:
    action = torch.as_tensor(action, dtype=torch.float32).expand(*env.batch_size, 2)
    return env.step(TensorDict({"action": action.clone()}, env.batch_size))["next"]


def scene(seed: int = 0, num_envs: int = 200, boxes: int = 8) -> tuple[np.ndarray, ...]:
    """Robots anywhere, some of them in boxes and behind walls."""
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-10, 10, num_envs)
    heading = np.stack((np.cos(yaw), np.sin(yaw)), -1)
    return (
        rng.uniform(-4.2, 4.2, (num_envs, 2)),
        yaw,
        heading,
        rng.uniform(-3, 3, (num_envs, boxes, 2)),
    )


def room(boxes: int, footprint: tuple[float, float] | None = None) -> mujoco.MjModel:
    """Walls and boxes as MuJoCo geoms, and the robot's rectangle as a body."""
    spec = mujoco.MjSpec()
    box = mujoco.mjtGeom.mjGEOM_BOX
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        size = (0.5 if x else 10.0, 0.5 if y else 10.0, 1.0)
        spec.worldbody.add_geom(type=box, pos=(4.5 * x, 4.5 * y, 0.0), size=size)
    for i in range(boxes):
        body = spec.worldbody.add_body(name=f"box{i}", mocap=True)
        body.add_geom(type=box, size=(0.25, 0.25, 1.0))
    if footprint:
        robot = spec.worldbody.add_body(name="robot")
        robot.add_freejoint()
        robot.add_geom(type=box, size=(*footprint, 0.1))
    return spec.compile()


class TestLidar:
    @pytest.mark.parametrize("boxes", [0, 8])
    def test_against_mj_ray(self, boxes):
        position, yaw, heading, centres = scene(boxes=boxes)
        got = navigation.ray_distances(TASK, position, heading, centres)
        assert got.shape == (200, 136)
        model = room(boxes)
        data = mujoco.MjData(model)
        hit = np.zeros(1, np.int32)
        in_a_box = seen = 0
        for i in range(200):
            # MuJoCo sees the walls from behind, and a box from inside.
            if np.abs(position[i]).max() > 4.0:
                assert got[i].max() <= 3.0
                continue
            if boxes:
                data.mocap_pos[:, :2] = centres[i]
            mujoco.mj_kinematics(model, data)
            if boxes and (np.abs(centres[i] - position[i]).max(-1) <= 0.25).any():
                assert (got[i] == 0.0).all()
                in_a_box += 1
                continue
            for j in range(136):
                angle = yaw[i] + math.radians(-135 + 2 * j)
                direction = np.array((math.cos(angle), math.sin(angle), 0.0))
                origin = np.array((*position[i], 0.0))
                distance = mujoco.mj_ray(model, data, origin, direction, None, 1, -1, hit)
                expected = distance if 0 <= distance < 3.0 else 3.0
                assert got[i, j] == pytest.approx(expected, abs=1e-9)
                seen += expected < 3.0
        assert seen > 5000
        assert in_a_box >= 3 or not boxes

    def test_against_a_march(self):
        """Without ray arithmetic: walk along each ray until it is inside something."""
        position, yaw, heading, centres = scene(seed=1, num_envs=4)
        position = np.clip(position, -3.9, 3.9)
        got = navigation.ray_distances(TASK, position, heading, centres)
        steps = np.arange(0.0, 3.0, 0.002)
        for i in range(4):
            for j in range(136):
                angle = yaw[i] + math.radians(-135 + 2 * j)
                walk = position[i] + steps[:, None] * (math.cos(angle), math.sin(angle))
                inside = np.abs(walk).max(-1) >= 4.0
                for centre in centres[i]:
                    inside |= np.abs(walk - centre).max(-1) <= 0.25
                expected = steps[inside.argmax()] if inside.any() else 3.0
                # It can step over a corner.
                if abs(got[i, j] - expected) > 0.003:
                    assert got[i, j] < expected
                    x, y = position[i] + got[i, j] * np.array((math.cos(angle), math.sin(angle)))
                    corners = np.abs(np.abs(centres[i] - (x, y)) - 0.25).max(-1)
                    assert corners.min() < 0.003

    @pytest.mark.parametrize("heading", [(1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)])
    def test_along_the_axes(self, heading):
        """Rays exactly along a wall, and grazing nothing, stay finite."""
        task = NavigationTask(lidar_bins=8)  # 46 rays, 6 degrees apart: one of them at 45 degrees
        distance = navigation.ray_distances(
            task, np.zeros((1, 2)), np.array([heading]), np.array([[[1.0, 0.0], [0.0, -2.0]]])
        )
        assert np.isfinite(distance).all()
        assert distance.shape == (1, 46)

    def test_bins_average_eleven_rays(self):
        average = navigation._lidar(TASK).average
        rng = np.random.default_rng(0)
        rays = rng.uniform(0, 3, 136)
        expected = [sum(rays[5 * k : 5 * k + 11]) / 11 for k in range(26)]
        np.testing.assert_allclose(rays @ average, expected)

    def test_right_ahead_left(self):
        """A box to the left shows in the later bins; nothing behind is seen."""
        task, yaw = NavigationTask(wall_distance=50.0), 0.7
        for angle, expected in ((-math.pi / 2, 4), (0.0, 13), (math.pi / 2, 21), (math.pi, None)):
            box = np.array((math.cos(yaw + angle), math.sin(yaw + angle)))[None, None]
            heading = np.array([[math.cos(yaw), math.sin(yaw)]])
            distance = navigation.ray_distances(task, np.zeros((1, 2)), heading, box)
            bins = (distance @ navigation._lidar(task).average)[0]
            if expected is None:
                assert bins == pytest.approx(3.0)
            else:
                assert abs(bins.argmin() - expected) <= 1


class TestContact:
    def test_against_mujoco(self):
        position, yaw, heading, centres = scene(seed=2, num_envs=1500, boxes=3)
        # Near things, where it matters.
        position[:1000] = centres[:1000, 0] + np.random.default_rng(3).uniform(-0.7, 0.7, (1000, 2))
        got = navigation.contact(TASK, FOOTPRINT, position, heading, centres)
        model = room(3, FOOTPRINT)
        data = mujoco.MjData(model)
        for i in range(len(yaw)):
            if np.abs(position[i]).max() > 4.0:
                continue
            data.qpos[:2] = position[i]
            data.qpos[3], data.qpos[6] = math.cos(yaw[i] / 2), math.sin(yaw[i] / 2)
            data.mocap_pos[:, :2] = centres[i]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            assert got[i] == (data.ncon > 0), i
        assert 400 < got.sum() < 1100

    def test_against_points(self):
        """Overlap if some point of a fine grid over the robot is in a box or a wall."""
        position, _, heading, centres = scene(seed=4, num_envs=400, boxes=2)
        got = navigation.contact(TASK, FOOTPRINT, position, heading, centres)
        u, v = np.meshgrid(np.linspace(-1, 1, 60) * 0.229, np.linspace(-1, 1, 60) * 0.208)
        disagreements = 0
        for i in range(400):
            (c, s), (x, y) = heading[i], position[i]
            px, py = x + c * u - s * v, y + s * u + c * v
            inside = (np.abs(px) >= 4.0) | (np.abs(py) >= 4.0)
            for bx, by in centres[i]:
                inside |= (np.abs(px - bx) <= 0.25) & (np.abs(py - by) <= 0.25)
            assert got[i] >= inside.any()
            disagreements += got[i] != inside.any()
        assert disagreements <= 4  # a box's corner between two points of the grid

    def test_the_rectangle_holds_the_robot(self):
        """Everything of the model that is seen lies within the footprint, and touches it."""
        model = mujoco.MjModel.from_xml_path(str(JACKAL.asset_path))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        reach = np.zeros(2)
        for i in range(model.ngeom):
            if model.geom_group[i] < 3:
                rotation = data.geom_xmat[i].reshape(3, 3)
                half = np.abs(rotation) @ model.geom_aabb[i, 3:]
                reach = np.maximum(reach, np.abs(data.geom_xpos[i, :2]) + half[:2])
        np.testing.assert_allclose(reach, FOOTPRINT, atol=1e-9)
        assert JACKAL.footprint == FOOTPRINT


class TestLayout:
    def test_is_legal(self):
        n = 500
        goal, boxes = navigation.sample_layout(TASK, RandomStreams(0, n), np.arange(n))
        axis = [-2.25, -1.75, -1.25, -0.75, -0.25, 0.25, 0.75, 1.25, 1.75, 2.25]
        for points in (goal[:, None], boxes):
            assert np.isclose(points[..., None], axis).any(-1).all()
            assert (np.abs(points).max(-1) > 1.0).all()
        for i in range(n):
            assert len({tuple(box) for box in boxes[i].tolist()}) == 8
            assert min(math.dist(goal[i], box) for box in boxes[i]) > 0.7 + 0.25 * math.sqrt(2)

    def test_every_point_is_used(self):
        n = 2000
        goal, boxes = navigation.sample_layout(TASK, RandomStreams(1, n), np.arange(n))
        count = np.unique(boxes.reshape(-1, 2), axis=0, return_counts=True)[1]
        assert len(count) == 84
        # 16,000 boxes on 84 points, without replacement: 190 +- 13.
        assert abs(count - 16000 / 84).max() < 5 * 13.1
        assert len(np.unique(goal, axis=0)) == 84

    def test_does_not_depend_on_company(self):
        full = navigation.sample_layout(TASK, RandomStreams(5, 20), np.arange(20))
        for row in (7, 19):
            alone = navigation.sample_layout(TASK, RandomStreams(5, 20), np.array([row]))
            for x, y in zip(full, alone, strict=True):
                assert (x[row] == y[0]).all()

    def test_the_sequence_of_goals(self):
        n, rows = 300, np.arange(300)
        streams = RandomStreams(2, n)
        goal, boxes = navigation.sample_layout(TASK, streams, rows)
        for _ in range(5):
            following = navigation.sample_goal(TASK, goal, boxes, streams, rows)
            for i in range(n):
                assert math.dist(following[i], goal[i]) > 2.0
                nearest = min(math.dist(following[i], box) for box in boxes[i])
                assert nearest > 0.7 + 0.25 * math.sqrt(2)
            goal = following

    def test_crowded_layouts_are_redrawn_until_goals_can_follow(self):
        task = NavigationTask(num_boxes=14, goal_clearance=0.5)
        rows = np.arange(50)
        goal, boxes = navigation.sample_layout(task, RandomStreams(3, 50), rows)
        following = navigation.sample_goal(task, goal, boxes, RandomStreams(4, 50), rows)
        assert (np.linalg.norm(following - goal, axis=-1) > 2.0).all()

    def test_without_boxes(self):
        task = NavigationTask(num_boxes=0)
        goal, boxes = navigation.sample_layout(task, RandomStreams(0, 3), np.arange(3))
        assert boxes.shape == (3, 0, 2)
        assert np.isfinite(goal).all()


class TestCost:
    def test_proximity_against_the_formula(self):
        nearest = np.array([0.0, 0.3, 0.5, 0.7, 3.0])
        cost, violation = navigation.proximity_cost(TASK, nearest)
        for d, c in zip(nearest, cost, strict=True):
            assert c == pytest.approx(1 / (1 + math.exp(-10 * (0.5 - d))), rel=1e-12)
        assert violation.tolist() == [True, True, False, False, False]
        cost, _ = navigation.proximity_cost(NavigationTask(binary_cost=True), nearest)
        assert cost.tolist() == [1.0, 1.0, 0.0, 0.0, 0.0]

    def test_remaining_against_the_sum(self):
        steps = np.array([0, 1, 2, 57, 999])
        cost = navigation.remaining_cost(steps, 0.99)
        for n, c in zip(steps, cost, strict=True):
            assert c == pytest.approx(math.fsum(0.99**k for k in range(1, n + 1)), rel=1e-12)


class TestRobot:
    @pytest.mark.parametrize(
        ("velocity", "turn"), [(1.0, 0.0), (0.5, 0.5), (1.0, 1.0), (0.0, -1.0)]
    )
    def test_commands_are_tracked(self, velocity, turn):
        """Within 3 % after half a second, 15 steps."""
        env = make(1, task=NavigationTask(num_boxes=0, wall_distance=50.0))
        env.reset()
        for _ in range(15):
            step(env, (2 * velocity - 1, turn))
        for _ in range(15):
            before, following = env.layout(0), step(env, (2 * velocity - 1, turn))
            after = env.layout(0)
            sensed = following["observation"][0, 3:5].numpy() * 0.5
            np.testing.assert_allclose(sensed, (velocity, turn), atol=0.03)
            # What it senses is what it does.
            moved = math.dist(before["robot"], after["robot"]) / 0.032
            assert moved == pytest.approx(velocity, abs=0.03)
            (c, s), (x, y) = before["heading"], after["heading"]
            turned = math.atan2(c * y - s * x, c * x + s * y) / 0.032
            assert turned == pytest.approx(turn, abs=0.03)

    def test_yaw_answers_within_three_steps(self):
        env = make(1, task=NavigationTask(num_boxes=0))
        env.reset()
        for _ in range(3):
            following = step(env, (-1.0, 1.0))
        assert following["observation"][0, 4].item() * 0.5 == pytest.approx(1.0, abs=0.1)

    def test_four_skidding_wheels_would_not_do(self):
        """Why the Jackal stands on two: four driven wheels answer a yaw rate by a quarter of it."""
        spec = mujoco.MjSpec.from_file(str(JACKAL.asset_path))
        for caster in ("front", "rear"):
            spec.delete(spec.geom(caster))
        robot = spec.body("robot")
        for side, y in (("left", 0.188), ("right", -0.188)):
            spec.body(side).pos[0] = 0.131
            rear = robot.add_body(name=f"rear_{side}", pos=(-0.131, y, 0.098))
            rear.mass, rear.inertia, rear.explicitinertial = (
                0.954,
                (0.00242, 0.00458, 0.00242),
                True,
            )
            rear.add_joint(name=f"rear_{side}", axis=(0, 1, 0))
            rear.add_geom(size=(0.098, 0, 0), contype=1, friction=(1, 0.005, 0.0001))
            servo = spec.add_actuator(name=f"rear_{side}", target=f"rear_{side}")
            servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
            servo.set_to_velocity(kv=2.0)
        model = spec.compile()
        model.opt.timestep = JACKAL.timestep
        data = mujoco.MjData(model)
        rates = []
        for _ in range(60):
            wheels = JACKAL.control(
                np.array([(-1.0, 1.0)]), data.qpos[None], data.qvel[None], np.array([data.time])
            )[0]
            data.ctrl[:] = np.tile(wheels, 2)
            mujoco.mj_step(model, data, JACKAL.substeps)
            rates.append(data.qvel[5])
        assert np.mean(rates[20:]) < 0.5

    def test_never_goes_backwards(self):
        env = make(8, task=NavigationTask(num_boxes=0))
        env.reset()
        generator = torch.Generator().manual_seed(0)
        slowest = 0.0
        for _ in range(60):
            following = step(env, torch.rand(8, 2, generator=generator) * 2 - 1)
            slowest = min(slowest, following["observation"][:, 3].min().item() * 0.5)
        assert slowest > -0.1

    def test_stands_still(self):
        env = make(1)
        env.reset()
        for _ in range(30):
            step(env, STOP)
        np.testing.assert_allclose(env.layout(0)["robot"], 0.0, atol=1e-3)

    def test_masses_are_the_published_ones(self):
        model = mujoco.MjModel.from_xml_path(str(JACKAL.asset_path))
        assert model.body_mass.sum() == pytest.approx(16.5 + 4 * 0.477)


class TestEnv:
    def test_specs(self):
        env = make(3, episode_length=9)
        check_env_specs(env)
        assert env.observation_spec["observation"].shape == (3, 2 + 1 + 2 + 26)
        check_env_specs(make(2, task=NavigationTask(lidar_bins=12, num_boxes=0)))

    def test_starts_at_the_origin(self):
        env = make(50)
        env.reset()
        headings = np.array([env.layout(i)["heading"] for i in range(50)])
        assert all((env.layout(i)["robot"] == 0).all() for i in range(50))
        assert np.linalg.norm(headings.mean(0)) < 0.5

    def test_along_a_rollout(self):
        """Reward, cost, violations and termination from positions and a slow lidar."""
        n, horizon = 8, 200
        env = make(n, seed=1, episode_length=horizon)
        env.reset()
        before = [env.layout(i) for i in range(n)]
        over = [False] * n
        goals = violations = 0
        generator = torch.Generator().manual_seed(0)
        for t in range(1, horizon + 1):
            following = step(env, seek(env, generator))
            layouts = [env.layout(i) for i in range(n)]
            place = [np.stack([x[k] for x in layouts]) for k in ("robot", "heading", "boxes")]
            rays = navigation.ray_distances(TASK, *place)
            touches = navigation.contact(TASK, FOOTPRINT, *place)
            for i in range(n):
                after = layouts[i]
                old = math.dist(before[i]["goal"], before[i]["robot"])
                new = math.dist(before[i]["goal"], after["robot"])
                met = new <= 0.25
                assert following["reward"][i].item() == pytest.approx(old - new + met, abs=1e-6)
                assert following["goal_met"][i].item() == met
                assert (after["boxes"] == before[i]["boxes"]).all()
                if met:
                    assert math.dist(after["goal"], before[i]["goal"]) > 2.0
                else:
                    assert (after["goal"] == before[i]["goal"]).all()
                bins = [sum(rays[i, 5 * k : 5 * k + 11]) / 11 for k in range(26)]
                touching = bool(touches[i])
                left = (horizon - t) * touching
                cost = 1 / (1 + math.exp(-10 * (0.5 - min(bins))))
                cost += math.fsum(0.99**k for k in range(1, left + 1))
                count = int(min(bins) < 0.5 or touching) + left
                assert following["cost"][i].item() == pytest.approx(cost, rel=1e-5)
                assert following["violations"][i].item() == count
                assert following["violation"][i].item() == (count > 0)
                assert following["terminated"][i].item() == touching
                assert following["truncated"][i].item() == (t == horizon)
                assert following["done"][i].item() == (touching or t == horizon)
                goal = after["goal"] - after["robot"]
                observation = following["observation"][i].numpy()
                distance = min(np.linalg.norm(goal), 3.0)
                assert observation[2] == pytest.approx((distance - 1.5) / 0.6, abs=1e-5)
                direction = goal @ after["heading"] / np.linalg.norm(goal)
                assert observation[0] == pytest.approx(direction / 0.7, abs=1e-5)
                nearness = 1 - np.array(bins) / 3.0
                np.testing.assert_allclose(observation[5:], (nearness - 0.3) / 0.3, atol=1e-5)
                goals += met
                violations += count > 0
                over[i] |= touching
                before[i] = after
        assert goals >= 3
        assert violations >= 20
        assert 1 <= sum(over) < n

    def test_a_collision_ends_the_episode(self):
        env = make(1, episode_length=500)
        td = env.reset()
        state = env.state_dict()
        box = torch.tensor([1.2, 0.0])
        state["boxes"][0, 0] = box
        # Facing it: the quaternion of the free joint.
        state["physics"][0, 4:8] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        env.load_state_dict(state)
        steps, done = 0, False
        while not done:
            td["action"] = torch.tensor([AHEAD])
            stepped, td = env.step_and_maybe_reset(td)
            following, steps = stepped["next"], steps + 1
            done = following["done"].item()
            assert done or following["cost"].item() <= 1.0
        assert following["terminated"].item()
        assert not following["truncated"].item()
        expected = 0.99 * (1 - 0.99 ** (500 - steps)) / 0.01
        assert expected < following["cost"].item() <= expected + 1
        assert following["violations"].item() == 1 + 500 - steps
        # The episode after it starts at the origin, unharmed.
        assert (env.layout(0)["robot"] == 0).all()
        assert not td["terminated"].item()
        assert td["violations"].item() == 0

    def test_the_approach_costs_before_the_contact(self):
        env = make(1)
        env.reset()
        state = env.state_dict()
        state["boxes"][0, 0] = torch.tensor([1.2, 0.0])
        state["physics"][0, 4:8] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        env.load_state_dict(state)
        costs, violations = [], []
        while not (following := step(env, AHEAD))["done"].item():
            costs.append(following["cost"].item())
            violations.append(following["violation"].item())
        assert costs[0] < 0.1
        assert max(costs) > 0.5
        assert any(violations)
        assert not violations[0]

    def test_a_diverging_robot_is_truncated_and_counted(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
        env = make(3)
        env.reset()
        step(env, AHEAD)
        layout, state = env.layout(1), env.state_dict()
        state["physics"][1, 1 + 9 :][:3] = 1e12  # time, positions, then velocities
        env.load_state_dict(state)
        following = step(env, AHEAD)
        assert env.instabilities == 1
        assert following["truncated"].flatten().tolist() == [False, True, False]
        assert not following["terminated"].any()
        assert following["reward"][1] == 0.0
        assert all((env.layout(1)[name] == value).all() for name, value in layout.items())
        for leaf in ("observation", "reward", "cost"):
            assert following[leaf].isfinite().all()

    def test_threads(self):
        controls = torch.rand(40, 5, 2, generator=torch.Generator().manual_seed(0)) * 2 - 1
        rollouts = []
        for num_threads in (1, 2):
            env = make(5, num_threads, episode_length=25)
            td, steps = env.reset(), []
            for control in controls:
                td["action"] = control.clone()
                stepped, td = env.step_and_maybe_reset(td)
                steps.append(stepped)
            rollouts.append(torch.stack(steps))
        assert (rollouts[0] == rollouts[1]).all()

    def test_resumes_exactly(self):
        env = make(3)
        env.reset()
        for _ in range(10):
            step(env, (0.5, 0.3))
        saved = env.state_dict()
        copy = pickle.loads(pickle.dumps(env))
        expected = torch.stack([step(env, (0.2, -0.5)) for _ in range(20)])
        other = make(3, seed=9)
        other.reset()
        other.load_state_dict(saved)
        for resumed in (other, copy):
            again = torch.stack([step(resumed, (0.2, -0.5)) for _ in range(20)])
            assert (again == expected).all()


def seek(env: SafeRobotEnv, generator: torch.Generator) -> torch.Tensor:
    """Turns to the goal and drives at it, boxes or not."""
    out = torch.zeros(*env.batch_size, 2)
    for i in range(len(out)):
        layout = env.layout(i)
        x, y = layout["goal"] - layout["robot"]
        angle = math.atan2(layout["heading"] @ (y, -x), layout["heading"] @ (x, y))
        out[i, 0] = 1.0 if abs(angle) < 0.7 else -0.8
        out[i, 1] = np.clip(2 * angle, -1, 1)
    return out + 0.1 * torch.randn(out.shape, generator=generator)


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "error", "match"),
        [
            ({"num_boxes": 2.5}, TypeError, "num_boxes must be an int, got 2.5"),
            ({"num_boxes": -1}, ValueError, "num_boxes must be at least 0, got -1"),
            ({"lidar_bins": 0}, ValueError, "lidar_bins must be at least 1, got 0"),
            ({"cost_slope": math.inf}, ValueError, "cost_slope must be positive and finite"),
            ({"binary_cost": 1}, TypeError, "binary_cost must be a bool, got 1"),
            ({"discount": 1.0}, ValueError, r"discount must be in \(0, 1\), got 1.0"),
            ({"wall_distance": 2.4}, ValueError, "wall_distance must be larger than .* 2.5"),
        ],
    )
    def test_options(self, options, error, match):
        with pytest.raises(error, match=match):
            NavigationTask(**options)

    @pytest.mark.parametrize(
        ("options", "match"),
        [
            ({"num_boxes": 84}, "84 boxes and a goal need more than 84 points: use fewer"),
            ({"num_boxes": 40}, "no legal layout found in 200 attempts .* use fewer"),
            ({"goal_spacing": 9.0}, "no legal layout found"),
            ({"start_clearance": 0.5}, "start_clearance must be at least .* 0.65, got 0.5"),
        ],
    )
    def test_impossible_layouts(self, options, match):
        with pytest.raises(ValueError, match=match):
            make(2, task=NavigationTask(**options))

    def test_robot_without_a_footprint(self):
        with pytest.raises(ValueError, match="'point' has no footprint"):
            SafeRobotEnv("point", num_envs=2, task=NavigationTask())


def test_observation_against_a_loop():
    rng = np.random.default_rng(0)
    position, yaw, heading, _ = scene(num_envs=20)
    motion = Motion(position, heading, rng.uniform(-1, 1, (20, 2)))
    goal, scan = rng.uniform(-2, 2, (20, 2)), rng.uniform(0, 1, (20, 136))
    observation = TASK.observe(JACKAL, motion, {"goal": goal}, scan)
    for i in range(20):
        x, y = goal[i] - position[i]
        angle = math.atan2(y, x) - yaw[i]
        expected = [
            math.cos(angle) / 0.7,
            math.sin(angle) / 0.7,
            (min(math.hypot(x, y), 3.0) - 1.5) / 0.6,
            *(motion.proprioception[i] / 0.5),
            *((scan[i, 5 * k : 5 * k + 11].mean() - 0.3) / 0.3 for k in range(26)),
        ]
        np.testing.assert_allclose(observation[i], expected, atol=1e-5)
