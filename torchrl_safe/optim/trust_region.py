"""A constrained trust-region step for any model: CPO, TRC, TRPO and SafeTAC under one optimizer."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_safe.optim.curvature import (
    StatisticsKL,
    conjugate_gradient,
    detach,
    flatten,
    gauss_newton_product,
    hessian_product,
    unflatten,
)
from torchrl_safe.optim.subproblem import Subproblem, solve_subproblem

Closure = Callable[[], TensorDictBase]

CASES = ("unconstrained", "inert", "feasible", "recoverable", "infeasible", "rejected")
"""Names of the cases of a step; a report's ``case_code`` is the position in this list."""


@dataclass(frozen=True)
class TrustRegionReport:
    """What a step did. Predictions are those of the linear model, for the step as accepted.

    Attributes:
        case (str): of the subproblem, see
            :class:`~torchrl_safe.optim.subproblem.Subproblem`; ``"rejected"`` if there was none
            to solve.
        accepted (bool): whether the parameters moved.
        reason (str): why they did not; empty otherwise.
        kl (float): divergence of the new policy, in nats; 0 if nothing moved.
        step_fraction (float): share of the subproblem's step that was taken.
        backtracks (int): candidates that the line search turned down.
        objective (float): before the step.
        objective_change (float): what the step did.
        objective_predicted (float): what it should have done.
        constraint (list of float): before the step, [m].
        constraint_change (list of float): what the step did, [m].
        constraint_predicted (list of float): what it should have done, [m].
        cg_residual (float): largest relative residual of the conjugate gradients' systems.
    """

    case: str
    accepted: bool
    reason: str = ""
    kl: float = 0.0
    step_fraction: float = 0.0
    backtracks: int = 0
    objective: float = math.nan
    objective_change: float = 0.0
    objective_predicted: float = 0.0
    constraint: tuple[float, ...] = ()
    constraint_change: tuple[float, ...] = ()
    constraint_predicted: tuple[float, ...] = ()
    cg_residual: float = math.nan

    def to_dict(self, prefix: str = "update/") -> dict[str, float]:
        """The numbers of the report under flat names, for a logger.

        A single constraint keeps its name, several are numbered: ``constraint_0`` and so on.

        Args:
            prefix (str): put before every name. Defaults to ``"update/"``.

        Examples:
            >>> report = TrustRegionReport(case="feasible", accepted=True, constraint=(-0.5,))
            >>> numbers = report.to_dict()
            >>> numbers["update/case_code"], numbers["update/constraint"]
            (2.0, -0.5)
        """
        numbers = {"case_code": float(CASES.index(self.case))}
        for name, value in vars(self).items():
            if isinstance(value, tuple):
                names = [name] if len(value) == 1 else [f"{name}_{i}" for i in range(len(value))]
                numbers.update(zip(names, value, strict=True))
            elif not isinstance(value, str):
                numbers[name] = float(value)
        return {prefix + name: value for name, value in numbers.items()}


class _Rejected(Exception):
    """A step that cannot be computed; the message says why."""


@dataclass(frozen=True)
class _Evaluation:
    """A closure's numbers, in double precision on the CPU."""

    objective: float
    constraint: NDArray[np.float64]
    kl: float

    def is_finite(self) -> bool:
        return bool(np.isfinite([self.objective, self.kl, *self.constraint]).all())


