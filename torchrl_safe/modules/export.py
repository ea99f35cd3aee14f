"""A trained policy as one file, for a machine without this library."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from torchrl_safe._extras import need
from torchrl_safe._files import expand, replacing

__all__ = ["DeterministicAction", "export_policy"]


class DeterministicAction(nn.Module):
    """A stochastic actor's deterministic action as a function of tensors, not tensordicts.

    Args:
        policy (ProbabilisticActor): an actor whose distribution has a ``deterministic_sample``.

    Examples:
        >>> import torch
        >>> from torch import nn
        >>> from torchrl.data import Bounded
        >>> from torchrl_safe import GMMTanhPolicy
        >>> policy = GMMTanhPolicy(nn.Linear(5, 15), Bounded(-1.0, 1.0, (2,)), num_components=3)
        >>> DeterministicAction(policy)(torch.zeros(4, 5)).shape
        torch.Size([4, 2])
    """

    def __init__(self, policy: ProbabilisticActor) -> None:
        super().__init__()
        self.policy = policy

    def forward(self, *inputs: Tensor) -> Tensor:
        """The action ``[B, A]`` for the tensors ``[B, ...]`` of the policy's ``in_keys``."""
        if len(inputs) != len(self.policy.in_keys):
            raise ValueError(
                f"inputs must be one tensor for each of {self.policy.in_keys}, got {len(inputs)}."
            )
        batch = inputs[0].shape[:1]
        entries = dict(zip(self.policy.in_keys, inputs, strict=True))
        return self.policy.get_dist(TensorDict(entries, batch)).deterministic_sample


def export_policy(
    policy: ProbabilisticActor, path: str | os.PathLike[str], example: TensorDictBase
) -> Path:
    """Writes a policy's deterministic action for any batch size as one self-contained file.

    * ``.pt2`` is a :func:`torch.export.export` program. It runs where torch runs:
      ``torch.export.load(path).module()(observation)``.
    * ``.onnx`` runs in any ONNX runtime: C, C++, JavaScript, microcontrollers. It needs the extra
      ``export``.

    There is no TorchScript: torch deprecated it in favour of ``torch.export``.

    Args:
        policy (ProbabilisticActor): an actor whose distribution has a ``deterministic_sample``.
        path (path): the file; its suffix picks the format. It appears whole or not at all. Missing
            parents are made.
        example (TensorDictBase): batch size [B] with the policy's ``in_keys``, such as
            ``env.reset()``; its values do not matter, its shapes and types do.

    Returns:
        Path: the file.

    Raises:
        ValueError: if the suffix is unknown or the example has no batch dimension.
        KeyError: if the example lacks a key of the policy.
        ModuleNotFoundError: if ``.onnx`` is asked for and its packages are missing.

    Examples:
        >>> import tempfile, torch
        >>> from tensordict import TensorDict
        >>> from torch import nn
        >>> from torchrl.data import Bounded
        >>> from torchrl_safe import GMMTanhPolicy
        >>> policy = GMMTanhPolicy(nn.Linear(5, 15), Bounded(-1.0, 1.0, (2,)), num_components=3)
        >>> example = TensorDict(observation=torch.zeros(1, 5), batch_size=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = export_policy(policy, f"{folder}/policy.pt2", example)
        ...     act = torch.export.load(path).module()
        >>> act(torch.zeros(7, 5)).shape
        torch.Size([7, 2])
    """
    path = expand(path)
    if path.suffix not in (".pt2", ".onnx"):
        raise ValueError(f"path must end in .pt2 or .onnx, got {str(path)!r}.")
    if example.ndim != 1:
        raise ValueError(f"example must have a batch size [B], got {tuple(example.batch_size)}.")
    missing = [key for key in policy.in_keys if key not in example.keys(True)]
    if missing:
        raise KeyError(f"example must have the policy's in_keys; {missing} are missing.")
    if path.suffix == ".onnx":
        need("writing .onnx (.pt2 needs torch alone)", "export", "onnx", "onnxscript")
    # A batch of one would be taken for a constant.
    inputs = tuple(
        example.get(key)[:1].expand(2, *example.get(key).shape[1:]).clone()
        for key in policy.in_keys
    )
    model = DeterministicAction(policy).eval()
    shapes = {"inputs": tuple({0: torch.export.Dim("batch")} for _ in inputs)}
    path.parent.mkdir(parents=True, exist_ok=True)
    with torch.no_grad(), warnings.catch_warnings():
        # Of torch's own exporters, about torch's own internals.
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        program = torch.export.export(model, inputs, dynamic_shapes=shapes, strict=False)
        with replacing(path) as draft:
            if path.suffix == ".pt2":
                torch.export.save(program, draft)
            else:
                torch.onnx.export(
                    program,
                    (),
                    draft,
                    input_names=[_flat(key) for key in policy.in_keys],
                    output_names=["action"],
                    external_data=False,
                    verbose=False,
                )
    return path


def _flat(key: str | tuple[str, ...]) -> str:
    return key if isinstance(key, str) else ".".join(key)
