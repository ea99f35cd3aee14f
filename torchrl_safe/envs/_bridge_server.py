"""The other end of ``bridge.py``, for the Python that has Safety-Gymnasium: 3.8 to 3.10.

It imports nothing of this package. It reads a JSON object per line, ``{"do": ...}``, and answers
each with one; an answer with ``"error"`` says what went wrong.
"""

from __future__ import annotations

import json
import os
import sys
from typing import Any


def plain(value: Any) -> Any:
    """An array, a number or NumPy's kind of one, as JSON has them."""
    return value.tolist() if hasattr(value, "tolist") else value


class Server:
    """One environment, and what may be asked of it."""

    def make(self, id: str, options: dict[str, Any]) -> dict[str, Any]:
        """Builds the environment, and says what it takes and gives."""
        import safety_gymnasium

        self.env = safety_gymnasium.make(id, **options)
        seen, action = self.env.observation_space, self.env.action_space
        if type(seen).__name__ != "Box" or type(action).__name__ != "Box":
            raise TypeError(f"observations and actions must be boxes, got {seen} and {action}")
        return {"seen": seen.shape, "low": plain(action.low), "high": plain(action.high)}

    def reset(self, seed: int | None) -> dict[str, Any]:
        """Starts an episode."""
        observation, _ = self.env.reset(seed=seed)
        return {"observation": plain(observation)}

    def step(self, action: list[float]) -> dict[str, Any]:
        """Makes a step."""
        import numpy

        observation, reward, cost, terminated, truncated, _ = self.env.step(numpy.array(action))
        return {
            "observation": plain(observation),
            "reward": float(reward),
            "cost": float(cost),
            "terminated": bool(terminated),
            "truncated": bool(truncated),
        }


def main() -> None:
    """Answers until there is nobody who asks."""
    sys.path.pop(0)  # this folder, whose modules would hide others of their names
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print is no answer
    server = Server()
    for line in sys.stdin:
        asked = json.loads(line)
        try:
            answer = getattr(server, asked.pop("do"))(**asked)
        except Exception as error:
            answer = {"error": f"{type(error).__name__}: {error}"}
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
