"""The number and the content of the instances are those of the paper."""

from pathlib import Path

import pytest
import torch

from hlsim import MSBG, Audiogram
from hlsim.audio import read_audio, write_audio
from hlsim.calibration import PASCAL_SPL
from hlsim.data.layouts import recognise
from hlsim.data.manifest import Utterance
from hlsim.dsp.active_level import active_level_db
from tests.helpers import load_example

PAPER = load_example("paper/instances.py")


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
    items = PAPER.Instances(rows, "", PAPER.draw_ears(20, split))
    assert len(items) == instances
    assert len({(row.path, ear.levels, name) for row, ear, name in items.items}) == instances


def test_an_instance_is_what_an_ear_perceives_aligned_with_its_input(
    tmp_path: Path, speech_dir: Path
) -> None:
    rows = [Utterance(f"{number}.wav", f"noisy {number}.wav") for number in range(2)]
    waveform, rate = read_audio(speech_dir / "train" / "flite-slt-01.flac")
    for number, row in enumerate(rows):
        clean = waveform[:, 4000 : 4000 + rate + 1000 * number]
        write_audio(tmp_path / row.path, clean, rate)
        write_audio(tmp_path / row.noisy, clean + 0.01 * torch.randn_like(clean), rate)
    ears = [Audiogram.standard(name) for name in ("N1", "N3", "N5")]
    instances = PAPER.Instances(rows, tmp_path, ears)
    assert [ear for _, ear, _ in instances.items] == [ears[i] for i in (0, 0, 1, 1, 2, 2, 0, 0)]
    assert [name for *_, name in instances.items] == ["clean", "noisy"] * 4
    for index, (row, ear, name) in enumerate(instances.items):
        instance = instances[index]
        assert instance["thresholds"].tolist() == list(ear.thresholds)
        clean, signal, impaired = (instance[key] for key in ("clean", "signal", "impaired"))
        original = read_audio(tmp_path / row.path)[0][0]
        assert active_level_db(clean, rate) + PASCAL_SPL == pytest.approx(65.0, abs=0.1)
        torch.testing.assert_close(clean / clean.norm(), original / original.norm())
        assert torch.equal(clean, signal) == (name == "clean")
        perceived = MSBG(sample_rate=16000)(signal, ear)
        assert impaired.shape == signal.shape == clean.shape
        assert float((impaired - perceived).norm() / perceived.norm()) < 1e-4


def test_drawn_ears_are_different_and_disjoint_between_splits() -> None:
    train, valid, test = (PAPER.draw_ears(150, split) for split in ("train", "valid", "test"))
    assert [ear.severity for ear in train[:4]] == ["mild", "moderate", "severe", "mild"]
    assert not {ear.levels for ear in train + valid} & {ear.levels for ear in test}
    assert len({ear.levels for ear in train}) > 140
    assert train == PAPER.draw_ears(150, "train")
