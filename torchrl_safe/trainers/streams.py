"""Seeds of everything that is drawn: one sequence, and a name for each part of it."""

from __future__ import annotations

import numpy as np

ENTROPY = 0x5AFE7AC  # the one sequence of all runs: a stream is what its name and numbers make it
WORD = 2**32


def stream_seed(name: str, *numbers: int) -> int:
    """The seed of a stream.

    Streams of other names, or of other numbers under the same name, are independent: no seed of a
    run and no number of frames leads training to the layouts of an evaluation.

    ========================  ==========================  =========================================
    Name                      Numbers                     Whose
    ========================  ==========================  =========================================
    ``networks``              seed                        weights, and the noise of this process
    ``training``              seed, frames done before    environments, of each resumption its own
    ``worker``                seed of the above, worker   environments and noise of one process
    ``standardization``       seed                        environments of ``standardize_frames``
    ``gait``                  seed                        the search of ``doggo_controller.py``
    ``calibration``           seed                        the safety critic, at the end of training
    ``evaluation``            none: equal for all runs    evaluations during training
    ``final evaluation``      none: equal for all runs    the evaluation at the end
    ``evaluate.py``           its ``--seed``              evaluations afterwards
    ========================  ==========================  =========================================

    Args:
        name (str): of the stream.
        *numbers (int): in [0, 2**64), what tells its parts apart.

    Returns:
        int: in [0, 2**63), which every generator takes.

    Raises:
        ValueError: if a number is out of range.

    Examples:
        >>> stream_seed("training", 3, 0) == stream_seed("training", 3, 0)
        True
        >>> stream_seed("training", 3, 0) == stream_seed("training", 3, 8000)
        False
    """
    for number in numbers:
        if not 0 <= number < WORD**2:
            raise ValueError(f"numbers must be in [0, 2**64), got {number} for {name!r}.")
    # Two words for each number, whatever its size: lists of words that differ stay different.
    words = [word for number in numbers for word in (number % WORD, number // WORD)]
    sequence = np.random.SeedSequence(ENTROPY, spawn_key=(*name.encode(), *words))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))
