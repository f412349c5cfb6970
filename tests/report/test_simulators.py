"""Fidelity as Markdown."""

import pytest

from hlsim.evaluation.previous.simulators import summarise
from hlsim.report.previous.simulators import summary_tables

pytest.importorskip("pandas")


def test_markdown_tables() -> None:
    summary = summarise(
        [
            {
                "snr": 10.0 + i / 8,
                "severity": ("severe", "none", "mild")[i % 3],
                "level": (80.0, 65)[i % 2],
                "condition": "clean" if i < 40 else None,
            }
            for i in range(60)
        ]
    )
    tables = [table.markdown() for table in summary_tables(summary)]
    text = "\n".join(tables)
    assert [len(table.splitlines()) for table in tables] == [3, 5, 4, 3]
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
    assert f"| mild | 20 | {summary['severity']['mild']['snr_median']:.1f} |" in text
    assert "By level (dB SPL)" in [table.caption for table in summary_tables(summary)]
    (whole,) = summary_tables(summarise([{"snr": 1.0}]))
    assert "n/a" in whole.markdown() and "By level" not in whole.caption
