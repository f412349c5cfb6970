"""Measure hlsim on one GPU: equality with the CPU, speed, memory, waits, CUDA graphs, training.

    python docs/figures/gpu.py --out DIR [--minutes 8] [--device cpu] [--small] [--only SECTION ...]

DIR/rows.jsonl gets one line per row as soon as it is measured. A row that is there is not measured
again, so an interrupted run continues where it stopped; delete a line to measure it again. A row
that fails keeps the end of its traceback, and the next one runs. DIR/summary.txt repeats the tables
that are printed at the end.

Signals are seeded noise with the spectrum and the syllable rhythm of speech at 65 dB SPL, so that
no audio file is read. TF32 rounds factors to 10 bits. By torch's defaults convolutions and cuDNN's
LSTM use it (``torch.backends.cudnn.allow_tf32`` is true), and matrix products do not
(``torch.backends.cuda.matmul.allow_tf32`` is false). The section "equality" measures these defaults
and both extremes, and "machine" both extremes of matrix products; the others use the defaults.

Predictions, made before the first run on a GPU
-----------------------------------------------
``PREDICTIONS`` holds, for a call with one item of 4 s, the number of operations that launch a
kernel and the megabytes that they read and write, as counted on a CPU by ``python
docs/figures/gpu.py --device cpu --only operations --out DIR``. (The count is that of torch's
profiler; an operation is one without children that is no view, and it writes as much as its largest
input holds. On a CPU Mamba works in more and smaller blocks than on a GPU, so that its operations
are upper bounds. Those of HASPI, HASQI and MBSTOI were counted on a pretended device.) We assume 8
microseconds of host time per operation and 2 terabytes per second. The expected time of a call is
the longer one of the two; the table of throughput shows it beside the measurement.

* At batch 1 the GPU waits for the host in every module. At batch 64 MSBG, the networks and the loss
  are limited by memory bandwidth: 41,000 times real time for MSBG at 16 kHz, 15,000 with its
  backward pass; 35,000 and 11,000 for
  ``neuro-msbg-cnn-narrow``.
* HASPI, HASQI and MBSTOI looped over their items in the first run: 180 to 420 times real time for
  HASPI. HASPI and HASQI process whole batches since; we expect 300 times real time at batch 1,
  where the host is the limit, and above the goal of 1,000 at batches of 16 and 64.
* Equality: without TF32 values agree to 1e-5 and gradients to 1e-3, as float32 and float64 do on a
  CPU. With torch's defaults the networks and resampling (convolutions) agree to about 1e-3.
* cuDNN's LSTM has a backward pass in training mode only: the gradient through the frozen
  ``neuro-msbg-lstm`` fails.
* The autocast region changes nothing, because compensators leave it; the networks' own
  ``autocast_dtype`` costs about 1e-3 of the output.
* CUDA graphs: networks and compensators are captured, and a replay takes a fifth of an eager call
  at batch 1. MSBG and the loss are not, because they read the ear's levels on the host.
* Table II: 2 ms for MSBG and the small networks; 3 ms for the CNN and the Transformer of the
  paper's size, 10 ms for the LSTM, and 15 ms for Mamba in plain torch.
* Goals: 5,000 times real time for MSBG, 1,000 for HASPI, and 5 ms per row of the paper's Table II.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import os
import statistics
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from compensators import load_compensator
from hlsim import MSBG, Audiogram, HASPILoss, HearingLossLoss, NeuroMSBG, load_pretrained
from hlsim.calibration import set_level
from hlsim.checkpoint import list_pretrained
from hlsim.losses.criteria import CRITERIA, weighted_sum
from hlsim.losses.paper import paper_parts
from hlsim.metrics import haspi, hasqi, mbstoi
from hlsim.neuro import NeuroConfig
from hlsim.neuro.family.scan import _kernel as mamba_kernel

Row = dict[str, Any]
Step = Callable[[], Any]

EARS = ("N1", "N3", "S2", "NH")
"""Ears of the items of a batch, in turns: a mild loss, two severe ones, and none."""

PRECISIONS = {"default": (False, True), "ieee": (False, False), "tf32": (True, True)}
"""Whether matrix products and whether convolutions may use TF32."""

PAPER = {"fft": 400, "window": 400, "hop": 100, "channels": 64, "dense_depth": 4, "stride": (1, 2)}
PAPER |= {"structure": "dual-path", "prior": False, "level_aware": False}
PAPER_NETWORKS = {
    "mamba": PAPER | {"block": "mamba", "blocks": 2, "expansion": 2},
    "lstm": PAPER | {"block": "lstm", "channels": 65, "blocks": 2, "expansion": 1},
    "cnn": PAPER | {"block": "cnn", "blocks": 5, "kernel": (15, 15), "expansion": 4},
    "transformer": PAPER | {"block": "transformer", "blocks": 3, "expansion": 4, "heads": 4},
}
"""The networks of the paper's size, as in ``examples/paper/``."""

PAPER_GPU_MS = {"mamba": 21.0, "lstm": 16.0, "cnn": 16.0}
"""Milliseconds of the paper's Table II on an NVIDIA RTX 3090."""

PAPER_WEIGHTS = {"magnitude": 0.9, "phase": 0.3, "complex": 0.1, "time": 0.2}

