"""SafeTAC in one file does what the trainer does."""

from __future__ import annotations

import re

import safetac_single_file
import torch

TINY = [
    *("--num-envs", "10", "--episode-length", "50", "--frames-per-batch", "200"),
    *("--total-frames", "800", "--init-frames", "400", "--num-cells", "16"),
    *("--buffer-size", "5000", "--slice-len", "10", "--critic-rounds", "2"),
    *("--critic-frames", "200", "--minibatch-size", "100", "--policy-frames", "100"),
    *("--anneal-frames", "800"),
]


def test_trains(capsys):
    policy = safetac_single_file.train(safetac_single_file.arguments(TINY))
    assert all(weight.isfinite().all() for weight in policy.parameters())
    lines = capsys.readouterr().out.splitlines()
    assert [int(line.split()[0].replace(",", "")) for line in lines] == [400, 600, 800]
    limits = [float(re.search(r"of (\S+)", line)[1]) for line in lines]
    assert limits == [10.0, 7.5, 5.0]
    kls = [float(re.search(r"kl (\S+)", line)[1]) for line in lines]
    assert all(0 < kl <= 0.0203 for kl in kls)


def test_defaults_are_the_trainers():
    from torchrl_safe.trainers import SafeTAC
    from torchrl_safe.trainers.options import flat

    options = [each for each in flat(SafeTAC.Options()) if not each[0].startswith("lagrangian.")]
    trainers = {name.rpartition(".")[2]: value for name, value in options}
    ours = vars(safetac_single_file.arguments([]))
    ours |= {"size": ours.pop("buffer_size"), "initial_cost_limit": None}
    assert {name: trainers[name] for name in ours} == ours


def test_same_seed_same_policy():
    first, second = (
        safetac_single_file.train(safetac_single_file.arguments(TINY)) for _ in range(2)
    )
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)
