"""Compare the exact MSBG with itself on other frames, and with the default network.

    python docs/figures/frame_grid.py SPEECH_DIR AUDIOGRAMS.csv [ITEMS]

MSBG smears frames of 5.8 ms, one every 1.45 ms. For a signal that is shifted by less than a hop,
the frames begin elsewhere in the speech, and the output differs. The script prints the median SNR
of the shifted output against the output as it is, by degree of loss, and that of `neuro-msbg`,
whose frames are MSBG's.
"""

import sys

import torch
from torch.nn import functional

from hlsim import MSBG, load_pretrained
from hlsim.audiogram import SEVERITIES, severity_index
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import set_level
from hlsim.data.clips import Clips
from hlsim.losses.teacher_distance import noise_to_signal_db

RATE = 16000
SHIFTS = (3, 6, 12)  # samples; half a hop is 11.6


@torch.no_grad()
def main() -> None:
    speech, table = sys.argv[1:3]
    items = int(sys.argv[3]) if len(sys.argv) > 3 else 48
    generator = torch.Generator().manual_seed(0)
    measured = read_audiograms(table, simulated=True)
    ears = [measured[item % len(measured)][1] for item in range(items)]
    clean = set_level(Clips(speech, sample_rate=RATE, seconds=2.0).draw(items, generator), 65.0)
    severity = severity_index(torch.tensor([ear.thresholds for ear in ears]))
    msbg = MSBG()
    expected = msbg(clean, ears)
    outputs = {"neuro-msbg": load_pretrained("neuro-msbg")(clean, ears)}
    for shift in SHIFTS:
        shifted = msbg(functional.pad(clean, (shift, 0)), ears)[..., shift:]
        outputs[f"msbg, shifted by {1000.0 * shift / RATE:.2f} ms"] = shifted
    degrees = severity.unique().tolist()
    titles = [f"{SEVERITIES[degree]} ({int((severity == degree).sum())})" for degree in degrees]
    print(f"| SNR in dB, median | {' | '.join(titles)} |")
    print(f"|---|{'---|' * len(titles)}")
    for name, output in outputs.items():
        snr = -noise_to_signal_db(output, expected)
        medians = [f"{float(snr[severity == degree].median()):.1f}" for degree in degrees]
        print(f"| {name} | {' | '.join(medians)} |")


if __name__ == "__main__":
    main()
