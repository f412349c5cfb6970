"""The report's page in a real Chromium: no error, no request, players that play, a phone's width, the keyboard.

Run with ``pytest -m browser``. Needs playwright and a Chromium: its own (``playwright install chromium``), or one of the
system, found by name or in the environment variable ``CHROMIUM``.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hlsim.report.page import write_page
from hlsim.report.recordings import report_page
from tests.report.test_recordings import evaluation

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of three conditions; the scores are made up."""
    root = tmp_path_factory.mktemp("report")
    study = evaluation(root)
    return write_page(report_page(study, listen=2), study.to_dict(), root / "out")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    sync_api = pytest.importorskip("playwright.sync_api")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(params=[(400, 740), (1400, 900)], ids=["phone", "desk"])
def opened(request: pytest.FixtureRequest, chromium: Any) -> Iterator[Callable[[Path], Any]]:
    """Opens a page; fails afterwards where it said anything or asked for anything but itself."""
    width, height = request.param
    page = chromium.new_page(viewport={"width": width, "height": height})
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda one: asked.append(one.url))

    def open_page(path: Path) -> Any:
        page.goto(path.as_uri())
        return page

    yield open_page
    url = page.url.partition("#")[0]
    page.close()
    assert said == []
    assert [one for one in asked if not one.startswith("data:")] == [url]


@pytest.fixture
def page(opened: Callable[[Path], Any], page_file: Path) -> Any:
    return opened(page_file)


def test_pictures_are_drawn_and_nothing_is_wider_than_the_screen(page: Any) -> None:
    widths = page.evaluate(
        "[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width])"
    )
    # five of the study, and for each of two items clean speech and three conditions
    assert len(widths) == 5 + 2 * 4
    inner = page.viewport_size["width"]
    assert all(natural > 0 and 150 < shown <= inner for natural, shown in widths)
    assert page.evaluate("document.documentElement.scrollWidth") <= inner
    # the first table is whole even on a phone
    region = page.locator(".scroll").first
    assert region.evaluate("e => e.scrollWidth <= e.clientWidth")
    assert (
        page.evaluate("parseFloat(getComputedStyle(document.querySelector('td')).fontSize)") >= 13
    )


def test_players_play(page: Any) -> None:
    played = page.evaluate(
        """async () => {
            const out = [];
            for (const audio of document.querySelectorAll('audio')) {
                audio.muted = true;
                await audio.play();
                await new Promise(done => audio.ontimeupdate = () => audio.currentTime > 0 && done());
                out.push([audio.duration, audio.error === null, audio.currentTime > 0]);
                audio.pause();
            }
            return out;
        }"""
    )
    assert len(played) == 2 * 4
    assert all(abs(seconds - 1.0) < 0.02 and fine and moved for seconds, fine, moved in played)


def test_the_keyboard_reaches_everything(page: Any) -> None:
    page.keyboard.press("Tab")
    focus = "[document.activeElement.className || document.activeElement.tagName, document.activeElement.innerText]"
    assert page.evaluate(focus) == ["skip", "Skip to the report"]
    assert page.evaluate("document.activeElement.getBoundingClientRect().left") >= 0
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"
    reached = []
    for _ in range(80):
        page.keyboard.press("Tab")
        kind = page.evaluate(
            "document.activeElement.tagName + '.' + document.activeElement.className"
        )
        reached.append(kind)
        if kind.startswith("SUMMARY"):
            break
    tables = page.evaluate(
        """() => {
            const folded = document.querySelector('details');
            const follows = Node.DOCUMENT_POSITION_FOLLOWING;
            return [...document.querySelectorAll('.scroll')].filter(
                e => e.compareDocumentPosition(folded) & follows && !folded.contains(e)).length;
        }"""
    )
    assert reached.count("DIV.scroll") == tables >= 2
    assert sum(kind.startswith("AUDIO") for kind in reached) >= 8
    hidden = page.locator("details table").first
    assert not hidden.is_visible()
    page.keyboard.press("Enter")
    assert hidden.is_visible()


def test_a_link_to_a_folded_section_opens_it_and_shows_its_heading(page: Any) -> None:
    names = page.evaluate("[...document.querySelectorAll('details.folded > div')].map(e => e.id)")
    name = next(name for name in names if page.locator(f'nav a[href="#{name}"]').count())
    details = page.locator(f'details.folded:has(> [id="{name}"])')
    assert not details.evaluate("e => e.open")
    page.locator(f'nav a[href="#{name}"]').click()
    page.wait_for_function("e => e.open", arg=details.element_handle())
    place = details.locator("h2").first.bounding_box()
    assert 0 <= place["y"] < page.viewport_size["height"]


def test_the_focus_is_seen_and_scrolls_a_wide_table(page: Any) -> None:
    wide = page.locator(".scroll").last
    page.locator("summary").first.click()
    wide.focus()
    page.keyboard.press("Tab")
    page.keyboard.press("Shift+Tab")
    assert wide.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
    if wide.evaluate("e => e.scrollWidth > e.clientWidth"):
        for _ in range(3):
            page.keyboard.press("ArrowRight")
        page.wait_for_function("e => e.scrollLeft > 0", arg=wide.element_handle())
