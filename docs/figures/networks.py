"""Train networks through the default loss or another one, and compare them with NAL-R.

    python docs/figures/networks.py train TRAIN_SPEECH VALID_SPEECH NETWORK [--ear N3]
    python docs/figures/networks.py judge \\
        TRAINED VALID_SPEECH VALID_NOISE --model WHISPER [--ear N3]

The networks are ``gru-mask``, ``gru-mask-8ms``, ``conv-mask``, ``waveform`` and ``conv-tasnet``.
Before training, all but the last leave their input unchanged. ``train`` prints a row of a table:
HASPI at 65 dB SPL, for clean speech and at 5 dB SNR in noise with the spectrum of the speech, each
unaided, with NAL-R, with the network, with the network at the output level of NAL-R, and with NAL-R
at the output level of the network. Then, for clean speech, HASQI, the output level, and the
correlation with the clean speech, with the best gain in each band and without.

``judge`` compares the networks that ``train --out TRAINED`` has saved, and NAL-R, at the output
level of NAL-R: HASPI, and the words correct of ``machine_listener.py``, with 95 % intervals.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from compensators import NALR
from examples.training.conv_tasnet import conv_tasnet
from examples.training.filter_bank import SAMPLE_RATE
from hlsim import Audiogram, HASPILoss, HearingLossLoss
from hlsim.calibration import level_spl, set_level
from hlsim.data.clips import Clips
from hlsim.data.mixing import mix
from hlsim.dsp.stft import STFT
from hlsim.evaluation.conditions import AtLevelOf
from hlsim.evaluation.measures import MEASURES
from hlsim.evaluation.study import Measure, run_study
from hlsim.losses.teacher_distance import noise_to_signal_db
from hlsim.metrics import haspi, hasqi
from hlsim.metrics.band_levels import band_edges


class Mask(nn.Module):
    """A network that computes gains for the frequencies of short frames from their levels.

    Args:
        layers: Layers from features of shape (items, frequencies, frames) to logarithms of gains of
            the same shape. The last one is set to zero, so that all gains are 1 before training.
        window: Length of the frames in samples at 16 kHz, an even number; there is one frequency
            more than half of it.
    """

    def __init__(self, *layers: nn.Module, window: int = 512) -> None:
        super().__init__()
        self.stft = STFT(window, window, window // 4)
        self.layers = nn.Sequential(*layers)
        set_to_zero(layers[-1])

    def forward(self, waveform: Tensor) -> Tensor:
        """Apply the gains. Shape: (items, time) -> (items, time)."""
        spectrum = self.stft.analyse(waveform)
        features = (spectrum.abs().square() + 1e-10).log().mT / 4.0
        gains = self.layers(features).mT.exp()
        return self.stft.synthesise(spectrum * gains, waveform.shape[-1])


class GRULayer(nn.GRU):
    """A recurrent layer with channels before time: (items, n, frames) -> (items, 128, frames)."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, 128, batch_first=True)

    def forward(self, features: Tensor) -> Tensor:
        return super().forward(features.mT)[0].mT


class Waveform(nn.Module):
    """Three convolutions of 65 samples and 32 channels, whose output is added to the waveform."""

    def __init__(self) -> None:
        super().__init__()
        first = nn.Conv1d(1, 32, 65, padding=32)
        second = nn.Conv1d(32, 32, 65, padding=32)
        last = set_to_zero(nn.Conv1d(32, 1, 65, padding=32))
        self.layers = nn.Sequential(first, nn.PReLU(), second, nn.PReLU(), last)

    def forward(self, waveform: Tensor) -> Tensor:
        """Add the output of the convolutions. Shape: (items, time) -> (items, time)."""
        return waveform + self.layers(waveform.unsqueeze(1)).squeeze(1)


def gru_mask(window: int = 512) -> Mask:
    """Build a mask of a recurrent and a linear layer, which looks one window ahead."""
    frequencies = window // 2 + 1
    return Mask(GRULayer(frequencies), nn.Conv1d(128, frequencies, 1), window=window)


