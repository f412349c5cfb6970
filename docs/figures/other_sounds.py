"""Errors of Neuro-MSBG for sounds that are not speech: python docs/figures/other_sounds.py [NAME OR
FOLDER]

The sounds are steady tones, white noise and a click at 50, 65 and 80 dB SPL. The table shows
differences in level from the exact MSBG, and for noise and click the SNR, in dB. Tones that the
exact MSBG attenuates below 0 dB SPL are ignored.
"""

import sys

import torch

from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.aid_properties import make_tones
from hlsim.metrics.fidelity import snr_db

EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "S1", "S2", "S3")
LEVELS = (50.0, 65.0, 80.0)
LOW, HIGH = (250, 500, 1000, 2000), (3000, 4000, 6000)  # Hz
RATE = 16000


def make_row(exact: MSBG, network: torch.nn.Module, ear: Audiogram) -> list[str]:
    """Return the cells of the table for an ear."""
    row = []
    for hertz in (LOW, HIGH):
        sound = make_tones(hertz, LEVELS)
        middle = slice(RATE // 2, -RATE // 2)
        expected = level_spl(exact(sound)[:, middle])
        levels = level_spl(network(sound, ear)[:, middle])
        errors = (levels - expected)[expected >= 0.0]
        text = f"{float(errors.min()):+.1f} to {float(errors.max()):+.1f}" if len(errors) else "-"
        row.append(text)
    noise = torch.randn(1, 2 * RATE, generator=torch.Generator().manual_seed(0))
    click = torch.zeros(1, 2 * RATE)
    click[:, RATE] = 1.0
    for shape in (noise, click):
        sound = set_level(shape.expand(len(LEVELS), -1), torch.tensor(LEVELS))
        expected = exact(sound)
        perceived = network(sound, ear)
        errors = level_spl(perceived) - level_spl(expected)
        row.append(", ".join(f"{error:+.1f}" for error in errors.tolist()))
        pairs = zip(expected.numpy(), perceived.numpy(), strict=True)
        row.append(", ".join(f"{snr_db(*pair):.0f}" for pair in pairs))
    return row


def main() -> None:
    network = load_pretrained(sys.argv[1] if len(sys.argv) > 1 else "neuro-msbg")
    print("| Ear | tones to 2 kHz | tones from 3 kHz | noise | noise, SNR | click | click, SNR |")
    print("|---|---|---|---|---|---|---|")
    for name in EARS:
        ear = Audiogram.standard(name)
        with torch.inference_mode():
            row = make_row(MSBG(ear, sample_rate=RATE), network, ear)
        print(f"| {name} | {' | '.join(row)} |")


if __name__ == "__main__":
    main()
