"""Pages in a real Chromium: errors, requests, players, a phone's width, dark mode, the keyboard.

Run with ``pytest -m browser``. The tests need playwright and a Chromium: its own
(``playwright install chromium``), or the system's, found by name or in the environment variable
``CHROMIUM``.
"""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hlsim import example_speech, listen
from hlsim.report.recordings_page import report_page
from hlsim.report.writing import write_results
from tests.helpers import run_short_demo
from tests.report.test_recordings import evaluation

pytestmark = pytest.mark.browser

STATE = """
    () => [...document.querySelectorAll('.hlsim-player')].map(player => {
        const audios = [...player.querySelectorAll('audio')];
        return {
            playing: audios.map((audio, number) => audio.paused ? -1 : number).filter(n => n >= 0),
            times: audios.map(audio => audio.currentTime),
            volumes: audios.map(audio => audio.volume),
            pressed: [...player.querySelectorAll('.select')]
                .findIndex(button => button.getAttribute('aria-pressed') === 'true'),
            position: Number(player.querySelector('.position').value),
            lowered: player.querySelector('.lowered').textContent,
        };
    })
"""
"""JavaScript that returns the state of each player of a page."""


FIRST_SEEKS = """
    () => document.querySelectorAll('audio').forEach(audio => {
        const keep = () => { audio.firstSeek = audio.currentTime; };
        audio.addEventListener('seeking', keep, { once: true });
    })
"""
"""JavaScript that keeps where each sound is set to first, which does not depend on the load."""


@pytest.fixture(scope="module")
def report_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of three conditions with made-up scores."""
    root = tmp_path_factory.mktemp("report")
    study = evaluation(root, listen=2)
    return write_results(report_page(study), study, root / "out")


@pytest.fixture(scope="module")
def players_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved player of speech and of louder copies."""
    path = tmp_path_factory.mktemp("players") / "players.html"
    speech = example_speech()
    listen(original=speech, louder=2.0 * speech, much_louder=20.0 * speech).save(path)
    return path


@pytest.fixture(scope="module")
def demo_file(tmp_path_factory: pytest.TempPathFactory, speech_dir: Path) -> Path:
    """The demo's page after few steps of training."""
    for package in ("lightning", "joblib"):
        pytest.importorskip(package)
    root = tmp_path_factory.mktemp("demo")
    run_short_demo(root, speech_dir, steps=10)
    return root / "out" / "report.html"


@pytest.fixture(params=["390 dark", "1400 light"])
def window(request: pytest.FixtureRequest, chromium: Any) -> Iterator[Any]:
    """A window that fails the test if its page logs anything or requests more than itself."""
    width, scheme = request.param.split()
    size = {"width": int(width), "height": 844}
    page = chromium.new_page(viewport=size, color_scheme=scheme)
    page.set_default_timeout(180_000)  # several pages share a core
    logged: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: logged.append(message.text))
    page.on("pageerror", lambda error: logged.append(str(error)))
    page.on("request", lambda request: requests.append(request.url))
    yield page
    url = page.url.partition("#")[0]
    page.close()
    assert logged == []
    assert [request for request in requests if not request.startswith("data:")] == [url]


@pytest.fixture
def report(window: Any, report_file: Path) -> Any:
    window.goto(report_file.as_uri())
    return window


@pytest.fixture
def demo(window: Any, demo_file: Path) -> Any:
    window.goto(demo_file.as_uri())
    return window


@pytest.fixture
def players(window: Any, players_file: Path) -> Any:
    window.goto(players_file.as_uri())
    return window


def wait_until(page: Any, expression: str, argument: Any = None) -> None:
    """Wait for an expression; playwright's own function needs ``eval``, which the page forbids."""
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        if page.evaluate(expression, argument):
            return
        page.wait_for_timeout(25)
    raise AssertionError(f"not true after 60 s: {expression}")


def check_images(page: Any, count: int) -> None:
    """Check that a page has some number of images, and that nothing is wider than the screen."""
    widths = page.evaluate(
        "[...document.images].map(i => [i.naturalWidth, i.getBoundingClientRect().width])"
    )
    inner = page.viewport_size["width"]
    assert len(widths) == count
    assert all(natural > 0 and 150 < width <= inner for natural, width in widths)
    assert page.evaluate("document.documentElement.scrollWidth") <= inner


def test_pictures_are_drawn_and_nothing_is_wider_than_the_screen(report: Any) -> None:
    # two of the scores, and for each of two items a normal ear and three conditions
    check_images(report, 2 + 2 * 4)
    # the first table is whole even on a phone
    assert report.locator(".scroll").first.evaluate("e => e.scrollWidth <= e.clientWidth")
    size = "parseFloat(getComputedStyle(document.querySelector('td')).fontSize)"
    assert report.evaluate(size) >= 13


