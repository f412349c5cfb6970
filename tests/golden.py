"""Golden cases: outputs and gradients that a change of the code must not alter by accident.

``golden.npz`` contains two excerpts of the bundled speech, and the output of every case when the
file was written. ``test_golden.py`` compares new outputs with it, within the tolerance of the case.
If the output of a case should change, write that case again::

    python -m tests.golden "resample 44100 to 16000 Hz"

Without a name, the command adds cases that are missing in the file. ``--all`` writes every case,
and ``--fast`` those that are no slow tests.

The last bits of an output depend on the processor and on the versions of the libraries. The
environment variable ``HLSIM_GOLDEN`` names another golden file, written by this machine, whose
every bit must be reproduced::

    HLSIM_GOLDEN=build/golden.npz python -m tests.golden --all  # before a change
    HLSIM_GOLDEN=build/golden.npz pytest tests/test_golden.py  # after it
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import soundfile
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

import compensators
import hlsim.metrics
from compensators import NALR, WDRC, load_compensator
from hlsim import (
    MSBG,
    Audiogram,
    HASPILoss,
    HearingLossLoss,
    Listener,
    estimate_delay,
    load_pretrained,
)
from hlsim.dsp.resample import resample
from hlsim.evaluation import statistics

COMMITTED_FILE = Path(__file__).with_name("golden.npz")
LOCAL_FILE = Path(os.environ["HLSIM_GOLDEN"]) if os.environ.get("HLSIM_GOLDEN") else None

# Largest differences on another machine or with another version of torch, relative to the peak of
# the array. Each is two to ten times the largest difference that was measured between an AMD and an
# Intel processor, the AVX-512, AVX2 and SSE kernels of MKL, and those of torch and oneDNN. Networks
# are computed in float64, because gradients of those with a phase are up to 0.1 of the peak away
# from the exact ones in float32.
EXACT = 1e-6
RESAMPLED_NETWORK = 5e-5  # a network between two resamplings
SINGLE_PRECISION = (
    2e-5  # float32 spectra, whose smallest powers differ most; float64 cases keep to EXACT
)
LOSS = 5e-4  # logarithms and phases of such spectra
GRADIENT = 2e-2  # through roots, logarithms and ratios of such spectra, which are steep near zero
LOSS_GRADIENT = 4e-2  # through the coherence of such spectra, too

SAMPLES = 256  # values of an array that are stored as they are
SUMS = 64  # sums with random signs, which together see every value of an array

Arrays = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A computation that is repeated.

    Attributes:
        compute: Returns tensors, arrays or numbers by name.
        tolerance: Largest difference from the committed file, relative to the peak.
        gradient_tolerance: The same for gradients, where it is another.
    """

    compute: Callable[[], Arrays]
    tolerance: float = EXACT
    gradient_tolerance: float | None = None

    def tolerance_of(self, output: str) -> float:
        if self.gradient_tolerance is not None and output.startswith("gradient"):
            return self.gradient_tolerance
        return self.tolerance


