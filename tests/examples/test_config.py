from __future__ import annotations

from importlib import util
from pathlib import Path

import hydra
import pytest
from omegaconf import OmegaConf, open_dict

from torchrl_safe.trainers import config
from torchrl_safe.trainers.policy_steps import MATCHED_BOUND, MOMENT_MATCHED, choose_distance

EXAMPLES = Path(config.__file__).parent
CONFIGS = sorted(path.stem for path in EXAMPLES.glob("*.yaml"))


def compose(name, *overrides):
    with hydra.initialize_config_dir(str(EXAMPLES), version_base="1.3"):
        return hydra.compose(name, list(overrides))


def options(node, prefix=""):
    for name, value in node.items():
        if isinstance(value, dict):
            yield from options(value, f"{prefix}{name}.")
        else:
            yield prefix + name


@pytest.mark.parametrize("name", CONFIGS)
class TestEveryConfiguration:
    def test_is_valid(self, name):
        config.check_config(compose(name))

    def test_every_option_has_a_rule(self, name):
        cfg = OmegaConf.to_container(compose(name), resolve=True)
        missing = set(options(cfg)) - set(config.RULES)
        assert not missing, f"examples/config.py has no rule for {sorted(missing)}"

    def test_every_option_says_what_it_is(self, name):
        """A comment on its line, or in the line above."""
        lines = (EXAMPLES / f"{name}.yaml").read_text().splitlines()
        silent = []
        for number, line in enumerate(lines):
            key, colon, value = line.partition(":")
            if line.startswith(("hydra:", "defaults:")):
                break
            is_option = colon and value.split("#")[0].strip() and not key.strip().startswith("#")
            if is_option and "#" not in line and not lines[number - 1].strip().startswith("#"):
                silent.append(key.strip())
        assert not silent, f"{name}.yaml does not say what these are: {silent}"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("seed", -1, "seed must be an integer of at least 0 and at most .*, got -1"),
        ("seed", 2**70, "seed must be an integer of .* at most 18446744073709551615, got 118059"),
        ("seed", True, "seed must be an integer of .*, got True"),
        ("device", "cuda:99", r"device must be one of 'cpu'.*got 'cuda:99'"),
        (
            "num_threads",
            1.5,
            "num_threads must be an integer of .* at most 2147483647, got 1.5",
        ),
        ("env.robot", "unicycle", "env.robot must be one of 'point'.*got 'unicycle'"),
        ("loss.risk_level", 2, r"loss.risk_level must be a number in \(0, 1\], got 2"),
        ("num_threads", 2**31, "num_threads must be an integer .*, got 2147483648"),
        ("loss.cost_limit", 1e300, r"loss.cost_limit must be a number in .* got 1e\+300"),
        ("loss.alpha", 1e-60, r"loss.alpha must be .*, got 1e-60, which is 0.0 in single"),
        ("loss.gamma", 1 - 1e-9, "loss.gamma must be .* which is 1.0 in single precision"),
        ("policy.log_std_bounds", [-4, 1e300], "policy.log_std_bounds must be two finite"),
        ("script", "other", "script must be one of 'base', .*got 'other'"),
        ("loss.gamma", 1.0, r"loss.gamma must be a number in \[0, 1\), got 1.0"),
        ("loss.gamma", "high", "loss.gamma must be a number.*got 'high'"),
        ("loss.cost_limit", float("nan"), r"loss.cost_limit must be a number in \[0, inf\)"),
        ("optim.max_kl", 0, r"optim.max_kl must be a number in \(0, inf\), got 0"),
        ("policy.num_cells", [64, 0], "policy.num_cells must be a list of integers"),
        ("policy.log_std_bounds", [2, -4], "policy.log_std_bounds must be two finite numbers"),
        ("logger.backend", "wandbb", "logger.backend must be one of 'csv', 'tensorboard', 'wandb'"),
        ("resume", "yes", "resume must be one of True, False, got 'yes'"),
        ("run_dir", "", "run_dir must be a path"),
        ("loss.cost_limt", 1.0, "loss.cost_limt is not an option; there are loss.cost_limit"),
        ("collector.frames_per_batch", 8001, "must be a multiple of env.num_envs=400, got 8001"),
        ("optim.critic_frames", 15_001, "must be a multiple of replay_buffer.slice_len=20"),
        ("env.episode_length", 10, "slice_len must be at most env.episode_length=10, got 20"),
        ("collector.frames_per_batch", 400, "frames_per_batch must be at least 800, got 400"),
        ("collector.init_frames", 0, "frames_per_batch must be at least 8400, got 8000.*slice_len"),
        ("replay_buffer.size", 800, "frames_per_batch must be at most replay_buffer.size=800"),
    ],
)
def test_message(name, value, message):
    cfg = compose("safetac_point")
    with open_dict(cfg):
        OmegaConf.update(cfg, name, value)
        if name == "collector.init_frames":
            cfg.replay_buffer.slice_len = 21
            cfg.optim.critic_frames = 21 * 700
    with pytest.raises(ValueError, match=message):
        config.check_config(cfg)


def test_memmap_is_for_the_cpu(monkeypatch):
    monkeypatch.setitem(config.RULES, "device", config.NAME)  # as where there is a GPU
    config.check_config(compose("safetac_point", "device=cuda"))
    with pytest.raises(ValueError, match=r"memmap keeps the replay on the CPU.*got 'cuda'"):
        config.check_config(compose("safetac_point", "device=cuda", "replay_buffer.storage=memmap"))


@pytest.mark.parametrize(
    ("option", "backend"),
    [("logger", "wandb"), ("logger", "tensorboard"), ("collector", "ray")],
)
def test_missing_extra(monkeypatch, option, backend):
    monkeypatch.setattr(
        config, "find_spec", lambda name: None if name == backend else util.find_spec(name)
    )
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'torchrl-safe\[{backend}\]'"):
        config.check_config(compose("safetac_point", f"{option}.backend={backend}"))


@pytest.mark.parametrize(
    ("overrides", "distance"),
    [
        ([], MOMENT_MATCHED),
        (["env.robot=jackal"], MATCHED_BOUND),
        (["env.robot=jackal", "optim.kl=moment_matched"], MOMENT_MATCHED),
        (["optim.kl=matched_bound"], MATCHED_BOUND),
    ],
)
def test_distance_of_a_robot(overrides, distance):
    assert choose_distance(compose("safetac_point", *overrides)) is distance


def test_workers_must_share_the_environments():
    options = ["collector.backend=multi_sync", "collector.num_workers=3"]
    with pytest.raises(ValueError, match=r"env.num_envs must be a multiple of .*num_workers=3"):
        config.check_config(compose("safetac_point", *options))
    config.check_config(compose("safetac_point", options[1]))  # nobody asks for them
