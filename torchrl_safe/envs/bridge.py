"""Safety-Gymnasium itself, in an old Python of its own, as a TorchRL environment.

Safety-Gymnasium 1.0 needs Python 3.8 to 3.10 and releases of Gymnasium and MuJoCo that nothing here
runs with. It gets an interpreter with them alone; the two talk in JSON lines over pipes.
"""

from __future__ import annotations

import contextlib
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

__all__ = ["SafetyGymnasiumBridge"]

_SERVER = Path(__file__).with_name("_bridge_server.py")


class SafetyGymnasiumBridge(EnvBase):
    """An environment of Safety-Gymnasium, stepped in a process of another Python.

    Entries under ``"next"`` after a step: ``observation`` [D], ``reward`` and ``cost`` [1],
    float32; ``violation`` [1] bool, the cost is above 0; ``done``, ``terminated``, ``truncated``
    [1]. There is no batch: ``SerialEnv`` or ``ParallelEnv`` makes one, a process for each. The
    process ends with :meth:`close`, or with this one.

    That Python is made by ``python3.10 -m venv FOLDER`` and
    ``FOLDER/bin/pip install safety-gymnasium==1.0.0``.

    Args:
        env_id (str): Safety-Gymnasium's name of the environment, ``"SafetyPointGoal1-v0"``.

    Keyword Args:
        python (str or path): the interpreter that has Safety-Gymnasium.
        device (torch.device, optional): device of the tensors.
        options: other keyword arguments are those of ``safety_gymnasium.make``.

    Raises:
        ValueError: if there is no such interpreter, or an action is not finite.
        RuntimeError: if Safety-Gymnasium is not there or fails, with what it says.

    Examples:
        >>> env = SafetyGymnasiumBridge(
        ...     "SafetyPointGoal1-v0", python="sg310/bin/python"
        ... )  # doctest: +SKIP
        >>> env.rollout(10)["next", "cost"].shape  # doctest: +SKIP
        torch.Size([10, 1])
    """

    def __init__(
        self,
        env_id: str,
        *,
        python: str | Path,
        device: torch.device | str | None = None,
        **options: Any,
    ) -> None:
        super().__init__(device=device, batch_size=torch.Size([]))
        self._said = tempfile.TemporaryFile()  # noqa: SIM115 closed with the environment
        self._seed: int | None = None
        try:
            self._process = subprocess.Popen(
                [str(python), str(_SERVER)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._said,
                text=True,
                encoding="utf-8",
            )
        except OSError as error:
            self._said.close()
            raise ValueError(
                "python must be the path of an interpreter that has safety-gymnasium, "
                f"got {str(python)!r}: {error.strerror}."
            ) from error
        try:
            spaces = self._ask("make", id=env_id, options=options)
        except BaseException:
            self.close()
            raise
        device = self.device

        def flag() -> Binary:
            return Binary(1, shape=(1,), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            observation=Unbounded(spaces["seen"], device=device, dtype=torch.float32),
            violation=flag(),
            device=device,
        )
        low, high = (
            torch.tensor(spaces[bound], dtype=torch.float32, device=device)
            for bound in ("low", "high")
        )
        self.action_spec = Bounded(low, high, device=device, dtype=torch.float32)
        self.full_reward_spec = Composite(
            {
                name: Unbounded((1,), device=device, dtype=torch.float32)
                for name in ("reward", "cost")
            },
            device=device,
        )
        self.full_done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), device=device
        )

    def _ask(self, do: str, **what: Any) -> dict[str, Any]:
        """What the other process answers.

        Raises:
            RuntimeError: if it failed or is gone.
        """
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps({"do": do, **what}) + "\n")
            process.stdin.flush()
            line = process.stdout.readline()
        except (OSError, ValueError) as error:
            line, reason = "", f" ({error})"
        else:
            reason = ""
        if not line:
            code = process.poll()
            raise RuntimeError(
                f"Safety-Gymnasium's process is gone{reason}, exit status {code}: {self._tail()}"
            )
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(
                f"Safety-Gymnasium fails in {do!r} with {answer['error']}. Its Python is "
                f"{process.args[0]!r}."  # type: ignore[index]
            )
        return answer

    def _tail(self) -> str:
        if self._said.closed:
            return "the environment is closed."
        self._said.seek(0)
        return self._said.read().decode(errors="replace")[-1000:] or "it said nothing."

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        answer = self._ask("reset", seed=self._seed)
        self._seed = None
        return self._to_tensordict(answer | {"cost": 0.0, "terminated": False, "truncated": False})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict["action"]
        if not action.isfinite().all():
            raise ValueError(f"action must be finite, got {action.tolist()}.")
        return self._to_tensordict(self._ask("step", action=action.tolist()))

    def _to_tensordict(self, answer: dict[str, Any]) -> TensorDictBase:
        ends = {name: [answer[name]] for name in ("terminated", "truncated")}
        numbers = {"observation": answer["observation"]}
        if "reward" in answer:
            numbers |= {name: [answer[name]] for name in ("reward", "cost")}
        return TensorDict(
            {
                **{
                    name: torch.tensor(value, dtype=torch.float32)
                    for name, value in numbers.items()
                },
                "violation": torch.tensor([answer["cost"] > 0.0]),
                "done": torch.tensor([answer["terminated"] or answer["truncated"]]),
                **{name: torch.tensor(value) for name, value in ends.items()},
            },
            batch_size=[],
            device=self.device,
        )

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed  # of the next reset, as Gymnasium has it

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Ends the other process; a closed environment says so."""
        process = self._process
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # nobody reads what was still to be said
                    pipe.close()
        try:
            process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._said.close()
        super().close(raise_if_closed=raise_if_closed)
