"""What the losses share: critics, kept as they were given, one by one or at once; estimators."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.parameter import is_lazy
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators, build_value_estimator
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_count, check_number

Ensemble = Callable[[TensorDictBase, TensorDictBase, NestedKey], Tensor]
ValueType: TypeAlias = ValueEstimators | str | type[ValueEstimatorBase] | ValueEstimatorBase


def as_given(
    network: TensorDictModule | Sequence[TensorDictModule],
    count: int,
    *,
    names: tuple[str, str],
    others: Iterable[nn.Parameter] = (),
) -> tuple[TensorDictModule | list[TensorDictModule], int | None]:
    """A critic as :meth:`~torchrl.objectives.LossModule.convert_to_functional` keeps it.

    That method draws the weights of whatever it expands anew, also of a single copy, and what was
    shared with other networks is then no longer shared. One network is therefore not expanded: the
    loss trains the network itself, with its weights and with the layers that it shares. Several
    copies of one network are expanded, as in TorchRL: their weights are drawn anew, apart from
    each other. A list of networks is stacked, with the weights they have.

    Args:
        network (TensorDictModule or list of them): the critic.
        count (int): number of networks.

    Keyword Args:
        names (tuple of str): of the two arguments of the loss, for errors.
        others (iterable of Parameter): parameters of other networks of the loss, which copies
            would not share with them.

    Returns:
        ``module`` and ``expand_dim``, arguments of
        :meth:`~torchrl.objectives.LossModule.convert_to_functional`.

    Raises:
        ValueError: if ``count`` is no positive integer, a list has another length or its networks
            are not of one kind, or copies would lose what is shared.
    """
    name, count_name = names
    check_count(count_name, count)
    is_list = isinstance(network, (list, tuple, nn.ModuleList))
    networks: list[Any] = list(network) if is_list else [network]
    if is_list and len(networks) != count:
        raise ValueError(
            f"{name}, a list of {len(networks)}, must have as many networks as {count_name} says, "
            f"got {count_name}={count}."
        )
    if count == 1:
        return networks[0], None
    kinds = [
        {key: None if is_lazy(p) else p.shape for key, p in each.state_dict().items()}
        for each in networks
    ]
    if any(kind != kinds[0] for kind in kinds):
        raise ValueError(f"{name}: networks of a list must have parameters of the same shapes.")
    parameters = [id(p) for each in networks for p in each.parameters()]
    if len(set(parameters)) < len(parameters) or not {id(p) for p in others}.isdisjoint(parameters):
        raise ValueError(
            f"{count_name}={count} makes copies, and {name} shares parameters with another network "
            f"of the loss, which copies would not. Allowed are {count_name}=1, or networks of "
            "their own."
        )
    return networks if is_list else network, count


def ensemble(module: TensorDictModule, *, randomness: str, deactivate_vmap: bool) -> Ensemble:
    """A network as a function of its input, of E sets of parameters and of the output in question.

    Args:
        module (TensorDictModule): the network. It is called as a module is, hooks included.

    Keyword Args:
        randomness (str): vmap's, ``"error"``, ``"different"`` or ``"same"``.
        deactivate_vmap (bool): call it E times in place of vmap. A CPU is faster at it, and so is
            this loop than TorchRL's: it stacks the output and nothing else.

    Returns:
        A function of a tensordict ``[*B]``, of parameters as
        :meth:`~torchrl.objectives.LossModule.convert_to_functional` makes them, ``[E]`` or, of one
        network, without batch size, and of a key. It returns what the module writes there,
        ``[E, *B, ...]``, and leaves its arguments alone. It raises ``KeyError`` if the module does
        not write there.
    """
    named = (*module.named_parameters(remove_duplicate=False),)
    named += (*module.named_buffers(remove_duplicate=False),)
    names = [name for name, _ in named]
    paths = [tuple(name.split(".")) for name in names]

    def call(tensordict: TensorDictBase, params: TensorDictBase, key: NestedKey) -> Tensor:
        def value_of(*tensors: Tensor) -> Tensor:
            inputs = tensordict.select(*module.in_keys, strict=False)
            state = dict(zip(names, tensors, strict=True))
            # A layer that is used twice is in the module twice, and has its weights twice.
            return functional_call(module, state, (inputs,), tie_weights=False)[key]

        tensors = [params.get(path) for path in paths]
        if not params.batch_dims:
            return value_of(*tensors).unsqueeze(0)
        if deactivate_vmap:
            members = zip(*(tensor.unbind(0) for tensor in tensors), strict=True)
            return torch.stack([value_of(*member) for member in members])
        return torch.vmap(value_of, randomness=randomness)(*tensors)

    return call


def make_estimator(
    loss: LossModule,
    value_type: ValueType,
    *,
    supported: Iterable[ValueEstimators | str],
    **hyperparams: Any,
) -> tuple[ValueEstimatorBase, ValueType]:
    """The value estimator that a loss was asked for.

    Args:
        loss (LossModule): whose networks a class or a name is tied to; left as it is.
        value_type (ValueEstimators, str, class or instance): a member or a name of ``supported``,
            in any case; a class, or an instance, which is taken as it is.

    Keyword Args:
        supported (iterable of ValueEstimators or str): members and names that the loss takes.
        **hyperparams: of the estimator.

    Returns:
        The estimator, and what the loss's ``value_type`` is then.

    Raises:
        ValueError: if ``value_type`` is none of these, or a discount is outside [0, 1].
    """
    if isinstance(value_type, ValueEstimatorBase):
        return value_type, type(value_type)
    for name in {"gamma", "lmbda"} & hyperparams.keys():
        discount = hyperparams[name]
        if isinstance(discount, Tensor) and discount.numel() == 1:
            discount = discount.item()
        check_number(name, discount, least=0, most=1)
    # No network but what the loss writes: the value of the next state.
    hyperparams = {"value_network": None, **hyperparams}
    if isinstance(value_type, type) and issubclass(value_type, ValueEstimatorBase):
        estimator: Any = value_type
        return estimator.for_loss(loss, **hyperparams), value_type
    kinds = {(kind if isinstance(kind, str) else kind.name).lower(): kind for kind in supported}
    asked: Any = value_type.name if isinstance(value_type, ValueEstimators) else value_type
    if not isinstance(asked, str) or asked.lower() not in kinds:
        raise ValueError(
            f"value_type must be one of {', '.join(map(repr, kinds))}, a member of ValueEstimators "
            f"of such a name, or a value estimator, class or instance, got {value_type!r}."
        )
    kind = kinds[asked.lower()]
    return build_value_estimator(loss, kind, **hyperparams), kind
