"""A constrained trust-region step, and the part of it that solves for the natural gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import pytest
import torch
from bench_training import compose
from tensordict import TensorDict
from torch import Tensor

from torchrl_safe import GMMTanhPolicy, TrustRegionSafeOptimizer
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.modules import DISTANCES
from torchrl_safe.optim.curvature import (
    Product,
    conjugate_gradient,
    flatten,
    gauss_newton_product,
    gradient,
    hessian_product,
)
from torchrl_safe.optim.repetition import CudaGraphRepeat, Repeat, one_by_one
from torchrl_safe.trainers import SafeTAC

NUM_STATES = 5000
MOMENTS = DISTANCES["moment_matched"]
CG_ITERS = 10


def make_closures(
    width: int,
    device: str,
) -> tuple[Any, GMMTanhPolicy, TensorDict, Callable[..., Callable[[], TensorDict]]]:
    """Options, policy, states, and a maker of closures with an active constraint."""
    torch.manual_seed(0)
    widths = [f"policy.num_cells=[{width},{width}]", f"critic.num_cells=[{width},{width}]"]
    options = compose([*widths, "policy.num_components=5", f"device={device}"])
    env = SafeGoalEnv(num_envs=1, num_threads=1, device=device)
    trainer = SafeTAC(options=options)
    trainer.build(env)
    policy = trainer.policy
    states = TensorDict({"observation": torch.randn(NUM_STATES, 24)}, [NUM_STATES]).to(device)
    batch = env.rollout(20, policy)
    limits = {name: loss.on_policy_cvar(batch) for name, loss in trainer.cost_losses.items()}

    def closure_of(curvature_frames: int | None = None) -> Callable[[], TensorDict]:
        torch.manual_seed(0)
        return trainer.policy_closure(states, limits, batch, curvature_frames)

    return options, policy, states, closure_of


def in_terms_of_kl(closure: Callable[[], TensorDict]) -> Callable[[], TensorDict]:
    """The same closure, for an optimizer that knows nothing of the policy's moments."""
    with torch.no_grad():
        old = closure()["statistics"]

    def kl_closure() -> TensorDict:
        out = closure()
        out["kl"] = MOMENTS.kl(old, out.pop("statistics"))
        return out

    return kl_closure


def rebuilt_hessian_product(policy: GMMTanhPolicy, states: TensorDict) -> Product:
    """Double backward as most CPO code has it: the KL and its gradient anew for every product."""
    params = list(policy.parameters())

    def product(vectors: Tensor) -> Tensor:
        rows = []
        for vector in vectors:
            new = TensorDict(MOMENTS.statistics(policy.get_dist(states)))
            slope = flatten(
                gradient("kl", [MOMENTS.kl(new.detach(), new)], params, create_graph=True)
            )
            rows.append(flatten(gradient("slope", [slope @ vector], params)))
        return torch.stack(rows)

    return product


def make_solver(width: int, device: str, curvature: str) -> Callable[[], Tensor]:
    """Conjugate gradients for g and b, from the closure's outputs to both solutions."""
    options, policy, states, closure_of = make_closures(width, device)
    params = list(policy.parameters())
    repeat: Repeat = one_by_one
    stream: Callable[[], AbstractContextManager[None]] = nullcontext
    if curvature == "gauss_newton_cuda_graph":
        repeat = CudaGraphRepeat(torch.device(device))
        stream = repeat.stream
    with stream():
        out = closure_of(NUM_STATES // 4)()
        old = out["statistics"].detach().clone()
        outputs = [out["objective"], out["constraint"].squeeze()]
        rhs = torch.stack([flatten(gradient("g, b", [output], params)) for output in outputs])

    def make_product() -> Product:
        if curvature == "gauss_newton_quarter":
            return gauss_newton_product(out["curvature_statistics"], MOMENTS.kl, params)
        if curvature.startswith("gauss_newton"):
            return gauss_newton_product(out["statistics"], MOMENTS.kl, params)
        if curvature == "double_backward":
            return hessian_product(MOMENTS.kl(old, out["statistics"]), params)
        return rebuilt_hessian_product(policy, states)

    def solve() -> Tensor:
        damping = options.optim.damping
        with stream():
            product = make_product()
            return conjugate_gradient(
                lambda v: product(v) + damping * v, rhs, CG_ITERS, repeat=repeat
            ).solution

    return solve


@contextmanager
def double_precision() -> Iterator[None]:
    """For what is made inside: ten iterations amplify the last digits of single precision."""
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize(
    "curvature",
    [
        "gauss_newton",
        "gauss_newton_cuda_graph",
        "gauss_newton_quarter",
        "double_backward",
        "double_backward_rebuilt",
    ],
)
@pytest.mark.parametrize("width", [128, 512], ids="24-{0}-{0}".format)
def bench_natural_gradients(
    benchmark: Any, device: str, timed: Any, width: int, curvature: str
) -> None:
    """The part of a step that solves two systems; directions are compared in double precision."""
    benchmark.group = f"natural gradients of g and b, 24-{width}-{width}, {NUM_STATES} states"
    solve = make_solver(width, device, curvature)
    benchmark.pedantic(timed(solve), rounds=3, warmup_rounds=1)
    with double_precision():
        solution, exact = (
            make_solver(width, device, each)() for each in (curvature, "double_backward")
        )
    cosine = torch.cosine_similarity(solution, exact).min().item()
    benchmark.extra_info["smallest cosine to double backward"] = round(cosine, 6)
    assert cosine > (0.8 if curvature == "gauss_newton_quarter" else 0.9999)


@pytest.mark.parametrize(
    "curvature",
    ["gauss_newton", "gauss_newton_cuda_graph", "gauss_newton_quarter", "double_backward"],
)
@pytest.mark.parametrize("width", [128, 512], ids="24-{0}-{0}".format)
def bench_step(benchmark: Any, device: str, timed: Any, width: int, curvature: str) -> None:
    """One step from the same weights on the same states, line search included."""
    benchmark.group = f"trust-region step, 24-{width}-{width}, 5 Gaussians, {NUM_STATES} states"
    options, policy, _, closure_of = make_closures(width, device)
    optim = TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=options.optim.max_kl,
        damping=options.optim.damping,
        cg_iters=CG_ITERS,
        statistics_kl=None if curvature == "double_backward" else MOMENTS.kl,
        cuda_graph=curvature.endswith("cuda_graph"),
    )
    weights = [p.detach().clone() for p in policy.parameters()]

    def setup() -> tuple[tuple[Any], dict[str, Any]]:
        with torch.no_grad():
            torch._foreach_copy_(list(policy.parameters()), weights)
        closure = closure_of(NUM_STATES // 4 if curvature == "gauss_newton_quarter" else None)
        return (in_terms_of_kl(closure) if curvature == "double_backward" else closure,), {}

    report = benchmark.pedantic(timed(optim.step), setup=setup, rounds=3, warmup_rounds=1)
    benchmark.extra_info |= {
        "case": report.case,
        "backtracks": report.backtracks,
        "kl": round(report.kl, 5),
        "objective_change": round(report.objective_change, 5),
        "constraint_change": round(report.constraint_change[0], 5) if report.accepted else 0.0,
    }
    assert report.accepted, report
