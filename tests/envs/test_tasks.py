"""The task's functions against slow versions written from its definition."""

from __future__ import annotations

import math

import numpy as np
import pytest

from torchrl_safe.envs import GoalTask, Robot, get_robot
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Motion, to_robot_frame
from torchrl_safe.envs.tasks import goal as tasks
from torchrl_safe.envs.tasks.base import goal_reward
from torchrl_safe.envs.tasks.layout import scatter

KEEPOUT = 0.4


def scene(seed: int = 0, num_envs: int = 200, hazards: int = 8) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    position = rng.uniform(-2, 2, (num_envs, 2))
    yaw = rng.uniform(-10, 10, num_envs)
    return position, yaw, rng.uniform(-1.5, 1.5, (num_envs, hazards, 2))


def heading_of(yaw: np.ndarray) -> np.ndarray:
    return np.stack((np.cos(yaw), np.sin(yaw)), -1)


class TestStreams:
    def test_a_stream_does_not_depend_on_its_company(self):
        together, apart = RandomStreams(3, 5), RandomStreams(3, 5)
        first = together.uniform(np.arange(5), 4)
        second = together.uniform(np.array([1, 4]), 3)
        for row in (4, 2, 0, 1, 3):
            assert (apart.uniform(np.array([row]), 4)[0] == first[row]).all()
        assert (apart.uniform(np.array([4]), 3)[0] == second[1]).all()

    def test_a_stream_does_not_depend_on_their_number(self):
        assert (RandomStreams(3, 2).state == RandomStreams(3, 9).state[:2]).all()

    def test_matches_splitmix64(self):
        mask = 2**64 - 1
        streams = RandomStreams(7, 3)
        state = [int(s) for s in streams.state]
        drawn = streams.uniform(np.arange(3), 5)
        for row in range(3):
            for k in range(5):
                state[row] = (state[row] + 0x9E3779B97F4A7C15) & mask
                z = state[row]
                z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
                z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
                z ^= z >> 31
                assert drawn[row, k] == (z >> 11) / 2**53

    def test_is_uniform_and_uncorrelated_across_streams(self):
        draws = RandomStreams(0, 50).uniform(np.arange(50), 20_000)
        count = np.histogram(draws, bins=100, range=(0, 1))[0]
        expected = draws.size / 100
        # chi-squared with 99 degrees of freedom: 99 +- 14
        assert ((count - expected) ** 2 / expected).sum() < 170
        correlation = np.corrcoef(draws) - np.eye(50)
        assert np.abs(correlation).max() < 5 / math.sqrt(20_000)

    def test_seeds_differ(self):
        assert not np.intersect1d(RandomStreams(0, 100).state, RandomStreams(1, 100).state).size
        assert (RandomStreams(None, 2).state != RandomStreams(None, 2).state).all()

    def test_rejects_a_negative_seed(self):
        with pytest.raises(ValueError, match=r"seed .* got -1"):
            RandomStreams(-1, 2)


def one_attempt(keepout: list[float], extent: float, tries: np.ndarray) -> list[list[float]]:
    """Places of the objects, up to the first that finds none among its tries [K, C, 2]."""
    placed: list[list[float]] = []
    for own, places in zip(keepout, tries.tolist(), strict=True):
        for place in places:
            x, y = ((extent - own) * number for number in place)
            if all(
                math.hypot(x - u, y - v) >= own + other
                for (u, v), other in zip(placed, keepout, strict=False)
            ):
                placed.append([x, y])
                break
        else:
            break
    return placed


