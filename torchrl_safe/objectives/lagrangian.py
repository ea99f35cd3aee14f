"""Lagrange multipliers: constraint, multiplier and Lagrangian as separate objects.

A constraint is a number that is feasible at or below 0, as
:meth:`~torchrl_safe.CVaRCostLoss.constraint` returns it. A multiplier prices it, and
:func:`lagrangian` puts both into what a policy maximises.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_safe._checks import check_count, check_number, check_shape

__all__ = ["LagrangeMultiplier", "PIDMultiplier", "exact_penalty", "lagrangian"]


def lagrangian(objective: Tensor, constraint: Tensor, multiplier: Tensor) -> Tensor:
    r"""Lagrangian of a constrained maximisation, rescaled.

    .. math::

        L = \frac{f - \sum_i \lambda_i c_i}{1 + \sum_i \lambda_i}

    The denominator moves no optimum over the policy. It keeps the gradient, a convex combination
    of those of objective and constraints, from growing with the multipliers (Stooke et al. 2020,
    https://arxiv.org/abs/2007.03964, section 6).

    Advantages are combined alike: that of ``L``, which PPO-Lagrangian and its kin follow, is the
    Lagrangian of those of return and costs, ``[*B]`` and ``[*B, m]``.

    Args:
        objective (Tensor): ``f``, to be maximised, ``[*B]``; a scalar in most cases.
        constraint (Tensor): ``c``, feasible at or below 0, ``[*B, m]``.
        multiplier (Tensor): ``lambda >= 0``, ``[m]``. No gradient flows to it.

    Returns:
        The Lagrangian, to be maximised, ``[*B]``.

    Raises:
        ValueError: if shapes disagree, a multiplier is negative, or one or a constraint is not
            finite. (Values are not looked at inside of :func:`torch.compile`.)

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import lagrangian
        >>> lagrangian(torch.tensor(4.0), torch.tensor([1.0]), torch.tensor([3.0]))
        tensor(0.2500)
    """
    if multiplier.ndim != 1 or constraint.shape != (*objective.shape, *multiplier.shape):
        raise ValueError(
            "objective, constraint and multiplier must have shapes [*B], [*B, m] and [m], got "
            f"{tuple(objective.shape)}, {tuple(constraint.shape)} and {tuple(multiplier.shape)}."
        )
    multiplier = multiplier.detach()
    if not torch.compiler.is_compiling():
        if not (multiplier.isfinite() & (multiplier >= 0)).all():
            raise ValueError(
                f"multiplier must be finite and at least 0, got {multiplier.tolist()}."
            )
        _check_finite(constraint)
    return (objective - (multiplier * constraint).sum(-1)) / (1 + multiplier.sum())


def exact_penalty(objective: Tensor, constraint: Tensor, penalty: float) -> Tensor:
    r"""Objective of a constrained maximisation, less a penalty on what violates it.

    .. math::

        f - \kappa \sum_i \max(0, c_i)

    The penalty is exact: above the largest multiplier of the constrained problem, any ``kappa`` has
    the same optimum as that problem has, and none has to be learned (P3O, Zhang et al. 2022,
    https://arxiv.org/abs/2205.11814).

    Args:
        objective (Tensor): ``f``, to be maximised, a scalar.
        constraint (Tensor): ``c``, feasible at or below 0, ``[m]``.
        penalty (float): ``kappa > 0``, in the unit of the objective per unit of a constraint.

    Returns:
        The penalised objective, to be maximised, a scalar.

    Raises:
        ValueError: if shapes disagree, or ``penalty`` is not positive and finite.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import exact_penalty
        >>> exact_penalty(torch.tensor(4.0), torch.tensor([-1.0, 0.5]), penalty=3.0)
        tensor(2.5000)
    """
    if objective.ndim or constraint.ndim != 1:
        raise ValueError(
            "objective and constraint must have shapes [] and [m], got "
            f"{tuple(objective.shape)} and {tuple(constraint.shape)}."
        )
    check_number("penalty", penalty, positive=True)
    return objective - penalty * constraint.relu().sum()


class LagrangeMultiplier(nn.Module):
    r"""Multipliers that a torch optimizer moves up the dual function, projected.

    .. math::

        \lambda \leftarrow (\lambda + \eta c)_+

    is projected dual ascent, and what :class:`torch.optim.SGD` does here. SAC-Lagrangian (Ha et al.
    2020, https://arxiv.org/abs/2002.08550) and WCSAC (Yang et al. 2021) constrain like this.

    The parameter is :math:`\lambda` itself. :meth:`loss` puts a step that ended below 0 back to 0,
    and has no gradient where a multiplier of 0 meets a constraint that holds: there it is at its
    optimum. A time of safety therefore leaves nothing to wind back, neither in the multiplier nor
    in the momentum of an optimizer, however long it was and however far inside the limit.

    .. note::
        Adam divides steps by a memory of gradients that lasts a thousand steps at its default
        ``betas``: a price then rises several times slower after a steep fall, or faster after a
        quiet time, than ``lr`` says. At ``betas=(0.9, 0.9)`` no step exceeds ``lr``, and both
        memories last some ten steps.

    Args:
        num_constraints (int): m. Defaults to 1.

    Keyword Args:
        init (float): multipliers to start with, at least 0. Defaults to 1.0.

    Raises:
        ValueError: if ``num_constraints`` is not a positive integer, or ``init`` is negative or not
            finite.

    Examples:
        A weight of 2 prices ``max -x^2`` to where ``x >= 1`` holds:

        >>> import torch
        >>> from torchrl_safe.objectives import LagrangeMultiplier, lagrangian
        >>> x, multiplier = torch.zeros(1, requires_grad=True), LagrangeMultiplier()
        >>> policy_optim = torch.optim.SGD([x], lr=0.1, maximize=True)
        >>> multiplier_optim = torch.optim.SGD(multiplier.parameters(), lr=0.05)
        >>> for _ in range(1000):
        ...     constraint = 1 - x
        ...     policy_optim.zero_grad()
        ...     lagrangian(-x.square().sum(), constraint, multiplier()).backward()
        ...     policy_optim.step()
        ...     multiplier_optim.zero_grad()
        ...     multiplier.loss(constraint).backward()
        ...     multiplier_optim.step()
        >>> round(x.item(), 2), round(multiplier().item(), 2)
        (1.0, 2.0)
    """

    def __init__(self, num_constraints: int = 1, *, init: float = 1.0) -> None:
        super().__init__()
        check_count("num_constraints", num_constraints)
        check_number("init", init, least=0)
        self.multiplier = nn.Parameter(torch.full((num_constraints,), float(init)))

    def forward(self) -> Tensor:
        """The multipliers, ``[m]``."""
        return self.multiplier.clamp(min=0)

    def loss(self, constraint: Tensor) -> Tensor:
        """What the multipliers' optimizer minimises: a violated constraint raises its price.

        Args:
            constraint (Tensor): ``[m]``, feasible at or below 0. No gradient flows to it.

        Returns:
            ``-lambda' c``, a scalar.

        Raises:
            ValueError: if ``constraint`` has another shape or is not finite.
        """
        constraint = _checked(constraint, self.multiplier)
        with torch.no_grad():
            self.multiplier.clamp_(min=0)
            at_rest = (self.multiplier == 0) & (constraint <= 0)
        return -(self.multiplier * constraint.masked_fill(at_rest, 0.0)).sum()

    def extra_repr(self) -> str:
        """Describe the module in ``repr``."""
        return f"num_constraints={len(self.multiplier)}"


class PIDMultiplier(nn.Module):
    r"""Multipliers set by a PID controller of the constraint.

    Algorithm 2 of "Responsive safety in reinforcement learning by PID Lagrangian methods" (Stooke
    et al. 2020, https://arxiv.org/abs/2007.03964), with the constraint as the error:

    .. math::

        I \leftarrow (I + c)_+, \qquad
        \lambda \leftarrow \left(K_P c + K_I I + K_D (c - c_{prev})_+\right)_+

    With ``ki`` alone it is gradient ascent on the multiplier, projected to ``lambda >= 0``; the
    other two terms damp its oscillation. The state (integral, last constraint, multipliers) is in
    ``state_dict``; nothing is learned by gradient.

    Args:
        num_constraints (int): m. Defaults to 1.

    Keyword Args:
        kp (float): proportional gain, at least 0.
        ki (float): integral gain, at least 0.
        kd (float): derivative gain, at least 0. Defaults to 0.
        init (float): multipliers to start with, at least 0. They enter the integral, so a positive
            ``init`` needs a positive ``ki``. Defaults to 0.

    Raises:
        ValueError: if an argument is out of its range, or all gains are 0.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives import PIDMultiplier
        >>> multiplier = PIDMultiplier(kp=1.0, ki=0.1, kd=0.5)
        >>> multiplier.update(torch.tensor([2.0]))  # 1 * 2 + .1 * 2
        tensor([2.2000])
        >>> multiplier.update(torch.tensor([3.0]))  # 1 * 3 + .1 * 5 + .5 * 1
        tensor([4.])
        >>> multiplier()
        tensor([4.])
    """

    integral: Tensor
    previous: Tensor
    multiplier: Tensor

    def __init__(
        self,
        num_constraints: int = 1,
        *,
        kp: float,
        ki: float,
        kd: float = 0.0,
        init: float = 0.0,
    ) -> None:
        super().__init__()
        check_count("num_constraints", num_constraints)
        for name, value in (("kp", kp), ("ki", ki), ("kd", kd), ("init", init)):
            check_number(name, value, least=0)
        if not kp + ki + kd > 0:
            raise ValueError("one of kp, ki and kd must be positive, got 0 for all of them.")
        if init > 0 and not ki > 0:
            raise ValueError(f"init={init} needs a positive ki, got ki={ki}.")
        self.kp, self.ki, self.kd = kp, ki, kd
        self.register_buffer("integral", torch.full((num_constraints,), init / ki if ki else 0.0))
        # NaN: there is no last constraint yet, and no derivative.
        self.register_buffer("previous", torch.full((num_constraints,), torch.nan))
        self.register_buffer("multiplier", torch.full((num_constraints,), float(init)))

    def forward(self) -> Tensor:
        """The multipliers, ``[m]``."""
        return self.multiplier

    def update(self, constraint: Tensor) -> Tensor:
        """One step of the controller.

        Args:
            constraint (Tensor): ``[m]``, feasible at or below 0.

        Returns:
            The new multipliers, ``[m]``.

        Raises:
            ValueError: if ``constraint`` has another shape, is not finite or so large that a
                multiplier would not be; the state is then left as it was.
        """
        error = _checked(constraint, self.multiplier)
        rise = torch.where(self.previous.isnan(), 0.0, error - self.previous).clamp(min=0)
        integral = (self.integral + error).clamp(min=0)
        multiplier = (self.kp * error + self.ki * integral + self.kd * rise).clamp(min=0)
        if not (integral.isfinite() & multiplier.isfinite()).all():
            raise ValueError(
                f"constraint must leave the multiplier finite, got {error.tolist()} at integral "
                f"{self.integral.tolist()}."
            )
        self.integral, self.previous, self.multiplier = integral, error, multiplier
        return multiplier

    def extra_repr(self) -> str:
        """Describe the module in ``repr``."""
        return f"num_constraints={len(self.multiplier)}, kp={self.kp}, ki={self.ki}, kd={self.kd}"


def _checked(constraint: Tensor | Sequence[float], like: Tensor) -> Tensor:
    """A copy of a constraint without gradient, on the device and of the dtype of multipliers."""
    constraint = torch.as_tensor(constraint).detach().to(like, copy=True)
    check_shape("constraint", constraint, like.shape, "that of the multiplier")
    _check_finite(constraint)
    return constraint


def _check_finite(constraint: Tensor) -> None:
    if not constraint.isfinite().all():
        raise ValueError(f"constraint must be finite, got {constraint.tolist()}.")
