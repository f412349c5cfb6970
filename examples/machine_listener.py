"""Words that a recogniser finds in the output of hearing aids, as an impaired ear perceives it.

HASPI is no independent judge of an aid that was trained by it. This *machine listener* has learned
from no simulator and no score. A simulator, by default the exact MSBG, is the impaired ear, the
internal noise of the ear after ANSI S3.5-1997 hides what is inaudible, and Whisper or Moonshine
writes down what is left. The share of the words of a sentence that it recognises, *words correct*,
depends on level, noise and loss.

Whisper needs `pip install faster-whisper` and a folder with a model for CTranslate2 (model.bin,
config.json, tokenizer.json, vocabulary.txt). Moonshine needs `pip install moonshine_voice==0.0.48`,
which contains the model `moonshine-tiny`. Both run offline.

    python examples/machine_listener.py transcribe speech/valid --models TINY BASE --out FILE.csv
    python examples/machine_listener.py compare speech/valid noise/valid --model TINY \\
        --audiograms audiograms/valid.csv --aids hearing-aid nalr --out listened
    python examples/machine_listener.py compare speech/valid noise/valid --model moonshine-tiny \\
        --simulator attenuation --audiograms audiograms/valid.csv --out listened-linear

`transcribe` cuts recordings at pauses and keeps the pieces in which two models recognise the same
words. `compare` processes these sentences by every aid for every ear, scales all outputs to the level
of the first aid's output (unless `--own-levels` is given), and prints words correct with 95 %
intervals (bootstrap over sentences and ears), paired differences, and the speech reception threshold.
A stopped comparison continues where it was; outputs of a plug-in are computed again unless it has an
attribute `fingerprint`, such as a version.

An aid is a name that `load_compensator` takes, a plug-in `file.py:NAME` called with a waveform and an
ear, or `unaided`; `hearing-aid@0.5` is an aid with half of its noise reduction, and
`equaliser:hearing-aid` a fixed filter with the mean gain of an aid for the ear.

The measure also scores recorded files, whose sentences are found by their names in a CSV file with the
columns item and text:

    export WHISPER_MODEL=TINY WHISPER_SENTENCES=FILE.csv
    hlsim haspi-report --manifest items.csv --measure examples/machine_listener.py:WordsCorrect

A recogniser is not a person. It was trained on noisy speech, and noise may disturb it less than a
person. The recogniser is independent of hlsim, but the simulated ear is not: compare aids behind more
than one.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from compensators import load_compensator
from hlsim import Audiogram
from hlsim.audio import find_audio, read_audio
from hlsim.audiogram.table import read_audiograms
from hlsim.calibration import PASCAL_SPL, level_spl, set_level
from hlsim.data.bundled import EXAMPLE_FILE
from hlsim.data.clips import Clips
from hlsim.data.mixing import mix
from hlsim.dsp.resample import resample
from hlsim.evaluation.conditions import AtLevelOf, EqualiserLike, Unaided
from hlsim.evaluation.digits.material import INTERNAL_NOISE_DB, INTERNAL_NOISE_HZ
from hlsim.evaluation.running.fingerprint import fingerprint, value_hash
from hlsim.evaluation.running.store import ScoreStore
from hlsim.evaluation.study import Condition, Item, Measure, run_study
from hlsim.extras import is_installed
from hlsim.files import read_table, sha256
from hlsim.plugins import load_plugin
from hlsim.progress import ProgressLine
from hlsim.simulators import load_simulator

if TYPE_CHECKING:
    from pandas import DataFrame

RATE = 16000
SENTENCES = Path(__file__).with_suffix(".csv")
"""Sentences of the validation speech of docs/results.md."""

SPEECH_LEVEL = 65.0
"""Level of clean speech in dB SPL."""

STANDARD_EARS = ("N2", "N3", "N4", "S2")
MEASURED_EARS = 4

PEAK = 0.5
"""Largest sample of the recogniser's input, which hears no level."""

PADDING_SECONDS = 0.5
"""Silence after the recogniser's input."""

LONGEST_SECONDS = 29.0
"""Longest input in seconds: Whisper processes 30 s at once."""