class TrustRegionSafeOptimizer(torch.optim.Optimizer):
    r"""Maximises an objective under constraints, inside a KL trust region, (13)-(17) of SafeTAC.

    One step linearises objective ``f`` and constraints ``c``, takes the curvature ``H`` of the
    KL, and solves

    .. math::

        \max_x g^\top x \quad \text{s.t.} \quad c + B x \le 0, \quad
        \tfrac12 x^\top H x \le \delta

    for the direction ``x``; a line search then shortens it until the true KL is inside the region
    and the true objective and constraints did what a step of its kind must do:

    * the KL is at most ``max_kl``;
    * a constraint that held still holds, and one that was violated is not violated more;
    * the objective did not fall, if all constraints held.

    When no candidate does, or anything is not finite, the parameters are put back bit for bit and
    the report says why. Without constraints this is TRPO (https://arxiv.org/abs/1502.05477), with
    them CPO (https://arxiv.org/abs/1705.10528): the closure decides.

    **The closure** is a deterministic function of the current parameters (draw noise once, before
    the step) that returns a TensorDict without batch size, holding

    * ``"objective"``: scalar, maximised;
    * ``"constraint"``: [m], feasible at or below 0; absent or empty for none;
    * ``"kl"``: scalar, zero with zero gradient at the parameters the step starts from. Curvature
      products then differentiate it twice; or
    * ``"statistics"``: a tensor or TensorDict that determines the policy on the batch, such as its
      moments, with ``statistics_kl`` given to the constructor. The KL is then
      ``statistics_kl(old, new)``, and its curvature products are exact Gauss-Newton ones,
      linearised once a step.

    Args:
        params (iterable of Parameter): parameters of the policy.

    Keyword Args:
        max_kl (float): size of the region, in nats. Defaults to 1e-3.
        damping (float): added to the diagonal of the curvature. Defaults to 0.01.
        cg_iters (int): conjugate-gradient iterations. Defaults to 10.
        backtrack_ratio (float): factor of the line search, in (0, 1). Defaults to 0.8.
        max_backtracks (int): how often it is applied at most. Defaults to 10.
        recovery_ratio (float): share of the region's radius that a violated constraint may claim,
            in (0, 1]; the rest goes to the objective. At 1 a violation that cannot be removed at
            once gives CPO's pure recovery step. Defaults to 1.0.
        statistics_kl (callable, optional): from old and new statistics to their mean KL, a scalar.

    ``max_kl``, ``damping``, ``backtrack_ratio``, ``max_backtracks``, ``cg_iters`` and
    ``recovery_ratio`` live in ``param_groups[0]`` and may be scheduled there.

    Raises:
        ValueError: if an argument is out of its range, or the parameters differ in dtype or device.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_safe import TrustRegionSafeOptimizer
        >>> x = torch.nn.Parameter(torch.zeros(2))
        >>> optim = TrustRegionSafeOptimizer([x], max_kl=0.5, damping=0.0)
        >>> old = x.detach().clone()
        >>> def closure():  # go right, but no further than 0.6
        ...     return TensorDict(
        ...         {
        ...             "objective": x[0],
        ...             "constraint": (x[0] - 0.6)[None],
        ...             "kl": 0.5 * (x - old).square().sum(),
        ...         }
        ...     )
        >>> report = optim.step(closure)
        >>> report.case, report.accepted, round(x[0].item(), 4)
        ('feasible', True, 0.6)
    """

    def __init__(
        self,
        params: Iterable[Tensor],
        *,
        max_kl: float = 1e-3,
        damping: float = 0.01,
        cg_iters: int = 10,
        backtrack_ratio: float = 0.8,
        max_backtracks: int = 10,
        recovery_ratio: float = 1.0,
        statistics_kl: StatisticsKL | None = None,
    ) -> None:
        defaults = {
            "max_kl": max_kl,
            "damping": damping,
            "cg_iters": cg_iters,
            "backtrack_ratio": backtrack_ratio,
            "max_backtracks": max_backtracks,
            "recovery_ratio": recovery_ratio,
        }
        _check_settings(defaults)
        super().__init__(params, defaults)
        if len(self.param_groups) != 1:
            raise ValueError(
                "params must be one group: a trust region has one size, got "
                f"{len(self.param_groups)} groups."
            )
        kinds = {(p.dtype, p.device) for p in self.param_groups[0]["params"]}
        if len(kinds) != 1:
            raise ValueError(
                f"params must share one dtype and device, got {sorted(map(str, kinds))}."
            )
        self.statistics_kl = statistics_kl

    def step(self, closure: Closure) -> TrustRegionReport:  # type: ignore[override]
        """Take one step.

        Args:
            closure (callable): see the class. It is called once with gradients and once, without,
                per candidate of the line search.

        Returns:
            TrustRegionReport: what happened. Nothing is raised for numbers that are not finite.

        Raises:
            KeyError: if the closure's result lacks an entry.
            TypeError: if there is no closure, or it does not return a TensorDict.
            ValueError: if an entry has the wrong shape, or a setting was put out of its range.
        """
        if not callable(closure):
            raise TypeError(f"step needs a closure that returns a TensorDict, got {closure!r}.")
        settings = self.param_groups[0]
        _check_settings(settings)
        params = [p for p in settings["params"] if p.requires_grad]
        backup = [p.detach().clone() for p in params]
        try:
            return self._step(closure, params, backup, settings)
        except BaseException:
            _restore(params, backup)
            raise

    def _step(
        self,
        closure: Closure,
        params: list[Tensor],
        backup: list[Tensor],
        settings: dict[str, Any],
    ) -> TrustRegionReport:
        with torch.enable_grad():
            out = self._call(closure)
            before, old = self._evaluate(out, None)
            report: dict[str, Any] = {
                "objective": before.objective,
                "constraint": tuple(before.constraint.tolist()),
            }
            try:
                solution, direction, predicted, residual = self._direct(
                    out, before, params, settings
                )
            except _Rejected as reason:
                return TrustRegionReport("rejected", False, str(reason), **report)
        report.update(cg_residual=residual)
        del out

        fraction, reason = 1.0, ""
        for backtracks in range(settings["max_backtracks"] + 1):
            with torch.no_grad():
                for p, start, move in zip(
                    params, backup, unflatten(direction, params), strict=True
                ):
                    p.copy_(start + fraction * move)
                after, _ = self._evaluate(self._call(closure), old)
            reason = _refusal(before, after, settings["max_kl"])
            if not reason:
                return TrustRegionReport(
                    solution.case,
                    True,
                    kl=after.kl,
                    step_fraction=fraction,
                    backtracks=backtracks,
                    objective_change=after.objective - before.objective,
                    objective_predicted=fraction * predicted[0],
                    constraint_change=tuple((after.constraint - before.constraint).tolist()),
                    constraint_predicted=tuple(fraction * p for p in predicted[1:]),
                    **report,
                )
            fraction *= settings["backtrack_ratio"]
        _restore(params, backup)
        return TrustRegionReport(
            solution.case,
            False,
            f"the line search is exhausted: {reason}",
            backtracks=settings["max_backtracks"],
            **report,
        )

    def _direct(
        self,
        out: TensorDictBase,
        before: _Evaluation,
        params: list[Tensor],
        settings: dict[str, Any],
    ) -> tuple[Subproblem, Tensor, list[float], float]:
        """The subproblem's solution, its step [n], predicted changes [1 + m], and residual."""
        if not before.is_finite():
            raise _Rejected("objective, constraint or KL is not finite")
        if self.statistics_kl is not None:
            product = gauss_newton_product(out.get("statistics"), self.statistics_kl, params)
        else:
            product = hessian_product(out.get("kl"), params)
        outputs = [out.get("objective"), *before.constraint.size * [None]]
        if before.constraint.size:
            outputs[1:] = out.get("constraint").unbind()
        gradients = torch.stack([_gradient(output, params) for output in outputs])
        damping = settings["damping"]
        solved = conjugate_gradient(
            lambda vectors: product(vectors) + damping * vectors, gradients, settings["cg_iters"]
        )
        # The only wait for the device before the line search.
        gram = (gradients.double() @ solved.solution.double().T).cpu().numpy()
        norms = gradients.norm(dim=-1)
        relative = solved.residual.norm(dim=-1) / torch.where(norms > 0, norms, 1.0)
        residual = relative.max().item()
        if not (np.isfinite(gram).all() and math.isfinite(residual)):
            raise _Rejected("a gradient or a curvature product is not finite")
        if solved.negative.any():
            raise _Rejected("the curvature is not positive definite")
        # Unfinished conjugate gradients leave the two triangles slightly different.
        gram = (gram + gram.T) / 2
        solution = solve_subproblem(
            gram[0, 0],
            gram[1:, 0],
            gram[1:, 1:],
            before.constraint,
            settings["max_kl"],
            settings["recovery_ratio"],
        )
        if solution.reason:
            raise _Rejected(solution.reason)
        weights = np.array([solution.objective_weight, *-solution.constraint_weight])
        direction = torch.as_tensor(weights, dtype=gradients.dtype).to(gradients.device)
        direction = direction @ solved.solution
        return solution, direction, (gram @ weights).tolist(), residual

    def _call(self, closure: Closure) -> TensorDictBase:
        out = closure()
        if not isinstance(out, TensorDictBase):
            raise TypeError(f"the closure must return a TensorDict, got {type(out).__name__}.")
        needed = "kl" if self.statistics_kl is None else "statistics"
        for key in ("objective", needed):
            if out.get(key, None) is None:
                raise KeyError(
                    f"the closure's result lacks {key!r}; it has {sorted(map(str, out.keys()))}."
                )
        for key in ("objective", "kl"):
            value = out.get(key, None)
            if value is not None and value.shape != ():
                raise ValueError(f"{key!r} must be a scalar, got shape {tuple(value.shape)}.")
        constraint = out.get("constraint", None)
        if constraint is not None and constraint.ndim != 1:
            raise ValueError(f"'constraint' must have shape [m], got {tuple(constraint.shape)}.")
        return out

    def _evaluate(self, out: TensorDictBase, old: Any) -> tuple[_Evaluation, Any]:
        """A closure's numbers, and the statistics that later KLs refer to."""
        if self.statistics_kl is None:
            kl = out.get("kl")
        elif old is None:
            old = detach(out.get("statistics"))
            kl = torch.zeros_like(out.get("objective"))
        else:
            kl = self.statistics_kl(old, out.get("statistics"))
        values = [out.get("objective").reshape(1), kl.reshape(1)]
        constraint = out.get("constraint", None)
        if constraint is not None:
            values.append(constraint)
        numbers = torch.cat([value.detach().double() for value in values]).cpu().numpy()
        return _Evaluation(float(numbers[0]), numbers[2:], float(numbers[1])), old


