"""Fixed filters at the output level of `hearing-aid`, for an ear that only attenuates.

`MostAudible` is the filter that makes most of speech audible: of all filters with that output
level, it has the highest speech intelligibility index (SII), mean of quiet, 5 and 0 dB SNR.
`Mirror` amplifies each frequency by the whole hearing loss.

    python docs/figures/fixed_filters.py

prints the index of both and of NAL-R, all at the same level. As aids for the machine listener:

    python examples/machine_listener.py compare speech/valid noise/valid --model moonshine-tiny \\
        --simulator attenuation --audiograms audiograms/valid.csv --baseline nalr --out words \\
        --aids hearing-aid nalr docs/figures/fixed_filters.py:MostAudible
"""

from functools import cache

import numpy as np
import scipy.optimize
import scipy.signal
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from compensators import NALR, load_compensator
from hlsim import Audiogram, example_speech
from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.published import SII_TABLE
from hlsim.audiogram.scale import interpolate_over_log
from hlsim.calibration import level_spl, set_level
from hlsim.dsp.fir import filter_without_delay
from hlsim.metrics.sii import SII_BANDS, SILENCE, sii

RATE = 16000
TAPS = 513
SPEECH_SPL = 65.0
SNRS = (None, 5.0, 0.0)  # dB; None is quiet
HERTZ = np.array(SII_BANDS, dtype=float)
BANDWIDTHS_DB = 10.0 * np.log10(HERTZ * (2.0 ** (1 / 6) - 2.0 ** (-1 / 6)))
LARGEST_CHANGE = 30.0  # dB, from the gains of NAL-R at the same level


def power_sum(levels: NDArray[np.float64]) -> float:
    """Return the level of all bands together, in dB. Shape: (bands,)."""
    return float(10.0 * np.log10((10.0 ** (levels / 10.0)).sum()))


def speech_spectrum() -> NDArray[np.float64]:
    """Return the standard's speech at 65 dB SPL: spectrum levels in dB SPL per Hz. Shape: (18,)."""
    speech = np.array([row[1] for row in SII_TABLE.values()])
    return speech + SPEECH_SPL - power_sum(speech + BANDWIDTHS_DB)


def audible_share(gains: NDArray[np.float64], loss: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the index of amplified speech in quiet and in noise with the spectrum of speech.

    Args:
        gains: Gains in dB. Shape: (18,).
        loss: Thresholds in dB HL. Shape: (18,).

    Returns: The index at each of ``SNRS``. Shape: (3,).
    """
    # An ear that attenuates by the loss is a normal ear with softer sounds.
    perceived = speech_spectrum() + gains - loss
    quiet = np.full(len(perceived), SILENCE)
    return np.array([sii(perceived, quiet if snr is None else perceived - snr) for snr in SNRS])


def losses(ear: Audiogram) -> NDArray[np.float64]:
    """Return the thresholds in dB HL at ``SII_BANDS``. Shape: (18,)."""
    return interpolate_over_log(HERTZ, FREQUENCIES, ear.thresholds)


def nalr_gains(ear: Audiogram) -> NDArray[np.float64]:
    """Return the gains of NAL-R in dB at ``SII_BANDS``. Shape: (18,)."""
    return interpolate_over_log(HERTZ, FREQUENCIES, NALR().gains(ear).tolist())


@cache
def aid_level(ear: Audiogram) -> float:
    """Return the output level of `hearing-aid` for speech at 65 dB SPL, in dB SPL."""
    speech = set_level(example_speech(), SPEECH_SPL)
    return float(level_spl(load_compensator("hearing-aid")(speech, ear).detach()))


def at_level_of_aid(gains: NDArray[np.float64], ear: Audiogram) -> NDArray[np.float64]:
    """Shift gains in dB so that amplified speech has the level of `hearing-aid`. Shape: (18,)."""
    return gains + aid_level(ear) - power_sum(speech_spectrum() + BANDWIDTHS_DB + gains)


class FixedFilter(nn.Module):
    """A linear filter for each ear, as an aid for signals of 16 kHz."""

    def __init__(self) -> None:
        super().__init__()
        self.taps: dict[Audiogram, Tensor] = {}

    def gains(self, ear: Audiogram) -> NDArray[np.float64]:
        """Return the gains in dB at ``SII_BANDS``. Shape: (18,)."""
        raise NotImplementedError

    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        """Amplify signals. Shape: (..., time) -> the same."""
        if ear not in self.taps:
            hertz = np.linspace(0.0, RATE / 2.0, TAPS)
            gains = interpolate_over_log(hertz, HERTZ, self.gains(ear))
            taps = scipy.signal.firwin2(TAPS, hertz, 10.0 ** (gains / 20.0), fs=RATE)
            self.taps[ear] = torch.from_numpy(taps)
        return filter_without_delay(waveform, self.taps[ear].to(waveform))


class MostAudible(FixedFilter):
    """The filter with the highest index at the output level of `hearing-aid`."""

    def gains(self, ear: Audiogram) -> NDArray[np.float64]:
        loss, start = losses(ear), at_level_of_aid(nalr_gains(ear), ear)
        result = scipy.optimize.minimize(
            lambda change: -audible_share(at_level_of_aid(start + change, ear), loss).mean(),
            np.zeros(len(start)),
            method="Powell",  # the index is no smooth function of the gains
            bounds=[(-LARGEST_CHANGE, LARGEST_CHANGE)] * len(start),
        )
        return at_level_of_aid(start + result.x, ear)


class Mirror(FixedFilter):
    """The filter that amplifies by the hearing loss."""

    def gains(self, ear: Audiogram) -> NDArray[np.float64]:
        return losses(ear)


def main() -> None:
    print("| ear | filter | quiet | 5 dB | 0 dB |\n|---|---|---|---|---|")
    curves = {"NAL-R": nalr_gains, "most audible": MostAudible().gains, "mirror": Mirror().gains}
    for name in ("N2", "N3", "N4", "S2"):
        ear = Audiogram.standard(name)
        for row, gains in curves.items():
            shares = audible_share(at_level_of_aid(gains(ear), ear), losses(ear))
            print(f"| {name} | {row} | {' | '.join(f'{share:.3f}' for share in shares)} |")


if __name__ == "__main__":
    main()