FRAMES_PER_STEP = 100
"""Inputs of Whisper have a multiple of this number of frames of 10 ms."""

RESAMPLES = 2000

EQUALISER = "equaliser:"
"""Beginning of the name of an aid that is an equaliser."""

EQUALISER_LEVELS = (50.0, 65.0, 80.0)
"""Levels of speech in dB SPL over which an equaliser averages the gain of an aid."""

PAUSE_SECONDS, PAUSE_DB = 0.15, -30.0
"""Shortest pause, and its highest level relative to the loudest 20 ms."""

PIECE_SECONDS = (2.0, 6.0)
"""Shortest and longest piece of a recording that becomes a sentence."""


def internal_noise(samples: int, seed: int) -> NDArray[np.float32]:
    """Draw the internal noise of a normal ear in pascals at 16 kHz.

    The level is interpolated over log frequency. Shape: -> (samples,).

    >>> internal_noise(16000, seed=0).shape
    (16000,)
    """
    generator = np.random.default_rng(seed)
    spectrum = np.fft.rfft(generator.standard_normal(samples))
    hertz = np.fft.rfftfreq(samples, 1.0 / RATE).clip(INTERNAL_NOISE_HZ[0])
    levels = np.interp(np.log(hertz), np.log(INTERNAL_NOISE_HZ), INTERNAL_NOISE_DB)
    # White noise of variance 1 has a power of 2 / RATE per Hz.
    gains = 10.0 ** ((levels - PASCAL_SPL) / 20.0) * math.sqrt(RATE / 2.0)
    noise: NDArray[np.float32] = np.fft.irfft(spectrum * gains, samples).astype(np.float32)
    return noise


def split_words(text: str) -> list[str]:
    """Split a text into lower-case words without punctuation and annotations in brackets.

    >>> split_words("Well-known: the dog's [barking] bone.")
    ['well', 'known', 'the', "dog's", 'bone']
    """
    plain = re.sub(r"\[[^\]]*\]|\([^)]*\)", " ", text.lower().replace("’", "'"))
    words = re.sub(r"[^a-z0-9' ]", " ", plain).split()
    return [word.strip("'") for word in words if word.strip("'")]


def count_correct(spoken: Sequence[str], recognised: Sequence[str]) -> int:
    """Count the spoken words that an alignment with the fewest errors finds.

    Errors are substitutions, insertions and deletions. Among alignments with equally many errors,
    the one with most correct words counts.

    >>> count_correct("the dog ran home".split(), "a dog run back home".split())
    2
    """
    # Each cell is (errors, -correct words) of the best alignment of two beginnings.
    row = [(column, 0) for column in range(len(recognised) + 1)]
    for number, word in enumerate(spoken, start=1):
        previous, row = row, [(number, 0)]
        for column, other in enumerate(recognised, start=1):
            is_same = word == other
            errors, correct = previous[column - 1]
            matched = (errors + (not is_same), correct - is_same)
            deleted = (previous[column][0] + 1, previous[column][1])
            inserted = (row[column - 1][0] + 1, row[column - 1][1])
            row.append(min(matched, deleted, inserted))
    return -row[-1][1]


