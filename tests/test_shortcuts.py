"""The functions for a notebook give what the modules behind them give, for tensors and arrays."""

import inspect
import math

import numpy as np
import pytest
import soundfile
import torch

import hlsim
from hlsim.calibration import level_spl
from hlsim.data.bundled import EXAMPLE_FILE

SPEECH = hlsim.example_speech()[8000:24000]


@pytest.mark.parametrize("function", [hlsim.simulate, hlsim.compensate])
def test_arrays_give_arrays_with_the_values_of_tensors(function) -> None:
    result = function(SPEECH.numpy(), "n4")
    assert isinstance(result, np.ndarray)
    assert result.dtype == np.float32
    assert np.array_equal(result, function(SPEECH, "N4").numpy())


def test_simulate_is_the_exact_model_and_compensate_the_hearing_aid() -> None:
    ear = hlsim.Audiogram.standard("N4")
    aid = hlsim.load_compensator("hearing-aid")
    with torch.no_grad():
        assert torch.equal(hlsim.simulate(SPEECH, ear), hlsim.MSBG(sample_rate=16000)(SPEECH, ear))
        assert torch.equal(hlsim.compensate(SPEECH, ear), aid(SPEECH, ear))


def test_one_gain_calibrates_all_channels_of_a_file(tmp_path) -> None:
    left = SPEECH.numpy()
    stereo = np.stack([left, 0.1 * left], axis=1)
    soundfile.write(tmp_path / "stereo.wav", stereo, 44100, subtype="FLOAT")
    channels, rate = hlsim.load_audio(tmp_path / "stereo.wav", spl=70.0, sample_rate=16000)
    assert (channels.ndim, len(channels), rate) == (2, 2, 16000)
    assert float(level_spl(channels.flatten())) == pytest.approx(70.0, abs=1e-3)
    assert float(level_spl(channels[0]) - level_spl(channels[1])) == pytest.approx(20.0, abs=0.01)


def test_players_share_one_gain_and_are_saved_as_a_page(tmp_path) -> None:
    pytest.importorskip("matplotlib")
    players = hlsim.listen(original=SPEECH, soft_N4=0.1 * SPEECH.numpy())
    assert repr(players).startswith("Player(original ") and ", soft N4 " in repr(players)
    players.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "<h1>Original, soft N4</h1>" in page, "labels keep their capitals"
    assert page.count("<audio controls") == page.count("<img") == 2
    assert "hlsim-player" in players._repr_html_()


def test_info_names_the_versions_for_a_bug_report() -> None:
    assert f"torch {torch.__version__.split('+')[0]}" in hlsim.info()


def test_load_audio_can_keep_the_samples_of_the_file() -> None:
    assert float(level_spl(hlsim.example_speech())) == pytest.approx(65.0, abs=1e-3)
    samples, rate = hlsim.load_audio(EXAMPLE_FILE, spl=None)
    expected, _ = soundfile.read(EXAMPLE_FILE, dtype="float32")
    assert rate == 16000
    assert np.array_equal(samples.numpy(), expected)


def test_all_modules_and_functions_have_the_same_default_rate() -> None:
    defaults = {}
    for name in hlsim.__all__:
        value = getattr(hlsim, name)
        if callable(value):
            constructor = value.__init__ if value is hlsim.NeuroMSBG else value
            parameter = inspect.signature(constructor).parameters.get("sample_rate")
            if parameter is not None and isinstance(parameter.default, int):
                defaults[name] = parameter.default
    assert {"MSBG", "NALR", "HearingLossLoss", "NeuroMSBG", "simulate"} <= defaults.keys()
    assert set(defaults.values()) == {16000}


def test_a_stereo_file_can_be_played_beside_a_mono_one(tmp_path) -> None:
    players = hlsim.listen(stereo=torch.stack([SPEECH, 0.1 * SPEECH]), mono=SPEECH)
    left, right = (float(level_spl(SPEECH)) - drop for drop in (0.0, 20.0))
    power = (10 ** (left / 10) + 10 ** (right / 10)) / 2
    level = 10 * math.log10(power)
    assert repr(players) == f"Player(stereo {level:.0f} dB SPL, mono {left:.0f} dB SPL)"
    players.save(tmp_path / "new folder" / "players.html")
    assert (tmp_path / "new folder" / "players.html").read_text().count("<audio") == 2


def test_whole_numbers_cannot_be_played_beside_pascals() -> None:
    whole = (1000.0 * SPEECH).short()
    for samples in (whole, whole.numpy()):
        with pytest.raises(ValueError, match="divide 16-bit samples by 32768"):
            hlsim.listen(original=SPEECH, whole=samples)
