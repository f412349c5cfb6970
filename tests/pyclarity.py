"""Stored outputs of pyclarity, which save most of the time of the tests that compare with it.

A test requests an output from the fixture ``pyclarity`` by a key, with the function that computes
it. By default, the output is read from ``pyclarity.npz``. Each of these tests also runs as a slow
test, which calls pyclarity and compares its output with the stored one. ``pytest -n 0 -m slow
--write-pyclarity`` stores new outputs.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from hlsim.audiogram import Audiogram

OUTPUTS_FILE = Path(__file__).with_name("pyclarity.npz")

STRIDE = 17
"""Distance of stored samples of a long signal; 17 has no factor in common with MSBG's hops."""

Array = NDArray[Any]


@lru_cache(maxsize=1)
def stored_outputs() -> dict[str, Array]:
    with np.load(OUTPUTS_FILE) as stored:
        return {key: stored[key] for key in stored.files}


class PyclarityOutputs:
    """Outputs by key: the stored ones, or with ``computed`` those of a call of pyclarity."""

    def __init__(self, computed: bool, new_outputs: dict[str, Array] | None) -> None:
        self.computed = computed
        self.new_outputs = new_outputs

    def __call__(self, key: str, compute: Callable[..., ArrayLike], *arguments: Any) -> Array:
        if not self.computed:
            return stored_outputs()[key]
        output = np.asarray(compute(*arguments))
        if self.new_outputs is not None:
            single = np.complex64 if np.iscomplexobj(output) else np.float32
            self.new_outputs[key] = output.astype(single) if output.size > 10 else output
        else:
            # other versions of numpy and scipy round in other ways
            tolerance = 1e-6 * np.abs(output).max()
            np.testing.assert_allclose(stored_outputs()[key], output, rtol=0, atol=tolerance)
        return output


def write_outputs(new_outputs: dict[str, Array]) -> None:
    known = stored_outputs() if OUTPUTS_FILE.exists() else {}
    np.savez_compressed(OUTPUTS_FILE, **{**known, **new_outputs})


# Calls of pyclarity


@contextmanager
def numpy_seed(seed: int) -> Iterator[None]:
    """Seed numpy's global generator, from which HASPI and HASQI draw, and restore it."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


def msbg(audiogram: Audiogram, waveform: Array, stride: int = 1) -> Array:
    """Samples of the output of ``Ear.process`` at 44.1 kHz, where RMS 1.0 is 120 dB SPL."""
    module = pytest.importorskip("clarity.evaluator.msbg.msbg")
    logging.disable(logging.WARNING)  # pyclarity warns of levels above 80 dB HL
    try:
        ear = module.Ear()
        ear.set_audiogram(audiogram.to_clarity())
        return np.asarray(ear.process(waveform)[0])[::stride]
    finally:
        logging.disable(logging.NOTSET)


def haspi(clean: Array, output: Array, audiogram: Audiogram, rate: int, seed: int) -> float:
    module = pytest.importorskip("clarity.evaluator.haspi")
    with numpy_seed(seed):
        score = module.haspi_v2(clean, rate, output, rate, audiogram.to_clarity(), level1=94.0)
    return float(score[0])


def hasqi(
    clean: Array, output: Array, audiogram: Audiogram, rate: int, seed: int, equalisation: int = 1
) -> Array:
    """Combined, nonlinear and linear score."""
    module = pytest.importorskip("clarity.evaluator.hasqi.hasqi")
    with numpy_seed(seed):
        scores = module.hasqi_v2(
            clean, rate, output, rate, audiogram.to_clarity(), equalisation, level1=94.0
        )
    return np.array(scores[:3], dtype=np.float64)


def haaqi(
    clean: Array, output: Array, audiogram: Audiogram, rate: int, seed: int, equalisation: int = 1
) -> Array:
    """Combined, nonlinear and linear score."""
    module = pytest.importorskip("clarity.evaluator.haaqi")
    with numpy_seed(seed):
        scores = module.haaqi_v1(
            clean, rate, output, rate, audiogram.to_clarity(), equalisation, level1=94.0
        )
    return np.array(scores[:3], dtype=np.float64)


def mbstoi(clean: Array, output: Array, rate: int) -> float:
    """Compute pyclarity's MBSTOI of signals (2, time), left ear first."""
    module = pytest.importorskip("clarity.evaluator.mbstoi")
    return float(module.mbstoi(*clean, *output, rate))
