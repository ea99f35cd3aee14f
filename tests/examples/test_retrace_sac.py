from __future__ import annotations

import csv
from pathlib import Path

import hydra
import pytest
import retrace_sac

EXAMPLES = Path(retrace_sac.__file__).parent


@pytest.mark.parametrize("estimator", ["retrace", "td0"])
@pytest.mark.filterwarnings("ignore:.*settotalmass")
def test_writes_a_learning_curve(tmp_path, estimator):
    overrides = [
        f"run_dir={tmp_path}",
        f"estimator.name={estimator}",
        "collector.total_frames=300",
        "collector.init_frames=200",
        "replay_buffer.batch_size=32",
        "optim.updates_per_frame=0.02",
        "eval.interval=300",
        "eval.num_episodes=1",
    ]
    with hydra.initialize_config_dir(str(EXAMPLES), version_base="1.3"):
        cfg = hydra.compose("retrace_sac", overrides)
    retrace_sac.main.__wrapped__(cfg)
    with open(tmp_path / "curves.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [100, 200, 300]
    assert float(rows[-1]["eval_return"]) < 0
    assert rows[0]["loss_qvalue"] == ""
    assert float(rows[-1]["loss_qvalue"]) > 0
    assert 0 < float(rows[-1]["trace"]) <= 1
