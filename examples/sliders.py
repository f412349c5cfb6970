"""Effect of the hearing aid's sliders and release time on HASPI, HASQI and levels.

    python examples/sliders.py speech/valid noise/valid audiograms/valid.csv [ITEMS] [COMPENSATOR]

The items are those of `hlsim evaluate-compensator` with seed 0: half of them are noisy, at 50, 65
and 80 dB SPL. The reference of HASQI is NAL-R, and HASPI rewards gain. The *loudness error* is the
perceived level, by the exact MSBG, minus the level that a normal ear perceives of the clean speech.
"""

import statistics
import sys
from dataclasses import replace

import torch

from compensators import load_compensator
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.items import draw_aid_items, read_ears
from hlsim.metrics import haspi, hasqi

FULL = {"noise_reduction": 1.0, "amplification": 1.0}
STEPS = (0.0, 0.25, 0.5, 0.75)
RELEASES = (0.5, 2.0)  # seconds, in addition to that of the aid


def main(
    speech: str, noise: str, audiograms: str, count: str = "48", name: str = "hearing-aid"
) -> None:
    aid, msbg = load_compensator(name), MSBG(sample_rate=16000)
    items = draw_aid_items(
        speech, noise, read_ears(audiograms), items=int(count), seconds=3.0, seed=0
    )
    default_release = aid.config.release
    settings = []
    for slider in FULL:
        settings += [(FULL | {slider: value}, default_release) for value in STEPS]
    settings += [(FULL, release) for release in (default_release, *RELEASES)]
    print(
        "| noise reduction | amplification | release (s) | | HASPI | HASQI | output level (dB "
        "SPL) | loudness error (dB) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for sliders, release in settings:
        aid.config = replace(aid.config, release=release)
        for condition in ("clean", "noisy"):
            rows = []
            for item in items:
                if item.facts["speech"] != condition:
                    continue
                output = aid(item.signal, item.ear, **sliders)
                normal = msbg(item.clean, Audiogram.standard("NH"))
                loudness_error = level_spl(msbg(output, item.ear)) - level_spl(normal)
                scores = [score(output, item.clean, item.ear) for score in (haspi, hasqi)]
                values = (*scores, level_spl(output), loudness_error)
                rows.append([float(value) for value in values])
            means = [statistics.mean(column) for column in zip(*rows, strict=True)]
            texts = "{:.3f} | {:.3f} | {:.1f} | {:+.1f}".format(*means)
            print(
                f"| {' | '.join(f'{value:g}' for value in (*sliders.values(), release))} | "
                f"{condition} | {texts} |",
                flush=True,
            )


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
