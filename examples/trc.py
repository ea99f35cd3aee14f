"""TRC: trust region conditional value at risk (Kim and Oh, RA-L 2022), on-policy.

    python examples/trc.py  # train, evaluate, film
    python examples/trc.py loss.risk_level=0.5    # the worst half of outcomes

The algorithm and its options are in torchrl_safe/trainers/trc.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("trc")
