"""The listening page in a real Chromium: values, clicks, the keyboard, the microphone, two widths, and no other host.

Run with ``pytest -m browser``. Needs npm, playwright and a Chromium: its own (``playwright install chromium``), or one
of the system, found by name or in the environment variable ``CHROMIUM``. This command prints the figures of the guide:

    pytest -n 0 -s -m browser tests/test_listening_page.py -k delay
"""

import http.server
import io
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import soundfile
import torch
from torch import Tensor

import hlsim
from hlsim.calibration import level_spl, set_level

pytestmark = pytest.mark.browser

ROOT = Path(__file__).parents[1]
COMPUTED = "!document.querySelector('[aria-busy=true]') || document.body.dataset.failed"
PAGE = "const { state } = await import('./page.js');"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the page with its models."""
    if shutil.which("npm") is None:
        pytest.skip("needs npm")
    pytest.importorskip("onnxscript")
    folder = tmp_path_factory.mktemp("listen")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(ROOT / "docs" / "listening_page.py"), str(folder)]
    subprocess.run(command, check=True, env=environment, stderr=subprocess.DEVNULL)
    return folder


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    """Address of the page, from a server of static files."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        extensions_map = http.server.SimpleHTTPRequestHandler.extensions_map | {
            ".mjs": "text/javascript",
            ".wasm": "application/wasm",
        }

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments, directory=str(folder))

        def log_message(self, *arguments: Any) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()


@pytest.fixture
def page(request: pytest.FixtureRequest, chromium: Any, address: str) -> Iterator[Any]:
    """A new page, 1400 px wide by default, which must print nothing and ask no other host."""
    width = getattr(request, "param", 1400)
    page = chromium.new_page(viewport={"width": width, "height": 900})
    messages: list[str] = []
    requests: list[str] = []
    page.on("console", lambda message: messages.append(message.text))
    page.on("pageerror", lambda error: messages.append(str(error)))
    page.on("request", lambda one: requests.append(one.url))
    page.set_default_timeout(180_000)  # several pages share a core
    yield page
    page.close()
    assert messages == []
    assert [url for url in requests if not url.startswith((address, "data:", "blob:"))] == []


@pytest.fixture
def fresh(page: Any, address: str, excerpt: bytes) -> Any:
    """The page with short sentences, of which nothing has to be computed yet."""
    page.route("**/*.flac", lambda route: route.fulfill(body=excerpt, content_type="audio/flac"))
    page.goto(address)
    return page


@pytest.fixture
def opened(fresh: Any) -> Any:
    """The page with all versions of its first sound computed."""
    wait(fresh)
    return fresh


@pytest.fixture(scope="module")
def excerpt() -> bytes:
    """A file with 0.9 s of speech, for which the simulator needs one window instead of three."""
    file = io.BytesIO()
    soundfile.write(file, hlsim.example_speech()[8000:22400].numpy(), 16000, format="FLAC")
    return file.getvalue()


def wait(page: Any) -> None:
    """Wait until all versions are computed."""
    page.wait_for_function(COMPUTED)
    assert page.evaluate("document.body.dataset.failed") is None


def set_file(page: Any, path: Path) -> None:
    page.set_input_files("#file", path)
    page.wait_for_function(
        "name => document.getElementById('source-name').textContent == name", arg=path.name
    )
    wait(page)


def result(page: Any, name: str) -> Tensor:
    samples = page.evaluate(f"async () => {{ {PAGE} return [...state.results['{name}']]; }}")
    return torch.tensor(samples)


def error_db(output: Tensor, expected: Tensor) -> float:
    return float(20.0 * torch.log10((output - expected).norm() / expected.norm()))


def expected_results(signal: Tensor, ear: str) -> dict[str, Tensor]:
    """Compute the three versions of the page in Python. In the page, silence follows a sound."""
    simulator = hlsim.load_pretrained("neuro-msbg")
    silence = torch.zeros(16000)
    clean = torch.cat((set_level(signal, 65.0), silence))
    with torch.no_grad():
        versions = {
            "normal": simulator(clean, "NH"),
            "ear": simulator(clean, ear),
            "aided": simulator(
                torch.cat((hlsim.compensate(clean, ear)[: len(signal)], silence)), ear
            ),
        }
    return {name: perceived[: len(signal)] for name, perceived in versions.items()}


