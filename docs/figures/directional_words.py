"""Words that a recogniser finds behind directional microphones, in scenes with and without a room.

    python docs/figures/directional_words.py speech/valid noise/valid [--aid FOLDER]

The sentences are those of ``examples/machine_listener.py``, from the front at 65 dB SPL and at a
signal-to-noise ratio of 0 dB. The noise comes from one direction on the left, 90, 135 or 180
degrees in turn, or from all directions, in the open and in a room with a reverberation time of .3 s
at a distance of 1 m. Each sentence is for one of the ears N2 to N5, in turn, equal at both sides.
`hearing-aid` gets the signal of the front microphones, of the adaptive differential microphone, or
of the front end of a trained aid. Moonshine tiny writes down what the left ear perceives, behind
the exact MSBG; all outputs have the level of that with the front microphones. The table has words
correct, and differences from the front microphones and from the adaptive one, with 95 % intervals
over sentences and ears. It needs `pip install moonshine_voice==0.0.48`.
"""

import argparse
import math
from typing import Any

import torch
from pandas import DataFrame
from torch import Tensor

from compensators import load_compensator
from compensators.directional import AdaptiveDifferentialMicrophone
from docs.figures.directional import FrontMicrophone
from examples.machine_listener import (
    RATE,
    SENTENCES,
    Comparison,
    WordsCorrect,
    describe,
    load_recogniser,
    make_items,
    print_table,
    read_sentences,
)
from hlsim import Audiogram, Listener
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.data.rooms import Room
from hlsim.data.scenes import make_scene
from hlsim.evaluation.study import Item

EARS = {name: Audiogram.standard(name) for name in ("N2", "N3", "N4", "N5")}
AZIMUTHS = (90.0, 135.0, 180.0)
ROOMS = {"open": None, "room": Room(reverberation_time=0.3, distance=1.0)}
FRONT, ADAPTIVE, TRAINED = "front microphone", "adaptive", "trained"


def make_places(item: Item, noise: Tensor) -> dict[str, Tensor]:
    """Return the signals of the microphones, (microphones, ears, time), by place of the noise."""
    azimuth = AZIMUTHS[item.facts["sentence"] % len(AZIMUTHS)]
    scenes = {}
    for name, room in ROOMS.items():
        settings: dict[str, Any] = {"snr": 0.0, "seed": item.seed, "room": room}
        scenes[f"behind, {name}"] = make_scene(item.clean, [noise], [azimuth], **settings).input
        scenes[f"all, {name}"] = make_scene(item.clean, diffuse=noise, **settings).input
    return scenes


@torch.no_grad()
def measure(speech: str, noise: str, front_ends: dict[str, Any]) -> DataFrame:
    """Return a table of words correct, with a row for each sentence, place and front end."""
    hearing_aid = load_compensator("hearing-aid")
    words = WordsCorrect(load_recogniser("moonshine-tiny"))
    generator = torch.Generator().manual_seed(0)
    items = make_items(speech, noise, read_sentences(SENTENCES), EARS, [math.inf], 0, len(EARS))
    rows = []
    for item in items:
        seconds = len(item.clean) / RATE
        clips = Clips(noise, sample_rate=RATE, seconds=seconds, repeat=True)
        masker = clips.draw(1, generator)[0, : len(item.clean)]
        for place, signal in make_places(item, masker).items():
            outputs = {
                name: hearing_aid(front_end(signal), Listener(item.ear, item.ear))[0]
                for name, front_end in front_ends.items()
            }
            level = level_spl(outputs[FRONT])
            for name, output in outputs.items():
                scores = words(item, set_level(output, level))
                rows.append({**item.facts, "condition": name, "snr": place, **scores})
        print(f"{len(rows)} outputs", end="\r", flush=True)
    return DataFrame(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("speech", help="folder of speech")
    parser.add_argument("noise", help="folder of noise")
    parser.add_argument("--aid", default="hearing-aid-directional", help="trained aid")
    options = parser.parse_args()
    trained: Any = load_compensator(options.aid)
    front_ends = {
        FRONT: FrontMicrophone(),
        ADAPTIVE: AdaptiveDifferentialMicrophone(),
        TRAINED: trained.front_end,
    }
    table = measure(options.speech, options.noise, front_ends)
    comparison = Comparison(table)
    rows = []
    for place in table["snr"].unique():
        front, adaptive, ours = (comparison.shares(name, place) for name in front_ends)
        shares = [f"{share[0]:.3f}" for share in (front, adaptive, ours)]
        gains = [describe(ours - other, "+.3f") for other in (front, adaptive)]
        rows.append([place, *shares, *gains])
    print_table(["noise", *front_ends, f"minus {FRONT}", f"minus {ADAPTIVE}"], rows)


if __name__ == "__main__":
    main()
