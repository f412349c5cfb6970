"""Golden cases: outputs and gradients that a change of the code must not alter by a single bit.

``golden.npz`` contains two excerpts of the bundled speech, the output of every case when the file
was written, and a description of the environment. ``test_golden.py`` compares new outputs with it.
If the output of a case should change, write that case again::

    python -m tests.golden "resample 44100 to 16000 Hz"

Without a name, the command adds cases that are missing in the file, and ``--all`` writes every
case.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

GOLDEN_FILE = Path(__file__).with_name("golden.npz")

# Largest differences on another machine or with another version of torch, relative to the peak of
# the array. Each is a few times the largest difference that was measured between AVX-512, AVX2 and
# no vector instructions on one machine.
EXACT = 1e-6
RESAMPLED = 1e-5  # hlsim's own resampling takes part
SINGLE_PRECISION = (
    2e-5  # float32 spectra, whose smallest powers differ most; float64 cases keep to EXACT
)
LOSS = 5e-4  # logarithms and phases of such spectra
GRADIENT = 2e-2  # through roots, logarithms and ratios of such spectra, which are steep near zero

SAMPLES = 256  # values of an array that are stored as they are
SUMS = 64  # sums with random signs, which together see every value of an array

Arrays = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """A computation that is repeated.

    Attributes:
        compute: Returns tensors, arrays or numbers by name.
        tolerance: Largest difference relative to the peak, where equal bits cannot be expected.
        gradient_tolerance: The same for gradients, where it is another.
        may_change: Whether other bits are accepted on the same machine, too, within the tolerance.
    """

    compute: Callable[[], Arrays]
    tolerance: float = EXACT
    gradient_tolerance: float | None = None
    may_change: bool = False

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


def environment() -> dict[str, str]:
    """Everything that the last bits of a result depend on, besides hlsim."""
    import scipy

    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    processors = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "torch": torch.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu": processors[0] if processors else platform.processor(),
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


# The file


@lru_cache(maxsize=1)
def read_file() -> tuple[dict[str, str], dict[str, NDArray[Any]], dict[str, dict[str, Summary]]]:
    """Environment, speech by name, and summaries by case and output."""
    with np.load(GOLDEN_FILE) as stored:
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
    return index["environment"], arrays, summaries


def write_file(
    speech_arrays: Mapping[str, NDArray[Any]], summaries: Mapping[str, Mapping[str, Summary]]
) -> None:
    rows = [
        (case, output, summary)
        for case, outputs in summaries.items()
        for output, summary in outputs.items()
    ]
    entries = [
        {
            "case": case,
            "output": output,
            "digest": summary.digest,
            "shape": summary.shape,
            "peak": summary.peak,
            "samples": len(summary.samples),
        }
        for case, output, summary in rows
    ]
    index = {"environment": environment(), "outputs": entries}
    np.savez_compressed(
        GOLDEN_FILE,
        index=json.dumps(index),
        samples=np.concatenate([summary.samples for _, _, summary in rows]),
        sums=np.stack([summary.sums for _, _, summary in rows]),
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


def speech(seconds: float = 0.4, rate: int = 16000, name: str = "female") -> Tensor:
    """Return an excerpt of a bundled utterance in pascals, whose samples are used at any rate."""
    count = round(seconds * rate)
    excerpt = read_file()[1][name]
    repeated = np.resize(excerpt, count)
    return torch.from_numpy(repeated.astype(np.float32) / 32768.0)


def noise(count: int, level: float = 0.005, seed: int = 1) -> Tensor:
    values = np.random.RandomState(seed).standard_normal(count)
    return torch.from_numpy((level * values).astype(np.float32))


def noisy_speech(seconds: float = 0.4, rate: int = 16000, name: str = "female") -> Tensor:
    clean = speech(seconds, rate, name)
    return clean + noise(len(clean))


def ear(name: str) -> Any:
    from hlsim import Audiogram

    return Audiogram.standard(name)


def thresholds(*names: str) -> Tensor:
    return torch.tensor([ear(name).levels for name in names])


def weights_like(output: Tensor) -> Tensor:
    return noise(output.numel(), 1.0, seed=2).reshape(output.shape).to(output)


def with_gradient(function: Callable[[Tensor], Tensor], signal: Tensor) -> dict[str, Tensor]:
    """The output, and the gradient of a randomly weighted sum of it."""
    signal = signal.clone().requires_grad_()
    output = function(signal)
    (gradient,) = torch.autograd.grad((output * weights_like(output)).sum(), signal)
    return {"output": output, "gradient": gradient}


def parameter_gradient(model: nn.Module, output: Tensor) -> Tensor:
    """The gradient of a randomly weighted sum, of all parameters in the order of their names."""
    for parameter in model.parameters():
        parameter.grad = None
    (output * weights_like(output)).sum().backward()
    named = sorted(model.named_parameters())
    return torch.cat([p.grad.flatten() for _, p in named if p.grad is not None])


def in_chunks(stream: Any, signal: Tensor, sizes: tuple[int, ...] = (1, 100, 16, 777)) -> Tensor:
    """Output of a stream for chunks of several sizes and at its end."""
    outputs = []
    position = turn = 0
    while position < signal.shape[-1]:
        size = sizes[turn % len(sizes)]
        outputs.append(stream(signal[..., position : position + size]))
        position += size
        turn += 1
    outputs.append(stream.flush())
    return torch.cat(outputs, -1)


# MSBG


def exact_msbg(name: str, rate: int, aligned: bool) -> Arrays:
    from hlsim import MSBG

    model = MSBG(ear(name), sample_rate=rate, aligned=aligned)
    return with_gradient(model, noisy_speech(0.3, rate))


def msbg_batch(dtype: torch.dtype) -> Arrays:
    from hlsim import MSBG

    ears = thresholds("N2", "NH", "N4", "S2")
    signals = torch.stack([noisy_speech(0.3, 44100), speech(0.3, 44100, "male")])[:, None].to(dtype)
    model = MSBG(sample_rate=44100)
    return with_gradient(lambda x: model(x, ears), signals)


def msbg_options() -> Arrays:
    from hlsim import MSBG

    signal = noisy_speech(0.3, 44100)
    pyclarity_like = MSBG(
        ear("N3"), sample_rate=44100, aligned=False, rescale_active=True, full_scale_spl=120.0
    )
    return with_gradient(pyclarity_like, 0.05 * signal)


def msbg_trained_ear() -> Arrays:
    from hlsim import MSBG

    levels = thresholds("N2")[0].requires_grad_()
    output = MSBG(sample_rate=16000)(speech(0.3), levels)
    (gradient,) = torch.autograd.grad((output * weights_like(output)).sum(), levels)
    return {"output": output, "gradient of the ear": gradient}


def msbg_delay() -> Arrays:
    from hlsim import MSBG, estimate_delay

    model = MSBG(ear("N4"), sample_rate=44100, aligned=False)
    return {"samples": np.array(estimate_delay(model))}


# Checkpoints and compensators


def simulator(name: str, rate: int = 16000) -> Arrays:
    from hlsim import load_pretrained

    model = load_pretrained(name, sample_rate=rate)
    signals = torch.stack([noisy_speech(0.4, rate), speech(0.4, rate, "male")])
    ears = thresholds("N3", "S2")
    return with_gradient(lambda x: model(x, ears), signals)


def simulator_training(name: str) -> Arrays:
    from hlsim import load_pretrained

    model = load_pretrained(name).requires_grad_(True)
    output = model(noisy_speech(0.3), ear("N4"))
    return {"gradient of the parameters": parameter_gradient(model, output)}


def compensator(name: str, rate: int = 16000) -> Arrays:
    from compensators import load_compensator

    model = load_compensator(name, sample_rate=rate)
    signals = torch.stack([noisy_speech(0.4, rate), speech(0.4, rate, "male")])
    ears = thresholds("N3", "S2")
    return with_gradient(lambda x: model(x, ears), signals)


def compensator_training(name: str) -> Arrays:
    from compensators import load_compensator

    model = load_compensator(name).requires_grad_(True)
    output = model(noisy_speech(0.3), ear("N4"))
    return {"gradient of the parameters": parameter_gradient(model, output)}


def aid_sliders() -> Arrays:
    from compensators import load_compensator

    aid = load_compensator("hearing-aid")
    signal = noisy_speech(0.4)
    return {
        f"noise reduction {reduction}, amplification {amplification}": aid(
            signal, ear("N3"), reduction, amplification
        )
        for reduction, amplification in ((0.0, 1.0), (1.0, 0.0), (0.5, 0.5))
    }


def aid_stream() -> Arrays:
    from compensators import load_compensator

    aid = load_compensator("hearing-aid")
    signals = torch.stack([noisy_speech(0.4), speech(0.4, name="male")])
    return {"output": in_chunks(aid.stream(thresholds("N3", "S2")), signals)}


def linked_aid() -> Arrays:
    from compensators import load_compensator
    from hlsim import Listener

    aid = load_compensator("hearing-aid", linked=True)
    signals = torch.stack([noisy_speech(0.4), 0.3 * noisy_speech(0.4)])
    return {"output": aid(signals, Listener(ear("N2"), ear("N4")))}


def nalr(name: str, rate: int) -> Arrays:
    from compensators import NALR

    return with_gradient(NALR(ear(name), sample_rate=rate), noisy_speech(0.3, rate))


def wdrc(linked: bool) -> Arrays:
    from compensators import WDRC

    aid = WDRC(linked=linked)
    signals = torch.stack([noisy_speech(0.3), speech(0.3, name="male")])
    return with_gradient(lambda x: aid(x, thresholds("N2", "N4")), signals)


def wdrc_stream() -> Arrays:
    from compensators import WDRC

    return {"output": in_chunks(WDRC().stream(ear("N4")), noisy_speech(0.3))}


def random_compensator(kind: str) -> Arrays:
    import compensators

    model = getattr(compensators, kind)()
    random = np.random.RandomState(3)
    with torch.no_grad():
        for _, parameter in sorted(model.named_parameters()):
            values = random.standard_normal(parameter.shape)
            parameter.copy_(torch.from_numpy(0.05 * values))
    signals = torch.stack([noisy_speech(0.3), speech(0.3, name="male")])
    ears = thresholds("N3", "S2")
    results = with_gradient(lambda x: model(x, ears), signals)
    gradient = parameter_gradient(model, model(signals, ears))
    return {**results, "gradient of the parameters": gradient}


# Losses


def loss_value(loss: nn.Module, *arguments: Any, listener: bool = False) -> dict[str, Tensor]:
    """Compute the loss of an aid's output, and the gradient with respect to the output."""
    clean = torch.stack([speech(0.8), speech(0.8, name="male")])
    compensated = 1.5 * clean + noise(clean.numel()).reshape(clean.shape)
    if listener:
        clean, compensated = clean[None], compensated[None]
    compensated.requires_grad_()
    value = loss(compensated, clean, *arguments)
    (gradient,) = torch.autograd.grad(value.sum(), compensated)
    return {"value": value, "gradient": gradient}


