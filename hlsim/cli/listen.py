"""The command ``listen``, which writes a page with players for some recordings."""

from __future__ import annotations

import argparse
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hlsim.cli.inputs import (
    build_simulator,
    build_single_microphone_aid,
    check_extras,
    level_and_gain,
    parse_ears,
    read_sliders,
    use_one_thread,
)
from hlsim.cli.options import SIMULATED_EARS, Parser, input_path, positive_number
from hlsim.progress import ProgressLine, track

if TYPE_CHECKING:
    from torch import Tensor

    from hlsim.audio import AudioInfo
    from hlsim.report.page import Section


def listen(parser: Parser) -> None:
    """Declare the options of the command ``listen``."""
    parser.set_command(
        _listen,
        "speech.wav --audiogram N2 --audiogram N4 --out page.html",
        "speech.wav noisy.wav --audiogram N3 --compensator hearing-aid --spl 65 --out page.html",
    )
    option = parser.option
    option("files", input_path, "audio files of 16 to 48 kHz", nargs="+")
    parser.ears(SIMULATED_EARS, "")
    text = (
        "also play what each ear perceives with an aid: nalr, nalrp, wdrc, camfit, or "
        "a name or folder"
    )
    option("--compensator", str, text)
    parser.sliders()
    parser.simulator("msbg")
    parser.levels("each file")
    text = "duration in seconds from the beginning of each file that is played"
    option("--seconds", positive_number, text, 8.0)
    option("--out", Path, "HTML file to write, which a browser opens offline", required=True)


def _listen(options: argparse.Namespace) -> None:
    sliders = read_sliders(options)
    use_one_thread()
    check_extras("eval")
    from hlsim.audio import scan_audio
    from hlsim.files import check_output_file, write_atomically
    from hlsim.report.page import Page

    check_output_file(options.out, options.files)
    ears = parse_ears(options, options.audiogram or [])
    simulator = cache(partial(build_simulator, options))
    aid = cache(partial(build_single_microphone_aid, options))

    def make_sounds(waveform: Tensor, rate: int) -> dict[str, Tensor]:
        sounds = {"original": waveform}
        for name, ear in ears.items():
            sounds[f"{name} unaided" if options.compensator else name] = simulator(rate)(
                waveform, ear
            )
            if options.compensator:
                output = aid(rate)(waveform, ear, **sliders)
                sounds[f"{name} with {options.compensator}"] = simulator(rate)(output, ear)
        return sounds

    thresholds = [
        f"{name}: {', '.join(f'{level:g}' for level in ear.thresholds)} dB HL."
        for name, ear in ears.items()
        if hasattr(ear, "thresholds")
    ]
    title = "What is perceived by " + ", ".join(ears)
    text = (
        "All sounds of a file have one gain, so that what is soft for an ear is soft here. "
        "Switch between them while one plays: the position stays the same. "
    )
    with ProgressLine("files", "starting", "writing the page"):
        # Whatever cannot be processed is reported before the first file is.
        recordings = [scan_audio(file) for file in options.files]
        for recording in recordings:
            simulator(recording.sample_rate)
            if options.compensator:
                aid(recording.sample_rate)
        tracked = track(recordings, "files", len(recordings))
        sections = [_make_section(options, recording, make_sounds) for recording in tracked]
        page = Page(title, text + " ".join(thresholds), sections)
        write_atomically(options.out, page.html())
    print(f"The page: {options.out.resolve().as_uri()}")


def _make_section(options: argparse.Namespace, recording: AudioInfo, make_sounds: Any) -> Section:
    """Return the section of the page for one audio file, with its player.

    Args:
        options: Options of the command.
        recording: Properties of the audio file.
        make_sounds: Function from samples (channels, time), at the scale of
            ``options.full_scale_spl``, and their rate in Hz to a dict from label to sound.

    Raises:
        ValueError: The file cannot be read or processed, or its played part is silent; the message
            names the file.
    """
    import torch

    from hlsim.audio import read_parts
    from hlsim.calibration import gain_to_pascals
    from hlsim.files import convert_at
    from hlsim.report.page import Section
    from hlsim.report.players import make_player

    file, rate = recording.path, recording.sample_rate
    level, gain_db = level_and_gain(recording.power, options)
    stop = min(recording.samples, max(1, round(options.seconds * rate)))
    (waveform,) = read_parts(recording, [(0, stop)])
    if not waveform.any():
        raise ValueError(
            f"{file}: the first {stop / rate:g} s are silent; play more of it (--seconds), or cut "
            "the silence off"
        )
    with torch.no_grad():
        scaled = waveform * 10.0 ** (gain_db / 20.0)
        sounds = convert_at(str(file), make_sounds, scaled, rate)
    gain = gain_to_pascals(options.full_scale_spl)
    player = make_player({"": {label: gain * sound for label, sound in sounds.items()}}, rate)
    text = f"{file}, {level + gain_db:.0f} dB SPL, {stop / rate:.1f} s"
    if stop < recording.samples:
        text += f" of {recording.samples / rate:.1f} s"
    return Section(file.name, [f"{text}."], player=player)
