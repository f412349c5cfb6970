"""What a wearable aid makes of a slam, a click and steady noise, and how far it looks ahead.

    python examples/sudden_sounds.py speech/valid [COMPENSATOR]

Prints how far the level of eight clips of speech of 65 dB SPL is off, from 0.3 s after the sound to 0.5 s, against the
same clips without it; the look-ahead in samples, from what changes when all from one of 200 places on is another; and,
for white noise, the mean gain and how it wanders from one 100 ms to the next.
"""

import sys

import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import Audiogram
from hlsim.calibration import level_spl, set_level
from hlsim.training.clips import Clips

RATE = 16000


def main(speech: str, name: str = "hearing-aid") -> None:
    aid, generator = load_compensator(name), torch.Generator().manual_seed(0)
    sliders = [{}, {"noise_reduction": 0.0}] if getattr(aid, "SLIDERS", ()) else [{}]

    def noise(samples: int, spl: float) -> Tensor:
        return set_level(torch.randn(samples, generator=generator), spl)

    clips = set_level(Clips(speech, sample_rate=RATE, seconds=2.5).draw(8, generator), 65.0)
    slam, click = torch.zeros(2, clips.shape[-1])
    slam[8000:8800], click[8800] = noise(800, 115.0), 20.0  # 120 dB SPL
    after = slice(8800 + 3 * RATE // 10, 8800 + 5 * RATE // 10)
    there = ", ".join(f"{level:.0f}" for level in level_spl(clips[:, after]).tolist())
    print(f"the clips from 0.3 to 0.5 s after the sound: {there} dB SPL")
    for ear in ("N2", "N4"):
        given = [
            aid(sound, Audiogram.standard(ear)) for sound in (clips, clips + slam, clips + click)
        ]
        plain, *struck = (level_spl(signal[:, after]) for signal in given)
        for sound, level in zip(("slam", "click"), struck, strict=True):
            off = ", ".join(f"{value:+.1f}" for value in (level - plain).tolist())
            print(f"{ear}, {sound}: {off} dB after 0.3 s")
    ear, signal = Audiogram.standard("N3"), noise(4000, 68.0)
    whole, ahead = aid(signal, ear), []
    for place in torch.linspace(100, 3900, 200).int().tolist():
        other = aid(torch.cat((signal[:place], noise(4000 - place, 80.0))), ear)
        ahead.append(place - int((other != whole).nonzero()[0]))
    print(f"looks {max(ahead)} samples ahead")
    for setting in sliders:
        steady = noise(4 * RATE, 65.0)
        gains = level_spl(aid(steady, ear, **setting)[RATE:].reshape(-1, RATE // 10)) - 65.0
        print(
            f"N3, white noise of 65 dB SPL, {setting or 'as it is'}: gain {gains.mean():.1f} ± {gains.std():.1f} dB"
        )


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
