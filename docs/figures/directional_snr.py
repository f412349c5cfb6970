"""Noise that directional microphones remove, and what they do to the talker in front.

    python docs/figures/directional_snr.py [CHECKPOINT [SECONDS]]

The bundled utterances for validation come from the front, and noise with the mean spectrum of the
bundled speech from one direction on the left or from all directions (64), at -5 dB, to a rigid
sphere, in the open or in a room with a reverberation time of SECONDS. The microphones are equal, or
their gains differ at random with a standard deviation of .5 dB. The benefit is the ratio of the
direct sound of the speech to all other sound, its echoes included, of both ears after a front end
minus that of the front microphones, a mean over third octaves in dB; the two parts behind the
adaptive front ends are separated by a second output, for the other sound with the opposite sign
(Hagerman and Olofsson 2004). The table has the benefits, by how much the beamformers are ahead of
the adaptive microphone, with 95 % intervals over the utterances, and the largest changes of the
talker's differences between the ears, of the level over five octaves and of the time over the two
octaves below 1 kHz (means over the utterances). The front end of a trained checkpoint is one of the
beamformers, if there is one. The second table has the change of the level of a talker in quiet, at
the front or beside it, relative to the front microphone, in third octaves at the ear that loses
more.
"""

import sys
from collections import defaultdict
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from compensators import load_compensator
from compensators.beamformer import AdaptiveBeamformer
from compensators.directional import AdaptiveDifferentialMicrophone
from hlsim.audio import find_audio, read_audio
from hlsim.calibration import set_level
from hlsim.data.bundled import SPEECH
from hlsim.data.rooms import Room
from hlsim.data.scenes import make_scene, sound_at_microphones
from hlsim.dsp.sphere import unit_vectors
from hlsim.metrics.interaural import interaural_change
from hlsim.metrics.sii import SII_BANDS

TALKER_AZIMUTHS = (0.0, 5.0, 10.0, 20.0)
OCTAVES = (250, 500, 1000, 2000, 4000)
AZIMUTHS: dict[str, float | None] = {"90": 90.0, "135": 135.0, "180": 180.0, "all": None}
SNR = -5.0
SECONDS = 2.0
SETTLED = slice(4000, None)
"""Samples that are measured, after the front ends have adapted."""


def band_levels(signals: Tensor) -> np.ndarray:
    """Return the levels of third octaves in dB, (..., time) -> (..., bands)."""
    spectra = np.abs(np.fft.rfft(signals[..., SETTLED].double().numpy())) ** 2
    hertz = np.fft.rfftfreq(signals[..., SETTLED].shape[-1], 1.0 / 16000.0)
    bands = []
    for centre in SII_BANDS[:-1]:  # The last one reaches above half the rate.
        is_inside = (hertz > centre * 2.0 ** (-1.0 / 6.0)) & (hertz < centre * 2.0 ** (1.0 / 6.0))
        bands.append(spectra[..., is_inside].sum(-1))
    return 10.0 * np.log10(np.stack(bands, -1))


def measure(front_end: nn.Module, target: Tensor, noise: Tensor) -> tuple[float, float, float]:
    """Return the benefit in dB, and the largest changes in level (dB) and time (microseconds)."""
    sum_output, difference = front_end(target + noise), front_end(target - noise)
    signal, rest = (sum_output + difference) / 2.0, (sum_output - difference) / 2.0
    after = (band_levels(signal) - band_levels(rest)).mean()
    before = (band_levels(target[0]) - band_levels(noise[0])).mean()
    change = interaural_change(target[0][..., SETTLED], signal[..., SETTLED])
    return (
        float(after - before),
        float(change.level.abs().max()),
        float(change.time[:2].abs().max()),
    )


