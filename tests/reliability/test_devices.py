"""Nothing is tied to the CPU: on a GPU the numbers are the same, and the host does not wait.

The tests marked ``gpu`` need one. ``test_host_sync.py`` counts what would make the host wait
without one.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import pytest
import torch
from tensordict import TensorDict
from test_host_sync import HostReads
from tiny import launch, options
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator

from torchrl_safe import (
    CVaRCostLoss,
    GMMTanhPolicy,
    TrustRegionSafeOptimizer,
    TsallisLoss,
)
from torchrl_safe.modules import DISTANCES, Distance
from torchrl_safe.objectives.value import PolicyEvaluation, evaluate_policy
from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import SafeTAC
from torchrl_safe.trainers import options as shared
from torchrl_safe.trainers.off_policy import make_slice_buffer, minibatches, replayed

OBS, ACT = 3, 2
MOMENT_MATCHED = DISTANCES["moment_matched"]
gpu = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
]
GPU = pytest.param("cuda", marks=gpu)


def make_critic(key: str, *last: nn.Module) -> ValueOperator:
    net = MLP(OBS + ACT, 1, num_cells=[16]).extend(last)
    return ValueOperator(net, in_keys=["observation", "action"], out_keys=[key]).double()


@contextmanager
def sync_debug_mode(mode: str) -> Iterator[None]:
    """Waits of the host are errors or warnings; that this is a prototype is said by torch, once."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Synchronization debug mode")
        torch.cuda.set_sync_debug_mode(mode)
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def make_blocks(device: str) -> tuple[GMMTanhPolicy, TsallisLoss, CVaRCostLoss]:
    """The same blocks on every device: a loss draws the weights of its ensemble where they are."""
    blocks = draw_blocks(device)
    for block, same in zip(blocks, draw_blocks("cpu"), strict=True):
        block.load_state_dict(same.state_dict())
    return blocks


def draw_blocks(device: str) -> tuple[GMMTanhPolicy, TsallisLoss, CVaRCostLoss]:
    torch.manual_seed(0)
    net = MLP(OBS, 3 * (1 + 2 * ACT), num_cells=[16])
    spec = Bounded(-1, 1, (ACT,), dtype=torch.float64, device=device)
    policy = GMMTanhPolicy(net, spec, num_components=3).double().to(device)
    reward_loss = TsallisLoss(
        policy,
        make_critic("state_action_value").to(device),
        alpha_init=1.0,  # its logarithm and back are exact: alpha is kept in single precision
        fixed_alpha=True,
        delay_qvalue=False,
    )
    reward_loss.make_value_estimator("retrace", gamma=0.9, lmbda=0.8)
    cost_loss = CVaRCostLoss(
        policy,
        make_critic("cost_value").to(device),
        make_critic("cost_std", nn.Softplus()).to(device),
        cost_limit=1.0,
    )
    cost_loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    return policy, reward_loss, cost_loss


def make_data(batch: tuple[int, int] = (6, 7)) -> TensorDict:
    """Trajectories."""
    generator = torch.Generator().manual_seed(1)

    def rand(*shape: int) -> torch.Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    done = rand(1) > 1
    return TensorDict(
        {
            "observation": rand(OBS),
            "action": rand(ACT).tanh(),
            "action_log_prob": rand(),
            "next": {
                "observation": rand(OBS),
                "reward": rand(1),
                "cost": rand(1).sigmoid(),
                "done": done,
                "terminated": done & (rand(1) > 0),
            },
        },
        batch,
    )


def evaluate(data: TensorDict, device: str) -> PolicyEvaluation:
    """The policy on the data, with draws that do not differ between devices."""
    torch.manual_seed(2)
    evaluation = evaluate_policy(data, make_blocks("cpu")[0])
    return PolicyEvaluation(*(tensor.to(device) for tensor in evaluation))


