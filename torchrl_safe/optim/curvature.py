"""Natural gradients: products with the KL's Hessian, conjugate gradients, and what they span."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_safe.optim.repetition import Repeat, State, one_by_one

Statistics: TypeAlias = Tensor | TensorDictBase
StatisticsKL: TypeAlias = Callable[[Statistics, Statistics], Tensor]
Product: TypeAlias = Callable[[Tensor], Tensor]


def flatten(tensors: Sequence[Tensor]) -> Tensor:
    """Concatenates tensors into one vector, shape [n]."""
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def unflatten(vector: Tensor, like: Sequence[Tensor]) -> list[Tensor]:
    """Splits a vector of shape [n] into tensors shaped as ``like``."""
    chunks = vector.split([tensor.numel() for tensor in like])
    return [chunk.view(tensor.shape) for chunk, tensor in zip(chunks, like, strict=True)]


def gradient(
    name: str,
    outputs: Sequence[Tensor],
    params: Sequence[Tensor],
    cotangents: Sequence[Tensor] | None = None,
    *,
    create_graph: bool = False,
) -> list[Tensor]:
    """Gradients that keep the graph: zero where a parameter does not matter, an error if none does.

    Args:
        name (str): of the outputs, for the error.
        outputs (sequence of torch.Tensor): scalars, unless there are ``cotangents``.
        params (sequence of torch.Tensor): the parameters.
        cotangents (sequence of torch.Tensor, optional): weights, each shaped as its output.

    Keyword Args:
        create_graph (bool): whether the gradients can be differentiated. Defaults to ``False``.

    Returns:
        list of torch.Tensor: shaped as the parameters.

    Raises:
        ValueError: when the outputs depend on no parameter.

    Examples:
        >>> x, y = (torch.ones(2, requires_grad=True) for _ in range(2))
        >>> gradient("objective", [(3 * x).sum()], [x, y])
        [tensor([3., 3.]), tensor([0., 0.])]
    """
    grads: tuple[Tensor | None, ...] = ()
    if any(output.requires_grad for output in outputs):
        grads = torch.autograd.grad(
            outputs,
            params,
            cotangents,
            retain_graph=True,
            create_graph=create_graph,
            allow_unused=True,
        )
    if all(grad is None for grad in grads):
        raise ValueError(f"{name!r} must depend on the optimizer's parameters, it does not.")
    pairs = zip(grads, params, strict=True)
    return [torch.zeros_like(param) if grad is None else grad for grad, param in pairs]


def hessian_product(kl: Tensor, params: Sequence[Tensor]) -> Product:
    """Products with the Hessian of ``kl``, by double backward.

    Args:
        kl (torch.Tensor): scalar, a function of ``params``.
        params (sequence of torch.Tensor): the parameters, n numbers in all.

    Returns:
        callable: from vectors [k, n] to ``H v`` [k, n].

    Raises:
        ValueError: when ``kl`` does not depend on the parameters.

    Examples:
        >>> x = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> hessian_product((x**3).sum(), [x])(torch.eye(2))
        tensor([[ 6.,  0.],
                [ 0., 12.]])
    """
    slope = gradient("kl", [kl], params, create_graph=True)

    def product(vectors: Tensor) -> Tensor:
        return torch.stack([flatten(_pull(slope, params, unflatten(v, params))) for v in vectors])

    return product


def gauss_newton_product(
    statistics: Statistics, statistics_kl: StatisticsKL, params: Sequence[Tensor]
) -> Product:
    """Products ``J' F J v``: the Hessian of ``statistics_kl(old, new)`` in ``params`` at new = old.

    ``J`` is the Jacobian of the statistics and ``F`` the Hessian of the KL in them. As the KL has
    no gradient at ``new = old``, this is the whole Hessian. Both are linearised here, once: a
    product differentiates ``J'u`` in ``u``, which costs a forward-mode pass, and pulls the result
    back with one reverse-mode pass; the network is not evaluated again.

    Args:
        statistics (torch.Tensor or TensorDictBase): any shape, with a graph to ``params``.
        statistics_kl (callable): the KL of two such statistics, a scalar, the mean over the batch.
        params (sequence of torch.Tensor): the parameters, n numbers in all.

    Returns:
        callable: from vectors [k, n] to ``J' F J v`` [k, n].

    Raises:
        ValueError: when ``statistics`` does not depend on the parameters, or ``statistics_kl`` does
            not return a scalar that depends on its second argument.

    Examples:
        >>> x = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> def kl(old, new):
        ...     return 0.5 * (new - old).square().sum()
        >>> gauss_newton_product(x**2, kl, [x])(torch.eye(2))
        tensor([[ 4.,  0.],
                [ 0., 16.]])
    """
    keys, leaves = _leaves(statistics)
    moving = [leaf for leaf in leaves if leaf.requires_grad]
    cotangent = [torch.zeros_like(leaf, requires_grad=True) for leaf in moving]
    pulled = gradient("statistics", moving, params, cotangent, create_graph=True)
    fresh = [leaf.detach().requires_grad_(leaf.requires_grad) for leaf in leaves]
    new = _rebuild(keys, fresh, statistics)
    fresh = [leaf for leaf in fresh if leaf.requires_grad]
    kl = statistics_kl(detach(statistics), new)
    if kl.shape != () or not kl.requires_grad:
        raise ValueError(
            "statistics_kl(old, new) must return a scalar that depends on new, got a tensor of "
            f"shape {tuple(kl.shape)} with requires_grad={kl.requires_grad}."
        )
    slope = torch.autograd.grad(kl, fresh, create_graph=True, materialize_grads=True)

    def product(vectors: Tensor) -> Tensor:
        rows = []
        for vector in vectors:
            tangent = _pull(pulled, cotangent, unflatten(vector, params))
            force = _pull(slope, fresh, tangent)
            rows.append(flatten(_pull(moving, params, force)))
        return torch.stack(rows)

    return product


def detach(statistics: Statistics) -> Statistics:
    """A copy without graph; a copy, because statistics may be views of the parameters."""
    return statistics.detach().clone()


class ConjugateGradient(NamedTuple):
    """What :func:`conjugate_gradient` found, for k systems of size n."""

    solution: Tensor
    """Shape [k, n]."""
    residual: Tensor
    """``rhs - H solution``, shape [k, n]."""
    relative_residual: Tensor
    """Its norm over that of ``rhs``, shape [k]; not finite where the products were not."""
    negative: Tensor
    """Whether a direction of negative curvature was met, bool, shape [k]."""


def conjugate_gradient(
    product: Product,
    rhs: Tensor,
    iterations: int,
    tolerance: float = 1e-10,
    repeat: Repeat = one_by_one,
) -> ConjugateGradient:
    """Solves ``H x = rhs`` for k right-hand sides side by side, H symmetric positive definite.

    A system stops moving once its residual fell below ``tolerance`` times its right-hand side, or
    when the curvature along its direction is not positive. Nothing here waits for the device.

    Args:
        product (callable): from vectors [k, n] to ``H v`` [k, n].
        rhs (torch.Tensor): shape [k, n].
        iterations (int): products at most.
        tolerance (float): residual norm at which a system counts as solved, relative to ``rhs``.
        repeat (callable): runs the iterations. Defaults to
            :func:`~torchrl_safe.optim.repetition.one_by_one`.

    Returns:
        ConjugateGradient: ``solution``, ``residual``, ``relative_residual`` and ``negative``.

    Examples:
        >>> hessian = torch.diag(torch.tensor([1.0, 2.0]))
        >>> conjugate_gradient(lambda v: v @ hessian, torch.ones(1, 2), iterations=2).solution
        tensor([[1.0000, 0.5000]])
    """
    # Unit scale, so that squared norms neither underflow nor overflow in single precision.
    scale = rhs.abs().amax(-1, keepdim=True)
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    residual = rhs / scale
    norm = residual.square().sum(-1, keepdim=True)
    start, target = norm.sqrt(), tolerance**2 * norm
    active = norm > target
    eps = torch.finfo(rhs.dtype).eps

    def iteration(
        solution: Tensor,
        residual: Tensor,
        direction: Tensor,
        norm: Tensor,
        active: Tensor,
        negative: Tensor,
    ) -> State:
        curved = product(direction)
        curvature = (direction * curved).sum(-1, keepdim=True)
        size = direction.norm(dim=-1, keepdim=True) * curved.norm(dim=-1, keepdim=True)
        active = active & (norm > target)
        negative = negative | active & (curvature < -(eps**0.5) * size)
        active = active & (curvature > eps * size)
        length = torch.where(active, norm / curvature, 0.0)
        solution = solution + length * direction
        residual = residual - length * curved
        previous, norm = norm, residual.square().sum(-1, keepdim=True)
        direction = residual + torch.where(active, norm / previous, 0.0) * direction
        return solution, residual, direction, norm, active, negative

    begin = torch.zeros_like(rhs), residual, residual, norm, active, torch.zeros_like(active)
    solution, residual, _, norm, _, negative = repeat(iteration, begin, iterations)
    relative = norm.sqrt() / torch.where(start > 0, start, 1.0)
    return ConjugateGradient(
        solution * scale, residual * scale, relative.squeeze(-1), negative.squeeze(-1)
    )


class NoStep(Exception):
    """A step that cannot be computed; the message says why."""


class NaturalGradients(NamedTuple):
    """Natural gradients ``H^-1 g_i`` of k functions, as far as the iterations have solved for them.

    However few these were, :attr:`gram` is exactly that of what :meth:`combine` returns.
    """

    basis: Tensor
    """What spans them, [k, n], in double precision."""
    coefficients: NDArray[np.float64]
    """Natural gradients in the basis, in columns, [k, k]."""
    gram: NDArray[np.float64]
    """Inner products ``g_i' H^-1 g_j``, [k, k]."""
    cg_residual: float
    """Largest relative residual of the systems."""
    dtype: torch.dtype
    """Of the gradients."""

    def combine(self, weights: NDArray[np.float64]) -> Tensor:
        """The sum of natural gradients with weights [k], shape [n]."""
        in_basis = torch.as_tensor(self.coefficients @ weights, device=self.basis.device)
        return (in_basis @ self.basis).to(self.dtype)