def test_text_and_plots_follow_the_colour_scheme(report: Any) -> None:
    colours = report.evaluate(
        "[getComputedStyle(document.body).color, getComputedStyle(document.body).backgroundColor]"
    )
    ink, ground = (sum(map(int, colour[4:-1].split(","))) for colour in colours)
    dark = report.evaluate("matchMedia('(prefers-color-scheme: dark)').matches")
    assert (ink > ground) == dark and abs(ink - ground) > 400
    # a pixel of the axes of the first plot, which is an image that the page's style cannot reach
    lightest, darkest = report.evaluate(
        """async () => {
            const image = document.querySelector('.pictures img');
            await image.decode();
            const canvas = document.createElement('canvas');
            Object.assign(canvas, {width: image.width, height: image.height});
            const context = canvas.getContext('2d');
            context.drawImage(image, 0, 0, image.width, image.height);
            const data = context.getImageData(0, 0, image.width, image.height).data;
            const grey = [];
            for (let i = 0; i < data.length; i += 4)
                if (data[i + 3] > 250) grey.push((data[i] + data[i + 1] + data[i + 2]) / 3);
            return [Math.max(...grey), Math.min(...grey)];
        }"""
    )
    assert lightest > 200 if dark else darkest < 50


def test_the_page_of_the_demo_shows_its_numbers_verdict_and_sounds(demo: Any) -> None:
    check_images(demo, 3 + 9)  # pictures, and spectrograms of all sounds
    titles = demo.locator(".card .name").all_inner_texts()
    assert titles == ["HASPI", "Words understood", "Loudness error"]
    bars = demo.locator(".card .bar").evaluate_all(
        "cells => cells.map(cell => cell.getBoundingClientRect().width)"
    )
    assert len(bars) == 3 * 4 and min(bars) > 40
    order = demo.evaluate(
        """['.cards', '.verdict', '.hlsim-player', '.pictures', 'details'].map(
            name => document.querySelector(name).getBoundingClientRect().top)"""
    )
    assert order == sorted(order)
    labels = demo.locator(".select span").all_inner_texts()
    assert labels[:4] == ["normal ear (the goal)", "unaided", "NAL-R", "trained aid"]
    assert labels[4:] == [
        "NAL-R, same level",
        *["original speech", "NAL-R", "NAL-R, same level", "trained aid"],
    ]
    demo.keyboard.press("2")  # on the fresh page, before any click
    (state,) = demo.evaluate(STATE)
    assert state["pressed"] == 1
    demo.locator(".play").click()
    demo.locator(".select").nth(3).click()
    wait_until(demo, "document.querySelectorAll('audio')[3].currentTime > 0.1")
    (state,) = demo.evaluate(STATE)
    assert state["playing"] == [3]


def test_switching_keeps_the_position(players: Any) -> None:
    players.locator(".play").click()
    wait_until(players, "document.querySelector('audio').currentTime > 0.4")
    players.evaluate(FIRST_SEEKS)
    players.locator(".select").nth(1).click()
    wait_until(players, "document.querySelectorAll('audio')[1].firstSeek > 0.4")
    (state,) = players.evaluate(STATE)
    assert state["playing"] == [1] and state["pressed"] == 1
    first_seek = players.evaluate("document.querySelectorAll('audio')[1].firstSeek")
    assert first_seek == pytest.approx(state["times"][0], abs=0.1)
    players.keyboard.press("1")
    wait_until(players, "!document.querySelector('audio').paused")
    (state,) = players.evaluate(STATE)
    assert state["playing"] == [0] and state["times"][0] >= 0.4
    players.locator(".play").click()
    (state,) = players.evaluate(STATE)
    assert state["playing"] == []
    script = """
        () => Math.abs(document.querySelector('.position').value
            - document.querySelector('audio').currentTime) < 0.05
    """
    wait_until(players, script)


def test_a_sound_plays_from_any_position(demo: Any) -> None:
    errors = demo.evaluate(
        """async () => {
            const errors = [];
            for (const audio of document.querySelectorAll('audio'))
                for (let step = 0; step < 20; step++) {
                    const answer = new Promise(found => {
                        audio.onseeked = audio.onerror = found;
                    });
                    audio.currentTime = audio.duration * step / 20;
                    await answer;
                    if (audio.error) errors.push([step / 20, audio.error.message]);
                }
            return errors;
        }"""
    )
    assert errors == []


def test_a_spectrogram_and_the_slider_choose_the_position(players: Any) -> None:
    spectrogram = players.locator(".spectrogram").nth(1)
    box = spectrogram.bounding_box()
    players.evaluate("document.querySelectorAll('audio')[1].loop = false")
    seconds = players.evaluate("Number(document.querySelector('.position').max)")
    spectrogram.click(position={"x": box["width"] / 2, "y": 40})
    wait_until(players, "document.querySelectorAll('audio')[1].played.length > 0")
    start = players.evaluate("document.querySelectorAll('audio')[1].played.start(0)")
    assert start == pytest.approx(seconds / 2, abs=0.1)
    players.locator(".play").click()
    players.locator(".position").fill("1")
    (state,) = players.evaluate(STATE)
    assert state["times"][1] == pytest.approx(1.0, abs=0.01)


