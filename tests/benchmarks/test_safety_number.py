"""The page of the safety number says what its runs showed."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "benchmarks"))

import safety_number  # noqa: E402


def test_page_is_what_was_measured():
    with safety_number.TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    written = safety_number.PAGE.read_text().partition(safety_number.MARK)[2]
    assert written.strip() == safety_number.table(rows)
    assert len(rows) >= 10


def test_order_and_digits():
    row = dict.fromkeys(safety_number.COLUMNS, "1.23456") | {"limit": "5.0"}
    rows = [row | {"run": "b"}, row | {"run": "c", "limit": "2.5"}, row | {"run": "a"}]
    lines = safety_number.table(rows).splitlines()[2:]
    assert [line[2] for line in lines] == ["a", "b", "c"]
    assert lines[0].count("1.235") == len(safety_number.COLUMNS) - 2