def make_closure(policy, reward_loss, cost_loss, states, noise, distance=MOMENT_MATCHED):
    """Noise is given, since generators of two devices differ."""

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        return TensorDict(
            objective=reward_loss.objective(states, action, log_prob).mean(),
            constraint=cost_loss.constraint(states, action)[None],
            statistics=TensorDict(distance.statistics(dist)),
        )

    return closure


def learn(device: str, distance: Distance) -> dict[str, torch.Tensor]:
    """What every block gives on a device."""
    policy, reward_loss, cost_loss = make_blocks(device)
    data = make_data().to(device)
    dist = policy.get_dist(data)
    noise = make_blocks("cpu")[0].get_dist(make_data()).draw_noise()
    noise = torch.utils._pytree.tree_map_only(torch.Tensor, lambda x: x.to(device), noise)
    out = {"log_prob": dist.log_prob(data["action"]), "action": dist.rsample(noise=noise)}
    out["mean"], out["cov"] = dist.moments
    evaluation = evaluate(make_data(), device)
    out["qvalue_target"] = reward_loss.compute_target(data, policy=evaluation)
    out["cost_target"], out["std_target"] = cost_loss.compute_target(data, policy=evaluation)
    data.update({name: out[name] for name in ("qvalue_target", "cost_target", "std_target")})
    losses = cost_loss(data)
    losses["loss_qvalue"], _ = reward_loss.qvalue_v2_loss(data)
    sum(losses[f"loss_{name}"] for name in ("qvalue", "cost_value", "cost_std")).backward()
    for name, params in (
        ("qvalue", reward_loss.qvalue_network_params),
        ("cost", cost_loss.cost_network_params),
        ("std", cost_loss.std_network_params),
    ):
        out |= {f"{name} {i}": p.grad for i, p in enumerate(params.parameters())}
    states = data.select("observation")
    optim = TrustRegionSafeOptimizer(policy.parameters(), max_kl=0.01, statistics_kl=distance.kl)
    report = optim.step(make_closure(policy, reward_loss, cost_loss, states, noise, distance))
    assert report.accepted, report
    return out | {f"weight {i}": p for i, p in enumerate(policy.parameters())}


@pytest.mark.parametrize("device", [GPU])
@pytest.mark.parametrize("distance", DISTANCES.values(), ids=DISTANCES)
def test_numbers_are_those_of_the_cpu(device, distance):
    expected, actual = learn("cpu", distance), learn(device, distance)
    for name, value in expected.items():
        assert actual[name].device.type == device
        # Conjugate gradients multiply the last digits by the curvature's condition.
        loose = 100 if name.startswith("weight") else 1
        torch.testing.assert_close(
            actual[name].cpu(),
            value,
            rtol=loose * 1e-8,
            atol=loose * 1e-10,
            msg=lambda text, name=name: f"{name}: {text}",
        )


def make_critics_update(device: str) -> Callable[[], None]:
    """Targets, losses, gradients and a step of Adam; what is settled once is settled."""
    policy, reward_loss, cost_loss = make_blocks(device)
    data = make_data().to(device)
    params = [
        *reward_loss.qvalue_network_params.parameters(),
        *cost_loss.cost_network_params.parameters(),
        *cost_loss.std_network_params.parameters(),
    ]
    optim = torch.optim.Adam(params, fused=True)

    def update() -> None:
        evaluation = evaluate_policy(data, policy)
        part = data.copy()
        part.set("qvalue_target", reward_loss.compute_target(part, policy=evaluation))
        cost_target, std_target = cost_loss.compute_target(part, policy=evaluation)
        part.update({"cost_target": cost_target, "std_target": std_target})
        losses = cost_loss(part)
        loss = losses["loss_cost_value"] + losses["loss_cost_std"]
        optim.zero_grad()
        (loss + reward_loss.qvalue_v2_loss(part)[0]).backward()
        optim.step()

    update()
    return update


def test_critics_read_nothing():
    update = make_critics_update("cpu")
    with HostReads() as reads:
        update()
    assert reads.count == 0


