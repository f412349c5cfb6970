"""Common set-up of all tests: seeded random numbers, one thread, and the bundled speech.

The process that distributes the tests imports this file, too. It needs no torch, whose import takes
seconds of one core, so functions import it and what depends on it.
"""

from __future__ import annotations

import gc
import os
import random
import shutil
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.sign_of_life import SignOfLife

if TYPE_CHECKING:
    from torch import Tensor

    from tests.pyclarity import PyclarityOutputs

SPEECH_DIR = Path(__file__).parents[1] / "hlsim" / "data" / "speech"


LONGEST = (
    "test_a_compiled_network",
    "test_parallel.py::test_a_process_that_ends",
    "test_clarity.py::test_the_baseline",
    "test_gpu_measurement_on_a_cpu",
    "test_commands_and_programs_of_a_page_run",
    "test_model.py::test_output_equals_pyclaritys_sample_by_sample",
    "test_long_recordings.py::test_memory",
    "test_export.py::test_onnx",
    "test_parallel.py",
    "test_study.py",
    "test_demo.py",
    "test_startup.py",
    "test_compensators.py",
    "test_scores.py::test_a_batch_equals_its_items",
)
"""Parts of the names of the longest tests, which the workers begin with.

A long test that began last would keep one core busy and let the others wait.
"""

SECOND_HALF = ("sympy", "scipy.stats", "pandas", "matplotlib.pyplot")
"""Packages that every second worker imports before torch.

In a new environment, where no module is compiled yet, two workers that import the same modules at
the same time both compile all of them.
"""

NEW_OUTPUTS = pytest.StashKey[dict[str, Any]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--write-pyclarity",
        action="store_true",
        help="store pyclarity's outputs that the slow tests compute (tests/pyclarity.py)",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Use one thread, because the rounding of transforms depends on the number of threads.

    Processes that tests start use one as well: several workers would wait for each other's threads.
    """
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    config.stash[NEW_OUTPUTS] = {}
    distributes_tests = bool(config.getoption("numprocesses", None))
    if distributes_tests and not hasattr(config, "workerinput"):
        config.pluginmanager.register(SignOfLife(config))
        return
    gc.disable()  # until all modules are imported
    if os.environ.get("PYTEST_XDIST_WORKER", "gw0")[-1] in "13579":
        for name in SECOND_HALF:
            if find_spec(name.partition(".")[0]):
                import_module(name)
    import torch

    torch.set_num_threads(1)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Let the workers begin with the longest tests."""
    if hasattr(config, "workerinput"):
        places = {
            item: next((i for i, name in enumerate(LONGEST) if name in item.nodeid), len(LONGEST))
            for item in items
        }
        items.sort(key=places.__getitem__)


def pytest_collection_finish() -> None:
    """Exempt what was imported from garbage collection, which would visit it again and again."""
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Store pyclarity's outputs if ``--write-pyclarity`` was set."""
    if session.config.stash[NEW_OUTPUTS]:
        from tests.pyclarity import write_outputs

        write_outputs(session.config.stash[NEW_OUTPUTS])


def pytest_report_header(config: pytest.Config) -> str | None:
    """Name the tests that run only with a marker."""
    if config.option.markexpr == "not slow and not install and not browser and not audio":
        return (
            "left out: slow tests, and tests of an installation, of a browser and of sound; "
            "run them with pytest -m slow, install, browser, audio"
        )
    return None


@pytest.fixture(params=["stored", pytest.param("computed", marks=pytest.mark.slow)])
def pyclarity(request: pytest.FixtureRequest) -> PyclarityOutputs:
    """Outputs of pyclarity by key: the stored ones, and in a second, slow test, computed ones."""
    from tests.pyclarity import PyclarityOutputs

    writes = request.config.option.write_pyclarity
    new_outputs = request.config.stash[NEW_OUTPUTS] if writes else None
    return PyclarityOutputs(request.param == "computed", new_outputs)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Seed every generator before each test; pyclarity's HASPI uses numpy's global one."""
    import torch

    random.seed(0)
    np.random.seed(0)
    # torch.manual_seed would also write down for each GPU where it was called, in milliseconds.
    torch.default_generator.manual_seed(0)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Use two threads, for code that computes differently with more than one."""
    import torch

    torch.set_num_threads(2)
    yield
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A headless Chromium with a microphone that plays beeps.

    It is playwright's own (``playwright install chromium``), or one of the system, found by name or
    in the environment variable ``CHROMIUM``.
    """
    sync_api = pytest.importorskip("playwright.sync_api")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    flags = (
        "--no-sandbox --disable-gpu --disable-background-networking --disable-component-update "
        "--disable-sync --use-fake-device-for-media-stream --use-fake-ui-for-media-stream"
    )
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=flags.split())
        yield browser
        browser.close()


@pytest.fixture
def quick_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace HASPI, HASQI and HAAQI, which take seconds, by scores of the level only."""
    from hlsim.evaluation import measures

    def score(name: str, precision: Any, item: Any, output: Tensor) -> dict[str, float]:
        highest = 1.0 if name == "haspi" else 0.5
        return {name: highest * float(output.std() / (output.std() + 0.1))}

    monkeypatch.setattr(measures, "_score_for_ear", score)
    monkeypatch.setattr(measures, "_prepare", None)  # so that a score not replaced here fails
    for name in measures.REFERENCES:
        monkeypatch.setitem(measures.MEASURES, name, measures._ear_measure(name))


@pytest.fixture
def every_path_exists(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the command line accept the paths in examples, which do not exist."""
    monkeypatch.setattr(Path, "exists", lambda path: True)
    monkeypatch.setattr(Path, "is_dir", lambda path: True)


@pytest.fixture(scope="session")
def speech_dir() -> Path:
    """The folder of the bundled speech, with the subfolders ``train`` and ``valid``."""
    return SPEECH_DIR


@cache
def read_speech(name: str) -> tuple[Tensor, int]:
    """Read a bundled utterance and its rate in Hz, once for all tests. Shape: (1, time)."""
    from hlsim.audio import read_audio

    return read_audio(SPEECH_DIR / f"{name}.flac")


@pytest.fixture
def speech() -> list[tuple[Tensor, int]]:
    """Four utterances by four voices, two at 16 kHz and two at 22.05 kHz, with their rates in Hz.

    The level is 68 dB SPL where RMS 1.0 is 94 dB SPL.

    Shape: (1, time) each.
    """
    names = (
        "train/flite-slt-01",
        "train/espeak-nyc-m4-01",
        "valid/flite-rms-01",
        "valid/espeak-us-annie-01",
    )
    utterances = [read_speech(name) for name in names]
    return [(waveform.clone(), rate) for waveform, rate in utterances]
