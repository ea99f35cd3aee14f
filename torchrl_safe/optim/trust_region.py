"""A constrained trust-region step for any model: TRPO, CPO, TRC and SafeTAC under one optimizer."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cached_property
from numbers import Integral, Real
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_safe.optim.curvature import (
    NoStep,
    Product,
    Statistics,
    StatisticsKL,
    detach,
    flatten,
    gauss_newton_product,
    gradient,
    hessian_product,
    natural_gradients,
    unflatten,
)
from torchrl_safe.optim.repetition import CudaGraphRepeat, one_by_one
from torchrl_safe.optim.subproblem import MAX_CONSTRAINTS, project_step, solve_subproblem

__all__ = ["TrustRegionReport", "TrustRegionSafeOptimizer"]

Closure: TypeAlias = Callable[[], TensorDictBase]

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
        reason (str): why they did not; empty otherwise. One of: a number or gradient is not finite;
            the curvature is not positive definite; no step lowers a violated constraint; the best
            step is none; or the line search is exhausted, with what it refused last.
        kl (float): divergence of the new policy, in nats; 0 if nothing moved.
        step_fraction (float): share of the subproblem's step that was taken.
        backtracks (int): candidates that the line search turned down.
        objective (float): before the step.
        objective_change (float): what the step did.
        objective_predicted (float): what it should have done.
        constraint (tuple of float): before the step, [m]; feasible at or below 0, so that a limit
            on a cost has been taken off.
        constraint_change (tuple of float): what the step did, [m].
        constraint_predicted (tuple of float): what it should have done, [m].
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


# Of the line search: a share of max_kl, and of the most that one step can lower a constraint by.
_TOLERANCE = 0.01
_ROUNDING = 8  # of a closure's numbers, in units of their resolution


@dataclass(frozen=True)
class _Evaluation:
    """A closure's numbers, in double precision on the CPU."""

    objective: float
    constraint: NDArray[np.float64]
    kl: float
    eps: float  # resolution of the least precise of objective and constraints

    def is_finite(self) -> bool:
        return bool(np.isfinite([self.objective, self.kl, *self.constraint]).all())

    def __str__(self) -> str:
        constraint = f", constraint={self.constraint.tolist()}" if self.constraint.size else ""
        return f"objective={self.objective}{constraint}, kl={self.kl}"


class _Proposal(NamedTuple):
    """The subproblem's step, and what the line search needs to judge it."""

    case: str
    direction: Tensor  # [n]
    predicted: list[float]  # changes of the objective and the constraints, [1 + m]
    reach: NDArray[np.float64]  # the most one step can change objective and constraints, [1 + m]
    cg_residual: float