def conv_mask() -> Mask:
    """Build a mask of three convolutions over time."""
    first = nn.Conv1d(257, 64, 3, padding=1)
    second = nn.Conv1d(64, 64, 3, padding=1)
    return Mask(first, nn.PReLU(), second, nn.PReLU(), nn.Conv1d(64, 257, 3, padding=1))


def set_to_zero(layer: nn.Module) -> nn.Module:
    """Set all parameters of a layer to zero, and return the layer."""
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


def without_channels(network: nn.Module) -> nn.Module:
    """Turn a network for (items, 1, time) into one for (items, time)."""
    return nn.Sequential(nn.Unflatten(-1, (1, -1)), network, nn.Flatten(1))


NETWORKS: dict[str, tuple[Callable[[], nn.Module], float, tuple[float, float]]] = {
    "gru-mask": (gru_mask, 3e-3, (50.0, 80.0)),
    "gru-mask-8ms": (lambda: gru_mask(128), 3e-3, (50.0, 80.0)),
    "conv-mask": (conv_mask, 1e-3, (50.0, 80.0)),
    "waveform": (Waveform, 1e-3, (50.0, 80.0)),
    "conv-tasnet": (lambda: without_channels(conv_tasnet()), 3e-3, (65.0, 65.0)),
}
"""For each network a function that builds it, a learning rate, and a range of levels in dB SPL."""

BEFORE_NALR = "snr"
"""Name of the loss whose networks reduce noise and do not amplify, so that NAL-R follows them."""

LOSSES: dict[str, Callable[[Audiogram], Callable[[Tensor, Tensor], Tensor]]] = {
    "default": HearingLossLoss,
    "with-haspi": partial(HearingLossLoss, criterion={"coherent-bands": 1.0, "haspi": 0.3}),
    "haspi": HASPILoss,
    BEFORE_NALR: lambda ear: lambda output, clean: noise_to_signal_db(output, clean).mean(),
}
"""For each name a function that builds the loss of an output and clean speech for an ear."""


def train_network(
    options: argparse.Namespace, loss: Callable[[Tensor, Tensor], Tensor]
) -> nn.Module:
    """Train the chosen network on 4 clips of 1 s per step."""
    torch.manual_seed(options.seed)
    build, rate, (softest, loudest) = NETWORKS[options.network]
    network = build()
    optimiser = torch.optim.Adam(network.parameters(), lr=options.rate or rate)
    generator = torch.Generator().manual_seed(options.seed)
    clips = Clips(options.train, sample_rate=SAMPLE_RATE, seconds=1.0)
    noises = None
    if options.noise:
        noises = Clips(options.noise, sample_rate=SAMPLE_RATE, seconds=1.0, repeat=True)
    norms = []
    for step in range(1, options.steps + 1):
        speech = clips.draw(4, generator)
        levels = softest + (loudest - softest) * torch.rand(4, generator=generator)
        speech = set_level(speech, levels)
        network_input = speech
        noise = None
        if noises is not None:
            noise = noises.draw(4, generator)
        elif options.noisy:
            noise = draw_speech_shaped_noise(speech, generator)
        if noise is not None:
            network_input = mix(speech, noise, 10.0 * torch.rand(4, generator=generator), None)
        value = loss(network(network_input), speech)
        optimiser.zero_grad()
        value.backward()
        norms.append(float(nn.utils.clip_grad_norm_(network.parameters(), options.clip)))
        optimiser.step()
        if step % 20 == 0 or step == options.steps:
            last_norms = torch.tensor(norms[-20:])
            text = (
                f"step {step}: {value.item():.3f}, norm of the gradient {last_norms.median():.2f}, "
                f"largest {last_norms.max():.1f}"
            )
            print(text, file=sys.stderr, flush=True)
    return network


def draw_speech_shaped_noise(speech: Tensor, generator: torch.Generator) -> Tensor:
    """Draw noise with the mean spectrum of the items. Shape: (items, time) -> (items, time)."""
    noise = torch.fft.rfft(torch.randn(speech.shape, generator=generator))
    magnitude = torch.fft.rfft(speech).abs().square().mean(0).sqrt()
    return torch.fft.irfft(magnitude * noise, speech.shape[-1])


