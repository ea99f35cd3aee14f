"""The comparison: what is drawn, how it is judged, and the whole chain on trainings of a second."""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
from pathlib import Path

import cell
import compare
import final
import numpy as np
import plan
import pytest
import small
import spaces
import torch
import tune
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_safe.envs import SafeRobotEnv
from torchrl_safe.record import evaluate
from torchrl_safe.trainers import METHODS, cli
from torchrl_safe.trainers.options import Options, flat
from torchrl_safe.trainers.saved_policies import read_policy


class TestSpaces:
    @pytest.mark.parametrize("row", spaces.ROWS)
    def test_every_trial_is_a_valid_configuration_within_its_ranges(self, row):
        space = spaces.ROWS[row].space
        assert len(space) >= 5
        trials = tune.trials(plan.PLAN, row)
        method, *words = trials[0].words
        assert dict(trials[0].options).items() <= dict(flat(cli.compose(method, words))).items()
        for trial in trials:
            values = dict(flat(Options.known[method].of(**dict(trial.options))))
            for name, each in space.items():
                value = values[name]
                if isinstance(each, spaces.Per):
                    value, each = value / values[each.option], each.of
                if isinstance(each, spaces.Choice):
                    assert value == pytest.approx(min(each.values, key=lambda x: abs(x - value)))
                else:
                    assert each.low <= value <= each.high

    def test_every_method_with_a_limit_is_there(self):
        limited = {n for n, m in METHODS.items() if "loss.cost_limit" in dict(flat(m.Options()))}
        assert limited <= spaces.ROWS.keys()
        assert "tac" not in spaces.ROWS

    def test_ranges_are_of_options(self):
        """A name that no method has would be tuned by nobody, in silence."""
        known = {name for options in Options.known.values() for name, _ in flat(options())}
        assert spaces.RANGES.keys() <= known

    def test_draws_do_not_depend_on_other_options(self, monkeypatch):
        before = spaces.ROWS["cpo"].draw(3)
        fewer = {name: each for name, each in spaces.RANGES.items() if name != "optim.max_kl"}
        monkeypatch.setattr(spaces, "RANGES", fewer)
        assert spaces.ROWS["cpo"].draw(3) == {n: x for n, x in before.items() if "max_kl" not in n}

    def test_draws_differ(self):
        draws = [spaces.ROWS["cpo"].draw(trial)["optim.max_kl"] for trial in range(200)]
        assert len(set(draws)) > 150
        # Half of the logarithms of a log-uniform draw are below the middle.
        assert 70 < sum(math.log(x) < (math.log(0.002) + math.log(0.05)) / 2 for x in draws) < 130

    def test_shares_are_of_the_run(self):
        values = spaces.ROWS["sac_lagrangian"].settled(
            {
                "optim.num_updates": 0.03,
                "loss.anneal_frames": 0.25,
                "loss.initial_cost_limit": 1.5,
                "loss.cost_limit": 3.0,
                "collector.frames_per_batch": 4_000,
            },
            300_000,
        )
        assert values["optim.num_updates"] == 120
        assert values["loss.anneal_frames"] == 75_000
        assert values["loss.initial_cost_limit"] == 4.5

    def test_page_has_the_ranges(self):
        assert spaces.page() == spaces.PAGE.read_text()

    def test_page_has_the_numbers(self):
        text = " ".join(spaces.PAGE.read_text().split())
        p = plan.PLAN
        assert f"{p.trials} for each method, of {p.trial_frames:,} frames" in text
        assert f"Trial n has seed {p.trial_seed} + n" in text
        assert "seeds 1100, 1101 and 1102" in text
        assert p.best_seeds == (1100, 1101, 1102)
        assert f"(realised mean / {p.tuning_target:g})" in text
        assert p.multiples == (0.4, 0.65, 1.0, 1.6, 2.5)
        assert f"seeds {p.search_seed} to {p.search_seed + len(p.multiples) - 1}" in text
        assert f"every method, {p.frames:,} frames, seeds 2000 to 2004" in text
        assert p.final_seeds == (2000, 2001, 2002, 2003, 2004)
        assert f"has {p.final_episodes:,} episodes" in text
        assert f"are of {p.tuning_episodes} episodes on layouts of tuning" in text
        assert p.targets == (2.0, 3.0, 5.0)

    def test_no_seed_is_used_twice(self):
        p = plan.PLAN
        used = [
            *range(p.trial_seed, p.trial_seed + p.trials),
            *p.best_seeds,
            *range(p.search_seed, p.search_seed + len(p.multiples) + 2 * p.further),
            *p.final_seeds,
        ]
        assert len(set(used)) == len(used)
        assert min(used) >= 100

    def test_kept_trials_are_of_these_ranges(self):
        """A range that is changed while trials of it are kept would compare what was not drawn."""
        for path in plan.RESULTS.glob("point/tuning/*/trial_*/*/seed_*.json"):
            kept = json.loads(path.read_text())
            row = spaces.ROWS[kept["row"]]
            drawn = row.draw(int(kept["name"].removeprefix("trial_")))
            assert kept["options"] == row.settled(drawn, kept["frames"]), path


