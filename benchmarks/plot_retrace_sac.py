"""The picture of docs/upstream.md from the curves of benchmarks/results/retrace_sac.

python benchmarks/plot_retrace_sac.py
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks/results/retrace_sac"
COLOURS = {"retrace": "#0072B2", "td0": "#D55E00"}


def smooth_returns(file: Path, window: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and the training return averaged over that many rows of 100 frames."""
    rows = np.genfromtxt(file, delimiter=",", names=True)
    rows = rows[~np.isnan(rows["train_return"])]
    mean = np.convolve(rows["train_return"], np.ones(window) / window, "valid")
    return rows["frames"][window - 1 :], mean


def main() -> None:
    """Every seed thin, their mean thick as far as all of them go."""
    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.add_subplot(xlabel="frames", ylabel="return of training episodes")
    for name, colour in COLOURS.items():
        curves = [smooth_returns(file) for file in sorted(RESULTS.glob(f"{name}/seed_*.csv"))]
        for frames, returns in curves:
            axes.plot(frames, returns, color=colour, linewidth=0.7, alpha=0.5)
        rows = min(len(frames) for frames, _ in curves)
        mean = np.mean([returns[:rows] for _, returns in curves], 0)
        axes.plot(curves[0][0][:rows], mean, color=colour, label=f"{name}, {len(curves)} seeds")
    axes.legend()
    axes.set_title("TorchRL's SAC on Reacher-v5")
    figure.savefig(ROOT / "docs/images/retrace_sac.png", dpi=150)


if __name__ == "__main__":
    main()
