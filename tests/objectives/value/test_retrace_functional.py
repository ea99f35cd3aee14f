"""Retrace targets against their definition, TD(lambda), expected SARSA and a solved MDP."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torchrl.objectives.value.functional import (
    td_lambda_return_estimate,
    vec_td_lambda_return_estimate,
)
from torchrl.testing import get_default_devices

from torchrl_safe.objectives.value import trace_lambda_return_estimate

GAMMA, LMBDA = 0.95, 0.9
NAMES = (
    "log_pi",
    "log_mu",
    "action_value",
    "next_state_value",
    "reward",
    "done",
    "terminated",
)


def make_inputs(
    *batch: int, steps: int, features: int = 1, dtype: torch.dtype = torch.float64, seed: int = 0
) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = (*batch, steps, features)

    def randn(*size: int) -> Tensor:
        return torch.randn(size, generator=generator, dtype=torch.float64).to(dtype)

    done = torch.rand(shape, generator=generator) < 0.3
    return {
        "log_pi": randn(*shape[:-1], 1),
        "log_mu": randn(*shape[:-1], 1),
        "action_value": randn(*shape),
        "next_state_value": randn(*shape),
        "reward": randn(*shape),
        "done": done,
        "terminated": done & (torch.rand(shape, generator=generator) < 0.5),
    }


# Munos et al., 2016, table 1: the trace coefficient from lambda and the two probabilities.
COEFFICIENTS = {
    "retrace": lambda lmbda, pi, mu: lmbda * min(1.0, pi / mu),
    "importance_sampling": lambda lmbda, pi, mu: lmbda * pi / mu,
    "tree_backup": lambda lmbda, pi, mu: lmbda * pi,
    "q_lambda": lambda lmbda, pi, mu: lmbda,
}
IGNORED = {"tree_backup": ["log_mu"], "q_lambda": ["log_pi", "log_mu"]}


def estimate_by(trace: str, *args, **inputs) -> Tensor:
    """The target without the densities that the trace does not read."""
    ignored = dict.fromkeys(IGNORED.get(trace, []))
    return trace_lambda_return_estimate(*args, **{**inputs, **ignored}, trace=trace)


def by_definition(
    gamma,
    lmbda,
    log_pi,
    log_mu,
    q,
    next_value,
    reward,
    done,
    terminated,
    coefficient=COEFFICIENTS["retrace"],
) -> Tensor:
    """Q + sum over s >= t of gamma^(s-t) (prod of c up to s) (TD error of s), in floats."""
    target = torch.empty_like(reward)
    *batch, steps, features = reward.shape
    gamma = torch.as_tensor(gamma, dtype=torch.float64).expand(reward.shape)
    for index in torch.cartesian_prod(*map(torch.arange, (*batch, features))).reshape(
        -1, len(batch) + 1
    ):
        *b, f = index.tolist()
        at = [(*b, t, f) for t in range(steps)]
        pi, mu = (
            [math.exp(log_prob[(*b, t, 0)].item()) for t in range(steps)]
            for log_prob in (log_pi, log_mu)
        )
        for t in range(steps):
            total = q[at[t]].item()
            for s in range(t, steps):
                weight = 1.0
                for i in range(t + 1, s + 1):
                    weight *= gamma[at[i - 1]].item() * coefficient(lmbda, pi[i], mu[i])
                bootstrap = 0.0 if terminated[at[s]] else next_value[at[s]].item()
                error = reward[at[s]] + gamma[at[s]] * bootstrap - q[at[s]]
                total += weight * error.item()
                if done[at[s]]:
                    break
            target[at[t]] = total
    return target


@pytest.mark.parametrize("vectorized", [True, False])
@pytest.mark.parametrize("steps", [1, 2, 3, 8, 16, 17, 32, 45])
@pytest.mark.parametrize(("batch", "features"), [((), 1), ((3,), 1), ((2, 2), 3)])
def test_definition(batch: tuple[int, ...], features: int, steps: int, vectorized: bool) -> None:
    inputs = make_inputs(*batch, steps=steps, features=features, seed=steps)
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs, vectorized=vectorized)
    torch.testing.assert_close(target, by_definition(GAMMA, LMBDA, *inputs.values()))


def by_loop(gamma, lmbda, inputs: dict[str, Tensor]) -> Tensor:
    """One backward pass over time; the definition without its double sum."""
    x = {name: tensor.movedim(-2, 0) for name, tensor in inputs.items()}
    reward = inputs["reward"]
    gamma, lmbda = (
        torch.as_tensor(value, dtype=reward.dtype, device=reward.device)
        .expand(reward.shape)
        .movedim(-2, 0)
        for value in (gamma, lmbda)
    )
    target, following = [], None
    for t in reversed(range(len(x["reward"]))):
        value = x["reward"][t] + gamma[t] * x["next_state_value"][t].masked_fill(
            x["terminated"][t], 0
        )
        if following is not None:
            trace = lmbda[t] * (x["log_pi"][t + 1] - x["log_mu"][t + 1]).exp().clamp_max(1)
            ahead = gamma[t] * trace * (following - x["action_value"][t + 1])
            value = value + ahead.masked_fill(x["done"][t], 0)
        target.append(value)
        following = value
    return torch.stack(target[::-1], -2)


@pytest.mark.parametrize("device", get_default_devices())
@pytest.mark.parametrize("gamma", [0.1, 0.5, 0.99])
@pytest.mark.parametrize("lmbda", [0.1, 0.99])
@pytest.mark.parametrize("batch", [(1,), (3,), (7, 3)])
@pytest.mark.parametrize(("steps", "features"), [(200, 1), (5, 2), (3, 5)])
@pytest.mark.parametrize("dtype", [torch.float, torch.double])
@pytest.mark.parametrize("has_done", [False, True])
def test_grid(gamma, lmbda, batch, steps, features, dtype, has_done, device) -> None:
    inputs = make_inputs(*batch, steps=steps, features=features, dtype=dtype)
    inputs = {name: tensor.to(device) for name, tensor in inputs.items()}
    if not has_done:
        inputs["done"][:] = inputs["terminated"][:] = False
    expected = by_loop(gamma, lmbda, inputs)
    for vectorized in (True, False):
        target = trace_lambda_return_estimate(gamma, lmbda, **inputs, vectorized=vectorized)
        assert target.dtype == dtype
        torch.testing.assert_close(target, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("shape", ["number", "element", "step", "batch", "feature"])
@pytest.mark.parametrize("steps", [3, 50])
@pytest.mark.parametrize("has_done", [False, True])
def test_discounts_of_any_shape(has_done: bool, steps: int, shape: str) -> None:
    inputs = make_inputs(7, 3, steps=steps, features=2)
    if not has_done:
        inputs["done"][:] = inputs["terminated"][:] = False
    sizes = {
        "number": (),
        "element": (1,),
        "step": (7, 3, steps, 1),
        "batch": (7, 1, 1, 1),
        "feature": (7, 3, steps, 2),
    }
    gamma = torch.rand(sizes[shape], dtype=torch.float64)
    expected = by_loop(gamma, LMBDA, inputs)
    for vectorized in (True, False):
        target = trace_lambda_return_estimate(gamma, LMBDA, **inputs, vectorized=vectorized)
        torch.testing.assert_close(target, expected)


@pytest.mark.parametrize("trace", COEFFICIENTS)
@pytest.mark.parametrize("steps", [4, 200])
@pytest.mark.parametrize("batch", [(3,), (3, 7)])
def test_successive_trajectories(trace, batch: tuple[int, ...], steps: int) -> None:
    """Two trajectories end to end have the targets of each alone, terminated or not."""
    inputs = make_inputs(*batch, steps=steps)
    inputs["done"][..., steps // 2 - 1, :] = True
    halves = [
        estimate_by(trace, GAMMA, LMBDA, **{name: x[..., part, :] for name, x in inputs.items()})
        for part in (slice(None, steps // 2), slice(steps // 2, None))
    ]
    for vectorized in (True, False):
        whole = estimate_by(trace, GAMMA, LMBDA, **inputs, vectorized=vectorized)
        torch.testing.assert_close(whole, torch.cat(halves, -2))


def test_arguments() -> None:
    """Inputs by place or name; settings by name alone; dimensions of a batch around time."""
    inputs = {name: x.movedim(-2, 2) for name, x in make_inputs(2, 3, 4, steps=20).items()}
    by_name = trace_lambda_return_estimate(gamma=GAMMA, lmbda=LMBDA, **inputs, time_dim=2)
    values = inputs.values()
    for time_dim in (2, -3):
        target = trace_lambda_return_estimate(GAMMA, LMBDA, *values, time_dim=time_dim)
        torch.testing.assert_close(target, by_name)
    with pytest.raises(TypeError, match="positional arguments"):
        trace_lambda_return_estimate(GAMMA, LMBDA, *values, True, 2)


@pytest.mark.parametrize("lmbda", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("vectorized", [True, False])
@pytest.mark.parametrize("trace", COEFFICIENTS)
def test_trace_coefficients(trace, vectorized: bool, lmbda: float) -> None:
    inputs = make_inputs(3, steps=19, features=2)
    inputs["log_pi"] = inputs["log_pi"].sigmoid().log()  # probabilities, for Tree-Backup
    expected = by_definition(GAMMA, lmbda, *inputs.values(), coefficient=COEFFICIENTS[trace])
    target = estimate_by(trace, GAMMA, lmbda, **inputs, vectorized=vectorized)
    torch.testing.assert_close(target, expected)
    moved = {name: x.transpose(0, 1) for name, x in inputs.items()}
    target = estimate_by(trace, GAMMA, lmbda, **moved, vectorized=vectorized, time_dim=0)
    torch.testing.assert_close(target, expected.transpose(0, 1))


@pytest.mark.parametrize("trace", COEFFICIENTS)
def test_expected_targets_are_exact(trace: str) -> None:
    """Off-policy, the exact action values of an MDP are their own expected targets."""
    mdp = RandomMDP(0)
    value = mdp._with_terminal(mdp.mean[:-1], 1e3)
    target = mdp.expected_target(mdp.gamma, 0.7, value, mdp.stored_cost(), trace)
    torch.testing.assert_close(target, mdp.mean[:-1].flatten())


def test_importance_sampling_is_monte_carlo() -> None:
    """At lambda = 1 no value counts but the last: the weighted return has the right mean."""
    mdp = RandomMDP(1)
    wrong = torch.rand_like(mdp.mean)
    states = mdp.successor[:, -1, 0]
    bootstrap = mdp._with_terminal(mdp.mean[:-1])[states, mdp.bootstrap[:, -1, 0]]
    next_value = wrong[mdp.successor, mdp.bootstrap]
    next_value[:, -1, 0] = bootstrap
    # The mean over next actions is exact, so that the wrong values cancel step by step.
    next_value[:, :-1] = (mdp.pi * wrong).sum(-1)[mdp.successor[:, :-1]]
    target = trace_lambda_return_estimate(
        mdp.gamma,
        1.0,
        mdp.pi.log()[mdp.state, mdp.action],
        mdp.mu.log()[mdp.state, mdp.action],
        wrong[mdp.state, mdp.action],
        next_value,
        mdp.stored_cost(),
        mdp.successor == mdp.num_states,
        trace="importance_sampling",
    )
    total = torch.zeros(mdp.num_states * mdp.num_actions, dtype=torch.float64)
    total.index_add_(0, mdp.start, mdp.probability * target[:, 0, 0])
    torch.testing.assert_close(total, mdp.mean[:-1].flatten())


def test_discount_per_step() -> None:
    inputs = make_inputs(2, steps=19, features=2)
    gamma = torch.rand(2, 19, 1, dtype=torch.float64)
    expected = by_definition(gamma, LMBDA, *inputs.values())
    torch.testing.assert_close(trace_lambda_return_estimate(gamma, LMBDA, **inputs), expected)
    moved = {name: tensor.transpose(0, 1) for name, tensor in inputs.items()}
    target = trace_lambda_return_estimate(gamma.transpose(0, 1), LMBDA, **moved, time_dim=0)
    torch.testing.assert_close(target, expected.transpose(0, 1))


@pytest.mark.parametrize("vectorized", [True, False])
def test_trace_decay_per_step(vectorized: bool) -> None:
    """That of a step is from it to the next, as its discount is."""
    inputs = make_inputs(2, steps=19, features=2)
    lmbda = torch.rand(2, 19, 1, dtype=torch.float64)
    target = trace_lambda_return_estimate(GAMMA, lmbda, **inputs, vectorized=vectorized)
    torch.testing.assert_close(target, by_loop(GAMMA, lmbda, inputs))


@pytest.mark.parametrize("shape", [(), (1,), (1, 1, 1)])
def test_scalar_tensors(shape: tuple[int, ...]) -> None:
    inputs = make_inputs(2, steps=5)
    gamma = torch.full(shape, GAMMA, dtype=torch.float64)
    lmbda = torch.full(shape, LMBDA, dtype=torch.float64)
    target = trace_lambda_return_estimate(gamma, lmbda, **inputs)
    torch.testing.assert_close(target, trace_lambda_return_estimate(GAMMA, LMBDA, **inputs))


@pytest.mark.parametrize("estimate", [td_lambda_return_estimate, vec_td_lambda_return_estimate])
def test_on_policy_is_td_lambda(estimate) -> None:
    # TD(lambda) knows values of states only: the two agree where Q(s, a) = V(s).
    inputs = make_inputs(4, steps=30)
    inputs["log_pi"] = inputs["log_mu"]
    value = inputs["action_value"]
    follows = ~inputs["done"][:, :-1]
    inputs["next_state_value"][:, :-1] = torch.where(
        follows, value[:, 1:], inputs["next_state_value"][:, :-1]
    )
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    expected = estimate(
        GAMMA,
        LMBDA,
        *(inputs[name] for name in ("next_state_value", "reward", "done", "terminated")),
    )
    # TorchRL's vectorised TD(lambda) drops weights below 1e-7.
    torch.testing.assert_close(target, expected, rtol=1e-5, atol=1e-5)


def test_lambda_zero_is_expected_sarsa() -> None:
    inputs = make_inputs(4, steps=20)
    target = trace_lambda_return_estimate(GAMMA, 0.0, **inputs)
    expected = inputs["reward"] + GAMMA * inputs["next_state_value"] * ~inputs["terminated"]
    torch.testing.assert_close(target, expected)


def test_ratio_is_clipped_and_belongs_to_the_next_step() -> None:
    zeros = torch.zeros(3, 1, dtype=torch.float64)
    reward = torch.tensor([[1.0], [10.0], [100.0]], dtype=torch.float64)
    never = torch.zeros(3, 1, dtype=torch.bool)

    def target(*ratios: float) -> list[float]:
        log_pi = torch.tensor(ratios, dtype=torch.float64).log().unsqueeze(-1)
        return (
            trace_lambda_return_estimate(0.5, 1.0, log_pi, zeros, zeros, zeros, reward, never)
            .squeeze(-1)
            .tolist()
        )

    assert target(1, 1, 1) == [31, 60, 100]
    assert target(7, 5, 3) == [31, 60, 100]
    # The first step's own ratio plays no role; a TD error has none.
    assert target(0, 1, 1) == [31, 60, 100]
    assert target(1, 0, 1) == [1, 60, 100]
    assert target(1, 0.5, 0.25) == [1 + 0.25 * 22.5, 10 + 0.125 * 100, 100]


def test_terminated_defaults_to_done() -> None:
    inputs = make_inputs(3, steps=10)
    inputs["terminated"] = inputs["done"]
    expected = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    del inputs["terminated"]
    torch.testing.assert_close(trace_lambda_return_estimate(GAMMA, LMBDA, **inputs), expected)


def test_truncation_inside_the_batch() -> None:
    """TorchRL issue 4209: a truncated step must not read the trajectory stored after it."""
    inputs = make_inputs(steps=12)
    inputs["done"][:] = False
    inputs["done"][4] = True
    inputs["terminated"][:] = False
    whole = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    parts = [
        trace_lambda_return_estimate(GAMMA, LMBDA, **{k: v[part] for k, v in inputs.items()})
        for part in (slice(None, 5), slice(5, None))
    ]
    torch.testing.assert_close(whole, torch.cat(parts))
    torch.testing.assert_close(
        whole[4], inputs["reward"][4] + GAMMA * inputs["next_state_value"][4]
    )


@pytest.mark.parametrize("time_dim", [0, 1, 2, -2, -3, -4])
def test_time_dim(time_dim: int) -> None:
    inputs = make_inputs(2, 3, steps=18, features=4)
    expected = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs).movedim(-2, time_dim)
    moved = {name: tensor.movedim(-2, time_dim) for name, tensor in inputs.items()}
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **moved, time_dim=time_dim)
    torch.testing.assert_close(target, expected)


@pytest.mark.parametrize("trace", COEFFICIENTS)
@pytest.mark.parametrize("name", NAMES)
def test_shapes_are_strict(trace: str, name: str) -> None:
    ignored = IGNORED.get(trace, [])
    if name in ignored:
        pytest.skip("not read")
    inputs = make_inputs(2, steps=5, features=3)
    inputs[name] = inputs[name][:, :-1]
    # A reward that differs from all others is what they are compared with.
    named = name if name != "reward" else "action_value"
    origin = "that of reward" + " with one feature" * named.startswith("log")
    with pytest.raises(
        ValueError, match=rf"^{named} must have shape \(2, [45], [13]\), {origin}, g"
    ):
        estimate_by(trace, GAMMA, LMBDA, **inputs)


def test_log_density_has_one_feature() -> None:
    inputs = make_inputs(2, steps=5, features=3)
    for log_pi in (inputs["log_pi"].squeeze(-1), inputs["log_pi"].expand(2, 5, 3)):
        with pytest.raises(ValueError, match=r"log_pi must have shape \(2, 5, 1\)"):
            trace_lambda_return_estimate(GAMMA, LMBDA, **{**inputs, "log_pi": log_pi})


@pytest.mark.parametrize("time_dim", [-1, 2, 3, -4])
def test_time_dim_out_of_range(time_dim: int) -> None:
    inputs = make_inputs(2, steps=5)
    with pytest.raises(ValueError, match="time_dim must be"):
        trace_lambda_return_estimate(GAMMA, LMBDA, **inputs, time_dim=time_dim)


@pytest.mark.parametrize("name", ["done", "terminated"])
def test_flags_are_boolean(name: str) -> None:
    inputs = make_inputs(2, steps=5)
    inputs[name] = inputs[name].float()
    with pytest.raises(TypeError, match=f"{name} must be boolean"):
        trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)


@pytest.mark.parametrize("value", [-0.1, 1.1, math.nan, math.inf])
@pytest.mark.parametrize("name", ["gamma", "lmbda"])
def test_coefficients_out_of_range(name: str, value: float) -> None:
    coefficients = {"gamma": GAMMA, "lmbda": LMBDA, name: value}
    with pytest.raises(ValueError, match=rf"{name} must be in \[0, 1\], got {value}"):
        trace_lambda_return_estimate(**coefficients, **make_inputs(2, steps=5))


@pytest.mark.parametrize("shape", [(5,), (2, 5), (2, 4, 1), (1, 2, 5, 1)])
def test_coefficient_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="gamma must be a number"):
        trace_lambda_return_estimate(torch.ones(shape), LMBDA, **make_inputs(2, steps=5))


@pytest.mark.parametrize("vectorized", [True, False])
def test_gradient(vectorized: bool) -> None:
    inputs = make_inputs(steps=18, features=2)
    flags = (inputs.pop("done"), inputs.pop("terminated"))
    coefficients = [torch.tensor(value, dtype=torch.float64) for value in (GAMMA, LMBDA)]
    arguments = [tensor.requires_grad_() for tensor in (*coefficients, *inputs.values())]
    assert torch.autograd.gradcheck(
        lambda *args: trace_lambda_return_estimate(*args, *flags, vectorized=vectorized),
        arguments,
    )


def test_masked_entries_may_be_nan() -> None:
    inputs = make_inputs(3, steps=40)
    inputs["done"][0, 4] = inputs["terminated"][0, 4] = True
    expected = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    first = torch.ones_like(inputs["done"])
    first[:, 1:] = inputs["done"][:, :-1]
    inputs["next_state_value"][inputs["terminated"]] = math.nan
    inputs["log_pi"][first] = math.nan
    inputs["log_mu"][first] = math.nan
    floating = [inputs[name].requires_grad_() for name in NAMES[:5]]
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    torch.testing.assert_close(target, expected)
    for gradient in torch.autograd.grad(target.sum(), floating):
        assert gradient.isfinite().all()


def test_impossible_actions() -> None:
    # A density of zero under either policy: no trace, or a full one.
    inputs = make_inputs(3, steps=20)
    inputs["log_pi"][:, 3] = -math.inf
    inputs["log_mu"][:, 5] = -math.inf
    finite = {name: tensor.clone() for name, tensor in inputs.items()}
    finite["log_pi"][:, 3] = -1e3
    finite["log_mu"][:, 5] = -1e3
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    torch.testing.assert_close(target, by_definition(GAMMA, LMBDA, *clip(finite).values()))


def clip(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Bound the log-ratio, which Python's exp overflows on."""
    log_mu = torch.maximum(inputs["log_mu"], inputs["log_pi"])
    return {**inputs, "log_mu": log_mu}


