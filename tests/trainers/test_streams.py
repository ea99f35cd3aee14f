"""The seeds of all that is drawn."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.trainers.collectors import worker_seed
from torchrl_safe.trainers.streams import stream_seed


def test_is_numpys_sequence_of_name_and_numbers():
    """Written out: the letters of the name, then each number as two words of 32 bits."""
    key = (*b"worker", 7, 0, 5, 1)
    expected = np.random.SeedSequence(0x5AFE7AC, spawn_key=key).generate_state(1, np.uint64)[0]
    assert stream_seed("worker", 7, 2**32 + 5) == int(expected) // 2


def test_no_two_streams_are_one():
    """Also where numbers would run into one another, as 1, 0 and 2**32 do word by word."""
    numbers = (0, 1, 2, 3, 1_000_000, 1_000_003, 2**32 - 1, 2**32, 2**32 + 1, 2**63, 2**64 - 1)
    streams = [("evaluation",), ("final evaluation",)]
    for name in ("networks", "training", "worker", "gait", "evaluate.py"):
        streams += [(name, n) for n in numbers]
        streams += [(name, *pair) for pair in itertools.product(numbers, repeat=2)]
    seeds = {stream_seed(*stream) for stream in streams}
    assert len(seeds) == len(streams)
    assert all(0 <= seed < 2**63 for seed in seeds)


def test_numbers_out_of_range():
    for number in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"in \[0, 2\*\*64\), got {number} for 'training'"):
            stream_seed("training", number)


def test_no_resumption_trains_on_the_layouts_of_an_evaluation():
    """Seed plus frames once was the seed of the evaluation, for seed 3 at a million frames."""

    def layouts(seed):
        env = SafeGoalEnv("point", num_envs=3, num_threads=1, seed=seed)
        return env.reset()["observation"]

    judged = [layouts(stream_seed(n)) for n in ("evaluation", "final evaluation")]
    judged.append(layouts(stream_seed("evaluate.py", 0)))
    for seed, frames in ((3, 1_000_000), (1_000_003, 0), (3, 0), (0, 1_000_003), (0, 0)):
        training = stream_seed("training", seed, frames)
        for trained in (training, worker_seed(training, 0), worker_seed(training, 1)):
            seen = layouts(trained)
            assert not any((seen == each).all(-1).any() for each in judged)
