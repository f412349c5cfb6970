"""Noisy speech at a signal-to-noise ratio."""

import math

import numpy as np
import torch
from torch import Tensor

from hlsim.calibration import HIGHEST_SPL, NEURO_RATE, dbfs, set_level
from hlsim.checks import check_finite, check_number, check_rate, check_waveform
from hlsim.dsp.active_level import active_level_db
from hlsim.torchtools import Audio, Samples, as_samples, as_type_of


def mix(
    speech: Audio,
    noise: Samples,
    snr: float | Tensor,
    sample_rate: int | None = NEURO_RATE,
    *,
    channels: bool = False,
) -> Audio:
    """Add noise to speech at a signal-to-noise ratio.

    The speech stays as it is, and the noise is scaled. The level of the speech is the active level
    of ITU-T P.56, which leaves pauses out; the level of the noise is its RMS level. Silent speech
    gets inaudible noise, at -106 dB SPL for an SNR of 0 dB or more.

    Args:
        speech: Tensor or NumPy array of speech, ``(..., time)``.
        noise: Noise of the same shape, or longer; its end is then left out.
        snr: Signal-to-noise ratio in dB, or a tensor of ratios, one per signal (with ``channels``,
            one per recording).
        sample_rate: Sample rate in Hz, 16000 to 48000. ``None`` takes the RMS level of the speech
            with its pauses instead of the active level.
        channels: Whether the second last dimension contains the channels of a recording, which have
            one SNR and one gain, so that the level differences between ears stay. Otherwise, each
            channel is a separate signal.

    Returns:
        Noisy speech, of the type and shape of ``speech``.

    Raises:
        ValueError: The shapes, or that of the SNR, do not fit; a signal is not floating-point with
            time last, or is above 1e9; the noise is silent or shorter than the speech, samples are
            NaN or infinite, the SNR is no number, or too low for any level of noise, or the sample
            rate is out of range.

    Example:
        >>> import hlsim
        >>> speech = hlsim.example_speech()
        >>> noisy = hlsim.mix(speech, torch.randn(2 * len(speech)), snr=5.0)
        >>> noisy.shape
        torch.Size([64320])
    """
    signal = check_waveform(as_samples(speech), "speech")
    masker = check_waveform(as_samples(noise), "noise")[..., : signal.shape[-1]].to(signal)
    if not isinstance(snr, Tensor | np.ndarray | list) and snr != math.inf:
        check_number("snr", snr, -math.inf)
    ratio = torch.as_tensor(snr, device=signal.device)
    if signal.ndim < 1 + channels:
        raise ValueError(
            "expected speech of shape (..., channels, time) with channels=True, got "
            f"{tuple(signal.shape)}; leave out channels for a single channel"
        )
    if masker.shape != signal.shape:
        raise ValueError(
            "expected speech and noise of the same shape (..., time), or longer noise, got "
            f"{tuple(signal.shape)} and {tuple(as_samples(noise).shape)}; repeat short noise, or "
            "expand it to the shape of the speech"
        )
    check_finite(signal, "speech")
    check_finite(masker, "noise")
    if bool((masker == 0.0).all((-2, -1) if channels else -1).any()):
        raise ValueError("expected noise, got silence; use another part of the recording")
    level = dbfs(signal)
    if sample_rate is not None:
        rate = check_rate(sample_rate)
        waveforms = signal.detach().cpu().double().reshape(-1, signal.shape[-1])
        for number, waveform in enumerate(waveforms):
            if bool(waveform.any()):  # A channel may be silent.
                level.view(-1)[number] = active_level_db(waveform, rate)
    if channels:
        loudest = level.amax(-1, keepdim=True)
        power = (10.0 ** ((level - loudest) / 10.0)).mean(-1)
        level = loudest.squeeze(-1) + 10.0 * power.log10()
        masker = masker.flatten(-2)
    # Fewer dimensions would broadcast: two ratios for two stereo items would be those of the ears.
    sizes = zip(ratio.shape, level.shape, strict=False)
    if ratio.ndim not in (0, level.ndim) or any(size not in (1, items) for size, items in sizes):
        unit = "recording" if channels else "signal"
        raise ValueError(
            f"expected one SNR, or one per {unit} in the shape {tuple(level.shape)}, got the shape "
            f"{tuple(ratio.shape)}; reshape it"
        )
    noise_level = (level - ratio).clamp_min(-200.0)  # the level of silence
    if not bool((noise_level <= HIGHEST_SPL).all()):  # also if it is NaN
        raise ValueError(
            f"expected an SNR in dB, such as 5 or -10, got {snr}; choose a higher one, at which "
            f"the RMS of the noise is at most {HIGHEST_SPL:g} dB above 1.0"
        )
    scaled = set_level(masker, noise_level, full_scale_spl=0.0)
    return as_type_of(speech, signal + scaled.reshape(signal.shape))
