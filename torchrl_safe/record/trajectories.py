"""Where a robot went: paths over the map of its hazards."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_safe._extras import need
from torchrl_safe._files import expand, replacing
from torchrl_safe.record.metrics import acting

__all__ = ["Trajectory", "plot_trajectories", "record_trajectories"]


class Trajectory(TypedDict):
    """One episode seen from above, in metres.

    Attributes:
        path: positions of the robot, ``[T + 1, 2]``.
        goals: the goals it was sent to, in order, ``[G, 2]``; none in a task without.
        hazards: centres of the hazards, ``[H, 2]``; none in a task without.
        boxes: centres of the boxes, ``[B, 2]``; none in a task without.
        violation: for each position, whether it violates there, ``[T + 1]``.
    """

    path: NDArray[np.float64]
    goals: NDArray[np.float64]
    hazards: NDArray[np.float64]
    boxes: NDArray[np.float64]
    violation: NDArray[np.bool_]


def record_trajectories(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    num_steps: int = 1_000,
    num_episodes: int = 9,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    seed: int | None = None,
) -> list[Trajectory]:
    """Plays one episode in the first environments of a batch and keeps where the robots went.

    Args:
        env (EnvBase): batch size [N], writes ``violation``, and has ``layout(index)`` that returns
            ``robot`` [2] and, where there are any, ``goal`` [2], ``hazards`` [H, 2] and ``boxes``
            [B, 2], as :class:`~torchrl_safe.envs.SafeRobotEnv` does. Not the collector's, see
            :func:`~torchrl_safe.record.evaluate`.
        policy (callable): from tensordict to tensordict with the action.

    Keyword Args:
        num_steps (int): most steps per episode. Defaults to 1,000.
        num_episodes (int): episodes kept, at most N. Defaults to 9.
        exploration_type (ExplorationType): how the policy picks its action. Defaults to
            ``DETERMINISTIC``.
        seed (int, optional): seed of the environments; with that of
            :func:`~torchrl_safe.record.evaluate` the layouts are those that were evaluated.

    Returns:
        list of Trajectory: one per episode, up to its end.

    Raises:
        TypeError: if the environment has no ``layout``: there is no map to draw then.
        ValueError: if a number is out of range.

    Examples:
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> (first,) = record_trajectories(env, env.rand_action, num_steps=5, num_episodes=1)
        >>> first["path"].shape, first["hazards"].shape
        ((6, 2), (8, 2))
    """
    if not callable(getattr(env, "layout", None)):
        raise TypeError(
            "env must have layout(index), which says where things are, as SafeRobotEnv does, got "
            f"{type(env).__name__}."
        )
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1, got {num_steps}.")
    if not 1 <= num_episodes <= env.batch_size.numel():
        raise ValueError(
            f"num_episodes must be in [1, {env.batch_size.numel()}], got {num_episodes}."
        )
    rows: list[list[dict[str, NDArray[np.float64]]]] = [[] for _ in range(num_episodes)]
    inside: list[list[bool]] = [[] for _ in range(num_episodes)]
    running = [True] * num_episodes

    def see(td: TensorDictBase) -> None:
        violation = td["violation"].flatten().tolist()
        for index in range(num_episodes):
            if running[index]:
                rows[index].append(env.layout(index))
                inside[index].append(violation[index])

    with acting(exploration_type):
        if seed is not None:
            env.set_seed(seed)
        td = env.reset()
        see(td)
        for _ in range(num_steps):
            stepped, td = env.step_and_maybe_reset(policy(td))
            # What a reset replaced is the next episode's.
            done = stepped["next", "done"].flatten().tolist()
            running = [going and not done[index] for index, going in enumerate(running)]
            see(td)
            if not any(running):
                break
    return [
        Trajectory(
            path=np.stack([layout["robot"] for layout in layouts]),
            goals=_changes([layout["goal"] for layout in layouts if "goal" in layout]),
            hazards=layouts[0].get("hazards", np.empty((0, 2))),
            boxes=layouts[0].get("boxes", np.empty((0, 2))),
            violation=np.array(flags),
        )
        for layouts, flags in zip(rows, inside, strict=True)
    ]


def plot_trajectories(
    trajectories: Sequence[Trajectory],
    path: str | os.PathLike[str],
    *,
    hazard_radius: float = 0.2,
    goal_radius: float = 0.3,
    box_half_size: float = 0.25,
) -> Path:
    """Draws each trajectory over its hazards, boxes and goals; steps that violate are red.

    Args:
        trajectories (sequence of Trajectory): at least one.
        path (path): the picture; its suffix picks the format. Missing parents are made.

    Keyword Args:
        hazard_radius (float): metres. Defaults to 0.2.
        goal_radius (float): metres. Defaults to 0.3.
        box_half_size (float): half the side of a box, metres. Defaults to 0.25.

    Returns:
        Path: the picture.

    Raises:
        ValueError: if there is no trajectory.

    Examples:
        >>> import tempfile
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> trajectories = record_trajectories(env, env.rand_action, num_steps=5, num_episodes=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_trajectories(trajectories, f"{folder}/trajectories.png").name
        'trajectories.png'
    """
    if not trajectories:
        raise ValueError("trajectories must hold at least one, got none.")
    need("a plot", "train", "matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Rectangle

    columns = math.ceil(math.sqrt(len(trajectories)))
    lines = math.ceil(len(trajectories) / columns)
    figure = Figure(figsize=(3.2 * columns, 3.2 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False).flatten()
    for axes in grid[len(trajectories) :]:
        axes.set_axis_off()
    for axes, trajectory in zip(grid, trajectories, strict=False):
        for centre in trajectory["hazards"]:
            axes.add_patch(Circle(centre, hazard_radius, color="#56B4E9", alpha=0.5, lw=0))
        for centre in trajectory["boxes"]:
            side = 2 * box_half_size
            axes.add_patch(
                Rectangle(centre - box_half_size, side, side, color="#56B4E9", alpha=0.9, lw=0)
            )
        for number, centre in enumerate(trajectory["goals"], 1):
            axes.add_patch(Circle(centre, goal_radius, color="#009E73", alpha=0.25, lw=0))
            axes.annotate(str(number), centre, color="#009E73", ha="center", va="center")
        x, y = trajectory["path"].T
        axes.plot(x, y, color="#333333", lw=1)
        axes.plot(x[0], y[0], marker="s", color="#333333", ms=5)
        inside = trajectory["violation"]
        axes.plot(x[inside], y[inside], ".", color="#D55E00", ms=4)
        title = f"violations {inside.sum()}"
        if len(trajectory["goals"]):
            title = f"goals {len(trajectory['goals']) - 1}, {title}"
        axes.set_title(title, fontsize=9)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    path = expand(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        figure.savefig(draft, dpi=120)
    return path


def _changes(places: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Those of T places [2] that differ from the one before, and the first, [G, 2]."""
    points = np.array(places).reshape(-1, 2)
    new = np.ones(len(points), bool)
    new[1:] = (points[1:] != points[:-1]).any(-1)
    return points[new]
