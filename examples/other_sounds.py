"""What Neuro-MSBG makes of sounds that are not speech: python examples/other_sounds.py [NAME OR FOLDER]

Steady tones, white noise and a click of 50, 65 and 80 dB SPL, compared with the exact MSBG. A tone counts where the exact
MSBG leaves 0 dB SPL of it or more.
"""

import sys

import torch

from hlsim import MSBG, Audiogram, load_pretrained
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.measurements import tones
from hlsim.metrics.fidelity import snr_db

EARS = ("NH", "N1", "N2", "N3", "N4", "N5", "S1", "S2", "S3")
LEVELS = (50.0, 65.0, 80.0)
LOW, HIGH = (250, 500, 1000, 2000), (3000, 4000, 6000)  # Hz
RATE = 16000


def cells(exact: MSBG, network: torch.nn.Module, ear: Audiogram) -> list[str]:
    row = []
    for hertz in (LOW, HIGH):
        sound, middle = tones(hertz, LEVELS), slice(RATE // 2, -RATE // 2)
        expected, heard = (
            level_spl(signal[:, middle]) for signal in (exact(sound), network(sound, ear))
        )
        off = (heard - expected)[expected >= 0.0]
        row.append(f"{float(off.min()):+.1f} to {float(off.max()):+.1f}" if len(off) else "-")
    noise = torch.randn(1, 2 * RATE, generator=torch.Generator().manual_seed(0))
    click = torch.zeros(1, 2 * RATE)
    click[:, RATE] = 1.0
    for shape in (noise, click):
        sound = set_level(shape.expand(len(LEVELS), -1), torch.tensor(LEVELS))
        expected, heard = exact(sound), network(sound, ear)
        off = level_spl(heard) - level_spl(expected)
        row += [
            ", ".join(f"{value:+.1f}" for value in off.tolist()),
            ", ".join(
                f"{snr_db(*pair):.0f}" for pair in zip(expected.numpy(), heard.numpy(), strict=True)
            ),
        ]
    return row


def main() -> None:
    network = load_pretrained(sys.argv[1] if len(sys.argv) > 1 else "neuro-msbg")
    print("| Ear | tones to 2 kHz | tones from 3 kHz | noise | noise, SNR | click | click, SNR |")
    print("|---|---|---|---|---|---|---|")
    for name in EARS:
        ear = Audiogram.standard(name)
        with torch.inference_mode():
            row = cells(MSBG(ear, sample_rate=RATE), network, ear)
        print(f"| {name} | {' | '.join(row)} |")


if __name__ == "__main__":
    main()
