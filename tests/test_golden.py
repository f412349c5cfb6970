"""Outputs and gradients equal those in the golden file, bit by bit on the machine that wrote it."""

import pytest

from tests.golden import CASES, compute, environment, read_file

MADE_IN, _, SUMMARIES = read_file()
SAME_MACHINE = environment() == MADE_IN


def test_file_holds_every_case() -> None:
    assert SUMMARIES.keys() == CASES.keys()


@pytest.mark.parametrize("name", CASES)
def test_case_is_unchanged(name: str) -> None:
    case = CASES[name]
    expected, computed = SUMMARIES[name], compute(case)
    assert computed.keys() == expected.keys()
    for output, summary in computed.items():
        if summary.digest == expected[output].digest:
            continue
        difference = expected[output].difference(summary)
        allowed = 0.0 if SAME_MACHINE and not case.may_change else case.tolerance_of(output)
        assert allowed, f"{output}: other bits, {difference:.1e} of the peak away"
        assert difference <= allowed, f"{output}: {difference:.1e} of the peak away"