PREDICTIONS = {
    "MSBG 16 kHz": ((159, 192.6), (380, 523.4)),
    "MSBG 44.1 kHz": ((186, 333.9), (462, 980.0)),
    "neuro-msbg": ((199, 115.3), (366, 301.7)),
    "neuro-msbg-cnn-narrow": ((200, 229.8), (413, 728.3)),
    "neuro-msbg-cnn": ((190, 218.5), (381, 683.9)),
    "neuro-msbg-lstm": ((224, 224.7), (429, 527.0)),
    "neuro-msbg-mamba": ((2455, 2392.8), (8420, 7635.7)),
    "neuro-msbg-transformer": ((248, 517.1), (525, 1431.2)),
    "loss through neuro-msbg": ((375, 141.5), (723, 346.3)),
    "loss through msbg": ((329, 182.0), (740, 481.7)),
    "HASPI": ((1072, 3498.5), (1740, 6586.0)),
    "HASQI": ((1233, 5806.6), (1939, 10986.9)),
    "MBSTOI": ((201, 1076.8), (341, 1538.1)),
    "HASPILoss": ((1480, 3757.1), (2482, 7356.7)),
    "nalr": ((55, 4.9), (71, 11.9)),
    "wdrc": ((188, 35.3), (500, 98.1)),
    "hearing-aid": ((306, 54.2), (846, 150.4)),
    "compensator-general": ((110, 252.0), (222, 866.5)),
}
"""Operations and megabytes of a call with one item of 4 s, forward and with the backward pass."""

OPERATION_S, BYTES_PER_SECOND = 8e-6, 2e12

DEADLINE = "HLSIM_GPU_DEADLINE"
"""The environment variable that keeps the deadline when the program starts anew."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of what is measured.

    Attributes:
        seconds: Duration of an item in seconds in the sections that measure speed.
        short: Duration of an item in seconds in the section "equality".
        items: Number of items in the section "equality".
        batches: Numbers of items in the section "throughput".
        budget: Duration in seconds for which a measurement repeats its call.
        training: Number and duration in seconds of the items of training steps.
    """

    seconds: float = 4.0
    short: float = 1.0
    items: int = 4
    batches: tuple[int, ...] = (1, 16, 64)
    budget: float = 0.6
    training: tuple[tuple[int, float], ...] = ((3, 1.0), (16, 2.0))


SMALL = Sizes(0.75, 0.75, 2, (1, 2), 0.0, ((1, 0.25),))


@dataclass(frozen=True)
class Subject:
    """A call that is compared and timed.

    Attributes:
        name: Name of the call in tables.
        build: Function that returns the module, on the CPU and in float32.
        call: Function of the module, output and clean speech (items, time), and ears (items, 8).
        rate: Sample rate in Hz.
    """

    name: str
    build: Callable[[], nn.Module]
    call: Callable[[nn.Module, Tensor, Tensor, Tensor], Tensor]
    rate: int = 16000


def process(module: nn.Module, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, ears)


def compare(module: nn.Module, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, clean, ears)


def compare_for_own_ear(module: nn.Module, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, clean)


