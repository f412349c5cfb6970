"""Random sounds that are not speech: steady tones and clicks.

Speech and noise fluctuate. A simulator that has learned from them alone has errors of several dB on
steady tones and on clicks.
"""

import math

import torch
from torch import Tensor

from hlsim.calibration import NEURO_RATE
from hlsim.checks import check_number
from hlsim.data.augment import draw_uniform

_LOWEST_TONE, _HIGHEST_TONE = 100.0, 7500.0  # in Hz
_MAX_TONES = 4
_MAX_CLICKS = 8
_RISE_SECONDS = 0.01


def draw_sounds(items: int, samples: int, generator: torch.Generator) -> Tensor:
    """Draw sounds at 16 kHz that are not speech, without a calibrated level.

    Items 0, 2, 4 and so on have one to four steady tones, 100 to 7500 Hz, which begin together at a
    random time, in the first half of the item or before the item, and rise over 10 ms. (If no tone
    began before the item, a network would learn that a tone always follows silence.) The other
    items have one to eight clicks of one sample. A single item has either, at random.

    The frequency of about half of the tones is a multiple of 250 Hz, as in audiometry. Such a tone
    has a whole number of periods in 4 or 8 ms, so that it has the same phase in every frame of a
    Fourier transform with this hop. A tone of random frequency does not.

    Args:
        items: Number of sounds.
        samples: Length of each sound in samples.
        generator: Source of the random numbers.

    Returns:
        Sounds with shape (items, samples).

    Raises:
        ValueError: A number is not whole, there are fewer than 0 items, or there are no samples.

    >>> draw_sounds(4, 16000, torch.Generator()).shape
    torch.Size([4, 16000])
    """

    check_number("items", items, 0, whole=True)
    check_number("samples", samples, 1, whole=True)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return draw_uniform(low, high, (items, *shape), generator)

    # Square roots of frequencies are equally likely, which makes high tones frequent.
    hertz = uniform(math.sqrt(_LOWEST_TONE), math.sqrt(_HIGHEST_TONE), _MAX_TONES).square()
    is_multiple = uniform(0.0, 1.0, _MAX_TONES) < 0.5
    hertz = torch.where(is_multiple, 250.0 * (hertz / 250.0).ceil(), hertz)
    levels_db = uniform(-40.0, 0.0, _MAX_TONES)
    is_absent = uniform(0.0, 1.0, _MAX_TONES - 1) < 0.75
    levels_db[:, 1:][is_absent] = -math.inf
    amplitudes = 10.0 ** (levels_db / 20.0)
    time = torch.arange(samples)
    # In single precision, the rounding errors of the phase would be noise 50 dB below the tone.
    start_periods = uniform(0.0, 1.0, _MAX_TONES).unsqueeze(-1)
    periods = start_periods + hertz.double().unsqueeze(-1) * time / NEURO_RATE
    tones = amplitudes.unsqueeze(-1) * torch.sin(2.0 * math.pi * periods).float()
    starts = uniform(-0.5 * samples, 0.5 * samples, 1)
    rise = ((time - starts) / (_RISE_SECONDS * NEURO_RATE)).clamp(0.0, 1.0)

    positions = (uniform(0.0, 1.0, _MAX_CLICKS) * samples).long().clamp_max(samples - 1)
    heights = uniform(-1.0, 1.0, _MAX_CLICKS)
    heights[:, 0] = 1.0
    is_absent = uniform(0.0, 1.0, _MAX_CLICKS - 1) < 0.5
    heights[:, 1:][is_absent] = 0.0
    clicks = torch.zeros(items, samples).scatter_add_(1, positions, heights)
    first_item = torch.randint(2, (1,), generator=generator) if items == 1 else 0
    has_tones = ((first_item + torch.arange(items)) % 2 == 0).unsqueeze(-1)
    return torch.where(has_tones, tones.sum(1) * rise, clicks)