def made_up(returns, costs, **more):
    """A result of two episodes without violations."""
    episodes = {"return": returns, "violations": [0, 0], "cost": [10.0, 10.0], "length": 1000}
    return {
        "episodes": {"sampled": {**episodes, "discounted": [costs]}, "deterministic": episodes},
        "training_violations": 7,
        **more,
    }


class TestMerit:
    def test_cost_above_the_target_divides(self):
        assert plan.merit(made_up([8.0, 10.0], [3.0, 3.0]), 3.0) == 9.0
        assert plan.merit(made_up([8.0, 10.0], [0.0, 1.0]), 3.0) == 9.0
        assert plan.merit(made_up([8.0, 10.0], [6.0, 6.0]), 3.0) == 4.5

    def test_a_score_below_zero_is_not_helped_by_cost(self):
        assert plan.merit(made_up([-1.0, -1.0], [6.0, 6.0]), 3.0) == -2.0

    def test_what_diverged_is_worst(self):
        assert plan.merit({"diverged": "it did"}, 3.0) == -math.inf

    def test_score_is_of_episodes(self):
        kept = made_up([8.0, 10.0], [1.0, 1.0])
        kept["episodes"]["sampled"]["violations"] = [1, 4]
        assert plan.column(kept, "score").tolist() == [4.0, 2.0]

    def test_an_episode_that_was_over_has_no_outcome(self):
        assert plan.column(made_up([0, 0], [1.0, None]), "outcomes").tolist() == [1.0]


class TestOutcomes:
    def test_from_the_start_is_the_discounted_cost_of_evaluate(self):
        recorder = cell.Costs()
        env = TransformedEnv(SafeRobotEnv("jackal", num_envs=16, num_threads=1), recorder)
        how = {"num_steps": 60, "exploration_type": ExplorationType.RANDOM, "seed": 0}
        played = evaluate(env, env.rand_action, cost_gamma=0.9, **how)
        costs, running = torch.stack(recorder.costs), torch.stack(recorder.running)
        rows = cell.outcomes(costs, running, 0.9)
        assert rows[0] == pytest.approx(played["discounted_cost"].tolist(), abs=0.005)
        assert running.sum(0).tolist() == played["length"].tolist()

    def test_by_hand(self):
        costs = torch.tensor([[1.0, 1], [2, 2], [4, 4], [8, 8]]).double()
        running = torch.tensor([[1, 1], [1, 1], [1, 0], [1, 0]]).bool()
        assert cell.outcomes(costs, running, 0.5) == [
            [1 + 1 + 1 + 1, 1 + 1],
            [2 + 2 + 2, 2],
            [4 + 4, None],
        ]


class TestLimit:
    @pytest.mark.parametrize("target", [1.0, 2.0, 5.0])
    def test_of_a_power_law(self, target):
        """Costs of .5 limit^1.3: the limit is known."""
        points = [(limit, 0.5 * limit**1.3) for limit in (1.0, 2.0, 4.0, 8.0)]
        assert final.limit_for(points, target) == pytest.approx((2 * target) ** (1 / 1.3), rel=5e-3)

    def test_seeds_of_one_limit_are_averaged(self):
        """Two of 1 and 4 at the limit 2 are 2 there; the fit goes through it."""
        assert final.limit_for([(2.0, 1.0), (2.0, 4.0), (4.0, 8.0)], 2.0) == 2.0

    def test_trainings_against_the_order_are_averaged(self):
        points = [(1.0, 1.0), (2.0, 4.0), (8.0, 1.0), (16.0, 8.0)]
        assert final.limit_for(points, 2.0) == 4.0  # the middle of the flat part

    def test_out_of_reach_is_the_nearest(self):
        points = [(1.0, 1.0), (4.0, 4.0)]
        assert [final.limit_for(points, target) for target in (0.5, 50.0)] == [1.0, 4.0]