@dataclass(frozen=True)
class Summary:
    """Hash, sampled values and sums that are stored for an array."""

    digest: str
    shape: tuple[int, ...]
    peak: float
    samples: NDArray[np.float64]
    sums: NDArray[np.float64]

    @classmethod
    def of(cls, value: Any) -> Summary:
        array = np.ascontiguousarray(value.detach().numpy() if isinstance(value, Tensor) else value)
        flat = array.astype(np.float64).reshape(-1)
        signs = np.random.RandomState(0).choice([-1.0, 1.0], len(flat))
        padded = np.pad(flat * signs, (0, -len(flat) % SUMS))
        return cls(
            digest=hashlib.sha256(
                f"{array.dtype}{array.shape}".encode() + array.tobytes()
            ).hexdigest(),
            shape=array.shape,
            peak=float(np.nan_to_num(np.abs(flat)).max(initial=0.0)),
            samples=flat[:: max(1, len(flat) // SAMPLES)],
            sums=padded.reshape(-1, SUMS).sum(0),
        )

    def difference(self, other: Summary) -> float:
        """Compute the largest difference relative to the peak; sums are scaled by their length."""
        if self.shape != other.shape:
            return float("inf")
        if (np.isnan(self.samples) != np.isnan(other.samples)).any():
            return float("inf")
        samples = np.nan_to_num(np.abs(self.samples - other.samples)).max(initial=0.0)
        sums = np.nan_to_num(np.abs(self.sums - other.sums)).max()
        terms = max(1.0, np.prod(self.shape) / SUMS)
        return float(max(samples, sums / np.sqrt(terms)) / max(self.peak, 1e-30))


# The file


@lru_cache
def read_file(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, dict[str, Summary]]]:
    """Return speech by name, and summaries by case and output."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    index = json.loads(str(arrays.pop("index")))
    samples, sums = arrays.pop("samples"), arrays.pop("sums")
    summaries: dict[str, dict[str, Summary]] = {}
    start = 0
    for row, entry in enumerate(index["outputs"]):
        end = start + entry["samples"]
        summary = Summary(
            entry["digest"], tuple(entry["shape"]), entry["peak"], samples[start:end], sums[row]
        )
        summaries.setdefault(entry["case"], {})[entry["output"]] = summary
        start = end
    return arrays, summaries


def write_file(
    path: Path,
    speech_arrays: Mapping[str, NDArray[Any]],
    summaries: Mapping[str, Mapping[str, Summary]],
) -> None:
    entries, samples, sums = [], [np.zeros(0)], [np.zeros((0, SUMS))]
    for case, outputs in summaries.items():
        for output, summary in outputs.items():
            names = {"case": case, "output": output, "samples": len(summary.samples)}
            facts = {key: getattr(summary, key) for key in ("digest", "shape", "peak")}
            entries.append(names | facts)
            samples.append(summary.samples)
            sums.append(summary.sums[None])
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        np.savez_compressed(
            file,
            index=json.dumps({"outputs": entries}),
            samples=np.concatenate(samples),
            sums=np.concatenate(sums),
            **speech_arrays,
        )
    read_file.cache_clear()


def compute(case: Case) -> dict[str, Summary]:
    """Run a case as the golden file was made: on one thread, from fixed seeds."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    np.random.seed(0)
    return {name: Summary.of(value) for name, value in case.compute().items()}


# Signals and helpers

ear = Audiogram.standard


def speech(seconds: float = 0.4, rate: int = 16000, name: str = "female") -> Tensor:
    """Return an excerpt of a bundled utterance in pascals, whose samples are used at any rate."""
    excerpt = np.resize(read_file(COMMITTED_FILE)[0][name], round(seconds * rate))
    return torch.from_numpy(excerpt.astype(np.float32) / 32768.0)


def noise(*shape: int, level: float = 0.005, seed: int = 1) -> Tensor:
    values = np.random.RandomState(seed).standard_normal(shape)
    return torch.from_numpy(np.asarray(level * values, dtype=np.float32))


def noisy_speech(seconds: float = 0.4, rate: int = 16000) -> Tensor:
    clean = speech(seconds, rate)
    return clean + noise(len(clean))


def two_voices(seconds: float, rate: int = 16000) -> Tensor:
    return torch.stack([speech(seconds, rate), speech(seconds, rate, "male")])


def two_signals(seconds: float, rate: int = 16000) -> Tensor:
    """Return noisy speech of one voice, and clean speech of another one. Shape: (2, time)."""
    return torch.stack([noisy_speech(seconds, rate), speech(seconds, rate, "male")])


def thresholds(*names: str) -> Tensor:
    return torch.tensor([ear(name).levels for name in names])


def weighted_sum(output: Tensor) -> Tensor:
    """Return a randomly weighted sum of an output, whose gradient is stored."""
    return (output * noise(*output.shape, level=1.0, seed=2).to(output)).sum()


def with_gradient(function: Callable[[Tensor], Tensor], signal: Tensor) -> dict[str, Tensor]:
    """Return the output, and the gradient of a weighted sum of it with respect to the signal."""
    signal = signal.clone().requires_grad_()
    output = function(signal)
    (gradient,) = torch.autograd.grad(weighted_sum(output), signal)
    return {"output": output, "gradient": gradient}


def parameter_gradient(model: nn.Module, output: Tensor) -> Tensor:
    """Return the gradient of a weighted sum, of all parameters in the order of their names."""
    model.zero_grad(set_to_none=True)
    weighted_sum(output).backward()
    named = sorted(model.named_parameters())
    return torch.cat([p.grad.flatten() for _, p in named if p.grad is not None])


def in_chunks(stream: Any, signal: Tensor) -> Arrays:
    """Return the output of a stream for chunks of several sizes, and at its end."""
    outputs, position = [], 0
    sizes = itertools.cycle((1, 100, 16, 777))
    while position < signal.shape[-1]:
        chunk = signal[..., position:][..., : next(sizes)]
        outputs.append(stream(chunk))
        position += chunk.shape[-1]
    return {"output": torch.cat([*outputs, stream.flush()], -1)}


# MSBG


def exact_msbg(name: str, rate: int, aligned: bool) -> Arrays:
    model = MSBG(ear(name), sample_rate=rate, aligned=aligned)
    return with_gradient(model, noisy_speech(0.3, rate))


def msbg_batch(dtype: torch.dtype) -> Arrays:
    ears, model = thresholds("N2", "NH", "N4", "S2"), MSBG(sample_rate=44100)
    return with_gradient(lambda x: model(x, ears), two_signals(0.3, 44100)[:, None].to(dtype))


def msbg_options() -> Arrays:
    options = {"aligned": False, "rescale_active": True, "full_scale_spl": 120.0}
    model = MSBG(ear("N3"), sample_rate=44100, **options)
    return with_gradient(model, 0.05 * noisy_speech(0.3, 44100))


def msbg_trained_ear() -> Arrays:
    levels = thresholds("N2")[0].requires_grad_()
    output = MSBG(sample_rate=16000)(speech(0.3), levels)
    (gradient,) = torch.autograd.grad(weighted_sum(output), levels)
    return {"output": output, "gradient of the ear": gradient}


def msbg_delay() -> Arrays:
    model = MSBG(ear("N4"), sample_rate=44100, aligned=False)
    return {"samples": np.array(estimate_delay(model))}


# Networks and compensators

Load = Callable[..., Any]


def network(load: Load, name: str) -> Arrays:
    model, ears = load(name).double(), thresholds("N3", "S2").double()
    return with_gradient(lambda x: model(x, ears), two_signals(0.4).double())


def network_at_another_rate(load: Load, name: str, rate: int) -> Arrays:
    model, ears = load(name, sample_rate=rate), thresholds("N3", "S2")
    return with_gradient(lambda x: model(x, ears), two_signals(0.4, rate))


def network_training(load: Load, name: str) -> Arrays:
    model = load(name).double().requires_grad_(True)
    output = model(noisy_speech(0.3).double(), ear("N4"))
    return {"gradient of the parameters": parameter_gradient(model, output)}


def random_compensator(kind: str) -> Arrays:
    model, ears = getattr(compensators, kind)(), thresholds("N3", "S2").double()
    random = np.random.RandomState(3)
    with torch.no_grad():
        for _, parameter in sorted(model.named_parameters()):
            parameter.copy_(torch.from_numpy(0.05 * random.standard_normal(parameter.shape)))
    model.double()
    signals = two_signals(0.3).double()
    results = with_gradient(lambda x: model(x, ears), signals)
    gradient = parameter_gradient(model, model(signals, ears))
    return {**results, "gradient of the parameters": gradient}


def aid_sliders() -> Arrays:
    aid, signal = load_compensator("hearing-aid"), noisy_speech(0.4)
    return {
        f"noise reduction {reduction}, amplification {amplification}": aid(
            signal, ear("N3"), reduction, amplification
        )
        for reduction, amplification in ((0.0, 1.0), (1.0, 0.0), (0.5, 0.5))
    }


def aid_stream() -> Arrays:
    stream = load_compensator("hearing-aid").stream(thresholds("N3", "S2"))
    return in_chunks(stream, two_signals(0.4))


def linked_aid() -> Arrays:
    aid = load_compensator("hearing-aid", linked=True)
    signals = torch.stack([noisy_speech(0.4), 0.3 * noisy_speech(0.4)])
    return {"output": aid(signals, Listener(ear("N2"), ear("N4")))}


def nalr(name: str, rate: int) -> Arrays:
    return with_gradient(NALR(ear(name), sample_rate=rate), noisy_speech(0.3, rate))


def wdrc(linked: bool) -> Arrays:
    aid, ears = WDRC(linked=linked), thresholds("N2", "N4")
    return with_gradient(lambda x: aid(x, ears), two_signals(0.3))


def wdrc_stream() -> Arrays:
    return in_chunks(WDRC().stream(ear("N4")), noisy_speech(0.3))


# Losses


def loss_value(loss: nn.Module, *arguments: Any, listener: bool = False) -> dict[str, Tensor]:
    """Compute the loss of an aid's output, and the gradient with respect to the output."""
    clean = two_voices(0.8)
    compensated = 1.5 * clean + noise(*clean.shape)
    if listener:
        clean, compensated = clean[None], compensated[None]
    compensated.requires_grad_()
    value = loss(compensated, clean, *arguments)
    (gradient,) = torch.autograd.grad(value.sum(), compensated)
    return {"value": value, "gradient": gradient}


def loss_of_criterion(criterion: Any, simulator: str) -> Arrays:
    loss = HearingLossLoss(simulator=simulator, criterion=criterion, reduction="none")
    return loss_value(loss, thresholds("N2", "N4"))


def loss_with_lengths(simulator: str) -> Arrays:
    loss = HearingLossLoss(ear("N3"), simulator=simulator)
    return loss_value(loss, None, torch.tensor([12800, 9000]))


def loss_of_listener(**options: Any) -> Arrays:
    return loss_value(HearingLossLoss(Listener(ear("N2"), ear("N4")), **options), listener=True)


def loss_reference(simulator: str) -> Arrays:
    loss = HearingLossLoss(
        ear("N4"), simulator=simulator, criterion="paper", reference="normal-hearing"
    )
    perceived, reference = loss.heard(1.5 * noisy_speech(0.4), speech(0.4))
    return {**loss_value(loss), "perceived": perceived, "reference": reference}


def loss_of_callable() -> Arrays:
    def mean_square(perceived: Tensor, reference: Tensor) -> Tensor:
        return (perceived - reference).square().mean(-1)

    return loss_value(HearingLossLoss(ear("N4"), criterion=mean_square))


def loss_parts(simulator: str, gain: float) -> Arrays:
    loss = HearingLossLoss(ear("N3"), simulator=simulator)
    return loss.parts(gain * noisy_speech(0.4), speech(0.4))


def haspi_loss(simulator: str) -> Arrays:
    return loss_value(HASPILoss(ear("N3"), simulator=simulator, quality=0.5))


# Metrics


def metric(name: str, dtype: torch.dtype, rate: int = 16000) -> Arrays:
    function, ears = getattr(hlsim.metrics, name), thresholds("N2", "N4")
    clean = two_voices(0.8, rate).to(dtype)
    output = clean + noise(*clean.shape, level=0.01)
    return with_gradient(lambda x: function(x, clean, ears, sample_rate=rate), output)


def metric_with_noise(name: str, kind: str) -> Arrays:
    """Score two items, with the seeds 1 and 2."""
    function, ears, clean = getattr(hlsim.metrics, name), thresholds("N2", "N4"), two_voices(0.8)
    clean = clean.double()
    output = clean + noise(*clean.shape, level=0.01)

    def score(x: Tensor) -> Tensor:
        scores = [function(x[i], clean[i], ears[i], noise=kind, seed=1 + i) for i in range(2)]
        return torch.stack(scores)

    return with_gradient(score, output)


def metric_lengths(name: str) -> Arrays:
    function, clean = getattr(hlsim.metrics, name), two_voices(0.8)
    lengths = torch.tensor([12800, 11500])
    output = clean + noise(12800, level=0.01)
    return {"scores": function(output, clean, ear("N3"), lengths=lengths)}


def hasqi_parts() -> Arrays:
    clean = speech(0.8)
    parts = hlsim.metrics.HasqiReference(clean, ear("N3")).parts(clean + noise(12800, level=0.01))
    return {"combined": parts.combined, "nonlinear": parts.nonlinear, "linear": parts.linear}


def binaural(rate: int) -> Arrays:
    source = speech(0.8, rate)
    clean = torch.stack([source, 0.7 * source.roll(6)])
    output = clean + noise(*clean.shape, level=0.01)
    return with_gradient(lambda x: hlsim.metrics.mbstoi(x, clean, sample_rate=rate), output)


# Resampling and statistics


def resampled(source_rate: int, target_rate: int, dtype: torch.dtype = torch.float64) -> Arrays:
    signal = noisy_speech(0.3, source_rate).to(dtype)
    return with_gradient(lambda x: resample(x, source_rate, target_rate), signal)


def before_and_after(pairs: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.RandomState(pairs)
    before = random.uniform(0.2, 0.9, pairs)
    after = before + 0.05 * random.standard_normal(pairs) + 0.02
    after[: pairs // 6] = before[: pairs // 6]
    return before, after


def comparison(pairs: int, decimals: int | None = None) -> Arrays:
    before, after = before_and_after(pairs)
    if decimals is not None:
        before, after = before.round(decimals), after.round(decimals)
    result = vars(statistics.paired_comparison(before, after))
    return {name: np.nan if value is None else float(value) for name, value in result.items()}


def adjusted_p_values() -> Arrays:
    adjusted = statistics.holm([0.01, None, 0.04, 0.03, 0.005, 0.8])
    return {"p": np.array([np.nan if p is None else p for p in adjusted])}


def interval() -> Arrays:
    before, after = before_and_after(24)
    return {"ends": np.array(statistics.bootstrap_interval(after - before))}


# The table of cases


def msbg_cases() -> dict[str, Case]:
    single = partial(Case, tolerance=SINGLE_PRECISION, gradient_tolerance=GRADIENT)
    cases = {
        "MSBG of two signals and four ears, float32": single(partial(msbg_batch, torch.float32)),
        "MSBG of two signals and four ears, float64": Case(partial(msbg_batch, torch.float64)),
        "MSBG with active rescaling and another full scale": single(msbg_options),
        "MSBG's gradient of the audiogram": single(msbg_trained_ear),
        "delay of MSBG by the impulse method": Case(msbg_delay),
    }
    for name, rate in product(("NH", "N2", "N4", "S2"), (16000, 22050, 44100, 48000)):
        for kind, aligned in (("aligned", True), ("with its delay", False)):
            function = partial(exact_msbg, name, rate, aligned)
            cases[f"MSBG of {name} at {rate} Hz, {kind}"] = single(function)
    return cases


def network_cases() -> dict[str, Case]:
    resampled_case = partial(Case, tolerance=RESAMPLED_NETWORK, gradient_tolerance=GRADIENT)
    cases = {}
    for kind in ("", "-cnn", "-cnn-narrow", "-lstm", "-mamba", "-transformer"):
        name = f"neuro-msbg{kind}"
        cases[f"checkpoint {name}"] = Case(partial(network, load_pretrained, name))
    for rate in (22050, 44100, 48000):
        function = partial(network_at_another_rate, load_pretrained, "neuro-msbg", rate)
        cases[f"checkpoint neuro-msbg at {rate} Hz"] = resampled_case(function)
    for name in ("compensator-general", "hearing-aid"):
        cases[f"checkpoint {name}"] = Case(partial(network, load_compensator, name))
        function = partial(network_at_another_rate, load_compensator, name, 44100)
        cases[f"checkpoint {name} at 44100 Hz"] = resampled_case(function)
    for name, load in (
        ("compensator-general", load_compensator),
        ("hearing-aid", load_compensator),
        ("neuro-msbg", load_pretrained),
    ):
        cases[f"parameters of {name} in training"] = Case(partial(network_training, load, name))
    for kind in ("MappingCompensator", "HearingAid"):
        cases[f"{kind} with random weights"] = Case(partial(random_compensator, kind))
    return cases


def aid_cases() -> dict[str, Case]:
    cases = {
        "hearing-aid with sliders": Case(aid_sliders),
        "hearing-aid streamed in chunks": Case(aid_stream),
        "hearing-aid linked between two ears": Case(linked_aid),
        "WDRC": Case(partial(wdrc, False)),
        "WDRC linked between two ears": Case(partial(wdrc, True)),
        "WDRC streamed in chunks": Case(wdrc_stream),
    }
    for name, rate in product(("NH", "N2", "N4", "S2"), (16000, 44100)):
        cases[f"NALR of {name} at {rate} Hz"] = Case(partial(nalr, name, rate))
    return cases


def loss_cases() -> dict[str, Case]:
    interaural = {"coherent-bands": 1.0, "interaural": 0.5}
    functions: dict[str, Callable[[], Arrays]] = {
        "loss with interaural differences": partial(loss_of_listener, criterion=interaural),
        "loss with a callable criterion": loss_of_callable,
    }
    for name in ("msbg", "neuro-msbg"):
        for criterion in ("coherent-bands", "bands", "paper", "haspi", "hasqi"):
            function = partial(loss_of_criterion, criterion, name)
            functions[f"loss {criterion} through {name}"] = function
        for ears in ("mean", "better"):
            function = partial(loss_of_listener, ears=ears, simulator=name)
            functions[f"loss of a listener, {ears} ear, through {name}"] = function
        for kind, gain in (("speech", 1.5), ("loud speech", 100.0)):
            function = partial(loss_parts, name, gain)
            functions[f"parts of the loss of {kind} through {name}"] = function
        reference = partial(loss_reference, name)
        functions[f"loss with lengths through {name}"] = partial(loss_with_lengths, name)
        functions[f"loss with the normal-hearing reference through {name}"] = reference
        functions[f"HASPILoss through {name}"] = partial(haspi_loss, name)
    return {
        name: Case(function, tolerance=LOSS, gradient_tolerance=LOSS_GRADIENT)
        for name, function in functions.items()
    }


def metric_cases() -> dict[str, Case]:
    single = partial(Case, tolerance=SINGLE_PRECISION)
    cases = {"parts of hasqi": single(hasqi_parts)}
    for name in ("haspi", "hasqi", "haaqi"):
        in_double = partial(metric, name, torch.float64)
        cases[f"{name}, float32"] = single(partial(metric, name, torch.float32))
        cases[f"{name}, float64"] = Case(in_double)
        cases[f"{name} at 44100 Hz"] = Case(partial(in_double, 44100))
        cases[f"{name} with lengths"] = single(partial(metric_lengths, name))
        for kind in ("seeded",) if name == "haaqi" else ("seeded", "none"):
            cases[f"{name} with noise {kind}"] = Case(partial(metric_with_noise, name, kind))
    for rate in (16000, 44100):
        cases[f"mbstoi at {rate} Hz"] = Case(partial(binaural, rate))
    return cases


def resampling_cases() -> dict[str, Case]:
    in_single = partial(resampled, 44100, 16000, torch.float32)
    cases = {"resample 44100 to 16000 Hz, float32": Case(in_single, tolerance=SINGLE_PRECISION)}
    upwards = ((16000, 44100), (16000, 48000), (16000, 24000))
    for source, target in (*upwards, (44100, 16000), (48000, 16000), (22050, 16000)):
        cases[f"resample {source} to {target} Hz"] = Case(partial(resampled, source, target))
    return cases


def statistics_cases() -> dict[str, Case]:
    cases = {
        "paired comparison with ties": Case(partial(comparison, 24, 2)),
        "Holm's adjusted p values": Case(adjusted_p_values),
        "bootstrap interval": Case(interval),
    }
    for pairs in (1, 4, 24, 60):
        cases[f"paired comparison of {pairs} pairs"] = Case(partial(comparison, pairs))
    return cases


CASES: dict[str, Case] = {
    **msbg_cases(),
    **network_cases(),
    **aid_cases(),
    **loss_cases(),
    **metric_cases(),
    **resampling_cases(),
    **statistics_cases(),
}


# scores that take as long as all other cases together, and of which other cases cover most
SLOW = re.compile(
    "(haspi|hasqi|haaqi)(, float64| at 44100 Hz| with noise .*)"
    "|(hasqi|haaqi)(, float32| with lengths)"
    "|(HASPILoss|loss hasqi) through .*|loss haspi through msbg"
)
FAST_CASES = [name for name in CASES if not SLOW.fullmatch(name)]


def excerpts() -> dict[str, NDArray[Any]]:
    """Return 0.8 s each of two bundled utterances. Shape: (12800,) int16."""
    folder = Path(__file__).parents[1] / "hlsim" / "data" / "speech"
    files = {"female": "train/flite-slt-01.flac", "male": "valid/flite-rms-01.flac"}
    return {
        name: soundfile.read(folder / file, start=9600, frames=12800, dtype="int16")[0]
        for name, file in files.items()
    }


def main() -> None:
    if not COMMITTED_FILE.exists():
        write_file(COMMITTED_FILE, excerpts(), {})
    path = LOCAL_FILE or COMMITTED_FILE
    speech_arrays, _ = read_file(COMMITTED_FILE)
    stored = read_file(path)[1] if path.exists() else {}
    names = sys.argv[1:] or [name for name in CASES if name not in stored]
    if names == ["--all"]:
        names = list(CASES)
    elif names == ["--fast"]:
        names = FAST_CASES
    computed = {name: compute(CASES[name]) for name in names}
    summaries = {name: computed.get(name, stored.get(name)) for name in CASES}
    write_file(path, speech_arrays, {name: value for name, value in summaries.items() if value})
    print(f"{path}: {len(names)} cases written, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