def print_talker(front_ends: dict[str, nn.Module], speech: Tensor) -> None:
    """Print the table of the level of a talker in quiet behind each front end."""
    print("\n| front end | talker at | " + " | ".join(f"{octave} Hz" for octave in OCTAVES) + " |")
    print("|---" * (2 + len(OCTAVES)) + "|")
    chosen = [SII_BANDS.index(octave) for octave in OCTAVES]
    for name, front_end in front_ends.items():
        for azimuth in TALKER_AZIMUTHS:
            at_microphones = sound_at_microphones(speech[None], unit_vectors([azimuth]))
            change = band_levels(front_end(at_microphones)) - band_levels(at_microphones[0])
            worse = change.min(0)[chosen]
            print(
                f"| {name} | {azimuth:g} | " + " | ".join(f"{level:.1f}" for level in worse) + " |"
            )


def speech_shaped_noise(samples: int, seed: int) -> Tensor:
    """Return noise with the mean spectrum of the bundled speech, (samples,)."""
    power = np.mean(
        [
            np.abs(np.fft.rfft(read_audio(file)[0][0, :16000].numpy(), 512)) ** 2
            for file in find_audio(SPEECH / "train")
        ],
        0,
    )
    white = np.fft.rfft(np.random.default_rng(seed).normal(size=samples))
    shape = np.interp(np.linspace(0.0, 1.0, len(white)), np.linspace(0.0, 1.0, len(power)), power)
    return torch.from_numpy(np.fft.irfft(white * np.sqrt(shape), samples)).float()


def main(checkpoint: str | None = None, reverberation_time: str = "0") -> None:
    seconds = float(reverberation_time)
    room = Room(reverberation_time=seconds) if seconds else None
    adaptive = AdaptiveDifferentialMicrophone()
    beamformers: dict[str, nn.Module] = {"untrained": AdaptiveBeamformer().requires_grad_(False)}
    if checkpoint is not None:
        trained: Any = load_compensator(checkpoint)
        beamformers["trained"] = trained.front_end
    samples = int(SECONDS * 16000)
    results: dict[tuple[str, float], list[Any]] = defaultdict(list)
    for seed, file in enumerate(find_audio(SPEECH / "valid")):
        target = set_level(read_audio(file)[0][0, :samples], 65.0)
        noise = speech_shaped_noise(2 * samples, seed)
        normal = np.random.default_rng(100 + seed).normal(size=(2, 2, 1))
        for name, azimuth in AZIMUTHS.items():
            masker = {"diffuse": noise} if azimuth is None else {"maskers": [noise]}
            azimuths = [] if azimuth is None else [azimuth]
            scene = make_scene(target, azimuths=azimuths, snr=SNR, seed=seed, room=room, **masker)
            for mismatch in (0.0, 0.5):
                gains = 10.0 ** (torch.from_numpy(mismatch * normal).float() / 20.0)
                at_microphones = gains * scene.target, gains * (scene.input - scene.target)
                rows = [
                    measure(front, *at_microphones) for front in (adaptive, *beamformers.values())
                ]
                results[name, mismatch].append(rows)
    print("| noise from, mismatch (dB) | adaptive | beamformer | benefit | ahead by | changes |")
    print("|---|---|---|---|---|---|")
    for (name, mismatch), values in results.items():
        measured = np.array(values)  # (utterances, front ends, 3)
        for number, label in enumerate(beamformers, start=1):
            ahead = measured[:, number, 0] - measured[:, 0, 0]
            margin = 2.0 * ahead.std(ddof=1) / len(ahead) ** 0.5
            means = measured.mean(0)
            print(
                f"| {name}, {mismatch:g} | {means[0, 0]:.1f} | {label} | {means[number, 0]:.1f} | "
                f"{ahead.mean():.1f} [{ahead.mean() - margin:.1f}, {ahead.mean() + margin:.1f}] | "
                f"{means[number, 1]:.1f} dB, {means[number, 2]:.0f} us |"
            )
    speech = read_audio(find_audio(SPEECH / "valid")[0])[0][0]
    print_talker({"adaptive": adaptive, **beamformers}, speech)


if __name__ == "__main__":
    main(*sys.argv[1:])