def natural_gradients(
    product: Product,
    gradients: Tensor,
    *,
    damping: float,
    iterations: int,
    repeat: Repeat = one_by_one,
) -> NaturalGradients:
    """Natural gradients ``(H + damping)^-1 g`` of several functions at once.

    Args:
        product (callable): from vectors [k, n] to ``H v`` [k, n].
        gradients (torch.Tensor): shape [k, n].

    Keyword Args:
        damping (float): added to the diagonal of ``H``.
        iterations (int): of the conjugate gradients.
        repeat (callable): runs the iterations. Defaults to
            :func:`~torchrl_safe.optim.repetition.one_by_one`.

    Returns:
        NaturalGradients: their span and their inner products.

    Raises:
        NoStep: if a number is not finite or the damped curvature not positive definite.

    Examples:
        >>> hessian, gradients = torch.diag(torch.tensor([1.0, 4.0])), torch.tensor([[1.0, 2.0]])
        >>> natural = natural_gradients(
        ...     lambda v: v @ hessian, gradients, damping=0.0, iterations=2
        ... )
        >>> natural.combine(np.ones(1)), natural.gram.round(6).tolist()
        (tensor([1.0000, 0.5000]), [[2.0]])
    """
    systems = conjugate_gradient(
        lambda vectors: product(vectors) + damping * vectors, gradients, iterations, repeat=repeat
    )
    residual = float(systems.relative_residual.max())
    # Double precision also keeps reduced-precision matrix products out of the subproblem.
    solved, wanted = systems.solution.double(), gradients.double()
    linear = (wanted @ solved.T).cpu().numpy()
    curvature = (solved @ (wanted - systems.residual.double()).T).cpu().numpy()
    if not (math.isfinite(residual) and np.isfinite([linear, curvature]).all()):
        raise NoStep("a gradient or a product with the curvature is not finite")
    flat = gradients.any(-1).cpu().numpy() & (np.diag(curvature) <= 0)
    if flat.any() or bool(systems.negative.any()):
        raise NoStep("the curvature is not positive definite; more damping may help")
    coefficients, gram = _galerkin(curvature, linear, torch.finfo(gradients.dtype).eps)
    return NaturalGradients(solved, coefficients, gram, residual, gradients.dtype)


