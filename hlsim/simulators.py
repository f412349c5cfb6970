"""Loading of all simulators: MSBG, trained networks, a linear ear, and simulators of your own."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hlsim.audiogram import FREQUENCIES
from hlsim.audiogram.thresholds import AudiogramLike, StoredEars, resolve_thresholds
from hlsim.calibration import (
    NEURO_RATE,
    PASCAL_SPL,
    check_full_scale,
    gain_to_pascals,
    set_level,
)
from hlsim.checks import check_attributes, check_rate, check_waveform
from hlsim.dsp.fft import correlate
from hlsim.dsp.fir import filter_without_delay
from hlsim.dsp.interpolation import interpolate
from hlsim.dsp.resample import HIGHEST_RESAMPLING_RATE, resample
from hlsim.msbg import MSBG
from hlsim.neuro import load_pretrained
from hlsim.plugins import WaveformPlugin
from hlsim.torchtools import pair_items

EXACT = "msbg"
"""Name of the exact MSBG."""

LINEAR = "attenuation"
"""Name of ``Attenuation``."""

UNSMEARED = "msbg-unsmeared"
"""Name of the exact MSBG without spectral smearing."""

_HALF_LENGTH_SECONDS = 0.064
"""Time in seconds that the filter of ``Attenuation`` covers before time 0, and after it."""

_MAX_DELAY_SECONDS = 2e-3
"""Largest delay in seconds of a plug-in that must be time-aligned."""

_LOWEST_PLUGIN_RATE = 1000
"""Lowest sample rate of a plug-in in Hz."""


class Attenuation(StoredEars, nn.Module):
    """Linear ear: each frequency is attenuated by the hearing loss, and nothing else happens.

    The gain in dB at a frequency is the threshold in dB HL times -1. Those at the eight
    ``FREQUENCIES`` are interpolated linearly in Hz, and constant below 250 Hz and above 8 kHz.
    There is neither recruitment nor smearing nor delay. Use this ear beside MSBG to see whether a
    result depends on these.

    Args:
        audiogram: Ear or ears; they may be passed with each call instead.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200. It has no influence
            on the output, but on the warning about loud signals.

    Attributes:
        reach: Number of input samples before and after an output sample that can influence it.
        thresholds: Thresholds of the constructor's ears in dB HL, (..., 8), or None.

    Raises:
        ValueError: The rate or the level is out of range, or the audiogram is not valid.

    >>> ear = Attenuation([20.0] * 8)
    >>> tone = torch.sin(0.1 * torch.arange(16000))
    >>> ratio = ear(tone)[4000:-4000].norm() / tone[4000:-4000].norm()
    >>> ratio.round(decimals=3)
    tensor(0.1000)
    """

    def __init__(
        self,
        audiogram: AudiogramLike | None = None,
        *,
        sample_rate: int = NEURO_RATE,
        full_scale_spl: float = PASCAL_SPL,
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        # samples before and after a sample of the output on which it depends
        self.reach = round(_HALF_LENGTH_SECONDS * self.sample_rate)
        self.store_ears(audiogram)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike | None = None) -> Tensor:
        """Attenuate signals.

        Shape: (..., time), (..., 8) -> (..., time), where the leading dimensions broadcast.

        Args:
            waveform: Input signals.
            audiogram: One ear for all signals, or ears whose thresholds in dB HL, (..., 8),
                broadcast over the leading dimensions of the waveform; by default those of the
                constructor.

        Raises:
            ValueError: There is no audiogram, a threshold is outside -10 to 100 dB HL, shapes do
                not broadcast, or the waveform is not a floating-point signal with time last, has no
                samples or one above 1e9 in magnitude.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        ears = self.resolve_thresholds(waveform, audiogram)
        with torch.autocast(waveform.device.type, enabled=False):
            dtype = torch.promote_types(waveform.dtype, torch.float32)
            half = self.reach
            hz = tuple(self.sample_rate * k / (2.0 * half) for k in range(half + 1))
            gains = 10.0 ** (-interpolate(ears.to(dtype), FREQUENCIES, hz) / 20.0)
            taps = torch.fft.irfft(gains.to(dtype.to_complex())).roll(half, -1)
            window = torch.hann_window(2 * half, dtype=dtype, device=waveform.device)
            return filter_without_delay(waveform.to(dtype), taps * window).to(waveform.dtype)