@pytest.mark.parametrize(
    ("dtype", "rtol", "atol"), [(torch.float32, 1e-5, 1e-5), (torch.bfloat16, 0.01, 0.02)]
)
def test_dtype(dtype: torch.dtype, rtol: float, atol: float) -> None:
    inputs = make_inputs(2, steps=200, dtype=dtype)
    exact = {name: x.double() if x.is_floating_point() else x for name, x in inputs.items()}
    target = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    assert target.dtype == dtype
    expected = trace_lambda_return_estimate(GAMMA, LMBDA, **exact)
    torch.testing.assert_close(target.double(), expected, rtol=rtol, atol=atol)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision_is_stable(dtype: torch.dtype) -> None:
    """A thousand rewards of 1: bfloat16 has no .99, and a running sum in it stops growing."""
    ones, zeros = torch.ones(1000, 1, dtype=dtype), torch.zeros(1000, 1, dtype=dtype)
    target = trace_lambda_return_estimate(0.99, 1.0, zeros, zeros, zeros, zeros, ones, zeros.bool())
    assert target.dtype == dtype
    left = torch.arange(1000, 0, -1, dtype=torch.float64).unsqueeze(-1)
    exact = (1 - 0.99**left) / 0.01
    torch.testing.assert_close(target.double(), exact, rtol=2**-8, atol=0)