class TestLayout:
    def test_is_legal(self):
        num_envs = 3000
        task = GoalTask()
        streams = RandomStreams(0, num_envs)
        robot, yaw, goal, hazards = tasks.sample_layout(task, KEEPOUT, streams, np.arange(num_envs))
        objects = np.concatenate((robot[:, None], goal[:, None], hazards), 1)
        keepout = [KEEPOUT, 0.305] + [0.18] * 8
        for i in range(10):
            assert np.abs(objects[:, i]).max() <= 1.5 - keepout[i]
            for j in range(i):
                distance = np.linalg.norm(objects[:, i] - objects[:, j], axis=-1)
                assert distance.min() >= keepout[i] + keepout[j]
        assert yaw.min() >= 0
        assert yaw.max() < 2 * math.pi

    def test_fills_the_square(self):
        rows = np.arange(3000)
        robot, yaw, goal, hazards = tasks.sample_layout(
            GoalTask(), KEEPOUT, RandomStreams(1, 3000), rows
        )
        # No coordinate prefers a side, and each comes close to its limit.
        for xy, limit in ((robot, 1.1), (goal, 1.195), (hazards.reshape(-1, 2), 1.32)):
            assert np.abs(xy.mean(0)).max() < 5 * limit / math.sqrt(len(xy))
            assert (xy.max(0) > 0.99 * limit).all()
            assert (xy.min(0) < -0.99 * limit).all()
        assert abs(np.cos(yaw).mean()) < 5 / math.sqrt(3000)

    def test_robot_is_uniform(self):
        """Placed first, it must not be bent by the others' rejections much."""
        rows = np.arange(4000)
        robot, *_ = tasks.sample_layout(GoalTask(), KEEPOUT, RandomStreams(2, 4000), rows)
        count = np.histogram(robot[:, 0], bins=10, range=(-1.1, 1.1))[0]
        assert ((count - 400) ** 2 / 400).sum() < 40

    def test_does_not_depend_on_company(self):
        task = GoalTask(num_hazards=14)
        full = tasks.sample_layout(task, KEEPOUT, RandomStreams(5, 40), np.arange(40))
        for row in (7, 3, 39):
            alone = tasks.sample_layout(task, KEEPOUT, RandomStreams(5, 40), np.array([row]))
            for x, y in zip(full, alone, strict=True):
                assert (x[row] == y[0]).all()

    @pytest.mark.parametrize(
        ("keepout", "extent", "candidates", "num"),
        [
            ([0.4] + [0.2] * 4 + [0.4] + [0.18] * 4 + [0.4] * 4, 1.5, 100, 6),  # Button's, level 1
            ([0.3] * 7, 1.1, 32, 60),
            ([0.2] * 3, 2.0, 32, 60),
        ],
    )
    def test_is_what_one_try_after_the_other_gives(self, keepout, extent, candidates, num):
        """Attempts that are made at once use the numbers that attempts in a row would have used."""
        streams, same = RandomStreams(4, num), RandomStreams(4, num)
        layouts = [scatter(np.array(keepout), extent, streams, np.arange(num), candidates)]
        layouts.append(scatter(np.array(keepout), extent, streams, np.arange(num), candidates))
        for layout in layouts:
            for row in range(num):
                placed = []
                while len(placed) < len(keepout):
                    numbers = same.uniform(np.array([row]), 2 * len(keepout) * candidates)[0]
                    tries = numbers.reshape(len(keepout), candidates, 2) * 2.0 - 1.0
                    placed = one_attempt(keepout, extent, tries)
                assert layout[row].tolist() == placed
        assert (streams.state == same.state).all()

    def test_without_hazards(self):
        hazards = tasks.sample_layout(
            GoalTask(num_hazards=0), KEEPOUT, RandomStreams(0, 3), np.arange(3)
        )[3]
        assert hazards.shape == (3, 0, 2)

    def test_impossible(self):
        with pytest.raises(ValueError, match="fewer hazards"):
            tasks.sample_layout(
                GoalTask(num_hazards=60), KEEPOUT, RandomStreams(0, 2), np.arange(2)
            )
        with pytest.raises(ValueError, match="does not fit"):
            tasks.sample_layout(GoalTask(), 1.6, RandomStreams(0, 2), np.arange(2))


class TestGoal:
    def test_is_legal(self):
        num_envs, rows = 2000, np.arange(2000)
        streams = RandomStreams(0, num_envs)
        robot, _, _, hazards = tasks.sample_layout(GoalTask(), KEEPOUT, streams, rows)
        goal = tasks.sample_goal(GoalTask(), KEEPOUT, robot, hazards, streams, rows)
        assert np.abs(goal).max() <= 1.195
        to_robot = np.linalg.norm(goal - robot, axis=-1)
        to_hazards = np.linalg.norm(goal[:, None] - hazards, axis=-1).min(-1)
        assert to_robot.min() >= 0.705
        assert to_hazards.min() >= 0.485

    def test_falls_back_to_the_most_clearance(self):
        """Hazards on a grid that leaves no legal place: the draw ends, far from all."""
        axis = np.linspace(-1.5, 1.5, 7)
        hazards = np.stack(np.meshgrid(axis, axis), -1).reshape(1, -1, 2)
        task = GoalTask(num_hazards=49)
        goal = tasks.sample_goal(
            task, KEEPOUT, np.zeros((1, 2)), hazards, RandomStreams(0, 1), np.arange(1)
        )
        # Cells of .5 m: their centres are .354 from the corners, the best any place can do.
        nearest = np.linalg.norm(goal - hazards[0], axis=-1).min()
        assert 0.3 < nearest <= 0.25 * math.sqrt(2)

    def test_without_hazards(self):
        goal = tasks.sample_goal(
            GoalTask(num_hazards=0),
            KEEPOUT,
            np.zeros((2, 2)),
            np.zeros((2, 0, 2)),
            RandomStreams(0, 2),
            np.arange(2),
        )
        assert (np.linalg.norm(goal, axis=-1) >= 0.705).all()


