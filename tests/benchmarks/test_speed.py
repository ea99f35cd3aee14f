"""The speed report: its tables are the measurements, and a failure is not hidden."""

from __future__ import annotations

from types import SimpleNamespace

import profile_training
import pytest
import report


def measured(group, name, median, **extra):
    stats = {"median": median, "min": median / 2, "rounds": 5}
    return {"group": group, "name": name, "stats": stats, "extra_info": extra}


def test_a_table_per_group_in_units_of_its_first_row():
    text = report.tables(
        {
            "benchmarks": [
                measured("a", "bench_step[64-fast]", 0.002, cosine=0.5),
                measured("b", "bench_reset", 1.5),
                measured("a", "bench_step[64-slow]", 0.005),
            ]
        }
    )
    first, second = text.split("\n\n")
    assert first.splitlines()[0] == "| a | median | ratio | fastest | rounds | cosine |"
    assert first.splitlines()[2:] == [
        "| `64-fast` | 2 ms | 1.00 | 1 ms | 5 | 0.5 |",
        "| `64-slow` | 5 ms | 2.50 | 2.5 ms | 5 |  |",
    ]
    assert second.splitlines()[2:] == ["| `bench_reset` | 1,500 ms | 1.00 | 750 ms | 5 |"]


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("python -c 1/0", "exit status 1: ZeroDivisionError: division by zero"),
        (  # as pytest ends, whose standard error says something else
            "python -c print('FAILED a.py::test');import sys;sys.exit('Wrote results.')",
            "exit status 1: FAILED a.py::test",
        ),
        ("python -c __import__('time').sleep(60)", "took more than 3 seconds"),
    ],
)
def test_a_part_without_result_is_named(tmp_path, monkeypatch, command, message):
    good = report.Part("Good", "python -c print(6*7)", "Text.")
    monkeypatch.setattr(report, "PARTS", [report.Part("Bad", shell_quoted(command), ""), good])
    monkeypatch.setattr(report, "TIMEOUT", 3)
    page = tmp_path / "page.md"
    assert report.write(page, tiny=False) == 1
    text = page.read_text()
    assert f"**No result**: {message}." in text
    assert text.endswith("## Good\n\n`python -c print(6*7)`\n\nText.\n\n42\n")


def shell_quoted(command):
    program, flag, code = command.split(maxsplit=2)
    return f'{program} {flag} "{code}"'


def test_time_is_the_innermost_parts():
    """Critics of 100 us hold a replay of 30 us; kernels count once, where they run."""

    def event(name, total, own, parent=None):
        return SimpleNamespace(
            name=name, cpu_time_total=total, self_cpu_time_total=own, cpu_parent=parent
        )

    critics = event("time/critics", 100, 20)
    replay = event("replay", 30, 5, critics)
    index = event("aten::index", 25, 10, replay)
    copy = event("aten::copy_", 15, 15, index)
    backward = event("AddmmBackward0", 50, 0, critics)
    product = event("aten::mm", 50, 50, backward)
    collect = event("collect", 40, 10)
    simulator = event(profile_training.SIMULATOR, 30, 30, collect)
    fused = event("graph_0_cpp_fused_relu_1", 10, 10, collect)
    events = [critics, replay, index, copy, backward, product, collect, simulator, fused]
    assert profile_training.attribute(events, slowdown=0.0) == {
        "time": {"time/critics": 70, "replay": 30, "collect": 40, None: 0},
        "kernels": {"time/critics": 50, "replay": 25, "collect": 10},
        "simulator": {"collect": 30},
    }
    # One microsecond per event, taken off the part and the kernel that it is inside of.
    assert profile_training.attribute(events, slowdown=len(events)) == {
        "time": {"time/critics": 67, "replay": 28, "collect": 38, None: -2},
        "kernels": {"time/critics": 50, "replay": 24, "collect": 10},
        "simulator": {"collect": 30},
    }