def test_long_undiscounted_trajectory() -> None:
    # Trace 1 throughout: the sum of what is left, which a product-and-divide scheme handles too;
    # then ratios of exp(-50), whose products underflow and may not be divided by.
    steps = 3000
    ones, zeros = torch.ones(steps, 1), torch.zeros(steps, 1)
    never = torch.zeros(steps, 1, dtype=torch.bool)
    target = trace_lambda_return_estimate(1.0, 1.0, zeros, zeros, zeros, zeros, ones, never)
    torch.testing.assert_close(target, torch.arange(steps, 0, -1.0).unsqueeze(-1))
    log_pi = torch.full((steps, 1), -50.0)
    target = trace_lambda_return_estimate(1.0, 1.0, log_pi, zeros, zeros, zeros, ones, never)
    torch.testing.assert_close(target, ones)


def test_vmap() -> None:
    inputs = make_inputs(3, 2, steps=20)
    expected = trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    target = torch.vmap(lambda *args: trace_lambda_return_estimate(GAMMA, LMBDA, *args))(
        *inputs.values()
    )
    torch.testing.assert_close(target, expected)
    # Over discounts, as in a sweep.
    gammas = torch.tensor([0.0, 0.5, 1.0], dtype=torch.float64)
    targets = torch.vmap(lambda gamma: trace_lambda_return_estimate(gamma, LMBDA, **inputs))(gammas)
    for gamma, target in zip(gammas.tolist(), targets, strict=True):
        torch.testing.assert_close(target, trace_lambda_return_estimate(gamma, LMBDA, **inputs))