def loss_of_criterion(criterion: Any, simulator: str) -> Arrays:
    from hlsim import HearingLossLoss

    loss = HearingLossLoss(simulator=simulator, criterion=criterion, reduction="none")
    return loss_value(loss, thresholds("N2", "N4"))


def loss_with_lengths(simulator: str) -> Arrays:
    from hlsim import HearingLossLoss

    loss = HearingLossLoss(ear("N3"), simulator=simulator)
    return loss_value(loss, None, torch.tensor([12800, 9000]))


def loss_of_listener(ears: str, simulator: str) -> Arrays:
    from hlsim import HearingLossLoss, Listener

    loss = HearingLossLoss(Listener(ear("N2"), ear("N4")), simulator=simulator, ears=ears)
    return loss_value(loss, listener=True)


def loss_between_ears() -> Arrays:
    from hlsim import HearingLossLoss, Listener

    criterion = {"coherent-bands": 1.0, "interaural": 0.5}
    loss = HearingLossLoss(Listener(ear("N2"), ear("N4")), criterion=criterion)
    return loss_value(loss, listener=True)


def loss_reference(simulator: str) -> Arrays:
    from hlsim import HearingLossLoss

    loss = HearingLossLoss(
        ear("N4"), simulator=simulator, criterion="paper", reference="normal-hearing"
    )
    perceived, reference = loss.heard(1.5 * noisy_speech(0.4), speech(0.4))
    return {**loss_value(loss), "perceived": perceived, "reference": reference}


