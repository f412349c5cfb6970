"""Errors of HASPI, HASQI and HAAQI in single precision, compared with double precision.

    python docs/figures/score_precision.py SPEECH [ITEMS]

The items are 1.5 s of speech at 16 kHz and 50 to 80 dB SPL, for the ears N1 to N6 and S1 to S3,
processed as in ``score_parity.py``. Every fifth item has HAAQI. The noise of the ear is drawn, as
commands draw it.
"""

import sys

import torch
from score_parity import EARS, RATE, prepare_score, process

from hlsim import Audiogram
from hlsim.calibration import set_level
from hlsim.data.clips import Clips

SECONDS = 1.5


@torch.no_grad()
def main(folder: str, items: str = "500") -> None:
    torch.set_num_threads(1)
    clips, generator = (
        Clips(folder, sample_rate=RATE, seconds=SECONDS),
        torch.Generator().manual_seed(0),
    )
    errors: dict[str, list[float]] = {"haspi": [], "hasqi": [], "haaqi": []}
    for index in range(int(items)):
        ear = Audiogram.standard(EARS[index % len(EARS)])
        level = 50.0 + 30.0 * torch.rand((), generator=generator)
        clean = set_level(clips.draw(1, generator)[0], level)
        output = process(clean, index, ear, generator)
        for name, errors_of_score in errors.items():
            if name == "haaqi" and index % 5:
                continue
            single, double = (
                float(
                    prepare_score(name, clean.to(dtype), ear)(
                        output.to(dtype), noise="seeded", seed=index
                    )
                )
                for dtype in (torch.float32, torch.float64)
            )
            errors_of_score.append(abs(single - double))
    for name, errors_of_score in errors.items():
        values = torch.tensor(errors_of_score).double()
        print(
            f"{name}: median {values.median():.1e}, 99 % below {values.quantile(0.99):.1e}, "
            f"largest {values.max():.1e} of {len(values)}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
