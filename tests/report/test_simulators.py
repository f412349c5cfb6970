"""Fidelity as Markdown."""

from hlsim.evaluation.simulators import summarise
from hlsim.report.simulators import fidelity_markdown


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
    text = fidelity_markdown(summary)
    tables = [block for block in text.split("\n\n") if block.startswith("|")]
    assert [len(table.splitlines()) for table in tables] == [3, 5, 4, 3]
    assert len({line.count("|") for line in text.splitlines() if line.startswith("|")}) == 1
    assert f"| mild | 20 | {summary['severity']['mild']['snr_median']:.1f} |" in text
    assert "By level (dB SPL)" in text
    assert "n/a" in fidelity_markdown(summarise([{"snr": 1.0}])) and "By level" not in fidelity_markdown(
        summarise([{"snr": 1.0}])
    )
