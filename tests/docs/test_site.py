"""The built site in a browser: phone and desktop, light and dark, tables, search, formulas.

    pip install playwright && playwright install chromium-headless-shell
    pytest -n 0 tests/docs/test_site.py

``CHROMIUM`` names a browser that is installed elsewhere; ``SCREENSHOTS`` a folder for pictures of
the pages, to be looked at. Without a browser all of this is skipped.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

playwright = pytest.importorskip("playwright.sync_api")
pytest.importorskip("sphinx")

ROOT = Path(__file__).parents[2]
ALONE = ["--no-sandbox", "--disable-gpu", "--headless=shell"]
DESKTOP = {"width": 1280, "height": 800}
PHONE = {"width": 390, "height": 844}
# Tables, pictures, formulas and notebooks.
SHOWN = ("index", "results", "safety_number", "experiments", "benchmarks", "performance")
SHOWN += ("configuration", "equations", "methods", "tutorials/sac_constraint", "blocks/baselines")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "-b", "html", "docs", str(out)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(out))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def browser():
    elsewhere = os.environ.get("CHROMIUM")
    with playwright.sync_playwright() as driver:
        try:
            chromium = driver.chromium.launch(
                executable_path=elsewhere, args=ALONE if elsewhere else []
            )
        except playwright.Error as error:
            pytest.skip(f"no browser: {str(error).splitlines()[0]}")
        yield chromium
        chromium.close()


@pytest.fixture
def view(browser, site):
    """Opens a page of the site, and notes what its scripts complain about."""
    contexts, complaints = [], []

    def show(page, size=DESKTOP, scheme="light"):
        contexts.append(browser.new_context(viewport=size, color_scheme=scheme))
        tab = contexts[-1].new_page()
        tab.on("pageerror", lambda error: complaints.append(str(error)))
        name, _, rest = page.partition("?")
        tab.goto(f"{site}/{name}.html{'?' + rest if rest else ''}")
        tab.wait_for_load_state()
        if folder := os.environ.get("SCREENSHOTS"):
            Path(folder).mkdir(parents=True, exist_ok=True)
            path = Path(folder, f"{name.replace('/', '-')}-{size['width']}-{scheme}.png")
            tab.screenshot(path=path, full_page=False)
        return tab

    yield show
    for context in contexts:
        context.close()
    assert not complaints


def test_landing_page_shows_commands_and_film(view):
    tab = view("index")
    bottom = DESKTOP["height"]
    for command in ("torchrl-safe train", "pytest"):
        block = tab.locator(".highlight", has_text=command).first
        assert block.bounding_box()["y"] < bottom * 1.5
    film = tab.locator("img[src$='play.gif']").first
    assert film.evaluate("image => image.complete && image.naturalWidth > 0")
    assert film.bounding_box()["y"] < bottom


@pytest.mark.parametrize("page", SHOWN)
def test_tables_are_whole_on_a_desktop(view, page):
    tab = view(page)
    hidden = tab.evaluate(
        """() => [...document.querySelectorAll("article table")].filter(table => {
            const box = table.closest(".table-wrapper") ?? table.parentElement;
            return box.scrollWidth > box.clientWidth + 1;
        }).map(table => table.querySelector("tr").innerText)"""
    )
    assert not hidden


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("page", SHOWN)
def test_page_fits_a_phone(view, page, scheme):
    tab = view(page, PHONE, scheme)
    assert tab.evaluate("document.scrollingElement.scrollWidth") <= PHONE["width"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_contrast(view, scheme):
    tab = view("index", scheme=scheme)
    text, ground = (
        tab.evaluate(f"getComputedStyle(document.body).{name}.match(/[0-9]+/g).map(Number)")
        for name in ("color", "backgroundColor")
    )
    dark = sum(ground[:3]) < 3 * 128
    assert dark == (scheme == "dark")
    assert abs(sum(text[:3]) - sum(ground[:3])) > 3 * 128


def test_pictures_are_there(view):
    for page in SHOWN:
        tab = view(page)
        for picture in tab.locator("article img").all():
            picture.scroll_into_view_if_needed()
            tab.wait_for_function("image => image.complete", arg=picture.element_handle())
            assert picture.evaluate("image => image.naturalWidth > 0"), page


def test_formulas_are_drawn(view):
    tab = view("methods")
    sizes = tab.evaluate(
        "() => [...document.querySelectorAll('math')].map(f => f.getBoundingClientRect().width)"
    )
    assert len(sizes) > 5
    assert min(sizes) > 0


def test_search_finds(view):
    tab = view("search?q=retrace")
    tab.wait_for_selector("#search-results li a", timeout=30_000)
    assert tab.locator("#search-results li a").count() > 3


def test_links_of_the_side_bar_lead_to_pages(view):
    tab = view("index")
    links = tab.evaluate(
        "() => [...document.querySelectorAll('.sidebar-tree a')].map(link => link.href)"
    )
    assert len(links) > 20
    for link in set(links):
        assert tab.request.get(link).ok, link
