from __future__ import annotations

import copy
import math
import pickle
import subprocess
import sys

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, set_skip_existing
from torch import nn
from torchrl.data import Bounded, Categorical, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl.testing.mocking_classes import ContinuousActionVecMockEnv

from torchrl_safe.modules import GMMParamExtractor, GMMTanhPolicy, TanhGaussianMixture

RELAXATIONS = ("gumbel_softmax", "straight_through", "implicit")
SPEC = Bounded(-1.0, 1.0, shape=(2,))


def make_policy(components=3, observation=5, **kwargs):
    torch.manual_seed(0)
    network = MLP(in_features=observation, out_features=components * 5, depth=1, num_cells=16)
    kwargs.setdefault("action_spec", SPEC)
    return GMMTanhPolicy(network, num_components=components, **kwargs)


def make_data(*batch, observation=5):
    return TensorDict(observation=torch.randn(*batch, observation), batch_size=batch)


class Constant(nn.Module):
    """A network that outputs the same features everywhere."""

    def __init__(self, features):
        super().__init__()
        self.features = nn.Parameter(torch.as_tensor(features))

    def forward(self, observation):
        return self.features.expand(*observation.shape[:-1], -1)


class TestExtractor:
    def test_splits_in_order(self):
        extractor = GMMParamExtractor(2, 3, log_std_bounds=(-5.0, 1.0))
        features = torch.arange(14.0).expand(4, 6, 14)
        logits, loc, scale = extractor(features)
        assert torch.equal(logits[1, 2], torch.tensor([0.0, 1.0]))
        assert torch.equal(loc[1, 2], torch.tensor([[2.0, 3.0, 4.0], [5.0, 6.0, 7.0]]))
        assert (scale[1, 2].flatten().diff() > 0).all()
        assert extractor.num_features == 14

    @pytest.mark.parametrize("bounds", [(-4.0, 2.0), (-5.0, 1.0), (-3.0, -1.0), (1.0, 4.0)])
    def test_log_std_stays_inside_and_its_gradient_alive(self, bounds):
        low, high = bounds
        extractor = GMMParamExtractor(1, 1, log_std_bounds=bounds)
        feature = torch.linspace(-8, 8, 101, dtype=torch.float64).requires_grad_()
        log_std = extractor(torch.stack([0 * feature, 0 * feature, feature], -1))[2].log().squeeze()
        assert ((log_std >= low) & (log_std <= high)).all()
        assert log_std.min() < low + 0.05
        assert log_std.max() > high - 0.05
        (slope,) = torch.autograd.grad(log_std.sum(), feature)
        assert (slope > 1e-9).all()

    def test_is_the_feature_itself_near_zero(self):
        extractor = GMMParamExtractor(1, 1)
        feature = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        log_std = extractor(feature)[2].log()
        assert log_std.item() == pytest.approx(0, abs=1e-12)
        assert torch.autograd.grad(log_std.sum(), feature)[0][2].item() == pytest.approx(1)

    @pytest.mark.parametrize("width", [14, 16])
    def test_wrong_width(self, width):
        with pytest.raises(ValueError, match=rf"= 15 columns, got shape \(4, {width}\)"):
            GMMParamExtractor(3, 2)(torch.zeros(4, width))

    @pytest.mark.parametrize(
        ("args", "kwargs", "name"),
        [
            ((0, 2), {}, "num_components"),
            ((3, 0), {}, "action_dim"),
            ((3, 2), {"log_std_bounds": (2.0, -4.0)}, "log_std_bounds"),
            ((3, 2), {"log_std_bounds": (-4.0, float("nan"))}, "log_std_bounds"),
        ],
    )
    def test_bad_arguments(self, args, kwargs, name):
        with pytest.raises(ValueError, match=name):
            GMMParamExtractor(*args, **kwargs)