class TestCompare:
    PLACE = ("point", 1_000_000, 3.0)

    def groups(self, *rows):
        seeds = [made_up([9.0 + s, 11.0 + s], [3.0, 3.0]) for s in range(5)]
        lower = [made_up([1.0 + s / 10, 1.0], [2.0, 6.0]) for s in range(5)]
        return [compare.Group("safetac", 5.0, seeds), compare.Group("cpo", 3.0, lower), *rows]

    def rows(self, groups):
        lines = compare.text({self.PLACE: groups}).splitlines()
        (head,) = (line for line in lines if line.startswith("| method"))
        names = [name.strip() for name in head.split("|")[1:-1]]
        table = [line for line in lines if line.startswith("| ") and line != head]
        return [
            dict(zip(names, (x.strip() for x in line.split("|")[1:-1]), strict=True))
            for line in table
        ]

    def test_table(self):
        ours, cpo = self.rows(self.groups())
        assert ours["method"] == "safetac"
        # Scores of 10 to 14: 12, give or take 2.776 of a standard error of .707.
        assert ours["score"] == "12 (10 to 14)"
        assert ours["IQM of scores"].startswith("12 (")
        assert ours["p, Welch (Holm)"] == ours["safetac above it"] == ""
        assert cpo["realised cost"] == "4 (4 to 4) (*)"
        assert cpo["realised CVaR"] == "6 (6 to 6)"  # the worst of two outcomes
        assert cpo["safetac above it"] == "1 (1 to 1)"
        assert cpo["p, permutation"] == "0.0079"
        assert cpo["in training"] == "7"

    def test_p_values_are_of_all_rows_together(self):
        """Of two rows alike Holm's first factor is two, and the second p is not below the first."""
        name = "p, Welch (Holm)"
        (_, alone), groups = self.rows(self.groups()), self.groups()
        _, *others = self.rows([*groups, compare.Group("trc", 3.0, groups[1].results)])
        for row in others:
            assert float(row[name]) == pytest.approx(2 * float(alone[name]), rel=0.05)
            assert row["p, permutation"] == "0.0079"

    def test_what_diverged_counts_as_nothing(self):
        seeds = [*self.groups()[1].results[:4], {"diverged": "it did"}]
        *_, row = self.rows([self.groups()[0], compare.Group("cpo", 3.0, seeds)])
        assert row["seeds"] == "5, 1 diverged"
        assert float(row["score"].split()[0]) == pytest.approx(
            (1 + 1.05 + 1.1 + 1.15) / 5, abs=0.01
        )
        (row,) = self.rows([compare.Group("cpo", 3.0, seeds[-1:])])
        assert (row["score"], row["realised cost"]) == ("0", "")

    def test_few_seeds_have_no_interquartile_mean(self):
        groups = [group._replace(results=group.results[:3]) for group in self.groups()]
        assert [row["IQM of scores"] for row in self.rows(groups)] == ["", ""]

    def test_picture(self, tmp_path):
        lost = compare.Group("trc", 3.0, [{"diverged": "it did"}])
        compare.draw({self.PLACE: self.groups(lost)}, tmp_path / "picture.png")
        assert (tmp_path / "picture.png").stat().st_size > 10_000

    def test_page_is_that_of_the_results(self):
        assert compare.page(compare.PAGE, compare.read(compare.RESULTS)) == compare.PAGE.read_text()


