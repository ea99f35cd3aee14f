from __future__ import annotations

import math

import mpmath
import pytest
import torch
from tensordict import TensorDict
from torch.distributions import (
    Categorical,
    Independent,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    kl_divergence,
)
from torchrl.modules import MaskedCategorical, OneHotCategorical

from torchrl_safe.modules import (
    CATEGORICAL,
    DISTANCES,
    MATCHED_BOUND,
    MOMENT_MATCHED,
    TanhGaussianMixture,
    categorical_kl,
    matched_bound_kl,
    mixture_moments,
    moment_matched_kl,
)


class TestMatchedBoundKL:
    @staticmethod
    def draw(*batch, components=3, dim=2):
        shape = (2, *batch, components)
        logits = torch.randn(shape, dtype=torch.float64)
        loc, log_scale = torch.randn(2, *shape, dim, dtype=torch.float64)
        return list(zip(logits, loc, log_scale.exp(), strict=True))

    @pytest.mark.parametrize("dim", [1, 2])
    @pytest.mark.parametrize("batch", [(), (7,), (4, 5)])
    def test_is_the_joint_kl(self, batch, dim):
        """Of component and value, by torch's divergences of their own distributions."""
        torch.manual_seed(0)
        old, new = self.draw(*batch, dim=dim)
        weights = [Categorical(logits=p[0]) for p in (old, new)]
        parts = [Independent(Normal(*p[1:]), 1) for p in (old, new)]
        expected = kl_divergence(*weights) + (weights[0].probs * kl_divergence(*parts)).sum(-1)
        torch.testing.assert_close(matched_bound_kl(*old, *new), expected)

    def test_bounds_the_kl(self):
        """Which is an integral, here by quadrature."""
        torch.manual_seed(1)
        old, new = self.draw(20, dim=1)
        grid = torch.linspace(-60, 60, 200_001, dtype=torch.float64)[:, None]
        log_p, log_q = (
            MixtureSameFamily(Categorical(logits=w), Normal(m[..., 0], s[..., 0])).log_prob(grid)
            for w, m, s in (old, new)
        )
        kl = torch.trapezoid(log_p.exp() * (log_p - log_q), grid[:, 0], dim=0)
        bound = matched_bound_kl(*old, *new)
        assert (kl > 0).all()
        assert (bound >= kl - 1e-9).all()

    def test_one_component_is_the_kl_of_the_moments(self):
        torch.manual_seed(2)
        old, new = self.draw(6, components=1)
        moments = [(m[:, 0], torch.diag_embed(s[:, 0].square())) for _, m, s in (old, new)]
        expected = moment_matched_kl(*moments[0], *moments[1])
        torch.testing.assert_close(matched_bound_kl(*old, *new), expected)

    def test_sees_what_moments_do_not(self):
        """Two components trade places: the same mixture, by a path that leads far away."""
        logits, loc = torch.zeros(2), torch.tensor([[1.0], [-1.0]])
        scale = torch.full((2, 1), 0.1)
        mean, cov = mixture_moments(logits, loc, scale)
        assert moment_matched_kl(mean, cov, *mixture_moments(logits, -loc, scale)).abs() < 1e-6
        assert matched_bound_kl(logits, loc, scale, logits, -loc, scale) == pytest.approx(200.0)

    def test_zero_with_zero_gradient_at_equality(self):
        torch.manual_seed(3)
        old, _ = self.draw(5)
        new = [x.clone().requires_grad_() for x in old]
        kl = matched_bound_kl(*old, *new)
        torch.testing.assert_close(kl, torch.zeros_like(kl))
        for grad in torch.autograd.grad(kl.sum(), new):
            torch.testing.assert_close(grad, torch.zeros_like(grad))

    def test_gradient(self):
        torch.manual_seed(4)
        old, new = self.draw(2)
        new = [x.requires_grad_() for x in new]
        assert torch.autograd.gradcheck(lambda *p: matched_bound_kl(*old, *p), new)


class TestMomentMatchedKL:
    @pytest.mark.parametrize("dim", [1, 2, 3])
    @pytest.mark.parametrize("batch", [(), (7,), (4, 5)])
    def test_multivariate_normal(self, batch, dim):
        torch.manual_seed(0)
        mean = torch.randn(2, *batch, dim, dtype=torch.float64)
        root = torch.randn(2, *batch, dim, dim, dtype=torch.float64)
        cov = root @ root.mT + 0.1 * torch.eye(dim, dtype=torch.float64)
        expected = kl_divergence(
            MultivariateNormal(mean[0], cov[0]), MultivariateNormal(mean[1], cov[1])
        )
        torch.testing.assert_close(moment_matched_kl(mean[0], cov[0], mean[1], cov[1]), expected)

    def test_zero_with_zero_gradient_at_equality(self):
        mean = torch.randn(5, 2, dtype=torch.float64)
        cov = torch.eye(2, dtype=torch.float64).expand(5, 2, 2) * 0.3
        new_mean, new_cov = mean.clone().requires_grad_(), cov.clone().requires_grad_()
        kl = moment_matched_kl(mean, cov, new_mean, new_cov)
        grads = torch.autograd.grad(kl.sum(), (new_mean, new_cov))
        torch.testing.assert_close(kl, torch.zeros_like(kl))
        for grad in grads:
            torch.testing.assert_close(grad, torch.zeros_like(grad))


