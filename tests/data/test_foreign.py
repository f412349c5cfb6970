"""Anyone's simulator as a teacher: how it is found, called and checked."""

import itertools
import pickle
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import Tensor

from hlsim import Audiogram
from hlsim.calibration import set_level
from hlsim.data.foreign import ForeignTeacher, load_enhancer, load_teacher
from hlsim.training.teacher import Teacher, find_teacher

HALF = """
import torch
from torch import nn

def half(waveform, audiogram):
    return waveform / 2

class Quieter(nn.Module):
    sample_rate = 44100
    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.5))
    def forward(self, waveform, audiogram):
        assert not self.training and not torch.is_grad_enabled()
        assert waveform.shape[0] == audiogram.shape[0] and audiogram.shape[1] == 8
        return self.gain * waveform * 10 ** (-audiogram[:, :1] / 20)

ready = Quieter()
number = 3
"""

_count = itertools.count()
Write = Callable[[str], str]


@pytest.fixture
def write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Write:
    """Writes a module into the working directory and returns its name, which no other test's has."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def write(text: str) -> str:
        name = f"somebodys_ears_{next(_count)}"
        (tmp_path / f"{name}.py").write_text(text)
        return name

    return write


def test_found_in_the_working_directory_and_asked_at_its_own_rate(write: Write) -> None:
    module = write(HALF)
    speech = set_level(torch.randn(2, 16000), 65.0)
    ears = torch.tensor([[0.0] * 8, [20.0] * 8])
    half = load_teacher(f"{module}:half")
    assert half.sample_rate == 16000
    torch.testing.assert_close(half(speech, ears, 16000), speech / 2)
    # the band that both rates hold
    low = torch.fft.irfft(torch.fft.rfft(speech) * (torch.arange(8001) < 6000), 16000)
    for name in ("Quieter", "ready"):
        other = load_teacher(f"{module}:{name}")
        assert other.sample_rate == 44100
        heard = other(low, ears, 16000)
        expected = low * torch.tensor([[0.5], [0.05]])
        assert heard.shape == low.shape
        assert float((heard - expected)[:, 400:-400].norm() / expected.norm()) < 1e-3
    # and as the teacher of a training or of prepared instances
    assert torch.equal(Teacher(16000, reference=half)(speech, ears), half(speech, ears, 16000))
    assert pickle.loads(pickle.dumps(half)) is half


def test_another_source_or_weights_are_another_teacher(write: Write) -> None:
    first, same, other = (
        load_teacher(f"{write(text)}:ready") for text in (HALF, HALF, HALF + "# changed")
    )
    assert first.digest == same.digest != other.digest
    assert len(first.digest) == 64 and first.digest[:12] in str(first)
    weights = write(HALF.replace("torch.tensor(0.5)", "torch.rand(())"))
    torch.manual_seed(1)
    drawn = load_teacher(f"{weights}:Quieter").digest
    load_teacher.cache_clear()
    assert load_teacher(f"{weights}:Quieter").digest != drawn


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (
            "return waveform[..., 1:]",
            r"made shape \(1, 7999\) of \(1, 8000\); allowed: a real tensor of the same",
        ),
        ("return waveform.mean(0)", r"made shape \(8000,\)"),
        ("return waveform.numpy()", "made ndarray of"),
        ("return waveform + 0j", "made complex shape"),
        ("return waveform / 0", "made NaN or infinity"),
        ("return waveform.roll(80, -1)", r"delays by 5\.0 ms; allowed: time-aligned"),
        ("return waveform.roll(-80, -1)", r"delays by -5\.0 ms"),
        ("return waveform @ audiogram", r"RuntimeError: .* \(somebodys_ears_\d+\.py, line 2\)"),
    ],
)
def test_what_it_makes_is_checked_before_the_work(write: Write, body: str, said: str) -> None:
    module = write(f"def hear(waveform, audiogram):\n    {body}\n")
    with pytest.raises(ValueError, match=f"teacher {module}:hear:? {said}"):
        load_teacher(f"{module}:hear")


def test_a_silent_ear_is_allowed_and_later_faults_are_told() -> None:
    silent = ForeignTeacher(lambda waveform, audiogram: 0 * waveform, "a:b", "")
    assert not silent(torch.ones(1, 100), torch.zeros(1, 8), 16000).any()

    def fails_for_some(waveform: Tensor, audiogram: Tensor) -> Tensor:
        return waveform / (audiogram[:, :1] < 50.0)

    some = ForeignTeacher(fails_for_some, "a:b", "")
    with pytest.raises(ValueError, match="teacher a:b made NaN or infinity"):
        some(torch.ones(1, 100), torch.tensor([Audiogram.standard("N5").thresholds]), 16000)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (
            "return waveform[..., 1:]",
            r"made shape \(\d+,\) of \(\d+,\); allowed: a real tensor of the same",
        ),
        ("return waveform / 0", "made NaN or infinity"),
        ("return waveform.roll(320, -1)", r"delays by 20\.0 ms; allowed: time-aligned"),
        ("return waveform @ nobody", r"NameError: .* \(somebodys_ears_\d+\.py, line 2\)"),
    ],
)
def test_an_enhancer_is_checked_too(write: Write, body: str, said: str) -> None:
    module = write(f"def enhance(waveform, sample_rate):\n    {body}\n")
    with pytest.raises(ValueError, match=f"enhancer {module}:enhance:? {said}"):
        load_enhancer(f"{module}:enhance")


def test_an_enhancer_is_found_as_a_teacher_is(write: Write) -> None:
    text = "class Softer:\n    def __call__(self, waveform, sample_rate):\n        return waveform / sample_rate\n"
    first, other = (load_enhancer(f"{write(own)}:Softer") for own in (text, text + "# changed"))
    assert torch.equal(first(torch.ones(2, 100), 16000), torch.ones(2, 100) / 16000)
    assert first.digest != other.digest and first.digest[:12] in str(first)
    assert pickle.loads(pickle.dumps(first)) is first


def test_what_is_no_teacher_is_refused(write: Write) -> None:
    module = write(HALF)
    for name, said in (
        (f"{module}:number", "is int; allowed: a callable"),
        (f"{module}:nobody", "cannot be had .*nobody"),
        ("no_such_module_here:hear", "cannot be had .*No module named 'no_such_module_here'"),
        (
            f"{write(HALF.replace('44100', '96000'))}:ready",
            "sample rate 96000 Hz; allowed: 16000 to 48000",
        ),
        ("pyclarty", "unknown teachers pyclarty; allowed: msbg, pyclarity, package.module:name"),
    ):
        with pytest.raises(ValueError, match=said):
            find_teacher(name)
    assert find_teacher("msbg") is None
