"""Windows equal scipy's to the bit, because the bits of all filters depend on them."""

import numpy as np
import pytest
import scipy.signal

from hlsim.dsp.windows import hamming, kaiser


@pytest.mark.parametrize("taps", [2, 133, 141, 201, 1015])
def test_windows_are_scipys(taps: int) -> None:
    assert np.array_equal(hamming(taps), scipy.signal.windows.hamming(taps))
    for beta in (4.0, 8.0):
        assert np.array_equal(kaiser(taps, beta), scipy.signal.windows.kaiser(taps, beta))