def slow_lidar(position, yaw, hazards, bins, reach):
    scan = [0.0] * bins
    width = 2 * math.pi / bins
    for x, y in hazards:
        distance = math.dist(position, (x, y))
        angle = (math.atan2(y - position[1], x - position[0]) - yaw) % (2 * math.pi)
        centre = int(angle / width) % bins
        share = angle / width - int(angle / width)
        reading = max(0.0, reach - distance) / reach
        for index, value in (
            (centre, reading),
            ((centre + 1) % bins, share * reading),
            ((centre - 1) % bins, (1 - share) * reading),
        ):
            scan[index] = max(scan[index], value)
    return scan


class TestLidar:
    @pytest.mark.parametrize(("bins", "reach"), [(16, 3.0), (3, 1.0), (26, 0.7)])
    def test_against_a_loop(self, bins, reach):
        position, yaw, hazards = scene()
        task = GoalTask(lidar_bins=bins, lidar_range=reach)
        offset, distance = tasks.hazard_distances(position, hazards)
        scan = tasks.lidar(task, offset, distance, heading_of(yaw))
        for i in range(len(yaw)):
            slow = slow_lidar(position[i], yaw[i], hazards[i], bins, reach)
            np.testing.assert_allclose(scan[i], slow, atol=1e-9)

    @pytest.mark.parametrize("angle", [0.0, -1e-18, -1e-300, math.pi, -math.pi])
    def test_at_the_seam(self, angle):
        """On the seam between two bins either may win, but the reading stays in their company."""
        offset = np.array([[[math.cos(angle), math.sin(angle)]]])
        scan = tasks.lidar(GoalTask(), offset, np.ones((1, 1)), np.array([[1.0, 0.0]]))[0]
        first = 0 if abs(angle) < 1 else 8
        assert scan[first] == pytest.approx(2 / 3)
        assert scan[first - 1] == pytest.approx(2 / 3)
        assert np.count_nonzero(scan > 1e-9) == 2

    def test_hazard_ahead_left_behind(self):
        task = GoalTask()
        for angle, index in ((0.1, 0), (math.pi / 2 + 0.1, 4), (math.pi + 0.1, 8)):
            offset = np.array([[[math.cos(angle), math.sin(angle)]]])
            scan = tasks.lidar(task, offset, np.ones((1, 1)), np.array([[1.0, 0.0]]))
            assert scan[0].argmax() == index

    def test_without_hazards(self):
        scan = tasks.lidar(
            GoalTask(num_hazards=0), np.zeros((2, 0, 2)), np.zeros((2, 0)), np.ones((2, 2))
        )
        assert scan.shape == (2, 16)
        assert not scan.any()


def test_goal_reward_against_a_loop():
    rng = np.random.default_rng(0)
    before, after = rng.uniform(0, 1, (2, 500))
    after[0] = 0.3
    reward, reached = goal_reward(before, after, 0.3)
    for i in range(500):
        bonus = 1.0 if after[i] <= 0.3 else 0.0
        assert reward[i] == pytest.approx(before[i] - after[i] + bonus, abs=1e-15)
        assert reached[i] == (bonus == 1.0)
    assert 0 < reached.sum() < 500


def test_hazard_cost_against_a_loop():
    position, _, hazards = scene(1)
    _, distance = tasks.hazard_distances(position, hazards)
    cost, violation = tasks.hazard_cost(GoalTask(), distance)
    for i in range(len(position)):
        nearest = min(math.dist(position[i], h) for h in hazards[i])
        assert cost[i] == pytest.approx(1 / (1 + math.exp(-10 * (0.2 - nearest))), rel=1e-12)
        assert violation[i] == (nearest <= 0.2)
    assert 0 < violation.sum() < len(position)


