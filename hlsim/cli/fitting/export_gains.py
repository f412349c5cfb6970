"""The command ``export-gains``, which writes an aid's gains for another program."""

import argparse
import sys
from pathlib import Path

from hlsim.cli.inputs import build_compensator, parse_ear, use_one_thread
from hlsim.cli.options import SIMULATED_EARS, Parser, count, sound_level


def export_gains(parser: Parser) -> None:
    """Declare the options of the command ``export-gains``."""
    parser.set_command(
        _export_gains,
        "--audiogram N3 --to camilladsp --level 70 --sample-rate 48000 --out aid.yml",
        "--audiogram N3 --to openmha --compensator wdrc --out gains.cfg",
    )
    option = parser.option
    parser.audiogram(ears=SIMULATED_EARS, required=True)
    text = "program that reads the file: camilladsp, equalizer-apo, openmha, or csv for a table"
    option("--to", str, text, required=True)
    text = (
        "aid whose gains are exported: nalr, nalrp, wdrc, camfit, or a checkpoint's name or "
        "folder; of one with a directional front end, the gains behind it"
    )
    option("--compensator", str, text, "hearing-aid")
    text = (
        "level of speech in dB SPL for which camilladsp and equalizer-apo amplify; the other "
        "formats have gains at many levels (default: 65)"
    )
    option("--level", sound_level, text)
    text = "sample rate in Hz of camilladsp or openmha (default: 48000)"
    option("--sample-rate", count, text)
    option("--out", Path, "file to write; without it, the text is printed")
    parser.set_defaults(full_scale_spl=94.0)  # for the aid, whose signals are in pascals


def _export_gains(options: argparse.Namespace) -> None:
    use_one_thread()
    ear = parse_ear(options)
    from hlsim.calibration import NEURO_RATE
    from hlsim.evaluation.fitting.gain_tables import export_gains as write_gains
    from hlsim.files import write_atomically

    aid = build_compensator(options, NEURO_RATE)
    text = write_gains(aid, ear, options.to, options.level, options.sample_rate)
    if options.out:
        write_atomically(options.out, text)
    else:
        sys.stdout.write(text)