class TrustRegionSafeOptimizer(torch.optim.Optimizer):
    r"""Maximises an objective under constraints, inside a KL trust region, (13)-(17) of SafeTAC.

    One step linearises objective ``f`` and constraints ``c``, takes the curvature ``H`` of the
    KL, and solves

    .. math::

        \max_x g^\top x \quad \text{s.t.} \quad c + B x \le 0, \quad
        \tfrac12 x^\top H x \le \delta

    for the direction ``x``; a line search then shortens it until the true KL is inside the region
    and the true objective and constraints did what a step of its kind must do:

    * the KL is at most ``max_kl`` (and at least ``-max_kl``: an estimate below that is none), up
      to a hundredth of it, since the subproblem's step is as long as the region allows;
    * a constraint that held still holds, and one that was violated is not violated more, both up to
      a hundredth of what one step can lower it by: along a curved boundary every step violates it a
      little, and a strict search would be stuck there for good;
    * the objective did not fall, if all constraints held.

    What the dtype of the closure's numbers cannot tell apart counts as no change. When no candidate
    does what it must, a number is not finite or the closure raises (or is interrupted), the
    parameters are put back bit for bit. Unless it raised, the report says why. Gradients in
    ``.grad`` are those of before the step, whatever the closure did. Which violations are repaired
    first, see :func:`~torchrl_safe.optim.subproblem.solve_subproblem`.

    Without constraints this is TRPO (https://arxiv.org/abs/1502.05477), with them CPO
    (https://arxiv.org/abs/1705.10528): the closure decides. With ``projection`` it is PCPO
    (https://arxiv.org/abs/2010.03152), see :func:`~torchrl_safe.optim.subproblem.project_step`.

    **The closure** is a deterministic function of the current parameters (draw noise once, before
    the step) that returns a TensorDict without batch size, holding

    * ``"objective"``: scalar, maximised;
    * ``"constraint"``: [m], feasible at or below 0; absent or empty for none;
    * ``"kl"``: scalar, zero with zero gradient at the parameters the step starts from. Curvature
      products then differentiate it twice; or
    * ``"statistics"``: a tensor or TensorDict that determines the policy on the batch, such as its
      moments, with ``statistics_kl`` given to the constructor. The KL is then
      ``statistics_kl(old, new)``, and its curvature products are exact Gauss-Newton ones,
      linearised once a step;
    * ``"curvature_statistics"``: the same on part of the batch, optional. Curvature products are
      then taken there, and cost accordingly less; the line search measures the KL on all of
      ``"statistics"`` as ever.

    Args:
        params (iterable of Parameter): parameters of the policy, in one group. Those that do not
            require a gradient when a step starts stay as they are.

    Keyword Args:
        max_kl (float): size of the region, in nats. Defaults to 1e-3.
        damping (float): added to the diagonal of the curvature. Defaults to 0.01.
        cg_iters (int): conjugate-gradient iterations. Defaults to 10.
        backtrack_ratio (float): factor of the line search, in (0, 1). Defaults to 0.8.
        max_backtracks (int): how often it is applied at most. Defaults to 10.
        recovery_ratio (float): share of the region's radius that a violated constraint may claim,
            in (0, 1]; the rest goes to the objective. At 1 a violation that cannot be removed at
            once gives CPO's pure recovery step; a projection has no use for it. Defaults to 1.0.
        projection (bool): whether the step is that up the objective alone, then projected onto the
            constraints, in place of the subproblem's. Defaults to ``False``.
        statistics_kl (callable, optional): from old and new statistics to their mean KL, a scalar,
            twice differentiable in the new ones.
        cuda_graph (bool): whether conjugate gradients run as a CUDA graph, on a stream of their
            own together with the closure: on a GPU their many small kernels wait for Python
            otherwise. Backward passes through the closure's result must not make the host wait,
            as those of the blocks here do not. Defaults to ``False``.

    These numbers live in ``param_groups[0]``, may be written there at any time, also after
    ``load_state_dict``, and are checked when a step uses them. Beside them stands ``"lr"``, a
    factor of ``max_kl`` that starts at 1: it is what the schedulers of
    ``torch.optim.lr_scheduler`` set. Inside ``torch.compile`` a step runs as it does outside.

    Raises:
        TypeError: if ``statistics_kl`` is not callable, or ``projection`` or ``cuda_graph`` not a
            bool.
        ValueError: if an argument is out of its range, or the parameters are not floating point,
            differ in dtype or device, come in several groups, one of them twice, or are not on a
            CUDA device with ``cuda_graph``.

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
        projection: bool = False,
        statistics_kl: StatisticsKL | None = None,
        cuda_graph: bool = False,
    ) -> None:
        if statistics_kl is not None and not callable(statistics_kl):
            raise TypeError(f"statistics_kl must be callable or None, got {statistics_kl!r}.")
        for name, value in (("projection", projection), ("cuda_graph", cuda_graph)):
            if not isinstance(value, bool):
                raise TypeError(f"{name} must be True or False, got {value!r}.")
        self.statistics_kl = statistics_kl
        self.projection = projection
        self.cuda_graph = cuda_graph
        defaults = {
            "lr": 1.0,
            "max_kl": max_kl,
            "damping": damping,
            "cg_iters": cg_iters,
            "backtrack_ratio": backtrack_ratio,
            "max_backtracks": max_backtracks,
            "recovery_ratio": recovery_ratio,
        }
        _check_settings(defaults)
        super().__init__(params, defaults)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        for group in self.param_groups:  # of a checkpoint from before there was a schedule
            group.setdefault("lr", 1.0)

    def __getstate__(self) -> dict[str, Any]:
        names = ("statistics_kl", "projection", "cuda_graph")
        return super().__getstate__() | {name: getattr(self, name) for name in names}

    @cached_property
    def _graphs(self) -> CudaGraphRepeat:
        return CudaGraphRepeat(self.param_groups[0]["params"][0].device)

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """Take the one group of parameters; a second one is a ``ValueError``."""
        if self.param_groups:
            raise ValueError("params must be one group, got several: a trust region has one size.")
        _check_settings({**self.defaults, **param_group})
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*duplicate parameters")
            super().add_param_group(param_group)  # which only warns of them
        _check_params(self.param_groups[0]["params"], self.cuda_graph)

    # Solving the subproblem is no work for a compiler, nor is a graph that is differentiated twice.
    @torch.compiler.disable
    def step(self, closure: Closure) -> TrustRegionReport:
        """Take one step.

        Args:
            closure (callable): see the class. It is called once with gradients and once, without,
                per candidate of the line search.

        Returns:
            TrustRegionReport: what happened. Nothing is raised for numbers that are not finite.

        Raises:
            KeyError: if the closure's result lacks an entry.
            TypeError: if there is no closure, or it does not return a TensorDict.
            ValueError: if an entry has the wrong shape or does not depend on the parameters, the
                KL does not start at zero, no parameter requires a gradient, or a setting was put
                out of its range.
        """
        if not callable(closure):
            raise TypeError(f"step needs a closure that returns a TensorDict, got {closure!r}.")
        settings = self.param_groups[0]
        _check_settings(settings)
        params = [p for p in settings["params"] if p.requires_grad]
        if not params:
            raise ValueError("params must hold one that requires a gradient, got none that does.")
        _check_params(params, self.cuda_graph)
        backup = [p.detach().clone() for p in params]
        grads = [p.grad for p in params]
        for p in params:  # aside, so that a closure with a backward pass adds to none of them
            p.grad = None
        try:
            with self._graphs.stream() if self.cuda_graph else nullcontext():
                report = self._step(closure, params, backup, settings)
        except BaseException:
            _move(params, backup)
            raise
        finally:
            for p, grad in zip(params, grads, strict=True):
                p.grad = grad
        if not report.accepted:
            _move(params, backup)
        return report

    def _step(
        self,
        closure: Closure,
        params: list[Tensor],
        backup: list[Tensor],
        settings: dict[str, Any],
    ) -> TrustRegionReport:
        """Evaluates where it starts, proposes a step, and searches along it."""
        max_kl = settings["lr"] * settings["max_kl"]
        with torch.enable_grad():
            out = self._call(closure)
            old = None if self.statistics_kl is None else detach(out.get("statistics"))
            before = self._evaluate(out, old)
            if abs(before.kl) > max_kl:
                raise ValueError(
                    "'kl' must be zero at the parameters the step starts from, got "
                    f"{before.kl} with max_kl={max_kl}."
                )
            report: dict[str, Any] = {
                "objective": before.objective,
                "constraint": tuple(before.constraint.tolist()),
            }
            try:
                proposal = self._propose(out, before, params, settings, max_kl)
            except NoStep as reason:
                return TrustRegionReport("rejected", False, str(reason), **report)
        report.update(case=proposal.case, cg_residual=proposal.cg_residual)
        del out  # The graph, before the candidates are evaluated.

        moves = unflatten(proposal.direction, params)
        refusal = ""
        for backtracks in range(settings["max_backtracks"] + 1):
            fraction = settings["backtrack_ratio"] ** backtracks
            with torch.no_grad():
                _move(params, torch._foreach_add(backup, moves, alpha=fraction))
                after = self._evaluate(self._call(closure), old)
            refusal = _refusal(before, after, max_kl, proposal.reach)
            if not refusal:
                return TrustRegionReport(
                    accepted=True,
                    kl=after.kl,
                    step_fraction=fraction,
                    backtracks=backtracks,
                    objective_change=after.objective - before.objective,
                    objective_predicted=fraction * proposal.predicted[0],
                    constraint_change=tuple((after.constraint - before.constraint).tolist()),
                    constraint_predicted=tuple(fraction * p for p in proposal.predicted[1:]),
                    **report,
                )
        return TrustRegionReport(
            accepted=False,
            reason=f"the line search is exhausted: {refusal}",
            backtracks=settings["max_backtracks"] + 1,
            **report,
        )

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
        if self.statistics_kl is None and out.get("curvature_statistics", None) is not None:
            raise ValueError("'curvature_statistics' needs statistics_kl, which is None.")
        for key in ("objective", "kl"):
            value = out.get(key, None)
            if value is not None and value.shape != ():
                raise ValueError(f"{key!r} must be a scalar, got shape {tuple(value.shape)}.")
        constraint = out.get("constraint", None)
        if constraint is not None and (constraint.ndim != 1 or len(constraint) > MAX_CONSTRAINTS):
            raise ValueError(
                f"'constraint' must have shape [m] with m at most {MAX_CONSTRAINTS}, got shape "
                f"{tuple(constraint.shape)}."
            )
        return out

    def _evaluate(self, out: TensorDictBase, old: Statistics | None) -> _Evaluation:
        """A closure's numbers; ``old`` are the statistics that the KL refers to."""
        with torch.no_grad():
            if self.statistics_kl is None:
                kl = out.get("kl")
            else:
                kl = self.statistics_kl(old, out.get("statistics"))
                if kl.shape != ():
                    raise ValueError(
                        f"statistics_kl must return a scalar, got shape {tuple(kl.shape)}."
                    )
            compared = [out.get("objective").reshape(1)]
            if out.get("constraint", None) is not None:
                compared.append(out.get("constraint"))
            values = torch.cat([value.double() for value in (kl.reshape(1), *compared)])
            numbers = values.cpu().numpy()
        eps = max(torch.finfo(value.dtype).eps for value in compared)
        return _Evaluation(float(numbers[1]), numbers[2:], float(numbers[0]), eps)

    def _propose(
        self,
        out: TensorDictBase,
        before: _Evaluation,
        params: list[Tensor],
        settings: dict[str, Any],
        max_kl: float,
    ) -> _Proposal:
        """The subproblem's step out of the natural gradients; :class:`NoStep` if there is none."""
        if not before.is_finite():
            raise NoStep(f"the closure returned {before}")
        natural = natural_gradients(
            self._kl_product(out, params),
            _gradients(out, params),
            damping=settings["damping"],
            iterations=settings["cg_iters"],
            repeat=self._graphs if self.cuda_graph else one_by_one,
        )
        gram = natural.gram
        products = (gram[0, 0], gram[1:, 0], gram[1:, 1:], before.constraint, max_kl)
        solution = (
            project_step(*products)
            if self.projection
            else solve_subproblem(*products, settings["recovery_ratio"])
        )
        if solution.reason:
            raise NoStep(solution.reason)
        dual = np.array([solution.objective_weight, *-solution.constraint_weight])
        if not dual.any():
            raise NoStep("the best step is none: no gradient leads anywhere better")
        return _Proposal(
            case=solution.case,
            direction=natural.combine(dual),
            predicted=(gram @ dual).tolist(),
            reach=np.sqrt(2 * max_kl * np.diag(gram).clip(0)),
            cg_residual=natural.cg_residual,
        )

    def _kl_product(self, out: TensorDictBase, params: list[Tensor]) -> Product:
        """Products with the curvature of the KL in the parameters."""
        if self.statistics_kl is None:
            return hessian_product(out.get("kl"), params)
        statistics = out.get("curvature_statistics", None)
        if statistics is None:
            statistics = out.get("statistics")
        return gauss_newton_product(statistics, self.statistics_kl, params)


