from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_safe.modules import moment_matched_kl
from torchrl_safe.modules.distributions import TanhGaussianMixture
from torchrl_safe.optim.curvature import (
    NoStep,
    conjugate_gradient,
    flatten,
    gauss_newton_product,
    hessian_product,
    natural_gradients,
    unflatten,
)


def dense_hessian(kl_of, params):
    """Hessian of ``kl_of(*params)``, [n, n], by the framework's own nested differentiation."""
    blocks = torch.autograd.functional.hessian(kl_of, tuple(p.detach() for p in params))
    rows = []
    for i, p in enumerate(params):
        rows.append(torch.cat([b.reshape(p.numel(), -1) for b in blocks[i]], dim=1))
    return torch.cat(rows)


def gaussian_kl(old, new):
    """Closed form of KL(N(old) || N(new)) for diagonal Gaussians, mean over the batch."""
    ratio = (old["log_std"] - new["log_std"]).mul(2).exp()
    shift = (old["mean"] - new["mean"]).square() * (-2 * new["log_std"]).exp()
    return 0.5 * (ratio + shift - 1 - ratio.log()).sum(-1).mean()


class Net:
    """Two-layer network as a function of explicit parameters: a mean and a log-std per state."""

    def __init__(self, seed=0, inputs=3, hidden=5, outputs=4):
        g = torch.Generator().manual_seed(seed)
        shapes = [(inputs, hidden), (hidden,), (hidden, outputs), (outputs,)]
        self.params = [
            nn.Parameter(0.5 * torch.randn(s, generator=g, dtype=torch.float64)) for s in shapes
        ]
        self.x = torch.randn(7, inputs, generator=g, dtype=torch.float64)

    def __call__(self, w1, b1, w2, b2):
        return torch.tanh(self.x @ w1 + b1) @ w2 + b2


def as_statistics(out):
    mean, log_std = out.chunk(2, -1)
    return TensorDict({"mean": mean, "log_std": log_std}, batch_size=[7])


@pytest.mark.parametrize("nested", [False, True])
def test_gauss_newton_and_double_backward_match_the_dense_hessian_of_the_kl(nested):
    net = Net()
    statistics = as_statistics(net(*net.params))
    old = statistics.detach().clone()
    dense = dense_hessian(lambda *p: gaussian_kl(old, as_statistics(net(*p))), net.params)
    eye = torch.eye(len(dense), dtype=torch.float64)
    kl = gaussian_kl
    if nested:
        statistics = TensorDict({"policy": statistics}, batch_size=[])

        def kl(old, new):
            return gaussian_kl(old["policy"], new["policy"])

    product = gauss_newton_product(statistics, kl, net.params)
    torch.testing.assert_close(product(eye), dense, rtol=1e-9, atol=1e-12)
    twice = hessian_product(gaussian_kl(old, as_statistics(net(*net.params))), net.params)
    torch.testing.assert_close(twice(eye), dense, rtol=1e-9, atol=1e-12)
    assert dense.abs().max() > 0.1


def test_gauss_newton_with_a_tensor_and_a_kl_that_is_not_quadratic():
    net = Net(1)

    def kl(old, new):  # Bernoulli, from logits
        p = old.sigmoid()
        log_p, log_q = nn.functional.logsigmoid(old), nn.functional.logsigmoid(new)
        return (p * (log_p - log_q) + (1 - p) * (log_p - old - log_q + new)).sum(-1).mean()

    logits = net(*net.params)
    dense = dense_hessian(lambda *p: kl(logits.detach(), net(*p)), net.params)
    vectors = torch.randn(3, len(dense), dtype=torch.float64)
    product = gauss_newton_product(logits, kl, net.params)
    torch.testing.assert_close(product(vectors), vectors @ dense, rtol=1e-9, atol=1e-12)


def test_gauss_newton_through_the_moments_of_a_mixture():
    k, d = 2, 2
    net = Net(2, outputs=k + 2 * k * d)

    def moments(*params):
        logits, loc, log_std = net(*params).split([k, k * d, k * d], -1)
        mixture = TanhGaussianMixture(
            logits, loc.unflatten(-1, (k, d)), log_std.unflatten(-1, (k, d)).exp()
        )
        mean, cov = mixture.moments
        return TensorDict({"mean": mean, "cov": cov}, batch_size=[7])

    def kl(old, new):
        return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"]).mean()

    def reference_kl(*params):
        new = moments(*params)
        p, q = (
            torch.distributions.MultivariateNormal(s["mean"], s["cov"], validate_args=False)
            for s in (old, new)
        )
        return torch.distributions.kl_divergence(p, q).mean()

    old = moments(*net.params).detach().clone()
    dense = dense_hessian(reference_kl, net.params)
    product = gauss_newton_product(moments(*net.params), kl, net.params)
    eye = torch.eye(len(dense), dtype=torch.float64)
    torch.testing.assert_close(product(eye), dense, rtol=1e-7, atol=1e-10)


