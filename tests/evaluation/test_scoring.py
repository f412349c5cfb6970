"""Scores of many files against the libraries called one by one; what is kept, what fails, and what a kill costs."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from hlsim.audio import read_audio, write_audio
from hlsim.audiogram import FREQUENCIES, Audiogram
from hlsim.evaluation.previous.scoring import FileItem, Results, score_items
from hlsim.evaluation.store import ScoreStore, content_hash
from hlsim.metrics import registry as measures_module
from hlsim.metrics.pyclarity import pyclarity_score

for module in ("clarity", "joblib", "pystoi", "pesq"):
    pytest.importorskip(module)

N3 = Audiogram.standard("N3")
ALL = ("haspi", "hasqi", "stoi", "pesq")
haspi = partial(pyclarity_score, "haspi")


@pytest.fixture
def items(tmp_path: Path, speech_dir: Path) -> list[FileItem]:
    """Two utterances of 0.8 s at 16 kHz in two ears, noisy and the same 12 dB louder."""
    out = []
    for name, ear in (("flite-slt-01", "N3"), ("flite-slt-02", "S2")):
        waveform, rate = read_audio(speech_dir / "train" / f"{name}.flac")
        clean = waveform[:, rate : rate + 8 * rate // 10]
        noise = 0.003 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(3))
        paths = {}
        for folder, signal_ in (
            ("clean", clean),
            ("noisy", clean + noise),
            ("louder", 4.0 * (clean + noise)),
        ):
            (tmp_path / folder).mkdir(exist_ok=True)
            paths[folder] = tmp_path / folder / f"{name}.wav"
            write_audio(paths[folder], signal_, rate)
        clean_path = paths.pop("clean")
        out.append(FileItem(name, clean_path, paths, Audiogram.standard(ear)))
    return out


def samples(path: Path) -> np.ndarray:
    return read_audio(path)[0][0].double().numpy()


def scores(results: Results) -> list[dict[tuple[str, str], float | None]]:
    return [{key: result.score for key, result in own.items()} for own in results]


def test_equal_the_libraries_called_one_by_one(items: list[FileItem]) -> None:
    import pesq
    import pystoi
    from clarity.evaluator.haspi import haspi_v2
    from clarity.evaluator.hasqi import hasqi_v2
    from clarity.utils.audiogram import Audiogram as ClarityAudiogram

    item = replace(items[0], full_scale_spl=91.0, processed={"noisy": items[0].processed["noisy"]})
    store = ScoreStore()
    results, pyclaritys = (
        score_items([item], ALL, seed=11, jobs=1, engine=engine, store=store)[0]
        for engine in ("hlsim", "pyclarity")
    )
    assert set(results) == {(measure, condition) for measure in ALL for condition in ("noisy",)}
    ear = ClarityAudiogram(levels=np.array(N3.levels), frequencies=np.array(FREQUENCIES))
    clean = samples(item.clean)
    for condition, path in item.processed.items():
        heard = samples(path)
        seed = results["haspi", condition].seed
        assert seed == (11 + int(content_hash(item.clean)[:8], 16)) % 2**32
        np.random.seed(seed)
        expected = {"haspi": haspi_v2(clean, 16000, heard, 16000, ear, level1=91.0)[0]}
        np.random.seed(seed)
        expected["hasqi"] = hasqi_v2(clean, 16000, heard, 16000, ear, level1=91.0)[0]
        expected["stoi"] = pystoi.stoi(clean, heard, 16000)
        expected["pesq"] = pesq.pesq(16000, clean, heard, "wb")
        for measure, value in expected.items():
            assert pyclaritys[measure, condition].score == pytest.approx(float(value), abs=1e-12)
            assert results[measure, condition].score == pytest.approx(float(value), abs=1e-6)
        level = 10 * np.log10(np.mean(heard**2))
        assert results["stoi", condition].dbfs == pytest.approx(level, abs=1e-9)
        assert results["stoi", condition].seconds == 0.8
    # HASPI and HASQI are kept by engine, for STOI and PESQ there is but one
    kept = sorted(
        (record["measure"], record.get("engine", "")) for record in store.records.values()
    )
    of_ear = [
        (measure, engine) for measure in ("haspi", "hasqi") for engine in ("hlsim", "pyclarity")
    ]
    assert kept == [*of_ear, ("pesq", ""), ("stoi", "")]


def test_a_stored_score_has_the_seed_of_this_run(items: list[FileItem], tmp_path: Path) -> None:
    """STOI knows no seed, so that a score of another run serves."""
    store = tmp_path / "scores.jsonl"
    first, second = (
        score_items(items[:1], ("stoi",), store=ScoreStore(store), seed=seed, jobs=1)[0][
            "stoi", "noisy"
        ]
        for seed in (0, 7)
    )
    assert second == first._replace(seed=first.seed + 7)


@pytest.mark.slow
def test_two_processes_give_the_same(items: list[FileItem]) -> None:
    given = [replace(item, processed={"noisy": item.processed["noisy"]}) for item in items]
    assert scores(score_items(given, ALL[::2], jobs=2)) == scores(
        score_items(given, ALL[::2], jobs=1)
    )


def test_two_threads_do_not_share_numpys_generator(items: list[FileItem]) -> None:
    """As on a cluster's worker with several threads."""
    clean, heard = samples(items[0].clean), samples(items[0].processed["noisy"])
    alone = [haspi(clean, heard, N3, 16000, seed=seed) for seed in (1, 2)]
    together = [0.0, 0.0]

    def score(place: int) -> None:
        together[place] = haspi(clean, heard, N3, 16000, seed=place + 1)

    threads = [threading.Thread(target=score, args=(place,)) for place in (0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert together == alone and alone[0] != alone[1]


def test_level_in_db_spl_is_the_full_scale_that_gives_it(items: list[FileItem]) -> None:
    item = items[1]
    level = 10 * np.log10(np.mean(samples(item.clean) ** 2))
    by_level = score_items([replace(item, spl=60.0)], jobs=1)[0]
    by_scale = score_items([replace(item, full_scale_spl=60.0 - level)], jobs=1)[0]
    other = score_items([item], jobs=1)[0]
    for key, result in by_level.items():
        assert result.score == pytest.approx(by_scale[key].score, abs=1e-9)
        assert result.score != other[key].score


def test_two_channels_are_the_two_ears(items: list[FileItem], tmp_path: Path) -> None:
    waves = [torch.from_numpy(samples(path)) for path in items[0].processed.values()]
    write_audio(tmp_path / "both.wav", torch.stack(waves), 16000)
    conditions = {"noisy": tmp_path / "both.wav", "louder": tmp_path / "both.wav"}
    both = [replace(items[0], ear=ear, processed=conditions) for ear in ("left", "right", "")]
    left, right, neither = score_items(both, jobs=1)
    mono = score_items(items[:1], jobs=1)[0]
    assert left["haspi", "noisy"].score == mono["haspi", "noisy"].score
    assert right["haspi", "noisy"].score == mono["haspi", "louder"].score
    assert "2 channels; allowed: 1," in str(neither["haspi", "noisy"].reason)


def test_known_scores_are_not_made_again(
    items: list[FileItem], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = count_scores(monkeypatch)
    path = tmp_path / "scores.jsonl"
    seen: list[tuple[int, int]] = []

    def run(given: list[FileItem], **options: object) -> Results:
        seen.clear()
        progress = lambda done, total: seen.append((done, total))  # noqa: E731
        return score_items(given, ALL, store=ScoreStore(path), jobs=1, progress=progress, **options)

    first = run(items)
    assert len(made) == 16 and seen == [(done, 16) for done in range(1, 17)]
    made.clear()
    assert run(items) == first and made == [] and seen == []
    # a new audiogram, level or seed costs what depends on it; STOI and PESQ do not
    for changed in (replace(items[0], audiogram=N3.standard("N1")), replace(items[0], spl=70.0)):
        again = run([changed, items[1]])
        assert sorted(made) == ["haspi", "haspi", "hasqi", "hasqi"] and again[1] == first[1]
        made.clear()
        assert seen[0] == (12, 16)
    run(items[:1], seed=1)
    assert sorted(made) == ["haspi", "haspi", "hasqi", "hasqi"]
    made.clear()
    # an item before the others changes none of them; new contents do, an old name does not help
    moved = items[1].clean.rename(items[1].clean.with_name("moved.wav"))
    assert run([replace(items[1], clean=moved), items[0]]) == [first[1], first[0]] and made == []
    write_audio(items[0].processed["noisy"], torch.from_numpy(samples(items[0].clean)), 16000)
    run(items[:1])
    assert sorted(made) == sorted(ALL)
    made.clear()
    monkeypatch.setattr("hlsim.evaluation.previous.scoring.versions_of", lambda *_: {"pesq": "another"})
    run(items[:1])
    assert len(made) == 8


def count_scores(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Replace each measure by one that is quick and says that it was called."""
    made: list[str] = []
    for name, measure in measures_module.MEASURES.items():

        def score(*given: object, name: str = name) -> float:
            made.append(name)
            return 0.5

        monkeypatch.setitem(measures_module.MEASURES, name, measure._replace(score=score))
    return made


def test_the_same_pair_twice_is_scored_once(
    items: list[FileItem], monkeypatch: pytest.MonkeyPatch
) -> None:
    made = count_scores(monkeypatch)
    twins = [items[0], replace(items[0], name="twin", audiogram=Audiogram.standard("N1"))]
    results = score_items(twins, ("haspi", "stoi"), jobs=1)
    assert sorted(made) == ["haspi"] * 4 + ["stoi"] * 2
    assert results[0]["stoi", "noisy"] == results[1]["stoi", "noisy"]


def test_failures_have_a_reason_and_the_rest_go_on(items: list[FileItem], tmp_path: Path) -> None:
    bad = {}
    for name, waveform, rate in (
        ("silent", torch.zeros(12800), 16000),
        ("short", torch.from_numpy(samples(items[0].clean))[:-1], 16000),
        ("fast", torch.from_numpy(samples(items[0].clean)), 24000),
    ):
        bad[name] = tmp_path / f"{name}.wav"
        write_audio(bad[name], waveform, rate)
    bad["broken"] = tmp_path / "broken.wav"
    bad["broken"].write_bytes(b"RIFF and nothing more")
    bad["missing"] = tmp_path / "missing.wav"
    store = ScoreStore(tmp_path / "scores.jsonl")
    given = [replace(items[0], processed={**bad, "noisy": items[0].processed["noisy"]})]
    results = score_items(given, ("stoi",), store=store, jobs=1)[0]
    for name, reason in (
        ("silent", "silent"),
        ("short", "12800 samples and .*12799; allowed: equal lengths"),
        ("fast", "24000 Hz and .* 16000 Hz; allowed: equal rates"),
        ("broken", "not readable as audio"),
        ("missing", "no such file"),
    ):
        result = results["stoi", name]
        assert result.score is None
        with pytest.raises(ValueError, match=reason):
            raise ValueError(result.reason)
        assert "\n" not in str(result.reason)
    assert results["stoi", "noisy"].score is not None
    # what failed is not kept: it is tried again
    assert len(store) == 1


def test_whatever_a_measure_raises_is_the_items_reason(
    items: list[FileItem], monkeypatch: pytest.MonkeyPatch
) -> None:
    def score(*_: object) -> float:
        raise ZeroDivisionError("by zero")

    monkeypatch.setitem(
        measures_module.MEASURES, "stoi", measures_module.MEASURES["stoi"]._replace(score=score)
    )
    results = score_items(items[:1], ("stoi",), jobs=1)[0]
    assert results["stoi", "noisy"].reason == "ZeroDivisionError: by zero"


SCRIPT = """
import sys, time
from pathlib import Path
from hlsim import Audiogram
from hlsim.evaluation import FileItem, ScoreStore, score_items
from hlsim.metrics.registry import MEASURES
score = MEASURES["stoi"].score
MEASURES["stoi"] = MEASURES["stoi"]._replace(score=lambda *a: (time.sleep(0.2), score(*a))[1])
root = Path(sys.argv[1])
ear = Audiogram.standard("N3")
items = [FileItem(p.stem, p, {"a": p, "b": p}, ear) for p in sorted((root / "many").iterdir())]
score_items(items, ["stoi"], store=ScoreStore(root / "scores.jsonl"), jobs=1)
"""


@pytest.mark.slow
def test_a_killed_run_goes_on_where_it_was(items: list[FileItem], tmp_path: Path) -> None:
    (tmp_path / "many").mkdir()
    clean = torch.from_numpy(samples(items[0].clean))
    for i in range(12):
        write_audio(tmp_path / "many" / f"{i:02}.wav", clean * (0.5 + i / 24), 16000)
    path = tmp_path / "scores.jsonl"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    with subprocess.Popen(command, env=environment) as process:
        end = time.monotonic() + 60
        while (not path.exists() or path.read_bytes().count(b"\n") < 3) and time.monotonic() < end:
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    before = path.read_bytes()
    assert 3 <= before.count(b"\n") < 12
    # each file is its own reference, so that its two conditions are one score
    many = [
        FileItem(p.stem, p, {"a": p, "b": p}, N3) for p in sorted((tmp_path / "many").iterdir())
    ]
    seen: list[int] = []
    store = ScoreStore(path)
    resumed = score_items(
        many, ("stoi",), store=store, jobs=1, progress=lambda done, _: seen.append(done)
    )
    assert seen[0] == 2 * before.count(b"\n")
    assert path.read_bytes().startswith(before) and path.read_bytes().count(b"\n") == 12
    assert len({json.loads(line)["key"] for line in path.read_text().splitlines()}) == 12
    assert scores(resumed) == scores(score_items(many, ("stoi",), jobs=1))


def test_bad_settings(items: list[FileItem]) -> None:
    with pytest.raises(
        ValueError, match="unknown measures loudness; allowed: haspi, hasqi, stoi, pesq"
    ):
        score_items(items, ("loudness",))
    with pytest.raises(ValueError, match="engine 'matlab'; allowed: hlsim, pyclarity"):
        score_items(items, engine="matlab")
    with pytest.raises(ValueError, match="no measure; allowed: haspi"):
        score_items(items, ())
    with pytest.raises(ValueError, match="seed is -1"):
        score_items(items, seed=-1)
    with pytest.raises(ValueError, match="jobs is 0"):
        score_items(items, jobs=0)
