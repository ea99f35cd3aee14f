"""How long a film of each robot takes to draw and encode, beside how long it lasts.

``python benchmarks/video_speed.py``: 480 x 360, in real time, headless (``MUJOCO_GL=egl``), the
simulation included. Processor time, too, as the clock on the wall measures what else the machine
does.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

import torch

from torchrl_safe.envs import ROBOTS, SafeGoalEnv
from torchrl_safe.record import record_video

torch.set_num_threads(1)

PICTURES = 25.0  # a second, about: some robots do not take as many steps


def used() -> float:
    """Processor time, that of the encoder's finished process included."""
    return sum(os.times()[:4])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=list(ROBOTS), help="default: all")
    parser.add_argument("--seconds", type=float, default=8.0, help="of film")
    options = parser.parse_args()
    print("| Robot | Pictures/s | Film, s | Made in, s | Processor time, s | of it per picture |")
    print("|---|---:|---:|---:|---:|---:|")
    for name in options.robots:
        step = ROBOTS[name].timestep * ROBOTS[name].substeps
        every = max(round(1.0 / (PICTURES * step)), 1)
        fps = 1.0 / (every * step)
        pictures = round(options.seconds * fps)
        env = SafeGoalEnv(name, num_envs=1, num_threads=1)
        env.reset()
        env.render()  # opens the context
        with tempfile.TemporaryDirectory() as folder:
            start, busy = time.perf_counter(), used()
            path = Path(folder, "film.mp4")
            steps = pictures * every
            record_video(env, env.rand_action, path, num_steps=steps, every=every, fps=fps)
            wall, busy = time.perf_counter() - start, used() - busy
        env.close()
        length = pictures / fps
        print(
            f"| {name} | {fps:.4g} | {length:.1f} | {wall:.1f} | {busy:.1f} "
            f"| {1e3 * busy / pictures:.1f} ms |",
            flush=True,
        )


if __name__ == "__main__":
    main()