def speech_file(folder: Path, samples: int) -> tuple[Path, Tensor]:
    signal = hlsim.example_speech()[:samples]
    path = folder / "speech.wav"
    soundfile.write(path, signal.numpy(), 16000, subtype="FLOAT")
    return path, signal


@pytest.mark.parametrize(("ear", "samples"), [("S3", 61_234), ("N6", 9_000)])
def test_outputs_equal_those_of_python(
    page: Any, address: str, tmp_path: Path, ear: str, samples: int
) -> None:
    path, signal = speech_file(tmp_path, samples)
    thresholds = hlsim.Audiogram.standard(ear).thresholds
    page.goto(f"{address}#ear={','.join(f'{level:g}' for level in thresholds)}")
    set_file(page, path)
    for name, expected in expected_results(signal, ear).items():
        assert error_db(result(page, name), expected) < -60.0, name


@pytest.mark.parametrize("page", [390], indirect=True)
def test_nothing_is_wider_than_the_screen(opened: Any) -> None:
    for width in (390, 1400):
        opened.set_viewport_size({"width": width, "height": 900})
        assert opened.evaluate("document.documentElement.scrollWidth") <= width
        sizes = opened.evaluate(
            "[...document.querySelectorAll('svg text')].map(t => t.getBoundingClientRect().height)"
        )
        assert min(sizes) >= 11
        assert opened.locator("#dock").is_visible() == (width < 960)


def test_a_dragged_point_moves_the_sounds_and_the_link(opened: Any) -> None:
    assert opened.locator("[aria-pressed=true]").first.inner_text() == "N3"
    before = result(opened, "ear")
    box = opened.locator(".point .dot").nth(0).bounding_box()
    opened.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    opened.mouse.down()
    opened.mouse.move(box["x"] + 5, box["y"] + 60, steps=4)
    level = int(opened.locator(".point").nth(0).get_attribute("aria-valuenow"))
    assert opened.locator(".value:visible").all_text_contents() == [f"{level} dB HL"]
    opened.mouse.up()
    assert level > 45
    assert f"#ear={level},35,40,50,55,60,65,65&" in opened.url
    name = "Your own ear, closest to N3: moderate loss"
    assert opened.locator("#ear-name").inner_text() == name
    for _ in range(600):  # the page waits a moment before it computes
        opened.wait_for_timeout(100)
        wait(opened)
        if not torch.equal(after := result(opened, "ear"), before):
            break
    assert float(after.norm()) < 0.9 * float(before.norm())


def test_loudness_is_that_relative_to_a_healthy_ear(opened: Any, excerpt: bytes) -> None:
    loudness = opened.locator(".loudness")
    normal, perceived = (level_spl(result(opened, name)) for name in ("normal", "ear"))
    difference = float(normal - perceived)
    samples, _ = soundfile.read(io.BytesIO(excerpt), dtype="float32")
    sound = set_level(torch.from_numpy(samples), 65.0)
    expected = level_spl(hlsim.simulate(sound, "NH")) - level_spl(hlsim.simulate(sound, "N3"))
    assert abs(difference - float(expected)) < 0.2  # from the exact MSBG
    assert loudness.nth(1).inner_text() == f"{round(difference)} dB softer than for a healthy ear"
    opened.get_by_role("button", name="N6", exact=True).click()
    opened.wait_for_function(
        "document.querySelectorAll('.loudness')[1].textContent.startsWith('not heard at all. Do not')"
    )


def test_presets_numbers_and_the_link_set_the_ear(fresh: Any) -> None:
    fresh.get_by_role("button", name="S1", exact=True).click()
    assert "#ear=10,10,10,15,30,55,70,70&" in fresh.url
    fresh.get_by_text("Type the numbers").click()
    fresh.get_by_label("Level at 1000 hertz in decibels").fill("400")
    fresh.keyboard.press("Tab")
    assert "#ear=10,10,100,15,30,55,70,70&" in fresh.url
    assert fresh.locator("#shared").inner_text() == "Levels go from -10 to 100 dB HL."
    fresh.evaluate("location.hash = '#ear=20,20,25,35,40,45,50,50'")
    fresh.wait_for_function("document.getElementById('ear-name').textContent.startsWith('N2')")
    fresh.evaluate("location.hash = '#ear=20,20,nonsense'")
    fresh.wait_for_function(
        "document.getElementById('shared').textContent.startsWith('The link has no ear')"
    )
    assert fresh.locator(".point").nth(3).get_attribute("aria-valuetext") == "35 decibels"