def correlation(output: Tensor, clean: Tensor, *, best_gains: bool) -> float:
    """Compute the mean correlation of output and clean speech over the items.

    Args:
        output: Output of an aid with shape (items, time).
        clean: Clean speech with shape (items, time).
        best_gains: Whether each of 24 bands of the output is multiplied by the gain, of either
            sign, that brings it closest to the clean speech.
    """
    output_spectrum = torch.fft.rfft(output.double())
    clean_spectrum = torch.fft.rfft(clean.double())
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / SAMPLE_RATE).double()
    bands = [(hz >= low) & (hz < high) for low, high in pairwise(torch.as_tensor(band_edges()))]

    def sum_bands(values: Tensor) -> Tensor:
        return torch.stack([values[:, band].sum(-1) for band in bands], -1)

    product = sum_bands((output_spectrum * clean_spectrum.conj()).real)
    output_power = sum_bands(output_spectrum.abs().square())
    clean_power = sum_bands(clean_spectrum.abs().square())
    gains = torch.ones_like(product)
    if best_gains:
        gains = product / output_power.clamp_min(1e-30)
    amplified_power = (gains.square() * output_power).sum(-1)
    correlations = (gains * product).sum(-1) / (amplified_power * clean_power.sum(-1)).sqrt()
    return float(correlations.mean())


@torch.no_grad()
def make_cells(network: nn.Module, ear: Audiogram, speech: Tensor, noise: Tensor) -> list[str]:
    """Compute the cells of the table's row.

    Args:
        network: Trained network.
        ear: Ear that wears the aid.
        speech: Clean speech with shape (items, time).
        noise: Noise with shape (items, time).
    """
    nalr = NALR(ear)
    clean = set_level(speech, 65.0)
    noisy = clean + set_level(noise, 60.0)
    cells = []
    for signal in (clean, noisy):
        output = network(signal)
        prescribed = nalr(signal)
        output_level = level_spl(output)
        prescribed_level = level_spl(prescribed)
        versions = (
            signal,
            prescribed,
            output,
            set_level(output, prescribed_level),
            set_level(prescribed, output_level),
        )
        cells += [f"{float(haspi(version, clean, ear).mean()):.3f}" for version in versions]
    output = network(clean)
    return [
        *cells,
        f"{float(hasqi(output, clean, ear).mean()):.3f}",
        f"{float(level_spl(output).mean()):.1f}",
        f"{correlation(output, clean, best_gains=True):.2f}",
        f"{correlation(output, clean, best_gains=False):.2f}",
    ]


