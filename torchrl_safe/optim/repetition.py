"""The same computation several times in a row: one by one, or as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeAlias

import torch
from torch import Tensor

State: TypeAlias = Sequence[Tensor]
Iteration: TypeAlias = Callable[..., State]
Repeat: TypeAlias = Callable[[Iteration, State, int], State]


def one_by_one(iteration: Iteration, state: State, times: int) -> State:
    """Repeats by calling.

    Args:
        iteration (callable): from some tensors to as many others, of the same shapes and dtypes.
        state (sequence of torch.Tensor): what it is given first.
        times (int): how often it is called.

    Returns:
        sequence of torch.Tensor: what the last call returned.

    Examples:
        >>> one_by_one(lambda x, y: (y, x + y), (torch.tensor(0), torch.tensor(1)), times=6)
        (tensor(8), tensor(13))
    """
    for _ in range(times):
        state = iteration(*state)
    return state


class CudaGraphRepeat:
    """Repeats by launching the kernels of an iteration at once, which spares waiting for Python.

    An iteration, which must return new tensors, is called once, while it is recorded, and the graph
    launched ``times`` times. Kernels of the default stream cannot be recorded, and those of a
    backward pass are on the stream of the forward pass: this object is called inside
    :meth:`stream`, and so is what computes all that an iteration differentiates.

    Args:
        device (torch.device): a CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self._stream = torch.cuda.Stream(device)
        # The last one is kept: the next takes over its memory.
        self._graph: torch.cuda.CUDAGraph | None = None

    @contextmanager
    def stream(self) -> Iterator[None]:
        """A stream that can be recorded; what is before waits for nothing, what is after for it."""
        outer = torch.cuda.current_stream(self._stream.device)
        self._stream.wait_stream(outer)
        try:
            with torch.cuda.stream(self._stream):
                yield
        finally:
            outer.wait_stream(self._stream)

    def __call__(self, iteration: Iteration, state: State, times: int) -> State:
        """See :func:`one_by_one`."""
        first = self._graph is None
        if first:  # what is settled once cannot be recorded
            state = iteration(*state)
        state = [tensor.clone() for tensor in state]
        graph = torch.cuda.CUDAGraph()
        # torch.cuda.graph would give all cached memory back to the driver before it begins.
        graph.capture_begin(pool=None if self._graph is None else self._graph.pool())
        try:
            for kept, new in zip(state, iteration(*state), strict=True):
                kept.copy_(new)
        finally:
            graph.capture_end()
        self._graph = graph
        for _ in range(times - first):
            graph.replay()
        return state
