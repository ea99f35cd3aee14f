"""A deterministic policy that explores with Gaussian noise, as TD3 and DDPG have it."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Distribution, constraints
from torchrl.data import TensorSpec
from torchrl.modules import ProbabilisticActor, TanhModule

from torchrl_safe._checks import check_number
from torchrl_safe.modules.actors import single_action_spec

__all__ = ["ClippedGaussian", "DeterministicPolicy"]


class ClippedGaussian(Distribution):
    r"""A Gaussian that is cut off at bounds: what lies beyond falls onto the bound.

    .. math::

        a = \text{clip}(\mu + \sigma \epsilon, l, h), \qquad \epsilon \sim N(0, I)

    A number inside has the Gaussian's density; a bound has the probability of all that falls onto
    it. :meth:`log_prob` is the logarithm of either (Fujita and Maeda 2018,
    https://arxiv.org/abs/1802.07564, section 3), so that ratios of two policies are right
    everywhere.

    Args:
        loc (Tensor): :math:`\mu`, the deterministic action, ``[*B, D]``.
        scale (Tensor): :math:`\sigma > 0`, ``[*B, D]`` or what broadcasts to it.
        low (Tensor): :math:`l`, likewise.
        high (Tensor): :math:`h`, likewise.

    Examples:
        >>> import torch
        >>> from torchrl_safe.modules import ClippedGaussian
        >>> low, high = torch.tensor([[-1.0], [1.0]])
        >>> dist = ClippedGaussian(torch.ones(1), torch.full((1,), 0.1), low, high)
        >>> dist.deterministic_sample
        tensor([1.])
        >>> dist.log_prob(torch.ones(1)).exp()  # half of the noise is cut off
        tensor(0.5000)
    """

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = True

    def __init__(self, loc: Tensor, scale: Tensor, low: Tensor, high: Tensor) -> None:
        self.loc, self.scale, self.low, self.high = torch.broadcast_tensors(loc, scale, low, high)
        super().__init__(self.loc.shape[:-1], self.loc.shape[-1:], validate_args=False)

    @property
    def deterministic_sample(self) -> Tensor:
        """The action without noise, ``[*B, D]``."""
        return self.loc

    def rsample(self, sample_shape: torch.Size | list[int] | tuple[int, ...] = ()) -> Tensor:
        """Draws, ``[*sample_shape, *B, D]``; none of those on a bound has a gradient."""
        shape = self._extended_shape(torch.Size(sample_shape))
        noise = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        return torch.clamp(self.loc + self.scale * noise, self.low, self.high)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log-density inside of the bounds, log-probability on them, ``[*B]``."""
        standard = (value - self.loc) / self.scale
        inside = -0.5 * standard.square() - self.scale.log() - 0.5 * math.log(2 * math.pi)
        on_low = torch.special.log_ndtr((self.low - self.loc) / self.scale)
        on_high = torch.special.log_ndtr((self.loc - self.high) / self.scale)
        cut = torch.where(value <= self.low, on_low, on_high)
        return torch.where((value > self.low) & (value < self.high), inside, cut).sum(-1)


class DeterministicPolicy(ProbabilisticActor):
    """A deterministic actor, with Gaussian noise to explore.

    Under ``ExplorationType.DETERMINISTIC``, and in the losses of TorchRL's that need it, the action
    is ``tanh`` of the network, scaled to the bounds. Otherwise noise is added, and the sum cut off
    at the bounds (Fujimoto et al. 2018, https://arxiv.org/abs/1802.09477).

    Args:
        network (nn.Module): maps the tensors of ``in_keys`` to D features.
        action_spec (Bounded): the action's spec, as of :class:`~torchrl_safe.GMMTanhPolicy`.

    Keyword Args:
        noise (float): standard deviation of the noise, as a share of half the action's range.
            Defaults to 0.1.
        in_keys (NestedKey or list of NestedKey): keys the network reads. Defaults to
            ``"observation"``.

    Raises:
        TypeError: if ``action_spec`` is not a ``Bounded`` leaf of floating type.
        ValueError: if its bounds are infinite or differ along leading dimensions, or ``noise`` is
            not positive.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch import nn
        >>> from torchrl.data import Bounded
        >>> from torchrl.envs import ExplorationType, set_exploration_type
        >>> from torchrl_safe.modules import DeterministicPolicy
        >>> network = nn.Linear(5, 2)
        >>> policy = DeterministicPolicy(network, Bounded(-1.0, 1.0, shape=(2,)), noise=0.2)
        >>> td = TensorDict(observation=torch.zeros(4, 5), batch_size=4)
        >>> with set_exploration_type(ExplorationType.DETERMINISTIC):
        ...     action = policy(td)["action"]
        >>> torch.allclose(action, network.bias.tanh())
        True
    """

    def __init__(
        self,
        network: nn.Module,
        action_spec: TensorSpec,
        *,
        noise: float = 0.1,
        in_keys: NestedKey | list[NestedKey] = "observation",
    ) -> None:
        check_number("noise", noise, positive=True)
        spec = single_action_spec(action_spec)
        low, high = spec.space.low, spec.space.high
        super().__init__(
            TensorDictSequential(
                TensorDictModule(network, in_keys=in_keys, out_keys=["loc"]),
                TanhModule(in_keys=["loc"], low=low, high=high),
            ),
            in_keys=["loc"],
            spec=spec,
            distribution_class=ClippedGaussian,
            distribution_kwargs={"scale": noise * (high - low) / 2, "low": low, "high": high},
            default_interaction_type=InteractionType.RANDOM,
            return_log_prob=True,
            log_prob_key="action_log_prob",
        )
        self.select_out_keys(*self[-1].out_keys)

    def get_dist(
        self,
        tensordict: TensorDictBase,
        tensordict_out: TensorDictBase | None = None,
        **kwargs: Any,
    ) -> ClippedGaussian:
        """Return the action distribution at ``tensordict``, which is left as it was."""
        return super().get_dist(tensordict.select(*self.in_keys), tensordict_out, **kwargs)