def exact_gaussian_kl(old_mean, old_cov, new_mean, new_cov):
    """KL(old || new) of two Gaussians with fifty digits."""
    with mpmath.workdps(50):
        m0, m1 = (mpmath.matrix(m.double().tolist()) for m in (old_mean, new_mean))
        c0, c1 = (mpmath.matrix(c.double().tolist()) for c in (old_cov, new_cov))
        inverse, shift = mpmath.inverse(c1), m1 - m0
        product = inverse * c0
        trace = sum(product[i, i] for i in range(len(m0)))
        determinants = mpmath.log(mpmath.det(c1) / mpmath.det(c0))
        return float((trace - len(m0) + (shift.T * inverse * shift)[0] + determinants) / 2)


class TestTinyDivergences:
    """Of the size of a trust region: what a step is judged by must not be rounding."""

    @pytest.mark.parametrize("size", [1.0, 1e3])
    @pytest.mark.parametrize("kl", [1e-6, 1e-4, 1e-2])
    @pytest.mark.parametrize("dim", [1, 2, 4])
    def test_moment_matched(self, size, kl, dim):
        generator = torch.Generator().manual_seed(dim)
        for _ in range(5):
            a = torch.randn(dim, dim, generator=generator, dtype=torch.float64)
            mean = size * torch.randn(dim, generator=generator, dtype=torch.float64)
            cov = size * (a @ a.T / dim + torch.eye(dim, dtype=torch.float64))
            tilt = math.sqrt(kl) * torch.randn(dim, dim, generator=generator).double()
            grow = torch.eye(dim, dtype=torch.float64) + tilt
            new = (mean + math.sqrt(size) * tilt[0], grow @ cov @ grow.T)
            given = [x.float() for x in (mean, cov, *new)]
            exact = exact_gaussian_kl(*given)
            assert 0 < exact < 100 * kl * dim**2
            assert moment_matched_kl(*given).item() == pytest.approx(exact, rel=3e-3)
            assert moment_matched_kl(*(x.double() for x in given)).item() == pytest.approx(
                exact, rel=1e-7
            )

    @pytest.mark.parametrize("kl", [1e-6, 1e-4, 1e-2])
    def test_matched_bound(self, kl):
        generator = torch.Generator().manual_seed(0)
        for _ in range(10):
            logits = 3 * torch.randn(3, generator=generator)
            loc = 1e3 * torch.randn(3, 2, generator=generator)
            scale = torch.rand(3, 2, generator=generator) + 0.5
            noise = [math.sqrt(kl) * torch.randn(x.shape, generator=generator) for x in (loc, loc)]
            new = (logits + noise[0][:, 0], loc + noise[0], scale * noise[1].exp())
            value = matched_bound_kl(logits, loc, scale, *new).item()
            log_old, log_new = logits.double().log_softmax(-1), new[0].double().log_softmax(-1)
            pairs = zip(log_old, log_new, loc, scale, *new[1:], strict=True)
            exact = 0.0
            for w, w_new, m, s, m_new, s_new in pairs:
                component = exact_gaussian_kl(
                    m, s.double().square().diag(), m_new, s_new.double().square().diag()
                )
                exact += w.exp().item() * ((w - w_new).item() + component)
            assert value == pytest.approx(exact, rel=3e-3)

    def test_a_weight_that_leaves_zero(self):
        """Its ratio overflows, its share does not: KL((1, 0) || (p, 1 - p)) = -log p."""
        loc, scale = torch.zeros(2, 1), torch.ones(2, 1)
        old, new = torch.tensor([0.0, -400.0]), torch.tensor([0.0, 1.0])
        value = matched_bound_kl(old, loc, scale, new, loc, scale)
        assert value.item() == pytest.approx(math.log(1 + math.e), rel=1e-6)

    @pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
    def test_half_types_are_computed_in_float32(self, dtype):
        mean, cov = torch.tensor([0.5, -0.25]), torch.tensor([[1.0, 0.25], [0.25, 0.5]])
        given = [x.to(dtype) for x in (mean, cov, mean + 2.0**-6, 1.0078125 * cov)]
        value = moment_matched_kl(*given)
        assert value.dtype == torch.float32
        assert value.item() == pytest.approx(exact_gaussian_kl(*given), rel=1e-3)
        logits, loc, scale = torch.zeros(2), torch.zeros(2, 1), torch.ones(2, 1)
        given = [x.to(dtype) for x in (logits, loc, scale, logits, loc + 2.0**-5, scale)]
        value = matched_bound_kl(*given)
        assert value.dtype == torch.float32
        assert value.item() == pytest.approx(2.0**-11, rel=1e-5)


