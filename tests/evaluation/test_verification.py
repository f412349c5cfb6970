"""An aid is verified from two recordings: gains, targets and the audible share of speech."""

from pathlib import Path

import numpy as np
import pytest
import torch

import hlsim
from compensators import NALR, WDRC, load_compensator
from compensators.filter_bank import SPEECH_SPECTRUM, speech_density
from hlsim.audio import write_audio
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.calibration import set_level
from hlsim.cli.main import main
from hlsim.data.bundled import SPEECH
from hlsim.evaluation.fitting.verification import prescribed_gains, section_powers, verify
from hlsim.metrics.sii import INTERNAL_NOISE, SII_BANDS, sii

RATE = 16000

# Example C.2 of ANSI S3.5-1997; a report of the package phonometry states its SII.
EXAMPLE_SPEECH = [54.0] * 18
EXAMPLE_NOISE = [40.0, 30.0, 20.0] + [0.0] * 15


@pytest.fixture(scope="module")
def steady_noise() -> torch.Tensor:
    """Noise with the spectrum of average speech, which repeats every 125 ms. Shape: (2000,)."""
    spectrum = np.zeros(1001, dtype=complex)
    phases = np.random.default_rng(0).uniform(0.0, 2.0 * np.pi, 1000)
    spectrum[1:] = np.sqrt(speech_density(2000)) * np.exp(1j * phases)
    return torch.from_numpy(np.fft.irfft(spectrum))


def test_sii_is_that_of_a_published_example() -> None:
    assert sii(EXAMPLE_SPEECH, EXAMPLE_NOISE) == pytest.approx(0.851, abs=0.001)


def test_sii_loses_what_is_below_the_threshold() -> None:
    noise = np.array(INTERNAL_NOISE)
    # Speech 15 dB above the internal noise is wholly audible, 15 dB below it not at all.
    assert sii(noise + 15.0) == pytest.approx(1.0, abs=0.02)
    assert sii(noise + 15.0, thresholds=[15.0] * 18) == pytest.approx(0.5, abs=0.02)
    assert sii(noise + 15.0, thresholds=[31.0] * 18) == 0.0
    with pytest.raises(ValueError, match="expected 18 levels"):
        sii([50.0] * 6)


def test_the_power_of_white_noise_in_a_band_is_its_share_of_the_spectrum() -> None:
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(20 * RATE))
    shares = np.array(SII_BANDS) * (2 ** (1 / 6) - 2 ** (-1 / 6)) / (RATE / 2)
    powers = section_powers(noise, RATE).mean(0)
    # The power of 20 s of noise has a standard deviation of up to 0.16 dB.
    assert np.abs(10.0 * np.log10(powers / shares)).max() < 0.5


def test_gains_are_those_of_a_known_compressor_at_three_levels(steady_noise: torch.Tensor) -> None:
    aid = WDRC("N3")
    # 45 % of the time at 50, 35 % at 65 and 20 % at 80 dB SPL: the percentiles 30, 65 and 99.
    levels = torch.tensor([50.0] * 9 + [65.0] * 7 + [80.0] * 4)
    seconds = set_level(steady_noise.repeat(8).repeat(20, 1), levels)
    speech = seconds.flatten()
    result = verify(speech, aid(speech), "N3", RATE, prescription="wdrc")
    at_audiogram = [SII_BANDS.index(hertz) for hertz in (250, 500, 1000, 2000, 3150, 4000, 6300)]
    for gains, level in zip(result.gains, (50.0, 65.0, 80.0), strict=True):
        expected = aid.gains(level=level).numpy()
        expected = np.interp(np.log(SII_BANDS), np.log(FREQUENCIES), expected)
        assert np.abs(gains - expected)[at_audiogram].max() < 1.0
    # The same compressor as a prescription has these gains as its targets, one per percentile.
    assert np.abs(result.gains - result.targets)[:, at_audiogram].max() < 1.0
    assert (result.targets[0] - result.targets[2])[at_audiogram].min() > 3.0


def test_the_target_of_a_band_is_the_gain_at_its_own_level() -> None:
    aid = WDRC()
    audiogram = hlsim.Audiogram.standard("N3")
    # Average speech at 70 dB SPL, of which the bands from 3150 Hz on are 20 dB louder.
    louder = np.array([SPEECH_SPECTRUM[band] + 20.0 * (band > 2500) for band in SII_BANDS])
    targets = prescribed_gains(aid, audiogram, louder)
    for hertz, level in ((500, 70.0), (4000, 90.0)):
        expected = aid.gains(audiogram, level)[FREQUENCIES.index(hertz)]
        assert targets[SII_BANDS.index(hertz)] == pytest.approx(float(expected), abs=0.1)