def test_products_of_parameters_that_do_not_matter_are_zero():
    used, unused = (nn.Parameter(torch.ones(2, dtype=torch.float64)) for _ in range(2))
    kl = lambda old, new: 0.5 * (new - old).square().sum()  # noqa: E731
    vector = torch.ones(1, 4, dtype=torch.float64)
    expected = torch.tensor([[4.0, 4.0, 0.0, 0.0]], dtype=torch.float64)
    product = gauss_newton_product(used**2, kl, [used, unused])
    torch.testing.assert_close(product(vector), expected)
    product = hessian_product(kl((used**2).detach(), used**2), [used, unused])
    torch.testing.assert_close(product(vector), expected)


def test_the_old_statistics_are_a_copy_of_views_of_the_parameters():
    x = nn.Parameter(torch.ones(2, dtype=torch.float64))
    seen = []

    def kl(old, new):
        seen.append(old)
        return 0.5 * (new - old).square().sum()

    gauss_newton_product(x, kl, [x])
    with torch.no_grad():
        x.add_(1.0)
    assert seen[0].tolist() == [1.0, 1.0]


def test_misuse_of_the_products():
    x, other = (nn.Parameter(torch.ones(2)) for _ in range(2))
    kl = lambda old, new: (new - old).square().sum()  # noqa: E731
    with pytest.raises(ValueError, match="'statistics' must depend on the optimizer's parameters"):
        gauss_newton_product(x.detach(), kl, [x])
    with pytest.raises(ValueError, match="'statistics' must depend on the optimizer's parameters"):
        gauss_newton_product(other * 1.0, kl, [x])
    with pytest.raises(ValueError, match=r"scalar that depends on new, got .* shape \(2,\)"):
        gauss_newton_product(x * 1.0, lambda old, new: (new - old).square(), [x])
    with pytest.raises(ValueError, match="requires_grad=False"):
        gauss_newton_product(x * 1.0, lambda old, new: (old - old).sum(), [x])
    for value in (x.detach().sum(), kl(x.detach(), other)):
        with pytest.raises(ValueError, match="'kl' must depend on the optimizer's parameters"):
            hessian_product(value, [x])


def test_flatten_and_unflatten_are_inverse():
    like = [torch.zeros(2, 3), torch.zeros(()), torch.zeros(4)]
    vector = torch.arange(11.0)
    parts = unflatten(vector, like)
    assert [p.shape for p in parts] == [p.shape for p in like]
    assert torch.equal(flatten(parts), vector)


def spd(n, condition, seed):
    g = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(n, n, generator=g, dtype=torch.float64)).Q
    values = torch.logspace(0, math.log10(condition), n, dtype=torch.float64)
    return basis @ torch.diag(values) @ basis.T


@pytest.mark.parametrize("condition", [1.0, 10.0, 1e3])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_conjugate_gradient_solves_several_systems_at_once(condition, scale):
    hessian = spd(12, condition, 0)
    rhs = scale * torch.randn(3, 12, dtype=torch.float64)
    found = conjugate_gradient(lambda v: v @ hessian, rhs, iterations=60)
    expected = torch.linalg.solve(hessian, rhs.T).T
    error = (found.solution - expected).norm() / expected.norm()
    assert error < 1e-7
    assert not found.negative.any()
    assert (found.relative_residual < 1e-8).all()


def test_conjugate_gradient_reports_its_true_residual_when_cut_short():
    hessian = spd(12, 1e3, 1)
    rhs = torch.randn(2, 12, dtype=torch.float64)
    found = conjugate_gradient(lambda v: v @ hessian, rhs, iterations=4)
    residual = rhs - found.solution @ hessian
    torch.testing.assert_close(found.residual, residual)
    torch.testing.assert_close(found.relative_residual, residual.norm(dim=-1) / rhs.norm(dim=-1))
    assert (found.relative_residual > 1e-3).all()


