"""The paper's tables: which cells are run, and what their numbers are made of."""

from __future__ import annotations

import json

import make_table
import numpy as np
import prediction_error
import pytest
import run_table
import table_2
import tiny
from torchrl.record import CSVLogger

from torchrl_safe.trainers import cli


class TestCells:
    @pytest.mark.parametrize("table", run_table.TABLES)
    def test_every_cell_is_a_valid_configuration(self, table):
        for cell in run_table.cells(table, ["point"], [0]):
            method = "safetac" if cell.script == "safetac_point" else cell.script
            assert cli.compose(method, list(cell.overrides)).method == method

    @pytest.mark.parametrize("table", run_table.TABLES)
    def test_no_two_share_a_folder(self, table):
        folders = [c.folder for c in run_table.cells(table, ["point", "car"], [0, 1])]
        assert len(set(folders)) == len(folders)

    def test_finished_interrupted_and_new(self, tmp_path):
        done, stopped, new = run_table.cells("table_1", ["point"], [0])[:3]
        for cell in (done, stopped):
            (tmp_path / cell.folder).mkdir(parents=True)
            (tmp_path / cell.folder / "config.yaml").touch()
        (tmp_path / done.folder / "results.json").touch()
        jobs = [run_table.job(cell, tmp_path, []) for cell in (done, stopped, new)]
        assert [job.finished for job in jobs] == [True, False, False]
        assert jobs[1].line()[-1] == "resume=true"
        assert jobs[2].line()[-1] == f"run_dir={tmp_path / new.folder}"

    def test_runs_skips_and_counts_failures(self, tmp_path, capfd):
        """Cells are real processes: one override is impossible, so that each fails at once."""
        argv = ["table_3", "--root", str(tmp_path), "--methods", "safetac_k3", "safetac_k5"]
        (tmp_path / "point" / "safetac_k3" / "seed_0").mkdir(parents=True)
        (tmp_path / "point" / "safetac_k3" / "seed_0" / "results.json").touch()
        assert run_table.main([*argv, "--set", "loss.risk_level=2"]) == 1
        assert "risk_level" in (tmp_path / "point" / "safetac_k5" / "seed_0.log").read_text()
        assert "finished  point/safetac_k3" in capfd.readouterr().out


def test_table():
    run = dict.fromkeys(make_table.COLUMNS.values(), 2.0)
    results = {"cpo": [{**run, "frames": 1000}, {**run, "frames": 900}]}
    text = make_table.table(results, make_table.PAPER["point"])
    assert text.splitlines()[-1].startswith("| cpo | 2 | 900 | 2 (2 to 2) |")
    assert text.endswith(" 8 / 0.021 |\n")
    assert make_table.table(results, {}).endswith(" - |\n")


def test_table_2(tmp_path):
    """Train on randomised Jackals by the cell's own overrides, then drive the held-out one."""
    (cell,) = run_table.cells("table_2", ["jackal"], [0], ["safetac_q12"])
    run_dir = tmp_path / cell.folder
    tiny.launch(run_dir, *cell.overrides, "collector.total_frames=200", "eval.num_steps=100")
    table_2.main([str(tmp_path / "jackal"), str(tmp_path / "out")])
    *_, row = (tmp_path / "out" / "table_2.md").read_text().splitlines()
    name, det, sampled, paper = (text.strip() for text in row.split("|")[1:-1])
    assert (name, paper) == ("safetac_q12_randomized, seed_0", "21.4 / 20.7 / 0")
    for cells in (det, sampled):
        reward, violations, failures = map(float, cells.split("/"))
        assert abs(reward) < 10
        assert violations >= failures
        assert 0 <= failures <= 10
    assert (run_dir / "evaluation_jackal_real" / "results.json").exists()


