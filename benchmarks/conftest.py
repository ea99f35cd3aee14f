"""Settings of all benchmarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import pytest
import torch

# Ratios between threaded programs depend on the machine; those on one thread hardly do.
torch.set_num_threads(1)

F = TypeVar("F", bound=Callable[..., Any])


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="cpu or cuda: where tensors are")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--device") == "cpu":
        skip = pytest.mark.skip(reason="a CUDA graph is a GPU's")
        for item in items:
            if "cuda_graph" in item.name:
                item.add_marker(skip)


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Where the benchmarked tensors are."""
    return request.config.getoption("--device")


@pytest.fixture
def timed(device: str) -> Callable[[F], F]:
    """Makes a function wait for what it has launched, where it would return before it is done."""

    def decorate(function: F) -> F:
        def call(*args: Any, **kwargs: Any) -> Any:
            out = function(*args, **kwargs)
            torch.cuda.synchronize()
            return out

        return function if device == "cpu" else call  # type: ignore[return-value]

    return decorate
