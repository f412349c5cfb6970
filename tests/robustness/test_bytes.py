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

from compensators import (
    HearingAid,
    HearingAidConfig,
    load_compensator,
    save_compensator,
    trained_for,
)
from hlsim import NeuroMSBG, load_pretrained
from hlsim.audio import read_audio, read_stretch
from hlsim.audiogram.table import read_audiograms
from hlsim.cli.inputs import read_recipe
from hlsim.evaluation.recordings import read_manifest
from hlsim.evaluation.store import ScoreStore
from hlsim.neuro import NeuroConfig
from hlsim.pretrained import checkpoint_about, checkpoint_digest, save_checkpoint
from hlsim.training.corpora.manifest import read_manifest as read_training_manifest
from hlsim.training.recipes import CompensatorRecipe, SimulatorRecipe

EXAMPLES = Path(__file__).parents[2] / "examples"
CORPUS = "path,noisy,speaker,split\na.wav,b.wav,s,train\nc.wav,,t,test\n"
LEVELS = (
    "hl_250,hl_500,hl_1000,hl_2000,hl_3000,hl_4000,hl_6000,hl_8000\n",
    "35,35,40,50,55,60,65,65\n",
)
EARS = f"listener,ear,split,{LEVELS[0]}L1,left,train,{LEVELS[1]}L1,right,test,{LEVELS[1]}"
MANIFEST = f"listener,ear,condition,clean,processed,snr,spl,{LEVELS[0]}" + "".join(
    f"L{n},left,{name},c/{n}.wav,{name}/{n}.wav,5,65,{LEVELS[1]}" for n in (1, 2) for name in "ab"
)


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
    soundfile.write(
        path,
        np.random.default_rng(0).uniform(-0.1, 0.1, (8000, 2)),
        16000,
        "FLOAT" if ending == "wav" else None,
    )
    whole = path.read_bytes()

    def read() -> None:
        waveform, rate = read_audio(path, any_rate=True)
        assert 16000 <= rate <= 384_000 and bool(torch.isfinite(waveform).all())

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        all_of(bench, read, lambda: read_stretch(path, 0.2, 0.5))

    bench.run(f"{ending} bytes", lambda draw: bench.damage(draw, whole), attempt, share=4.0)


def damaged_table(bench: Any, draw: Random, text: str) -> bytes:
    """Bytes damaged, or cells of another kind, rows and columns gone or twice."""
    if draw.random() < 0.4:
        return bench.damage(draw, text.encode())
    rows = list(csv.reader(io.StringIO(text)))
    for _ in range(draw.randrange(1, 4)):
        row, way = draw.randrange(len(rows)), draw.randrange(5)
        if way < 3 and rows[row]:
            rows[row][draw.randrange(len(rows[row]))] = draw.choice(bench.texts)
        elif way == 3:
            rows[row] = rows[row][: draw.randrange(len(rows[row]) + 1)]
        else:
            rows.insert(row, list(draw.choice(rows)))
    table = io.StringIO()
    csv.writer(table, delimiter=draw.choice(",,,,;\t")).writerows(rows)
    return table.getvalue().encode(
        draw.choice(("utf-8", "utf-8", "utf-8-sig", "utf-16")), "replace"
    )


@pytest.mark.parametrize("kind", ["audiogram tables", "report manifests", "corpus tables"])
def test_tables(bench: Any, tmp_path: Path, kind: str) -> None:
    path = tmp_path / "t.csv"
    (tmp_path / "a.wav").touch()
    text, read = {
        "audiogram tables": (EARS, lambda: read_audiograms(path, simulated=True)),
        "report manifests": (MANIFEST, lambda: read_manifest(path)),
        "corpus tables": (CORPUS, lambda: read_training_manifest(path)),
    }[kind]

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        read()

    bench.run(kind, lambda draw: damaged_table(bench, draw, text), attempt, share=4.0)


