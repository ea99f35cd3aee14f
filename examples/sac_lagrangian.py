"""SAC-Lagrangian (Ha et al. 2020): SAC with a multiplier on the mean cost.

    python examples/sac_lagrangian.py  # train, evaluate, film

The algorithm and its options are in torchrl_safe/trainers/wcsac.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("sac_lagrangian")