def test_a_much_louder_sound_lowers_the_volume(players: Any) -> None:
    (state,) = players.evaluate(STATE)
    start = state["volumes"][0]
    assert start == 0.5
    players.locator(".select").nth(1).click()  # 6 dB louder
    (state,) = players.evaluate(STATE)
    assert state["volumes"][1] == start and state["lowered"] == ""
    players.locator(".select").nth(2).click()  # 26 dB louder than the first
    (state,) = players.evaluate(STATE)
    assert state["volumes"][2] == pytest.approx(start * 10 ** ((12 - 26.02) / 20), rel=0.01)
    assert state["lowered"].startswith("Volume lowered by 14 dB")
    # all sounds keep one gain: a softer one does not raise the volume, and the note stays
    players.locator(".select").nth(0).click()
    (state,) = players.evaluate(STATE)
    assert state["volumes"][0] < start and state["lowered"].endswith("Raise it with the slider.")
    players.locator(".volume").fill("0.5")
    (state,) = players.evaluate(STATE)
    assert state["volumes"][0] == start and state["lowered"] == ""


def test_players_of_several_notebook_cells_work_on_one_page(window: Any, tmp_path: Path) -> None:
    speech = example_speech()[:16000]
    cells = [listen(original=speech, soft=0.5 * speech)._repr_html_() for _ in range(2)]
    path = tmp_path / "notebook.html"
    path.write_text("<!doctype html><link rel=icon href=data:,>" + "".join(cells), encoding="utf-8")
    window.goto(path.as_uri())
    for number in (0, 3):
        window.locator(".select").nth(number).click()
        script = "n => document.querySelectorAll('audio')[n].currentTime > 0.1"
        wait_until(window, script, number)
    first, second = window.evaluate(STATE)
    assert (first["playing"], second["playing"]) == ([], [1]), "only one player plays"
    assert window.locator("audio[controls]").count() == 0
    window.locator(".volume").first.fill("0.25")
    first, second = window.evaluate(STATE)
    assert first["volumes"] == second["volumes"] == [0.25, 0.25]


def test_without_scripts_every_sound_has_the_controls_of_the_browser(
    chromium: Any, players_file: Path
) -> None:
    page = chromium.new_context(java_script_enabled=False).new_page()
    page.goto(players_file.as_uri())
    assert page.locator("audio[controls]").count() == 3
    assert page.locator("audio").first.is_visible()
    assert not page.locator(".controls").first.is_visible()
    page.context.close()


def test_the_keyboard_reaches_everything(report: Any) -> None:
    report.keyboard.press("Tab")
    element = "document.activeElement"
    focus = f"[{element}.className || {element}.tagName, {element}.innerText]"
    assert report.evaluate(focus) == ["skip", "Skip to the content"]
    assert report.evaluate(f"{element}.getBoundingClientRect().left") >= 0
    report.keyboard.press("Enter")
    assert report.evaluate(f"{element}.id") == "main"
    focused = []
    for _ in range(80):
        report.keyboard.press("Tab")
        kind = report.evaluate(f"{element}.tagName + '.' + {element}.className")
        focused.append(kind)
        if kind.startswith("SUMMARY"):
            break
    tables = report.evaluate(
        """() => {
            const folded = document.querySelector('details');
            const follows = Node.DOCUMENT_POSITION_FOLLOWING;
            return [...document.querySelectorAll('.scroll')].filter(
                e => e.compareDocumentPosition(folded) & follows && !folded.contains(e)).length;
        }"""
    )
    assert focused.count("DIV.scroll") == tables >= 2
    assert focused.count("BUTTON.play") == 2 and focused.count("BUTTON.select") == 8
    assert focused.count("INPUT.volume") == focused.count("INPUT.position") == 2
    hidden = report.locator("details table").first
    assert not hidden.is_visible()
    report.keyboard.press("Enter")
    assert hidden.is_visible()


def test_a_link_to_a_folded_section_opens_it_and_shows_its_heading(report: Any) -> None:
    names = report.evaluate("[...document.querySelectorAll('details.folded > div')].map(e => e.id)")
    name = next(name for name in names if report.locator(f'nav a[href="#{name}"]').count())
    details = report.locator(f'details.folded:has(> [id="{name}"])')
    assert not details.evaluate("e => e.open")
    report.locator(f'nav a[href="#{name}"]').click()
    wait_until(report, "e => e.open", details.element_handle())
    place = details.locator("h2").first.bounding_box()
    assert 0 <= place["y"] < report.viewport_size["height"]


def test_the_focus_is_visible_and_scrolls_a_wide_table(report: Any) -> None:
    wide = report.locator(".scroll").last
    report.locator("summary").first.click()
    wide.focus()
    report.keyboard.press("Tab")
    report.keyboard.press("Shift+Tab")
    assert wide.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
    if wide.evaluate("e => e.scrollWidth > e.clientWidth"):
        for _ in range(3):
            report.keyboard.press("ArrowRight")
        wait_until(report, "e => e.scrollLeft > 0", wide.element_handle())