def test_compile() -> None:
    compiled = torch.compile(trace_lambda_return_estimate, backend="eager", fullgraph=True)
    for steps in (20, 24):
        inputs = make_inputs(2, steps=steps)
        torch.testing.assert_close(
            compiled(GAMMA, LMBDA, **inputs),
            trace_lambda_return_estimate(GAMMA, LMBDA, **inputs),
        )


def test_inputs_are_left_alone() -> None:
    inputs = make_inputs(2, steps=6)
    before = {name: tensor.clone() for name, tensor in inputs.items()}
    trace_lambda_return_estimate(GAMMA, LMBDA, **inputs)
    for name, tensor in inputs.items():
        torch.testing.assert_close(tensor, before[name], rtol=0, atol=0)


class RandomMDP:
    """Three states, two actions and a terminal state; all trajectories of three steps.

    Along each, ``a`` is drawn from mu and ``b``, the next action of the bootstrap, from pi.
    ``mean`` and ``variance`` are those of the discounted cost sum under pi, from linear systems.
    """

    num_states, num_actions, horizon, gamma = 3, 2, 3, 0.9

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)

        def rand(*shape: int) -> Tensor:
            return torch.rand(shape, generator=generator, dtype=torch.float64)

        states, actions, gamma = self.num_states, self.num_actions, self.gamma
        # The last state is terminal; what follows it is another trajectory's and irrelevant.
        transition = rand(states + 1, actions, states + 1).square()
        self.transition = transition / transition.sum(-1, keepdim=True)
        self.cost = 2 * rand(states + 1, actions, states + 1)
        self.pi, self.mu = (
            (weights / weights.sum(-1, keepdim=True))
            for weights in (rand(states + 1, actions).square(), rand(states + 1, actions))
        )

        size = states * actions
        move = self.transition[:-1, :, :-1, None] * self.pi[:-1]
        move = move.reshape(size, size)
        chance, cost = self.transition[:-1], self.cost[:-1]
        eye = torch.eye(size, dtype=torch.float64)
        mean = torch.linalg.solve(eye - gamma * move, (chance * cost).sum(-1).reshape(size))
        self.mean = self._with_terminal(mean)
        next_mean = (self.pi * self.mean).sum(-1)
        second = chance * (cost.square() + 2 * gamma * cost * next_mean)
        second = torch.linalg.solve(eye - gamma**2 * move, second.sum(-1).reshape(size))
        self.variance = self._with_terminal(second - mean.square())
        self._enumerate()

    def _with_terminal(self, values: Tensor, terminal: float = 0.0) -> Tensor:
        values = values.reshape(self.num_states, self.num_actions)
        return torch.cat([values, values.new_full((1, self.num_actions), terminal)])

    def _enumerate(self) -> None:
        states, actions = self.num_states, self.num_actions
        sizes = [states, actions, *[states + 1, actions, actions] * self.horizon]
        first, action, *rest = torch.cartesian_prod(*map(torch.arange, sizes)).unbind(-1)
        self.start = first * actions + action
        probability = torch.ones(len(first), dtype=torch.float64)
        steps, state = [], first
        for successor, stored, bootstrap in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
            probability = probability * self.transition[state, action, successor]
            probability = probability * self.mu[successor, stored] * self.pi[successor, bootstrap]
            steps.append((state, action, successor, bootstrap))
            state, action = successor, stored
        self.probability = probability
        self.state, self.action, self.successor, self.bootstrap = (
            torch.stack(column, 1).unsqueeze(-1) for column in zip(*steps, strict=True)
        )

    def expected_target(
        self,
        gamma: float,
        lmbda: float,
        value: Tensor,
        reward: Tensor,
        trace: str = "retrace",
    ) -> Tensor:
        """E_mu[first target | s, a], for a value ``[S + 1, A]``."""
        densities = {
            "log_pi": self.pi.log()[self.state, self.action],
            "log_mu": self.mu.log()[self.state, self.action],
        }
        target = estimate_by(
            trace,
            gamma,
            lmbda,
            **densities,
            action_value=value[self.state, self.action],
            next_state_value=value[self.successor, self.bootstrap],
            reward=reward,
            done=self.successor == self.num_states,
        )
        total = torch.zeros(self.num_states * self.num_actions, dtype=torch.float64)
        return total.index_add(0, self.start, self.probability * target[:, 0, 0])

    def stored_cost(self) -> Tensor:
        return self.cost[self.state, self.action, self.successor]


