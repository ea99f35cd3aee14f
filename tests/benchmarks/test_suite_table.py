"""The table of records: which cells are run, what is kept of them, and what the page says."""

from __future__ import annotations

import json
import sys
import textwrap
from pathlib import Path

import drive_original
import pytest
import run
import small
import table
import torch
from tensordict import TensorDict

from torchrl_safe.trainers import METHODS, cli
from torchrl_safe.trainers.tasks import follows

TASK = "SafetyPointCircle1"
TINY = [word for word in (*small.COMMON, *small.OF_METHOD["cpo"]) if "total_frames" not in word]
TINY = [word for word in TINY if not word.startswith(("video", "num_threads", "eval.interval"))]


@pytest.fixture
def tiny(monkeypatch):
    """A method of a second."""
    monkeypatch.setitem(run.KNOWN, "tiny", ("cpo", *TINY))
    return ["--tasks", TASK, "--methods", "tiny", "--frames", "400", "--seeds", "0"]


class TestCells:
    def test_plan_is_of_valid_configurations(self):
        for cell in {(cell.task, cell.method): cell for cell in run.PLAN}.values():
            method, *overrides = cell.words
            options = cli.compose(method, overrides)
            assert options.loss.cost_limit == 25.0
            assert options.eval.num_steps == follows(cell.task)["eval.num_steps"]

    def test_no_two_share_a_file(self):
        assert len({cell.path for cell in run.PLAN}) == len(run.PLAN)

    def test_missing_ones_are_run_and_kept(self, tiny, tmp_path, capsys):
        """Once: then there is nothing to do; without its result, the run is kept again."""
        where = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
        assert run.main([*tiny, *where]) == 0
        (path,) = (tmp_path / "results").rglob("*.json")
        assert path.relative_to(tmp_path / "results") == Path(TASK, "tiny", "400", "seed_0.json")
        assert path.stat().st_size < 10_000
        kept = json.loads(path.read_text())
        finished = json.loads((tmp_path / f"runs/{TASK}/tiny/400/seed_0/results.json").read_text())
        for kind, prefix in run.KINDS.items():
            returns = [episode["return"] for episode in finished["episodes"][prefix]]
            assert kept["episodes"][kind]["return"] == pytest.approx(returns, abs=1e-3)
            assert kept["curve"][kind]["cost"][-1] >= 0.0
        assert kept["command"].startswith(f"torchrl-safe train cpo env.task={TASK} ")
        assert kept["curve"]["frames"] == [200, 400]
        seconds = kept["curve"]["seconds"]
        assert 0 < seconds[0] <= seconds[1] <= kept["seconds"]
        total = kept["seconds"] + kept["evaluation_seconds"]
        assert total == pytest.approx(finished["seconds"], abs=0.2)
        assert kept["launches"][0]["threads"] == 1
        assert len(kept["launches"][0]["commit"].removesuffix("-dirty")) == 40

        capsys.readouterr()
        assert run.main([*tiny, *where, "--dry-run"]) == 0
        assert capsys.readouterr().out == "1 of 1 cells have a result\nabout 0 core-hours\n"
        before = path.read_text()
        path.unlink()
        assert run.main([*tiny, *where]) == 0
        assert path.read_text() == before

    def test_run_of_another_command_is_no_record(self, tiny, tmp_path, monkeypatch):
        where = ["--runs", str(tmp_path / "runs"), "--results", str(tmp_path / "results")]
        assert run.main([*tiny, *where]) == 0
        run_dir = tmp_path / f"runs/{TASK}/tiny/400/seed_0"
        monkeypatch.setitem(run.KNOWN, "tiny", ("cpo", *TINY, "loss.cost_limit=10"))
        with pytest.raises(ValueError, match=r"other options than .*/seed_0: \['loss'\]"):
            run.result(run.Cell(TASK, "tiny", 400, 0), run_dir)


