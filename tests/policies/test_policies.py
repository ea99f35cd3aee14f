"""Policies in files of their own: those that come with the library, and how they are read."""

from __future__ import annotations

import json
import shlex

import keep_policy
import pytest
import tiny
import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe import policies
from torchrl_safe.trainers import cli, load_policy
from torchrl_safe.trainers.commands import play
from torchrl_safe.trainers.environments import UntrustedError
from torchrl_safe.trainers.saved_policies import read_policy
from torchrl_safe.trainers.surroundings import commit

OVERRIDES = ("collector.total_frames=100", "loss.cost_limit=2.5", "policy.num_components=2")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    tiny.launch(path, *OVERRIDES)
    return path


@pytest.fixture
def kept(run_dir, tmp_path, monkeypatch):
    """Its policy among the library's, as ``tiny``."""
    monkeypatch.setattr(policies, "FOLDER", tmp_path)
    keep_policy.keep_policy(run_dir, tmp_path / "tiny.safetensors", num_episodes=3)
    return tmp_path / "tiny.safetensors"


def test_is_the_runs(run_dir, kept):
    policy, options, about = policies.load("tiny")
    expected = load_policy(run_dir)
    observation = torch.randn(5, 24)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        actions = [
            each(TensorDict(observation=observation, batch_size=5))["action"]
            for each in (policy, expected)
        ]
    torch.testing.assert_close(*actions, rtol=0, atol=0)
    assert options.loss.cost_limit == 2.5
    assert about["commit"] == (commit() or "unknown")
    for mean, low, high in about["figures"].values():
        assert low <= mean <= high
    # The command trains such a policy again.
    program, subcommand, method, *words = shlex.split(about["command"])
    assert (program, subcommand) == ("torchrl-safe", "train")
    again = cli.compose(method, words).settings()
    for name in ("run_dir", "num_threads"):
        again[name] = options.settings()[name]
    assert again == options.settings()


def test_is_played_by_name(kept, tmp_path, capsys):
    metrics = play.main("tiny", episodes=2, steps=5, out=tmp_path / "film.mp4")
    assert metrics["length"] == 5
    assert "torchrl-safe train safetac" in capsys.readouterr().out


def test_unknown_name(kept):
    with pytest.raises(KeyError, match="name must be one of tiny, got 'other'"):
        policies.load("other")


def rewritten(path, tensors=None, **settings):
    """The file with other weights or settings."""
    size = int.from_bytes(path.read_bytes()[:8], "little")
    metadata = json.loads(path.read_bytes()[8 : 8 + size])["__metadata__"]
    changed = json.loads(metadata["settings"])
    for name, value in settings.items():
        group, last = name.split("__")
        changed[group][last] = value
    metadata["settings"] = json.dumps(changed)
    save_file(load_file(path) if tensors is None else tensors, path, metadata)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"policy__num_cells": [9]}, "are not its options'"),
        ({"policy__num_cells": [10**9, 10**9]}, "must be of at most"),
        ({"policy__width": 3}, "policy.width is not an option"),
        ({"env__robot": "tank"}, "env.robot must be null or one of"),
    ],
)
def test_options_that_do_not_fit(kept, settings, match):
    rewritten(kept, **settings)
    with pytest.raises(CheckpointError, match=match):
        read_policy(kept)


def test_weights_that_are_no_numbers(kept):
    tensors = {name: torch.full_like(value, torch.nan) for name, value in load_file(kept).items()}
    rewritten(kept, tensors)
    with pytest.raises(CheckpointError, match="is not finite"):
        read_policy(kept)


def test_code_is_not_imported(kept):
    rewritten(kept, env__name="this:that")
    with pytest.raises(UntrustedError, match="names code"):
        read_policy(kept)


@pytest.mark.parametrize("content", [b"", b"\xff" * 100, b"\x02\0\0\0\0\0\0\0{}", b"\x80\x04."])
def test_what_is_no_policy(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="holds no policy"):
        read_policy(path)


@pytest.mark.slow
@pytest.mark.parametrize("name", policies.names())
def test_does_what_is_said_of_it(name):
    """Twenty other episodes, whose own intervals meet those of the figures beside the weights."""
    saved = policies.load(name)
    assert (policies.FOLDER / f"{name}.safetensors").stat().st_size <= keep_policy.LARGEST
    for figure, (_, low, high) in keep_policy.figures(saved, 20, seed=1).items():
        _, least, most = saved.about["figures"][figure]
        assert low <= most, figure
        assert high >= least, figure