def test_the_keyboard_alone_sets_an_ear_and_plays(opened: Any) -> None:
    def press_tab_until(label: str) -> None:
        for _ in range(60):
            opened.keyboard.press("Tab")
            focused = "document.activeElement.getAttribute('aria-label') || document.activeElement.innerText"
            if label in opened.evaluate(focused):
                return
        pytest.fail(f"the tabulator does not reach {label}")

    opened.keyboard.press("Tab")
    assert opened.evaluate("document.activeElement.className") == "skip"
    press_tab_until("at 4000 hertz")
    for key in ("ArrowDown", "ArrowDown", "ArrowLeft", "PageDown"):
        opened.keyboard.press(key)
    assert "#ear=35,35,40,50,55,85,65,65&" in opened.url
    wait(opened)
    press_tab_until("Play: This ear")
    opened.keyboard.press("Enter")
    opened.wait_for_selector("#version-ear.playing")
    press_tab_until("Play: This ear with a hearing aid")
    opened.keyboard.press("Space")
    opened.wait_for_selector("#version-aided.playing")
    assert opened.locator(".playing").count() == 1
    opened.keyboard.press("Space")
    opened.wait_for_function("!document.querySelector('.playing')")
    opened.keyboard.press("1")
    opened.wait_for_selector("#version-normal.playing")


def test_another_sentence_plays_from_its_start(opened: Any) -> None:
    opened.locator("#version-ear .play").click()
    opened.wait_for_selector("#version-ear.playing")
    opened.wait_for_function(
        "parseFloat(document.querySelector('#version-ear .head-line').style.left) > 5"
    )
    opened.evaluate(
        """() => {
            window.positions = [];
            const start = AudioBufferSourceNode.prototype.start;
            AudioBufferSourceNode.prototype.start = function (when, position) {
                window.positions.push(position);
                start.call(this, when, position);
            };
        }"""
    )
    opened.locator("#speech").select_option(index=1)
    opened.wait_for_function("window.positions.length > 0")
    opened.wait_for_selector("#version-ear.playing")
    assert opened.evaluate("window.positions[0]") == 0


def test_the_link_has_the_ear_and_the_sentence(fresh: Any, chromium: Any) -> None:
    fresh.get_by_role("button", name="N2", exact=True).click()
    fresh.locator("#speech").select_option(index=2)
    assert fresh.url.endswith("#ear=20,20,25,35,40,45,50,50&speech=espeak-us-annie-01")
    other = chromium.new_page()
    other.goto(fresh.url)
    assert other.locator("[aria-pressed=true]").first.inner_text() == "N2"
    other.wait_for_function("document.getElementById('source-name').textContent.includes('Jane')")
    other.close()


def test_playback_starts_softly_and_is_limited(page: Any, address: str) -> None:
    """For a tone 20 dB above full scale, and for one that the limiter should leave as it is."""
    page.goto(address)
    assert float(page.locator("#volume").input_value()) <= 50
    peaks = page.evaluate(
        """async () => {
            const { safeOutput } = await import('./player.js');
            const peakOf = async (amplitude) => {
                const context = new OfflineAudioContext(1, 16000, 16000);
                const tone = new OscillatorNode(context, { frequency: 500 });
                const gain = new GainNode(context, { gain: amplitude });
                tone.connect(gain).connect(safeOutput(context, 1));
                tone.start();
                const samples = (await context.startRendering()).getChannelData(0);
                return samples.reduce((peak, sample) => Math.max(peak, Math.abs(sample)), 0);
            };
            return [await peakOf(10), await peakOf(0.1)];
        }"""
    )
    assert peaks[0] <= 0.5
    assert abs(peaks[1] - 0.1) < 1e-3


def test_a_file_that_is_no_sound_is_named(fresh: Any, tmp_path: Path) -> None:
    fresh.wait_for_function("document.getElementById('source-name').textContent.includes('ferry')")
    path = tmp_path / "notes.wav"
    path.write_text("no sound")
    fresh.set_input_files("#file", path)
    name = fresh.locator("#source-name")
    fresh.wait_for_function(
        "document.getElementById('source-name').textContent.includes('cannot read')"
    )
    assert "You still hear: “The ferry" in name.inner_text()
    fresh.locator("#version-normal .play").click()
    fresh.wait_for_selector("#version-normal.playing")


