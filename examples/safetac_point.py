"""SafeTAC on the Point robot.

    python examples/safetac_point.py                                # train, evaluate, film
    python examples/safetac_point.py collector.total_frames=100000  # a quick look
    python examples/safetac_point.py resume=true                    # go on after Ctrl-C

The algorithm and its options are in torchrl_safe/trainers/safetac.py; docs/configuration.md has
all of them.
"""

from __future__ import annotations

from torchrl_safe.trainers import cli

if __name__ == "__main__":
    cli.train("safetac", run_dir="runs/safetac_point/seed_${seed}")
