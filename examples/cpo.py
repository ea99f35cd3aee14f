"""CPO: constrained policy optimization (Achiam et al. 2017), which is TRC at ``risk_level=1``.

    python examples/cpo.py                          # train, evaluate, film

The algorithm is in trc.py; every option is in cpo.yaml, trc.yaml, constrained.yaml and base.yaml.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from trc import run_trc

from torchrl_safe.trainers.utils import Run


@hydra.main(config_path="pkg://torchrl_safe.trainers", config_name="cpo", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """CPO as configured in cpo.yaml."""
    with Run(cfg) as run:
        run_trc(run)


if __name__ == "__main__":
    main()
