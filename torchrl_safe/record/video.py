"""A video of a policy at work."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_safe._extras import need
from torchrl_safe._files import expand, replacing
from torchrl_safe.record.metrics import acting

__all__ = ["record_video"]


def record_video(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    path: str | os.PathLike[str],
    *,
    num_steps: int = 1_000,
    every: int = 2,
    fps: float = 25,
    width: int = 480,
    height: int = 360,
    index: int | Sequence[int] = 0,
    exploration_type: ExplorationType = ExplorationType.DETERMINISTIC,
    seed: int | None = None,
) -> Path:
    """Plays one episode and writes it as an mp4 (H.264, yuv420p) that browsers play.

    The file appears whole or not at all. Pass an environment made for this, never the
    collector's (see :func:`~torchrl_safe.record.evaluate`), best with no more environments than
    are filmed: all of a batch step. Several are shown in a grid. The video ends when all filmed
    episodes have; one that ended earlier keeps its last picture.

    Args:
        env (EnvBase): with ``render(index=..., width=..., height=...)`` that returns a uint8
            array [height, width, 3]. Or of Gymnasium, made with ``render_mode="rgb_array"``: its
            pictures are scaled to fit.
        policy (callable): from tensordict to tensordict with the action.
        path (path): the ``.mp4`` to write. Missing parent directories are made.

    Keyword Args:
        num_steps (int): most steps to play. Defaults to 1,000.
        every (int): film the state before every ``every``-th step. Defaults to 2.
        fps (float): frames per second of playback; ``1 / (every * seconds per step)`` is real
            time. Defaults to 25, real time for steps of 0.02 s.
        width (int): pixels, even. Defaults to 480.
        height (int): pixels, even. Defaults to 360.
        index (int or sequence of int): the environments to film. Defaults to 0.
        exploration_type (ExplorationType): how the policy picks its action. Defaults to
            ``DETERMINISTIC``.
        seed (int, optional): seed of the environment, and of sampled actions.

    Returns:
        Path: the video.

    Raises:
        ValueError: if an argument is out of range, before the environment is touched.
        RuntimeError: if the environment cannot render here, for example without OpenGL.

    Examples:
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=1, num_threads=1)
        >>> # Needs OpenGL, so it is not run as a test.
        >>> record_video(env, env.rand_action, "point.mp4")  # doctest: +SKIP
        PosixPath('point.mp4')
    """
    path = expand(path)
    if path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4, got {str(path)!r}.")
    for name, value in (("num_steps", num_steps), ("every", every), ("fps", fps)):
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}.")
    for name, value in (("width", width), ("height", height)):
        if value < 2 or value % 2:
            raise ValueError(f"{name} must be a positive even number (yuv420p), got {value}.")
    filmed = [index] if isinstance(index, int) else list(index)
    if not filmed:
        raise ValueError("index must name at least one environment, got none.")
    for i in filmed:
        if not 0 <= i < env.batch_size.numel():
            raise ValueError(f"index must be in [0, {env.batch_size.numel()}), got {i}.")

    def pictures(indices: Sequence[int]) -> dict[int, np.ndarray]:
        try:
            images = _render(env, indices, width, height)
            for image in images.values():
                if image.shape != (height, width, 3) or image.dtype != np.uint8:
                    raise ValueError(
                        f"got {image.dtype} {image.shape}, not uint8 [height, width, 3]"
                    )
            return images
        except Exception as error:
            raise RuntimeError(
                f"the environment could not render ({type(error).__name__}: {error}); without a "
                "display, MUJOCO_GL=egl or MUJOCO_GL=osmesa renders off screen where installed."
            ) from error

    need("a video", "train", "imageio", "imageio_ffmpeg")
    import imageio.v2 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        # macro_block_size: even sizes are kept as they are; faststart: plays while it loads.
        writer = imageio.get_writer(
            draft,
            format="FFMPEG",
            fps=fps,
            codec="libx264",
            pixelformat="yuv420p",
            macro_block_size=2,
            output_params=["-movflags", "+faststart"],
        )
        with acting(exploration_type), closing(writer):
            if seed is not None:
                env.set_seed(seed)
                torch.manual_seed(seed)
            td = env.reset()
            tiles: dict[int, np.ndarray] = {}
            running = set(filmed)
            for step in range(num_steps):
                if step % every == 0:
                    tiles |= pictures([i for i in filmed if i in running])
                    writer.append_data(_grid([tiles[i] for i in filmed]))
                stepped, td = env.step_and_maybe_reset(policy(td))
                done = stepped["next", "done"].flatten()
                running -= {i for i in running if done[i]}
                if not running:
                    break
    return path


def _render(env: EnvBase, indices: Sequence[int], width: int, height: int) -> dict[int, np.ndarray]:
    if "index" in inspect.signature(env.render).parameters:
        return {i: env.render(index=i, width=width, height=height) for i in indices}
    drawn: Any = env.render()  # of a batch, a list
    if not isinstance(drawn, list | tuple):
        drawn = [drawn]
    return {i: _fitted(np.asarray(drawn[i]), width, height) for i in indices}


def _fitted(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture in the middle of a white one of another size."""
    scale = min(height / image.shape[0], width / image.shape[1])
    rows, columns = ((np.arange(int(scale * size)) / scale).astype(int) for size in image.shape[:2])
    fitted = np.full((height, width, 3), 255, image.dtype)
    top, left = (height - len(rows)) // 2, (width - len(columns)) // 2
    fitted[top : top + len(rows), left : left + len(columns)] = image[rows][:, columns]
    return fitted


def _grid(tiles: list[np.ndarray]) -> np.ndarray:
    """Pictures [h, w, 3] side by side, in lines of equal length; what is left over is white."""
    columns = math.ceil(math.sqrt(len(tiles)))
    blank = [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    tiles = tiles + blank
    lines = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return np.vstack(lines)