def _galerkin(
    curvature: NDArray[np.float64], linear: NDArray[np.float64], eps: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The subproblem, restricted to the span of unfinished solutions ``X``.

    Inside that span the natural gradients are ``X G^+ (L')``, with ``G = X'HX`` and ``L`` the
    gradients' products with ``X``. Their Gram matrix is ``L G^+ L'`` however few iterations the
    conjugate gradients had: the step's predicted changes and its size in the metric are exact.

    Args:
        curvature (numpy.ndarray): ``G``, shape [k, k].
        linear (numpy.ndarray): ``L``, shape [k, k].
        eps (float): resolution of the vectors' dtype; directions as similar as that count as one.

    Returns:
        tuple: coefficients of the natural gradients in ``X`` (in columns) and their Gram matrix.
    """
    scale = np.sqrt(np.diag(curvature))
    scale = np.where(scale > 0, scale, 1.0)
    unit = (curvature + curvature.T) / np.outer(2 * scale, scale)
    inverse = np.linalg.pinv(unit, rcond=10 * eps, hermitian=True) / np.outer(scale, scale)
    basis = inverse @ linear.T
    gram = linear @ basis
    return basis, (gram + gram.T) / 2


def _pull(outputs: Sequence[Tensor], inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> list:
    """Vector-Jacobian product that keeps the graph; zeros where nothing depends on an input."""
    pairs = [(o, w) for o, w in zip(outputs, weights, strict=True) if o.requires_grad]
    if not pairs:
        return [torch.zeros_like(tensor) for tensor in inputs]
    reached, cotangents = zip(*pairs, strict=True)
    return list(
        torch.autograd.grad(reached, inputs, cotangents, retain_graph=True, materialize_grads=True)
    )


def _leaves(statistics: Statistics) -> tuple[list, list[Tensor]]:
    if isinstance(statistics, Tensor):
        return [], [statistics]
    keys = list(statistics.keys(True, True))
    return keys, [statistics.get(key) for key in keys]


def _rebuild(keys: list, leaves: list[Tensor], like: Statistics) -> Statistics:
    if isinstance(like, Tensor):
        return leaves[0]
    return TensorDict(dict(zip(keys, leaves, strict=True)), batch_size=like.batch_size)