@pytest.mark.parametrize("vectorized", [True, False])
@pytest.mark.parametrize("what", ["reward", "action_value", "next_state_value", "log_pi"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_what_is_not_finite_stays_behind_its_cut(vectorized, what, value):
    """Targets and gradients before the cut are those without it; its own trajectory shows it."""
    torch.manual_seed(0)
    steps, cut, bad = 40, 19, 25
    done = torch.zeros(steps, 1, dtype=torch.bool)
    done[cut] = True
    names = ("log_pi", "log_mu", "action_value", "next_state_value", "reward")
    data = {name: torch.randn(steps, 1, dtype=torch.float64) for name in names}

    def estimate(data):
        leaves = {name: tensor.clone().requires_grad_() for name, tensor in data.items()}
        target = trace_lambda_return_estimate(
            0.99, 0.97, **leaves, done=done, terminated=~done & done, vectorized=vectorized
        )
        gradients = torch.autograd.grad(target[: cut + 1].sum(), leaves.values())
        return target, [gradient[: cut + 1] for gradient in gradients]

    expected, slopes = estimate(data)
    data[what][bad] = value
    target, gradients = estimate(data)
    torch.testing.assert_close(target[: cut + 1], expected[: cut + 1])
    torch.testing.assert_close(gradients, slopes)
    if what != "log_pi":
        assert not target[cut + 1 : bad].isfinite().any()


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool])
def test_counts_and_flags_are_rewards(dtype):
    torch.manual_seed(0)
    reward = torch.rand(3, 9, 1) < 0.5
    done = torch.rand(3, 9, 1) < 0.2
    rest = [torch.randn(3, 9, 1) for _ in range(4)]
    target = trace_lambda_return_estimate(0.9, 0.9, *rest, reward.to(dtype), done)
    assert target.dtype == torch.float32
    expected = trace_lambda_return_estimate(0.9, 0.9, *rest, reward.float(), done)
    torch.testing.assert_close(target, expected)