@pytest.mark.parametrize("device", [GPU])
def test_host_does_not_wait_for_critics(device):
    update = make_critics_update(device)
    with sync_debug_mode("error"):
        update()


def make_step(device: str, **settings) -> tuple[GMMTanhPolicy, Callable]:
    """A policy, and a trust-region step of it."""
    policy, reward_loss, cost_loss = make_blocks(device)
    states = make_data().to(device).select("observation")
    torch.manual_seed(3)
    noise = policy.get_dist(states).draw_noise()
    optim = TrustRegionSafeOptimizer(
        policy.parameters(), max_kl=1e-4, statistics_kl=MOMENT_MATCHED.kl, **settings
    )
    closure = make_closure(policy, reward_loss, cost_loss, states, noise)
    return policy, partial(optim.step, closure)


@pytest.mark.parametrize("device", [GPU])
def test_a_step_as_a_graph_is_the_same(device):
    """Step after step, whose graphs take over each other's memory."""
    plain, plain_step = make_step(device)
    graphed, graphed_step = make_step(device, cuda_graph=True)
    held = []
    for _ in range(4):
        expected, actual = plain_step().to_dict(), graphed_step().to_dict()
        assert actual == pytest.approx(expected, rel=1e-6, abs=1e-12)
        for a, b in zip(plain.parameters(), graphed.parameters(), strict=True):
            torch.testing.assert_close(b, a, rtol=1e-8, atol=1e-12)
        held.append(torch.cuda.memory_reserved())
    assert held[3] == held[1]


