"""Policies and critics of the options' sizes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import (
    MLP,
    OneHotCategorical,
    ProbabilisticActor,
    ValueOperator,
)

from torchrl_safe import GMMTanhPolicy
from torchrl_safe.modules import DeterministicPolicy
from torchrl_safe.trainers.options import MethodOptions, NoisyPolicy

MakeNetwork = Callable[[list[TensorSpec], int], nn.Module]
"""From the specs of a network's inputs and its number of outputs to the network."""


class Scale(NamedTuple):
    """Where the values of an observation lie, per entry.

    Attributes:
        loc: their mean, ``[d]``.
        scale: their standard deviation, ``[d]``; 1 where they are all alike.
    """

    loc: Tensor
    scale: Tensor


def scale_of(values: Tensor) -> Scale:
    """Mean and standard deviation of ``values``, ``[*B, d]``.

    Examples:
        >>> scale_of(torch.tensor([[1.0, 9.8], [3.0, 9.8]]))
        Scale(loc=tensor([2.0000, 9.8000]), scale=tensor([1.4142, 1.0000]))
    """
    deviation, mean = torch.std_mean(values.flatten(0, -2).double(), 0)
    # What is constant up to rounding has no unit to be measured in.
    alike = deviation <= 1e-6 * mean.abs().clamp(min=1.0)
    return Scale(mean.float(), deviation.masked_fill(alike, 1.0).float())


class Standardize(nn.Module):
    """Values less a mean, by a deviation, within ``limit`` deviations.

    Args:
        loc (Tensor): means, ``[d]``.
        scale (Tensor): standard deviations, ``[d]``.
        limit (float): what is further away is cut off. Defaults to 10.

    Examples:
        >>> standardize = Standardize(torch.tensor([9.8, 0.0]), torch.tensor([2.0, 1.0]))
        >>> standardize(torch.tensor([11.8, 0.5]))
        tensor([1.0000, 0.5000])
    """

    loc: Tensor
    scale: Tensor

    def __init__(self, loc: Tensor, scale: Tensor, limit: float = 10.0) -> None:
        super().__init__()
        self.register_buffer("loc", loc)
        self.register_buffer("scale", scale)
        self.limit = limit

    def forward(self, values: Tensor) -> Tensor:
        """The same, ``[*B, d]``."""
        return ((values - self.loc) / self.scale).clamp(-self.limit, self.limit)


def is_discrete(env: EnvBase) -> bool:
    """Whether an environment's action is one of several."""
    return isinstance(env.action_spec, OneHot | Categorical)


def make_policy(
    options: MethodOptions,
    env: EnvBase,
    *,
    in_keys: Sequence[str] = ("observation",),
    network: MakeNetwork | None = None,
    scales: Mapping[str, Scale] | None = None,
) -> ProbabilisticActor:
    """The policy of the options, the mixture (11) in most; of discrete actions, a categorical one.

    Args:
        options (MethodOptions): ``policy``.
        env (EnvBase): whose observations and actions they are.

    Keyword Args:
        in_keys (sequence of str): what it reads.
        network (callable, optional): makes the network; by default it is an MLP of one vector.
        scales (mapping, optional): with ``env.standardize_frames``, of what it reads, by key; by
            default those that come with the weights that will be loaded.
    """
    make = partial(_make, options, env, list(in_keys), options.policy.num_cells, network, scales)
    spec = env.action_spec_unbatched  # the policy acts in one environment as well
    if is_discrete(env):
        return ProbabilisticActor(
            TensorDictModule(make(spec.space.n), in_keys=list(in_keys), out_keys=["logits"]),
            spec=spec,
            in_keys=["logits"],
            distribution_class=OneHotCategorical,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
    if isinstance(options.policy, NoisyPolicy):
        module = make(spec.shape[-1])
        return DeterministicPolicy(module, spec, noise=options.policy.noise, in_keys=list(in_keys))
    low, high = options.policy.log_std_bounds
    return GMMTanhPolicy(
        make(options.policy.num_components * (1 + 2 * spec.shape[-1])),
        spec,
        num_components=options.policy.num_components,
        in_keys=list(in_keys),
        relaxation=options.policy.relaxation,
        temperature=options.policy.temperature,
        log_std_bounds=(low, high),
    )


def make_critic(
    options: MethodOptions,
    env: EnvBase,
    out_key: str,
    *last: nn.Module,
    of_actions: bool = True,
    num_outputs: int = 1,
    in_keys: Sequence[str] = ("observation",),
    network: MakeNetwork | None = None,
    scales: Mapping[str, Scale] | None = None,
) -> ValueOperator:
    """A critic of observation and, by default, action; ``last`` goes behind its linear output."""
    keys = [*in_keys, *(["action"] if of_actions else [])]
    cells = options.critic.num_cells
    module = _make(options, env, keys, cells, network, scales, num_outputs, inplace=True)
    if last:
        module = module.extend(last) if isinstance(module, MLP) else _Chain(module, *last)
    return ValueOperator(module, in_keys=keys, out_keys=[out_key])


class _Chain(nn.Sequential):
    """A network of one or more inputs, then layers."""

    def forward(self, *inputs: Tensor) -> Tensor:
        network, *layers = self
        values = network(*inputs)
        for layer in layers:
            values = layer(values)
        return values


def _make(
    options: MethodOptions,
    env: EnvBase,
    keys: list[str],
    num_cells: list[int],
    network: MakeNetwork | None,
    scales: Mapping[str, Scale] | None,
    num_outputs: int,
    *,
    inplace: bool = False,
) -> nn.Module:
    specs = {key: env.action_spec if key == "action" else env.observation_spec[key] for key in keys}
    if network is not None:
        if options.env.standardize_frames:
            raise ValueError(
                "env.standardize_frames must be 0 with a network of one's own, which standardises "
                f"what it reads itself, got {options.env.standardize_frames}."
            )
        return network(list(specs.values()), num_outputs).to(options.device)
    widths = {key: spec.shape[-1] for key, spec in specs.items()}
    mlp = MLP(
        sum(widths.values()),
        num_outputs,
        num_cells=num_cells,
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True} if inplace else None,  # half the memory to go through
        device=options.device,
    )
    if options.env.standardize_frames:
        each = [(scales or {}).get(key) or _as_they_are(width) for key, width in widths.items()]
        loc, scale = (torch.cat(values) for values in zip(*each, strict=True))
        mlp.insert(0, Standardize(loc, scale).to(options.device))
    return mlp


def _as_they_are(width: int) -> Scale:
    return Scale(torch.zeros(width), torch.ones(width))