def made_up(seed=0, task="SafetyPointGoal1", **more):
    """A result."""
    costs = [0.0] * 90 + [30.0] * 10
    episodes = {"return": [20.0 + seed] * 100, "cost": costs, "length": [1000] * 100}
    points = {"return": [1.0, 21.0, 25.0], "cost": [50.0, 26.0, 3.0]}
    launch = {"cpu": "a chip", "cores": 2, "jobs": 1, "threads": 2, "commit": "c" * 40 + "-dirty"}
    return {
        "task": task,
        "method": "safetac",
        "frames": 1_000_000,
        "seed": seed,
        "command": "torchrl-safe train safetac",
        "launches": [launch],
        "seconds": 120.0,
        "episodes": {"deterministic": episodes, "sampled": episodes},
        "curve": {
            "frames": [10, 20, 30],
            "seconds": [60.0, 120.0, 180.0],
            "deterministic": points,
            "sampled": points,
        },
        **more,
    }


class TestTable:
    def test_mark_needs_reward_and_cost_at_once(self):
        assert table.time_to(made_up(), 20.0) == (180.0, 30)
        assert table.time_to(made_up(), 26.0) is None

    def test_section(self):
        lines = table.text([made_up(0), made_up(2)]).splitlines()
        (row,) = (line for line in lines if line.startswith("| safetac | "))
        # Means 20 and 22: 21, give or take 12.706 of a standard error of 1.
        assert row.split(" | ")[2:5] == ["2", "**21** (8.294 to 33.71)", "**3** (3 to 3)"]
        (row,) = (line for line in lines if line.startswith("| safetac, 1,000,000 | sampled"))
        assert "| 0 | 30 | 30 | 30 | 10 % of 200 (6.6 to 15) |" in row
        (row,) = (line for line in lines if "3 min, 30 frames" in line)
        assert row.endswith(" never |")
        assert any("`cccccccccc*`" in line and "| 2 each |" in line for line in lines)
        assert any(line.startswith("| SAC-Lag, OmniSafe |") and "21.45" in line for line in lines)

    def test_page_is_that_of_the_results(self):
        assert table.page(table.read_results()) == table.PAGE.read_text()

    def test_every_published_task_is_one_of_ours(self):
        assert table.PUBLISHED.keys() <= {*run.NAMED}


class TestOriginal:
    STAND_IN = """
        import gymnasium
        import torchrl_safe.envs

        class Env:
            def __init__(self, id):
                self.env = gymnasium.make("torchrl_safe/" + id)
                self.observation_space = self.env.observation_space
                self.action_space = self.env.action_space

            def reset(self, seed=None):
                return self.env.reset(seed=seed)

            def step(self, action):
                *step, terminated, truncated, info = self.env.step(action)
                return *step, info["cost"], terminated, truncated, info

        def make(id):
            return Env(id)
    """

    @pytest.mark.slow
    def test_drives_in_both(self, tmp_path, monkeypatch, capsys):
        """With our own environment in the original's place, the other end of the bridge."""
        options = small.options("cpo", f"env.task={TASK}", run_dir=tmp_path / "run")
        METHODS["cpo"](options=options).train()
        (tmp_path / "safety_gymnasium.py").write_text(textwrap.dedent(self.STAND_IN))
        root = str(Path(run.__file__).parents[2])
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{root}")
        words = ["--python", sys.executable, "--episodes", "2", "--episodes-here", "2"]
        drive_original.main([str(tmp_path / "run"), *words])
        out = capsys.readouterr().out
        assert f"{TASK}, 2 episodes in the original, 2 here" in out
        assert out.count(" to ") == 4

    def test_comparison(self):
        """Means, and a test that finds a shift and does not find none."""
        torch.manual_seed(0)

        def episodes(mean):
            values = {"episode_return": mean + torch.randn(50), "cost": torch.randn(50)}
            return TensorDict(values, [50])

        rows = drive_original.compared(episodes(0.0), episodes(5.0))
        assert float(rows["return, Mann-Whitney test"].removeprefix("p = ")) < 1e-6
        assert float(rows["cost, Mann-Whitney test"].removeprefix("p = ")) > 0.01
        assert rows["return here"].startswith(("4.", "5."))

    def test_other_policies_are_refused(self):
        with pytest.raises(ValueError, match="safetac-point must be of a task of Safety-Gymnasium"):
            drive_original.main(["safetac-point", "--python", sys.executable])