@pytest.mark.parametrize("device", [GPU])
def test_a_step_that_cannot_be_recorded_leaves_all_as_it_was(device):
    """And the next one can."""

    class Waits(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return grad * grad.isfinite().all().item()

    policy, step = make_step(device, cuda_graph=True)
    (closure,) = step.args
    before = [p.detach().clone() for p in policy.parameters()]

    def waits():
        out = closure()
        out["statistics", "mean"] = Waits.apply(out["statistics", "mean"])
        return out

    with pytest.raises(RuntimeError, match="captur"):
        step.func(waits)
    assert all(map(torch.equal, before, policy.parameters()))
    assert step().accepted


@pytest.mark.parametrize("cuda_graph", [False, True])
@pytest.mark.parametrize("device", [GPU])
def test_host_waits_for_the_line_search_alone(device, cuda_graph):
    """As often after twenty conjugate-gradient iterations as after two."""
    waits = {}
    for iterations in (2, 20):
        _, step = make_step(device, cg_iters=iterations, cuda_graph=cuda_graph)
        step()
        with sync_debug_mode("warn"), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            report = step()
        candidates = report.backtracks + 1
        waits[iterations] = len([w for w in caught if "synchroniz" in str(w.message)]), candidates
    assert waits[2] == waits[20], waits


@pytest.mark.parametrize("device", [GPU])
def test_cuda_graphs_learn_the_same(device, tmp_path):
    """A pass of gradient steps as one graph, and a bad number in it reaches nothing."""
    ends = []
    for graphs in (False, True):
        torch.manual_seed(0)
        trainer = SafeTAC(
            options=options(tmp_path, f"device={device}", f"optim.cuda_graphs={graphs}")
        )
        env = trainer.make_env(4, seed=0)
        optim, fit = trainer.build(env)["critic_optim"], trainer.fit_critics
        data = TensorDict(
            observation=torch.randn(100, 24),
            action=torch.rand(100, env.action_spec.shape[-1]) * 2 - 1,
            **{f"{name}_target": torch.rand(100, 1) for name in ("value", "cost", "std")},
            batch_size=[100],
        ).to(device)
        for _ in range(6):
            fit._descend(data.clone())
        assert fit.steps.count() == 0
        before = [p.detach().clone() for p in optim.param_groups[0]["params"]]
        bad = data.clone()
        bad["cost_target"][7] = torch.nan
        fit._descend(bad)
        assert fit.steps.count() == 1
        assert all(map(torch.equal, before, optim.param_groups[0]["params"]))
        fit._descend(data.clone())
        assert not any(map(torch.equal, before, optim.param_groups[0]["params"]))
        ends.append([p.detach() for p in optim.param_groups[0]["params"]])
    for eager, graph in zip(*ends, strict=True):
        torch.testing.assert_close(graph, eager, rtol=1e-3, atol=1e-5)


@pytest.mark.filterwarnings(
    "ignore:.*inline_inbuilt_nn_modules:FutureWarning",
    "ignore:.*autograd.Function:DeprecationWarning",
)
@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.long)])
def test_compiled_critics_learn_the_same(backend, tmp_path, monkeypatch):
    """Targets and losses are one graph each, and what they teach is what they teach without."""
    ends = []
    for compiled in (False, True):
        torch.manual_seed(0)
        trainer = SafeTAC(
            options=options(tmp_path, f"optim.compile={compiled}", "optim.minibatch_size=70")
        )
        env = trainer.make_env(4, seed=0)
        compile_ = partial(torch.compile, backend=backend, fullgraph=True)
        with monkeypatch.context() as patch:
            patch.setattr(torch, "compile", compile_)
            optim = trainer.build(env)["critic_optim"]
        fit = trainer.fit_critics
        with torch.no_grad():
            batch = env.rollout(50, trainer.policy, break_when_any_done=False)
        batch["collector", "traj_ids"] = torch.arange(4)[:, None].expand(4, 50).clone()
        trainer.buffer.extend(batch.select(*replayed(trainer)))
        before = [p.detach().clone() for p in optim.param_groups[0]["params"]]
        for _ in range(3):
            assert fit()["update/skipped_steps"] == 0
        ends.append([p.detach() for p in optim.param_groups[0]["params"]])
        assert not any(map(torch.equal, before, ends[-1]))
    for eager, compiled in zip(*ends, strict=True):
        torch.testing.assert_close(compiled, eager, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("device", [GPU])
def test_a_run(device, tmp_path):
    """With CUDA graphs: several updates, a checkpoint, and a resumed run from it."""
    launch(
        tmp_path / "run",
        f"device={device}",
        "optim.critic_rounds=4",
        "collector.total_frames=400",
    )
    more = ["resume=true", "collector.total_frames=600"]
    launch(tmp_path / "run", f"device={device}", "optim.critic_rounds=4", *more)
    losses = read_metrics(tmp_path / "run" / "log")["update/loss_qvalue"][1]
    assert len(losses) == 6
    assert torch.as_tensor(losses).isfinite().all()


def test_networks_and_replay_are_on_the_device(tmp_path, monkeypatch):
    """``meta`` stands in for a GPU."""
    trainer = SafeTAC(options=options(tmp_path))
    env = trainer.make_env(2, seed=0)
    assert env.device == torch.device("cpu")
    assert not any(p.is_meta for p in trainer.make_policy(env).parameters())
    monkeypatch.setattr(shared, "devices", lambda: ["meta"])
    trainer.options.device = "meta"
    networks = trainer.make_policy(env), trainer.make_critic(env, "cost_value")
    assert all(p.is_meta for network in networks for p in network.parameters())
    assert make_slice_buffer(trainer).storage.device == torch.device("meta")


def test_minibatches_are_drawn_where_the_data_is():
    data = TensorDict(x=torch.arange(10.0), batch_size=[10])
    parts = list(minibatches(data, 4))
    assert [len(part) for part in parts] == [4, 4, 2]
    assert torch.cat([part["x"] for part in parts]).sort().values.equal(data["x"])
    assert not torch.cat([part["x"] for part in parts]).equal(data["x"])
    (part,) = minibatches(data.to("meta"), 10)  # an order on the CPU would raise
    assert part["x"].is_meta
