"""What ``filtfilt``, pyclarity's way to run the envelope's low-pass, makes of a signal that ends in mid-speech.

Behind the last sample it goes on with eight, those before it reflected about it, and then with a constant. Seen
from the samples before, that differs from silence by a free oscillation of the low-pass, which is of second order: two
numbers a channel, linear in the last samples. With severe losses it moves the last 50 ms by up to 1e-2 of the whole.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from hlsim.msbg.envelope import STEP, envelope_filters
from hlsim.msbg.filterbank import FilterBank
from hlsim.msbg.recruitment import AHEAD

LOOK_BACK = 4096
"""Samples that the slowest low-pass looks back, to 70 dB."""

_PADDING = 8

Array = NDArray[np.float64]


def ending(channels: Tensor, weights: Tensor, response: Tensor, length: int) -> Tensor:
    """What the end adds to the envelopes of ``hlsim.msbg.envelope.envelope``.

    Shape: (..., channels, time), (channels, 2, samples), (channels, steps, 2) -> (..., channels, time // 24).

    Args:
        channels: zero from sample ``length`` on.
        weights, response: ``ending_weights`` and, for this length, ``ending_response``.
    """
    last = channels[..., max(0, length - LOOK_BACK) : length].abs().unsqueeze(-1)
    oscillation = (response @ (weights[..., -last.shape[-2] :] @ last)).squeeze(-1)
    steps = channels.shape[-1] // STEP
    end = (length - 1) // STEP + AHEAD + 1
    oscillation = oscillation[..., -end:]
    return functional.pad(oscillation, (end - oscillation.shape[-1], steps - end))


def ending_weights(bank: FilterBank) -> Array:
    """Weights of the last samples, the newest last, in the oscillation. Returns (channels, 2, 4096)."""
    return np.stack([weights for weights, _ in _oscillations(bank)])


def ending_response(bank: FilterBank, length: int) -> Array:
    """The oscillation at the steps up to ``AHEAD`` behind the end. Returns (channels, 170, 2)."""
    first = (length - 1) % STEP
    return np.stack(
        [response[first::STEP][: LOOK_BACK // STEP][::-1] for _, response in _oscillations(bank)]
    )


@lru_cache(maxsize=4)
def _oscillations(bank: FilterBank) -> list[tuple[Array, Array]]:
    return [_oscillation(*coefficients) for coefficients in envelope_filters(bank)]


def _oscillation(numerator: Array, denominator: Array) -> tuple[Array, Array]:
    """Weights, and the oscillation from ``AHEAD`` steps behind the end backwards.

    The filter's state z moves by z' = move z + enter u, and its output is y = z[0] + b0 u.

    Returns: (2, 4096), (4096 and the samples ahead, 2).
    """
    move = np.array([[-denominator[1], 1.0], [-denominator[2], 0.0]])
    enter = numerator[1:] - denominator[1:] * numerator[0]
    settled = np.linalg.solve(np.eye(2) - move, enter)  # the state after a constant input of 1

    def reflected(state: Array, newest: Array) -> Array:
        """State of the backward pass at the end, from that of the forward pass and the newest nine samples."""
        outputs = []
        for sample in 2.0 * newest[0] - newest[1:]:
            outputs.append(state[0] + numerator[0] * sample)
            state = move @ state + enter * sample
        state = settled * outputs[-1]
        for output in reversed(outputs):
            state = move @ state + enter * output
        return state

    # in silence the forward pass rings on, z, move z, ..., and the backward pass has S z: S = enter [1 0] + move S move
    silent = np.linalg.solve(np.eye(4) - np.kron(move, move.T), np.outer(enter, [1.0, 0.0]).ravel())
    nothing = np.zeros(_PADDING + 1)
    from_state = np.stack([reflected(unit, nothing) for unit in np.eye(2)], 1) - silent.reshape(
        2, 2
    )
    from_newest = np.stack([reflected(np.zeros(2), unit) for unit in np.eye(_PADDING + 1)], 1)

    behind = AHEAD * STEP
    powers = np.empty((behind + LOOK_BACK, 2, 2))
    powers[0] = np.linalg.matrix_power(np.linalg.inv(move), behind)
    for k in range(1, len(powers)):
        powers[k] = move @ powers[k - 1]
    weights = from_state @ (powers[behind:] @ enter).T
    weights[:, : _PADDING + 1] += from_newest
    # an orthonormal basis, for the states of such slow filters are too alike for single precision
    response, basis = np.linalg.qr(powers[:, 0])
    return (basis @ weights)[:, ::-1], response
