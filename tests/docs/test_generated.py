"""Figures of README and docs are those of the results that are kept, and lines are short."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
if not (ROOT / "benchmarks" / "results").exists():
    pytest.skip("a source distribution has no results", allow_module_level=True)
sys.path += [str(ROOT / "benchmarks"), str(ROOT / "benchmarks" / "paper")]

import result_tables  # noqa: E402
import write_pages  # noqa: E402

README = (ROOT / "README.md").read_text()
CODE = re.compile(r"^( *)```.*?^\1```$", re.MULTILINE | re.DOTALL)
PART = re.compile(r"<!-- generated: .*?<!-- end -->", re.DOTALL)
NUMBER = re.compile(r"(?<![\w.])\d[\d,]*(?:\.\d+)*")


def shown(markdown):
    """What a reader sees of Markdown: no comments, no addresses, no tags."""
    markdown = re.sub(r"<!--.*?-->|<[a-z/][^>]*>", "", markdown, flags=re.DOTALL)
    return re.sub(r"\]\([^)]*\)", "]", markdown)


@pytest.mark.parametrize("page", write_pages.PAGES)
def test_page_is_what_the_results_say(page):
    text = (ROOT / page).read_text()
    assert write_pages.MARKED.search(text)
    assert write_pages.rewritten(text) == text, "run python benchmarks/write_pages.py"


def test_every_table_of_the_results_is_generated():
    typed = PART.sub("", (ROOT / "docs" / "results.md").read_text())
    assert not re.findall(r"^\|.*", typed, re.MULTILINE)
    assert not re.findall(r"\d / \.?\d", CODE.sub("", typed))  # a score with its CV


def test_picture_is_of_the_curves_that_are_kept():
    paths = write_pages.learning_curves()
    assert len(paths) >= 5
    assert write_pages.drawn_from(write_pages.LEARNING) == write_pages.digest(paths)
    assert write_pages.LEARNING.stat().st_size < 100_000


class TestReadme:
    def test_numbers_are_few(self):
        assert len(NUMBER.findall(shown(README))) <= 40

    def test_no_figure_is_typed(self):
        assert not NUMBER.findall(shown(CODE.sub("", PART.sub("", README))))

    def test_sentences_are_short(self):
        prose = re.sub(r"^\|.*$", "", shown(CODE.sub("", README)), flags=re.MULTILINE)
        for sentence in re.split(r"[.:?;]\s|\n\n|\n\* ", prose):
            assert len(sentence.split()) <= 30, sentence

    def test_it_is_a_screen_and_a_half(self):
        assert len(README.splitlines()) <= 120
        assert max(map(len, README.splitlines())) <= 100

    def test_code_is_short(self):
        block, environment = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
        assert len(block.replace("\n\n", "\n").splitlines()) <= 10
        assert len(environment.replace("\n\n", "\n").splitlines()) <= 5

    def test_table_is_small(self):
        rows = [line for line in README.splitlines() if line.startswith("|")]
        assert len(rows) - 2 <= 6
        assert all(row.count(" to ") == 2 for row in rows[2:])  # intervals


class TestTables:
    def test_mean_and_range_of_seeds(self, tmp_path):
        for seed, score in enumerate((8.0, 10.0)):
            path = tmp_path / f"seed_{seed}" / "results.json"
            path.parent.mkdir()
            path.write_text(json.dumps({"eval/score": score, "eval/cv_rate": 0.004}))
        runs = result_tables.seeds(tmp_path)
        assert result_tables.spread(runs, "eval/score", ".1f") == "9.0 (8.0 to 10.0)"
        assert result_tables.spread(runs[:1], "eval/score", ".1f") == "8.0"
        assert result_tables.pair(runs) == "9.0 / 0.0040"

    def test_level_is_of_the_last_tenth(self, tmp_path):
        lines = [f"{frames},{frames / 10}" for frames in range(10, 101, 10)]
        path = tmp_path / "curves.csv"
        path.write_text("\n".join(["frames,update/constraint", *lines, "110,"]))
        assert result_tables.level(path) == 10  # of frame 100 alone; 110 has no update

    def test_rows_have_as_many_cells_as_the_head(self):
        for name, part in write_pages.PARTS.items():
            rows = [line for line in part().splitlines() if line.startswith("|")]
            assert len({line.count("|") for line in rows}) <= 1, name


@pytest.mark.parametrize("words", ["not kept", "dearest", "gave these same", "is paid for"])
def test_prose_is_plain(words):
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        prose = CODE.sub("", page.read_text())
        assert words not in " ".join(prose.split()), page


PROSE = [ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PROSE, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_are_short(page):
    for line in page.read_text().splitlines():
        table, picture = line.lstrip().startswith("|"), line.startswith("![")
        breakable = " " in line.strip(" *>") and not re.fullmatch(r"`[^`]*`", line)
        assert len(line) <= 100 or table or picture or not breakable, line
