"""Players: levels in dB SPL, one gain per group, spectrograms on one scale."""

import io
import math

import pytest
import soundfile
import torch
from PIL import Image
from torch import Tensor

from hlsim.report.page import SPECTROGRAM_COLOURS, SPECTROGRAM_LEVELS
from hlsim.report.players import encode_wav, make_player, spectrogram_levels

pytest.importorskip("matplotlib")


def tone(level: float, seconds: float = 0.5) -> Tensor:
    """A tone of 1 kHz at a level in dB SPL."""
    times = torch.arange(round(seconds * 16000)) / 16000
    return math.sqrt(2.0) * 10 ** ((level - 94) / 20) * torch.sin(2 * math.pi * 1000 * times)


def samples(audio: bytes) -> Tensor:
    return torch.from_numpy(soundfile.read(io.BytesIO(audio), dtype="float32")[0])


def test_a_tone_has_its_level_in_one_bin() -> None:
    levels = spectrogram_levels(tone(80.0), 16000)
    assert float(levels[20].median()) == pytest.approx(80.0, abs=0.1)  # bins of 50 Hz
    assert float(levels[40].median()) < 20.0
    assert len(spectrogram_levels(torch.zeros(44100), 44100)) == len(levels), "both end at 8 kHz"


def test_sounds_of_a_group_have_one_gain_and_groups_are_not_louder_than_others() -> None:
    groups = {"perceived": {"a": tone(60.0), "b": tone(50.0)}, "output": {"c": tone(90.0)}}
    player = make_player(groups, 16000)
    assert list(player.groups) == ["perceived", "output, played 30 dB softer than the first row"]
    first, second, third = player.sounds
    ratio = samples(first.audio).std() / samples(second.audio).std()
    assert float(ratio) == pytest.approx(10 ** (10 / 20), rel=1e-3)
    for sound in (first, third):
        assert float(samples(sound.audio).abs().max()) == pytest.approx(0.9, abs=1e-3)
    for sound in player.sounds:
        played = 20 * float(samples(sound.audio).square().mean().log10()) / 2
        assert sound.loudness == pytest.approx(played, abs=0.01)
    assert player.full_scale == pytest.approx(63.93, abs=0.01)


def test_spectrograms_have_one_scale() -> None:
    player = make_player({"": {"loud": tone(80.0), "soft": tone(-20.0)}}, 16000)
    lowest, highest = SPECTROGRAM_LEVELS
    loud, soft = (Image.open(io.BytesIO(sound.spectrogram)) for sound in player.sounds)
    bins, frames = spectrogram_levels(tone(80.0), 16000).shape
    assert loud.size == soft.size == (frames, bins)
    row = bins - 1 - 20  # the picture begins at 8 kHz
    expected = 255 * (80.0 - lowest) / (highest - lowest)
    assert loud.getpixel((frames // 2, row)) == pytest.approx(expected, abs=1)
    assert soft.getextrema() == (0, 0)
    palette = bytes(loud.getpalette())
    ends = "".join(f"#{palette[place : place + 3].hex()} " for place in (0, 3 * 255))
    assert ends.split() == [SPECTROGRAM_COLOURS[0], SPECTROGRAM_COLOURS[-1]]


@pytest.mark.parametrize("samples", [1, 100])
def test_a_sound_shorter_than_a_window_can_be_played(samples: int) -> None:
    (sound,) = make_player({"": {"click": torch.ones(samples)}}, 16000).sounds
    assert sound.level == pytest.approx(94.0)


def test_silence_is_rejected() -> None:
    with pytest.raises(ValueError, match="silent"):
        make_player({"": {"silence": torch.zeros(1600)}}, 16000)


def test_a_black_spectrogram_says_why() -> None:
    loud = tone(60.0)
    sounds = {"loud": loud, "faint": tone(-20.0), "click": torch.zeros(8000)}
    sounds["click"][4000] = 0.05
    notes = {sound.label: sound.note for sound in make_player({"": sounds}, 16000).sounds}
    assert notes["loud"] == ""
    assert notes["faint"] == "nothing is perceived"
    page = make_player({"": {"loud": loud, "faint": tone(-20.0)}}, 16000)._repr_html_()
    assert page.count(">nothing is perceived<") == 1


def test_little_colour_is_almost_nothing() -> None:
    signal = 1e-7 * torch.ones(160000)
    signal[:800] = tone(30.0)[:800]
    (sound,) = make_player({"": {"a": signal}}, 16000).sounds
    assert sound.note == "almost nothing is perceived"


def test_an_encoded_sound_is_the_signal_to_16_bits() -> None:
    signal = torch.linspace(-1.0, 0.99, 16000)
    samples, rate = soundfile.read(io.BytesIO(encode_wav(signal, 16000)), dtype="float32")
    assert rate == 16000 and abs(samples - signal.numpy()).max() <= 2**-15
    negative = torch.view_as_complex(torch.stack((signal, signal), -1)).conj().imag
    assert negative.is_neg() and encode_wav(negative, 16000) == encode_wav(-signal, 16000)
