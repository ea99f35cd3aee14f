"""Domain randomisation: robots that differ from one environment and episode to the next."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array

Range = tuple[float, float]


class Variation(NamedTuple):
    """How the robots of N environments differ from their model: [N] each.

    Attributes:
        mass (array): factor of all masses and inertias.
        friction (array): factor of all friction coefficients and joint dampings.
        actuator_gain (array): factor of what the actuators make of a command.
        actuator_delay (array): environment steps by which commands arrive late, whole numbers.
        sensor_noise (array): standard deviation of what is added to each entry of the observation.
        lidar_dropout (array): probability that a reading of the lidar sees nothing.
    """

    mass: Array
    friction: Array
    actuator_gain: Array
    actuator_delay: Array
    sensor_noise: Array
    lidar_dropout: Array


@dataclass(frozen=True)
class Randomization:
    """Ranges that :class:`Variation` is drawn from at every reset, uniformly and independently.

    The defaults change nothing. Reward, cost and violations are those of the true state: noise and
    drop-out reach the observation only.

    Args:
        mass (tuple of float): smallest and largest factor, > 0.
        friction (tuple of float): as ``mass``.
        actuator_gain (tuple of float): as ``mass``.
        actuator_delay (tuple of int): fewest and most environment steps, >= 0.
        sensor_noise (tuple of float): in units of the scaled observation, >= 0.
        lidar_dropout (tuple of float): in [0, 1].

    Raises:
        ValueError: if a range is not two numbers, is empty or out of bounds.

    Examples:
        >>> Randomization(mass=(0.9, 1.2), actuator_delay=(0, 2)).mass
        (0.9, 1.2)
    """

    mass: Range = (1.0, 1.0)
    friction: Range = (1.0, 1.0)
    actuator_gain: Range = (1.0, 1.0)
    actuator_delay: tuple[int, int] = (0, 0)
    sensor_noise: Range = (0.0, 0.0)
    lidar_dropout: Range = (0.0, 0.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            name, value = field.name, getattr(self, field.name)
            kinds = int if name == "actuator_delay" else (int, float)
            if not (
                isinstance(value, tuple)
                and len(value) == 2
                and all(isinstance(v, kinds) and not isinstance(v, bool) for v in value)
                and value[0] <= value[1] < np.inf
            ):
                what = "integers" if name == "actuator_delay" else "finite numbers"
                raise ValueError(f"{name} must be a tuple (low, high) of {what}, got {value!r}.")
            if name in ("mass", "friction", "actuator_gain"):
                if value[0] <= 0.0:
                    raise ValueError(f"{name} must be positive, got {value}.")
            elif value[0] < 0 or (name == "lidar_dropout" and value[1] > 1.0):
                bounds = "in [0, 1]" if name == "lidar_dropout" else ">= 0"
                raise ValueError(f"{name} must be {bounds}, got {value}.")

    def sample(self, streams: RandomStreams, rows: NDArray[np.integer]) -> Variation:
        """Draws a variation for the environments ``rows`` [n]."""
        ranges = np.array([getattr(self, name) for name in Variation._fields], float)
        low, high = ranges.T
        draws = streams.uniform(rows, len(ranges))
        delay = Variation._fields.index("actuator_delay")
        values = low + draws * (high - low)
        values[:, delay] = np.floor(low[delay] + draws[:, delay] * (high[delay] - low[delay] + 1.0))
        return Variation(*values.T)


JACKAL_TRAINING = Randomization(
    mass=(0.9, 1.2),
    friction=(0.6, 1.2),
    actuator_gain=(0.9, 1.1),
    actuator_delay=(0, 2),
    sensor_noise=(0.0, 0.03),
    lidar_dropout=(0.0, 0.02),
)
"""Ranges to train a Jackal with that has to cope with another one."""

JACKAL_REAL = Randomization(
    mass=(1.25, 1.25),
    friction=(0.55, 0.55),
    actuator_gain=(0.88, 0.88),
    actuator_delay=(3, 3),
    sensor_noise=(0.04, 0.04),
    lidar_dropout=(0.05, 0.05),
)
"""A held-out Jackal, beyond every range of ``JACKAL_TRAINING``: loaded, slippery, slow and noisy.

A stand-in for the real robot of SafeTAC's Table II; nobody measured one to choose these numbers.
"""

RANDOMIZATIONS = {"jackal_training": JACKAL_TRAINING, "jackal_real": JACKAL_REAL}
"""Profiles by name, for configurations."""


def drop_readings(
    scan: Array, dropout: Array, streams: RandomStreams, rows: NDArray[np.integer]
) -> Array:
    """A lidar's readings [n, R] with each lost, so zero, with probability ``dropout`` [n]."""
    return scan * (streams.uniform(rows, scan.shape[1]) >= dropout[:, None])


def add_noise(
    observation: NDArray[np.float32],
    deviation: Array,
    streams: RandomStreams,
    rows: NDArray[np.integer],
) -> NDArray[np.float32]:
    """Observations [n, D] plus independent normal noise of standard ``deviation`` [n]."""
    # Draws are in [0, 1), on a grid of 2^-53: half a step on, none is at an infinite quantile.
    noise = ndtri(streams.uniform(rows, observation.shape[1]) + 2.0**-54)
    return observation + (deviation[:, None] * noise).astype(np.float32)
