"""Tsallis actor-critic (Lee et al. 2020), without a constraint: SAC with another entropy.

    python examples/tac.py  # train, evaluate, film
    python examples/tac.py loss.entropic_index=1    # SAC

The algorithm and its options are in torchrl_safe/trainers/tac.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("tac")