class Whisper:
    """Greedy recognition by a Whisper model in English, on one thread.

    Args:
        folder: Whisper model for CTranslate2.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        self.fingerprint = sha256(self.folder / "model.bin")

    def __reduce__(self) -> Any:
        return Whisper, (self.folder,)

    @cached_property
    def _parts(self) -> tuple[Any, Any, Any]:
        """Model, tokeniser and computation of features, loaded when they are needed."""
        import ctranslate2
        import tokenizers
        from faster_whisper.feature_extractor import FeatureExtractor
        from faster_whisper.tokenizer import Tokenizer

        model = ctranslate2.models.Whisper(
            str(self.folder), compute_type="float32", intra_threads=1, inter_threads=1
        )
        vocabulary = tokenizers.Tokenizer.from_file(str(self.folder / "tokenizer.json"))
        task = {"task": "transcribe", "language": "en"} if model.is_multilingual else {}
        tokeniser = Tokenizer(vocabulary, model.is_multilingual, **task)
        return model, tokeniser, FeatureExtractor()

    @property
    def prompt(self) -> list[int]:
        """Tokens before each text: the start, the language and the task, and no timestamps."""
        _, tokeniser, _ = self._parts
        return [*tokeniser.sot_sequence, tokeniser.no_timestamps]

    @property
    def mel_filters(self) -> Tensor:
        """Weights of the 201 frequencies of a spectrum in mel bands. Shape: (bands, 201)."""
        _, _, compute_features = self._parts
        return torch.from_numpy(np.asarray(compute_features.mel_filters, np.float32))

    def encode(self, text: str) -> list[int]:
        """Return the tokens of a text. A word's token begins with the space before it."""
        _, tokeniser, _ = self._parts
        tokens: list[int] = tokeniser.encode(text)
        return tokens

    def __call__(self, waveform: NDArray[np.float32]) -> str:
        """Return the text of a waveform at 16 kHz. Shape: (time,)."""
        import ctranslate2

        model, tokeniser, compute_features = self._parts
        if len(waveform) > LONGEST_SECONDS * RATE:
            raise ValueError(f"expected at most {LONGEST_SECONDS:g} s, got {len(waveform) / RATE}")
        scaled = (waveform * (PEAK / np.abs(waveform).max())).astype(np.float32)
        frames = (len(waveform) / RATE + PADDING_SECONDS) * 100.0
        frames = math.ceil(frames / FRAMES_PER_STEP) * FRAMES_PER_STEP
        padded = np.pad(scaled, (0, frames * RATE // 100 - len(scaled)))
        features = compute_features(padded, padding=0)[None, :, :frames]
        result = model.generate(
            ctranslate2.StorageView.from_array(np.ascontiguousarray(features, np.float32)),
            [self.prompt],
            beam_size=1,
            max_length=100,
            no_repeat_ngram_size=5,
        )
        tokens = [token for token in result[0].sequences_ids[0] if token < tokeniser.eot]
        text: str = tokeniser.decode(tokens)
        return text


class Moonshine:
    """Recognition by a Moonshine model in English that the package moonshine_voice contains.

    Args:
        name: Folder of the model in the package.
    """

    def __init__(self, name: str = "tiny-en") -> None:
        self.name = name

    def __reduce__(self) -> Any:
        return Moonshine, (self.name,)

    @property
    def fingerprint(self) -> str:
        """Name of the model and version of the package, which contains it."""
        return f"{self.name} of moonshine_voice {version('moonshine_voice')}"

    @cached_property
    def _transcriber(self) -> Any:
        from moonshine_voice import ModelArch, Transcriber, get_model_path

        return Transcriber(str(get_model_path(self.name)), ModelArch.TINY)

    def __call__(self, waveform: NDArray[np.float32]) -> str:
        """Return the text of a waveform at 16 kHz. Shape: (time,)."""
        scaled = waveform * (PEAK / np.abs(waveform).max())
        padded = np.pad(scaled, (0, round(PADDING_SECONDS * RATE)))
        transcript = self._transcriber.transcribe_without_streaming(padded.tolist(), RATE)
        return " ".join(line.text for line in transcript.lines)


def load_recogniser(name: str) -> Callable[[NDArray[np.float32]], str]:
    """Return Moonshine for the name ``moonshine-tiny``, and Whisper for a folder.

    Raises:
        ModuleNotFoundError: The package of Moonshine is not installed.
    """
    if name != "moonshine-tiny":
        return Whisper(name)
    if not is_installed("moonshine_voice"):
        raise ModuleNotFoundError(
            "moonshine_voice is not installed; install it with: pip install moonshine_voice==0.0.48"
        )
    return Moonshine()


class WordsCorrect:
    """Measure of a study: the share of a sentence's words that the machine listener recognises.

    The text is the item's fact ``text``, or that of its fact ``utterance`` in the file of sentences.

    Args:
        recognise: Function of samples at 16 kHz, (time,), that returns a text; by default the
            recogniser that the environment variable ``WHISPER_MODEL`` names.
        sentences: Texts by utterance; by default those of the CSV file in ``WHISPER_SENTENCES``.
        simulator: Name of the simulated ear, as in ``load_simulator``.
    """

    def __init__(
        self,
        recognise: Callable[[NDArray[np.float32]], str] | None = None,
        sentences: Mapping[str, str] | None = None,
        simulator: str = "msbg",
    ) -> None:
        self.recognise = recognise or load_recogniser(os.environ["WHISPER_MODEL"])
        if sentences is None and "WHISPER_SENTENCES" in os.environ:
            sentences = {}
            for place, row in read_table(os.environ["WHISPER_SENTENCES"], "the sentences"):
                if sentences.setdefault(row["item"], row["text"]) != row["text"]:
                    raise ValueError(
                        f"{place}: the item {row['item']} has another text in an earlier line; "
                        "remove one of them"
                    )
        self.sentences = sentences or {}
        self.simulator = load_simulator(simulator, sample_rate=RATE)

    @property
    def fingerprint(self) -> str | None:
        """Fingerprint of recogniser, simulator and texts; None if one of them has none."""
        recogniser = getattr(self.recognise, "fingerprint", None)
        simulator = fingerprint(self.simulator)
        if recogniser is None or simulator is None:
            return None
        return value_hash([recogniser, simulator, dict(self.sentences)])

    def __call__(self, item: Item, output: Tensor) -> dict[str, float]:
        text = item.facts.get("text") or self.sentences.get(str(item.facts.get("utterance")))
        if text is None:
            raise ValueError(f"the text of {item.name} is unknown; add it to WHISPER_SENTENCES")
        signal = resample(output, item.sample_rate, RATE)
        pascals = signal.float() * 10.0 ** ((item.full_scale_spl - PASCAL_SPL) / 20.0)
        spoken = split_words(text)
        recognised = split_words(self.recognise(self.perceive(pascals, item.ear, item.seed)))
        return {"words_correct": count_correct(spoken, recognised) / len(spoken)}

    @torch.no_grad()
    def perceive(self, output: Tensor, ear: Audiogram, seed: int) -> NDArray[np.float32]:
        """Return what an ear perceives, with its internal noise. Shape: (time,) in pascals."""
        perceived: NDArray[np.float32] = self.simulator(output, ear).numpy()
        return perceived + internal_noise(len(perceived), seed)


class Sentence(NamedTuple):
    """A piece of a recording and its text."""

    path: str
    start: float
    end: float
    text: str


def find_cuts(speech: NDArray[np.float32]) -> list[int]:
    """Return the first sample, the middle of each pause, and the end of speech at 16 kHz.

    Shape: (time,).
    """
    hop = RATE // 50
    frames = speech[: len(speech) // hop * hop].reshape(-1, hop)
    power = np.square(frames, dtype=np.float64).mean(-1)
    is_quiet = power < power.max() * 10.0 ** (PAUSE_DB / 10.0)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], is_quiet, [0]))))
    pauses = [(a, b) for a, b in edges.reshape(-1, 2) if b - a >= PAUSE_SECONDS * 50]
    return [0, *(int(a + b) // 2 * hop for a, b in pauses), len(speech)]


def transcribe(
    speech: str | Path, recognisers: Sequence[Callable[[NDArray[np.float32]], str]]
) -> list[Sentence]:
    """Return pieces of recordings, from pause to pause, in which all recognisers find the same words.

    Pieces do not overlap. They have 2 to 6 s and three or more words, and are as long as possible.
    """
    sentences = []
    for path in find_audio(speech):
        name = path.relative_to(speech).as_posix()
        waveform = load_speech(path)
        cuts = find_cuts(waveform)
        while len(cuts) > 1:
            start, *ends = cuts
            found = None
            for end in reversed(ends):
                if PIECE_SECONDS[0] <= (end - start) / RATE <= PIECE_SECONDS[1]:
                    found = agreed_text(waveform[start:end], recognisers)
                if found is not None:
                    sentences.append(Sentence(name, start / RATE, end / RATE, found))
                    break
            cuts = cuts[1:] if found is None else cuts[cuts.index(end) :]
    return sentences


def agreed_text(
    waveform: NDArray[np.float32], recognisers: Sequence[Callable[[NDArray[np.float32]], str]]
) -> str | None:
    """Return the text of three or more words in which all recognisers agree, or None.

    Whisper may write a short text twice. Such texts are rejected.
    """
    text = recognisers[0](waveform).strip()
    words = split_words(text)
    half = len(words) // 2
    if len(words) < 3 or words[:half] == words[half:]:
        return None
    is_agreed = all(split_words(recognise(waveform)) == words for recognise in recognisers[1:])
    return text if is_agreed else None


def load_speech(path: str | Path) -> NDArray[np.float32]:
    """Read the first channel of a recording at 16 kHz. Shape: -> (time,)."""
    waveform, rate = read_audio(path)
    samples: NDArray[np.float32] = resample(waveform[0], rate, RATE).numpy()
    return samples


def read_sentences(path: str | Path) -> list[Sentence]:
    """Read the file that ``transcribe`` writes."""
    rows = [row for _, row in read_table(path, "the sentences")]
    return [
        Sentence(row["path"], float(row["start"]), float(row["end"]), row["text"]) for row in rows
    ]


def make_items(
    speech: str | Path,
    noise: str | Path,
    sentences: Sequence[Sentence],
    ears: Mapping[str, Audiogram],
    snrs_db: Sequence[float],
    seed: int,
    step: int = 1,
) -> list[Item]:
    """Return every sentence for its ears at every SNR in dB; an SNR of infinity is quiet.

    A sentence has the same piece of noise for all ears and SNRs. Kinds of noise, the subfolders of
    the folder, take turns.

    Args:
        speech, noise: Folders.
        sentences: Pieces of the files of speech.
        ears: Audiograms by name.
        snrs_db: signal-to-noise ratios in dB, by active speech level.
        seed: Seed of the noise and of the internal noise.
        step: Every ``step``-th ear processes a sentence, beginning with another one for the next.
    """
    generator = torch.Generator().manual_seed(seed)
    kinds = sorted(path for path in Path(noise).iterdir() if path.is_dir()) or [Path(noise)]
    items = []
    for number, sentence in enumerate(sentences):
        recording = load_speech(Path(speech) / sentence.path)
        piece = recording[round(sentence.start * RATE) : round(sentence.end * RATE)]
        clean = set_level(torch.from_numpy(piece), SPEECH_LEVEL)[None]
        kind = kinds[number % len(kinds)]
        seconds = clean.shape[-1] / RATE
        clips = Clips(kind, sample_rate=RATE, seconds=seconds, repeat=True)
        masker = clips.draw(1, generator)[:, : clean.shape[-1]]
        for snr in snrs_db:
            signal = clean
            if math.isfinite(snr):
                signal = mix(clean, masker, torch.tensor([snr]), RATE)
            for name, ear in [*ears.items()][number % step :: step]:
                facts = {"sentence": number, "text": sentence.text, "ear": name}
                facts |= {"snr": snr, "noise": kind.name}
                item = Item(
                    f"sentence {number}", clean[0], signal[0], ear, seed=seed + number, facts=facts
                )
                items.append(item)
    return items


class WithSlider(nn.Module):
    """A hearing aid with a fixed share of its noise reduction."""

    def __init__(self, aid: nn.Module, noise_reduction: float) -> None:
        super().__init__()
        self.aid, self.noise_reduction = aid, noise_reduction

    def forward(self, waveform: Tensor, audiogram: Audiogram) -> Tensor:
        """Process a waveform for an ear."""
        output: Tensor = self.aid(waveform, audiogram, noise_reduction=self.noise_reduction)
        return output


def load_aid(name: str) -> Any:
    """Load an aid by one of the names in the description of this file."""
    if name == "unaided":
        return Unaided().eval()
    if ".py:" in name:
        return load_plugin(name, "aid")
    if name.startswith(EQUALISER):
        aid = load_aid(name.removeprefix(EQUALISER))
        speech = torch.from_numpy(load_speech(EXAMPLE_FILE))
        return EqualiserLike(aid, speech[None], EQUALISER_LEVELS).eval()
    name, at, slider = name.partition("@")
    aid = load_compensator(name).eval()
    return WithSlider(aid, float(slider)).eval() if at else aid


class AtEqualLevel(Condition):
    """A condition whose process is an ``AtLevelOf``; the level is computed once per item."""

    def output(self, item: Item) -> Tensor:
        """Process an item with the aid, at the level of the other aid's output."""
        assert isinstance(self.process, AtLevelOf)
        aid, other = self.process.aid, self.process.other
        time = item.signal.shape[-1]  # Samples after the end of the input are not scored.
        # A plug-in that changes its input in place must not change the item.
        copies = item.signal.clone(), item.signal.clone()
        level = item.once("level", lambda: level_spl(other(copies[0], item.ear)[..., :time]))
        return set_level(aid(copies[1], item.ear)[..., :time], level)


def make_conditions(aids: Sequence[str], *, own_levels: bool) -> list[Condition]:
    """Return one condition per aid.

    All outputs have the level of the first aid's output, unless ``own_levels`` is set.
    """
    if own_levels:
        return [Condition(name, load_aid(name)) for name in aids]
    first = load_aid(aids[0])
    return [AtEqualLevel(name, AtLevelOf(load_aid(name), first).eval()) for name in aids]


def reception_threshold(snrs_db: Sequence[float], shares: Sequence[float], target: float) -> float:
    """Return the lowest SNR in dB at which the share of words reaches a target, by interpolation.

    Returns: Minus infinity if the share at the lowest SNR reaches the target, and infinity if no
        share does.

    >>> reception_threshold([-5, 0, 5, 10], [0.125, 0.25, 0.5, 0.75], 0.375)
    2.5
    >>> reception_threshold([0, 5], [0.5, 0.9], 0.4)
    -inf
    """
    points = sorted(zip(snrs_db, shares, strict=True))
    if points[0][1] >= target:
        return -math.inf
    for (low, below), (high, above) in pairwise(points):
        if below < target <= above:
            return low + (high - low) * (target - below) / (above - below)
    return math.inf


class Comparison:
    """Words correct of a table of ``run_study``, with intervals by a bootstrap.

    A share is the number of correct words divided by the number of all words, over all ears. The
    bootstrap draws sentences and, independently of them, ears, because results should hold for
    other sentences and for other ears.

    Args:
        table: Rows of the study.
        seed: Seed of the bootstrap.
    """

    def __init__(self, table: DataFrame, seed: int = 0) -> None:
        self.table = table.assign(words=table["text"].map(lambda text: len(split_words(text))))
        self.table["correct"] = self.table["words_correct"] * self.table["words"]
        self.sentences = sorted(self.table["sentence"].unique())
        self.ears = sorted(self.table["ear"].unique())
        generator = np.random.default_rng(seed)
        self.sentence_counts = draw_counts(generator, len(self.sentences))
        self.ear_counts = draw_counts(generator, len(self.ears))

    def shares(self, condition: str, snr: float, ear: str | None = None) -> NDArray[np.float64]:
        """Return the share of all sentences, and of each resample. Shape: -> (1 + resamples,).

        Args:
            condition: Name of the aid.
            snr: SNR in dB.
            ear: Name of one ear, for which sentences alone are drawn; by default all ears.
        """
        table = self.table
        chosen = table[(table["condition"] == condition) & (table["snr"] == snr)]
        ears = self.ears if ear is None else [ear]
        ear_counts = self.ear_counts if ear is None else np.ones((1 + RESAMPLES, 1))
        sums = []
        for column in ("correct", "words"):
            grid = chosen.pivot_table(column, "sentence", "ear", aggfunc="sum")
            values = grid.reindex(index=self.sentences, columns=ears).fillna(0.0).to_numpy()
            sums.append(((self.sentence_counts @ values) * ear_counts).sum(-1))
        correct, words = sums
        # A resample may contain no sentence of its ears.
        with np.errstate(invalid="ignore"):
            shares: NDArray[np.float64] = correct / words
        return shares

    def thresholds(self, condition: str, target: float) -> NDArray[np.float64]:
        """Return the speech reception threshold in dB of all sentences, and of each resample.

        The values of ``reception_threshold``, which may be infinite. Shape: -> (1 + resamples,).
        """
        snrs = sorted(snr for snr in self.table["snr"].unique() if math.isfinite(snr))
        shares = np.stack([self.shares(condition, snr) for snr in snrs], -1)
        return np.array([reception_threshold(snrs, list(row), target) for row in shares])


def draw_counts(generator: np.random.Generator, size: int) -> NDArray[np.float64]:
    """Draw how often each of ``size`` things is in each resample.

    Returns: Counts. Those of row 0 are 1, so that it stands for the data themselves. Shape: (1 +
        resamples, size).
    """
    drawn = generator.integers(0, size, (RESAMPLES, size))
    counts = [np.ones(size), *(np.bincount(row, minlength=size) for row in drawn)]
    return np.stack(counts).astype(np.float64)


def describe(values: NDArray[np.float64], form: str = ".3f") -> str:
    """Return the first value with the 95 % interval of the others, as text.

    An infinite threshold is "below all SNRs" or "not reached". Infinite resamples count in the
    interval.

    >>> describe(np.array([1.0, 1.0, 1.0]))
    '1.000 [1.000, 1.000]'
    """
    if not math.isfinite(values[0]):
        return "below all SNRs" if values[0] < 0.0 else "not reached"
    resamples = values[1:][~np.isnan(values[1:])]
    # Percentiles are not interpolated, because infinite values cannot be.
    low = np.percentile(resamples, 2.5, method="lower")
    high = np.percentile(resamples, 97.5, method="higher")
    return f"{values[0]:{form}} [{low:{form}}, {high:{form}}]"


def print_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table in Markdown."""
    for cells in (header, ["---"] * len(header), *rows):
        print(f"| {' | '.join(cells)} |", flush=True)
    print()


def print_report(table: DataFrame, normal: DataFrame, baseline: str) -> None:
    """Print words correct, differences from a baseline, and speech reception thresholds.

    Args:
        table: Rows of the aids.
        normal: Rows of a normal ear without an aid.
        baseline: Name of the aid that is subtracted.
    """
    aids, ears = list(table["condition"].unique()), list(table["ear"].unique())
    snrs = sorted(table["snr"].unique())
    comparison, normal_ear = Comparison(table), Comparison(normal)
    places = ["quiet" if math.isinf(snr) else f"{snr:g} dB" for snr in snrs]
    words = int(comparison.table.drop_duplicates("sentence")["words"].sum())
    print(f"{len(comparison.sentences)} sentences, {words} words, {len(ears)} ears\n")
    shares = {aid: [comparison.shares(aid, snr) for snr in snrs] for aid in aids}
    rows = [[aid, *map(describe, values)] for aid, values in shares.items()]
    normal_shares = [normal_ear.shares("unaided", snr) for snr in snrs]
    print_table(
        ["words correct", *places],
        [["normal ear, unaided", *map(describe, normal_shares)], *rows],
    )
    rows = []
    for aid, values in shares.items():
        if aid != baseline:
            pairs = zip(values, shares[baseline], strict=True)
            rows.append([aid, *(describe(value - base, "+.3f") for value, base in pairs)])
    print_table([f"minus {baseline}", *places], rows)
    rows = []
    for aid in aids:
        for snr, place in zip(snrs, places, strict=True):
            values = [float(comparison.shares(aid, snr, ear)[0]) for ear in ears]
            rows.append([aid, place, *(f"{value:.3f}" for value in values)])
    print_table(["words correct", "", *ears], rows)
    if math.inf in snrs and len(snrs) > 2:
        target = 0.5 * float(normal_shares[-1][0])
        rows = [[aid, describe(comparison.thresholds(aid, target), "+.1f")] for aid in aids]
        rows.insert(
            0, ["normal ear, unaided", describe(normal_ear.thresholds("unaided", target), "+.1f")]
        )
        print_table([f"SNR in dB for {target:.3f} of the words", ""], rows)


def choose_ears(audiograms: str | Path) -> dict[str, Audiogram]:
    """Return four standard ears and up to four measured ones, at equal steps through a CSV file."""
    ears = {name: Audiogram.standard(name) for name in STANDARD_EARS}
    measured = read_audiograms(audiograms, simulated=True)
    step = max(1, len(measured) // MEASURED_EARS)
    for number, (row, ear) in enumerate(measured[::step][:MEASURED_EARS], start=1):
        name = " ".join(filter(None, (row.get("listener"), row.get("ear"))))
        is_new = bool(name) and name not in ears
        ears[name if is_new else f"{name} {number}".strip()] = ear
    return ears


def run_transcribe(options: argparse.Namespace) -> None:
    """Write the sentences of a folder of speech."""
    found = transcribe(options.speech, [load_recogniser(name) for name in options.models])
    with open(options.out, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Sentence._fields)
        table.writerows((s.path, f"{s.start:.2f}", f"{s.end:.2f}", s.text) for s in found)


def run_compare(options: argparse.Namespace) -> None:
    """Compare aids, and write the table of all values."""
    listener = WordsCorrect(load_recogniser(options.model), simulator=options.simulator)
    measure = Measure("words_correct", listener, packages=["hlsim"], settings=listener.fingerprint)
    sentences = read_sentences(options.sentences)
    parts = (options.speech, options.noise, sentences)
    snrs = [math.inf if snr == "quiet" else float(snr) for snr in options.snrs]
    settings = (snrs, options.seed)
    items = make_items(*parts, choose_ears(options.audiograms), *settings, step=options.step)
    normal_items = make_items(*parts, {"NH": Audiogram.standard("NH")}, *settings)
    out = Path(options.out)
    running: dict[str, Any] = {"store": ScoreStore(out / "scores.jsonl"), "jobs": options.jobs}
    unaided = Condition("unaided", Unaided().eval())
    with ProgressLine("outputs for a normal ear") as progress:
        normal = run_study(normal_items, [unaided], [measure], progress=progress, **running)
    conditions = make_conditions(options.aids, own_levels=options.own_levels)
    with ProgressLine("outputs") as progress:
        table = run_study(items, conditions, [measure], progress=progress, **running)
    table.to_csv(out / "table.csv", index=False)
    failures = table["failure"].dropna()
    if not failures.empty:
        raise ValueError(f"{len(failures)} outputs have no value; the first: {failures.iloc[0]}")
    print_report(table, normal, options.baseline or options.aids[-1])


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("transcribe", help="find sentences whose words are known")
    command.add_argument("speech", help="folder of speech")
    command.add_argument("--models", nargs="+", required=True, help="recognisers")
    command.add_argument("--out", required=True, help="CSV file that is written")
    command.set_defaults(run=run_transcribe)
    command = commands.add_parser("compare", help="compare hearing aids")
    command.add_argument("speech", help="folder of speech")
    command.add_argument("noise", help="folder of noise, with a subfolder for each kind")
    text = "recogniser: the folder of a Whisper model, or moonshine-tiny"
    command.add_argument("--model", required=True, help=text)
    text = "simulated ear: msbg, attenuation, or another name of a simulator"
    command.add_argument("--simulator", default="msbg", help=text)
    command.add_argument("--audiograms", required=True, help="CSV file of measured ears")
    command.add_argument("--sentences", default=SENTENCES, help="CSV file of sentences")
    command.add_argument("--aids", nargs="+", default=["hearing-aid", "nalr"], help="aids")
    command.add_argument("--baseline", help="aid that is subtracted; by default the last one")
    command.add_argument("--own-levels", action="store_true", help="do not equalise levels")
    command.add_argument("--snrs", nargs="+", default=["0", "5", "quiet"], help="SNRs in dB")
    command.add_argument("--seed", type=int, default=0, help="seed of noise and internal noise")
    command.add_argument("--step", type=int, default=1, help="every STEP-th ear, in turn")
    command.add_argument("--jobs", type=int, default=1, help="number of processes")
    command.add_argument("--out", required=True, help="folder of the values")
    command.set_defaults(run=run_compare)
    options = parser.parse_args(arguments)
    options.run(options)


if __name__ == "__main__":
    main()
