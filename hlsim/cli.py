"""The program ``hlsim``. Bad input ends with exit status 2 and one line."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from hlsim import __version__
from hlsim.audio import HIGHEST_RATE, read_audio, resample, write_audio
from hlsim.audiogram import Audiogram
from hlsim.extras import MissingExtraError, require
from hlsim.msbg import MSBG
from hlsim.pretrained import load_pretrained


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; returns its exit status."""
    try:
        options = _parser().parse_args(arguments)
        options.run(options)
    except (ValueError, MissingExtraError, OSError) as error:
        print(f"hlsim: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "hlsim: stopped; what was finished is kept, and training goes on from there with the same command",
            file=sys.stderr,
        )
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="hlsim", description="Hear through an impaired ear, and train through it."
    )
    parser.add_argument("--version", action="version", version=f"hlsim {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(
            name, help=text, description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
        )
        sub.set_defaults(run=run)
        return sub

    sub = command(
        "demo", _demo, "train a compensator for one ear on the embedded speech and score it by HASPI"
    )
    sub.add_argument(
        "--out", type=Path, default=Path("hlsim-demo"), help="folder for report, audio and pictures"
    )
    _audiogram(sub, default="N4")
    sub.add_argument(
        "--speech", type=Path, help="folder of speech instead of the embedded; a third of it is scored"
    )
    sub.add_argument("--minutes", type=_positive, default=3.0, help="of training")
    _seed(sub)

    sub = command("simulate", _simulate, "write what an impaired ear hears of a file")
    sub.add_argument(
        "input", type=Path, metavar="IN", help="wav, flac or ogg, 16 kHz or more, any number of channels"
    )
    sub.add_argument("output", type=Path, metavar="OUT", help="wav (32-bit float), flac or ogg")
    _audiogram(sub, required=True)
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="msbg (exact), or a checkpoint's name or folder"
    )
    _full_scale(sub)

    sub = command("train-simulator", _train_simulator, "train a Neuro-MSBG on targets from the exact MSBG")
    sub.add_argument(
        "--config", type=Path, required=True, help="recipe, a YAML file (examples/neuro-msbg.yaml)"
    )
    sub.add_argument("--noise", type=Path, help="folder of noises to mix in")
    sub.add_argument("--audiograms", type=Path, help="CSV of measured ears to join the drawn ones")
    sub.add_argument("--valid-noise", type=Path, help="folder of noises to validate with")
    sub.add_argument("--valid-audiograms", type=Path, help="CSV of ears to validate with")
    _training(sub, minutes=60.0)

    sub = command("train-compensator", _train_compensator, "train a compensator through a frozen simulator")
    sub.add_argument("--config", type=Path, help="recipe, a YAML file (examples/compensator.yaml)")
    _audiogram(sub, default=None, text="; without it one compensator for all ears is trained")
    sub.add_argument(
        "--simulator", default="neuro-msbg", help="msbg (exact), or a checkpoint's name or folder"
    )
    sub.add_argument("--noise", type=Path, help="folder of noises to mix in")
    _training(sub, minutes=10.0)

    sub = command(
        "evaluate-simulator", _evaluate_simulator, "compare simulators with MSBG: SNR, STOI, PESQ, bands"
    )
    sub.add_argument(
        "names", nargs="+", metavar="NAME", help="checkpoints, by name or folder, or msbg (exact)"
    )
    sub.add_argument("--speech", type=Path, required=True, help="folder of clean speech")
    sub.add_argument(
        "--audiograms", type=Path, required=True, help="CSV with columns hl_250, hl_500, ... in dB HL"
    )
    sub.add_argument("--noise", type=Path, help="folder of noises; every second item is then noisy")
    sub.add_argument(
        "--teacher", choices=("pyclarity", "msbg"), default="pyclarity", help="what counts as the truth"
    )
    sub.add_argument("--items", type=_count, default=240, help="how many")
    sub.add_argument("--seconds", type=_positive, default=3.0, help="length of an item")
    _seed(sub)
    _out(sub)

    sub = command("haspi-report", _haspi_report, "HASPI before and after a treatment, with paired tests")
    for name, text in (
        ("clean", "clean speech"),
        ("before", "what the ear was given"),
        ("after", "what it is given now"),
    ):
        sub.add_argument(
            f"--{name}", type=Path, required=True, help=f"folder of {text}; the file names are the same"
        )
    _audiogram(sub, default=None, text=", for all files")
    sub.add_argument(
        "--audiograms", type=Path, help="CSV with columns file, hl_250, hl_500, ...: one row a file"
    )
    _full_scale(sub)
    sub.add_argument("--jobs", type=_count, help="processes; all cores by default")
    _seed(sub)
    _out(sub)

    sub = command("benchmark", _benchmark, "time the simulators side by side")
    sub.add_argument("--device", default="cpu", help="cpu or cuda")
    sub.add_argument("--seconds", type=_positive, default=1.0, help="length of the clip")
    sub.add_argument("--repeats", type=_count, default=9, help="counted rounds")
    sub.add_argument("--simulator", default="neuro-msbg", help="the Neuro-MSBG, by name or folder")
    sub.add_argument("--json", type=Path, help="also write the figures to this file")
    return parser


def _audiogram(
    parser: argparse.ArgumentParser, *, default: str | None = None, required: bool = False, text: str = ""
) -> None:
    parser.add_argument(
        "--audiogram",
        default=default,
        required=required,
        help="NH, N1 to N7, S1 to S3, or eight levels in dB HL at 250, 500, 1000, 2000, 3000, 4000, 6000, 8000 Hz, "
        f"separated by commas{text}",
    )


