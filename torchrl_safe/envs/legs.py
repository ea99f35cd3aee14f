"""What moves Doggo's legs: a gait, and what a small network adds to it.

One side of the body is described. The other side does what this one would do in a mirror, half a
period later: a robot alike on both sides walks alike to both sides. The weights are made by
``benchmarks/doggo_controller.py``, which learns on the very input that is computed here.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

Array = NDArray[np.float64]

STEP = 0.1  # seconds between two torques
# A period is four steps: what the clock shows, sine and cosine, is 0, 1 or -1.
_CLOCK = np.array(((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0)))
# Of the input: command (2), velocity (3), angular velocity (3) and vertical (3) of the trunk,
# velocity, sine and cosine of twelve joints, clock (2).
INPUT_SIZE = 49
_SCALE = np.array((0.5,) * 3 + (2.0,) * 3 + (1.0,) * 3 + (5.0,) * 12 + (1.0,) * 24)
# The same in the mirror: legs change places (they come front left, front right, rear left, rear
# right), and what points to the left points to the right.
_LEGS = np.array((3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8))
OTHER_SIDE = np.concatenate((np.arange(11), 11 + _LEGS, 23 + _LEGS, 35 + _LEGS, (47, 48)))
SIGNS = np.array((1, -1) + (1, -1, 1) + (-1, 1, -1) + (1, -1, 1) + (1,) * 36 + (-1, -1), float)


class Legs(NamedTuple):
    """The weights of a controller.

    Attributes:
        gait (array): [6, 6], of the features of :func:`gait_features`.
        weights (list of arrays): of the network's layers, [out, in].
        biases (list of arrays): [out].
    """

    gait: Array
    weights: list[Array]
    biases: list[Array]


@cache
def load_legs(path: Path) -> Legs:
    """Reads a controller from a safetensors file."""
    tensors = {name: value.astype(np.float64) for name, value in load_file(path).items()}
    layers = range(sum(name.startswith("weight") for name in tensors))
    return Legs(
        tensors["gait"],
        [tensors[f"weight{i}"] for i in layers],
        [tensors[f"bias{i}"] for i in layers],
    )


def controller_input(command: Array, readings: Array, time: Array) -> Array:
    """What the controller sees.

    Args:
        command (array): [N, 2], where to walk in the robot's frame; of length one at most, for as
            fast as it can.
        readings (array): [N, 45], what ``doggo_torques`` senses.
        time (array): [N], seconds since the robot was put down.

    Returns:
        array: [N, 49].
    """
    clock = _CLOCK[np.rint(time / STEP).astype(np.intp) % len(_CLOCK)]
    return np.concatenate((command, readings / _SCALE, clock), 1)


def gait_features(x: Array) -> Array:
    """How far to step ahead and how far to turn, each times (sine, cosine, 1) of the clock.

    Args:
        x (array): [N, 49].

    Returns:
        array: [N, 6]; zero if nothing is commanded.
    """
    length, angle = np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])
    ahead = length * np.sqrt(np.maximum(np.cos(angle), 0.0))
    turn = length * np.clip(angle / 2.0, -1.0, 1.0)
    clock = np.column_stack((x[:, -2:], np.ones(len(x))))
    return np.concatenate((ahead[:, None] * clock, turn[:, None] * clock), 1)


def torques(legs: Legs, x: Array) -> Array:
    """The motors' torques.

    Args:
        legs (Legs): the controller.
        x (array): [N, 49], of :func:`controller_input`.

    Returns:
        array: [N, 12] in [-1, 1]; hip z, hip y and ankle of front left, rear left, rear right and
        front right.
    """
    both = np.concatenate((x, x[:, OTHER_SIDE] * SIGNS))
    hidden = both
    for i, (weight, bias) in enumerate(zip(legs.weights, legs.biases, strict=True)):
        hidden = (hidden if i == 0 else np.tanh(hidden)) @ weight.T + bias
    left, right = (gait_features(both) @ legs.gait.T + hidden).reshape(2, len(x), 2, 3)
    legwise = np.stack((left[:, 0], left[:, 1], right[:, 1], right[:, 0]), 2)
    return np.tanh(legwise.reshape(len(x), 12))
