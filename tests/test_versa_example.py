"""The metric for VERSA scores utterances by VERSA's interface, which is copied as a fact.

The copies follow versa/definition.py of VERSA's commit b7b9dd4. Where VERSA is installed, its own
scorer scores a list of files.
"""

import json
import sys
from collections.abc import Iterator
from enum import Enum
from importlib import util
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import hlsim
from hlsim.audio import write_audio
from hlsim.calibration import level_spl
from hlsim.metrics import haspi, mbstoi

FOLDER = Path(__file__).parents[1] / "examples" / "integrations" / "versa"


class BaseMetric:
    """Base class that stores the settings, as versa.definition.BaseMetric does."""

    def __init__(self, config: dict[str, Any] | None = None) -> None:
        self.config = config or {}
        self._setup()  # type: ignore[attr-defined]


class Registry:
    """The method of versa.definition.MetricRegistry that metrics call."""

    def __init__(self) -> None:
        self.metrics: dict[str, type] = {}

    def register(self, metric_class: type, metadata: Any, aliases: list[str]) -> None:
        self.metrics |= dict.fromkeys([metadata.name, *aliases], metric_class)


FIELDS = (
    "name category metric_type requires_reference requires_text gpu_compatible auto_install "
    "dependencies description paper_reference implementation_source"
)


def make_metadata(**fields: Any) -> SimpleNamespace:
    """Make metadata of the fields that versa.definition.MetricMetadata accepts."""
    assert {*fields} == {*FIELDS.split()}
    return SimpleNamespace(**fields)


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    definition: Any = ModuleType("versa.definition")
    definition.BaseMetric = BaseMetric
    definition.MetricMetadata = make_metadata
    definition.MetricCategory = Enum("MetricCategory", "INDEPENDENT DEPENDENT")
    definition.MetricType = Enum("MetricType", "FLOAT DICT")
    monkeypatch.setitem(sys.modules, "versa", ModuleType("versa"))
    monkeypatch.setitem(sys.modules, "versa.definition", definition)
    registry = Registry()
    load_example().register_hearing_metric(registry)
    yield registry


def load_example() -> Any:
    """Load the file that a user copies into VERSA."""
    spec = util.spec_from_file_location("hearing", FOLDER / "hearing.py")
    assert spec and spec.loader
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_yaml_scores_an_utterance_as_hlsim_does(registry: Registry) -> None:
    yaml = pytest.importorskip("yaml")
    (config,) = yaml.safe_load((FOLDER / "hearing.yaml").read_text())
    metric = registry.metrics[config.pop("name")](config)
    clean = hlsim.example_speech()[8000:20000].double()
    output = hlsim.compensate(clean, "N3", compensator="nalr")
    # Files hold other scales, and outputs may be longer.
    factor = 1e-3
    predictions = np.append(factor * output.numpy(), np.zeros(100))
    scores = metric.compute(predictions, factor * clean.numpy(), {"sample_rate": 16000})
    assert {*scores} == {"haspi", "hasqi", "hearing_level"}
    scale = 10.0 ** ((65.0 - float(level_spl(clean))) / 20.0)
    expected = haspi(scale * output, scale * clean, "N3")
    assert scores["haspi"] == pytest.approx(float(expected), abs=1e-6)
    assert scores["hearing_level"] == pytest.approx(float(level_spl(scale * output)), abs=0.01)


def test_two_channels_have_mbstoi(registry: Registry) -> None:
    metric = registry.metrics["hearing"]({"audiogram": "NH", "measures": ["mbstoi"]})
    clean = hlsim.example_speech()[8000:40000].double().expand(2, -1)
    output = clean + 0.01 * torch.arange(32000).double().sin()
    score = metric.compute(output.T.numpy(), clean.T.numpy())["mbstoi"]
    assert score == pytest.approx(float(mbstoi(output, clean)), abs=1e-4)


def test_settings_and_missing_signals_are_refused(registry: Registry) -> None:
    hearing = registry.metrics["hearing"]
    with pytest.raises(ValueError, match="expected the setting audiogram"):
        hearing({})
    with pytest.raises(ValueError, match="no measures"):
        hearing({"audiogram": "N3", "measures": ["pesq"]})
    with pytest.raises(ValueError, match="must be provided"):
        hearing({"audiogram": "N3"}).compute(np.ones(16000))


def test_the_scorer_of_versa_scores_a_kaldi_list(tmp_path: Path) -> None:
    yaml = pytest.importorskip("yaml")
    shared = pytest.importorskip("versa.scorer_shared", exc_type=ImportError)
    definition = pytest.importorskip("versa.definition")
    clean = hlsim.example_speech()[8000:20000]
    output = hlsim.compensate(clean, "N3", compensator="nalr")
    lists = []
    for name, signal in (("clean", clean), ("output", output)):
        write_audio(tmp_path / f"{name}.wav", 0.1 * signal, 16000)
        lists.append(tmp_path / f"{name}.scp")
        lists[-1].write_text(f"first {tmp_path}/{name}.wav\n")
    registry = definition.MetricRegistry()
    load_example().register_hearing_metric(registry)
    scorer = shared.VersaScorer(registry)
    clean_files, output_files = (
        shared.audio_loader_setup(str(path), "soundfile") for path in lists
    )
    suite = scorer.load_metrics(yaml.safe_load((FOLDER / "hearing.yaml").read_text()))
    (row,) = scorer.score_utterances(
        output_files, suite, clean_files, output_file=str(tmp_path / "scores.jsonl"), io="soundfile"
    )
    scale = 10.0 ** ((65.0 - float(level_spl(clean))) / 20.0)
    assert row["key"] == "first"
    assert row["haspi"] == pytest.approx(
        float(haspi(scale * output, scale * clean, "N3")), abs=0.01
    )
    assert json.loads((tmp_path / "scores.jsonl").read_text())["haspi"] == row["haspi"]
