"""The speed report: its tables are the measurements, and a failure is not hidden."""

from __future__ import annotations

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


def test_a_look_is_the_innermost_parts_and_its_nearest_owners():
    main = "MainThread;main (profile_training.py:80);Trainer._loop (trainer.py:160)"
    update = f"{main};SafeTAC.update (safetac.py:160)"
    step = f"{update};SafeTAC._step (safetac.py:170)"
    fit = f"{update};CriticFit.__call__ (off_policy.py:9)"
    descend = f"{fit};CriticFit.__init__.<locals>.descend (off_policy.py:155)"
    collect = f"{main};Collector.rollout (torchrl/collectors/_single.py:2)"
    forward = f"{descend};Module._call_impl (torch/nn/modules/module.py:1)"
    runner = f"Runner.call (c{'a1' * 25}b.py:3)"
    stacks = [
        # A product, called from Python; memory for it; the call; what is called.
        f"{forward};at::mm(at::Tensor const&) (libtorch_cpu.so) 16",
        f"{forward};at::empty (libc10.so);malloc (libc.so.6) 8",
        f"{forward} 4",
        f"{forward};call (torchrl_safe/objectives/utils.py:50);PyObject_Call (libpython3.11.so) 2",
        f"{descend};{runner};kernel (c{'a1' * 25}b.main.cpp:8) 1",
        f"{descend};{runner} 32",
        # A replay in it is a part of its own, the trust region whatever else an update does.
        f"{fit};ReplayBuffer.sample (torchrl/data/replay_buffers/base.py:1) 3",
        f"{step};step (numpy/_core/_multiarray_umath.cpython-311-x86_64-linux-gnu.so) 5",
        f"{collect};mj_step (mujoco/libmujoco.so.3.17.0) 7",
        f"{collect};mj_step (mujoco/libmujoco.so.3.17.0);sin (libm.so.6) 1",
        "MainThread;gc_collect_main (libpython3.11.so.1.0) 9",
        "thread (0x1): Thread-1;Trainer._loop (trainer.py:160);run (libtorch_cpu.so) 99",
    ]
    seen = profile_training.attribute(stacks)
    assert {part.partition(":")[0]: dict(counts) for part, counts in seen.items()} == {
        "collect": {"MuJoCo": 8},
        "replay": {"neither": 3},
        "targets": {},
        "critics": {"torch, native": 25, "torch, Python": 36, "neither": 2},
        "policy": {"neither": 5},
        "logging and what is left": {"neither": 9},
    }


def test_a_profile_without_permission_says_what_py_spy_said(tmp_path, monkeypatch):
    (tmp_path / "py-spy").write_text("#!/bin/sh\necho Permission Denied: try sudo\nexit 1\n")
    (tmp_path / "py-spy").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    with pytest.raises(RuntimeError, match="Permission Denied: try sudo"):
        profile_training.start_sampler(tmp_path / "stacks")
