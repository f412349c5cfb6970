"""Damaged files: reading gives a result or a ValueError, never another exception."""

import hashlib
import json
from contextlib import suppress
from pathlib import Path
from random import Random

import numpy as np
import pytest
import soundfile
import torch

from compensators import HearingAid, HearingAidConfig, load_compensator, save_compensator
from hlsim import NeuroMSBG, load_pretrained
from hlsim.audio import read_audio
from hlsim.audiogram.table import read_audiograms
from hlsim.checkpoint import save_checkpoint
from hlsim.neuro import NeuroConfig

TRIALS = 100
SIZES = (0, 1, 2**31 - 1, 2**31, 2**32 - 1)


def damaged(data: bytes, draw: Random) -> bytes:
    """Change, remove, repeat or truncate bytes; more often in the header than elsewhere."""
    result = bytearray(data)
    for _ in range(draw.choice((1, 1, 2, 8))):
        position = draw.randrange(max(1, min(len(result), draw.choice((64, 256, len(result))))))
        length = draw.randrange(1, 65)
        match draw.randrange(5):
            case 0:
                result[position : position + 1] = draw.randbytes(1)
            case 1:
                result[position : position + 4] = draw.choice(SIZES).to_bytes(4, "little")
            case 2:
                del result[position : position + length]
            case 3:
                result[position:position] = result[position : position + length]
            case 4:
                del result[draw.randrange(len(result) + 1) :]
    return bytes(result)


@pytest.mark.filterwarnings("ignore:.*truncated")
@pytest.mark.parametrize("ending", ["wav", "flac", "ogg", "mp3", "aiff"])
def test_audio(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a.{ending}"
    soundfile.write(path, np.random.default_rng(0).uniform(-0.1, 0.1, (8000, 2)), 16000)
    data = path.read_bytes()
    for seed in range(TRIALS):
        path.write_bytes(damaged(data, Random(seed)))
        with suppress(ValueError):
            waveform, rate = read_audio(path)
            assert rate >= 16000 and bool(torch.isfinite(waveform).all())


def test_audiograms(tmp_path: Path) -> None:
    data = (
        b"listener,hl_250,hl_500,hl_1000,hl_2000,hl_4000,hl_8000\n" + 3 * b"L1,35,35,40,50,60,65\n"
    )
    for seed in range(TRIALS):
        (tmp_path / "ears.csv").write_bytes(damaged(data, Random(seed)))
        with suppress(ValueError):
            read_audiograms(tmp_path / "ears.csv", simulated=True)


@pytest.mark.parametrize("kind", ["simulator", "compensator"])
@pytest.mark.parametrize("file", ["config.json", "model.safetensors"])
def test_checkpoints(tmp_path: Path, kind: str, file: str) -> None:
    if kind == "simulator":
        config = NeuroConfig(channels=4, blocks=1)
        save_checkpoint(tmp_path / "c", "neuro-msbg", NeuroMSBG(config), config.to_dict(), {})
    else:
        save_compensator(
            HearingAid(config=HearingAidConfig(bands=4, bins=0, width=4)), tmp_path / "c"
        )
    path, record = tmp_path / "c" / file, json.loads((tmp_path / "c" / "config.json").read_text())
    data = path.read_bytes()
    for seed in range(TRIALS):
        path.write_bytes(damaged(data, Random(seed)))
        if file == "model.safetensors":  # with the hash of the damaged weights
            record["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
            (tmp_path / "c" / "config.json").write_text(json.dumps(record))
        with suppress(ValueError):
            (load_pretrained if kind == "simulator" else load_compensator)(tmp_path / "c")


@pytest.mark.parametrize("value", [None, True, -1, 0, 10**12, 1e308, float("nan"), "many", [], {}])
def test_settings_of_a_checkpoint(tmp_path: Path, value: object) -> None:
    config = NeuroConfig(channels=4, blocks=1)
    save_checkpoint(tmp_path / "c", "neuro-msbg", NeuroMSBG(config), config.to_dict(), {})
    path = tmp_path / "c" / "config.json"
    record = json.loads(path.read_text())
    for name in record["config"]:
        settings = {**record["config"], name: value}
        digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
        path.write_text(json.dumps(record | {"config": settings, "config_sha256": digest}))
        with suppress(ValueError):
            load_pretrained(tmp_path / "c")
