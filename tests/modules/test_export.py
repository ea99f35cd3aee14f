from __future__ import annotations

import importlib.util

import onnxruntime
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

from torchrl_safe import GMMTanhPolicy
from torchrl_safe.modules import DeterministicAction, export_policy

SPEC = Bounded(torch.tensor([-2.0, 0.0]), torch.tensor([1.0, 3.0]))


def mixture():
    torch.manual_seed(0)
    return GMMTanhPolicy(MLP(5, 15, num_cells=[16]), SPEC, num_components=3)


def gaussian():
    """An actor of TorchRL's own."""
    torch.manual_seed(0)
    network = nn.Sequential(MLP(5, 4, num_cells=[16]), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=SPEC,
        distribution_class=TanhNormal,
    )


@pytest.fixture
def example():
    return TensorDict(observation=torch.zeros(1, 5), batch_size=1)


class Sum(nn.Module):
    def __init__(self):
        super().__init__()
        self.first, self.second = nn.Linear(3, 5), nn.Linear(2, 5)

    def forward(self, first, second):
        return self.first(first) + self.second(second)


def of_two_inputs():
    return GMMTanhPolicy(Sum(), SPEC, num_components=1, in_keys=["scan", ("body", "pose")])


@pytest.mark.parametrize("make", [mixture, gaussian])
@pytest.mark.parametrize("batch", [1, 6])
def test_parity(tmp_path, example, make, batch):
    policy = make()
    path = export_policy(policy, tmp_path / "new" / "policy.pt2", example)
    observation = 3 * torch.randn(batch, 5)
    expected = policy.get_dist(
        TensorDict(observation=observation, batch_size=batch)
    ).deterministic_sample
    torch.testing.assert_close(torch.export.load(path).module()(observation), expected)
    torch.testing.assert_close(DeterministicAction(policy)(observation), expected)


def test_two_inputs(tmp_path):
    policy = of_two_inputs()
    example = TensorDict(
        {"scan": torch.zeros(1, 3), "body": {"pose": torch.zeros(1, 2)}}, batch_size=1
    )
    path = export_policy(policy, tmp_path / "policy.pt2", example)
    scan, pose = torch.randn(4, 3), torch.randn(4, 2)
    data = TensorDict({"scan": scan, "body": {"pose": pose}}, batch_size=4)
    torch.testing.assert_close(
        torch.export.load(path).module()(scan, pose), policy.get_dist(data).deterministic_sample
    )


def test_onnx(tmp_path):
    """The inputs' names are the keys, joined; any number of states."""
    policy = of_two_inputs()
    data = TensorDict(
        {"scan": torch.randn(4, 3), "body": {"pose": torch.randn(4, 2)}}, batch_size=4
    )
    path = export_policy(policy, tmp_path / "policy.onnx", data[:1])
    inputs = {"scan": data["scan"].numpy(), "body.pose": data["body", "pose"].numpy()}
    (action,) = onnxruntime.InferenceSession(path).run(["action"], inputs)
    expected = policy.get_dist(data).deterministic_sample
    torch.testing.assert_close(torch.from_numpy(action), expected)


class TestMisuse:
    def test_suffix(self, tmp_path, example):
        with pytest.raises(ValueError, match=r"path must end in .pt2 or .onnx, got .*policy.pt"):
            export_policy(mixture(), tmp_path / "policy.pt", example)

    def test_no_batch(self, tmp_path, example):
        with pytest.raises(ValueError, match=r"batch size \[B\], got \(\)"):
            export_policy(mixture(), tmp_path / "policy.pt2", example[0])

    def test_missing_key(self, tmp_path):
        with pytest.raises(KeyError, match=r"\['observation'\] are missing"):
            export_policy(mixture(), tmp_path / "policy.pt2", TensorDict(batch_size=1))

    def test_missing_packages(self, tmp_path, example, monkeypatch):
        monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-safe\[export\]'"):
            export_policy(mixture(), tmp_path / "policy.onnx", example)
        assert not list(tmp_path.iterdir())
