"""Effect of ``filtfilt`` on the envelopes of a signal that ends abruptly.

pyclarity runs the envelope's low-pass forwards and backwards with ``scipy.signal.filtfilt``. At the
end of a signal, ``filtfilt`` adds eight samples, the last ones reflected about the last sample, and
starts the backward pass as if the signal had been constant after them. The Fourier transforms of
``hlsim.msbg.envelope`` treat the signal as followed by silence instead.

The two envelopes differ by a *free oscillation* of the low-pass, which rings like a struck string.
The low-pass is of second order, so that two amplitudes per channel describe the oscillation. They
are weighted sums of the last samples of the rectified channel. With a severe loss, the oscillation
changes the last 50 ms by up to 1e-2 of the whole signal.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.msbg.envelope import STEP, envelope_filters
from hlsim.msbg.filter_bank import FilterBank
from hlsim.msbg.recruitment import AHEAD
from hlsim.torchtools import as_tensor, compute_once

LOOK_BACK = 4096
"""Number of last samples with an influence. In this time the slowest low-pass decays by 107 dB."""

_PADDING = 8
"""Number of samples that ``filtfilt`` adds at the end of a signal."""

Array = NDArray[np.float64]


def end_correction(channels: Tensor, bank: FilterBank, length: int) -> Tensor:
    """Compute the correction in Pa that is added to the envelopes of a signal that ends abruptly.

    pyclarity smooths envelopes with ``scipy.signal.filtfilt``, which continues a signal beyond its
    end. ``hlsim.msbg.envelope.envelope`` treats the signal as followed by silence. The result is
    the difference.

    Shape: (..., channels, time) -> (..., channels, time // 24).

    Args:
        channels: Band-pass signals at 44.1 kHz that are 0 from sample ``length`` on.
        bank: Filter bank to which the channels belong.
        length: Number of samples of the signal.

    Returns:
        Difference of the envelopes, one value for every 24 samples.

    >>> from hlsim.msbg.filter_bank import BANKS
    >>> end_correction(torch.zeros(19, 240), BANKS["severe"], length=100).shape
    torch.Size([19, 10])
    """
    weights, oscillations = _oscillations(bank, channels.dtype, channels.device)
    # One value per step, up to three steps (``AHEAD``) after the last step of the signal
    sampled = oscillations[:, (length - 1) % STEP :: STEP][:, : LOOK_BACK // STEP].flip(1)
    first = max(0, length - LOOK_BACK)
    last_samples = channels[..., first:length].abs().unsqueeze(-1)
    amplitudes = weights[..., -last_samples.shape[-2] :] @ last_samples
    correction = (sampled @ amplitudes).squeeze(-1)
    steps = channels.shape[-1] // STEP
    end = (length - 1) // STEP + AHEAD + 1
    correction = correction[..., -end:]
    return functional.pad(correction, (end - correction.shape[-1], steps - end))


@compute_once
def _oscillations(
    bank: FilterBank, dtype: torch.dtype, device: torch.device
) -> tuple[Tensor, Tensor]:
    """Compute the two free oscillations of each channel's low-pass, see ``_oscillation``.

    Args:
        bank: Filter bank to which the channels belong.
        dtype: Precision of the results.
        device: Device of the results.

    Returns:
        Weights of the last 4096 samples of a signal in the amplitudes of the oscillations, the last
        sample last, (channels, 2, 4096), and the oscillations, backwards in time from 72 samples
        after the end, (channels, 72 + 4096, 2).
    """
    results = [_oscillation(*coefficients) for coefficients in envelope_filters(bank)]
    weights, oscillations = (np.stack(arrays) for arrays in zip(*results, strict=True))
    return as_tensor(weights, dtype, device), as_tensor(oscillations, dtype, device)


def _oscillation(numerator: Array, denominator: Array) -> tuple[Array, Array]:
    """Compute the free oscillations of a low-pass, and the weights of the last samples in them.

    The weighted sums of the last samples multiply the oscillations. The result is the difference
    between the envelope by ``filtfilt`` and that of a signal which continues in silence.

    The low-pass has a state z of two numbers. With the input u, its output is z[0] + b0 u, and its
    next state is A z + (b1 - a1 b0, b2 - a2 b0) u with A = [[-a1, 1], [-a2, 0]].

    Args:
        numerator: Three coefficients b0, b1, b2.
        denominator: Three coefficients 1, a1, a2.

    Returns:
        Weights of the last 4096 samples, the last one last, (2, 4096), and oscillations in an
        orthonormal basis, (72 + 4096, 2), which run backwards in time from 72 samples (``AHEAD``
        steps) after the end.
    """
    transition = np.array([[-denominator[1], 1.0], [-denominator[2], 0.0]])
    input_vector = numerator[1:] - denominator[1:] * numerator[0]
    # At the end of the signal, ``filtfilt`` adds samples to the forward pass, and the backward pass
    # begins behind them. Its state where it reaches the signal depends linearly on the state of the
    # forward pass and on the last nine samples, the last one first.
    units = np.eye(2 + 1 + _PADDING)
    state, newest = units[:2], units[2:]
    padding = 2.0 * newest[0] - newest[1:]
    outputs = []
    for sample in padding:
        outputs.append(state[0] + numerator[0] * sample)
        state = transition @ state + np.outer(input_vector, sample)
    state_of_constant = np.linalg.solve(np.eye(2) - transition, input_vector)
    backward_state = np.outer(state_of_constant, outputs[-1])
    for output in reversed(outputs):
        backward_state = transition @ backward_state + np.outer(input_vector, output)

    # If silence follows, the forward pass goes through the states z, transition z, ... The backward
    # pass then ends in the state S z, where S = input_vector [1 0] + transition S transition.
    silence = np.linalg.solve(
        np.eye(4) - np.kron(transition, transition.T), np.outer(input_vector, [1.0, 0.0]).ravel()
    )
    from_state = backward_state[:, :2] - silence.reshape(2, 2)
    from_newest = backward_state[:, 2:]

    samples_behind = AHEAD * STEP
    powers = np.empty((samples_behind + LOOK_BACK, 2, 2))
    powers[0] = np.linalg.matrix_power(np.linalg.inv(transition), samples_behind)
    for k in range(1, len(powers)):
        powers[k] = transition @ powers[k - 1]
    weights = from_state @ (powers[samples_behind:] @ input_vector).T
    weights[:, : _PADDING + 1] += from_newest
    # The two states of a slow filter are nearly proportional to each other, too close for single
    # precision. An orthonormal basis separates them.
    response, basis = np.linalg.qr(powers[:, 0])
    return (basis @ weights)[:, ::-1], response
