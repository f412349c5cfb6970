"""Exported gains, read by each program's grammar and applied by scipy, are those of the aid."""

import csv
import io
import re

import numpy as np
import pytest
import scipy
from numpy.typing import NDArray

from compensators import NALR, WDRC, load_compensator
from compensators.filter_bank import speech_density
from hlsim.audiogram import FREQUENCIES
from hlsim.calibration import PASCAL_SPL
from hlsim.cli.main import main
from hlsim.evaluation.fitting.gain_tables import export_gains

Array = NDArray[np.float64]

TOLERANCE_DB = 0.5


def speech_noise(rate: int, level: float) -> Array:
    """One second of noise in pascals with the spectrum of average speech up to 8 kHz."""
    density = np.zeros(rate // 2 + 1)
    density[1:8001] = speech_density(16000)
    phases = np.random.default_rng(1).uniform(0.0, 2.0 * np.pi, len(density))
    noise = np.fft.irfft(np.sqrt(density) * np.exp(1j * phases))
    return noise * 10.0 ** ((level - PASCAL_SPL) / 20.0) / np.sqrt(np.mean(noise**2))


def band_gains(noise: Array, output: Array) -> Array:
    """Gain in dB in the third of an octave around each frequency of an audiogram."""
    powers = [np.abs(np.fft.rfft(signal)) ** 2 for signal in (noise, output)]
    hertz = np.arange(len(powers[0]))
    gains = []
    for centre in FREQUENCIES:
        band = (hertz > centre * 2 ** (-1 / 6)) & (hertz < min(centre * 2 ** (1 / 6), 8000.5))
        gains.append(10.0 * np.log10(powers[1][band].sum() / powers[0][band].sum()))
    return np.array(gains)


def filter_periodic(noise: Array, taps: Array) -> Array:
    """Filter noise that repeats, and return one period."""
    return scipy.signal.oaconvolve(np.tile(noise, 2), taps)[len(noise) : 2 * len(noise)]


def apply_csv(text: str, level: float) -> Array:
    rows = csv.DictReader(io.StringIO(text))
    return np.array([float(row[f"gain_db_at_{level:g}"]) for row in rows])


def apply_equalizer_apo(text: str, level: float) -> Array:
    (line,) = [line for line in text.splitlines() if not line.startswith("#")]
    command, pairs = line.split(": ")
    assert command == "GraphicEQ"
    numbers = np.array([re.fullmatch(r"(\S+) (\S+)", pair).groups() for pair in pairs.split("; ")])
    hertz, gains = numbers.astype(float).T
    grid = np.arange(8001.0)
    wanted = np.interp(np.log(grid.clip(1)), np.log(hertz), gains)
    taps = scipy.signal.firwin2(4095, grid, 10.0 ** (wanted / 20.0), fs=16000)
    noise = speech_noise(16000, level)
    return band_gains(noise, filter_periodic(noise, taps))


def apply_camilladsp(text: str, level: float) -> Array:
    yaml = pytest.importorskip("yaml")
    config = yaml.safe_load(text)
    (step,) = config["pipeline"]
    assert step["type"] == "Filter" and step["channels"] == [0]
    (name,) = step["names"]
    taps = config["filters"][name]
    assert taps["type"] == "Conv" and taps["parameters"]["type"] == "Values"
    noise = speech_noise(config["devices"]["samplerate"], level)
    return band_gains(noise, filter_periodic(noise, np.array(taps["parameters"]["values"])))


def apply_openmha(text: str, level: float) -> Array:
    lines = [line.split(" = ") for line in text.splitlines() if not line.startswith("#")]
    settings = dict(lines)

    def vector(key: str) -> Array:
        return np.array(settings[key].strip("[]").split(), float)

    assert settings["fftfilterbank.ftype"] == "center" and settings["dc.log_interp"] == "yes"
    rows = settings["dc.gtdata"].removeprefix("[[").removesuffix("]]").split("];[")
    table = np.array([row.split() for row in rows], float)
    levels = vector("dc.gtmin") + vector("dc.gtstep") * np.arange(table.shape[1])
    noise = speech_noise(16000, level)
    spectrum = np.fft.rfft(noise)
    distances = np.log(np.arange(len(spectrum)).clip(1))[:, None] - np.log(
        vector("fftfilterbank.f")
    )
    bands = np.abs(distances).argmin(1)
    output = np.zeros_like(spectrum)
    for band, gains in enumerate(table):
        part = np.where(bands == band, spectrum, 0.0)
        band_level = PASCAL_SPL + 10.0 * np.log10(np.mean(np.fft.irfft(part) ** 2))
        output += part * 10.0 ** (np.interp(band_level, levels, gains) / 20.0)
    return band_gains(noise, np.fft.irfft(output))


APPLY = {
    "csv": apply_csv,
    "equalizer-apo": apply_equalizer_apo,
    "camilladsp": apply_camilladsp,
    "openmha": apply_openmha,
}


@pytest.mark.parametrize(
    ("program", "ear"), [*((program, "N3") for program in APPLY), ("openmha", "S2")]
)
def test_the_program_amplifies_as_the_aid_does(program: str, ear: str) -> None:
    aid = WDRC()
    text = ""
    for level in (50.0, 65.0, 80.0):
        if not text or program in ("equalizer-apo", "camilladsp"):
            one_level = {"level": level} if program in ("equalizer-apo", "camilladsp") else {}
            text = export_gains(aid, ear, program, **one_level)
        error = APPLY[program](text, level) - aid.gains(ear, level).double().numpy()
        assert np.abs(error).max() < TOLERANCE_DB


def test_steep_gains_of_the_trained_aid_are_those_of_the_equaliser() -> None:
    aid = load_compensator("hearing-aid")
    text = export_gains(aid, "S1", "equalizer-apo", 50.0)
    error = apply_equalizer_apo(text, 50.0) - aid.gains("S1", 50.0).double().numpy()
    assert np.abs(error).max() < TOLERANCE_DB


@pytest.mark.parametrize("rate", [16000, 96000, 192000])
def test_low_frequencies_have_their_gain_at_every_sample_rate(rate: int) -> None:
    aid = load_compensator("nalr")
    text = export_gains(aid, "S3", "camilladsp", sample_rate=rate)
    error = apply_camilladsp(text, 65.0) - aid.gains("S3", 65.0).double().numpy()
    assert np.abs(error).max() < TOLERANCE_DB


def test_command_prints_or_writes_the_text(
    tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export-gains", *"--audiogram N3 --compensator nalr --to equalizer-apo".split()]
    assert main(command) == 0
    printed = capsys.readouterr().out
    assert main([*command, "--out", f"{tmp_path}/aid.txt"]) == 0
    with open(f"{tmp_path}/aid.txt") as file:
        assert (
            file.read() == printed == export_gains(load_compensator("nalr"), "N3", "equalizer-apo")
        )


def test_other_formats_several_ears_and_low_rates_are_refused() -> None:
    with pytest.raises(ValueError, match="no format 'pdf'; expected one of camilladsp, "):
        export_gains(WDRC(), "N3", "pdf")
    with pytest.raises(ValueError, match="expected one ear, got a list of 2"):
        export_gains(WDRC(), ["N3", "N4"], "csv")
    for rate in (8000, 44100.5):
        with pytest.raises(ValueError, match="sample_rate to be a whole number from 16000"):
            export_gains(WDRC(), "N3", "camilladsp", sample_rate=rate)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="level to be a number from 0 to 120, got 130"):
        export_gains(NALR(), "N3", "equalizer-apo", level=130.0)


@pytest.mark.parametrize(
    ("program", "option"),
    [
        ("csv", "--level"),
        ("openmha", "--level"),
        ("csv", "--sample-rate"),
        ("equalizer-apo", "--sample-rate"),
    ],
)
def test_an_option_without_effect_is_refused(
    program: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export-gains", "--audiogram", "N3", "--compensator", "nalr", "--to", program]
    assert main([*command, option, "80" if option == "--level" else "44100"]) == 2
    assert f"({option}) has no effect on the format {program}" in capsys.readouterr().err
