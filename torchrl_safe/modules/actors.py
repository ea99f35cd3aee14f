"""The mixture policy: a network, its parameter head and the squashed Gaussian mixture."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import InteractionType, ProbabilisticTensorDictModule, TensorDictModule
from torch import Tensor, nn
from torchrl.data import Bounded, TensorSpec
from torchrl.modules import ProbabilisticActor, SafeProbabilisticModule

from torchrl_safe.modules.distributions import Relaxation, TanhGaussianMixture

__all__ = ["GMMParamExtractor", "GMMTanhPolicy"]


class GMMParamExtractor(nn.Module):
    """Split features into the parameters of a Gaussian mixture.

    The log standard deviation is a sigmoid of its feature scaled to ``log_std_bounds``, zero with
    slope one at feature zero: near there it is the feature itself, as under a clamp, but towards
    the bounds the gradient fades instead of vanishing, so that no component gets stuck. Bounds that
    do not have zero between them put feature zero at their middle.

    Args:
        num_components (int): number of Gaussians K.
        action_dim (int): number of action dimensions D.

    Keyword Args:
        log_std_bounds (tuple of float): range of the log standard deviation before tanh.
            Default: ``(-4.0, 2.0)``.

    Raises:
        ValueError: if a count is not positive or the bounds are not finite and increasing; in
            ``forward``, if the features do not have ``num_features`` columns.

    Examples:
        >>> import torch
        >>> extractor = GMMParamExtractor(num_components=3, action_dim=2)
        >>> extractor.num_features
        15
        >>> logits, loc, scale = extractor(torch.zeros(4, 15))
        >>> logits.shape, loc.shape, scale.shape
        (torch.Size([4, 3]), torch.Size([4, 3, 2]), torch.Size([4, 3, 2]))
        >>> scale.unique()
        tensor([1.])
    """

    def __init__(
        self,
        num_components: int,
        action_dim: int,
        *,
        log_std_bounds: tuple[float, float] = (-4.0, 2.0),
    ) -> None:
        super().__init__()
        for name, count in (("num_components", num_components), ("action_dim", action_dim)):
            if not isinstance(count, int) or count < 1:
                raise ValueError(f"{name}, an integer, must be at least 1, got {count}")
        low, high = log_std_bounds
        if not -math.inf < low < high < math.inf:
            raise ValueError(f"log_std_bounds must be finite and increasing, got {log_std_bounds}")
        self.num_components = num_components
        self.action_dim = action_dim
        self.log_std_bounds = (low, high)
        fraction = -low / (high - low) if low < 0 < high else 0.5
        self._shift = math.log(fraction / (1 - fraction))
        self._slope = 1 / ((high - low) * fraction * (1 - fraction))

    @property
    def num_features(self) -> int:
        """The number of features read, ``K (1 + 2 D)``."""
        return self.num_components * (1 + 2 * self.action_dim)

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Split ``[*B, K (1 + 2 D)]`` into logits ``[*B, K]``, loc and scale ``[*B, K, D]``."""
        if features.shape[-1:] != (self.num_features,):
            raise ValueError(
                f"features must have num_components * (1 + 2 * action_dim) = {self.num_features} "
                f"columns, got shape {tuple(features.shape)}"
            )
        components, dim = self.num_components, self.action_dim
        # One transposition here lays the parameters out as the distribution computes with them.
        logits, loc, log_std = (
            features.movedim(-1, 0)
            .contiguous()
            .split([components, components * dim, components * dim])
        )
        low, high = self.log_std_bounds
        log_std = low + (high - low) * torch.sigmoid(self._slope * log_std + self._shift)
        loc, scale = (
            parameter.unflatten(0, (components, dim)).movedim((0, 1), (-2, -1))
            for parameter in (loc, log_std.exp())
        )
        return logits.movedim(0, -1), loc, scale

    def extra_repr(self) -> str:
        """Describe the module in ``repr``."""
        return (
            f"num_components={self.num_components}, action_dim={self.action_dim}, "
            f"log_std_bounds={self.log_std_bounds}"
        )


