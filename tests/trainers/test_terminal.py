"""What is said to nobody ends nothing."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_safe.trainers import terminal
from torchrl_safe.trainers.terminal import GracefulStop, Lenient, say

TALK = """
import sys, terminal
progress = terminal.progress_bar(total=3000, mininterval=0)
for i in range(3000):
    progress.update()
    progress.set_postfix(reward="1.0")
    terminal.say("a line " * 20)
progress.close()
open(sys.argv[1], "w").write("went on")
"""


@pytest.mark.parametrize(
    "rest", ["2>&1 | head -c 100", "2>&1 >/dev/null | head -c 100", "2>&-", ">&-", ">&- 2>&- <&-"]
)
def test_nobody_reads(tmp_path, rest):
    """The reader of a pipe leaves, or there is no stream at all; the exit status stays 0."""
    (tmp_path / "talk.py").write_text(TALK)
    command = f"set -o pipefail; '{sys.executable}' talk.py went {rest}; exit ${{PIPESTATUS[0]}}"
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