def damaged_values(bench: Any, draw: Random, value: Any) -> Any:
    """A tree of settings with a leaf or a branch of another kind, or gone."""
    if not (isinstance(value, dict) and value) or draw.random() < 0.1:
        return draw.choice(bench.values)
    key = draw.choice(sorted(value))
    changed = {} if draw.random() < 0.1 else {key: damaged_values(bench, draw, value[key])}
    return {name: one for name, one in value.items() if name != key} | changed


def test_recipes(bench: Any, tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    texts = [path.read_text() for path in sorted(EXAMPLES.glob("*.yaml"))]
    path = tmp_path / "r.yaml"

    def make(draw: Random) -> bytes:
        text = draw.choice(texts)
        if draw.random() < 0.4:
            return bench.damage(draw, text.encode())
        return yaml.safe_dump(
            damaged_values(bench, draw, yaml.safe_load(text)), allow_unicode=True
        ).encode()

    def attempt(data: bytes) -> None:
        path.write_bytes(data)
        settings = read_recipe(path)
        all_of(
            bench,
            *(
                lambda kind=kind: kind.from_dict(settings)
                for kind in (SimulatorRecipe, CompensatorRecipe)
            ),
        )

    bench.run("YAML recipes", make, attempt, share=4.0)


def test_checkpoints(bench: Any, tmp_path: Path) -> None:
    config, about = NeuroConfig(channels=4, blocks=1), {"audiogram": {"levels": [0] * 8}}
    save_checkpoint(tmp_path / "s", "neuro-msbg", NeuroMSBG(config), config.to_dict(), about)
    save_compensator(
        HearingAid(HearingAidConfig(bands=4, bins=0, width=4, hidden=4)), tmp_path / "a"
    )
    loaders = {tmp_path / "s": load_pretrained, tmp_path / "a": load_compensator}
    whole = {
        folder: [(folder / name).read_bytes() for name in ("config.json", "model.safetensors")]
        for folder in loaders
    }

    def make_record(draw: Random) -> tuple[Path, bytes, bytes]:
        folder = draw.choice(sorted(whole))
        record, weights = whole[folder]
        if draw.random() < 0.4:
            return folder, bench.damage(draw, record), weights
        changed = damaged_values(bench, draw, json.loads(record))
        if isinstance(changed, dict) and draw.random() < 0.8:
            config = json.dumps(
                changed.get("config"), sort_keys=True
            )  # as of a person who knows how to
            changed["config_sha256"] = hashlib.sha256(config.encode()).hexdigest()
        return folder, json.dumps(changed).encode(), weights

    def make_weights(draw: Random) -> tuple[Path, bytes, bytes]:
        folder = draw.choice(sorted(whole))
        weights = bench.damage(draw, whole[folder][1])
        record = json.loads(whole[folder][0]) | {"sha256": hashlib.sha256(weights).hexdigest()}
        return folder, json.dumps(record).encode(), weights

    def load(given: tuple[Path, bytes, bytes]) -> None:
        folder, record, weights = given
        (folder / "config.json").write_bytes(record)
        (folder / "model.safetensors").write_bytes(weights)
        readers = (checkpoint_about, checkpoint_digest, trained_for, loaders[folder])
        all_of(bench, *(lambda read=read: read(folder) for read in readers))

    bench.run("JSON configurations", make_record, load, share=4.0)
    bench.run("safetensors of checkpoints", make_weights, load, share=4.0)


def test_scores(bench: Any, tmp_path: Path) -> None:
    scores = 5 * (json.dumps({"key": "k", "score": 0.5, "seed": 1, "seconds": 2.0}) + "\n").encode()
    path = tmp_path / "x"

    def read_scores(data: bytes) -> None:
        path.write_bytes(data)
        ScoreStore(path).append("new", {"score": 1.0})
        assert ScoreStore(path).get("new") == {"score": 1.0}

    bench.run("stored scores", lambda draw: bench.damage(draw, scores), read_scores, share=2.0)
