"""The number and the content of the instances are those of the paper."""

from pathlib import Path

import pytest
import torch
from torch.nn import functional

from hlsim import MSBG, Audiogram
from hlsim.audio import read_audio, write_audio
from hlsim.calibration import PASCAL_SPL
from hlsim.dsp.active_level import active_level_db
from hlsim.dsp.resample import resample
from hlsim.msbg.ear import MSBG_RATE
from hlsim.training.corpora.instances import Instances, draw_ears
from hlsim.training.corpora.layouts import find_corpus, recognise

SPEECH = (
    ("trainset_28spk", "p226_001", "train/flite-slt-01.flac"),
    ("trainset_28spk", "p227_001", "train/espeak-nyc-m4-01.flac"),
    ("testset", "p232_001", "valid/flite-rms-01.flac"),
)


@pytest.fixture
def voicebank(tmp_path: Path, speech_dir: Path) -> Path:
    """VoiceBank-DEMAND in small: three utterances of 1 s and different lengths, in noise."""
    for number, (part, name, file) in enumerate(SPEECH):
        waveform, rate = read_audio(speech_dir / file)
        clean = waveform[:, 4000 : 4000 + rate + 1000 * number]
        noisy = clean + 0.01 * torch.randn_like(clean)
        for kind, signal in (("clean", clean), ("noisy", noisy)):
            folder = tmp_path / f"{kind}_{part}_wav_16k"
            folder.mkdir(exist_ok=True)
            write_audio(folder / f"{name}.wav", signal, rate)
    return tmp_path


@pytest.mark.parametrize(
    ("part", "split", "utterances", "instances"),
    [("trainset_28spk", "train", 11_572, 46_288), ("testset", "test", 824, 3_296)],
)
def test_voicebank_demand_gives_the_papers_number_of_instances(
    part: str, split: str, utterances: int, instances: int
) -> None:
    files = [
        f"{kind}_{part}_wav/p226_{number:05d}.wav"
        for kind in ("clean", "noisy")
        for number in range(utterances)
    ]
    _, rows = recognise(files)
    items = Instances(rows, "", draw_ears(20, split))
    assert len(items) == instances
    assert len({(row.path, ear.levels, name) for row, ear, name in items.items}) == instances


def test_an_instance_is_what_an_ear_perceives_aligned_with_its_input(voicebank: Path) -> None:
    _, utterances = find_corpus(voicebank)
    rows = [row for row in utterances if row.split == "train"]
    ears = [Audiogram.standard(name) for name in ("N1", "N3", "N5")]
    instances = Instances(rows, voicebank, ears)
    assert len(instances) == 8
    for index, (row, ear, name) in enumerate(instances.items):
        instance = instances[index]
        assert instance["thresholds"].tolist() == list(ear.thresholds)
        assert ear == ears[index // 2 % 3] and name == ("clean", "noisy")[index % 2]
        clean, signal, impaired = (instance[key] for key in ("clean", "signal", "impaired"))
        waveform, rate = read_audio(voicebank / row.path)
        level = active_level_db(waveform[0], rate)
        scaled = waveform * 10.0 ** ((65.0 - PASCAL_SPL - level) / 20.0)
        torch.testing.assert_close(clean, resample(scaled, rate, 16000)[0])
        assert active_level_db(clean, 16000) + PASCAL_SPL == pytest.approx(65.0, abs=0.3)
        assert torch.equal(clean, signal) == (name == "clean")
        perceived = MSBG(sample_rate=16000)(signal, ear)
        assert impaired.shape == signal.shape == clean.shape
        assert float((impaired - perceived).norm() / perceived.norm()) < 1e-4
    # The structural delay of MSBG is removed to a fraction of a sample.
    unaligned = MSBG(sample_rate=16000, aligned=False)
    delay = round(unaligned.delay(ear.severity) * 16000 / MSBG_RATE)
    late = unaligned(functional.pad(signal, (0, 2000)), ear)
    shifts = range(delay - 3, delay + 4)
    errors = [float((late[shift:][: len(signal)] - impaired).norm()) for shift in shifts]
    assert abs(shifts[errors.index(min(errors))] - delay) <= 1


def test_instances_that_cannot_be_read_name_the_file(voicebank: Path) -> None:
    _, utterances = find_corpus(voicebank)
    instances = Instances(utterances, voicebank, draw_ears(4, "train"))
    noisy = voicebank / "noisy_testset_wav_16k" / "p232_001.wav"
    write_audio(noisy, torch.randn(9000), 16000)
    with pytest.raises(ValueError, match=r"p232_001\.wav"):
        instances[0]
    with pytest.raises(IndexError):
        instances[len(instances)]


def test_drawn_ears_are_different_and_disjoint_between_splits() -> None:
    train, valid, test = (draw_ears(600, split) for split in ("train", "valid", "test"))
    assert [ear.severity for ear in train[:4]] == ["mild", "moderate", "severe", "mild"]
    assert not {ear.levels for ear in train + valid} & {ear.levels for ear in test}
    assert len({ear.levels for ear in train}) > 500
    assert train == draw_ears(600, "train") and train != draw_ears(600, "train", seed=1)
