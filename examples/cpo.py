"""CPO: constrained policy optimization (Achiam et al. 2017), which is TRC at risk level 1.

    python examples/cpo.py  # train, evaluate, film

The algorithm and its options are in torchrl_safe/trainers/trc.py.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("cpo")
