"""Times of simulators, loss, training step and metrics, and their ratios to pyclarity's.

    python docs/figures/benchmark.py
    python docs/figures/benchmark.py --what simulators --simulators neuro-msbg runs/mine/checkpoint
    OMP_NUM_THREADS=1 python docs/figures/benchmark.py --what loss step --seconds 2 --batch 8
    OMP_NUM_THREADS=1 python docs/figures/benchmark.py --processor-time  # on a busy machine
    OMP_NUM_THREADS=1 python docs/figures/benchmark.py --what parts  # of the exact MSBG

Every round times all rows of a table in turn, so that a ratio compares calls within seconds of each
other. The first round is not counted. Tables show the median (minimum to maximum) of the other
rounds, that of ``parts`` the median alone.
"""

import argparse
import cProfile
import logging
import pstats
import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from compensators import MappingCompensator
from hlsim import MSBG, Audiogram, HearingLossLoss, list_pretrained, load_pretrained
from hlsim.calibration import set_level
from hlsim.metrics import haspi, hasqi, mbstoi

EAR = Audiogram.standard("N2")
FULL_SCALE_SPL = 94.0
SHIPPED = [name for name in list_pretrained() if name.startswith("neuro-")]
LOSS_SIMULATORS = ("neuro-msbg", "msbg")
SHORT_SECONDS = 0.02  # so short that only the cost of calling torch's operations remains
PYCLARITY_RATE = 44100  # Hz, the only rate of pyclarity's MSBG


class Row(NamedTuple):
    """A call to time.

    Attributes:
        call: Function without arguments that returns a tensor.
        reference: Name of the row of pyclarity that the ratios refer to.
        backward: Whether the call is differentiable; it is then timed with its backward pass, too.
    """

    name: str
    call: Callable[[], Tensor]
    reference: str
    backward: bool = True


def noise_like_speech(rate: int, seconds: float, batch: int, seed: int = 0) -> Tensor:
    """Make noise at 65 dB SPL, modulated at the rate of syllables. Shape: -> (batch, time)."""
    generator = torch.Generator().manual_seed(seed)
    samples = round(rate * seconds)
    envelope = torch.sin(2.0 * torch.pi * 4.0 * torch.arange(samples) / rate).clamp_min(0.05)
    return set_level(torch.randn(batch, samples, generator=generator) * envelope, 65.0)


def simulator_rows(options: argparse.Namespace) -> list[Row]:
    """Exact MSBG, Neuro-MSBG and pyclarity's two models."""
    device, reference = options.device, "pyclarity Ear, 44100 Hz"
    inputs = {}
    for rate in (PYCLARITY_RATE, 16000):
        signal = noise_like_speech(rate, options.seconds, options.batch).to(device)
        inputs[rate] = signal.requires_grad_()
    rows = pyclarity_simulator_rows(inputs[PYCLARITY_RATE], reference, device)
    for rate, signal in inputs.items():
        exact = MSBG(EAR, sample_rate=rate).to(device)
        rows.append(Row(f"MSBG (exact), {rate} Hz", lambda m=exact, x=signal: m(x), reference))
        for name in options.simulators or SHIPPED:
            network = load_pretrained(name, sample_rate=rate).to(device)
            parameters = sum(weights.numel() for weights in network.parameters())
            title = f"{name} ({parameters:,} parameters), {rate} Hz"
            rows.append(Row(title, lambda m=network, x=signal: m(x, EAR), reference))
    return rows


def pyclarity_simulator_rows(signal: Tensor, reference: str, device: str) -> list[Row]:
    """pyclarity's reference in NumPy, which processes single items on the CPU, and its torch
    model."""
    from clarity.evaluator.msbg.msbg import Ear
    from clarity.predictor.torch_msbg import MSBGHearingModel

    logging.getLogger("clarity").setLevel(logging.ERROR)
    ear = Ear(equiv_0db_spl=FULL_SCALE_SPL - 20.0)  # pyclarity adds 20 dB.
    ear.set_audiogram(EAR.to_clarity())
    items = signal.detach().cpu().double().numpy()
    model = MSBGHearingModel(
        np.array(EAR.thresholds), np.array(EAR.frequencies), sr=PYCLARITY_RATE, device=device
    ).to(device)

    def process_items() -> Tensor:
        return torch.from_numpy(np.stack([ear.process(item)[0] for item in items]))

    return [
        Row(reference, process_items, reference, backward=False),
        Row(f"pyclarity torch_msbg, {PYCLARITY_RATE} Hz", lambda: model(signal), reference),
    ]