@pytest.mark.parametrize("steps", [10, 40, 100])
def test_a_density_that_is_no_number_stays_behind_every_cut(steps):
    """However far behind it: a product of coefficients over the cut must not carry it back."""
    names = ("log_pi", "log_mu", "action_value", "next_state_value", "reward")
    torch.manual_seed(0)
    data = {name: torch.randn(steps, 1, dtype=torch.float64) for name in names}
    for cut in range(1, steps - 3):
        for bad in range(cut + 2, min(cut + 6, steps)):
            done = torch.zeros(steps, 1, dtype=torch.bool)
            done[cut] = True
            log_pi = data["log_pi"].clone()
            log_pi[bad] = math.nan
            target = trace_lambda_return_estimate(
                GAMMA, LMBDA, **{**data, "log_pi": log_pi}, done=done, terminated=~done & done
            )
            assert target[: cut + 1].isfinite().all()
            assert target[cut + 1 : bad].isnan().all()
            assert target[bad:].isfinite().all()


def test_traces_by_name() -> None:
    inputs = make_inputs(2, steps=5)
    with pytest.raises(ValueError, match=r"trace must be one of 'retrace', .*, got 'v_trace'"):
        trace_lambda_return_estimate(GAMMA, LMBDA, **inputs, trace="v_trace")
    for trace, name in (("retrace", "log_mu"), ("tree_backup", "log_pi")):
        with pytest.raises(ValueError, match=f"{name} must be a tensor for trace='{trace}'"):
            trace_lambda_return_estimate(GAMMA, LMBDA, **{**inputs, name: None}, trace=trace)