def test_targets_thresholds_and_scale() -> None:
    speech = hlsim.example_speech()
    result = verify(speech, NALR("N3")(speech), "N3", RATE)
    assert np.ptp(result.targets, axis=0).max() < 1e-6  # a linear prescription
    upper = slice(SII_BANDS.index(1000), None)
    assert np.abs(result.gains - result.targets)[:, upper].max() < 1.0
    assert 0.0 < result.unaided_sii < result.aided_sii < 1.0
    assert (result.thresholds < result.uncomfortable).all()
    # 1 kHz: 40 dB HL is 40 dB above the 2.4 dB SPL of ISO 389-7.
    assert result.thresholds[SII_BANDS.index(1000)] == pytest.approx(42.4, abs=0.1)
    measured = Audiogram(Audiogram.standard("N3").to_dict()["levels"], ucl={1000: 90.0})
    by_measurement = verify(speech, speech, measured, RATE).uncomfortable
    assert by_measurement[SII_BANDS.index(1000)] == pytest.approx(92.4, abs=0.1)
    louder = verify(0.1 * speech, 0.1 * speech, "N3", RATE, full_scale_spl=114.0)
    assert louder.input_levels == pytest.approx(result.input_levels, abs=0.01)
    assert louder.aided_sii == pytest.approx(result.unaided_sii, abs=1e-4)


@pytest.mark.parametrize("lag", [-6000, 12000])
def test_gains_do_not_depend_on_silence_and_delay(lag: int) -> None:
    speech = hlsim.example_speech().double()
    output = NALR("N3")(speech)
    delayed = torch.nn.functional.pad(output, (lag, 0))  # cut if negative
    aligned, other = (verify(speech, sound, "N3", RATE) for sound in (output, delayed))
    # Valleys seemed to lose 4 dB and more; what remains is the part that one recording lacks.
    assert np.abs(other.gains - aligned.gains).max() < 1.0
    late = torch.nn.functional.pad(output, (17000, 0))[: len(speech)]
    with pytest.raises(ValueError, match=r"output is 1\.1 s later"):
        verify(speech, late, "N3", RATE)


def test_recordings_that_do_not_belong_together_are_refused() -> None:
    speech = hlsim.example_speech()
    with pytest.raises(ValueError, match="differ in length by more than 1 s"):
        verify(speech, speech[:40000], "N3", RATE)
    with pytest.raises(ValueError, match="at least 1 s"):
        verify(speech[:8000], speech[:8000], "N3", RATE)
    with pytest.raises(ValueError, match="save the channel of the ear as a mono file"):
        verify(torch.stack([speech, speech]), speech, "N3", RATE)
    with pytest.raises(ValueError, match="output has samples that are NaN or infinite"):
        verify(speech, speech * torch.nan, "N3", RATE)
    with pytest.raises(ValueError, match="input_ is silent"):
        verify(torch.zeros_like(speech), speech, "N3", RATE)
    with pytest.raises(ValueError, match="output is silent"):
        verify(speech, torch.zeros_like(speech), "N3", RATE)
    other_speech = hlsim.load_audio(SPEECH / "train/flite-slt-01.flac", sample_rate=RATE)[
        0
    ].flatten()
    samples = min(len(speech), len(other_speech))
    with pytest.raises(ValueError, match=r"not similar \(correlation 0\.\d+, expected 0\.4"):
        verify(speech[:samples], other_speech[:samples], "N3", RATE)
    with pytest.raises(ValueError, match="expected input_ to be a floating-point tensor"):
        verify((1000.0 * speech).short(), speech, "N3", RATE)


@pytest.mark.parametrize("aid", ["wdrc", "compensator-general"])
def test_the_output_of_an_aid_in_noise_belongs_to_its_input(aid: str) -> None:
    speech = hlsim.example_speech()
    noise = torch.from_numpy(np.random.default_rng(0).standard_normal(len(speech))).float()
    noisy = speech + 0.03 * noise
    with torch.no_grad():
        output = load_compensator(aid)(noisy, Audiogram.standard("N6"))
    assert verify(noisy, output, "N6", RATE).gains[1, 8] > 20.0  # at 1 kHz


def test_command_prints_a_table_and_writes_it_with_a_plot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    speech = 0.1 * hlsim.example_speech()
    write_audio(tmp_path / "in.wav", speech, RATE)
    write_audio(tmp_path / "out.wav", 2.0 * speech, RATE)
    files = [str(tmp_path / name) for name in ("in.wav", "out.wav")]
    written = ["--csv", f"{tmp_path}/table.csv", "--plot", f"{tmp_path}/plot.svg"]
    assert main(["verify", *files, *"--audiogram N3 --spl 65".split(), *written]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 20 and "in 30" in lines[0] and "SII" in lines[-1]
    rows = (tmp_path / "table.csv").read_text().splitlines()
    at_1_khz = dict(zip(rows[0].split(","), rows[9].split(","), strict=True))
    expected = verify(set_level(speech, 65.0), speech, "N3", RATE)
    assert float(at_1_khz["input_65"]) == pytest.approx(expected.input_levels[1, 8], abs=0.1)
    assert at_1_khz["gain_65"] == "6.0"
    assert at_1_khz["target_30"] == at_1_khz["target_99"] == "19.6"
    plot = (tmp_path / "plot.svg").read_text()
    assert all(label in plot for label in ("uncomfortable level", "target, 30 %", "target, 99 %"))

    write_audio(tmp_path / "out.wav", torch.cat([speech] * 3)[:130000], 48000)
    assert main(["verify", *files, "--audiogram", "N3"]) == 2
    assert "expected one sample rate, got 16000 and 48000 Hz" in capsys.readouterr().err