def _training(parser: argparse.ArgumentParser, *, minutes: float) -> None:
    parser.add_argument("--speech", type=Path, required=True, help="folder of clean speech to train on")
    parser.add_argument("--valid-speech", type=Path, help="folder of other speakers to validate on")
    parser.add_argument(
        "--max-minutes", type=_positive, default=minutes, help="of training, resumed parts included"
    )
    parser.add_argument("--max-steps", type=int, default=-1, help="stop earlier; -1 for no such limit")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, only a line a validation")
    _out(parser)


def _out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")


def _seed(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=int, default=0, help="of every random draw")


def _full_scale(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--full-scale-spl", type=float, default=94.0, help="level in dB SPL of a file whose RMS is 1.0"
    )


def _positive(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"{text}; allowed: more than 0")
    return value


def _count(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}; allowed: 1 or more")
    return value


def _ear(text: str) -> Audiogram:
    """An ear from what ``--audiogram`` holds."""
    if "," not in text:
        return Audiogram.standard(text)
    try:
        return Audiogram(tuple(float(part) for part in text.split(",")))
    except ValueError as error:
        raise ValueError(f"--audiogram {text}: {error}") from error


def _simulator(name: str, sample_rate: int, full_scale_spl: float = 94.0) -> torch.nn.Module:
    options: dict[str, Any] = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl}
    return MSBG(**options) if name == "msbg" else load_pretrained(name, **options)


def _recipe(path: Path | None) -> dict[str, Any]:
    if path is None:
        return {}
    yaml = require("yaml", "train")
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: not readable as YAML ({error})") from error
    if not isinstance(data, dict):
        raise ValueError(f"{path}: holds no settings; allowed: 'name: value' lines")
    return data


def _simulate(options: argparse.Namespace) -> None:
    ear = _ear(options.audiogram)
    waveform, rate = read_audio(options.input, any_rate=True)
    inner = min(rate, HIGHEST_RATE)
    simulator = _simulator(options.simulator, inner, options.full_scale_spl)
    with torch.no_grad():
        heard = simulator(resample(waveform, rate, inner), ear)
    write_audio(options.output, resample(heard, inner, rate)[..., : waveform.shape[-1]], rate)


def _train_simulator(options: argparse.Namespace) -> None:
    require("lightning", "train")
    from hlsim.training.simulator import SimulatorData, SimulatorRecipe, train_simulator

    data = SimulatorData(
        options.speech,
        options.noise,
        options.audiograms,
        options.valid_speech,
        options.valid_noise,
        options.valid_audiograms,
    )
    folder = train_simulator(
        data, SimulatorRecipe.from_dict(_recipe(options.config)), **_training_options(options)
    )
    print(f"the best checkpoint is in {folder}")


def _train_compensator(options: argparse.Namespace) -> None:
    require("lightning", "train")
    from hlsim.training.compensator import CompensatorData, CompensatorRecipe, train_compensator

    folder = train_compensator(
        CompensatorData(speech=options.speech, noise=options.noise, valid_speech=options.valid_speech),
        CompensatorRecipe.from_dict(_recipe(options.config)),
        audiogram=_ear(options.audiogram) if options.audiogram else None,
        simulator=options.simulator,
        **_training_options(options),
    )
    print(f"the best checkpoint is in {folder}")


def _training_options(options: argparse.Namespace) -> dict[str, Any]:
    return {
        "out": options.out,
        "max_minutes": options.max_minutes,
        "max_steps": options.max_steps,
        "accelerator": "gpu" if options.device == "cuda" else options.device,
        "progress": not options.quiet,
    }


def _evaluate_simulator(options: argparse.Namespace) -> None:
    for module in ("clarity", "pystoi", "pesq"):
        require(module, "eval")
    from hlsim.evaluation.simulators import RATE, evaluate_simulators

    evaluate_simulators(
        {name: _simulator(name, RATE) for name in options.names},
        speech=options.speech,
        audiograms=options.audiograms,
        noise=options.noise,
        out=options.out,
        teacher=options.teacher,
        items=options.items,
        seconds=options.seconds,
        seed=options.seed,
        progress=_progress("items"),
    )
    print((options.out / "fidelity.md").read_text(encoding="utf-8"))


def _haspi_report(options: argparse.Namespace) -> None:
    from hlsim.evaluation import haspi_report

    report = haspi_report(
        options.clean,
        options.before,
        options.after,
        _ear(options.audiogram) if options.audiogram else None,
        audiograms=options.audiograms,
        out=options.out,
        full_scale_spl=options.full_scale_spl,
        seed=options.seed,
        jobs=options.jobs,
        progress=_progress("scores"),
    )
    print(report.to_markdown())


def _benchmark(options: argparse.Namespace) -> None:
    from hlsim.evaluation.benchmark import benchmark, benchmark_markdown

    result = benchmark(
        device=options.device,
        seconds=options.seconds,
        repeats=options.repeats,
        simulator=options.simulator,
        progress=lambda line: print(f"\r{line}", end="", file=sys.stderr, flush=True),
    )
    print(file=sys.stderr)
    print(benchmark_markdown(result))
    if options.json is not None:
        options.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _demo(options: argparse.Namespace) -> None:
    for module, extra in (("lightning", "train"), ("clarity", "eval"), ("matplotlib", "eval")):
        require(module, extra)
    from hlsim.demo import demo

    report = demo(
        options.out,
        _ear(options.audiogram),
        speech=options.speech,
        minutes=options.minutes,
        seed=options.seed,
    )
    print(report)


def _progress(what: str) -> Callable[[int, int], None]:
    def show(done: int, total: int) -> None:
        print(f"\r{done} of {total} {what}", end="\n" if done == total else "", file=sys.stderr, flush=True)

    return show


if __name__ == "__main__":
    sys.exit(main())
