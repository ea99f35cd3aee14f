"""A limit that corrects itself until what is measured is what is allowed."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_safe._checks import check_number
from torchrl_safe.objectives.functional import check_cost_limit

__all__ = ["LimitController"]


class LimitController(nn.Module):
    r"""Moves the limit that a policy is held to until what it realises is what is allowed.

    An optimizer holds what it predicts. Where a policy's cost ends up above what was predicted,
    update after update, its level settles above the limit by as much. A PI controller of the
    difference lowers the limit in use, :math:`d_{used}`, until that has gone:

    .. math::

        e = \text{level} - d, \qquad
        I \leftarrow \text{clip}\left(I + k_i e,\; -l\,d,\; t\,d\right), \qquad
        d_{used} = d - \text{clip}\left(k_p e + I,\; -l\,d,\; t\,d\right)

    with the shares :math:`t` and :math:`l` of the limit that it may be tightened and loosened by.
    The integral is clipped to what it may do (anti-windup): however long the level was out of
    reach, nothing has to be wound back. The integral is in ``state_dict``.

    Keyword Args:
        kp (float): proportional gain, at least 0. Defaults to 0.
        ki (float): integral gain per update, positive: the level's difference to the limit decays
            like ``(1 - ki) ** updates`` where the level follows the limit at once. Slower than the
            policy follows its limit, or it oscillates. Defaults to 0.05.
        tighten (float): largest share of the limit to take off, in [0, 1]. Defaults to 0.5.
        loosen (float): largest share of the limit to add, at least 0. Defaults to 0: the limit in
            use is never above the allowed one.

    Raises:
        ValueError: if an argument is out of its range.

    Examples:
        A policy that ends .6 above whatever limit it is given:

        >>> from torchrl_safe.objectives import LimitController
        >>> controller = LimitController(ki=0.2)
        >>> used = 5.0
        >>> for _ in range(50):
        ...     used = controller.update(level=used + 0.6, cost_limit=5.0)
        >>> round(used, 3), round(used + 0.6, 3)
        (4.4, 5.0)
    """

    integral: Tensor

    def __init__(
        self, *, kp: float = 0.0, ki: float = 0.05, tighten: float = 0.5, loosen: float = 0.0
    ) -> None:
        super().__init__()
        check_number("kp", kp, least=0)
        check_number("ki", ki, positive=True)
        check_number("tighten", tighten, least=0, most=1)
        check_number("loosen", loosen, least=0)
        self.kp, self.ki, self.tighten, self.loosen = kp, ki, tighten, loosen
        self.register_buffer("integral", torch.zeros((), dtype=torch.float64))

    def update(self, level: float | Tensor, cost_limit: float | Tensor) -> float:
        """One step of the controller.

        Args:
            level (float or Tensor): what the policy of now realises, measured, a scalar: see
                ``on_policy_cvar`` of the cost losses.
            cost_limit (float or Tensor): what is allowed, a scalar in the same unit. It may change
                from update to update.

        Returns:
            The limit to hold the policy to until the next update, at least 0: the argument
            ``cost_limit`` of a loss's ``constraint``.

        Raises:
            ValueError: if ``level`` is not finite, or ``cost_limit`` negative or not finite; the
                state is then left as it was.
        """
        level, cost_limit = (x.item() if isinstance(x, Tensor) else x for x in (level, cost_limit))
        check_number("level", level)
        check_cost_limit(cost_limit)
        low, high = -self.loosen * cost_limit, self.tighten * cost_limit
        error = level - cost_limit
        self.integral.add_(self.ki * error).clamp_(low, high)
        correction = self.kp * error + self.integral.item()
        return cost_limit - min(max(correction, low), high)

    def extra_repr(self) -> str:
        """Describe the module in ``repr``."""
        return f"kp={self.kp}, ki={self.ki}, tighten={self.tighten}, loosen={self.loosen}"