def _gradients(out: TensorDictBase, params: list[Tensor]) -> Tensor:
    """Gradients of the objective and of the constraints, [1 + m, n]."""
    outputs = [("objective", out.get("objective"))]
    if out.get("constraint", None) is not None:
        outputs += [(f"constraint[{i}]", c) for i, c in enumerate(out.get("constraint").unbind())]
    return torch.stack([flatten(gradient(name, [output], params)) for name, output in outputs])


def _refusal(
    before: _Evaluation, after: _Evaluation, max_kl: float, reach: NDArray[np.float64]
) -> str:
    """Why the line search turns a candidate down; empty if it does not."""
    if after.constraint.shape != before.constraint.shape:
        raise ValueError(
            f"'constraint' must keep its shape during a step, got {before.constraint.shape}, then "
            f"{after.constraint.shape}."
        )
    if not after.is_finite():
        return f"the closure returned {after}"
    if abs(after.kl) > (1 + _TOLERANCE) * max_kl:
        return f"a KL of {after.kl} with max_kl={max_kl}"
    # What the closure's dtype cannot tell apart is no change.
    size = np.abs([before.objective, *before.constraint]) + reach
    rounding = _ROUNDING * max(before.eps, after.eps) * size
    tolerance = _TOLERANCE * reach[1:] + rounding[1:]
    excess = after.constraint - np.maximum(before.constraint, 0) - tolerance
    if (excess > 0).any():
        i = excess.argmax()
        return f"constraint[{i}] went from {before.constraint[i]} to {after.constraint[i]}"
    if (before.constraint <= 0).all() and after.objective < before.objective - rounding[0]:
        return f"the objective fell from {before.objective} to {after.objective}"
    return ""


