"""The page about a run says what is in its folder, loads nothing, and runs nothing."""

from __future__ import annotations

import base64
import json
import re
import shutil
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
import tiny

from torchrl_safe.trainers import report, run
from torchrl_safe.trainers.commands import report as command
from torchrl_safe.trainers.report import Number, over_seeds, write_report
from torchrl_safe.trainers.saved import read_config, write_config
from torchrl_safe.trainers.surroundings import surroundings

VOID = {"meta", "br", "img"}


class Page(HTMLParser):
    """Tags are closed in the order in which they were opened; text by section, what is linked."""

    def __init__(self, html):
        super().__init__()
        self.open, self.links, self.text, self.tags = [], [], "", []
        self.feed(html)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name in ("src", "href", "xlink:href"):
                self.links.append(value)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data + " "


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Two seeds of one setting, and one of another."""
    path = tmp_path_factory.mktemp("runs")
    for seed, limit in ((0, 5.0), (1, 5.0), (0, 7.5)):
        tiny.launch(
            path / f"limit_{limit}/seed_{seed}",
            f"seed={seed}",
            f"loss.cost_limit={limit}",
            "collector.total_frames=200",
            "eval.interval=100",
            "eval.num_steps=20",
            "eval.final_episodes=4",
        )
    return path


@pytest.fixture
def one(trained, tmp_path):
    return shutil.copytree(trained / "limit_7.5/seed_0", tmp_path / "run")


def page(*folders, out):
    return Page(write_report(folders, out).read_text())


class TestARun:
    def test_is_written_at_the_end_of_a_training(self, one, tmp_path):
        written = Page((one / "report.html").read_text())
        assert "SafeTAC, point, seed 0" in written.text
        assert "Finished, 200 of 200 frames." in written.text

    def test_loads_nothing(self, one, tmp_path):
        html = write_report([one], tmp_path / "page.html").read_text()
        shown = Page(html)
        assert "script" not in shown.tags
        assert all(link.startswith(("data:", "#")) for link in shown.links)
        assert shown.tags.count("svg") == 4
        assert "http://" not in html.replace("http://www.w3.org/", "")
        assert "default-src 'none'" in html
        assert "var(--line-0)" in html

    def test_numbers_are_those_of_the_episodes(self, one, tmp_path):
        results = json.loads((one / "results.json").read_text())
        episodes = results["episodes"]["eval/det/"]
        for i, episode in enumerate(episodes):  # something to tell apart
            episode |= {"violations": 10 * i, "goals": i % 2, "cost": 2.0 + i}
        for share in ("p95", "p99"):  # what is not in the results is computed
            del results[f"eval/det/violations_{share}"]
        (one / "results.json").write_text(json.dumps(results))
        values = report.judged(results, "eval/det/")
        assert values["violations"].value == 15.0
        assert values["violations_p95"].value == pytest.approx(28.5)  # between 20 and 30
        assert values["no_goal_rate"].value == 0.5
        assert values["violating"].value == 0.75
        assert values["violating"].low == pytest.approx(0.3006, abs=1e-4)  # Wilson, by hand
        text = page(one, out=tmp_path / "page.html").text
        # 7.5, discounted by 0.99, is 0.075 in each of 20 steps.
        assert "The mean cost of an episode is 3.5, above its limit of 1.5." in text
        assert "28.5" in text
        assert re.search(r"Limit on it\s+1\.5\s+1\.5", text)

    def test_numbers_of_the_results_come_first(self):
        results = {
            "det/violations_p95": 7.0,
            "det/longest_violation": 12.0,
            "det/score": 1.5,
            "episodes": {"det/": [{"violations": 1, "end": "truncated"}]},
        }
        values = report.judged(results, "det/")
        assert values["violations_p95"] == Number(7.0)
        assert values["longest_violation"] == Number(12.0)
        assert values["score"] == Number(1.5)

    def test_options_that_differ_are_marked(self, one, tmp_path):
        html = write_report([one], tmp_path / "page.html").read_text()
        first, _, everything = html.partition("<details>")
        assert re.search(r"loss\.cost_limit</code></th><td><mark>7\.5</mark></td><td>5\.0<", first)
        assert "loss.gamma" not in first
        assert "loss.gamma" in everything

    def test_what_it_ran_on(self, one, tmp_path):
        text = page(one, out=tmp_path / "page.html").text
        found = surroundings()
        assert f"Python {found['python']}" in text
        assert f"torch {found['packages']['torch']}" in text
        assert found["commit"] is None or found["commit"][:12] in text

    def test_film_and_pictures_are_inside(self, one, tmp_path):
        (one / "evaluation").mkdir()
        contents = {
            "video.mp4": b"a film",
            "evaluation/trajectories.png": b"paths",
            "evaluation/calibration.png": b"bins",
        }
        for name, content in contents.items():
            (one / name).write_bytes(content)
        links = page(one, out=tmp_path / "page.html").links
        inside = {base64.b64decode(x.partition(",")[2]) for x in links if x.startswith("data:")}
        assert inside == set(contents.values())

    def test_a_large_film_stays_outside(self, one, tmp_path, monkeypatch):
        (one / "video.mp4").write_bytes(b"a film")
        monkeypatch.setattr(report, "MEDIA_LIMIT", 5)
        assert "video" not in page(one, out=tmp_path / "page.html").tags

    @pytest.mark.parametrize("missing", ["results.json", "log", "history.jsonl"])
    def test_while_something_is_missing(self, one, tmp_path, missing):
        path = one / missing
        shutil.rmtree(path) if path.is_dir() else path.unlink()
        text = page(one, out=tmp_path / "page.html").text
        if missing == "results.json":
            assert "Not finished: 200 of 200 frames." in text

    def test_a_training_ends_well_without_it(self, tmp_path, monkeypatch, capsys):
        def fail(*_):
            raise RuntimeError("no ink")

        monkeypatch.setattr(run, "write_report", fail)
        tiny.launch(tmp_path / "run", "collector.total_frames=100")
        assert "no report: RuntimeError: no ink" in capsys.readouterr().out
        assert (tmp_path / "run/results.json").exists()


class TestSeveral:
    def test_seeds_are_one_column(self, trained, tmp_path):
        shown = page(trained, out=tmp_path / "page.html")
        assert "3 runs, point" in shown.text
        assert "SafeTAC, cost_limit=5.0" in shown.text
        assert "SafeTAC, cost_limit=7.5" in shown.text
        assert "0, 1" in shown.text

    def test_each_run_once(self, trained, tmp_path):
        found = report.runs_in([trained / "limit_5.0", trained, trained / "limit_5.0/seed_1"])
        assert len(found) == 3

    def test_mean_and_interval_over_seeds(self):
        """Three seeds: the mean of the means; the percentiles of all 27 resamples."""
        seeds = [{"score": Number(x, x - 9, x + 9)} for x in (1.0, 2.0, 6.0)]
        value, low, high = over_seeds(seeds)["score"]
        means = [np.mean([a, b, c]) for a in (1, 2, 6) for b in (1, 2, 6) for c in (1, 2, 6)]
        assert value == pytest.approx(3.0)
        assert low == pytest.approx(np.quantile(means, 0.025), abs=0.35)
        assert high == pytest.approx(np.quantile(means, 0.975), abs=1.5)
        assert over_seeds(seeds[:1]) == seeds[0]

    def test_where_the_page_goes(self, trained, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        a, b = trained / "limit_5.0", trained / "limit_7.5"
        assert command.main([a]) == a / "report.html"
        assert command.main([a, b]).resolve() == tmp_path / "report.html"
        assert command.main([a], out=tmp_path / "new/page.html").exists()

    def test_no_run(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"holds no run: there is no config\.yaml"):
            command.main([tmp_path])
        assert not list(tmp_path.iterdir())

    def test_too_many(self, trained, monkeypatch):
        monkeypatch.setattr(report, "MOST_RUNS", 2)
        with pytest.raises(ValueError, match="at most 2 runs, and here are 3"):
            report.runs_in([trained])


class TestOfAStranger:
    def test_nothing_is_obeyed(self, one, tmp_path):
        """Names and values are text, whatever they look like."""
        bad = "<script>alert(1)</script>'\"><img src=x onerror=alert(1)>"
        settings = read_config(one / "config.yaml") | {"method": bad, bad: bad}
        settings["env"] |= {"robot": bad}
        write_config(one / "config.yaml", SimpleNamespace(settings=lambda: settings))
        (one / "history.jsonl").write_text(
            json.dumps({"time": bad, "surroundings": {"commit": bad, "packages": {bad: bad}}})
        )
        results = json.loads((one / "results.json").read_text())
        results["episodes"]["eval/det/"] = [{bad: bad, "violations": bad, "score": None}]
        (one / "results.json").write_text(json.dumps(results | {"frames": bad, "seconds": bad}))
        (one / f"log/scalars/update/cost_level/{'<b>x'}").parent.mkdir()
        (one / "log/scalars/update/cost_level/<b>x.csv").write_text("100,1.0\n")
        shown = page(one, out=tmp_path / "page.html")
        assert not {"script", "b>x"} & set(shown.tags)
        assert all(link.startswith(("data:", "#")) for link in shown.links)
        assert "<script>alert(1)" in shown.text

    @pytest.mark.parametrize("content", ["[]", "{", '{"episodes": 3}', '{"episodes": {"a": 1}}'])
    def test_results_that_are_none(self, one, tmp_path, content):
        (one / "results.json").write_text(content)
        page(one, out=tmp_path / "page.html")

    @pytest.mark.parametrize("name", ["video.mp4", "evaluation"])
    def test_links_are_not_followed(self, one, tmp_path, name):
        secret = tmp_path / "secret"
        secret.mkdir()
        (secret / "trajectories.png").write_bytes(b"secret")
        target = secret if name == "evaluation" else secret / "trajectories.png"
        (one / name).symlink_to(target)
        links = page(one, out=tmp_path / "page.html").links
        assert not any(link.startswith("data:") for link in links)

    def test_the_page_is_no_link(self, one, tmp_path):
        precious = tmp_path / "precious"
        precious.write_text("precious")
        (one / "report.html").unlink()
        (one / "report.html").symlink_to(precious)
        command.main([one])
        assert precious.read_text() == "precious"
        assert not (one / "report.html").is_symlink()
