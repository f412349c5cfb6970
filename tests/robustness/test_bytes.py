"""Damaged files: read, or refused in hlsim's words, in seconds and without filling the memory."""

import csv
import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import soundfile
import torch

from compensators import HearingAid, HearingAidConfig, load_compensator, save_compensator, trained_for
from hlsim import NeuroMSBG, load_pretrained
from hlsim.audio import read_audio, read_stretch
from hlsim.audiogram import read_audiograms
from hlsim.cli.inputs import read_recipe
from hlsim.data.corpora import find_utterances
from hlsim.data.instances import Instance, Plan, is_whole
from hlsim.data.plan import prepare
from hlsim.data.plan_settings import PlanSettings
from hlsim.evaluation.inputs import read_manifest
from hlsim.evaluation.store import ScoreStore
from hlsim.neuro import NeuroConfig
from hlsim.pretrained import checkpoint_about, checkpoint_digest, save_checkpoint
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

ROOT = Path(__file__).parents[2]


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def all_of(bench: Any, *readers: Callable[[], Any]) -> None:
    """Call each, also when one before refuses as it should."""
    for reader in readers:
        try:
            reader()
        except ValueError as error:
            if not bench.own_words(error):
                raise


@pytest.mark.parametrize("ending", ["wav", "flac", "ogg"])
def test_audio(bench: Any, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    samples = np.random.default_rng(0).uniform(-0.1, 0.1, (8000, 2))
    soundfile.write(path, samples, 16000, subtype={"wav": "FLOAT"}.get(ending))
    whole = path.read_bytes()

    def attempt(data: bytes) -> None:
        written(path, data)
        waveform = None

        def read() -> None:
            nonlocal waveform
            waveform, rate = read_audio(path, any_rate=True)
            assert 16000 <= rate <= 384_000 and bool(torch.isfinite(waveform).all())

        all_of(bench, read, lambda: read_stretch(path, 0.2, 0.5))

    bench.run(f"{ending} bytes", lambda draw: bench.damage(draw, whole), attempt, share=4.0)


def damaged_table(bench: Any, draw: Random, text: str) -> bytes:
    """A CSV file with bytes damaged, or with cells of another kind, rows and columns gone or twice."""
    if draw.random() < 0.4:
        return bench.damage(draw, text.encode())
    rows = [row[:] for row in csv.reader(io.StringIO(text))]
    for _ in range(draw.randrange(1, 4)):
        row = draw.randrange(len(rows))
        way = draw.randrange(5)
        if way < 3 and rows[row]:
            rows[row][draw.randrange(len(rows[row]))] = draw.choice(bench.texts)
        elif way == 3:
            rows[row] = rows[row][: draw.randrange(len(rows[row]) + 1)]
        else:
            rows.insert(row, list(draw.choice(rows)))
    table = io.StringIO()
    csv.writer(table, delimiter=draw.choice(",,,,;\t")).writerows(rows)
    return table.getvalue().encode(draw.choice(("utf-8", "utf-8", "utf-8-sig", "utf-16")), "replace")


def test_tables(bench: Any, tmp_path: Path) -> None:
    hz = (250, 500, 1000, 2000, 3000, 4000, 6000, 8000)
    head, levels = ",".join(f"hl_{f}" for f in hz), "35,35,40,50,55,60,65,65"
    ears = f"listener,ear,split,{head}\nL1,left,train,{levels}\nL1,right,test,{levels}\n"
    manifest = f"listener,ear,condition,clean,processed,snr,spl,{head}\n" + "".join(
        f"L{n},left,{condition},c/{n}.wav,{condition}/{n}.wav,5,65,{levels}\n"
        for n in (1, 2)
        for condition in "ab"
    )
    corpus = "file,id,speaker,split,noisy,noise,snr\na.wav,1,s,train,b.wav,hum,5\nc.wav,2,t,test,,,\n"
    path = tmp_path / "t.csv"
    kinds: dict[str, tuple[str, Callable[[], Any]]] = {
        "audiogram tables": (ears, lambda: read_audiograms(path, simulated=True)),
        "report manifests": (manifest, lambda: read_manifest(path)),
        "corpus tables": (corpus, lambda: list(find_utterances(tmp_path, "folder", path))),
    }
    for kind, (text, read) in kinds.items():

        def attempt(data: bytes, read: Callable[[], Any] = read) -> None:
            written(path, data)
            read()

        bench.run(kind, lambda draw, text=text: damaged_table(bench, draw, text), attempt, share=4.0)


def damaged_values(bench: Any, draw: Random, value: Any) -> Any:
    """A tree of settings with one leaf, or more, of another kind, or gone."""
    if isinstance(value, dict) and value and draw.random() < 0.9:
        key = draw.choice(sorted(value))
        way = draw.random()
        rest = {name: one for name, one in value.items() if way < 0.9 or name != key}
        return rest | ({key: damaged_values(bench, draw, value[key])} if way < 0.9 else {})
    return draw.choice(bench.values)


def test_recipes(bench: Any, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    texts = [path.read_text() for path in sorted((ROOT / "examples").glob("*.yaml"))]
    path = tmp_path / "r.yaml"

    def make(draw: Random) -> bytes:
        text = draw.choice(texts)
        if draw.random() < 0.4:
            return bench.damage(draw, text.encode())
        return str(
            yaml.safe_dump(damaged_values(bench, draw, yaml.safe_load(text)), allow_unicode=True)
        ).encode()

    def attempt(data: bytes) -> None:
        settings = read_recipe(written(path, data))
        all_of(
            bench, lambda: SimulatorRecipe.from_dict(settings), lambda: CompensatorRecipe.from_dict(settings)
        )

    bench.run("YAML recipes", make, attempt, share=4.0)


@pytest.fixture
def simulator(tmp_path: Path) -> Path:
    config = NeuroConfig(channels=4, blocks=1)
    save_checkpoint(
        tmp_path / "s", "neuro-msbg", NeuroMSBG(config), config.to_dict(), {"audiogram": {"levels": [0] * 8}}
    )
    return tmp_path / "s"


def test_checkpoints(bench: Any, tmp_path: Path, simulator: Path) -> None:
    save_compensator(HearingAid(HearingAidConfig(bands=4, bins=0, width=4, hidden=4)), tmp_path / "a")
    folders = {"s": simulator, "a": tmp_path / "a"}
    records = {name: (folder / "config.json").read_text() for name, folder in folders.items()}
    weights = {name: (folder / "model.safetensors").read_bytes() for name, folder in folders.items()}

    def load(name: str, record: bytes, data: bytes) -> None:
        written(folders[name] / "config.json", record)
        written(folders[name] / "model.safetensors", data)
        loader = load_pretrained if name == "s" else load_compensator
        about = (checkpoint_about, checkpoint_digest, trained_for)
        all_of(
            bench, *(lambda read=read: read(folders[name]) for read in about), lambda: loader(folders[name])
        )

    def make_record(draw: Random) -> tuple[str, bytes]:
        name = draw.choice("sa")
        if draw.random() < 0.4:
            return name, bench.damage(draw, records[name].encode())
        record = json.loads(records[name])
        changed = damaged_values(bench, draw, record)
        if isinstance(changed, dict) and draw.random() < 0.8:
            changed.pop("config_sha256", None)  # as of a person who knows how to
        return name, json.dumps(changed).encode()

    bench.run("JSON configurations", make_record, lambda x: load(*x, weights[x[0]]), share=4.0)

    def make_weights(draw: Random) -> tuple[str, bytes]:
        name = draw.choice("sa")
        return name, bench.damage(draw, weights[name])

    def load_weights(given: tuple[str, bytes]) -> None:
        name, data = given
        record = json.loads(records[name]) | {"sha256": hashlib.sha256(data).hexdigest()}
        load(name, json.dumps(record).encode(), data)

    bench.run("safetensors of checkpoints", make_weights, load_weights, share=4.0)


def test_instances_plans_and_scores(bench: Any, corpus: Path, tmp_path: Path) -> None:
    tensors = {name: torch.randn(800) for name in ("clean", "signal", "impaired")}
    instance = Instance(**tensors, thresholds=torch.zeros(8)).to_bytes()
    path = tmp_path / "x"

    def read_instance(data: bytes) -> None:
        written(path, data)
        if is_whole(path):
            found = Instance.read(path)
            assert {len(found.clean), len(found.signal)} <= {800} or found.clean.ndim > 0

    bench.run("safetensors of instances", lambda draw: bench.damage(draw, instance), read_instance, share=4.0)
    folder = tmp_path / "plan"
    prepare(PlanSettings(corpus / "speech"), folder, jobs=1)
    names = ("plan.json", "manifest.csv", "instances.csv")
    whole = {name: (folder / name).read_bytes() for name in names}

    def make_plan(draw: Random) -> tuple[str, bytes]:
        name = draw.choice(names)
        if name == "plan.json" and draw.random() < 0.7:
            return name, json.dumps(damaged_values(bench, draw, json.loads(whole[name]))).encode()
        return name, bench.damage(draw, whole[name])

    def open_plan(given: tuple[str, bytes]) -> None:
        for name in names:
            written(folder / name, whole[name])
        written(folder / given[0], given[1])
        Plan(folder).instance(0)

    bench.run("prepared plans", make_plan, open_plan, share=2.0)
    line = json.dumps({"key": "k", "score": 0.5, "seed": 1, "seconds": 2.0, "clean_dbfs": -20.0}) + "\n"

    def read_scores(data: bytes) -> None:
        store = ScoreStore(written(path, data))
        store.append("new", {"score": 1.0})
        assert ScoreStore(path).get("new") == {"score": 1.0}

    bench.run("stored scores", lambda draw: bench.damage(draw, 5 * line.encode()), read_scores, share=2.0)