def loss_rows(options: argparse.Namespace) -> list[Row]:
    """The loss through each simulator, and a loss of auraloss, without the network that they
    train."""
    from auraloss.freq import MultiResolutionSTFTLoss

    clean = noise_like_speech(16000, options.seconds, options.batch).to(options.device)
    output = noise_like_speech(16000, options.seconds, options.batch, seed=1).to(options.device)
    output.requires_grad_()
    rows = []
    for simulator in LOSS_SIMULATORS:
        loss = HearingLossLoss(EAR, simulator=simulator).to(options.device)
        rows.append(Row(f"HearingLossLoss ({simulator})", lambda f=loss: f(output, clean), ""))
    spectral = MultiResolutionSTFTLoss().to(options.device)
    pair = (output.unsqueeze(1), clean.unsqueeze(1))
    rows.append(Row("auraloss, MultiResolutionSTFTLoss", lambda: spectral(*pair), ""))
    return rows


def step_rows(options: argparse.Namespace) -> list[Row]:
    """An untrained compensator alone, and with the loss behind it: what a training step
    computes."""
    clean = noise_like_speech(16000, options.seconds, options.batch).to(options.device)
    network = MappingCompensator().to(options.device).train()
    rows = [Row("compensator alone", lambda: network(clean, EAR), "")]
    for simulator in LOSS_SIMULATORS:
        loss = HearingLossLoss(EAR, simulator=simulator).to(options.device)
        title = f"compensator and HearingLossLoss ({simulator})"
        rows.append(Row(title, lambda f=loss: f(network(clean, EAR), clean), ""))
    return rows


def metric_rows(options: argparse.Namespace) -> list[Row]:
    """HASPI, HASQI and MBSTOI of one pair of at least 1 s, by hlsim and by pyclarity."""
    from clarity.evaluator.haspi import haspi_v2
    from clarity.evaluator.hasqi import hasqi_v2
    from clarity.evaluator.mbstoi import mbstoi as pyclarity_mbstoi

    rate, seconds = 16000, max(1.0, options.seconds)
    clean = noise_like_speech(rate, seconds, 2)
    output = clean + 0.3 * noise_like_speech(rate, seconds, 2, seed=1)
    pair = (clean[0].double().numpy(), output[0].double().numpy())
    both_ears = (*clean.double().numpy(), *output.double().numpy())
    clarity_ear = EAR.to_clarity()
    ours, clean = output.to(options.device).requires_grad_(), clean.to(options.device)

    def one_ear(score: Callable[..., tuple[float, ...]]) -> Tensor:
        value = score(pair[0], rate, pair[1], rate, clarity_ear, level1=FULL_SCALE_SPL)[0]
        return torch.tensor(value)

    def two_ears() -> Tensor:
        return torch.tensor(pyclarity_mbstoi(*both_ears, rate))

    names = [f"pyclarity {metric}" for metric in ("HASPI", "HASQI", "MBSTOI")]
    return [
        Row(names[0], lambda: one_ear(haspi_v2), names[0], backward=False),
        Row("HASPI", lambda: haspi(ours[0], clean[0], EAR), names[0]),
        Row(names[1], lambda: one_ear(hasqi_v2), names[1], backward=False),
        Row("HASQI", lambda: hasqi(ours[0], clean[0], EAR), names[1]),
        Row(names[2], two_ears, names[2], backward=False),
        Row("MBSTOI", lambda: mbstoi(ours, clean), names[2]),
    ]


TABLES = {
    "simulators": simulator_rows,
    "loss": loss_rows,
    "step": step_rows,
    "metrics": metric_rows,
}