class TestPolicy:
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    @pytest.mark.parametrize("exploration", [ExplorationType.RANDOM, ExplorationType.DETERMINISTIC])
    def test_writes_only_the_action_and_its_score(self, relaxation, exploration):
        policy = make_policy(relaxation=relaxation)
        with set_exploration_type(exploration):
            td = policy(make_data(7))
        assert set(td.keys()) == {"observation", "action", "action_log_prob"}
        assert policy.out_keys == ["action", "action_log_prob"]
        assert td["action"].shape == (7, 2)
        assert td["action_log_prob"].shape == (7,)
        score = policy.get_dist(td).log_prob(td["action"])
        torch.testing.assert_close(td["action_log_prob"], score, rtol=1e-4, atol=1e-4)

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    @pytest.mark.parametrize("gradients", [True, False])
    @pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
    @pytest.mark.parametrize("box", [(-1.0, 1.0), (100.0, 101.0), (-2.0, 3.0)])
    @pytest.mark.parametrize(
        ("loc", "log_std"), [(0.0, 0.0), (11.0, -1.0), (40.0, -50.0), (-9.0, 50.0)]
    )
    def test_ratio_of_a_policy_to_itself(self, relaxation, gradients, dtype, box, loc, log_std):
        """Saturated, narrow, wide: what is stored is the density of the stored action."""
        features = torch.tensor([0.3, 0.0, loc, -loc, log_std, log_std], dtype=dtype)
        spec = Bounded(*box, shape=(1,), dtype=dtype)
        policy = GMMTanhPolicy(Constant(features), spec, num_components=2, relaxation=relaxation)
        with torch.set_grad_enabled(gradients):
            data = policy(make_data(200).to(dtype)).detach()
        score = policy.get_dist(data).log_prob(data["action"])
        assert score.isfinite().all()
        assert torch.equal(data["action_log_prob"], score)
        (score * torch.randn(200).to(dtype)).mean().backward()
        (network, _) = policy[0].module
        assert network.features.grad.abs().sum() > 0

    def test_entropy_is_of_the_draw(self):
        """Scored where tanh rounded it, a saturated policy would look random to an entropy."""
        features = torch.tensor([0.0, 20.0, -2.0], dtype=torch.float64)
        policy = GMMTanhPolicy(Constant(features), Bounded(-1.0, 1.0, (1,)), num_components=1)
        dist = policy.get_dist(make_data(20_000).double())
        torch.manual_seed(0)
        _, drawn = dist.sample_and_log_prob()
        # h(tanh u) = h(u) + E log(1 - tanh^2 u), the latter 2 (log 2 - u) this far out
        scale = dist.scale[0].item()
        entropy = 0.5 * math.log(2 * math.pi * math.e * scale**2) + 2 * (math.log(2) - 20.0)
        assert -drawn.mean().item() == pytest.approx(entropy, abs=0.02)

    def test_score_is_optional(self):
        td = make_policy(return_log_prob=False)(make_data(7))
        assert set(td.keys()) == {"observation", "action"}

    def test_get_dist_leaves_its_input_as_it_was(self):
        policy, td = make_policy(), make_data(7)
        td["loc"] = torch.zeros(7)
        dist = policy.get_dist(td)
        assert isinstance(dist, TanhGaussianMixture)
        assert set(td.keys()) == {"observation", "loc"}
        assert torch.equal(td["loc"], torch.zeros(7))
        with pytest.raises(KeyError, match="observation"):
            policy.get_dist(TensorDict(state=torch.zeros(3, 5), batch_size=3))

    def test_exploration_types(self):
        policy, td = make_policy(), make_data(7)
        assert policy.default_interaction_type is ExplorationType.RANDOM
        assert not torch.equal(policy(td)["action"], policy(td.clone())["action"])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            first, second = policy(td)["action"], policy(td.clone())["action"]
        assert torch.equal(first, second)
        torch.testing.assert_close(first, policy.get_dist(td).deterministic_sample)

    @pytest.mark.parametrize("gradients", [True, False])
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_acts_with_exact_draws(self, relaxation, gradients):
        """Two narrow components: a soft draw would lie between them."""
        features = torch.tensor([0.0, 0.0, -1.0, -1.0, 1.0, 1.0, *[-50.0] * 4])
        policy = GMMTanhPolicy(Constant(features), SPEC, num_components=2, relaxation=relaxation)
        torch.manual_seed(0)
        with torch.set_grad_enabled(gradients):
            action = policy(make_data(5000))["action"].atanh()
        assert ((action.abs() - 1).abs() < 0.15).all()
        assert (action[:, 0] > 0).double().mean().item() == pytest.approx(0.5, abs=0.04)
        assert torch.equal(action[:, 0] > 0, action[:, 1] > 0)

    def test_bounds_come_from_the_spec(self):
        spec = Bounded(torch.tensor([-3.0, 0.0]), torch.tensor([-1.0, 5.0]), shape=(2,))
        policy = make_policy(action_spec=spec)
        with torch.no_grad():
            policy[0].module[0][-1].weight.mul_(200)
            action = policy(make_data(2000))["action"]
        assert policy.spec["action"].is_in(action)
        assert spec.project(action.clone()).equal(action)
        torch.testing.assert_close(action.amin(0), spec.space.low, atol=1e-3, rtol=0)
        torch.testing.assert_close(action.amax(0), spec.space.high, atol=1e-3, rtol=0)

    def test_an_action_that_is_a_matrix(self):
        """One state, one action of 2 x 3 numbers: not the three that the last dimension has."""
        network = nn.Linear(5, 14)
        policy = GMMTanhPolicy(network, Bounded(-1.0, 1.0, (2, 3)), num_components=2)
        with pytest.raises(ValueError, match=r"action_spec has shape \(2, 3\).*\(14,\).*flat"):
            policy(make_data())
        assert policy(make_data(4, 2))["action"].shape == (4, 2, 3)  # agents

    def test_batched_spec(self):
        policy = make_policy(action_spec=SPEC.expand(8, 2))
        assert policy.spec["action"].shape == (2,)
        assert policy(make_data(8))["action"].shape == (8, 2)

    def test_nested_keys_and_several_inputs(self):
        policy = make_policy(
            observation=7,
            in_keys=[("agent", "state"), "goal"],
            out_keys=[("agent", "action")],
        )
        td = TensorDict(
            agent=TensorDict(state=torch.randn(4, 5), batch_size=4),
            goal=torch.randn(4, 2),
            batch_size=4,
        )
        policy(td)
        assert set(td.keys(True, True)) == {
            "goal",
            ("agent", "state"),
            ("agent", "action"),
            ("agent", "action_log_prob"),
        }

    def test_skips_an_existing_action(self):
        policy, td = make_policy(), make_data(4)
        td["action"], td["action_log_prob"] = torch.zeros(4, 2), torch.zeros(4)
        with set_skip_existing(True):
            assert torch.equal(policy(td)["action"], torch.zeros(4, 2))

    @pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda p: pickle.loads(pickle.dumps(p))])
    def test_copies(self, duplicate):
        policy, td = make_policy(relaxation="implicit", temperature=0.3), make_data(4)
        twin = duplicate(policy)
        assert set(twin(td.clone()).keys()) == {"observation", "action", "action_log_prob"}
        with torch.no_grad():
            policy[0].module[0][-1].weight.add_(1)
        dist, other = policy.get_dist(td), twin.get_dist(td)
        assert not torch.equal(dist.loc, other.loc)
        assert other.relaxation == "implicit"
        assert other.temperature == 0.3
        twin.load_state_dict(policy.state_dict())
        torch.testing.assert_close(twin.get_dist(td).loc, dist.loc)

    def test_follows_the_type_of_its_parameters(self):
        td = make_policy().double()(make_data(4).double())
        assert td["action"].dtype == torch.float64
        assert td["action_log_prob"].dtype == torch.float64

    def test_wrong_network_width(self):
        policy = GMMTanhPolicy(nn.Linear(5, 14), SPEC, num_components=3)
        with pytest.raises(ValueError, match="= 15 columns"):
            policy(make_data(4))

    @pytest.mark.parametrize(
        ("kwargs", "error", "message"),
        [
            ({"action_spec": Unbounded(shape=(2,))}, TypeError, "action_spec"),
            ({"action_spec": Categorical(3, shape=(2,))}, TypeError, "action_spec"),
            ({"action_spec": Bounded(-1.0, 1.0, shape=())}, TypeError, "action_spec"),
            (
                {"action_spec": Bounded(-1.0, torch.tensor([1.0, torch.inf]))},
                ValueError,
                "finite",
            ),
            (
                {"action_spec": Bounded(-1.0, torch.tensor([[1.0], [2.0]]))},
                ValueError,
                "one pair of bounds",
            ),
            ({"relaxation": "soft"}, ValueError, "relaxation"),
            ({"temperature": -1.0}, ValueError, "temperature"),
            ({"log_std_bounds": (1.0, 0.0)}, ValueError, "log_std_bounds"),
        ],
    )
    def test_bad_arguments(self, kwargs, error, message):
        with pytest.raises(error, match=message):
            make_policy(**kwargs)

    def test_zero_components(self):
        with pytest.raises(ValueError, match="num_components"):
            GMMTanhPolicy(nn.Linear(5, 5), SPEC, num_components=0)


