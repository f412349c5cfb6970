"""Measure the benefit of aids in the digit test, and print a table.

    python docs/figures/digits_aids.py [--ears N3 N4] [--simulator msbg] [--triplets 120]
        [--listener FOLDER]

The first row has the unaided thresholds. Each cell below is the unaided minus the aided threshold
in dB, with its interval of 95 %.
"""

import argparse
from functools import partial

import torch

from compensators import load_compensator
from hlsim import Audiogram
from hlsim.evaluation.digits import DigitTest
from hlsim.evaluation.digits.psychometric import subtract

AIDS = {
    "NAL-R": ("nalr", {}),
    "`hearing-aid` without noise reduction": ("hearing-aid", {"noise_reduction": 0.0}),
    "`hearing-aid`, half of it": ("hearing-aid", {"noise_reduction": 0.5}),
    "`hearing-aid`, all of it": ("hearing-aid", {"noise_reduction": 1.0}),
    "`compensator-general`": ("compensator-general", {}),
}
"""Name of the checkpoint and sliders of each aid."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ears", nargs="+", default=["N2", "N3", "N4", "N5", "S2"])
    parser.add_argument("--simulator", default="msbg")
    parser.add_argument("--listener", default="digit-listener")
    parser.add_argument("--triplets", type=int, default=120)
    options = parser.parse_args()
    torch.set_num_threads(1)
    test = DigitTest.draw(options.triplets, simulator=options.simulator, listener=options.listener)
    ears = [torch.tensor(Audiogram.standard(name).thresholds) for name in options.ears]
    unaided = [test.measure(ear) for ear in ears]
    print(f"| aid | {' | '.join(options.ears)} |\n|---|{'---|' * len(options.ears)}")
    print(f"| unaided threshold | {' | '.join(f'{x.value:.1f}' for x in unaided)} |", flush=True)
    for label, (name, sliders) in AIDS.items():
        aid = partial(load_compensator(name), **sliders)
        benefits = [
            subtract(without, test.measure(ear, aid))
            for ear, without in zip(ears, unaided, strict=True)
        ]
        cells = [f"{value:+.1f} [{low:+.1f}, {high:+.1f}]" for value, low, high in benefits]
        print(f"| {label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
