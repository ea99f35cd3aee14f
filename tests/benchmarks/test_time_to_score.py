"""When an agent is there, and what a table of several seeds says."""

from __future__ import annotations

import argparse

import pytest
import time_to_score as benchmark
from busy_machine import table as shares

CRITERIA = {"score": 10.0, "cv_rate": 0.01}


def rows(*scores, seed=0, det=12.0, method="cpo"):
    """Evaluations every 100 frames and 50 seconds, that fail by their sampled score alone."""
    figures = dict.fromkeys(benchmark.EVALUATION, 0.0) | {"eval/det/score": det}
    return [
        {"method": method, "seed": seed, "frames": 100.0 * i, "seconds": 50.0 * i}
        | {"violations": 7.0 * i, **figures, "eval/score": score}
        for i, score in enumerate(scores, 1)
    ]


@pytest.mark.parametrize(
    ("scores", "frames"),
    [
        ((11, 9, 11, 12, 13), 400),
        ((10, 10), 200),
        ((11, 9, 11, 9), None),
        ((11,), None),
        ((), None),
    ],
)
def test_two_in_a_row(scores, frames):
    end = benchmark.there(rows(*scores), CRITERIA)
    assert (None if end is None else end["frames"]) == frames


def test_both_kinds_of_actions_count():
    assert benchmark.there(rows(11, 11, det=9.0), CRITERIA) is None


def test_limits_are_upper_bounds():
    assert benchmark.there(rows(11, 11), {"cost": 0.0}) is not None
    assert benchmark.there(rows(11, 11), {"cost": -1.0}) is None


def test_median_and_range_over_seeds():
    mine = [*rows(11, 11), *rows(9, 11, 11, seed=1), *rows(9, 9, seed=2)]
    (found,) = benchmark.summary(mine, CRITERIA).values()
    assert (found["there"], found["seeds"]) == (2, 3)
    assert found["seconds"] == [150.0, 100.0, None]
    assert found["violations"] == [21.0, 14.0, None]
    assert "2 of 3 | 2.5 (1.7 to never) | 300 (200 to never)" in benchmark.table({"cpo": found})


def test_none_is_there():
    (found,) = benchmark.summary(rows(9, 9), CRITERIA).values()
    assert found["frames"] == [None, None, None]


def test_rows_are_read_as_they_were_written(tmp_path):
    before = rows(11.25, 9.5)
    benchmark.write(tmp_path / "new" / "a.csv", before)
    assert benchmark.read(tmp_path / "new" / "a.csv") == before
    assert benchmark.read(tmp_path / "none.csv") == []


def test_a_criterion_has_a_name_and_a_number():
    assert benchmark.criterion("cost=25") == ("cost", 25.0)
    with pytest.raises(argparse.ArgumentTypeError, match="speed must be one of score, return"):
        benchmark.criterion("speed=3")


def test_the_fair_share_of_a_busy_machine():
    rates = {
        ("a", 0): [100.0, 90, 110],
        ("a", 2): [40.0, 60, 50],
        ("b", 0): [80.0],
        ("b", 2): [25.0],
    }
    _, _, first, second = shares(rates, cores=2).splitlines()
    assert first == "| a | 100 (100%) | 50 (100%) |"
    assert second == "| b | 80 (80%) | 25 (50%) |"