def _move(params: list[Tensor], values: list[Tensor] | tuple[Tensor, ...]) -> None:
    with torch.no_grad():
        torch._foreach_copy_(params, values)


def _check_settings(settings: dict[str, Any]) -> None:
    allowed: dict[str, tuple[type, Callable[[Any], bool], str]] = {
        "lr": (Real, lambda v: 0 < v < math.inf, "a positive finite number"),
        "max_kl": (Real, lambda v: 0 < v < math.inf, "a positive finite number"),
        "damping": (Real, lambda v: 0 <= v < math.inf, "a finite number, at least 0"),
        "cg_iters": (Integral, lambda v: v >= 1, "an integer, at least 1"),
        "backtrack_ratio": (Real, lambda v: 0 < v < 1, "in (0, 1)"),
        "max_backtracks": (Integral, lambda v: v >= 0, "an integer, at least 0"),
        "recovery_ratio": (Real, lambda v: 0 < v <= 1, "in (0, 1]"),
    }
    for name, (kind, check, text) in allowed.items():
        value = settings.get(name)
        if not (isinstance(value, kind) and check(value)):
            raise ValueError(f"{name} must be {text}, got {value!r}.")


def _check_params(params: list[Tensor], cuda_graph: bool) -> None:
    if not params:
        raise ValueError("params must hold at least one parameter, got none.")
    if len({id(p) for p in params}) < len(params):
        raise ValueError("params must hold every parameter once, got one of them twice.")
    kinds = {(p.dtype, p.device) for p in params}
    if len(kinds) != 1 or not params[0].is_floating_point():
        raise ValueError(
            "params must share one floating-point dtype and one device, got "
            f"{sorted(f'{dtype} on {device}' for dtype, device in kinds)}."
        )
    if cuda_graph and not params[0].is_cuda:
        raise ValueError(f"cuda_graph=True needs params on a CUDA device, got {params[0].device}.")
