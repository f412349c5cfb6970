"""A wearable aid after a slam and a click, its look-ahead, and its gain for steady noise.

    python examples/sudden_sounds.py speech/valid [COMPENSATOR]

It prints:

- by how many dB a slam or a click changes the output level of eight clips of speech at 65 dB SPL,
    0.3 to 0.5 s later
- the look-ahead in samples: the signal is replaced from one of 200 positions on, and the first
    change of the output found
- the mean gain for white noise, and its standard deviation over segments of 100 ms
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
    aid = load_compensator(name)
    generator = torch.Generator().manual_seed(0)
    sliders = [{}, {"noise_reduction": 0.0}] if getattr(aid, "SLIDERS", ()) else [{}]

    def noise(samples: int, spl: float) -> Tensor:
        return set_level(torch.randn(samples, generator=generator), spl)

    clips = set_level(Clips(speech, sample_rate=RATE, seconds=2.5).draw(8, generator), 65.0)
    slam, click = torch.zeros(2, clips.shape[-1])
    slam[8000:8800], click[8800] = noise(800, 115.0), 20.0  # 120 dB SPL
    after = slice(8800 + 3 * RATE // 10, 8800 + 5 * RATE // 10)
    text = ", ".join(f"{level:.0f}" for level in level_spl(clips[:, after]).tolist())
    print(f"levels of the clips, 0.3 to 0.5 s after the sound: {text} dB SPL")
    for ear in ("N2", "N4"):
        inputs = (clips, clips + slam, clips + click)
        outputs = [aid(sound, Audiogram.standard(ear)) for sound in inputs]
        speech_level, *levels = (level_spl(output[:, after]) for output in outputs)
        for sound, level in zip(("slam", "click"), levels, strict=True):
            changes = ", ".join(f"{value:+.1f}" for value in (level - speech_level).tolist())
            print(f"{ear}, {sound}: {changes} dB after 0.3 s")
    ear, signal = Audiogram.standard("N3"), noise(4000, 68.0)
    expected = aid(signal, ear)
    look_aheads = []
    for start in torch.linspace(100, 3900, 200).int().tolist():
        output = aid(torch.cat((signal[:start], noise(4000 - start, 80.0))), ear)
        first_change = int((output != expected).nonzero()[0])
        look_aheads.append(start - first_change)
    print(f"look-ahead: {max(look_aheads)} samples")
    for setting in sliders:
        steady = noise(4 * RATE, 65.0)
        gains = level_spl(aid(steady, ear, **setting)[RATE:].reshape(-1, RATE // 10)) - 65.0
        print(
            f"N3, white noise of 65 dB SPL, {setting or 'default'}: gain {gains.mean():.1f} ± "
            f"{gains.std():.1f} dB"
        )


if __name__ == "__main__":
    with torch.no_grad():
        main(*sys.argv[1:])
