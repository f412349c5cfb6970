"""Outputs and gradients keep to the golden file: within tolerances, or bit by bit if asked for."""

import pytest

from tests.golden import CASES, COMMITTED_FILE, FAST_CASES, LOCAL_FILE, compute, read_file
from tests.helpers import mostly_slow

_, SUMMARIES = read_file(LOCAL_FILE or COMMITTED_FILE)


def test_committed_file_holds_every_case() -> None:
    _, committed = read_file(COMMITTED_FILE)
    assert committed.keys() == CASES.keys()


@pytest.mark.parametrize("name", mostly_slow(CASES, FAST_CASES))
def test_case_is_unchanged(name: str) -> None:
    if LOCAL_FILE and name not in SUMMARIES:
        pytest.skip(f"{LOCAL_FILE} was written before this case existed")
    case, expected = CASES[name], SUMMARIES[name]
    computed = compute(case)
    assert computed.keys() == expected.keys()
    for output, summary in computed.items():
        if summary.digest == expected[output].digest:
            continue
        difference = expected[output].difference(summary)
        assert not LOCAL_FILE, f"{output}: other bits, {difference:.1e} of the peak away"
        assert difference <= case.tolerance_of(output), (
            f"{output}: {difference:.1e} of the peak away"
        )
