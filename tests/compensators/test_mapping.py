"""The mapping compensator starts as NAL-R, corrects smoothly, and keeps tones and phase."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from compensators import NALR, MappingCompensator
from hlsim import Audiogram
from hlsim.calibration import level_spl
from hlsim.data.ears import draw_thresholds
from hlsim.metrics.band_levels import band_levels
from tests.compensators.aids import EAR, SMALL, tone, varied_mapping


def bands_db(waveform: Tensor) -> Tensor:
    """Compute the level of each of 24 bands. Shape: (..., time) -> (..., 24)."""
    return 10.0 * torch.log10((10.0 ** (band_levels(waveform, 16000) / 10.0)).mean(-2))


def test_starts_as_nalr(utterance: Tensor) -> None:
    standard = torch.tensor([Audiogram.standard(name).thresholds for name in ("NH", "N2", "S2")])
    ears = torch.cat((standard, draw_thresholds(8, torch.Generator().manual_seed(1))))
    output, prescribed = MappingCompensator()(utterance, ears), NALR(ears)(utterance)
    difference = (bands_db(output) - bands_db(prescribed)).abs()
    assert difference.max() < 1.5
    assert difference[:3].max() < 1.0
    assert difference.mean() < 0.3
    assert (level_spl(output) - level_spl(prescribed)).abs().max() < 0.5
    correlation = torch.fft.rfft(output, 48000) * torch.fft.rfft(utterance, 48000).conj()
    assert not torch.fft.irfft(correlation).argmax(-1).any()  # aligned


def test_gradients_reach_every_weight_and_are_finite_for_silence(utterance: Tensor) -> None:
    for phase in ("input", "predicted"):
        model = varied_mapping(replace(SMALL, phase=phase))
        for signal in (utterance[:8000], torch.zeros(1600)):
            output = model(signal, EAR)
            gradients = torch.autograd.grad(
                output.square().sum() + output.sum(), [*model.parameters()]
            )
            assert all(gradient.isfinite().all() for gradient in gradients)


def sideband_ratio(model: MappingCompensator) -> float:
    """Compute the largest magnitude beside a tone of 1013 Hz, relative to the tone's."""
    output = model.double()(tone(1013.0, 65.0, 3.0).double(), EAR).detach()
    window = torch.hann_window(16000, dtype=torch.float64)
    spectrum = torch.fft.rfft(output[16000:32000] * window).abs()  # one frequency per Hz
    beside = torch.cat((spectrum[:1003], spectrum[1024:]))
    return float(beside.max() / spectrum[1013])


def test_a_tone_stays_a_tone_unless_the_phase_is_predicted() -> None:
    """The gain follows neither the positions of frames nor the stride of the decoder."""
    for stride in ((2, 3), (3, 3)):
        assert sideband_ratio(varied_mapping(replace(SMALL, stride=stride))) < 1e-3
    assert sideband_ratio(varied_mapping(replace(SMALL, phase="predicted"))) > 0.01


def test_the_phase_is_kept_or_predicted(utterance: Tensor) -> None:
    turns = []
    for phase in ("input", "predicted"):
        model = varied_mapping(replace(SMALL, phase=phase))
        before, after = (
            model.stft.analyse(signal[None]) for signal in (utterance, model(utterance, EAR))
        )
        is_loud = before.abs() > 0.1 * before.abs().max()
        turns.append(float((after * before.conj())[is_loud].angle().abs().mean()))
    assert turns[0] < 0.1 < 0.2 < turns[1]


@pytest.mark.parametrize("shape", [(3,), (3, 2)])
def test_several_microphones_are_filtered_and_added(
    utterance: Tensor, shape: tuple[int, ...]
) -> None:
    config = replace(SMALL, microphones=3, ears=len(shape))
    model, single = MappingCompensator(config=config), MappingCompensator(config=SMALL)
    signals = torch.stack((utterance[:8000], *torch.zeros(2, 8000)))
    ears: list[str] | str = "N3"
    if len(shape) == 2:
        signals, ears = torch.stack((signals, 0.1 * signals), 1), ["N3", "N4"]
    torch.testing.assert_close(model(signals, ears), single(signals[0], ears))
    assert model.weight_decoder is not None
    with torch.no_grad():
        model.weight_decoder.leave.bias.unflatten(0, (4, -1))[0] = -1.0
    assert float(model(signals[:1].expand(*shape, -1), ears).detach().abs().max()) < 1e-6
    with pytest.raises(ValueError, match=r"3 microphones per ear, .* the reference first"):
        model(signals[:2], ears)
    with pytest.warns(UserWarning, match="microphones are measured with the same signal") as record:
        model.gains("N3")
    assert record[0].filename == __file__
