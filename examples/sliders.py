"""What the hearing aid's sliders and its release trade: HASPI, HASQI and the level heard, at five settings and three.

    python examples/sliders.py speech/valid noise/valid audiograms/valid.csv [ITEMS] [COMPENSATOR]

Items as in `hlsim evaluate-compensator`, seed 0: half of them noisy, at 50, 65 and 80 dB SPL in turn. HASQI takes NAL-R
for perfect, HASPI rewards gain, and *heard* is the level after the exact MSBG less a normal ear's of the clean speech.
"""

import statistics
import sys
from dataclasses import replace

import torch

from compensators import load_compensator
from hlsim import MSBG, Audiogram
from hlsim.calibration import level_spl
from hlsim.evaluation.items import draw_judged_items, read_ears
from hlsim.metrics import haspi, hasqi

FULL, STEPS = {"noise_reduction": 1.0, "amplification": 1.0}, (0.0, 0.25, 0.5, 0.75, 1.0)
RELEASES = (0.5, 2.0)  # seconds, beside the aid's own


def main(
    speech: str, noise: str, audiograms: str, count: str = "48", name: str = "hearing-aid"
) -> None:
    aid, msbg = load_compensator(name), MSBG(sample_rate=16000)
    items = draw_judged_items(
        speech, noise, read_ears(audiograms), items=int(count), seconds=3.0, seed=0
    )
    own = aid.config.release
    settings = [(FULL | {slider: value}, own) for slider in FULL for value in STEPS if value < 1.0]
    print(
        "| noise reduction | amplification | release (s) | | HASPI | HASQI | given (dB SPL) | heard (dB) |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for sliders, release in settings + [(FULL, release) for release in (own, *RELEASES)]:
        aid.config = replace(aid.config, release=release)
        for condition in ("clean", "noisy"):
            rows = []
            for item in items:
                if item.facts["speech"] != condition:
                    continue
                given = aid(item.signal, item.ear, **sliders)
                normal = msbg(item.clean, Audiogram.standard("NH"))
                heard = level_spl(msbg(given, item.ear)) - level_spl(normal)
                scores = [score(given, item.clean, item.ear) for score in (haspi, hasqi)]
                rows.append([float(value) for value in (*scores, level_spl(given), heard)])
            means = [statistics.mean(column) for column in zip(*rows, strict=True)]
            figures = "{:.3f} | {:.3f} | {:.1f} | {:+.1f}".format(*means)
            print(
                f"| {' | '.join(f'{value:g}' for value in (*sliders.values(), release))} | {condition} | {figures} |",
                flush=True,
            )


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