BUILT_IN: dict[str, Callable[..., nn.Module]] = {
    EXACT: MSBG,
    UNSMEARED: partial(MSBG, smearing=False),
    LINEAR: Attenuation,
}
"""Simulators that need no checkpoint, by name."""


class PluginSimulator(nn.Module):
    """Simulator of hearing loss from your own code, loaded by its name.

    Your simulator is a function ``(waveform, audiogram) -> waveform``, or a class whose objects can
    be called in this way and which is constructed without arguments. It receives signals in pascals
    with shape (items, time) and thresholds in dB HL with shape (items, 8), and returns the
    perceived signals, time-aligned with its input. Gradients pass through it if it is
    differentiable; its parameters do not require a gradient. Its sample rate is its attribute
    ``sample_rate``, 1000 to 1000000, or else 16000 Hz. It may have the attributes
    ``emulates_msbg``, ``highest_frequency`` and ``needs_exact_lengths``, see ``HearingLossLoss``.

    Args:
        name: ``package.module:name`` or ``path/to/file.py:name``.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000. Signals are resampled
            to the rate of your simulator and back.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: There is no such simulator, its attribute ``full_scale_spl`` is not 94, it
            fails, or its output for half a second of noise has another shape, is shifted by more
            than 2 ms, silent or not finite; or a rate or the level is out of range.

    >>> simulator = PluginSimulator("hlsim:MSBG")
    >>> simulator(torch.randn(1, 16000), "N3").shape
    torch.Size([1, 16000])
    """

    def __init__(
        self, name: str, *, sample_rate: int = NEURO_RATE, full_scale_spl: float = PASCAL_SPL
    ) -> None:
        super().__init__()
        self.sample_rate = check_rate(sample_rate)
        self.full_scale_spl = check_full_scale(full_scale_spl)
        self.plugin = WaveformPlugin(name, "simulator")
        function = self.plugin.function
        if isinstance(function, nn.Module):
            function.requires_grad_(False)
        scale = getattr(function, "full_scale_spl", PASCAL_SPL)
        if scale != PASCAL_SPL:
            raise ValueError(
                f"expected the simulator {name} to take pascals, full_scale_spl={PASCAL_SPL:g}, "
                f"got {scale:g}; build it without another scale"
            )
        self.plugin_rate = check_rate(
            getattr(function, "sample_rate", NEURO_RATE),
            _LOWEST_PLUGIN_RATE,
            HIGHEST_RESAMPLING_RATE,
        )
        self.emulates_msbg: bool = getattr(function, "emulates_msbg", False)
        self.needs_exact_lengths: bool = getattr(function, "needs_exact_lengths", False)
        highest_frequency = getattr(function, "highest_frequency", math.inf)
        self.highest_frequency = min(highest_frequency, self.plugin_rate / 2.0)
        # Whatever torch's default type and device, for example ``meta``
        settings: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
        generator = torch.Generator().manual_seed(0)
        noise = torch.randn(1, self.plugin_rate // 2, generator=generator, **settings)
        no_loss = torch.zeros(1, len(FREQUENCIES), **settings)
        check_aligned(self.plugin, set_level(noise, 65.0), self.plugin_rate, no_loss)

    def __str__(self) -> str:
        return str(self.plugin)

    def forward(self, waveform: Tensor, audiogram: AudiogramLike) -> Tensor:
        """Simulate what ears perceive.

        Shape: (..., time), (..., 8) -> (..., time), where the leading dimensions broadcast.

        Args:
            waveform: Input signals, where RMS 1.0 has the level ``full_scale_spl``.
            audiogram: One ear for all signals, or ears whose thresholds in dB HL, (..., 8),
                broadcast over the leading dimensions of the waveform.

        Raises:
            ValueError: There is no audiogram, a threshold is outside -10 to 100 dB HL, shapes do
                not broadcast, the waveform is not a floating-point signal with time last, has no
                samples or one above 1e9 in magnitude, or your simulator fails.
        """
        check_waveform(waveform, full_scale_spl=self.full_scale_spl)
        thresholds = resolve_thresholds(None, audiogram, waveform)
        batch, signals, ears = pair_items(waveform, thresholds, waveform.dtype)
        gain = gain_to_pascals(self.full_scale_spl)
        inputs = resample(signals * gain, self.sample_rate, self.plugin_rate)
        perceived = self.plugin.call(inputs, ears)
        output = resample(perceived, self.plugin_rate, self.sample_rate)
        return output[..., : waveform.shape[-1]].reshape(*batch, -1) / gain


def check_aligned(
    plugin: WaveformPlugin, waveform: Tensor, sample_rate: int, *arguments: Any
) -> None:
    """Call a plug-in, and reject an output that is delayed or advanced by more than 2 ms.

    The delay is that at which the first channels of input and output correlate most. A plug-in
    whose second output for the same input differs causes a warning, see
    ``WaveformPlugin.try_twice``.

    Args:
        plugin: Simulator or enhancer.
        waveform: First argument of the plug-in. Shape: (..., time).
        sample_rate: Sample rate in Hz.
        arguments: Further arguments of the plug-in.

    Raises:
        ValueError: The call fails, or the output is silent or not time-aligned.

    >>> check_aligned(WaveformPlugin("torch:sin", "enhancer"), torch.randn(2, 16000), 16000)
    """
    output = plugin.try_twice(waveform, *arguments)
    channels = [signal.reshape(-1, signal.shape[-1])[0] for signal in (output, waveform)]
    delay, coefficient = correlate(*channels)
    if coefficient == 0.0:
        raise ValueError(
            f"{plugin.kind} {plugin.name} returned silence for sound, expected an output that is "
            "time-aligned with the input"
        )
    if abs(delay) > _MAX_DELAY_SECONDS * sample_rate:
        raise ValueError(
            f"{plugin.kind} {plugin.name} delays by {1000 * delay / sample_rate:.1f} ms, expected "
            "an output that is time-aligned with the input; shift the output in your code"
        )


def load_simulator(
    simulator: str | Path | nn.Module,
    *,
    sample_rate: int = NEURO_RATE,
    full_scale_spl: float = PASCAL_SPL,
) -> nn.Module:
    """Return the simulator that a name, a folder or a module describes.

    Args:
        simulator: ``"msbg"``, the exact model; ``"msbg-unsmeared"``, the exact model without
            spectral smearing; ``"attenuation"``, a linear ear; the name of a checkpoint that ships
            with hlsim, such as ``"neuro-msbg"``, or the folder of a checkpoint or training run;
            ``package.module:name`` or ``path/to/file.py:name``, a simulator of your own
            (``PluginSimulator``); or a module, which is set to evaluation mode. If a module has an
            attribute ``sample_rate``, ``full_scale_spl`` or ``aligned``, it is validated.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of samples whose RMS is 1.0, 0 to 200.

    Raises:
        ValueError: There is no such simulator, a checkpoint is damaged, the rate or the level is
            out of range, the module was built for another rate or level, or with
            ``aligned=False``, or a simulator of your own is not valid (see ``PluginSimulator``).

    >>> load_simulator("msbg")
    MSBG(sample_rate=16000, full_scale_spl=94, aligned=True, rescale_active=False, smearing=True)
    """
    if isinstance(simulator, nn.Module):
        settings = {"sample_rate": sample_rate, "full_scale_spl": full_scale_spl, "aligned": True}
        check_attributes(simulator, "a simulator", **settings)
        return simulator.eval()
    name = str(simulator)
    if name in BUILT_IN:
        return BUILT_IN[name](sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    if ":" in name and not Path(name).is_dir():
        return PluginSimulator(name, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
    return load_pretrained(simulator, sample_rate=sample_rate, full_scale_spl=full_scale_spl)
