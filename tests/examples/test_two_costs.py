"""The example with two costs: each has its own limit, level and critics."""

from __future__ import annotations

import math

import pytest
import small
import two_costs

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import METHODS

# What the example says of its size is said again, smaller.
SIZES = [*small.COMMON, *small.OF_METHOD["safetac"], "loss.anneal_frames=400"]


def test_limits_fall_to_what_the_example_says(tmp_path):
    words = [word for word in two_costs.OPTIONS if not word.startswith("run_dir")]
    options = small.cli.compose("safetac", [*words, *SIZES, f"run_dir={tmp_path / 'run'}"])
    METHODS["safetac"](options=options).train()
    logged = {
        name: values.tolist() for name, (_, values) in read_metrics(options.folder + "/log").items()
    }
    for cost, limit in (("collision_cost", 5.0), ("speed_cost", 20.0)):
        # From one and a half times the limit, over 400 frames.
        assert logged[f"update/cost_limit/{cost}"] == pytest.approx([1.25 * limit, limit])
        assert math.isfinite(logged[f"update/cost_level/{cost}"][-1])
        assert f"eval/det/{cost}" in logged


def test_folder_is_that_of_the_seed():
    assert "run_dir=runs/two_costs/seed_${seed}" in two_costs.OPTIONS
    assert small.cli.compose("safetac", [*two_costs.OPTIONS, "seed=3"]).folder == (
        "runs/two_costs/seed_3"
    )
