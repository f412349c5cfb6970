"""Tables as Markdown and LaTeX, whatever stands in their cells."""

import pytest

from hlsim.audiogram import Audiogram
from hlsim.evaluation import ItemScore
from hlsim.evaluation.previous.comparison import compare_conditions
from hlsim.report.page import Section, render_markdown
from hlsim.report.previous.tables import Table, listener_table, number, severity_table, spread


def test_cells_are_escaped() -> None:
    table = Table.of("a_b", [{"x|y": "1 | 2", "50 %": r"\{~^}"}, {"x|y": "<Δ>", "50 %": "3 ± 1"}])
    assert table.markdown().splitlines() == [
        "| x\\|y | 50 % |",
        "| --- | --- |",
        "| 1 \\| 2 | \\{~^} |",
        "| <Δ> | 3 ± 1 |",
    ]
    lines = table.latex().splitlines()
    assert r"\caption{a\_b.}" in lines and r"\begin{tabular}{lr}" in lines
    assert r"x|y & 50 \% \\" in lines and r"$<$$\Delta$$>$ & 3 $\pm$ 1 \\" in lines
    assert r"1 | 2 & \textbackslash{}\{\textasciitilde{}\textasciicircum{}\} \\" in lines


def test_what_there_is_not() -> None:
    assert (number(None, ".1f"), number(0.25, ".1f"), number(None, "g", "none")) == (
        "n/a",
        "0.2",
        "none",
    )
    assert (spread(0.5, None), spread(0.5, 0.25)) == ("0.500", "0.500 ± 0.250")


@pytest.mark.parametrize("names", [("a", "A"), ("d", "wilcoxon")])
def test_conditions_may_be_called_anything(names: tuple[str, str]) -> None:
    """As another column, or as each other but for capitals."""
    ear, levels = Audiogram.standard("N3"), dict.fromkeys(names, 65.0)
    scores = [{"haspi": dict(zip(names, (0.25, 0.5 + i / 8), strict=True))} for i in range(4)]
    items = [
        ItemScore(f"{i}", ear, 65.0, levels, own, 16000, 2.0, i, listener=f"L{i % 2}")
        for i, own in enumerate(scores)
    ]
    (comparison,) = compare_conditions(items, ["haspi"], names)
    listeners = listener_table(comparison)
    assert listeners is not None
    for table in (severity_table(comparison), listeners):
        assert len(table.header) == 8 and {len(row) for row in table.rows} == {8}
        assert [name.lower() for name in table.header[2:4]] == [name.lower() for name in names]
        assert table.rows[0][2].startswith("0.250")


def test_markdown_leaves_to_the_page_what_is_folded_or_nested() -> None:
    table = Table("t", ("a", "b"), [("1", "2")])
    assert "p < .1, &lt;b> &lt;/b>" in render_markdown("T", [Section("S", ["p < .1, <b> </b>"])])
    sections = [
        Section("One", ["text"], [table]),
        Section("Folded", tables=[table], folded=True),
        Section("Nested", ["text"], sections=[Section("Inner", ["text"])]),
        Section("Empty"),
    ]
    text = render_markdown("Title", sections, "lead")
    assert (
        text
        == "# Title\n\nlead\n\n## One\n\ntext\n\n**t**\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    )