def print_parts(options: argparse.Namespace) -> None:
    """Print which parts of the exact MSBG's processor time do not depend on how it is written.

    They are the Fourier transforms, and the cost of calling all operations, which is the time for a
    very short signal. The last column has the ratio to pyclarity's time if nothing else took time.
    """
    calls: dict[str, Callable[[], Tensor]] = {}
    for rate in (PYCLARITY_RATE, 16000):
        model = MSBG(EAR, sample_rate=rate)
        signal = noise_like_speech(rate, options.seconds, options.batch)
        short = noise_like_speech(rate, SHORT_SECONDS, 1)
        calls[f"{rate} Hz"] = lambda m=model, x=signal: m(x)
        calls[f"{rate} Hz, short"] = lambda m=model, x=short: m(x)
        if rate == PYCLARITY_RATE:
            calls["Ear"] = pyclarity_simulator_rows(signal, "", "cpu")[0].call
    times: dict[str, list[float]] = {name: [] for name in calls}
    transforms: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(options.repeats + 1):
        for name, call in calls.items():
            times[name].append(time_call(Row(name, call, ""), False, "cpu", time.process_time))
            run = cProfile.Profile(time.process_time)
            with torch.inference_mode():
                run.runcall(call)
            seconds = [
                own_time
                for (_, _, function), (_, _, own_time, _, _) in pstats.Stats(run).stats.items()
                if "torch._C._fft" in function
            ]
            transforms[name].append(1000.0 * sum(seconds))
    median = {name: statistics.median(values[1:]) for name, values in times.items()}
    print(
        "\n| exact MSBG, processor time | all (ms) | transforms (ms) | short signal (ms) |", end=""
    )
    print(" times Ear's speed | if nothing else took time |\n|---|---|---|---|---|---|")
    for name in (f"{PYCLARITY_RATE} Hz", "16000 Hz"):
        transform = statistics.median(transforms[name][1:])
        short_call = median[f"{name}, short"]
        bound = transform + short_call - statistics.median(transforms[f"{name}, short"][1:])
        columns = [median[name], transform, short_call]
        columns += [median["Ear"] / duration for duration in (median[name], bound)]
        print(f"| {name} | {' | '.join(f'{value:.1f}' for value in columns)} |")


def time_call(row: Row, backward: bool, device: str, clock: Callable[[], float]) -> float:
    """Measure the milliseconds of a call, forward alone or with the backward pass."""
    start = clock()
    with torch.inference_mode(not backward):
        value = row.call()
        if backward:
            value.square().sum().backward()
    if device.startswith("cuda"):
        torch.cuda.synchronize(device)
    return 1000.0 * (clock() - start)


def print_table(
    title: str, rows: list[Row], repeats: int, device: str, clock: Callable[[], float]
) -> None:
    """Time the rows in turns and print a Markdown table."""
    times: dict[tuple[str, bool], list[float]] = {}
    for repeat in range(repeats + 1):
        for row in rows:
            for backward in (False, True) if row.backward else (False,):
                elapsed = time_call(row, backward, device, clock)
                if repeat > 0:
                    times.setdefault((row.name, backward), []).append(elapsed)
    print(f"\n| {title} | forward (ms) | forward + backward (ms) | pyclarity's time / forward |")
    print("|---|---|---|---|")
    for row in rows:
        forward = times[row.name, False]
        ratios = []
        if row.reference:
            pairs = zip(times[row.reference, False], forward, strict=True)
            ratios = [reference_ms / hlsim_ms for reference_ms, hlsim_ms in pairs]
        columns = [
            summarise(forward),
            summarise(times.get((row.name, True), [])),
            summarise(ratios),
        ]
        print(f"| {row.name} | {' | '.join(columns)} |")


def summarise(values: list[float]) -> str:
    """Format the median, minimum and maximum."""
    if not values:
        return "-"
    return f"{statistics.median(values):.1f} ({min(values):.1f} to {max(values):.1f})"


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--what",
        nargs="+",
        choices=(*TABLES, "parts"),
        default=[*TABLES],
        help="tables to print",
    )
    parser.add_argument(
        "--simulators", nargs="+", metavar="NAME", help="checkpoints by name or folder"
    )
    parser.add_argument("--seconds", type=float, default=1.0, help="length of each signal")
    parser.add_argument("--batch", type=int, default=1, help="signals per batch")
    parser.add_argument("--repeats", type=int, default=7, help="counted rounds")
    parser.add_argument("--device", default="cpu", help="cpu, cuda or cuda:1")
    parser.add_argument(
        "--processor-time",
        action="store_true",
        help="time all threads of this process, instead of the time that passes",
    )
    options = parser.parse_args(arguments)
    clock = time.process_time if options.processor_time else time.perf_counter
    size = f"{options.batch} x {options.seconds:g} s"
    print(
        f"{size} on {options.device}, {torch.get_num_threads()} threads, torch "
        f"{torch.__version__}, {time.strftime('%Y-%m-%d')}; median (minimum to maximum) of "
        f"{options.repeats} rounds"
    )
    for name in options.what:
        if name == "parts":
            print_parts(options)
            continue
        print_table(name, TABLES[name](options), options.repeats, options.device, clock)


if __name__ == "__main__":
    main()