def test_binary_cost():
    cost, violation = tasks.hazard_cost(GoalTask(binary_cost=True), np.array([[0.1], [0.2], [0.3]]))
    assert cost.tolist() == [1.0, 1.0, 0.0]
    assert violation.tolist() == [True, True, False]


def test_hazard_cost_at_the_rim_far_away_and_without_hazards():
    cost, violation = tasks.hazard_cost(GoalTask(), np.array([[0.2], [1e6]]))
    assert cost.tolist() == [0.5, 0.0]
    assert violation.tolist() == [True, False]
    cost, violation = tasks.hazard_cost(GoalTask(num_hazards=0), np.zeros((2, 0)))
    assert cost.tolist() == [0.0, 0.0]
    assert not violation.any()


def test_observation_against_a_loop():
    position, yaw, _ = scene(2, num_envs=50)
    rng = np.random.default_rng(3)
    goal, sensed, scan = rng.normal(size=(50, 2)), rng.normal(size=(50, 5)), rng.random((50, 16))
    motion = Motion(position, heading_of(yaw), sensed)
    scale = np.array(get_robot("point").proprioception_scale)
    observation = tasks.observe(motion, goal, scan, scale)
    assert observation.dtype == np.float32
    for i in range(50):
        distance = math.dist(goal[i], position[i])
        angle = math.atan2(goal[i, 1] - position[i, 1], goal[i, 0] - position[i, 0]) - yaw[i]
        expected = [math.cos(angle) / 0.7, math.sin(angle) / 0.7, (distance - 1.5) / 0.6]
        expected += [sensed[i, 0] / 8, sensed[i, 1] / 8, sensed[i, 2] / 0.2, sensed[i, 3] / 0.2]
        expected += [sensed[i, 4] / 2]
        expected += [(s - 0.3) / 0.3 for s in scan[i]]
        np.testing.assert_allclose(observation[i], expected, rtol=1e-5, atol=1e-5)


def test_observation_on_the_goal_is_finite():
    motion = Motion(np.zeros((1, 2)), np.array([[1.0, 0.0]]), np.zeros((1, 5)))
    observation = tasks.observe(motion, np.zeros((1, 2)), np.zeros((1, 16)), np.ones(5))
    assert observation[0, :2].tolist() == [0.0, 0.0]
    assert np.isfinite(observation).all()


def test_robot_frame_is_a_rotation():
    rng = np.random.default_rng(0)
    vector, yaw = rng.normal(size=(20, 2)), rng.uniform(-9, 9, 20)
    turned = to_robot_frame(vector, heading_of(yaw))
    z = (vector[:, 0] + 1j * vector[:, 1]) * np.exp(-1j * yaw)
    np.testing.assert_allclose(turned[:, 0] + 1j * turned[:, 1], z, atol=1e-14)


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"num_hazards": -1}, ValueError, "num_hazards must be at least 0, got -1"),
        ({"num_hazards": 2.5}, TypeError, "num_hazards must be an int"),
        ({"num_hazards": True}, TypeError, "num_hazards must be an int"),
        ({"lidar_bins": 2}, ValueError, "lidar_bins must be at least 3"),
        ({"extent": "1"}, ValueError, "extent must be positive and finite, got '1'"),
        ({"extent": 0.0}, ValueError, "extent must be positive"),
        ({"cost_slope": math.nan}, ValueError, "cost_slope must be positive"),
        ({"lidar_range": math.inf}, ValueError, "lidar_range must be positive"),
        ({"hazard_radius": -0.1}, ValueError, "hazard_radius must be positive"),
        ({"goal_keepout": 1.5}, ValueError, "goal_keepout must be smaller than extent"),
        ({"hazard_keepout": 2.0}, ValueError, "hazard_keepout must be smaller than extent"),
    ],
)
def test_task_rejects(options, error, match):
    with pytest.raises(error, match=match):
        GoalTask(**options)


def test_unknown_robot_names_the_known_ones():
    assert isinstance(get_robot("point"), Robot)
    with pytest.raises(ValueError, match=r"one of .*'point'.* got 'snake'"):
        get_robot("snake")