def compare_two_ears(module: nn.Module, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(two_ears(wave), two_ears(clean), ears.unsqueeze(-2))


def two_ears(wave: Tensor) -> Tensor:
    """The right ear 5 samples late and 2 dB fainter. Shape: (items, time) -> (items, 2, time)."""
    return torch.stack((wave, 0.8 * wave.roll(5, -1)), -2)


def compensators() -> list[Subject]:
    names = ("nalr", "wdrc", "hearing-aid", "compensator-general")
    return [Subject(name, lambda name=name: load_compensator(name), process) for name in names]


def simulator_names() -> list[str]:
    return [name for name, loader in list_pretrained().items() if loader == "load_pretrained"]


def simulators() -> list[Subject]:
    subjects = [
        Subject("MSBG 16 kHz", lambda: MSBG(sample_rate=16000), process),
        Subject("MSBG 44.1 kHz", lambda: MSBG(sample_rate=44100), process, 44100),
    ]
    for name in simulator_names():
        subjects.append(Subject(name, lambda name=name: load_pretrained(name), process))
    return subjects


def losses() -> list[Subject]:
    """The loss with each criterion through each simulator; the ears are given with the call."""
    subjects = []
    for criterion in CRITERIA:
        call = compare_two_ears if criterion == "interaural" else compare
        for simulator in ("neuro-msbg", "msbg"):
            build = loss_builder(simulator=simulator, criterion=criterion)
            subjects.append(Subject(f"loss {criterion}, {simulator}", build, call))
    return subjects


def loss_builder(**options: Any) -> Callable[[], nn.Module]:
    return lambda: HearingLossLoss(**options)


def scores() -> list[Subject]:
    return [
        Subject("HASPI", nn.Identity, lambda _, wave, clean, ears: haspi(wave, clean, ears)),
        Subject("HASQI", nn.Identity, lambda _, wave, clean, ears: hasqi(wave, clean, ears)),
        Subject(
            "MBSTOI",
            nn.Identity,
            lambda _, wave, clean, ears: mbstoi(two_ears(wave), two_ears(clean)),
        ),
        Subject("HASPILoss", HASPILoss, compare),
    ]


def speed_subjects() -> list[Subject]:
    """Calls to be timed. The ear of a loss is given to its constructor."""
    subjects = simulators()
    for simulator in ("neuro-msbg", "msbg"):
        build = loss_builder(audiogram=Audiogram.standard("N3"), simulator=simulator)
        subjects.append(Subject(f"loss through {simulator}", build, compare_for_own_ear))
    return [*subjects, *scores(), *compensators()]


def speech_like(rate: int, seconds: float, items: int, seed: int) -> Tensor:
    """Noise with a spectrum like speech and four syllables per second. Shape: -> (items, time)."""
    generator = torch.Generator().manual_seed(seed)
    samples = round(rate * seconds)
    noise = torch.randn(items, samples, generator=generator)
    hertz = torch.fft.rfftfreq(samples, 1.0 / rate)
    slope = (hertz / 100.0).clamp_max(1.0) / (1.0 + (hertz / 500.0).square()).sqrt()
    shaped = torch.fft.irfft(torch.fft.rfft(noise) * slope, samples)
    phases = 6.28 * torch.rand(items, 1, generator=generator)
    syllables = torch.sin(torch.arange(samples) * (2.0 * torch.pi * 4.0 / rate) + phases)
    return set_level(shaped * syllables.clamp_min(0.03), 65.0)


def signals(rate: int, seconds: float, items: int) -> tuple[Tensor, Tensor, Tensor]:
    """Noisy speech at 10 dB SNR, clean speech, ears. Shape: -> (items, time) twice, (items, 8)."""
    clean = speech_like(rate, seconds, items, seed=0)
    noise = set_level(torch.randn(clean.shape, generator=torch.Generator().manual_seed(1)), 55.0)
    levels = [Audiogram.standard(EARS[item % len(EARS)]).thresholds for item in range(items)]
    return clean + noise, clean, torch.tensor(levels)


def relative_error(values: Tensor, expected: Tensor) -> float:
    """Norm of the difference relative to the norm of the expected values."""
    difference = values.detach().double().cpu() - expected.detach().double().cpu()
    return float(difference.norm() / expected.detach().double().norm().cpu())


@contextmanager
def precision(name: str) -> Iterator[None]:
    """Run with one of ``PRECISIONS``."""
    products, convolutions = PRECISIONS[name]
    before = torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32
    torch.backends.cuda.matmul.allow_tf32 = products
    torch.backends.cudnn.allow_tf32 = convolutions
    try:
        yield
    finally:
        torch.backends.cuda.matmul.allow_tf32, torch.backends.cudnn.allow_tf32 = before


class Call:
    """A subject with its signals on a device, ready to be called."""

    def __init__(
        self,
        subject: Subject,
        device: torch.device,
        seconds: float,
        items: int,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.subject = subject
        self.module = subject.build().to(device, dtype)
        tensors = (tensor.to(device, dtype) for tensor in signals(subject.rate, seconds, items))
        self.wave, self.clean, self.ears = tensors
        self.wave.requires_grad_()

    def value(self) -> Tensor:
        return self.subject.call(self.module, self.wave, self.clean, self.ears)

    def forward(self) -> Tensor:
        with torch.no_grad():
            return self.value()

    def both(self) -> tuple[Tensor, Tensor]:
        """Value, and gradient with respect to the output.

        The gradient is that of a waveform's energy, or of the sum of scores or losses.
        """
        value = self.value()
        total = value.square().sum() if value.shape[-1:] == self.wave.shape[-1:] else value.sum()
        (gradient,) = torch.autograd.grad(total, self.wave)
        return value.detach(), gradient


class Run:
    """A run with its rows, its deadline and its device."""

    def __init__(self, out: Path, device: torch.device, sizes: Sizes, deadline: float) -> None:
        self.device, self.sizes, self.deadline = device, sizes, deadline
        self.path = out / "rows.jsonl"
        self.rows: list[Row] = []
        self.left_out: list[str] = []
        if self.path.is_file():
            lines = self.path.read_text(encoding="utf-8").splitlines()
            self.rows = [json.loads(line) for line in lines]

    @property
    def on_gpu(self) -> bool:
        return self.device.type == "cuda"

    def add_row(self, section: str, name: str, measure: Callable[[], Row]) -> None:
        """Measure a row and append it to the file, unless it is there or the time is over."""
        if any(row["section"] == section and row["name"] == name for row in self.rows):
            return
        if time.time() > self.deadline:
            self.left_out.append(f"{section}: {name}")
            return
        row: Row = {"section": section, "name": name}
        start = time.perf_counter()
        try:
            row |= measure()
            self.synchronise()
        except Exception as error:  # one failing row must not stop the rest
            lines = traceback.format_exception(error)
            row["error"] = "".join(lines).strip().splitlines()[-6:]
        row["took_s"] = round(time.perf_counter() - start, 2)
        self.rows.append(row)
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        outcome = row["error"][-1][:150] if "error" in row else "done"
        print(f"{section}: {name}: {outcome} ({row['took_s']} s)", flush=True)
        self.recover("error" in row)

    def recover(self, failed: bool) -> None:
        """Free memory. Start the program anew after an error that broke the CUDA context."""
        gc.collect()
        if not self.on_gpu:
            return
        try:
            if failed:
                # a failed capture leaves its own stream behind
                torch.cuda.set_stream(torch.cuda.default_stream(self.device))
            torch.cuda.empty_cache()
            if failed:
                torch.cuda.synchronize()
                float(torch.randn(8, device=self.device).sum())
        except Exception as error:
            print(f"the device is broken, starting anew ({error})", flush=True)
            os.environ[DEADLINE] = str(self.deadline)
            os.execv(sys.executable, [sys.executable, *sys.argv])

    def synchronise(self) -> None:
        if self.on_gpu:
            torch.cuda.synchronize(self.device)

    def time(self, call: Step, budget: float | None = None) -> Row:
        """Milliseconds of the first call, median and minimum of the others, and peak memory.

        CUDA events measure calls that follow each other. ``latency_ms`` is the median wall time of
        single calls, each waited for. Memory that was allocated before does not count.
        """
        budget = self.sizes.budget if budget is None else budget
        row: Row = {"first_ms": self.latency(call)}
        if self.on_gpu:
            torch.cuda.reset_peak_memory_stats(self.device)
            allocated = torch.cuda.memory_allocated(self.device)
        estimate = self.latency(call)
        if self.on_gpu:
            peak = torch.cuda.max_memory_allocated(self.device) - allocated
            row["peak_mib"] = round(peak / 2**20, 1)
        count = int(min(50, max(0.0, 500.0 * budget / estimate)))
        if count < 2:
            return row | {
                "median_ms": estimate,
                "least_ms": estimate,
                "latency_ms": estimate,
                "calls": 1,
            }
        latencies = [self.latency(call) for _ in range(count)]
        times = self.event_times(call, count) if self.on_gpu else latencies
        row["median_ms"], row["least_ms"] = statistics.median(times), min(times)
        return row | {"latency_ms": statistics.median(latencies), "calls": count}

    def latency(self, call: Step) -> float:
        self.synchronise()
        start = time.perf_counter()
        call()
        self.synchronise()
        return 1000.0 * (time.perf_counter() - start)

    def event_times(self, call: Step, count: int) -> list[float]:
        """Milliseconds of each of several calls in a row, by CUDA events."""
        events = [torch.cuda.Event(enable_timing=True) for _ in range(count + 1)]
        events[0].record()
        for event in events[1:]:
            call()
            event.record()
        self.synchronise()
        return [first.elapsed_time(second) for first, second in pairwise(events)]


# -- Sections --------------------------------------------------------------------------------------


def machine(run: Run) -> None:
    run.add_row("machine", "about", lambda: about(run))
    if run.on_gpu:
        run.add_row("machine", "ceilings", lambda: ceilings(run))


def about(run: Run) -> Row:
    row: Row = {
        "device": str(run.device),
        "torch": torch.__version__,
        "python": sys.version.split()[0],
    }
    row |= {"cores": os.cpu_count(), "threads": torch.get_num_threads()}
    row["mamba_ssm"] = mamba_kernel() is not None
    row["tf32"] = {
        "products": torch.backends.cuda.matmul.allow_tf32,
        "convolutions": torch.backends.cudnn.allow_tf32,
    }
    if run.on_gpu:
        row["gpu"] = torch.cuda.get_device_name(run.device)
        row |= {"cuda": torch.version.cuda, "cudnn": torch.backends.cudnn.version()}
        query = [
            "nvidia-smi",
            "--query-gpu=driver_version,clocks.sm,memory.total",
            "--format=csv,noheader",
        ]
        row["driver"] = subprocess.run(
            query, capture_output=True, text=True, check=False
        ).stdout.strip()
    return row


def ceilings(run: Run) -> Row:
    """Bandwidth of a copy, rates of matrix products, and microseconds of a tiny operation."""
    size = 8192
    large = torch.randn(2**28, device=run.device)
    target = torch.empty_like(large)
    copy = run.time(lambda: target.copy_(large), 0.2)["median_ms"]
    row: Row = {"copy_tb_s": 2 * 4 * 2**28 / copy / 1e9}
    for name, dtype in (("ieee", torch.float32), ("tf32", torch.float32), ("bf16", torch.bfloat16)):
        factor = torch.randn(size, size, device=run.device, dtype=dtype)
        with precision("ieee" if name == "ieee" else "tf32"):
            product = run.time(lambda factor=factor: factor @ factor, 0.2)["median_ms"]
        row[f"{name}_tflop_s"] = 2 * size**3 / product / 1e9
    small = torch.randn(8, device=run.device)

    def thousand() -> None:
        for _ in range(1000):
            small.add(1.0)

    row["operation_us"] = run.time(thousand, 0.2)["median_ms"]
    return row


def equality(run: Run) -> None:
    for subject in [*simulators(), *losses(), *scores(), *compensators()]:
        run.add_row("equality", subject.name, lambda subject=subject: equality_row(run, subject))


def equality_row(run: Run, subject: Subject) -> Row:
    """Relative errors of value and gradient to the CPU in float32 and in float64."""
    size = run.sizes.short, run.sizes.items
    cpu = torch.device("cpu")
    single = Call(subject, cpu, *size).both()
    row: Row = {}
    try:
        double = Call(subject, cpu, *size, torch.float64).both()
        row["cpu"] = {"float64": errors(single, double)}
    except Exception as error:
        double, row["note"] = None, f"no float64: {type(error).__name__}: {error}"[:200]
    for name in PRECISIONS if run.on_gpu else ("default",):
        with precision(name):
            call = Call(subject, run.device, *size)
            try:
                values = call.both()
            except Exception as error:  # the value may be right where the gradient fails
                value_error = relative_error(call.forward(), single[0])
                message = f"{type(error).__name__}: {error}"[:300]
                row[name] = {"float32": [value_error, None], "gradient_fails": message}
                continue
        row[name] = {"float32": errors(values, single)}
        if double is not None:
            row[name]["float64"] = errors(values, double)
    return row


def errors(values: Iterable[Tensor], expected: Iterable[Tensor]) -> list[float]:
    pairs = zip(values, expected, strict=True)
    return [relative_error(first, second) for first, second in pairs]


def table_two(run: Run) -> None:
    """The paper's Table II: 1 s at 44.1 kHz, batch 1. Networks of its size have random weights."""
    seconds = min(1.0, run.sizes.seconds)
    wave, _, ears = (tensor.to(run.device) for tensor in signals(44100, seconds, 2))
    wave, ear = wave[1:], ears[1:]

    def measure(module: nn.Module, paper_ms: float | None = None) -> Row:
        module = module.to(run.device).eval()
        count = sum(parameter.numel() for parameter in module.parameters())
        with torch.no_grad():
            row = run.time(lambda: module(wave, ear))
        return row | {"parameters": count, "paper_ms": paper_ms}

    run.add_row("table-2", "MSBG", lambda: measure(MSBG(sample_rate=44100)))
    for name, settings in PAPER_NETWORKS.items():
        run.add_row(
            "table-2",
            f"{name}, paper's size",
            lambda name=name, settings=settings: measure(
                NeuroMSBG(NeuroConfig(**settings), sample_rate=44100), PAPER_GPU_MS.get(name)
            ),
        )
    for name in simulator_names():
        run.add_row(
            "table-2", name, lambda name=name: measure(load_pretrained(name, sample_rate=44100))
        )


def throughput(run: Run) -> None:
    for subject in speed_subjects():
        for items in run.sizes.batches:
            run.add_row(
                "throughput",
                f"{subject.name}, {items}",
                lambda subject=subject, items=items: throughput_row(run, subject, items),
            )


def throughput_row(run: Run, subject: Subject, items: int) -> Row:
    """Times forward and with the backward pass, and seconds of audio per second."""
    call = Call(subject, run.device, run.sizes.seconds, items)
    row: Row = {"items": items, "seconds": run.sizes.seconds}
    for direction, step in (("forward", call.forward), ("both", call.both)):
        try:
            times = run.time(step)
        except Exception as error:
            row[direction] = {"error": f"{type(error).__name__}: {error}"[:300]}
            continue
        row[direction] = times | {
            "real_time": 1000.0 * items * run.sizes.seconds / times["median_ms"]
        }
    return row


def waits(run: Run) -> None:
    items = min(4, max(run.sizes.batches))
    for subject in [*speed_subjects(), *losses()]:
        run.add_row("waits", subject.name, lambda subject=subject: waits_row(run, subject, items))


def waits_row(run: Run, subject: Subject, items: int) -> Row:
    """Number of times that a call makes the host wait for the device, by the line of hlsim."""
    if not run.on_gpu:
        return {"skipped": "needs a GPU"}
    row: Row = {"items": items}
    call = Call(subject, run.device, min(1.0, run.sizes.seconds), items)
    for direction, step in (("forward", call.forward), ("both", call.both)):
        step()
        run.synchronise()
        with counted_waits() as lines:
            step()
        row[direction] = dict(lines.most_common(12))
        row[f"{direction}_total"] = sum(lines.values())
    return row


@contextmanager
def counted_waits() -> Iterator[Counter[str]]:
    """Count torch's warnings of synchronizing operations by the line of hlsim that caused them."""
    lines: Counter[str] = Counter()

    def count(message: Any, *_: Any, **__: Any) -> None:
        if "called a synchronizing" in str(message):
            lines[calling_line()] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = count
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield lines
        finally:
            torch.cuda.set_sync_debug_mode("default")


def calling_line() -> str:
    """The innermost line of hlsim on the stack, or "elsewhere" if there is none."""
    root = Path(__file__).resolve().parents[2]
    frame: Any = sys._getframe()
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(root) and path.name != Path(__file__).name:
            return f"{path.relative_to(root)}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


def capture(run: Run) -> None:
    """CUDA graphs: of simulators, aids and HASPI forward, and of the loss with its gradient."""
    items = 1 if run.sizes is SMALL else 4
    chosen = {"MSBG 16 kHz", "neuro-msbg", "neuro-msbg-cnn-narrow", "neuro-msbg-mamba", "HASPI"}
    for subject in speed_subjects():
        if subject.name in chosen or subject.name.startswith(
            ("loss", "hearing-aid", "compensator")
        ):
            for batch in (1, items):
                run.add_row(
                    "capture",
                    f"{subject.name}, {batch}",
                    lambda subject=subject, batch=batch: capture_row(run, subject, batch),
                )


def capture_row(run: Run, subject: Subject, items: int) -> Row:
    """Time of a replay beside that of eager calls, and the error of a replay on other signals."""
    if not run.on_gpu:
        return {"skipped": "needs a GPU"}
    call = Call(subject, run.device, min(1.0, run.sizes.seconds), items)
    gradient = subject.name.startswith("loss")
    step = call.both if gradient else lambda: (call.forward(),)
    row: Row = {"gradient": gradient, "eager_ms": run.time(step, 0.3)["latency_ms"]}
    with counted_waits() as lines:
        step()
    if lines:  # a capture would fail, and torch's allocator with it
        return row | {
            "waits": sum(lines.values()),
            "lines": [line for line, _ in lines.most_common()],
        }
    side = torch.cuda.Stream()
    side.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(side):
        for _ in range(3):
            step()
    torch.cuda.current_stream().wait_stream(side)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = step()
    row["replay_ms"] = run.time(graph.replay, 0.3)["latency_ms"]
    with torch.no_grad():
        call.wave.copy_(0.7 * call.wave.flip(-1))
        call.clean.copy_(call.clean.flip(-1))
    graph.replay()
    run.synchronise()
    row["replay_error"] = errors([tensor.clone() for tensor in captured], step())
    return row


def autocast(run: Run) -> None:
    """Compensators and networks in bfloat16: outputs and times beside those in float32."""
    items = 2 if run.sizes is SMALL else 16
    for name in ("compensator-general", "hearing-aid"):
        run.add_row(
            "autocast",
            f"{name}, autocast region",
            lambda name=name: autocast_row(run, load_compensator(name), items, inside=False),
        )
    for name in ("neuro-msbg", "neuro-msbg-mamba"):
        run.add_row(
            "autocast",
            f"{name}, layers",
            lambda name=name: autocast_row(run, load_pretrained(name), items, inside=True),
        )


def autocast_row(run: Run, model: nn.Module, items: int, inside: bool) -> Row:
    """Compare bfloat16 with float32.

    Args:
        inside: Set the network's ``autocast_dtype`` instead of calling it in an autocast region.
    """
    model = model.to(run.device)
    wave, _, ears = (tensor.to(run.device) for tensor in signals(16000, run.sizes.seconds, items))
    with torch.no_grad():
        whole = model(wave, ears)
        row: Row = {"float32_ms": run.time(lambda: model(wave, ears))["median_ms"]}
        if inside:
            model.autocast_dtype = torch.bfloat16
        with torch.autocast(run.device.type, torch.bfloat16, enabled=not inside):
            row["value_error"] = relative_error(model(wave, ears), whole)
            row["bfloat16_ms"] = run.time(lambda: model(wave, ears))["median_ms"]
    return row


def training(run: Run) -> None:
    """Training steps of the networks of the paper's size, and of a compensator through the loss."""
    for items, seconds in run.sizes.training:
        size = f"{items} x {seconds:g} s"
        for block in PAPER_NETWORKS:
            for lower in (None, torch.bfloat16):
                kind = "float32" if lower is None else "bfloat16"
                run.add_row(
                    "training",
                    f"{block} {kind}, {size}",
                    lambda block=block, lower=lower, items=items, seconds=seconds: simulator_row(
                        run, block, lower, items, seconds
                    ),
                )
        if mamba_kernel() is not None:
            run.add_row(
                "training",
                f"mamba-ssm float32, {size}",
                lambda items=items, seconds=seconds: simulator_row(
                    run, "mamba", None, items, seconds, plain=False
                ),
            )
    items, seconds = run.sizes.batches[-2], run.sizes.seconds
    for simulator in ("neuro-msbg", "msbg"):
        run.add_row(
            "training",
            f"compensator through {simulator}, {items} x {seconds:g} s",
            lambda simulator=simulator: compensator_row(run, simulator, items, seconds),
        )


def simulator_row(
    run: Run,
    block: str,
    lower: torch.dtype | None,
    items: int,
    seconds: float,
    plain: bool = True,
) -> Row:
    """A step of AdamW on the paper's loss, with Mamba's scan in plain torch if ``plain``."""
    torch.manual_seed(0)
    network = NeuroMSBG(NeuroConfig(**PAPER_NETWORKS[block])).to(run.device).train()
    network.autocast_dtype = lower
    wave, clean, ears = (tensor.to(run.device) for tensor in signals(16000, seconds, items))
    scale = clean.square().mean(-1, keepdim=True).rsqrt()

    def loss() -> Tensor:
        perceived = network(wave, ears)
        parts = paper_parts(perceived * scale, clean * scale)
        return weighted_sum(parts, PAPER_WEIGHTS).mean()

    if not plain:
        return step_row(run, network, loss, items * seconds)
    with mock.patch("hlsim.neuro.family.scan._kernel", lambda: None):
        return step_row(run, network, loss, items * seconds)


def compensator_row(run: Run, simulator: str, items: int, seconds: float) -> Row:
    """A step of AdamW of ``compensator-general`` through the default loss for one ear."""
    ear = Audiogram.standard("N3")
    network = load_compensator("compensator-general").to(run.device).train().requires_grad_(True)
    criterion = HearingLossLoss(ear, simulator=simulator).to(run.device)
    wave, clean, _ = (tensor.to(run.device) for tensor in signals(16000, seconds, items))
    return step_row(run, network, lambda: criterion(network(wave, ear), clean), items * seconds)


def step_row(run: Run, network: nn.Module, loss: Callable[[], Tensor], audio: float) -> Row:
    optimiser = torch.optim.AdamW(network.parameters(), lr=5e-4)
    values: list[Tensor] = []

    def step() -> None:
        optimiser.zero_grad(set_to_none=True)
        value = loss()
        value.backward()
        optimiser.step()
        values.append(value.detach())

    row = run.time(step)
    count = sum(parameter.numel() for parameter in network.parameters())
    row |= {"parameters": count, "first_loss": float(values[0]), "last_loss": float(values[-1])}
    return row | {"real_time": 1000.0 * audio / row["median_ms"]}


def operations(run: Run) -> None:
    for subject in speed_subjects():
        run.add_row(
            "operations", subject.name, lambda subject=subject: operations_row(run, subject)
        )


def operations_row(run: Run, subject: Subject) -> Row:
    """Operations and bytes of a call with one item, and on a GPU its kernels and their time."""
    call = Call(subject, run.device, run.sizes.seconds, 1)
    row: Row = {}
    for direction, step in (("forward", call.forward), ("both", call.both)):
        step()
        run.synchronise()
        kinds = [torch.profiler.ProfilerActivity.CPU]
        if run.on_gpu:
            kinds.append(torch.profiler.ProfilerActivity.CUDA)
        with torch.profiler.profile(activities=kinds, record_shapes=True) as profile:
            step()
            run.synchronise()
        row[direction] = count_operations(profile.events())
    return row


VIEWS = set(
    (
        "view reshape transpose permute expand select slice unsqueeze squeeze as_strided empty "
        "empty_like empty_strided split chunk detach unfold narrow alias item _local_scalar_dense "
        "real imag view_as_real t mT view_as_complex resolve_conj resolve_neg diagonal lift_fresh "
        "unbind conj movedim _conj numpy_T is_nonzero result_type expand_as new_empty set "
        "unflatten flatten swapaxes _unsafe_view split_with_sizes _reshape_alias broadcast_tensors "
        "broadcast_to expand_copy resize _has_compatible_shallow_copy_type"
    ).split()
)
"""Operations that launch no kernel."""


def count_operations(events: Iterable[Any]) -> Row:
    """Operations that launch a kernel, the megabytes that they move, and kernels on a GPU."""
    number = moved = kernels = 0
    busy_us = 0.0
    for event in events:
        if event.device_type != torch.autograd.DeviceType.CPU:
            kernels += 1
            busy_us += event.time_range.elapsed_us()
        elif launches_kernel(event) and not any(
            launches_kernel(child) for child in event.cpu_children
        ):
            sizes = [element_count(shape) for shape in event.input_shapes]
            number += 1
            moved += 4 * (sum(sizes) + max(sizes, default=0))
    row: Row = {"operations": number, "moved_mb": round(moved / 1e6, 1)}
    return row | {"kernels": kernels, "busy_ms": round(busy_us / 1e3, 3)}


def launches_kernel(event: Any) -> bool:
    name = event.name
    return name.startswith("aten::") and name.removeprefix("aten::").rstrip("_") not in VIEWS


def element_count(shape: Any) -> int:
    if not shape or not all(isinstance(size, int) for size in shape):
        return 0
    return math.prod(shape)


SECTIONS: dict[str, Callable[[Run], None]] = {
    "machine": machine,
    "equality": equality,
    "table-2": table_two,
    "throughput": throughput,
    "waits": waits,
    "capture": capture,
    "autocast": autocast,
    "training": training,
    "operations": operations,
}
"""Functions that measure the sections, the most important one first."""


# -- Summary ---------------------------------------------------------------------------------------


def summary(run: Run) -> str:
    """All rows as text, a table for each section."""
    lines: list[str] = []
    for section in SECTIONS:
        rows = [row for row in run.rows if row["section"] == section]
        if rows:
            lines += ["", f"== {section}: {HEADINGS.get(section, '')}"]
            if section == "throughput":
                lines += throughput_lines(rows)
            else:
                lines += [summary_line(section, row) for row in rows]
        if section == "waits":
            lines += most_frequent_waits(rows)
    if run.left_out:
        lines += ["", f"Time was over; {len(run.left_out)} rows left out, from {run.left_out[0]!r}"]
    return "\n".join(lines)


HEADINGS = {
    "equality": "errors of value/gradient: CPU float32 to float64 | GPU to CPU, each TF32 setting",
    "table-2": "1 s at 44.1 kHz, batch 1: wall ms, [ms by events], paper's ms on an RTX 3090",
    "throughput": "batch: times real time forward/with backward [predicted], peak memory",
    "waits": "waits of the host forward, with backward",
    "capture": "eager ms, replay ms, errors of a replay on other signals",
    "autocast": "float32 ms, bfloat16 ms, relative error of the output",
    "training": "ms per step, times real time, peak MiB, parameters",
    "operations": "one item: operations, MB moved, kernels, ms of kernels; forward | with backward",
}


def summary_line(section: str, row: Row) -> str:
    name = f"{row['name'][:36]:36}"
    if "error" in row:
        return f"{name} FAILED {row['error'][-1][:200]}"
    if "skipped" in row:
        return f"{name} skipped: {row['skipped']}"
    return f"{name} {LINES.get(section, str)(row)}"


def equality_line(row: Row) -> str:
    parts = ["-" if "cpu" not in row else pair(row["cpu"]["float64"]), "|"]
    for name in PRECISIONS:
        if name in row:
            parts.append(f"{name} {pair(row[name]['float32'])}")
    failures = [
        row[name]["gradient_fails"] for name in PRECISIONS if "gradient_fails" in row.get(name, {})
    ]
    return " ".join([*parts, *failures[:1]])[:200]


def pair(values: list[float | None]) -> str:
    return "/".join("none" if value is None else f"{value:.0e}" for value in values)


def table_two_line(row: Row) -> str:
    paper = "" if row["paper_ms"] is None else f", paper {row['paper_ms']:g}"
    return (
        f"{row['latency_ms']:.2f} [{row['median_ms']:.2f}]{paper}, {row['parameters']} parameters"
    )


def throughput_lines(rows: list[Row]) -> list[str]:
    """A line for each subject, with its batches."""
    lines: dict[str, list[str]] = {}
    for row in rows:
        name = row["name"].rsplit(",", 1)[0]
        parts = lines.setdefault(name, [f"{name[:26]:26}"])
        if "error" in row:
            parts.append(f"FAILED {row['error'][-1][:100]}")
            continue
        factors = "/".join(
            real_time_or_failure(row[direction]) for direction in ("forward", "both")
        )
        predicted = predicted_real_time(row)
        expected = "" if predicted is None else f" [{predicted[0]:.0f}/{predicted[1]:.0f}]"
        peak = row["both"].get("peak_mib", "-")
        parts.append(f"{row['items']}: {factors}{expected} {peak} MiB;")
    return [" ".join(parts) for parts in lines.values()]


def real_time_or_failure(times: Row) -> str:
    return f"FAILED {times['error'][:60]}" if "error" in times else f"{times['real_time']:.0f}"


def predicted_real_time(row: Row) -> tuple[float, float] | None:
    """Real-time factors that ``PREDICTIONS`` expect, forward and with the backward pass."""
    name = row["name"].rsplit(",", 1)[0]
    if name not in PREDICTIONS:
        return None
    items = row["items"]
    factors = []
    for count, megabytes in PREDICTIONS[name]:
        launching = count * OPERATION_S
        moving = megabytes * 1e6 * items / BYTES_PER_SECOND
        factors.append(4.0 * items / max(launching, moving))
    return factors[0], factors[1]


def waits_line(row: Row) -> str:
    return f"{row['forward_total']}, {row['both_total']}"


def most_frequent_waits(rows: list[Row]) -> list[str]:
    lines: Counter[str] = Counter()
    for row in rows:
        lines.update(row.get("both", {}))
    return [f"  {count:4} {line}" for line, count in lines.most_common(20)]


def capture_line(row: Row) -> str:
    if "waits" in row:
        return f"not tried: {row['waits']} waits of the host, {row['lines'][:2]}"
    return f"{row['eager_ms']:.2f}, {row['replay_ms']:.2f}, {pair(row['replay_error'])}"


def autocast_line(row: Row) -> str:
    return f"{row['float32_ms']:.2f}, {row['bfloat16_ms']:.2f}, {row['value_error']:.1e}"


def training_line(row: Row) -> str:
    peak = row.get("peak_mib", "-")
    return f"{row['median_ms']:.1f}, {row['real_time']:.0f}, {peak}, {row['parameters']}"


def operations_line(row: Row) -> str:
    columns = ("operations", "moved_mb", "kernels", "busy_ms")
    directions = (
        " ".join(str(row[way][column]) for column in columns) for way in ("forward", "both")
    )
    return " | ".join(directions)


def machine_line(row: Row) -> str:
    return ", ".join(
        f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
        for key, value in row.items()
        if key not in ("section", "name", "took_s")
    )


LINES: dict[str, Callable[[Row], str]] = {
    "machine": machine_line,
    "equality": equality_line,
    "table-2": table_two_line,
    "waits": waits_line,
    "capture": capture_line,
    "autocast": autocast_line,
    "training": training_line,
    "operations": operations_line,
}


def main(arguments: list[str] | None = None) -> None:
    started = time.time()
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--minutes", type=float, default=8.0, help="no row begins later than this")
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--small", action="store_true", help="sizes for a rehearsal on a CPU")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    options = parser.parse_args(arguments)
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no GPU; rehearse with --device cpu --small")
    options.out.mkdir(parents=True, exist_ok=True)
    deadline = float(os.environ.get(DEADLINE, started + 60.0 * options.minutes))
    device = torch.device(options.device)
    run = Run(options.out, device, SMALL if options.small else Sizes(), deadline)
    for section in SECTIONS:
        if section in options.only:
            SECTIONS[section](run)
    text = summary(run)
    (options.out / "summary.txt").write_text(text + "\n", encoding="utf-8")
    print(text)
    print(f"\n{time.time() - started:.0f} s in all")


if __name__ == "__main__":
    main()