class GMMTanhPolicy(ProbabilisticActor):
    """A stochastic actor whose action is a squashed Gaussian mixture, eqs. (11), (12) of SafeTAC.

    Calling it draws exact actions and writes ``action`` and ``action_log_prob``, which is
    ``get_dist(td).log_prob(action)``: the ratio of a policy to itself is 1, however saturated it
    is. The distribution's
    parameters stay out of the tensordict, hence out of the replay buffer; :meth:`get_dist` computes
    the distribution and leaves its input as it was.

    Args:
        network (nn.Module): maps the tensors of ``in_keys`` to ``num_components * (1 + 2 * D)``
            features, the ``num_features`` of :class:`GMMParamExtractor`.
        action_spec (Bounded): the action's spec, whose last dimension is D and whose bounds the
            actions fill. Leading dimensions are a batch, as in the spec of a batched environment or
            of agents, and must share them: an action that is a matrix has to be flattened.
            On an accelerator, pass the spec on the policy's device: the bounds do not move with it.

    Keyword Args:
        num_components (int): number of Gaussians K. Default: ``3``.
        in_keys (NestedKey or list of NestedKey): keys the network reads. As everywhere in
            tensordict, a list holds several keys and a tuple is one. Default: ``"observation"``.
        out_keys (list of NestedKey, optional): where the action is written.
            Default: ``["action"]``.
        relaxation (str): how losses differentiate through a draw, see
            :class:`TanhGaussianMixture`. Default: ``"implicit"``.
        temperature (float): temperature of the soft weights. Default: ``0.5``.
        log_std_bounds (tuple of float): see :class:`GMMParamExtractor`. Default: ``(-4.0, 2.0)``.
        return_log_prob (bool): whether to write ``action_log_prob``. Default: ``True``.

    Raises:
        TypeError: if ``action_spec`` is not a ``Bounded`` leaf of floating type.
        ValueError: if its bounds are infinite or differ along leading dimensions, or the mixture's
            arguments are out of range; when called, if the features have fewer batch dimensions
            than the spec.

    .. note:: Under ``ExplorationType.DETERMINISTIC`` the action is
        :attr:`TanhGaussianMixture.deterministic_sample`; there is no ``MODE``.

    .. note:: TorchRL's own losses call ``rsample_and_log_prob`` for their targets too. Under
        ``"gumbel_softmax"`` those are soft draws, which the policy never acts with; the other two
        relaxations draw exactly.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch import nn
        >>> from torchrl.data import Bounded
        >>> action_spec = Bounded(-1.0, 1.0, shape=(2,))
        >>> policy = GMMTanhPolicy(nn.Linear(5, 15), action_spec, num_components=3)
        >>> td = policy(TensorDict(observation=torch.randn(4, 5), batch_size=4))
        >>> sorted(td.keys())
        ['action', 'action_log_prob', 'observation']
        >>> policy.get_dist(td).log_prob(td["action"]).shape
        torch.Size([4])
    """

    def __init__(
        self,
        network: nn.Module,
        action_spec: TensorSpec,
        *,
        num_components: int = 3,
        in_keys: NestedKey | list[NestedKey] = "observation",
        out_keys: list[NestedKey] | None = None,
        relaxation: Relaxation = "implicit",
        temperature: float = 0.5,
        log_std_bounds: tuple[float, float] = (-4.0, 2.0),
        return_log_prob: bool = True,
    ) -> None:
        spec = single_action_spec(action_spec)
        extractor = GMMParamExtractor(num_components, spec.shape[-1], log_std_bounds=log_std_bounds)
        parameters = ["logits", "loc", "scale"]
        distribution_kwargs = {
            "low": spec.space.low,
            "high": spec.space.high,
            "relaxation": relaxation,
            "temperature": temperature,
        }
        # Complain about the arguments now and not at the first action.
        example = torch.ones(num_components, spec.shape[-1], device=spec.device)
        TanhGaussianMixture(example[:, 0], example, example, **distribution_kwargs)
        # As ProbabilisticActor's own constructor, with another last module.
        super(ProbabilisticActor, self).__init__(
            TensorDictModule(
                _Headed(network, extractor, action_spec.shape),
                in_keys=in_keys,
                out_keys=parameters,
            ),
            _StoredAction(
                in_keys=parameters,
                out_keys=["action"] if out_keys is None else out_keys,
                spec=spec,
                distribution_class=TanhGaussianMixture,
                distribution_kwargs=distribution_kwargs,
                default_interaction_type=InteractionType.RANDOM,
                return_log_prob=return_log_prob,
            ),
        )
        self.select_out_keys(*self[-1].out_keys)

    def get_dist(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs: Any,
    ) -> TanhGaussianMixture:
        """Return the action distribution at ``tensordict``, which is left as it was."""
        return super().get_dist(tensordict.select(*self.in_keys), tensordict_out, **kwargs)


class _StoredAction(SafeProbabilisticModule):
    """Draws an action and scores it as it is stored, rounded by tanh.

    TorchRL's own module scores the draw before tanh. Where tanh saturates, the policy's
    ``log_prob`` of the stored action is another number, and the ratio of a policy to itself not 1.
    """

    forward = ProbabilisticTensorDictModule.forward


class _Headed(nn.Sequential):
    """A network of one or more inputs, then a head."""

    def __init__(self, network: nn.Module, head: GMMParamExtractor, spec_shape: torch.Size) -> None:
        super().__init__(network, head)
        self.spec_shape = spec_shape

    def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        network, head = self
        features = network(*inputs)
        if features.ndim < len(self.spec_shape):
            raise ValueError(
                f"action_spec has shape {tuple(self.spec_shape)}: an action of "
                f"{self.spec_shape[-1]} numbers for each element of a batch. The network's "
                f"features, of shape {tuple(features.shape)}, have no such batch. If one action is "
                "an array, give the policy the spec of a flat action and reshape it in the "
                "environment; agents need features of their own."
            )
        return head(features)


def single_action_spec(spec: TensorSpec) -> Bounded:
    """The spec of one action out of that of a batch of them."""
    if not isinstance(spec, Bounded) or not spec.dtype.is_floating_point or spec.ndim < 1:
        raise TypeError(
            "action_spec must be a Bounded spec of floating type and at least one dimension (such "
            f"as env.action_spec_unbatched), got {spec}"
        )
    low, high = spec.space.low, spec.space.high
    if not bool((low.isfinite() & high.isfinite() & (low < high)).all()):
        raise ValueError(
            "action_spec must have finite bounds with low < high, got "
            f"low={low.tolist()} and high={high.tolist()}"
        )
    single = spec[(0,) * (spec.ndim - 1)]
    if not bool((low == single.space.low).all() & (high == single.space.high).all()):
        raise ValueError(
            f"action_spec must have one pair of bounds per action dimension, got {spec}"
        )
    return single