def test_claims():
    """One that holds, one that fails, one that seeds leave open, one without a second seed."""

    def runs(*scores):
        return [{make_table.SCORE: score, make_table.CV: 0.01} for score in scores]

    results = {
        "safetac_q12": runs(8.0, 9.0),
        "cpo": runs(3.0, 4.0),
        "trc": runs(1.0, 2.0),
        "safetac_k5": runs(4.0, 14.0),
        "wcsac": runs(0.0),
        "unknown": runs(1.0, 1.0),
    }

    def rows(robot):
        lines = make_table.claims(results, make_table.PAPER[robot]).splitlines()[2:]
        cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
        return {claim: rest for claim, *rest in cells}

    point = rows("point")
    # 5 apart, of variances of .5 and a standard error of .5 ** .5 at 2 degrees of freedom.
    assert point["SafeTAC scores more than CPO"][1:] == [
        "+5 (+4 to +6)",
        "0.019",
        "0.33",
        "holds",
    ]
    assert point["TRC scores more than SafeTAC"][-1] == "fails"
    assert point["K = 5 scores more than K = 1"][-1] == "open"
    assert point["SafeTAC scores more than WCSAC"] == ["+10.6", "+8.5 (one seed)", "", "", "open"]
    assert point["CPO violates more than SafeTAC"][-1] == "open"  # a difference of nothing
    assert "q = 1.2 scores more than q = 1" not in point


def test_claims_are_those_of_the_robot():
    """The paper has TRC ahead on Point and Jackal, behind on Car and Doggo."""
    runs = [{make_table.SCORE: 1.0 + seed, make_table.CV: 0.01} for seed in range(3)]
    results = {"safetac_q12": runs, "trc": runs}
    for robot, claim in (
        ("jackal", "| TRC scores more than SafeTAC | +1.02 |"),
        ("car", "| SafeTAC scores more than TRC | +2.3 |"),
        ("doggo", "| SafeTAC scores more than TRC | +2.6 |"),
    ):
        assert claim in make_table.claims(results, make_table.PAPER[robot])


def test_smoothing_keeps_a_line():
    """Means of what is there: a constant stays one at the ends, and the inside of a line does."""
    np.testing.assert_allclose(make_table.smoothed(np.full(20, 3.0)), 3.0)
    np.testing.assert_allclose(make_table.smoothed(np.arange(20.0))[4:-4], np.arange(4, 16))
    np.testing.assert_allclose(make_table.smoothed(np.ones(2)), 1.0)


def test_from_runs_to_pictures(tmp_path):
    """A run that is not finished, and the logs of the cells, are left alone."""
    for name, finished in (("cpo_limit2.5", True), ("cpo", True), ("trc", False)):
        run_dir = tmp_path / "point" / name / "seed_0"
        logger = CSVLogger("log", log_dir=str(run_dir))
        for frames in (400, 800):
            for metric in ("reward_per_1000", "cv_rate", "total_cvs"):
                logger.log_scalar(f"train/{metric}", 0.1, step=frames)
        for file in logger.experiment.files.values():
            file.close()
        run_dir.with_name("seed_0.log").touch()
        (run_dir / "config.yaml").touch()
        if finished:
            results = {**dict.fromkeys(make_table.COLUMNS.values(), 1.0), "frames": 800}
            (run_dir / "results.json").write_text(json.dumps(results))
    make_table.main([str(tmp_path / "point"), str(tmp_path / "out")])
    text = (tmp_path / "out" / "table.md").read_text()
    assert "cpo_limit2.5" in text
    assert "trc" not in text
    for name in ("table_1.png", "frontier.png"):
        assert (tmp_path / "out" / name).stat().st_size > 5_000
    assert (tmp_path / "out" / "cpo" / "seed_0" / "curves.csv").exists()


class TestPredictionError:
    HEAD = "frames,train/entropy,update/constraint_change,update/constraint_predicted"

    def write(self, folder, *rows):
        (folder / "curves.csv").write_text("\n".join([self.HEAD, *rows]) + "\n")

    def test_median_of_what_was_logged(self, tmp_path):
        """Errors of 10 %, 50 % and, of the floor .05, 20 %; the first update has no step."""
        self.write(tmp_path, "1,-3,,", "2,-1,1,1.1", "3,-2,-1,-0.5", "4,-1,0.01,0.02")
        error, entropy = prediction_error.prediction_error(tmp_path / "curves.csv")
        assert error == pytest.approx(0.2)
        assert entropy == -3

    def test_run_of_another_method(self, tmp_path):
        self.write(tmp_path, "1,-3,,")
        with pytest.raises(ValueError, match="no trust region's"):
            prediction_error.prediction_error(tmp_path / "curves.csv")