class TestCategoricalKL:
    @pytest.mark.parametrize("batch", [(), (7,), (4, 5)])
    def test_is_the_kl(self, batch):
        torch.manual_seed(0)
        old, new = torch.randn(2, *batch, 4, dtype=torch.float64)
        expected = kl_divergence(Categorical(logits=old), Categorical(logits=new))
        torch.testing.assert_close(categorical_kl(old, new), expected)

    @pytest.mark.parametrize("kl", [1e-6, 1e-4, 1e-2])
    def test_tiny(self, kl):
        generator = torch.Generator().manual_seed(0)
        for _ in range(10):
            old = 3 * torch.randn(5, generator=generator)
            new = old + math.sqrt(kl) * torch.randn(5, generator=generator)
            with mpmath.workdps(50):
                p, q = ([mpmath.exp(x) for x in logits.double().tolist()] for logits in (old, new))
                p, q = ([x / sum(weights) for x in weights] for weights in (p, q))
                exact = float(sum(x * mpmath.log(x / y) for x, y in zip(p, q, strict=True)))
            assert categorical_kl(old, new).item() == pytest.approx(exact, rel=3e-3)

    def test_masked_actions(self):
        mask = torch.tensor([True, False, True])
        old, new = torch.randn(2, 6, 3, dtype=torch.float64)
        old, new = (x.masked_fill(~mask, -torch.inf) for x in (old, new))
        new.requires_grad_()
        kl = categorical_kl(old, new)
        torch.testing.assert_close(kl, categorical_kl(old[:, mask], new[:, mask]))
        (grad,) = torch.autograd.grad(kl.sum(), new)
        assert grad.isfinite().all()
        assert (grad[:, 1] == 0).all()

    def test_an_action_that_is_given_up_or_taken_up(self):
        logits, one = torch.zeros(2), torch.tensor([0.0, -torch.inf])
        assert categorical_kl(logits, one) == torch.inf
        assert categorical_kl(one, logits).item() == pytest.approx(math.log(2))

    def test_gradient(self):
        torch.manual_seed(4)
        old, new = torch.randn(2, 3, 4, dtype=torch.float64)
        assert torch.autograd.gradcheck(lambda x: categorical_kl(old, x), new.requires_grad_())
        same = old.clone().requires_grad_()
        (grad,) = torch.autograd.grad(categorical_kl(old, same).sum(), same)
        torch.testing.assert_close(grad, torch.zeros_like(grad))


class TestDistances:
    @staticmethod
    def mixtures(components):
        torch.manual_seed(0)
        shape = (2, 5, components)
        logits, loc = torch.randn(shape).double(), torch.randn(*shape, 2).double()
        scale = torch.rand(*shape, 2).double() + 0.5
        return [
            TanhGaussianMixture(*parameters) for parameters in zip(logits, loc, scale, strict=True)
        ]

    def test_mixtures_of_one_component_are_gaussians(self):
        old, new = self.mixtures(1)
        expected = kl_divergence(
            *(Independent(Normal(d.loc[:, 0], d.scale[:, 0]), 1) for d in (old, new))
        ).mean()
        for distance in (MOMENT_MATCHED, MATCHED_BOUND):
            kl = distance.kl(*(distance.statistics(dist) for dist in (old, new)))
            torch.testing.assert_close(kl, expected)

    def test_they_compare_what_they_are_named_after(self):
        old, new = self.mixtures(3)
        gaussians = [MultivariateNormal(*dist.moments) for dist in (old, new)]
        for distance, expected in (
            (MOMENT_MATCHED, kl_divergence(*gaussians)),
            (MATCHED_BOUND, kl_divergence(old, new)),
        ):
            # A closure's result is a TensorDict.
            statistics = [TensorDict(distance.statistics(d), batch_size=[5]) for d in (old, new)]
            torch.testing.assert_close(distance.kl(*statistics), expected.mean())

    @pytest.mark.parametrize("kind", [Categorical, OneHotCategorical])
    def test_discrete_policies(self, kind):
        torch.manual_seed(0)
        old, new = (kind(logits=logits) for logits in torch.randn(2, 5, 3))
        kl = CATEGORICAL.kl(*(CATEGORICAL.statistics(dist) for dist in (old, new)))
        expected = kl_divergence(*(Categorical(logits=d.logits) for d in (old, new))).mean()
        torch.testing.assert_close(kl, expected)

    def test_masked_policies(self):
        torch.manual_seed(0)
        mask = torch.tensor([[True, True, False], [True, False, True]])
        old, new = (MaskedCategorical(logits=x, mask=mask) for x in torch.randn(2, 2, 3))
        kl = CATEGORICAL.kl(*(CATEGORICAL.statistics(dist) for dist in (old, new)))
        expected = (old.probs * (old.probs / new.probs).nan_to_num(nan=1.0).log()).sum(-1).mean()
        torch.testing.assert_close(kl, expected)

    def test_names(self):
        assert DISTANCES == {
            "moment_matched": MOMENT_MATCHED,
            "matched_bound": MATCHED_BOUND,
            "categorical": CATEGORICAL,
        }
