"""Whether a criterion finds worse what HASPI and HASQI find worse: python examples/validity.py SPEECH [NOISE]

Seventeen degradations and the clean speech, 3 s at 65 dB SPL of four talkers for the ears N2, N3 and N4, each through one
fixed equaliser: one with which the ear hears the clean speech's bands as a normal ear does, and one of half its gain in
dB. The noise has the spectrum of the speech, or is cut from recordings in NOISE.

The table tells the rank correlation of minus the loss with the scores, over the 18 signals of each pair of talker and
ear: mean, and the worst pair; in how many pairs the noise ratios are in order, and the clean speech the nearest.
"""

import statistics
import sys
from itertools import pairwise

import torch
from torch import Tensor

from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.dsp.stft import STFT
from hlsim.losses.band_levels import band_edges, band_levels
from hlsim.metrics import HaspiReference, HasqiReference
from hlsim.metrics.fidelity import rank_correlation
from hlsim.training.clips import Clips

RATE, SECONDS, SPL = 16000, 3.0, 65.0
TALKERS, EARS = 4, ("N2", "N3", "N4")
CRITERIA = ("coherent-bands", "bands", "paper")
NOISY = (
    "clean",
    "noise at 20 dB",
    "noise at 10 dB",
    "noise at 5 dB",
    "noise at 0 dB",
    "noise at -5 dB",
)
GAINS = {"heard as normal": 1.0, "half the gain": 0.5}


def filtered(speech: Tensor, gains: Tensor) -> Tensor:
    """Shape: (..., time), (time // 2 + 1,) -> (..., time)."""
    return torch.fft.irfft(torch.fft.rfft(speech) * gains, speech.shape[-1])


