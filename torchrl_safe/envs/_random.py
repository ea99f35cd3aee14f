"""Independent random streams for a batch of environments, drawn in one vectorised call."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# SplitMix64 (Steele, Lea & Flood, OOPSLA 2014): its state is one counter, so a stream is one
#     integer,
# draws vectorise over streams, and saving the streams is copying an array.
_INCREMENT = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)


def check_seed(name: str, seed: object) -> None:
    """Raise a ``ValueError`` unless ``seed`` is None or an integer of at least 0."""
    if seed is not None and (not isinstance(seed, (int, np.integer)) or seed < 0):
        raise ValueError(f"{name} must be None or an integer >= 0, got {seed!r}.")


class RandomStreams:
    """One stream of uniform numbers per environment.

    What a stream yields depends on the seed, its index and how much was drawn from it before, never
    on which other streams were drawn from in the same call.

    Args:
        seed (int or None): the seed; ``None`` takes one from the operating system.
        num_streams (int): how many streams, N.

    Raises:
        ValueError: if the seed is negative or no integer.

    Examples:
        >>> import numpy as np
        >>> together = RandomStreams(0, 3).uniform(np.arange(3), 2)
        >>> alone = RandomStreams(0, 3).uniform(np.array([2]), 2)
        >>> bool((together[2] == alone[0]).all())
        True
    """

    def __init__(self, seed: int | None, num_streams: int) -> None:
        check_seed("seed", seed)
        children = np.random.SeedSequence(seed).spawn(num_streams)
        self.state = np.array([c.generate_state(1, np.uint64)[0] for c in children], np.uint64)

    def uniform(self, rows: NDArray[np.integer], count: int) -> NDArray[np.float64]:
        """The next ``count`` numbers in [0, 1) of each stream in ``rows``: [len(rows), count]."""
        numbers = self.peek(rows[:, None], np.arange(count))
        self.skip(rows, count)
        return numbers

    def peek(
        self,
        rows: NDArray[np.integer],
        which: NDArray[np.integer],
        ahead: NDArray[np.integer] | int = 0,
    ) -> NDArray[np.float64]:
        """Of the streams ``rows`` the numbers ``which``, counted from the next one, drawing none.

        All are broadcast, and rows may come more than once. The next ``ahead`` numbers are left
        out of the count.
        """
        first = self.state[rows] + np.asarray(ahead).astype(np.uint64) * _INCREMENT
        z = first + (which + 1).astype(np.uint64) * _INCREMENT
        # In place: memory that is asked for anew costs more than the arithmetic.
        high = z >> np.uint64(30)
        for factor, shift in ((_MIX_1, 27), (_MIX_2, 31)):
            z ^= high
            z *= factor
            np.right_shift(z, np.uint64(shift), out=high)
        z ^= high
        z >>= np.uint64(11)
        return z * 2.0**-53

    def skip(self, rows: NDArray[np.integer], count: int | NDArray[np.integer]) -> None:
        """Leaves out the next ``count`` numbers, one for all or [n], of each stream in ``rows``."""
        self.state[rows] += np.asarray(count).astype(np.uint64) * _INCREMENT
