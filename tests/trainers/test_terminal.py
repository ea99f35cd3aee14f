"""What is said to nobody ends nothing."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_safe.trainers import terminal
from torchrl_safe.trainers.terminal import GracefulStop, Lenient, say

TALK = """
import sys, terminal
if "bar" in sys.argv and sys.stderr:
    sys.stderr.isatty = lambda: True
progress = terminal.Progress(total=3000)
for i in range(3000):
    progress.update(1, cost="31.2/25")
    terminal.say("a line " * 20)
progress.close()
open(sys.argv[1], "w").write("went on")
"""


@pytest.mark.parametrize(
    "rest", ["2>&1 | head -c 100", "2>&1 >/dev/null | head -c 100", "2>&-", ">&-", ">&- 2>&- <&-"]
)
@pytest.mark.parametrize("kind", ["bar", "lines"])
def test_nobody_reads(tmp_path, rest, kind):
    """The reader of a pipe leaves, or there is no stream at all; the exit status stays 0."""
    (tmp_path / "talk.py").write_text(TALK)
    command = (
        f"set -o pipefail; '{sys.executable}' talk.py went {kind} {rest}; exit ${{PIPESTATUS[0]}}"
    )
    result = subprocess.run(
        ["bash", "-c", command],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(terminal.__file__).parent)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (tmp_path / "went").read_text() == "went on"
    assert result.returncode == 0, result.stderr


def test_hung_up_terminal(tmp_path):
    """A terminal that is gone answers with EIO."""

    class HungUp(io.StringIO):
        def write(self, text):
            raise OSError(5, "Input/output error")

    stream = Lenient(HungUp())
    assert stream.write("text") == 4
    stream.flush()


class TestProgress:
    def play(self, total=2_000, each=10, initial=0):
        progress = terminal.Progress(total, initial)
        for _ in range((total - initial) // each):
            progress.update(each, cost="31.2/25", violations="4.0")
        progress.close()

    def test_a_log_gets_a_line_for_every_twentieth(self, capsys):
        self.play()
        first, *_, last = lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 21  # the first update says that it goes
        assert first.startswith("10 of 2,000 frames, ")
        assert last.startswith("2,000 of 2,000 frames, 00:00 left, ")
        assert all(line.endswith("/s, cost 31.2/25, violations 4.0") for line in lines)
        assert not any("\r" in line for line in lines)

    def test_a_resumed_run_goes_on(self, capsys):
        self.play(initial=1_000)
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 11
        assert lines[0].startswith("1,010 of 2,000")

    def test_more_frames_than_asked_for(self, capsys):
        """The last batch is whole."""
        progress = terminal.Progress(100)
        progress.update(160)
        assert capsys.readouterr().err.startswith("160 of 100 frames, 00:00 left")

    def test_a_terminal_has_a_bar(self, monkeypatch):
        class Terminal(io.StringIO):
            def isatty(self):
                return True

        stream = Terminal()
        monkeypatch.setattr("sys.stderr", stream)
        self.play()
        last = stream.getvalue().rpartition("\r")[2]
        assert re.search(r"100 %\|.*\| 2.00k/2.00k, 00:00 left, .*/s, cost 31.2/25, viol", last)

    def test_a_notebook_has_its_widget(self, monkeypatch):
        made = []

        class Widget(terminal.tqdm):
            def __init__(self, **options):
                made.append(self)
                super().__init__(**options, file=io.StringIO())

        monkeypatch.setattr(terminal.auto, "notebook_tqdm", Widget)
        monkeypatch.setattr(terminal.auto, "tqdm", Widget)
        self.play()
        (bar,) = made
        assert bar.n == bar.total == 2_000
        assert bar.postfix == "cost 31.2/25, violations 4.0"


def test_is_said(capsys):
    say("a line")
    assert capsys.readouterr().out == "a line\n"


class TestGracefulStop:
    @pytest.mark.parametrize("name", GracefulStop.names)
    def test_asks_first(self, name):
        number = getattr(signal, name)
        before = signal.signal(number, signal.SIG_DFL)  # whoever started pytest may ignore it
        try:
            with GracefulStop() as stop:
                assert not stop.requested
                signal.raise_signal(number)
                assert stop.requested
                with pytest.raises(KeyboardInterrupt):
                    signal.raise_signal(number)
            assert signal.getsignal(number) is signal.SIG_DFL
        finally:
            signal.signal(number, before)

    def test_nohup_stays(self):
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            with GracefulStop() as stop:
                signal.raise_signal(signal.SIGHUP)
            assert not stop.requested
        finally:
            signal.signal(signal.SIGHUP, before)
