"""Preparing a corpus: counts, faults, the same bytes again, and what is refused."""

import csv
import json
import os
import shutil
import sys
from pathlib import Path

import pytest
import soundfile
import torch
from torch import Tensor

from hlsim.audio import write_audio
from hlsim.data.instances import Plan
from hlsim.data.plan import Prepared, prepare
from hlsim.data.plan_settings import PlanSettings

OUTPUTS = ("manifest.csv", "instances.csv", "faults.csv", "plan.json")


def rows(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def run(corpus: Path, out: Path, **options: object) -> Prepared:
    return prepare(PlanSettings(corpus, **options), out, jobs=1)  # type: ignore[arg-type]


def test_a_plan_of_voicebank_demand(voicebank: Path, tmp_path: Path) -> None:
    prepared = run(voicebank, tmp_path / "out")
    assert prepared.utterances == {"train": 4, "test": 2} and prepared.instances == {
        "train": 16,
        "test": 8,
    }
    assert prepared.faults == 0 and rows(tmp_path / "out" / "faults.csv") == []
    assert (
        prepared.to_text()
        .splitlines()[0]
        .startswith("train: 4 utterances, 0.00 h, 16 instances; ears ")
    )
    manifest, instances = (
        rows(tmp_path / "out" / "manifest.csv"),
        rows(tmp_path / "out" / "instances.csv"),
    )
    first = manifest[0]
    assert list(first) == [
        *(
            "id",
            "speaker",
            "split",
            "clean",
            "noisy",
            "noise",
            "snr",
            "noise_start",
            "rate",
            "seconds",
            "active_level",
        )
    ]
    assert (first["id"], first["noise"], first["snr"], first["rate"], first["seconds"]) == (
        *("p226_001", "cafe", "5", "16000", "0.8"),
    )
    assert [row["number"] for row in instances] == [str(i) for i in range(24)]
    for i, row in enumerate(instances):
        assert row["id"] == manifest[i // 4]["id"] and row["input"] == ("clean", "noisy")[i % 2]
    assert len({tuple(row.values())[6:] for row in instances}) == 12  # two ears an utterance
    train, test = (
        {tuple(r.values())[6:] for r in instances if r["split"] == s} for s in ("train", "test")
    )
    assert not train & test


@pytest.mark.slow
def test_voicebank_demands_names_give_the_papers_counts(tmp_path: Path) -> None:
    """11,572 and 824 utterances, each clean and noisy, two ears: 46,288 and 3,296 instances."""
    one = tmp_path / "one.wav"
    generator = torch.Generator().manual_seed(0)
    write_audio(one, 0.1 * torch.randn(1600, generator=generator), 16000)
    for part, speakers, total in (("trainset_28spk", 28, 11572), ("testset", 2, 824)):
        for kind in ("clean", "noisy"):
            folder = tmp_path / "vbd" / f"{kind}_{part}_wav"
            folder.mkdir(parents=True)
            for i in range(total):
                speaker = (226 if speakers == 28 else 500) + i % speakers
                os.link(one, folder / f"p{speaker}_{i // speakers + 1:03d}.wav")
    prepared = run(tmp_path / "vbd", tmp_path / "out", shortest=0.1)
    assert prepared.utterances == {"train": 11572, "test": 824}
    assert prepared.instances == {"train": 46288, "test": 3296}
    plan = Plan(tmp_path / "out")
    assert len(plan) == 46288 + 3296 and len(plan.indices("test")) == 3296
    shares = {
        key: count / prepared.instances[key.split()[0]]
        for key, count in prepared.severities.items()
    }
    assert shares == pytest.approx(dict.fromkeys(shares, 1 / 3), abs=2 / 3296) and len(shares) == 6


def test_noise_is_mixed_in_by_the_plan(
    tmp_path: Path, pieces: list[Tensor], noise_folder: Path
) -> None:
    for i, piece in enumerate(pieces):
        folder = tmp_path / "speech" / f"speaker{i % 5}"
        folder.mkdir(parents=True, exist_ok=True)
        write_audio(folder / f"{i}.wav", piece, 16000)
    prepared = run(
        tmp_path / "speech", tmp_path / "out", noise=noise_folder, valid_share=0.25, ears=1
    )
    assert sum(prepared.instances.values()) == 20 and set(prepared.utterances) == {
        "train",
        "valid",
        "test",
    }
    manifest = rows(tmp_path / "out" / "manifest.csv")
    kinds = {
        split: {row["noise"].split("/")[1] for row in manifest if row["split"] == split}
        for split in ("train", "valid", "test")
    }
    assert not (kinds["train"] | kinds["valid"]) & kinds["test"]
    snrs = {
        split: {float(row["snr"]) for row in manifest if row["split"] == split} for split in kinds
    }
    assert snrs["train"] | snrs["valid"] <= {0.0, 5.0, 10.0, 15.0} and snrs["test"] <= {
        2.5,
        7.5,
        12.5,
        17.5,
    }
    speakers = {
        split: {row["speaker"] for row in manifest if row["split"] == split} for split in kinds
    }
    assert sum(map(len, speakers.values())) == len(set().union(*speakers.values()))
    assert all(
        row["clean"].startswith("speech/") and row["noise"].startswith("noise/") for row in manifest
    )
    assert json.loads((tmp_path / "out" / "plan.json").read_text())["root"] == str(tmp_path)
    # the folder of noise is no speech, wherever it lies
    noise_folder.rename(tmp_path / "speech" / "noise")
    inside = run(tmp_path / "speech", tmp_path / "in", noise=tmp_path / "speech" / "noise")
    assert sum(inside.utterances.values()) == 10


def test_the_same_corpus_gives_the_same_bytes_and_is_not_read_twice(
    voicebank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = run(voicebank, tmp_path / "a")
    run(voicebank, tmp_path / "b")
    for name in OUTPUTS:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    monkeypatch.setattr("hlsim.data.checking.examine", None)
    assert run(voicebank, tmp_path / "a") == first
    monkeypatch.undo()
    assert run(voicebank, tmp_path / "a", seed=1) == first  # counts; the ears are others
    assert (tmp_path / "a" / "instances.csv").read_bytes() != (
        tmp_path / "b" / "instances.csv"
    ).read_bytes()
    (voicebank / "clean_testset_wav" / "p232_001.wav").unlink()
    assert run(voicebank, tmp_path / "a", seed=1).utterances == {"train": 4, "test": 1}


def test_another_file_in_the_root_changes_nothing(
    tmp_path: Path, pieces: list[Tensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    for i, piece in enumerate(pieces[:4]):
        folder = tmp_path / "speech" / f"speaker{i}"
        folder.mkdir(parents=True)
        write_audio(folder / f"{i}.wav", piece, 16000)
    first = run(tmp_path / "speech", tmp_path / "out", root=tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    monkeypatch.setattr("hlsim.data.checking.examine", None)
    assert run(tmp_path / "speech", tmp_path / "out", root=tmp_path) == first


def faulty(corpus: Path) -> dict[str, str]:
    """One file of each fault in an otherwise good corpus; the reasons by path."""
    clean, noisy = corpus / "clean_trainset_28spk_wav", corpus / "noisy_trainset_28spk_wav"
    tone = 0.1 * torch.sin(torch.arange(12800) / 5.0)
    for number in range(1, 10):
        for folder in (clean, noisy):
            write_audio(folder / f"p300_{number}.wav", tone, 16000)
    (clean / "p300_1.wav").write_text("no audio")
    soundfile.write(clean / "p300_2.wav", torch.zeros(0).numpy(), 16000)
    write_audio(noisy / "p300_3.wav", torch.zeros(12800), 16000)
    for folder in (clean, noisy):
        write_audio(folder / "p300_4.wav", tone[:1600], 16000)
    (noisy / "p300_5.wav").unlink()
    write_audio(noisy / "p300_6.wav", tone[:-1], 16000)
    write_audio(noisy / "p300_7.wav", tone, 22050)
    write_audio(clean / "p300_8.wav", torch.stack((torch.zeros(12800), tone)), 16000)
    (clean / "p300_9.wav").unlink()
    for name in "bc":
        for folder, peak in (
            (clean, 1e-39 if name == "b" else 0.1),
            (noisy, 1e-39 if name == "c" else 0.1),
        ):
            soundfile.write(
                folder / f"p300_{name}.wav", (peak * tone).numpy(), 16000, subtype="FLOAT"
            )
    outside = corpus.parent / "outside.wav"
    write_audio(outside, tone, 16000)
    (clean / "p300_a.wav").symlink_to(outside)
    write_audio(noisy / "p300_a.wav", tone, 16000)
    return {
        "clean_trainset_28spk_wav/p300_1.wav": "not readable as audio",
        "clean_trainset_28spk_wav/p300_2.wav": "empty",
        "noisy_trainset_28spk_wav/p300_3.wav": "silent",
        "clean_trainset_28spk_wav/p300_4.wav": "0.1 s; 0.5 s or more",
        "clean_trainset_28spk_wav/p300_5.wav": "no noisy counterpart",
        "noisy_trainset_28spk_wav/p300_6.wav": "12799 samples, its clean speech has 12800: unequal lengths",
        "noisy_trainset_28spk_wav/p300_7.wav": "22050 Hz, its clean speech has 16000 Hz",
        "clean_trainset_28spk_wav/p300_8.wav": "silent first channel",
        "noisy_trainset_28spk_wav/p300_9.wav": "no clean counterpart",
        "clean_trainset_28spk_wav/p300_a.wav": "leads out of",
        "clean_trainset_28spk_wav/p300_b.wav": "as good as silent",
        "noisy_trainset_28spk_wav/p300_c.wav": "as good as silent",
    }


def test_faults_are_listed_and_left_out(voicebank: Path, tmp_path: Path) -> None:
    expected = faulty(voicebank)
    prepared = run(voicebank, tmp_path / "out")
    assert prepared.utterances == {"train": 4, "test": 2} and prepared.faults == len(expected)
    listed = {row["path"]: row["reason"] for row in rows(tmp_path / "out" / "faults.csv")}
    assert set(listed) == set(expected)
    for path, reason in expected.items():
        assert reason in listed[path] and "\n" not in listed[path]
    assert not any("p300" in row["id"] for row in rows(tmp_path / "out" / "manifest.csv"))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_names_that_fit_no_csv_file_are_faults(
    voicebank: Path, noise_folder: Path, tmp_path: Path, pieces: list[Tensor]
) -> None:
    names = {
        os.fsdecode(b"caf\xe9.wav"): r"caf\udce9.wav",
        "a\nb.wav": r"a\nb.wav",
        "\u2028.wav": r"\u2028.wav",
    }
    (tmp_path / "speech").mkdir()
    write_audio(tmp_path / "good.wav", pieces[0], 16000)
    shutil.copy(tmp_path / "good.wav", tmp_path / "speech")
    for name in names:
        shutil.copy(tmp_path / "good.wav", tmp_path / "speech" / name)
        shutil.copy(tmp_path / "good.wav", noise_folder / "hum" / name)
        shutil.copy(tmp_path / "good.wav", voicebank / "clean_testset_wav" / name)
    assert run(tmp_path / "speech", tmp_path / "out", noise=noise_folder).utterances == {"train": 1}
    listed = {row["path"]: row["reason"] for row in rows(tmp_path / "out" / "faults.csv")}
    assert set(listed) == {
        f"{place}/{name}" for place in ("speech", "noise/hum") for name in names.values()
    }
    assert all("rename it" in reason for reason in listed.values())
    assert run(voicebank, tmp_path / "vbd-out").faults == 3  # here without a noisy counterpart


def test_paths_of_faults_are_no_formulas(tmp_path: Path, pieces: list[Tensor]) -> None:
    names = ["=1+1.wav", "+1.wav", "-1.wav", "@a.wav", "a=1.wav"]
    (tmp_path / "speech").mkdir()
    write_audio(tmp_path / "speech" / "good.wav", pieces[0], 16000)
    for name in names:
        (tmp_path / "speech" / name).touch()
    assert run(tmp_path / "speech", tmp_path / "out").faults == 5
    listed = [row["path"] for row in rows(tmp_path / "out" / "faults.csv")]
    assert sorted(listed) == sorted([*(f"./{name}" for name in names[:4]), "a=1.wav"])


def test_strict_makes_a_fault_an_error(voicebank: Path, tmp_path: Path) -> None:
    faulty(voicebank)
    for _ in range(2):
        with pytest.raises(
            ValueError,
            match=r"12 faults, the first clean_trainset_28spk_wav/p300_1.wav: not readable",
        ):
            prepare(PlanSettings(voicebank), tmp_path / "out", strict=True, jobs=1)
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["faults.csv"]
    run(voicebank, tmp_path / "out")
    with pytest.raises(ValueError, match="12 faults"):
        prepare(PlanSettings(voicebank), tmp_path / "out", strict=True, jobs=1)
    plan = (tmp_path / "out" / "plan.json").read_text()
    with pytest.raises(ValueError, match="12 faults"):
        prepare(PlanSettings(voicebank, seed=1), tmp_path / "out", strict=True, jobs=1)
    assert (tmp_path / "out" / "plan.json").read_text() == plan  # until there is another


def test_what_is_refused_before_a_file_is_read(
    voicebank: Path, tmp_path: Path, noise_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hlsim.data.checking.examine", None)
    out = tmp_path / "out"
    elsewhere = tmp_path / "empty"
    elsewhere.mkdir()
    for options, said in (
        ({"corpus": tmp_path / "none"}, "no such folder"),
        ({"corpus": elsewhere}, "no audio in it"),
        ({"noise": noise_folder}, "has noisy speech of its own"),
        ({"root": elsewhere}, "not in the root"),
        ({"audiograms": tmp_path / "none.csv"}, "cannot read audiograms"),
        ({"noise": tmp_path / "none"}, "no such folder"),
        ({"noise": voicebank}, "holds the corpus, and its speech would be noise"),
        ({"noise": tmp_path}, "holds the corpus, and its speech would be noise"),
    ):
        with pytest.raises(ValueError, match=said):
            prepare(PlanSettings(**{"corpus": voicebank} | options), out, jobs=1)
    assert not out.exists()


def test_tables_of_the_users_are_not_written_over(
    voicebank: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hlsim.data.checking.examine", None)
    out = tmp_path / "out"
    out.mkdir()
    for name in ("manifest.csv", "instances.csv", "faults.csv"):
        (out / name).write_text("file\nclean_testset_wav/p232_001.wav\n")
        with pytest.raises(
            ValueError, match=rf"{name}: not written by 'hlsim prepare'; choose another --out"
        ):
            run(voicebank, out)
        for option in ("table", "audiograms", "test_audiograms"):
            with pytest.raises(
                ValueError, match=rf"{name}: would be written over, and is read from; choose"
            ):
                run(voicebank, out, **{option: out / name})
        assert (out / name).read_text().startswith("file\n")
        (out / name).unlink()
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"layout": "timit"}, "layout 'timit'; allowed: auto, voicebank-demand"),
        ({"rate": 8000}, "8000 Hz"),
        ({"test_share": 1.0}, "test_share 1.0; allowed: 0 to less than 1"),
        ({"ears": 0}, "counts from 1 up"),
        ({"level": (70.0, 60.0)}, "ascending, 20 to 110"),
    ],
)
def test_settings_that_cannot_be(options: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        PlanSettings(Path("x"), **options)  # type: ignore[arg-type]


def test_nothing_left_to_use(tmp_path: Path) -> None:
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "a.wav").write_text("x")
    with pytest.raises(ValueError, match=r"nothing in it can be used; .*faults.csv says why"):
        run(tmp_path / "c", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["faults.csv"]
    assert len(rows(tmp_path / "out" / "faults.csv")) == 1
