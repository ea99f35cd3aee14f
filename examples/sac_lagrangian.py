"""SAC-Lagrangian (Ha et al. 2020): SAC with a multiplier on the mean cost, WCSAC at risk level 1.

    python examples/sac_lagrangian.py               # train, evaluate, film

The algorithm is in wcsac.py; every option is in sac_lagrangian.yaml, wcsac.yaml,
constrained.yaml and base.yaml.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from wcsac import run_wcsac

from torchrl_safe.trainers.utils import Run


@hydra.main(
    config_path="pkg://torchrl_safe.trainers", config_name="sac_lagrangian", version_base="1.3"
)
def main(cfg: DictConfig) -> None:
    """SAC-Lagrangian as configured in sac_lagrangian.yaml."""
    with Run(cfg) as run:
        run_wcsac(run)


if __name__ == "__main__":
    main()
