"""HASQI in torch against pyclarity and stage by stage, its batches and its gradient."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.signal import resample_poly
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.metrics.ear import clean_speech, fine_structure
from hlsim.metrics.ear import model as ear_model
from hlsim.metrics.hasqi_score import HasqiReference, hasqi
from hlsim.metrics.quality import _nalr_taps, scale_motion_to_level
from tests import pyclarity as reference
from tests.pyclarity import PyclarityOutputs

N1, N3, N6 = (Audiogram.standard(name) for name in ("N1", "N3", "N6"))


@pytest.fixture(scope="module")
def clean(speech_dir: Path) -> Tensor:
    """Two clips of 0.8 s at 16 kHz, 68 dB SPL, (2, time)."""
    clips = [
        read_audio(speech_dir / "valid" / f"flite-rms-0{i}.flac")[0][0, 8000:20800] for i in (3, 4)
    ]
    return torch.stack(clips)


@pytest.fixture(scope="module")
def noisy(clean: Tensor) -> Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(1))
    return clean + 0.3 * noise * clean.square().mean(-1, keepdim=True).sqrt()


@pytest.mark.parametrize(
    ("ear", "rate", "gain"), [(N1, 16000, 1.0), (N3, 48000, 5.0), (N3, 44100, 0.5)]
)
def test_equals_pyclarity_under_its_seed(
    clean: Tensor,
    noisy: Tensor,
    pyclarity: PyclarityOutputs,
    ear: Audiogram,
    rate: int,
    gain: float,
) -> None:
    x, y = (
        torch.from_numpy(resample_poly(signal[0].double().numpy(), rate // 100, 160))
        for signal in (clean, gain * noisy)
    )
    wanted = pyclarity(f"hasqi, {rate} Hz", reference.hasqi, x.numpy(), y.numpy(), ear, rate, 7)
    for dtype, error in ((torch.float64, 1e-7), (torch.float32, 1e-4)):
        prepared = HasqiReference(x.to(dtype), ear, sample_rate=rate, whole_khz=True)
        found = prepared.parts(y.to(dtype), noise="seeded", seed=7)
        assert [float(part) for part in found] == pytest.approx(wanted.tolist(), abs=error)
    expected = float(hasqi(y, x, ear, sample_rate=rate, whole_khz=True))
    assert expected == pytest.approx(float(wanted[0]), abs=2e-3)


@pytest.mark.parametrize("name", ["NH", "N3", "N6"])
def test_nalr_is_pyclaritys(name: str) -> None:
    clarity = pytest.importorskip("clarity.enhancer.nalr")
    ear = Audiogram.standard(name)
    wanted, _ = clarity.NALR(140, 24000).build(ear.to_clarity())
    np.testing.assert_allclose(
        _nalr_taps(torch.tensor(ear.thresholds, dtype=torch.float64)), wanted, rtol=0, atol=1e-12
    )


@pytest.mark.parametrize("time", [9000, 9100, 9216])
def test_segments_stage_by_stage(time: int) -> None:
    eb = pytest.importorskip("clarity.evaluator.haspi.eb")
    random = np.random.RandomState(0)
    x, y = (20.0 * np.abs(random.standard_normal((32, time))) for _ in range(2))
    y[:, :3000] = x[:, 5:3005]
    y[3] = 0.0
    a, b = torch.from_numpy(x)[None], torch.from_numpy(y)[None]
    extent = ear_model.Extent((time,))
    counts = fine_structure.segments_of(extent)
    means = fine_structure.smooth_levels(a, extent)[0]
    np.testing.assert_allclose(means.numpy(), eb.env_smooth(x, 16, 24000.0), rtol=1e-12)
    wanted = eb.bm_covary(x, y, 16, 24000.0)
    spectra = [fine_structure.segment_spectra(one, extent) for one in (a, b)]
    both = fine_structure.coherence(*spectra, counts)
    np.testing.assert_allclose(both[0].numpy(), wanted[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(spectra[0][1][0].numpy(), wanted[1], rtol=1e-10)
    sync = float(fine_structure.synchrony(both, spectra[0][1], counts))
    assert sync == pytest.approx(eb.ave_covary2(wanted[0], wanted[1], 2.5)[1][4], abs=1e-12)
    smooth = [eb.env_smooth(one, 16, 24000.0) for one in (x, y)]
    mean, _ = eb.mel_cepstrum_correlation(*smooth, 2.5, 0.0)
    levels = [torch.from_numpy(one)[None] for one in smooth]
    ours = fine_structure.envelope_correlation(*levels, counts)
    assert float(ours) == pytest.approx(mean, abs=1e-12)


def test_motion_where_the_envelopes_shift_leaves_nothing() -> None:
    motion, power, levels = (
        torch.tensor([4.0, 4.0, 4.0]),
        torch.tensor([0.0, 0.5, 100.0]),
        torch.tensor([0.0, 0.0, 20.0]),
    )
    assert scale_motion_to_level(motion, power, levels, 0.25).tolist() == [
        1.0,
        0.0,
        pytest.approx(8.0),
    ]


def test_a_batch_is_its_items(
    clean: Tensor, noisy: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y, ends, ears = clean.double(), noisy.double(), [12800, 11300], [N1, N3]
    for noise in ("seeded", "none"):
        alone = [hasqi(y[i, :n], x[i, :n], ears[i], noise=noise) for i, n in enumerate(ends)]
        together = hasqi(y, x, ears, lengths=ends, noise=noise)
        torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-13)
    assert torch.equal(HasqiReference(x, ears, lengths=ends).score(y, noise="none"), together)
    # as on a GPU
    monkeypatch.setattr(clean_speech.CleanSpeech, "_batch_slices", lambda self, n: [slice(0, n)])
    monkeypatch.setattr(ear_model, "_shift_rows", ear_model._gather_rows)
    torch.testing.assert_close(
        hasqi(y, x, ears, lengths=ends, noise="none"), together, rtol=0, atol=1e-13
    )


def test_gradient_is_that_of_finite_differences(clean: Tensor, noisy: Tensor) -> None:
    prepared = HasqiReference(clean[0].double(), N1)
    given = noisy[0].double().requires_grad_()
    (gradient,) = torch.autograd.grad(prepared.score(given), given)
    step = 1e-5
    with torch.no_grad():
        ends = [float(prepared.score(given * (1.0 + sign * step))) for sign in (1.0, -1.0)]
    assert float((gradient * given.detach()).sum()) == pytest.approx(
        (ends[0] - ends[1]) / (2 * step), rel=0.01
    )


@pytest.mark.parametrize("given", ["silence", "equal", "inaudible", "loud"])
def test_gradient_is_finite(clean: Tensor, given: str) -> None:
    gain = {"silence": 0.0, "equal": 1.0, "inaudible": 1e-4, "loud": 1e3}[given]
    for ear in (Audiogram.standard("NH"), N6):
        for noise in ("expected", "none"):
            y = (gain * clean[0]).requires_grad_()
            score = hasqi(y, clean[0], ear, noise=noise)
            score.backward()
            assert 0.0 <= float(score.detach()) <= 1.0
            assert y.grad is not None and bool(y.grad.isfinite().all())


@pytest.mark.parametrize(
    ("samples", "audiogram", "noise"),
    [
        (5000, N3, "expected"),
        (12800, torch.full((8,), -20.0), "expected"),
        (12800, N3, "pink"),
    ],
)
def test_bad_input_raises_value_error(
    clean: Tensor, samples: int, audiogram: Audiogram | Tensor, noise: str
) -> None:
    signal = clean[0, :samples]
    with pytest.raises(ValueError):
        hasqi(signal, signal, audiogram, noise=noise)
