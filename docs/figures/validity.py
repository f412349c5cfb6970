"""Rank correlation of criteria with HASPI and HASQI: python docs/figures/validity.py SPEECH [NOISE]

The signals are clean speech and seventeen degradations of it: 3 s at 65 dB SPL by four talkers, for
the ears N2, N3 and N4. Each is scored behind each of two fixed equalisers. With one, the ear
perceives the bands of the clean speech at the levels of a normal ear. The other has half of its
gain in dB. The noise has the spectrum of the speech, or is drawn from recordings in NOISE.

For each pair of talker and ear, the rank correlation of the negative loss with the scores is
computed over the 18 signals. The table shows its mean and minimum over the pairs, the number of
pairs in which the loss increases with the noise, and the number of pairs in which the loss of the
clean speech is the lowest.
"""

import statistics
import sys
from itertools import pairwise

import torch
from scipy.stats import spearmanr
from torch import Tensor

from hlsim import MSBG, Audiogram, HearingLossLoss
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.dsp.stft import STFT
from hlsim.metrics import HaspiReference, HasqiReference
from hlsim.metrics.band_levels import band_edges, band_levels

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
GAINS = {"normal band levels": 1.0, "half the gain": 0.5}


def apply_gains(speech: Tensor, gains: Tensor) -> Tensor:
    """Apply a gain at each frequency. Shape: (..., time), (time // 2 + 1,) -> (..., time)."""
    return torch.fft.irfft(torch.fft.rfft(speech) * gains, speech.shape[-1])