class TestChain:
    def test_from_trials_to_the_page(self, tmp_path, capsys):
        where = ["--results", str(tmp_path / "results"), "--runs", str(tmp_path / "runs")]
        words = ["--smoke", "--methods", "cpo", *where]
        assert tune.main([*words, "--dry-run"]) == 0
        out = capsys.readouterr().out
        assert "0 of 2 cells have a result" in out
        assert "then 1 of the best trials again, about" in out
        assert not (tmp_path / "runs").exists()

        assert final.main(words) == 0
        assert "not tuned yet: cpo" in capsys.readouterr().out
        assert tune.main(words) == 0
        frozen = json.loads((tmp_path / "results" / "frozen.json").read_text())
        trials = [json.loads(p.read_text()) for p in sorted(tmp_path.glob("results/*/*/*/*/400/*"))]
        assert [kept["seed"] for kept in trials] == [1000, 1001]
        merits = [plan.merit(kept, 3.0) for kept in trials]
        assert frozen["cpo"]["trial"] == f"trial_{np.argmax(merits):02d}"
        assert frozen["cpo"]["drawn"] == spaces.ROWS["cpo"].draw(int(np.argmax(merits)))
        assert len(trials[0]["episodes"]["sampled"]["return"]) == plan.SMOKE.tuning_episodes

        assert final.main(words) == 0
        kept = [json.loads(p.read_text()) for p in sorted(tmp_path.glob("results/*/final/*/*/*/*"))]
        assert [each["seed"] for each in kept] == [2000, 2001]
        limits = json.loads((tmp_path / "results" / "frozen.json").read_text())["cpo"]
        assert all(each["options"][final.LIMIT] == limits["limits_point"]["3"] for each in kept)
        assert len(kept[0]["episodes"]["sampled"]["discounted"][2]) == plan.SMOKE.final_episodes
        assert kept[0]["launches"][0]["threads"] == 1
        assert kept[0]["curve"]["frames"][-1] == kept[0]["frames"] == 600
        # Layouts of a stage are the same for all seeds, and other than those of another stage.
        assert kept[0]["episodes"] != kept[1]["episodes"]

        page = tmp_path / "page.md"
        page.write_text(f"before\n{compare.BEGIN}{compare.END}after\n")
        drawn = ["--results", where[1], "--page", str(page), "--picture", str(tmp_path / "p.png")]
        assert compare.main([*drawn, "--check"]) == 1
        assert compare.main(drawn) == 0
        assert compare.main([*drawn, "--check"]) == 0
        assert "## Point, 600 frames, realised cost 3" in page.read_text()
        assert page.read_text().endswith("after\n")

        before = {path: path.read_bytes() for path in (tmp_path / "results").rglob("*.json")}
        capsys.readouterr()
        assert tune.main(words) == final.main(words) == 0
        assert "kept" not in capsys.readouterr().out
        assert before == {p: p.read_bytes() for p in (tmp_path / "results").rglob("*.json")}

    def test_tiny_trainings_are_no_results(self, capsys):
        with pytest.raises(SystemExit):
            tune.main(["--smoke"])
        assert "--smoke needs --results elsewhere" in capsys.readouterr().err

    def test_a_frozen_entry_stays(self, tmp_path):
        where = {"results": tmp_path, "runs": tmp_path, "threads": 1, "smoke": True}
        there = plan.Comparison(argparse.Namespace(**where))
        there.freeze("cpo", trial="trial_01")
        there.freeze("cpo", trial="trial_01", limits_point={"3": 2.0})
        with pytest.raises(
            ValueError, match="trial of cpo is frozen as trial_01, and would be tri"
        ):
            there.freeze("cpo", trial="trial_02")
        assert there.frozen == {"cpo": {"trial": "trial_01", "limits_point": {"3": 2.0}}}

    def test_what_diverges_is_kept_as_such(self, tmp_path, monkeypatch):
        def diverge(self):
            self.options.run_dir and Path(self.options.run_dir).mkdir(parents=True)
            raise FloatingPointError("100 gradient steps were not finite")

        monkeypatch.setattr(METHODS["cpo"], "train", diverge)
        where = ["--results", str(tmp_path / "results"), "--runs", str(tmp_path / "runs")]
        assert tune.main(["--smoke", "--methods", "cpo", *where]) == 0
        kept = [json.loads(path.read_text()) for path in tmp_path.glob("results/**/seed_*.json")]
        assert {each["diverged"] for each in kept} == {"100 gradient steps were not finite"}
        assert json.loads((tmp_path / "results/frozen.json").read_text())["cpo"]["merits"] == {
            "trial_01": None
        }

    @pytest.mark.slow
    def test_a_cell_is_a_process(self, tmp_path):
        words = [*small.COMMON, *small.OF_METHOD["cpo"], f"run_dir={tmp_path / 'run'}"]
        line = [sys.executable, cell.__file__, "tuning", "3", "cpo", *words]
        subprocess.run(line, check=True, capture_output=True)
        played = json.loads((tmp_path / "run" / cell.PLAYED).read_text())
        assert [len(each["return"]) for each in played["episodes"].values()] == [3, 3]
        # Without its replay, which would fill the disk, and with its policy.
        assert sum(path.stat().st_size for path in (tmp_path / "run").rglob("*")) < 1_000_000
        assert read_policy(tmp_path / "run" / cell.POLICY).options.method == "cpo"
