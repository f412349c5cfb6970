"""Spectral smearing against pyclarity's, sample for sample."""

import numpy as np
import pytest
import torch

from hlsim.msbg.ear import MSBG_RATE
from hlsim.msbg.smearing import (
    BROADENING,
    FFT,
    FRAME,
    HOP,
    SMEARING_DELAY,
    roex_filters,
    smear,
    smearing_matrix,
    smearing_matrix_below,
)

clarity = pytest.importorskip("clarity.evaluator.msbg.smearing")
cochlea = pytest.importorskip("clarity.evaluator.msbg.cochlea")

LENGTHS = [1, 63, 64, 65, 192, 255, 256, 257, 300, 320, 384, 1000, 3008, 3009, 3071]


def test_broadening_is_the_references() -> None:
    theirs = {name.lower(): value["smear_params"] for name, value in cochlea.HL_PARAMS.items()}
    assert theirs.pop("nothing") == (1.0, 1.0)
    assert theirs == BROADENING


@pytest.mark.parametrize("sides", [(1.0, 1.0), *BROADENING.values()])
def test_auditory_filters(sides: tuple[float, float]) -> None:
    ours = roex_filters(*sides, FFT // 2, MSBG_RATE / FFT)
    np.testing.assert_allclose(ours, clarity.audfilt(*sides, 44100.0, 256), rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("severity", BROADENING)
def test_matrix(severity: str) -> None:
    theirs = clarity.make_smear_mat3(*BROADENING[severity], 44100.0)
    np.testing.assert_allclose(smearing_matrix(*BROADENING[severity]), theirs, atol=1e-9)


@pytest.mark.parametrize("severity", BROADENING)
@pytest.mark.parametrize("length", LENGTHS)
def test_smearing_sample_for_sample(severity: str, length: int) -> None:
    noise = np.random.default_rng(length).standard_normal(length)
    matrix = smearing_matrix(*BROADENING[severity])
    # the reference takes no fewer samples than one frame
    theirs = clarity.smear3(matrix, np.pad(noise, (0, max(0, 256 - length))))
    ours = smear(torch.from_numpy(noise), torch.from_numpy(matrix)).numpy()
    assert len(ours) == HOP * (-(-length // HOP) + 3)
    if length >= 256:
        assert len(theirs) == len(ours)
        np.testing.assert_allclose(ours, theirs, atol=1e-10)
    else:
        # it goes on over the zeros we padded with; the first hops are the same
        whole = HOP * -(-length // HOP)
        np.testing.assert_allclose(ours[:whole], theirs[:whole], atol=1e-10)


@pytest.mark.parametrize("severity", BROADENING)
@pytest.mark.parametrize("highest", [8000.0, 9000.0])
def test_frequencies_above_the_highest_of_interest_need_not_be_smeared(
    severity: str, highest: float
) -> None:
    spectrum = torch.fft.rfft(torch.randn(32 * 400, dtype=torch.float64))
    spectrum[round(highest / (MSBG_RATE / 2) * 32 * 400) :] = 0.0
    noise = torch.fft.irfft(spectrum)
    matrices = (
        smearing_matrix(*BROADENING[severity])[:128, :128],
        smearing_matrix_below(severity, 2, highest),
    )
    assert len(matrices[1]) < 128
    whole, part = (torch.fft.rfft(smear(noise, torch.from_numpy(matrix), 2)) for matrix in matrices)
    below = slice(round(highest / (MSBG_RATE / 2) * HOP * (32 * 400 // HOP + 3)))
    assert (whole - part)[below].norm() < 1e-3 * whole[below].norm()


def test_leading_dimensions_are_items() -> None:
    waves = torch.randn(2, 3, 700, dtype=torch.float64)
    matrix = torch.from_numpy(smearing_matrix(*BROADENING["mild"]))
    together = smear(waves, matrix)
    for i in range(2):
        for j in range(3):
            torch.testing.assert_close(together[i, j], smear(waves[i, j], matrix))


def test_an_identity_delays_by_three_hops() -> None:
    wave = torch.randn(2000, dtype=torch.float64)
    # the analysis loses the bin at the Nyquist frequency
    wave = torch.fft.irfft(torch.fft.rfft(wave) * (torch.arange(1001) < 900), 2000)
    out = smear(wave, torch.eye(256, dtype=torch.float64))
    steady = slice(4 * HOP, 1700)
    torch.testing.assert_close(
        out[steady.start + SMEARING_DELAY : steady.stop + SMEARING_DELAY],
        wave[steady],
        atol=1e-3,
        rtol=0,
    )


def test_smearing_is_homogeneous() -> None:
    wave = torch.randn(900, dtype=torch.float64)
    matrix = torch.from_numpy(smearing_matrix(*BROADENING["severe"]))
    torch.testing.assert_close(
        smear(1e-3 * wave, matrix), 1e-3 * smear(wave, matrix), atol=1e-12, rtol=1e-9
    )


@pytest.mark.parametrize("severity", BROADENING)
def test_gradients(severity: str) -> None:
    wave = torch.randn(1, 320, dtype=torch.float64, requires_grad=True)
    matrix = torch.from_numpy(smearing_matrix(*BROADENING[severity]))
    assert torch.autograd.gradcheck(lambda w: smear(w, matrix), wave, fast_mode=True)
    assert torch.autograd.gradgradcheck(lambda w: smear(w, matrix), wave, fast_mode=True)


def test_gradients_of_silence_are_those_of_no_smearing() -> None:
    """A model whose output is still 0 learns to make it louder."""
    wave = torch.zeros(2000, requires_grad=True)
    out = smear(wave, torch.from_numpy(smearing_matrix(*BROADENING["severe"])).float())
    assert not bool(out.any())
    spectrum = torch.fft.rfft(torch.randn_like(out))
    spectrum[len(spectrum) * 98 // 100 :] = 0.0  # frames leave their highest frequency out
    weights = torch.fft.irfft(spectrum)
    (gradient,) = torch.autograd.grad(out, wave, weights)
    kept = slice(2 * FRAME, 2000 - 2 * FRAME)
    delayed = weights[SMEARING_DELAY : SMEARING_DELAY + 2000]
    torch.testing.assert_close(gradient[kept], delayed[kept], atol=0.02, rtol=0.0)
