"""WCSAC: worst-case soft actor-critic (Yang et al. 2021), SAC with a multiplier on the CVaR.

    python examples/wcsac.py  # train, evaluate, film
    python examples/wcsac.py loss.risk_level=0.5    # the worst half of outcomes

The algorithm and its options are in torchrl_safe/trainers/wcsac.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("wcsac")
