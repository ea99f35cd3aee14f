"""Policies and critics of the options' sizes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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


def is_discrete(env: EnvBase) -> bool:
    """Whether an environment's action is one of several."""
    return isinstance(env.action_spec, OneHot | Categorical)


def make_policy(
    options: MethodOptions,
    env: EnvBase,
    *,
    in_keys: Sequence[str] = ("observation",),
    network: MakeNetwork | None = None,
) -> ProbabilisticActor:
    """The policy of the options, the mixture (11) in most; of discrete actions, a categorical one.

    Args:
        options (MethodOptions): ``policy``.
        env (EnvBase): whose observations and actions they are.

    Keyword Args:
        in_keys (sequence of str): what it reads.
        network (callable, optional): makes the network; by default it is an MLP of one vector.
    """
    inputs = [env.observation_spec[key] for key in in_keys]
    spec = env.action_spec_unbatched  # the policy acts in one environment as well
    if is_discrete(env):
        num_actions = spec.space.n
        module = _make(inputs, num_actions, options.policy.num_cells, options.device, network)
        return ProbabilisticActor(
            TensorDictModule(module, in_keys=list(in_keys), out_keys=["logits"]),
            spec=spec,
            in_keys=["logits"],
            distribution_class=OneHotCategorical,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
    if isinstance(options.policy, NoisyPolicy):
        module = _make(inputs, spec.shape[-1], options.policy.num_cells, options.device, network)
        return DeterministicPolicy(module, spec, noise=options.policy.noise, in_keys=list(in_keys))
    num_outputs = options.policy.num_components * (1 + 2 * spec.shape[-1])
    module = _make(inputs, num_outputs, options.policy.num_cells, options.device, network)
    low, high = options.policy.log_std_bounds
    return GMMTanhPolicy(
        module,
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
) -> ValueOperator:
    """A critic of observation and, by default, action; ``last`` goes behind its linear output."""
    keys = [*in_keys, *(["action"] if of_actions else [])]
    inputs = [env.action_spec if key == "action" else env.observation_spec[key] for key in keys]
    module = _make(
        inputs, num_outputs, options.critic.num_cells, options.device, network, inplace=True
    )
    if last:
        module = module.extend(last) if isinstance(module, MLP) else _Chain(module, *last)
    return ValueOperator(module, in_keys=keys, out_keys=[out_key])


class _Chain(nn.Sequential):
    """A network of one or more inputs, then layers."""

    def forward(self, *inputs: Tensor) -> Tensor:
        network, *layers = self
        return nn.Sequential(*layers)(network(*inputs))


def _make(
    inputs: list[TensorSpec],
    num_outputs: int,
    num_cells: list[int],
    device: str,
    network: MakeNetwork | None,
    *,
    inplace: bool = False,
) -> nn.Module:
    if network is not None:
        return network(inputs, num_outputs).to(device)
    return MLP(
        sum(spec.shape[-1] for spec in inputs),
        num_outputs,
        num_cells=num_cells,
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True} if inplace else None,  # half the memory to go through
        device=device,
    )
