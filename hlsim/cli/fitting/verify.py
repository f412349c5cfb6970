"""The command ``verify``, which measures an aid's gains from recordings of its input and output."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from hlsim.cli.inputs import check_extras, parse_ear, use_one_thread, warn_of_other_ears
from hlsim.cli.options import SIMULATED_EARS, Parser, input_path

if TYPE_CHECKING:
    from hlsim.evaluation.fitting.verification import Verification


def verify(parser: Parser) -> None:
    """Declare the options of the command ``verify``."""
    parser.set_command(
        _verify,
        "input.wav output.wav --audiogram N3",
        "input.wav output.wav --audiogram N3 --spl 65 --plot verify.svg --csv verify.csv",
    )
    option = parser.option
    option("input", input_path, "input of the aid, a mono file of 16 to 48 kHz")
    option("output", input_path, "output of the aid at the same scale and rate")
    parser.audiogram(ears=SIMULATED_EARS, required=True)
    parser.uncomfortable_levels("the table and --plot")
    text = (
        "aid whose gains are the targets: nalr, nalrp, wdrc, camfit, or "
        "a checkpoint's name or folder"
    )
    option("--target", str, text, "nalr")
    parser.levels("the input; the output is scaled by the same factor")
    option("--csv", Path, "file to write, with the printed table")
    option("--plot", Path, "SVG file to write, with speech, threshold and uncomfortable level")


def _verify(options: argparse.Namespace) -> None:
    use_one_thread()
    if options.plot:
        check_extras("eval")
    from hlsim.audio import read_audio
    from hlsim.calibration import full_scale_at
    from hlsim.evaluation.fitting.verification import verify as verify_aid
    from hlsim.files import check_output_file, csv_text, write_atomically

    for file in filter(None, (options.csv, options.plot)):
        check_output_file(file, [options.input, options.output])
    ear = parse_ear(options)
    warn_of_other_ears({options.target: options.target}, ear)
    (input_, rate), (output, output_rate) = map(read_audio, (options.input, options.output))
    if rate != output_rate:
        raise ValueError(
            f"expected one sample rate, got {rate} and {output_rate} Hz; resample one of the files"
        )
    full_scale_spl = options.full_scale_spl
    if options.spl is not None:
        full_scale_spl = full_scale_at(options.spl, input_)
    result = verify_aid(
        input_.squeeze(0),
        output.squeeze(0),
        ear,
        rate,
        full_scale_spl=full_scale_spl,
        prescription=options.target,
    )
    _print_result(result)
    if options.csv:
        rows = result.rows()
        write_atomically(options.csv, csv_text([rows[0], *(row.values() for row in rows)]))
    if options.plot:
        from hlsim.report.plots import verification_picture

        write_atomically(options.plot, verification_picture(result).data)


def _print_result(result: Verification) -> None:
    """Print one row per third octave, see ``Verification.rows``, and audible shares of speech."""
    rows = result.rows()
    # Short labels, such as "in 30" for input_30, keep the table within the width of a terminal.
    labels = [name.replace("put_", " ").replace("_", " ") for name in rows[0]]
    print("  ".join(f"{label:>6}" for label in labels))
    for row in rows:
        cells = zip(labels, row.values(), strict=True)
        print("  ".join(f"{value:>{max(6, len(label))}.0f}" for label, value in cells))
    unaided, aided = result.unaided_sii, result.aided_sii
    print(f"audible share of speech (SII): {unaided:.2f} unaided, {aided:.2f} aided")