class TestTorchRL:
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_sac_loss(self, relaxation):
        policy = make_policy(relaxation=relaxation)
        critic = ValueOperator(
            MLP(in_features=7, out_features=1, depth=1, num_cells=16),
            in_keys=["observation", "action"],
        )
        loss = SACLoss(policy, critic, action_spec=SPEC)
        loss.make_value_estimator(gamma=0.9)
        SoftUpdate(loss, tau=0.01)
        td = policy(make_data(32)).detach()
        td["next"] = make_data(32).update(
            {
                "reward": torch.randn(32, 1),
                "done": torch.zeros(32, 1, dtype=torch.bool),
                "terminated": torch.zeros(32, 1, dtype=torch.bool),
            }
        )
        losses = loss(td)
        losses["loss_actor"].backward()
        actor = list(loss.actor_network_params.values(True, True))
        assert all(p.grad.isfinite().all() and p.grad.any() for p in actor)
        assert losses["loss_qvalue"].isfinite()
        assert not {"logits", "loc", "scale"} & set(td.keys(True))

    def test_functional_parameters(self):
        policy, td = make_policy(), make_data(4)
        parameters = TensorDict.from_module(policy)
        with (parameters.clone() * 0).to_module(policy):
            dist = policy.get_dist(td)
        assert not dist.loc.any()
        assert policy.get_dist(td).loc.any()

    # Raised by torchrl itself, the first time its collectors are imported.
    @pytest.mark.filterwarnings("ignore:Creating .*WeightUpdater:DeprecationWarning")
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_collector(self, relaxation):
        from torchrl.collectors import Collector

        env = ContinuousActionVecMockEnv()
        dim = env.action_spec_unbatched.shape[-1]
        extractor = GMMParamExtractor(3, dim)
        policy = GMMTanhPolicy(
            nn.Linear(env.observation_spec["observation"].shape[-1], extractor.num_features),
            env.action_spec_unbatched,
            relaxation=relaxation,
        )
        collector = Collector(
            env,
            policy,
            frames_per_batch=20,
            total_frames=20,
            auto_register_policy_transforms=False,
        )
        (batch,) = list(collector)
        collector.shutdown()
        assert batch["action_log_prob"].shape == (20,)
        assert env.action_spec_unbatched.is_in(batch["action"][0])
        assert not {"logits", "loc", "scale"} & {
            k if isinstance(k, str) else k[-1] for k in batch.keys(True)
        }

    def test_is_a_probabilistic_actor_module(self):
        policy = make_policy()
        assert isinstance(policy[0], TensorDictModule)
        assert policy.in_keys == ["observation"]
        assert policy.log_prob_keys == ["action_log_prob"]


def test_needs_no_simulator():
    code = "import sys; sys.modules['mujoco'] = None; import torchrl_safe.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