def loss_of_callable() -> Arrays:
    from hlsim import HearingLossLoss

    def mean_square(perceived: Tensor, reference: Tensor) -> Tensor:
        return (perceived - reference).square().mean(-1)

    return loss_value(HearingLossLoss(ear("N4"), criterion=mean_square))


def loss_parts(simulator: str, gain: float) -> Arrays:
    from hlsim import HearingLossLoss

    loss = HearingLossLoss(ear("N3"), simulator=simulator)
    return loss.parts(gain * noisy_speech(0.4), speech(0.4))


def haspi_loss(simulator: str) -> Arrays:
    from hlsim import HASPILoss

    return loss_value(HASPILoss(ear("N3"), simulator=simulator, quality=0.5))


# Metrics


def metric(name: str, dtype: torch.dtype, rate: int = 16000, **options: Any) -> Arrays:
    import hlsim.metrics

    function = getattr(hlsim.metrics, name)
    clean = torch.stack([speech(0.8, rate), speech(0.8, rate, "male")]).to(dtype)
    processed = clean + noise(clean.numel(), 0.01).reshape(clean.shape)
    ears = thresholds("N2", "N4")
    return with_gradient(lambda x: function(x, clean, ears, sample_rate=rate, **options), processed)


def metric_lengths(name: str) -> Arrays:
    import hlsim.metrics

    function = getattr(hlsim.metrics, name)
    clean = torch.stack([speech(0.8), speech(0.8, name="male")])
    lengths = torch.tensor([12800, 11500])
    return {"scores": function(clean + noise(12800, 0.01), clean, ear("N3"), lengths=lengths)}


