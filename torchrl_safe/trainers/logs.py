"""The log of a run, which goes on as if nobody had stopped it."""

from __future__ import annotations

import errno
import io
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from torchrl.record.loggers import CSVLogger, Logger, TensorboardLogger, get_logger

from torchrl_safe._files import (
    DRAFT,
    check_folder,
    read_bytes,
    regular_files,
    replacing,
    write_atomically,
)
from torchrl_safe.trainers.options import Logger as LoggerOptions

NAME = "log"
WANDB_ID = "wandb_id"


class Log:
    """TorchRL's logger of ``logger.backend``, opened at a frame.

    What a killed run had logged beyond that frame is not there any more: lines of the csv files are
    cut off, TensorBoard is told to forget. Weights & Biases keeps what it has; the run has one id
    in all of its parts, kept in the folder.

    Args:
        options (Logger): the run's ``logger``.
        path (Path): the run's folder.
        frames (int): frames that the run goes on from.
        finishing (bool): whether only the final evaluation is left, which is then logged anew.
    """

    def __init__(self, options: LoggerOptions, path: Path, frames: int, *, finishing: bool) -> None:
        self._folder = path
        self._logger: Logger | None
        if os.path.lexists(path / NAME):
            regular_files(path / NAME)  # or a link would be written through
        if os.path.lexists(path / "wandb"):
            check_folder(path / "wandb")  # it makes links in there itself
        if options.backend == "csv":
            if (path / NAME).exists():
                cut_csv(path / NAME, frames, finishing=finishing)
            self._logger = CSVLogger(NAME, str(path))
        elif options.backend == "tensorboard":
            self._logger = _Purging(NAME, str(path), purge_step=frames + 1)
        else:
            os.environ.setdefault("WANDB_MODE", "offline")
            wandb: dict[str, Any] = {"project": options.project_name, "dir": str(path)}
            if options.backend == "wandb":
                wandb["id"] = _wandb_id(path)
            with nobody_to_ask():
                self._logger = get_logger(
                    options.backend,
                    logger_name=str(path),
                    experiment_name=NAME,
                    wandb_kwargs=wandb,
                )

    def write(self, metrics: Mapping[str, float], frames: int) -> None:
        """Write metrics at a frame.

        Raises:
            OSError: if they cannot be written; on a full disk with the bytes needed and free.
        """
        if self._logger is None:
            return
        try:
            self._logger.log_metrics(dict(metrics), step=frames)
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            needed = sum(len(f"{frames},{value}\n") for value in metrics.values())
            raise OSError(
                error.errno,
                f"{error.strerror}: the log needs {needed} bytes for the {len(metrics)} metrics of "
                f"frame {frames}, there are {shutil.disk_usage(self._folder).free}. Free some "
                "space and resume: the run goes on from its last checkpoint, and the log with it",
                str(self._folder / NAME),
            ) from error
        if isinstance(self._logger, CSVLogger):
            # TorchRL's keeps all it ever wrote: megabytes per hour that nobody reads.
            self._logger.experiment.scalars.clear()

    def close(self) -> None:
        """Close its files; a run of wandb ends, or the next one in this process would be in it."""
        if self._logger is None:
            return
        if isinstance(self._logger, CSVLogger):
            for file in self._logger.experiment.files.values():
                with suppress(OSError):  # a full disk: what it could not write is redone
                    file.close()
        with suppress(OSError):
            self._logger.close()


def cut_csv(log: Path, frames: int, *, finishing: bool = False) -> None:
    """End csv files at a frame: lines beyond it and a torn last line go, all others stay.

    Args:
        log (Path): the csv logger's folder.
        frames (int): the last one that stays.
        finishing (bool): whether the final evaluation at this frame goes, too. Defaults to False.
    """
    for name, file in regular_files(log).items():
        if file.name.startswith(DRAFT):
            file.unlink()
        if file.name.startswith(DRAFT) or file.suffix != ".csv":
            continue
        last = frames - 1 if finishing and name.startswith("scalars/final/") else frames
        content = file.read_bytes()
        lines = content.splitlines(keepends=True)
        kept = b"".join(line for line in lines if line.endswith(b"\n") and _step(line) <= last)
        if kept != content:
            with replacing(file) as draft:
                draft.write_bytes(kept)


def _step(line: bytes) -> int:
    """The step of a line; a line that is not one is of no step."""
    digits = re.match(rb"\d+(?=,)", line)
    return int(digits[0]) if digits else 0


class _Purging(TensorboardLogger):
    """TorchRL's, with what earlier parts of a run logged from a step on taken back."""

    def __init__(self, exp_name: str, log_dir: str, *, purge_step: int) -> None:
        self._purge_step = purge_step
        super().__init__(exp_name, log_dir)

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        log_dir = os.path.join(self.log_dir, self.exp_name)
        return SummaryWriter(log_dir=log_dir, purge_step=self._purge_step)


def _wandb_id(path: Path) -> str:
    """The run's id at Weights & Biases, the same in all of its parts."""
    file = path / WANDB_ID
    if not os.path.lexists(file):
        write_atomically(file, secrets.token_hex(4) + "\n")
    name = read_bytes(file, 100).decode(errors="replace").strip()
    if not re.fullmatch("[0-9a-z]{8}", name):
        raise ValueError(f"{file} must hold 8 digits and small letters, got {name!a}.")
    return name


@contextmanager
def nobody_to_ask() -> Iterator[None]:
    """No terminal to read from: wandb, asked to be online without an account, fails at once."""
    terminal, sys.stdin = sys.stdin, io.StringIO()
    try:
        yield
    finally:
        sys.stdin = terminal
