"""What noise reduction could bring in the hearing aid's direct path, had it the true noise: the most to hope for.

    python examples/true_gains.py speech/valid noise/valid audiograms/valid.csv [COMPENSATOR]

24 items of 3 s at 65 dB SPL, 0 to 15 dB SNR, measured ears. Gains are a share of the dB of Wiener's, from the powers of
speech and noise in the aid's own frames, at single frequencies or in its 20 bands, with its amplification and its timing.
Prints HASPI at the level that the clean speech is given, under and over 8 dB SNR, beside the aid itself.
"""

import sys

import torch
from torch import Tensor
from torch.nn import functional

from compensators import HearingAid, load_compensator
from compensators.bands import DELAY, FRAME, HISTORY, HOP, LONG_FRAME, frame_power, shares, spread
from compensators.filters import apply_filters, filter_taps
from examples.noise_reduction import LEVEL, RATE, SECONDS
from hlsim.audiogram import read_audiograms
from hlsim.calibration import level_spl, set_level
from hlsim.data.augment import mix
from hlsim.data.clips import Clips
from hlsim.metrics import haspi

ITEMS, QUIET = 24, 1e-12


def true_gains(clean: Tensor, noise: Tensor, share: float, most: float, bands: int | None) -> Tensor:
    """Shape: (items, HISTORY + hops * HOP) twice -> (items, hops, LONG_FRAME / 2 + 1) dB."""
    speech, other = (frame_power(some, FRAME if bands else LONG_FRAME) + QUIET for some in (clean, noise))
    if bands:
        speech, other = (some @ torch.from_numpy(shares(bands, FRAME)).to(some) for some in (speech, other))
    gains = (share * 10.0 * torch.log10(speech / (speech + other))).clamp_min(-most)
    return spread(gains) if bands else gains


def given(aid: HearingAid, signal: Tensor, ears: Tensor, reduction: Tensor) -> Tensor:
    """The aid's output with other gains in place of its noise reduction's. Shape: as ``true_gains`` -> (items, time)."""
    _, fitted, sliders = aid.prepare(signal, ears, (0.0, 1.0))
    state = aid.initial(sliders)
    powers, fine = (frame_power(signal, points) for points in (FRAME, LONG_FRAME))
    gains, _ = aid.control(powers, fine, fitted, sliders.unsqueeze(1).expand(-1, powers.shape[1], -1), state)
    taps = torch.cat((state["filters"], filter_taps(gains + reduction)), 1)[:, :-1]
    return aid.finish(apply_filters(signal, taps))


def main(speech: str, noise: str, audiograms: str, name: str = "hearing-aid") -> None:
    aid, generator = load_compensator(name), torch.Generator().manual_seed(0)
    if not isinstance(aid, HearingAid):
        sys.exit(f"{name} is no hearing aid")
    clean = set_level(Clips(speech, sample_rate=RATE, seconds=SECONDS).draw(ITEMS, generator), LEVEL)
    noises = Clips(noise, sample_rate=RATE, seconds=SECONDS, repeat=True).draw(ITEMS, generator)
    snr = torch.tensor([0.0, 5.0, 10.0, 15.0])[torch.arange(ITEMS) % 4]
    signal = mix(clean, noises, snr)
    measured = [ear.thresholds for _, ear in read_audiograms(audiograms, simulated=True)]
    ears = torch.tensor([measured[i % len(measured)] for i in range(ITEMS)])
    level = level_spl(aid(clean, ears, 0.0))
    end = DELAY + -(clean.shape[-1] + DELAY) % HOP
    padded, alone, added = (functional.pad(some, (HISTORY, end)) for some in (signal, clean, signal - clean))
    outputs = {"none": aid(signal, ears, 0.0), "the aid's own": aid(signal, ears)}
    for bands in (20, None):
        for share, most in ((0.6, 12.0), (0.8, 18.0), (1.0, 30.0)):
            gains = true_gains(alone, added, share, most, bands)
            where = f"{bands} bands" if bands else "31.25 Hz apart"
            late = given(aid, padded, ears, gains)
            outputs[f"true, {where}, {share:g} of the dB, {most:g} dB at most"] = late[
                :, DELAY : DELAY + clean.shape[-1]
            ]
    print("| noise reduction | HASPI | under 8 dB | over 8 dB |\n|---|---|---|---|")
    for title, output in outputs.items():
        scores = haspi(set_level(output, level), clean, ears)
        means = (float(some.mean()) for some in (scores, scores[snr < 8.0], scores[snr > 8.0]))
        print(f"| {title} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |")


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
