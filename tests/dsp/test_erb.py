"""The three functions of the ERB scale agree with each other."""

import numpy as np

from hlsim.dsp.erb import erb, erb_frequency, erb_number

HZ = np.linspace(50.0, 16000.0, 2000)


def test_the_number_counts_erbs_and_has_an_inverse() -> None:
    np.testing.assert_allclose(erb_frequency(erb_number(HZ)), HZ, rtol=1e-12)
    assert erb_number(np.zeros(1)) == 0.0
    slope = np.gradient(erb_number(HZ), HZ)
    np.testing.assert_allclose(slope[5:-5] * erb(HZ)[5:-5], 1.0, rtol=0.01)  # 21.4 is rounded
