"""Examples in docstrings print what they say, and every public function and class has one."""

import doctest
import importlib
import inspect

import pytest

# Modules whose examples are tested. Add yours when each public function and class has an example.
MODULES = [
    "compensators.config",
    "compensators.filter_bank",
    "compensators.gains",
    "compensators.hearing_aid",
    "compensators.limiter",
    "compensators.loading",
    "compensators.mapping",
    "compensators.nalr",
    "compensators.smoothing",
    "compensators.stream",
    "compensators.wdrc",
    "compensators.wearable",
    "hlsim.audio",
    "hlsim.audiogram.conversion",
    "hlsim.audiogram.devices",
    "hlsim.audiogram.listener",
    "hlsim.audiogram.plot",
    "hlsim.audiogram.table",
    "hlsim.audiogram.thresholds",
    "hlsim.audiogram.value",
    "hlsim.calibration",
    "hlsim.checkpoint",
    "hlsim.checks",
    "hlsim.dsp.active_level",
    "hlsim.dsp.erb",
    "hlsim.dsp.fft",
    "hlsim.dsp.fir",
    "hlsim.dsp.overlap",
    "hlsim.dsp.resample",
    "hlsim.dsp.stft",
    "hlsim.dsp.windows",
    "hlsim.evaluation.aids",
    "hlsim.evaluation.comparison",
    "hlsim.evaluation.compensators",
    "hlsim.evaluation.fingerprint",
    "hlsim.evaluation.items",
    "hlsim.evaluation.aid_properties",
    "hlsim.evaluation.measures",
    "hlsim.evaluation.parallel",
    "hlsim.evaluation.recordings",
    "hlsim.evaluation.result",
    "hlsim.evaluation.simulators",
    "hlsim.evaluation.statistics",
    "hlsim.evaluation.store",
    "hlsim.evaluation.study",
    "hlsim.export",
    "hlsim.extras",
    "hlsim.files",
    "hlsim.live",
    "hlsim.losses.band_levels",
    "hlsim.losses.coherent_bands",
    "hlsim.losses.criteria",
    "hlsim.losses.frozen_simulator",
    "hlsim.losses.haspi_loss",
    "hlsim.losses.hearing_loss",
    "hlsim.losses.paper",
    "hlsim.losses.waveform",
    "hlsim.metrics.ear.clean_speech",
    "hlsim.metrics.ear.envelope_modulation",
    "hlsim.metrics.ear.extent",
    "hlsim.metrics.ear.fine_structure",
    "hlsim.metrics.ear.input",
    "hlsim.metrics.ear.model",
    "hlsim.metrics.ear.recursions",
    "hlsim.metrics.fidelity",
    "hlsim.metrics.haaqi_score",
    "hlsim.metrics.haspi_score",
    "hlsim.metrics.hasqi_score",
    "hlsim.metrics.interaural",
    "hlsim.metrics.mbstoi_score",
    "hlsim.metrics.score_loss",
    "hlsim.metrics.pair",
    "hlsim.metrics.quality",
    "hlsim.metrics.reference",
    "hlsim.metrics.torchmetric",
    "hlsim.metrics.words",
    "hlsim.msbg.overlapping_blocks",
    "hlsim.msbg.cochlea",
    "hlsim.msbg.delay",
    "hlsim.msbg.ear",
    "hlsim.msbg.envelope",
    "hlsim.msbg.filterbank",
    "hlsim.msbg.filtfilt_end",
    "hlsim.msbg.model",
    "hlsim.msbg.multirate",
    "hlsim.msbg.recruitment",
    "hlsim.msbg.resampling",
    "hlsim.msbg.response",
    "hlsim.msbg.smearing",
    "hlsim.neuro.bands",
    "hlsim.neuro.blocks",
    "hlsim.neuro.config",
    "hlsim.neuro.decoders",
    "hlsim.neuro.encoder",
    "hlsim.neuro.mamba",
    "hlsim.neuro.model",
    "hlsim.neuro.network",
    "hlsim.neuro.prior",
    "hlsim.neuro.scan",
    "hlsim.plugins",
    "hlsim.report.page",
    "hlsim.report.players",
    "hlsim.report.plots",
    "hlsim.report.recordings",
    "hlsim.report.results",
    "hlsim.report.simulators",
    "hlsim.shortcuts",
    "hlsim.torchtools",
    "hlsim.training.augment",
    "hlsim.training.batches",
    "hlsim.training.callbacks",
    "hlsim.training.clips",
    "hlsim.training.compensator",
    "hlsim.training.corpora.instances",
    "hlsim.training.corpora.layouts",
    "hlsim.training.corpora.manifest",
    "hlsim.training.data_module",
    "hlsim.training.denoising",
    "hlsim.training.ears",
    "hlsim.training.module",
    "hlsim.training.recipes",
    "hlsim.training.simulator",
    "hlsim.training.teacher",
    "hlsim.training.tones_and_clicks",
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_they_say(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0
    assert results.failed == 0  # pytest shows the differences, which doctest prints


@pytest.mark.parametrize("name", MODULES)
def test_every_public_function_and_class_has_an_example(name: str) -> None:
    module = importlib.import_module(name)
    without_example = [
        f"{name}.{member}"
        for member, value in vars(module).items()
        if callable(value)
        and getattr(value, "__module__", None) == name
        and not member.startswith("_")
        and ">>>" not in (inspect.getdoc(value) or "")
    ]
    assert without_example == []
