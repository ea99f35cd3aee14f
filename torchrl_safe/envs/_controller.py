"""The network inside a legged robot: from a local goal and the joints to torques, in numpy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

Array = NDArray[np.float64]


class LegController:
    """A multilayer perceptron with rectifiers and a tanh at its end, for a batch.

    Args:
        layers (list of tuples of arrays): weight [out, in] and bias [out] of each layer.

    Examples:
        >>> import numpy as np
        >>> controller = LegController([(np.ones((1, 4)), np.zeros(1))])
        >>> controller(np.array([[0.0, 2.0]]), np.zeros((1, 1))).round(3).tolist()  # length 1
        [[0.964]]
    """

    def __init__(self, layers: list[tuple[NDArray[np.floating], NDArray[np.floating]]]) -> None:
        # Single precision is twice as fast, and transposed weights need no copy in the product.
        self._layers = [
            (np.ascontiguousarray(weight.T, np.float32), bias.astype(np.float32))
            for weight, bias in layers
        ]

    @classmethod
    def load(cls, path: Path) -> LegController:
        """Reads the entries ``weight0``, ``bias0``, ``weight1``, ... of a safetensors file."""
        tensors = load_file(path)
        count = len(tensors) // 2
        return cls([(tensors[f"weight{i}"], tensors[f"bias{i}"]) for i in range(count)])

    def __call__(self, goal: Array, readings: Array) -> Array:
        """Torques for a local goal.

        Args:
            goal (array): [N, 2], x ahead and y to the left. Its direction is where to walk, its
                length, clipped at one, how fast.
            readings (array): [N, P], what the robot senses of itself.

        Returns:
            array: [N, A] in [-1, 1].
        """
        length = np.hypot(goal[:, 0], goal[:, 1])[:, None]
        # No goal, no direction: ahead, at no speed.
        direction = np.where(length > 0.0, goal / np.maximum(length, 1e-12), (1.0, 0.0))
        x = np.concatenate((direction, np.minimum(length, 1.0), readings), 1, dtype=np.float32)
        for weight, bias in self._layers[:-1]:
            x = np.maximum(x @ weight + bias, 0.0)
        weight, bias = self._layers[-1]
        return np.tanh(x @ weight + bias).astype(np.float64)