def degrade(speech: Tensor, noise: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Degrade speech in seventeen ways, with noise of the same RMS; the result has the clean
    speech, too.

    Shape: (time,), (time,) -> (time,) by name.
    """
    time = speech.shape[-1]
    hz, peak = torch.fft.rfftfreq(time, 1.0 / RATE), float(speech.abs().max())
    signals = {"clean": speech}
    for name in NOISY[1:]:
        signals[name] = speech + noise * 10.0 ** (-float(name.split()[2]) / 20.0)
    for edge in (1000.0, 2000.0, 4000.0):
        signals[f"low-pass {edge:g} Hz"] = apply_gains(speech, torch.sigmoid((edge - hz) / 50.0))
    for share in (0.25, 0.1):
        signals[f"clipped at {share:g} of the peak"] = speech.clamp(-share * peak, share * peak)
    stft = STFT(512, 512, 128)
    floor = stft.analyse(noise[None]).abs().square().mean(-2, keepdim=True)
    for snr in (10.0, 0.0):  # Spectral subtraction turns noise into tones.
        mixed = stft.analyse((speech + noise * 10.0 ** (-snr / 20.0))[None])
        power_gain = (
            1.0 - 2.0 * floor * 10.0 ** (-snr / 10.0) / mixed.abs().square().clamp_min(1e-20)
        ).clamp_min(0.0)
        signals[f"musical noise, from {snr:g} dB"] = stft.synthesise(
            mixed * power_gain.sqrt(), time
        )[0]
    for seconds, direct_db in ((0.4, 5.0), (1.0, 0.0)):
        tail = torch.randn(time, generator=generator) * 10.0 ** (
            -3.0 * torch.arange(time) / (RATE * seconds)
        )
        wet = torch.fft.irfft(torch.fft.rfft(speech, 2 * time) * torch.fft.rfft(tail, 2 * time))[
            :time
        ]
        wet = set_level(wet, SPL - direct_db)
        signals[f"reverberation of {seconds:g} s"] = set_level(speech + wet, SPL)
    signals["a delay of 1 ms"] = apply_gains(speech, torch.exp(-2j * torch.pi * 0.001 * hz))
    signals["phase turned by 90 degrees"] = apply_gains(
        speech, torch.full_like(hz, 1j, dtype=torch.complex64)
    )
    signals["sign"] = -speech
    return signals


def fit_equaliser(speech: Tensor, ear: Audiogram) -> Tensor:
    """Compute gains in dB, -10 to 90, with which an ear perceives each band at the level of a
    normal ear.

    Shape: (time,) -> (time // 2 + 1,).
    """
    msbg, hz = MSBG(sample_rate=RATE), torch.fft.rfftfreq(speech.shape[-1], 1.0 / RATE)
    edges = torch.from_numpy(band_edges()).float()
    # The first band extends to 0 Hz, and the last one to half the sample rate.
    band = torch.bucketize(hz, edges[1:-1])

    def perceived_levels(waveform: Tensor, audiogram: Audiogram) -> Tensor:
        powers = 10.0 ** (band_levels(msbg(waveform, audiogram), RATE) / 10.0)
        return 10.0 * torch.log10(powers.mean(-2))

    target = perceived_levels(speech, Audiogram.standard("NH"))
    gain = torch.zeros(len(edges) - 1)
    for _ in range(12):  # 1 dB of gain raises the perceived level by 1 to 3 dB.
        output = apply_gains(speech, 10.0 ** (gain[band] / 20.0))
        gain = (gain + 0.4 * (target - perceived_levels(output, ear))).clamp(-10.0, 90.0)
    return gain[band]


def compute_scores(
    signals: dict[str, Tensor], gain_db: Tensor, ear: Audiogram, losses: dict[str, HearingLossLoss]
) -> dict[str, dict[str, Tensor]]:
    """Compute HASPI, HASQI and each criterion of all equalised signals, by measure and signal."""
    clean = signals["clean"]
    outputs = apply_gains(torch.stack(list(signals.values())), 10.0 ** (gain_db / 20.0))
    haspi_reference = HaspiReference(clean)
    hasqi_reference = HasqiReference(clean, ear)
    measures = {
        "HASPI": torch.stack([haspi_reference.score(output, ear) for output in outputs]),
        "HASQI": torch.stack([hasqi_reference.score(output) for output in outputs]),
        **{name: loss(outputs, clean.expand_as(outputs), ear) for name, loss in losses.items()},
    }
    return {name: dict(zip(signals, values, strict=True)) for name, values in measures.items()}


def compare(
    scores: dict[str, dict[str, Tensor]], criterion: str
) -> tuple[float, float, bool, bool]:
    """Compute the rank correlations with HASPI and HASQI, and check the order of the losses.

    Returns:
        Both correlations, whether the loss increases with the noise, and whether it is lowest for
        the clean speech.
    """
    loss = scores[criterion]
    negative_loss = -torch.stack(list(loss.values()))
    haspi, hasqi = (
        spearmanr(negative_loss, torch.stack(list(scores[name].values())))[0]
        for name in ("HASPI", "HASQI")
    )
    ordered = all(bool(loss[less] < loss[more]) for less, more in pairwise(NOISY))
    return (
        float(haspi),
        float(hasqi),
        ordered,
        min(loss, key=lambda name: float(loss[name])) == "clean",
    )


def draw_noise(speech: Tensor, generator: torch.Generator) -> Tensor:
    """Draw noise with the spectrum of speech. Shape: (time,) -> (time,)."""
    spectrum = torch.fft.rfft(speech).abs()
    smooth = torch.nn.functional.avg_pool1d(
        spectrum.square()[None], 101, 1, 50, count_include_pad=False
    )[0].sqrt()
    return apply_gains(torch.randn(speech.shape, generator=generator), smooth)


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
        noise = draw_noise(speech, generator) if noises is None else noises.draw(1, generator)[0]
        signals = degrade(speech, set_level(noise, SPL), generator)
        for name in EARS:
            ear = Audiogram.standard(name)
            gain_db = fit_equaliser(speech, ear)
            for title, share in GAINS.items():
                scores = compute_scores(signals, share * gain_db, ear, losses)
                for criterion in CRITERIA:
                    row = compare(scores, criterion)
                    rows.setdefault((title, criterion), []).append(row)
                    print(
                        f"{talker.name}, {name}, {title}, {criterion}: {row}",
                        file=sys.stderr,
                        flush=True,
                    )
    print(
        "| gain | criterion | HASPI: mean (worst) | HASQI: mean (worst) | noise in order | "
        "clean nearest |"
    )
    print("|---|---|---|---|---|---|")
    for (title, criterion), pairs in rows.items():
        haspi, hasqi, ordered, nearest = zip(*pairs, strict=True)
        ranks = [f"{statistics.mean(values):.3f} ({min(values):.3f})" for values in (haspi, hasqi)]
        print(
            f"| {title} | `{criterion}` | {ranks[0]} | {ranks[1]} | {sum(ordered)} of "
            f"{len(pairs)} | {sum(nearest)} |"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
