"""Off-policy TRC (Kim and Oh 2022): TRC's surrogates on replayed trajectories, by Retrace.

    python examples/offpolicy_trc.py  # train, evaluate, film

The algorithm and its options are in torchrl_safe/trainers/offpolicy_trc.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("offpolicy_trc")