def degraded(speech: Tensor, noise: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """The clean speech and its seventeen degradations. Shape: (time,) and noise of the same RMS -> (time,) each."""
    time = speech.shape[-1]
    hz, peak = torch.fft.rfftfreq(time, 1.0 / RATE), float(speech.abs().max())
    signals = {"clean": speech}
    for name in NOISY[1:]:
        signals[name] = speech + noise * 10.0 ** (-float(name.split()[2]) / 20.0)
    for edge in (1000.0, 2000.0, 4000.0):
        signals[f"low-pass {edge:g} Hz"] = filtered(speech, torch.sigmoid((edge - hz) / 50.0))
    for share in (0.25, 0.1):
        signals[f"clipped at {share:g} of the peak"] = speech.clamp(-share * peak, share * peak)
    stft = STFT(512, 512, 128)
    floor = stft.analyse(noise[None]).abs().square().mean(-2, keepdim=True)
    for snr in (10.0, 0.0):  # what spectral subtraction leaves of the noise is tones
        mixed = stft.analyse((speech + noise * 10.0 ** (-snr / 20.0))[None])
        kept = (
            1.0 - 2.0 * floor * 10.0 ** (-snr / 10.0) / mixed.abs().square().clamp_min(1e-20)
        ).clamp_min(0.0)
        signals[f"musical noise, from {snr:g} dB"] = stft.synthesise(mixed * kept.sqrt(), time)[0]
    for seconds, direct_db in ((0.4, 5.0), (1.0, 0.0)):
        tail = torch.randn(time, generator=generator) * 10.0 ** (
            -3.0 * torch.arange(time) / (RATE * seconds)
        )
        wet = torch.fft.irfft(torch.fft.rfft(speech, 2 * time) * torch.fft.rfft(tail, 2 * time))[
            :time
        ]
        wet = set_level(wet, SPL - direct_db)
        signals[f"reverberation of {seconds:g} s"] = set_level(speech + wet, SPL)
    signals["a delay of 1 ms"] = filtered(speech, torch.exp(-2j * torch.pi * 0.001 * hz))
    signals["phase turned by 90 degrees"] = filtered(
        speech, torch.full_like(hz, 1j, dtype=torch.complex64)
    )
    signals["sign"] = -speech
    return signals


def equaliser(speech: Tensor, ear: Audiogram) -> Tensor:
    """Gain in dB of each frequency with which the ear hears each band's power as a normal ear does, -10 to 90.

    Shape: (time,) -> (time // 2 + 1,).
    """
    msbg, hz = MSBG(sample_rate=RATE), torch.fft.rfftfreq(speech.shape[-1], 1.0 / RATE)
    edges = torch.from_numpy(band_edges()).float()
    place = torch.bucketize(
        hz, edges[1:-1]
    )  # the bands at the ends go on to 0 Hz and to half the rate

    def heard(waveform: Tensor, audiogram: Audiogram) -> Tensor:
        powers = 10.0 ** (band_levels(msbg(waveform, audiogram), RATE) / 10.0)
        return 10.0 * torch.log10(powers.mean(-2))

    aim, gain = heard(speech, Audiogram.standard("NH")), torch.zeros(len(edges) - 1)
    for _ in range(12):  # a dB given is one to three dB heard
        given = filtered(speech, 10.0 ** (gain[place] / 20.0))
        gain = (gain + 0.4 * (aim - heard(given, ear))).clamp(-10.0, 90.0)
    return gain[place]


def judged(
    signals: dict[str, Tensor], gain_db: Tensor, ear: Audiogram, losses: dict[str, HearingLossLoss]
) -> dict[str, dict[str, Tensor]]:
    """HASPI, HASQI and each criterion of all signals through an equaliser. Returns (signals,) by name, for each."""
    clean = signals["clean"]
    given = filtered(torch.stack(list(signals.values())), 10.0 ** (gain_db / 20.0))
    intelligible, good = HaspiReference(clean), HasqiReference(clean, ear)
    found = {
        "HASPI": torch.stack([intelligible.score(one, ear) for one in given]),
        "HASQI": torch.stack([good.score(one) for one in given]),
        **{name: loss(given, clean.expand_as(given), ear) for name, loss in losses.items()},
    }
    return {name: dict(zip(signals, values, strict=True)) for name, values in found.items()}


def summary(found: dict[str, dict[str, Tensor]], criterion: str) -> tuple[float, float, bool, bool]:
    """Rank correlations with HASPI and HASQI, whether the noise ratios are in order, and the clean speech the nearest."""
    loss = found[criterion]
    nearness = -torch.stack(list(loss.values()))
    haspi, hasqi = (
        rank_correlation(nearness.numpy(), torch.stack(list(found[name].values())).numpy())
        for name in ("HASPI", "HASQI")
    )
    ordered = all(bool(loss[less] < loss[more]) for less, more in pairwise(NOISY))
    return (
        float(haspi),
        float(hasqi),
        ordered,
        min(loss, key=lambda name: float(loss[name])) == "clean",
    )


def shaped(speech: Tensor, generator: torch.Generator) -> Tensor:
    """Noise with the spectrum of speech. Shape: (time,) -> (time,)."""
    spectrum = torch.fft.rfft(speech).abs()
    smooth = torch.nn.functional.avg_pool1d(
        spectrum.square()[None], 101, 1, 50, count_include_pad=False
    )[0].sqrt()
    return filtered(torch.randn(speech.shape, generator=generator), smooth)


@torch.no_grad()
def main(folder: str, noise_folder: str | None = None) -> None:
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(0)
    clips = Clips(folder, sample_rate=RATE, seconds=SECONDS, repeat=True)
    noises = (
        Clips(noise_folder, sample_rate=RATE, seconds=SECONDS, repeat=True)
        if noise_folder
        else None
    )
    talkers = sorted({path.parent for path in clips.files})
    chosen = [talkers[index * len(talkers) // TALKERS] for index in range(TALKERS)]
    network = HearingLossLoss().simulator
    losses = {
        name: HearingLossLoss(simulator=network, criterion=name, reduction="none")
        for name in CRITERIA
    }
    rows: dict[tuple[str, str], list[tuple[float, float, bool, bool]]] = {}
    for talker in chosen:
        file = next(index for index, path in enumerate(clips.files) if path.parent == talker)
        speech = set_level(clips.cut_clip(file, 0.5), SPL)
        noise = shaped(speech, generator) if noises is None else noises.draw(1, generator)[0]
        signals = degraded(speech, set_level(noise, SPL), generator)
        for name in EARS:
            ear = Audiogram.standard(name)
            gain_db = equaliser(speech, ear)
            for title, share in GAINS.items():
                found = judged(signals, share * gain_db, ear, losses)
                for criterion in CRITERIA:
                    row = summary(found, criterion)
                    rows.setdefault((title, criterion), []).append(row)
                    print(
                        f"{talker.name}, {name}, {title}, {criterion}: {row}",
                        file=sys.stderr,
                        flush=True,
                    )
    print(
        "| gain | criterion | HASPI: mean (worst) | HASQI: mean (worst) | noise in order | clean nearest |"
    )
    print("|---|---|---|---|---|---|")
    for (title, criterion), pairs in rows.items():
        haspi, hasqi, ordered, nearest = zip(*pairs, strict=True)
        ranks = [f"{statistics.mean(values):.3f} ({min(values):.3f})" for values in (haspi, hasqi)]
        print(
            f"| {title} | `{criterion}` | {ranks[0]} | {ranks[1]} | {sum(ordered)} of {len(pairs)} | {sum(nearest)} |"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
