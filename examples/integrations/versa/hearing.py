"""Metric of VERSA: HASPI, HASQI, HAAQI and MBSTOI of each utterance for one ear, by hlsim.

README.md says where to copy this file. The interface is that of VERSA's contributor guidelines.
"""

from typing import Any

import numpy as np
import torch
from versa.definition import BaseMetric, MetricCategory, MetricMetadata, MetricType

from hlsim.audiogram import as_audiogram
from hlsim.calibration import level_spl
from hlsim.metrics import haaqi, haspi, hasqi, mbstoi

MEASURES = {"haspi": haspi, "hasqi": hasqi, "haaqi": haaqi}
"""Measures of an ear, by name. MBSTOI, which has no ear, is called in another way."""


class HearingMetric(BaseMetric):
    """Scores of an utterance for an impaired ear."""

    def _setup(self) -> None:
        """Validate the settings. Nothing is downloaded."""
        if "audiogram" not in self.config:
            raise ValueError("expected the setting audiogram, such as N3, in the YAML entry")
        self.audiogram = as_audiogram(self.config["audiogram"])
        self.measures = self.config.get("measures", ["haspi", "hasqi"])
        self.spl = float(self.config.get("spl", 65.0))
        if unknown := {*self.measures} - {*MEASURES, "mbstoi"}:
            raise ValueError(f"no measures {sorted(unknown)}; expected {[*MEASURES, 'mbstoi']}")

    def compute(
        self, predictions: Any, references: Any = None, metadata: dict[str, Any] | None = None
    ) -> dict[str, float]:
        """Score an utterance.

        Args:
            predictions: Output of the system, (time,) or (time, channels).
            references: Clean speech of the same shape; the longer of both is cut.
            metadata: ``sample_rate`` in Hz, 16000 to 48000; by default 16000.

        Returns:
            Each measure, from 0 to 1, of the better channel, and ``hearing_level``, the level of
            the output in dB SPL.

        Raises:
            ValueError: A signal is missing, or what a measure does not accept.
        """
        if predictions is None or references is None:
            raise ValueError("Predicted and reference signal must be provided")
        rate = (metadata or {}).get("sample_rate", 16000)
        samples = min(len(predictions), len(references))
        output, clean = (
            torch.from_numpy(np.asarray(signal[:samples], dtype=np.float64).T.copy())
            for signal in (predictions, references)
        )
        # One factor for both, so that what the system amplified stays amplified.
        scale = 10.0 ** ((self.spl - level_spl(clean.flatten())) / 20.0)
        output, clean = scale * output, scale * clean
        scores = {"hearing_level": float(level_spl(output.flatten()))}
        for name in self.measures:
            if name == "mbstoi":
                scores[name] = float(mbstoi(output, clean, sample_rate=rate))
            else:
                score = MEASURES[name](output, clean, self.audiogram, sample_rate=rate)
                scores[name] = float(score.max())
        return scores

    def get_metadata(self) -> MetricMetadata:
        """Return the metadata of the registry."""
        return _metadata()


def _metadata() -> MetricMetadata:
    """Describe the metric for VERSA's registry."""
    return MetricMetadata(
        name="hearing",
        category=MetricCategory.DEPENDENT,
        metric_type=MetricType.DICT,
        requires_reference=True,
        requires_text=False,
        gpu_compatible=False,
        auto_install=False,
        dependencies=["hlsim"],
        description="HASPI, HASQI, HAAQI and MBSTOI for a listener with a hearing loss",
        paper_reference="https://doi.org/10.1016/j.specom.2020.05.001",
        implementation_source="https://github.com/OWNER/hlsim",
    )


def register_hearing_metric(registry: Any) -> None:
    """Register the metric with VERSA's registry."""
    registry.register(HearingMetric, _metadata(), aliases=["hearing_loss"])
