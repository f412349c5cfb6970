"""The machine listener of examples/machine_listener.py, with a recogniser that needs no Whisper."""

import doctest
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas
import pytest
import torch
from scipy.signal import welch

from hlsim import Audiogram
from hlsim.audio import write_audio
from hlsim.calibration import level_spl, set_level
from hlsim.evaluation.measures import load_measure
from hlsim.evaluation.study import Item
from tests.helpers import EXAMPLES, load_example, write_ears

FILE = EXAMPLES / "machine_listener.py"
TEXT = "one two three four five six seven eight"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    return load_example("machine_listener.py")


def recognise_loud_eighths(waveform: np.ndarray) -> str:
    """Return the words of TEXT in whose eighth of the waveform the level exceeds 40 dB SPL."""
    eighths = torch.from_numpy(waveform[: len(waveform) // 8 * 8]).reshape(8, -1)
    words = TEXT.split()
    levels = level_spl(eighths).tolist()
    return " ".join(word for word, level in zip(words, levels, strict=True) if level > 40.0)


def test_examples_of_docstrings(example: ModuleType) -> None:
    result = doctest.testmod(example)
    assert result.attempted >= 4 and result.failed == 0


@pytest.mark.parametrize(
    ("spoken", "recognised", "correct"),
    [
        ("a b c d", "", 0),
        ("a b c d", "d c b a", 1),
        ("a b c d", "x a b c d y", 4),
        ("a b c d", "a x c", 2),
        ("a b a", "b a", 2),
    ],
)
def test_words_are_aligned(example: ModuleType, spoken: str, recognised: str, correct: int) -> None:
    assert example.count_correct(spoken.split(), recognised.split()) == correct


def test_internal_noise_has_the_levels_of_the_standard(example: ModuleType) -> None:
    noise = example.internal_noise(60 * 16000, seed=1)
    frequencies, density = welch(noise, fs=16000, nperseg=4096)
    for frequency, level in zip(example.INTERNAL_NOISE_HZ, example.INTERNAL_NOISE_DB, strict=True):
        if 100 <= frequency < 8000:
            near = np.abs(frequencies / frequency - 1.0) < 0.06
            measured = 94.0 + 10.0 * np.log10(density[near].mean())
            assert measured == pytest.approx(level, abs=1.2), frequency


def test_threshold_is_interpolated(example: ModuleType) -> None:
    assert example.reception_threshold([10, 0, 5], [0.9, 0.1, 0.5], 0.4) == pytest.approx(3.75)
    above = example.reception_threshold([0, 5], [0.5, 0.9], 0.4)
    below = example.reception_threshold([0, 5], [0.1, 0.3], 0.4)
    assert (above, below) == (-np.inf, np.inf)
    assert example.describe(np.array([above, 1.0])) == "below all SNRs"
    assert example.describe(np.array([below, 1.0])) == "not reached"
    assert example.describe(np.array([2.0, 1.0, below]), ".1f") == "2.0 [1.0, inf]"


def test_more_loss_costs_words_and_an_aid_returns_them(example: ModuleType) -> None:
    noise = torch.randn(32000, generator=torch.Generator().manual_seed(0))
    # Each eighth is 6 dB softer than the one before.
    steps = 10.0 ** (-0.3 * torch.arange(8.0)).repeat_interleave(4000)
    signal = set_level(noise * steps, 65.0)
    measure = example.WordsCorrect(recognise_loud_eighths)
    shares = {}
    for ear in ("NH", "N2", "N4"):
        item = Item("item", signal, signal, Audiogram.standard(ear), facts={"text": TEXT})
        aided = example.load_aid("nalr")(signal, item.ear)
        outputs = {"unaided": signal, "aided": aided}
        shares[ear] = {name: measure(item, x)["words_correct"] for name, x in outputs.items()}
    unaided = [scores["unaided"] for scores in shares.values()]
    assert unaided[0] > unaided[1] > unaided[2]
    assert shares["N4"]["aided"] > shares["N4"]["unaided"]


def test_the_package_of_moonshine_is_named_where_it_is_missing(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(example, "is_installed", lambda module: False)
    with pytest.raises(ModuleNotFoundError, match="pip install moonshine_voice=="):
        example.load_recogniser("moonshine-tiny")


def test_measure_is_loaded_by_its_name_and_finds_sentences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "model.bin").write_bytes(b"weights")
    (tmp_path / "sentences.csv").write_text("item,text\ns1,one two\n")
    monkeypatch.setenv("WHISPER_MODEL", str(tmp_path))
    monkeypatch.setenv("WHISPER_SENTENCES", str(tmp_path / "sentences.csv"))
    measure = load_measure(f"{FILE}:WordsCorrect")
    assert measure.fingerprint is not None
    words: Any = measure.compute
    words.function.recognise = lambda waveform: "one three"
    signal = set_level(torch.randn(16000), 65.0)
    known = Item("a", signal, signal, Audiogram.standard("NH"), facts={"utterance": "s1"})
    assert words(known, signal) == {"words_correct": 0.5}
    unknown = Item("b", signal, signal, Audiogram.standard("NH"), facts={"utterance": "s2"})
    with pytest.raises(ValueError, match="the text of b is unknown"):
        words(unknown, signal)
    (tmp_path / "sentences.csv").write_text("item,text\ns1,one two\ns1,three\n")
    with pytest.raises(ValueError, match="line 3: the item s1 has another text"):
        load_measure(f"{FILE}:WordsCorrect")


def test_an_aid_that_changes_its_input_in_place_does_not_change_the_item(
    example: ModuleType, tmp_path: Path
) -> None:
    path = tmp_path / "aid.py"
    path.write_text("def double(signal, ear): return signal.mul_(2.0)")
    signal = set_level(torch.randn(1600), 65.0)
    item = Item("a", signal.clone(), signal.clone(), Audiogram.standard("N3"))
    for condition in example.make_conditions([f"{path}:double", "unaided"], own_levels=False):
        assert condition.output(item) == pytest.approx(2.0 * signal, rel=1e-4)
        assert torch.equal(item.signal, signal)


def test_pieces_end_in_pauses_and_are_kept_where_recognisers_agree(
    example: ModuleType, tmp_path: Path
) -> None:
    generator = torch.Generator().manual_seed(0)
    burst, pause = 0.1 * torch.randn(48000, generator=generator), torch.zeros(8000)
    write_audio(tmp_path / "a.wav", torch.cat((burst, pause, burst))[None], 16000)
    cuts = example.find_cuts(example.load_speech(tmp_path / "a.wav"))
    assert cuts == [0, pytest.approx(52000, abs=640), 104000]
    agreed = example.transcribe(tmp_path, [lambda x: TEXT.upper() + ".", lambda x: TEXT])
    assert [(s.path, s.text) for s in agreed] == [("a.wav", TEXT.upper() + ".")] * 2
    assert agreed[0].end == agreed[1].start
    assert example.transcribe(tmp_path, [lambda x: TEXT, lambda x: TEXT + " nine"]) == []
    assert example.transcribe(tmp_path, [lambda x: "a b a b"] * 2) == []


@pytest.mark.slow
def test_aids_are_compared_at_equal_level(
    example: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    generator = torch.Generator().manual_seed(0)
    for kind in ("speech", "noise/rain", "noise/wind"):
        (tmp_path / kind).mkdir(parents=True)
        noise = 0.1 * torch.randn(1, 32000, generator=generator)
        write_audio(tmp_path / kind / "x.wav", noise, 16000)
    sentences = [f"x.wav,{start},{start + 1},{TEXT}" for start in (0.0, 0.5, 1.0)]
    (tmp_path / "s.csv").write_text("\n".join(["path,start,end,text", *sentences]))
    write_ears(tmp_path / "ears.csv", "N1", "N5")
    levels = []

    class Recogniser:
        fingerprint = "fake"

        def __init__(self, folder: str) -> None:
            pass

        def __call__(self, waveform: np.ndarray) -> str:
            return recognise_loud_eighths(waveform)

    class Words(example.WordsCorrect):  # type: ignore[name-defined,misc]
        def __call__(self, item: Item, output: torch.Tensor) -> dict[str, float]:
            levels.append((item.name, item.facts["ear"], item.facts["snr"], level_spl(output)))
            return super().__call__(item, output)

    monkeypatch.setattr(example, "Whisper", Recogniser)
    monkeypatch.setattr(example, "WordsCorrect", Words)
    folders = [str(tmp_path / "speech"), str(tmp_path / "noise")]
    options = ["--model", "M", "--audiograms", str(tmp_path / "ears.csv"), "--snrs", "0", "quiet"]
    options += ["--sentences", str(tmp_path / "s.csv"), "--aids", "hearing-aid@0.5", "nalr"]
    example.main(["compare", *folders, *options, "--step", "3", "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "3 sentences, 24 words, 6 ears" in printed and "| hearing-aid@0.5 | " in printed
    out = pandas.read_csv(tmp_path / "out" / "table.csv")
    # 2 ears of 6 for each sentence, 2 SNRs, 2 aids
    assert len(out) == 3 * 2 * 2 * 2 and out["words_correct"].between(0.0, 1.0).all()
    aided = levels[6:]  # after those of the normal ear
    for (*place, first), (*same_place, second) in zip(aided[::2], aided[1::2], strict=True):
        assert place == same_place
        assert float(first) == pytest.approx(float(second), abs=0.01)


def test_measured_ears_without_names_remain_several(example: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "ears.csv").write_text("hl_500,hl_4000\n20,40\n30,50\n40,60\n50,70\n")
    assert len(example.choose_ears(tmp_path / "ears.csv")) == 8


def test_intervals_are_those_of_ears_too(example: ModuleType) -> None:
    # All sentences are understood with one ear, and none with the other.
    rows = [
        {"sentence": s, "text": TEXT, "ear": e, "snr": 0.0, "condition": "aid", "words_correct": w}
        for s in range(3)
        for e, w in (("a", 1.0), ("b", 0.0))
    ]
    comparison = example.Comparison(pandas.DataFrame(rows))
    assert example.describe(comparison.shares("aid", 0.0)) == "0.500 [0.000, 1.000]"
    assert example.describe(comparison.shares("aid", 0.0, "a")) == "1.000 [1.000, 1.000]"


def test_intervals_are_those_of_sentences(example: ModuleType) -> None:
    # In one sentence all ears find all words, in the other none: nothing else varies.
    rows = [
        {"sentence": s, "text": TEXT, "ear": e, "snr": 0.0, "condition": "aid", "words_correct": s}
        for s in (0.0, 1.0)
        for e in ("a", "b", "c")
    ]
    shares = example.Comparison(pandas.DataFrame(rows)).shares("aid", 0.0)
    assert shares[0] == 0.5
    assert set(np.round(shares[1:], 6)) == {0.0, 0.5, 1.0}
    assert example.describe(shares) == "0.500 [0.000, 1.000]"