@pytest.mark.parametrize("iterations", [1, 5, 20])
def test_conjugate_gradient_is_bounded(iterations):
    calls = []
    hessian = spd(30, 1e6, 2)

    def product(vectors):
        calls.append(vectors)
        return vectors @ hessian

    conjugate_gradient(product, torch.ones(1, 30, dtype=torch.float64), iterations)
    assert len(calls) <= iterations


def test_conjugate_gradient_of_zero_is_zero_beside_a_real_system():
    hessian = spd(6, 10.0, 3)
    rhs = torch.zeros(2, 6, dtype=torch.float64)
    rhs[1] = 1.0
    found = conjugate_gradient(lambda v: v @ hessian, rhs, 20)
    assert (found.solution[0] == 0).all()
    assert found.relative_residual[0] == 0
    torch.testing.assert_close(found.solution[1], torch.linalg.solve(hessian, rhs[1]))


def test_conjugate_gradient_flags_negative_curvature_and_keeps_zero_curvature_finite():
    rhs = torch.ones(1, 3, dtype=torch.float64)
    for diagonal, negative in (([1.0, 2.0, -9.0], True), ([0.0, 0.0, 0.0], False)):
        hessian = torch.diag(torch.tensor(diagonal, dtype=torch.float64))
        found = conjugate_gradient(lambda v, h=hessian: v @ h, rhs, 10)
        assert found.negative.item() is negative
        assert found.solution.isfinite().all()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_conjugate_gradient_ends_on_numbers_that_are_not_finite(bad):
    found = conjugate_gradient(lambda v: v * bad, torch.ones(1, 3), 10)
    assert not found.relative_residual.isfinite().any()
    found = conjugate_gradient(lambda v: v, torch.tensor([[1.0, bad]]), 10)
    assert not found.relative_residual.isfinite().any()


def test_conjugate_gradient_goes_on_after_convergence_without_harm():
    hessian = spd(5, 10.0, 4)
    rhs = torch.randn(2, 5, dtype=torch.float64)
    expected = torch.linalg.solve(hessian, rhs.T).T
    for dtype, rtol in ((torch.float32, 1e-4), (torch.float64, 1e-8)):
        h = hessian.to(dtype)
        found = conjugate_gradient(lambda v, h=h: v @ h, rhs.to(dtype), 300)
        torch.testing.assert_close(found.solution.double(), expected, rtol=rtol, atol=rtol)
        assert not found.negative.any()


def test_natural_gradients_are_those_of_a_dense_inverse():
    torch.manual_seed(0)
    root, gradients = torch.randn(6, 6).double(), torch.randn(3, 6).double()
    hessian = root @ root.T
    natural = natural_gradients(lambda v: v @ hessian, gradients, damping=0.1, iterations=12)
    expected = torch.linalg.solve(hessian + 0.1 * torch.eye(6).double(), gradients.T).T
    weights = np.array([1.0, -2.0, 0.5])
    torch.testing.assert_close(natural.combine(weights), torch.tensor(weights) @ expected)
    torch.testing.assert_close(torch.tensor(natural.gram), gradients @ expected.T)
    assert natural.cg_residual < 1e-8


@pytest.mark.parametrize("iterations", [1, 2, 3])
def test_inner_products_are_exact_however_few_the_iterations(iterations):
    """``g' x`` and ``x' H x`` of what is combined, which is all that a step's model consists of."""
    torch.manual_seed(1)
    root, gradients = torch.randn(9, 9).double(), torch.randn(2, 9).double()
    hessian = root @ root.T
    natural = natural_gradients(
        lambda v: v @ hessian, gradients, damping=0.0, iterations=iterations
    )
    weights = np.array([0.7, -1.3])
    step = natural.combine(weights)
    torch.testing.assert_close(gradients @ step, torch.tensor(natural.gram @ weights))
    size = torch.tensor(weights @ natural.gram @ weights)
    torch.testing.assert_close(step @ hessian @ step, size)


@pytest.mark.parametrize(
    ("hessian", "gradient", "reason"),
    [
        ([1.0, -1.0], [1.0, 1.0], "not positive definite"),
        ([1.0, math.nan], [1.0, 1.0], "not finite"),
        ([1.0, 1.0], [math.inf, 1.0], "not finite"),
    ],
)
def test_no_natural_gradient(hessian, gradient, reason):
    diagonal = torch.tensor(hessian).diag()
    with pytest.raises(NoStep, match=reason):
        natural_gradients(
            lambda v: v @ diagonal, torch.tensor([gradient]), damping=0.0, iterations=4
        )