def test_the_unpacked_zip_says_how_to_serve_it(folder: Path, tmp_path: Path, chromium: Any) -> None:
    shutil.unpack_archive(folder.with_suffix(".zip"), tmp_path)
    page = chromium.new_page()
    page.goto((tmp_path / folder.name / "index.html").as_uri())
    page.wait_for_selector("text=python3 -m http.server", state="visible")
    page.close()


def test_a_recording_can_be_heard(fresh: Any) -> None:
    fresh.get_by_role("button", name="Record 5 seconds").click()
    fresh.wait_for_function(
        "document.getElementById('source-name').textContent == 'Your recording'"
    )
    fresh.wait_for_selector("#version-normal[aria-busy=false]")
    assert fresh.locator("#speech").input_value() == ""
    recording = result(fresh, "normal")
    assert recording.shape == (5 * 16000,)
    assert float(recording.norm()) > 0.1


def test_the_live_aid_starts_and_stops(opened: Any) -> None:
    start = opened.locator("#live")
    assert start.is_disabled()
    opened.get_by_label("I wear headphones").check()
    start.click()
    opened.wait_for_function("document.getElementById('live-status').textContent.startsWith('On.')")
    opened.get_by_role("button", name="N5").click()
    opened.locator("#version-ear .play").click()
    opened.wait_for_function("document.getElementById('live').textContent == 'Start'")
    opened.wait_for_selector("#version-ear.playing")
    wait(opened)


LIVE = """async (thresholds) => {
    const { connectAid, LIVE_DELAY } = await import('./microphone.js');
    const context = new AudioContext({ sampleRate: 16000 });
    const seconds = 6;
    const noise = new AudioBuffer({ length: seconds * 16000, sampleRate: 16000 });
    const samples = noise.getChannelData(0);
    for (let i = 0; i < samples.length; i++) samples[i] = 0.02 * (Math.random() - 0.5);
    const source = new AudioBufferSourceNode(context, { buffer: noise });
    const aid = await connectAid(context, source, thresholds);
    const statistics = [];
    aid.port.onmessage = ({ data }) => statistics.push(data);
    const both = new ChannelMergerNode(context, { numberOfInputs: 2 });
    source.connect(both, 0, 0);
    aid.connect(both, 0, 1);
    const code = `registerProcessor('both', class extends AudioWorkletProcessor {
        process([input]) { if (input.length == 2) this.port.postMessage(input); return true; }
    })`;
    const module = URL.createObjectURL(new Blob([code], { type: 'text/javascript' }));
    await context.audioWorklet.addModule(module);
    const recorder = new AudioWorkletNode(context, 'both');
    const recording = [[], []];
    recorder.port.onmessage = ({ data }) => data.forEach((part, i) => recording[i].push(...part));
    both.connect(recorder).connect(context.destination);
    source.start();
    await new Promise((resolve) => (source.onended = resolve));
    await context.close();
    return { recording, delay: LIVE_DELAY, ...statistics.at(-1) };
}"""


def test_the_live_aid_has_the_delay_that_it_states(page: Any, address: str) -> None:
    """Print the figures of docs/measured.md; no time of the machine is asserted."""
    begin = time.perf_counter()
    page.goto(address)
    page.locator("#version-ear .play").click()
    page.wait_for_selector("#version-ear.playing")
    seconds = time.perf_counter() - begin
    wait(page)
    live = page.evaluate(LIVE, list(hlsim.Audiogram.standard("N3").thresholds))
    microphone, output = (torch.tensor(channel) for channel in live["recording"])
    points = 2 * len(microphone)
    product = torch.fft.rfft(output, points) * torch.fft.rfft(microphone, points).conj()
    delay = float(torch.fft.irfft(product)[:4000].abs().argmax()) / 16.0
    print(
        f"\nfirst sound of the impaired ear after opening the page: {seconds:.1f} s\nlive: "
        f"{delay:.1f} ms from input to output of the audio graph; {live['late']} of "
        f"{live['blocks']} blocks of 8 ms were late"
    )
    assert live["delay"] < 50.0 and abs(delay - live["delay"]) < 1.0
