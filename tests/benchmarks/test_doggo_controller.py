from __future__ import annotations

import itertools
import signal
from pathlib import Path

import doggo_controller
import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from walking import TIPPED, VERTICAL, Walking

from torchrl_safe.envs import SafeGoalEnv, check_safe_env
from torchrl_safe.envs.legs import load_legs
from torchrl_safe.trainers import cli

STAGE = "num_directions: 2, population: 4, elites: 2, num_steps: 4, generations: 2"
TINY = [
    "num_threads=1",
    "env.num_envs=8",
    f"gait=[{{{STAGE}, std: [0.6, 0.0]}}, {{{STAGE}, std: [0.1, 0.6]}}]",
    "collector.frames_per_batch=64",
    "collector.total_frames=256",
    "optim.minibatch_size=32",
    "eval.interval=128",
    "eval.num_directions=2",
    "eval.num_steps=3",
    "checkpoint.interval=1000",
]


def launch(run_dir: Path, *overrides: str) -> None:
    words = [f"run_dir={run_dir}", *TINY, *overrides]
    doggo_controller.main(cli.compose("doggo_controller", words))


def test_an_interrupted_run_ends_as_one_that_was_not(tmp_path, monkeypatch, capsys):
    launch(tmp_path / "whole")
    update, calls = doggo_controller.update, itertools.count(1)

    def interrupting(*args):
        if next(calls) == 2:
            signal.raise_signal(signal.SIGINT)
        return update(*args)

    monkeypatch.setattr(doggo_controller, "update", interrupting)
    launch(tmp_path / "parts")
    assert not (tmp_path / "parts" / "legs.safetensors").exists()
    assert "resume=true" in capsys.readouterr().out
    launch(tmp_path / "parts", "resume=true")
    whole, parts = (load_file(tmp_path / run / "legs.safetensors") for run in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    for name, value in whole.items():
        assert torch.equal(value, parts[name]), name
    legs = load_legs(tmp_path / "whole" / "legs.safetensors")
    assert abs(legs.weights[-1]).max() > 0  # PPO has moved what started at zero


class TestWalking:
    def test_contract(self):
        check_safe_env(SafeGoalEnv("doggo_torques", num_envs=3, num_threads=1, task=Walking()))

    def test_reward(self):
        """Against the definition, from the layouts before and after."""
        task = Walking()
        env = SafeGoalEnv("doggo_torques", num_envs=6, num_threads=1, task=task, seed=1)
        td = env.reset()
        generator = torch.Generator().manual_seed(0)
        over = 0
        for _ in range(30):
            before = [env.layout(i) for i in range(6)]
            td["action"] = torch.rand(6, 12, generator=generator) * 2 - 1
            td = env.step(td)["next"]
            vertical = env._core._robots.motion.proprioception[:, VERTICAL]
            for i in range(6):
                command = before[i]["command"]
                share = np.linalg.norm(command)
                moved = env.layout(i)["robot"] - before[i]["robot"]
                progress = moved @ command / share / 0.1
                wanted = 0.6 * share
                expected = progress if progress < wanted else 2 * wanted - progress
                expected -= 4.0 * (1 - vertical[i]) ** 2
                assert td["reward"][i].item() == pytest.approx(expected, abs=1e-5)
                assert td["terminated"][i].item() == (vertical[i] < TIPPED)
                over += progress > wanted
        assert over > 5

    def test_tests_keep_their_directions(self):
        env = SafeGoalEnv(
            "doggo_torques", num_envs=4, num_threads=1, task=Walking(num_directions=4)
        )
        env.reset()
        first = [env.layout(i) for i in range(4)]
        for i, layout in enumerate(first):
            ahead, way = (complex(*layout[name]) for name in ("heading", "command"))
            assert way / ahead == pytest.approx(1j**i)
        env.rollout(20, auto_reset=True)
        env.reset()
        assert abs(env.layout(1)["command"] @ env.layout(1)["heading"]) < 1e-9
