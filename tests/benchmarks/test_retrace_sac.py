from __future__ import annotations

import csv

import pytest
import retrace_sac

from torchrl_safe.trainers import cli


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
    retrace_sac.main(cli.compose("retrace_sac", overrides))
    with open(tmp_path / "curves.csv") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frames"]) for row in rows] == [100, 200, 300]
    assert float(rows[-1]["eval_return"]) < 0
    assert rows[0]["loss_qvalue"] == ""
    assert float(rows[-1]["loss_qvalue"]) > 0
    assert 0 < float(rows[-1]["trace"]) <= 1