def _gradient(output: Tensor, params: list[Tensor]) -> Tensor:
    if not output.requires_grad:
        return torch.zeros_like(flatten(params))
    return flatten(torch.autograd.grad(output, params, retain_graph=True, materialize_grads=True))


def _refusal(before: _Evaluation, after: _Evaluation, max_kl: float) -> str:
    """Why the line search turns a candidate down; empty if it does not."""
    if not after.is_finite():
        return "objective, constraint or KL is not finite"
    if after.kl > max_kl:
        return "the KL is above max_kl"
    if (after.constraint - before.constraint > np.maximum(-before.constraint, 0)).any():
        return "a constraint is violated"
    if (before.constraint <= 0).all() and after.objective < before.objective:
        return "the objective fell"
    return ""


def _restore(params: list[Tensor], backup: list[Tensor]) -> None:
    with torch.no_grad():
        for p, start in zip(params, backup, strict=True):
            p.copy_(start)


def _check_settings(settings: dict[str, Any]) -> None:
    allowed: dict[str, tuple[Callable[[Any], bool], str]] = {
        "max_kl": (lambda v: 0 < v < math.inf, "positive and finite"),
        "damping": (lambda v: 0 <= v < math.inf, "finite and at least 0"),
        "cg_iters": (lambda v: isinstance(v, int) and v >= 1, "an integer of at least 1"),
        "backtrack_ratio": (lambda v: 0 < v < 1, "in (0, 1)"),
        "max_backtracks": (lambda v: isinstance(v, int) and v >= 0, "an integer of at least 0"),
        "recovery_ratio": (lambda v: 0 < v <= 1, "in (0, 1]"),
    }
    for name, (check, text) in allowed.items():
        if not check(settings[name]):
            raise ValueError(f"{name} must be {text}, got {settings[name]!r}.")