def hasqi_parts() -> Arrays:
    from hlsim.metrics import HasqiReference

    clean = speech(0.8)
    parts = HasqiReference(clean, ear("N3")).parts(clean + noise(12800, 0.01))
    return {"combined": parts.combined, "nonlinear": parts.nonlinear, "linear": parts.linear}


def binaural(rate: int) -> Arrays:
    from hlsim.metrics import mbstoi

    source = speech(0.8, rate)
    clean = torch.stack([source, 0.7 * source.roll(6)])
    processed = clean + noise(clean.numel(), 0.01).reshape(clean.shape)
    return with_gradient(lambda x: mbstoi(x, clean, sample_rate=rate), processed)


# Resampling and statistics


def resampled(source_rate: int, target_rate: int, dtype: torch.dtype = torch.float32) -> Arrays:
    from hlsim.dsp.resample import resample

    signal = noisy_speech(0.3, source_rate).to(dtype)
    return with_gradient(lambda x: resample(x, source_rate, target_rate), signal)


def before_and_after(pairs: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    random = np.random.RandomState(pairs)
    before = random.uniform(0.2, 0.9, pairs)
    after = before + 0.05 * random.standard_normal(pairs) + 0.02
    after[: pairs // 6] = before[: pairs // 6]
    return before, after


def comparison(pairs: int, decimals: int | None = None) -> Arrays:
    from hlsim.evaluation.statistics import paired_comparison

    before, after = before_and_after(pairs)
    if decimals is not None:
        before, after = before.round(decimals), after.round(decimals)
    result = paired_comparison(before, after).to_dict()
    return {name: np.nan if value is None else float(value) for name, value in result.items()}


def adjusted_p_values() -> Arrays:
    from hlsim.evaluation.statistics import holm

    adjusted = holm([0.01, None, 0.04, 0.03, 0.005, 0.8])
    return {"p": np.array([np.nan if p is None else p for p in adjusted])}


def interval() -> Arrays:
    from hlsim.evaluation.statistics import bootstrap_interval

    before, after = before_and_after(24)
    return {"ends": np.array(bootstrap_interval(after - before))}


# The table of cases

SIMULATORS = (
    "neuro-msbg",
    "neuro-msbg-cnn",
    "neuro-msbg-light",
    "neuro-msbg-lstm",
    "neuro-msbg-mamba",
    "neuro-msbg-transformer",
)
RATE_PAIRS = (
    (16000, 44100),
    (44100, 16000),
    (16000, 48000),
    (48000, 16000),
    (22050, 16000),
    (16000, 24000),
)


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
    resampled_case = partial(
        Case, tolerance=RESAMPLED, gradient_tolerance=GRADIENT, may_change=True
    )
    cases = {f"checkpoint {name}": Case(partial(simulator, name)) for name in SIMULATORS}
    for rate in (22050, 44100, 48000):
        function = partial(simulator, "neuro-msbg", rate)
        cases[f"checkpoint neuro-msbg at {rate} Hz"] = resampled_case(function)
    for name in ("compensator-general", "hearing-aid"):
        cases[f"checkpoint {name}"] = Case(partial(compensator, name))
        cases[f"checkpoint {name} at 44100 Hz"] = resampled_case(partial(compensator, name, 44100))
        training = partial(compensator_training, name)
        cases[f"parameters of {name} in training"] = Case(training)
    training = partial(simulator_training, "neuro-msbg-light")
    cases["parameters of neuro-msbg-light in training"] = Case(training)
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
    functions: dict[str, Callable[[], Arrays]] = {
        "loss with interaural differences": loss_between_ears,
        "loss with a callable criterion": loss_of_callable,
    }
    for name in ("msbg", "neuro-msbg"):
        for criterion in ("coherent-bands", "bands", "paper", "haspi", "hasqi"):
            function = partial(loss_of_criterion, criterion, name)
            functions[f"loss {criterion} through {name}"] = function
        for ears in ("mean", "better"):
            function = partial(loss_of_listener, ears, name)
            functions[f"loss of a listener, {ears} ear, through {name}"] = function
        for kind, gain in (("speech", 1.5), ("loud speech", 100.0)):
            function = partial(loss_parts, name, gain)
            functions[f"parts of the loss of {kind} through {name}"] = function
        reference = partial(loss_reference, name)
        functions[f"loss with lengths through {name}"] = partial(loss_with_lengths, name)
        functions[f"loss with the normal-hearing reference through {name}"] = reference
        functions[f"HASPILoss through {name}"] = partial(haspi_loss, name)
    return {
        name: Case(function, tolerance=LOSS, gradient_tolerance=GRADIENT)
        for name, function in functions.items()
    }


def metric_cases() -> dict[str, Case]:
    single = partial(Case, tolerance=SINGLE_PRECISION)
    cases = {"parts of hasqi": single(hasqi_parts)}
    for name in ("haspi", "hasqi"):
        in_double = partial(metric, name, torch.float64)
        cases[f"{name}, float32"] = single(partial(metric, name, torch.float32))
        cases[f"{name}, float64"] = Case(in_double)
        cases[f"{name} at 44100 Hz"] = Case(partial(in_double, 44100))
        cases[f"{name} with lengths"] = single(partial(metric_lengths, name))
        for kind in ("seeded", "none"):
            function = partial(in_double, noise=kind, seed=[1, 2])
            cases[f"{name} with noise {kind}"] = Case(function)
    haaqi = partial(metric, "haaqi", torch.float64)
    cases["haaqi, float32"] = single(partial(metric, "haaqi", torch.float32))
    cases["haaqi, float64"] = Case(haaqi)
    cases["haaqi at 44100 Hz"] = Case(partial(haaqi, 44100))
    cases["haaqi with noise seeded"] = Case(partial(haaqi, noise="seeded", seed=[1, 2]))
    cases["haaqi with lengths"] = single(partial(metric_lengths, "haaqi"))
    for rate in (16000, 44100):
        cases[f"mbstoi at {rate} Hz"] = Case(partial(binaural, rate))
    return cases


def resampling_cases() -> dict[str, Case]:
    """Cases of hlsim's resampler, whose kernel may come from another implementation."""
    new_bits = partial(Case, tolerance=RESAMPLED, may_change=True)
    in_double = partial(resampled, 44100, 16000, torch.float64)
    cases = {"resample 44100 to 16000 Hz, float64": new_bits(in_double)}
    for source, target in RATE_PAIRS:
        cases[f"resample {source} to {target} Hz"] = new_bits(partial(resampled, source, target))
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


def excerpts() -> dict[str, NDArray[Any]]:
    """0.8 s each of two bundled utterances. Shape: (12800,) int16."""
    import soundfile

    folder = Path(__file__).parents[1] / "hlsim" / "data" / "speech"
    files = {"female": "train/flite-slt-01.flac", "male": "valid/flite-rms-01.flac"}
    return {
        name: soundfile.read(folder / file, start=9600, frames=12800, dtype="int16")[0]
        for name, file in files.items()
    }


def main() -> None:
    if not GOLDEN_FILE.exists():
        write_first = {"environment": environment(), "outputs": []}
        empty = np.zeros((0, SUMS))
        np.savez_compressed(
            GOLDEN_FILE,
            index=json.dumps(write_first),
            samples=empty[:, 0],
            sums=empty,
            **excerpts(),
        )
    _, speech_arrays, stored = read_file()
    arguments = sys.argv[1:]
    if arguments == ["--all"]:
        names = list(CASES)
    else:
        names = arguments or [name for name in CASES if name not in stored]
    summaries = {name: stored[name] for name in CASES if name in stored and name not in names}
    for name in names:
        summaries[name] = compute(CASES[name])
    write_file(speech_arrays, {name: summaries[name] for name in CASES if name in summaries})
    print(f"{len(names)} cases written, {GOLDEN_FILE.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