class SavedNetwork(nn.Module):
    """A trained network as an aid, with NAL-R behind it where its loss requires that.

    Args:
        path: File of the parameters, whose name is NETWORK.LOSS.pt.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        network, loss = path.stem.split(".")
        self.network = NETWORKS[network][0]()
        self.network.load_state_dict(torch.load(path))
        self.nalr = NALR() if loss == BEFORE_NALR else None

    def forward(self, waveform: Tensor, ear: Audiogram) -> Tensor:
        """Process a waveform in pascals at 16 kHz. Shape: (time,) -> (time,)."""
        output = self.network(waveform[None])[0]
        return output if self.nalr is None else self.nalr(output, ear)


def judge(options: argparse.Namespace) -> None:
    """Print HASPI and words correct of saved networks and NAL-R, and their differences."""
    from examples import machine_listener as listener

    nalr, ears = NALR(), {options.ear: Audiogram.standard(options.ear)}
    sentences = listener.read_sentences(listener.SENTENCES)
    parts = (options.speech, options.noise, sentences)
    items = listener.make_items(*parts, ears, options.snrs, seed=0)
    aids = {"NAL-R": nalr}
    for path in sorted(Path(options.trained).glob("*.pt")):
        aids[path.stem] = SavedNetwork(path)
    conditions = [
        listener.AtEqualLevel(name, AtLevelOf(aid, nalr).eval()) for name, aid in aids.items()
    ]
    words = Measure("words_correct", listener.WordsCorrect(listener.Whisper(options.model)))
    table = run_study(items, conditions, [MEASURES["haspi"], words], jobs=1)
    failures = table["failure"].dropna()
    if not failures.empty:
        raise ValueError(f"{len(failures)} outputs have no score; the first: {failures.iloc[0]}")
    print_differences("words correct", listener.Comparison(table), list(aids), options.snrs)
    # Each sentence counts as one word, and HASPI as the share of it that is correct.
    table = table.assign(words_correct=table["haspi"], text="word")
    print_differences("HASPI", listener.Comparison(table), list(aids), options.snrs)


def print_differences(title: str, comparison: Any, aids: list[str], snrs: list[float]) -> None:
    """Print the scores of aids, minus those of NAL-R, and minus the network's by default.

    Args:
        title: Name of the score.
        comparison: A ``Comparison`` of ``machine_listener.py``.
        aids: Names of the aids, NETWORK.LOSS or NAL-R.
        snrs: SNRs in dB. Their mean makes the last column.
    """
    from examples.machine_listener import describe, print_table

    scores = {}
    for aid in aids:
        scores[aid] = [comparison.shares(aid, snr) for snr in snrs]
        scores[aid].append(sum(scores[aid]) / len(snrs))
    rows = [[aid, *map(describe, values)] for aid, values in scores.items()]
    for aid, values in scores.items():
        network = aid.partition(".")[0]
        for other in ("NAL-R", f"{network}.default"):
            if aid != "NAL-R" and aid != other and other in scores:
                pairs = zip(values, scores[other], strict=True)
                differences = [describe(value - base, "+.3f") for value, base in pairs]
                rows.append([f"{aid} minus {other}", *differences])
    print_table([title, *(f"{snr:g} dB" for snr in snrs), "mean"], rows)


def train(options: argparse.Namespace) -> None:
    """Train a network, save it, and print its row of the table."""
    ear, generator = Audiogram.standard(options.ear), torch.Generator().manual_seed(0)
    speech = Clips(options.valid, sample_rate=SAMPLE_RATE, seconds=2.0).draw(
        options.items, generator
    )
    noise = draw_speech_shaped_noise(speech, generator)
    network = train_network(options, LOSSES[options.loss](ear)).eval()
    if options.out:
        Path(options.out).mkdir(parents=True, exist_ok=True)
        path = Path(options.out) / f"{options.network}.{options.loss}.pt"
        torch.save(network.state_dict(), path)
    if options.loss == BEFORE_NALR:
        network = nn.Sequential(network, NALR(ear))
    print(f"| {options.network} | {' | '.join(make_cells(network, ear, speech, noise))} |")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("train")
    command.add_argument("train")
    command.add_argument("valid")
    command.add_argument("network", choices=NETWORKS)
    command.add_argument("--ear", default="N3")
    command.add_argument("--loss", choices=LOSSES, default="default")
    command.add_argument("--steps", type=int, default=300)
    command.add_argument("--rate", type=float, help="Adam's learning rate")
    command.add_argument(
        "--clip", type=float, default=float("inf"), help="largest norm of the gradient"
    )
    command.add_argument("--noisy", action="store_true", help="train in noise at 0 to 10 dB SNR")
    command.add_argument("--noise", help="train in the noise of a folder at 0 to 10 dB SNR")
    command.add_argument("--out", help="folder in which the network is saved")
    command.add_argument(
        "--items", type=int, default=12, help="number of clips of 2 s that are scored"
    )
    command.add_argument("--seed", type=int, default=0)
    command.set_defaults(run=train)
    command = commands.add_parser("judge")
    command.add_argument("trained", help="folder of saved networks")
    command.add_argument("speech", help="folder of the speech of machine_listener.csv")
    command.add_argument("noise", help="folder of noise, with a subfolder for each kind")
    command.add_argument("--model", required=True, help="folder of a Whisper model")
    command.add_argument("--ear", default="N3")
    command.add_argument("--snrs", type=float, nargs="+", default=[0.0, 5.0], help="SNRs in dB")
    command.set_defaults(run=judge)
    options = parser.parse_args(arguments)
    options.run(options)


if __name__ == "__main__":
    main()
