"""The demo's page on made-up scores: the verdict's words, names, pictures and players."""

from collections.abc import Sequence

import pytest
import torch

from hlsim.audiogram import Audiogram
from hlsim.evaluation.previous.haspi_report import HaspiReport
from hlsim.evaluation.previous.scores import ItemScore
from hlsim.losses.band_levels import band_centres
from hlsim.report.previous.demo import (
    AS_LOUD,
    NORMAL_EAR,
    PRESCRIBED,
    TRAINED,
    UNAIDED,
    Sounds,
    demo_front,
    demo_verdict,
    result_table,
)
from hlsim.report.previous.haspi import Front, html, markdown

pytest.importorskip("matplotlib")

STEADY = (0.05, 0.06, 0.04, 0.05, 0.05, 0.06, 0.04, 0.05)
SKEWED = (
    0.3,
    0.01,
    0.01,
    0.01,
    0.01,
    0.01,
    0.01,
    0.01,
)  # the t-test finds little in it, Wilcoxon much
AROUND_NOTHING = (0.05, -0.05, 0.04, -0.04, 0.06, -0.06, 0.03, -0.03)


def made_up(changes: Sequence[float], louder: float = 6.0) -> HaspiReport:
    """Scores of the trained aid less those of NAL-R as loud, which is ``louder`` dB above NAL-R and 0.02 better."""
    items = []
    for i, change in enumerate(changes):
        base = 0.6 + 0.02 * i
        scores = {UNAIDED: 0.2, PRESCRIBED: base - 0.02, AS_LOUD: base, TRAINED: base + change}
        levels = {UNAIDED: 65.0, PRESCRIBED: 80.0, AS_LOUD: 80.0 + louder, TRAINED: 80.0 + louder}
        about = {"clean_level": 65.0, "sample_rate": 16000, "seconds": 1.0, "seed": i}
        items.append(
            ItemScore(
                f"s{i}", Audiogram.standard("N4"), levels=levels, scores={"haspi": scores}, **about
            )
        )
    return HaspiReport(items)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            STEADY,
            "The trained aid is better than NAL-R made as loud: HASPI 0.720 against 0.670 (8 items, ",
        ),
        (
            [-x for x in STEADY],
            "The trained aid is worse than NAL-R made as loud: HASPI 0.620 against 0.670",
        ),
        (
            AROUND_NOTHING,
            "The trained aid cannot be told from NAL-R made as loud: HASPI 0.670 against 0.670",
        ),
        (SKEWED, "The trained aid may be better than NAL-R made as loud"),
    ],
)
def test_the_verdict_is_at_one_level(changes: Sequence[float], said: str) -> None:
    text = demo_verdict(made_up(changes))
    assert text.startswith(said)
    assert text.endswith(
        "; NAL-R as prescribed, 6.0 dB softer, has 0.650, and the unaided ear has 0.200."
    )
    assert ("the tests disagree" in text) == (changes is SKEWED)


def test_where_levels_are_alike_nal_r_itself_is_the_rival() -> None:
    text = demo_verdict(made_up(STEADY, louder=0.5))
    assert text.startswith(
        "The trained aid is better than NAL-R: HASPI 0.720 against 0.650 (8 items, "
    )
    assert text.endswith("; the unaided ear has 0.200.") and "as loud" not in text
    assert "softer, has" in demo_verdict(made_up(STEADY, louder=1.5))
    assert "louder, has" in demo_verdict(made_up(STEADY, louder=-1.5))


def made_up_page() -> tuple[HaspiReport, Front]:
    report = made_up(STEADY)
    generator = torch.Generator().manual_seed(0)
    clean = [0.1 * torch.randn(16000, generator=generator) for _ in report.items]
    gains = {UNAIDED: 1.0, PRESCRIBED: 5.0, AS_LOUD: 10.0, TRAINED: 10.0, NORMAL_EAR: 1.0}
    signals = {name: [gain * one for one in clean] for name, gain in gains.items()}
    hertz = band_centres().tolist()
    curves = [
        {"compensator": name, "ear": "N4 (severe loss)", "levels": [50, 65], "frequencies": hertz}
        | {"gain_db": [[20.0] * len(hertz), [15.0] * len(hertz)]}
        for name in (PRESCRIBED, TRAINED)
    ]
    table = result_table(report, {UNAIDED: -50.0, PRESCRIBED: -3.0, AS_LOUD: 3.0, TRAINED: 0.04})
    front, picture = demo_front(report, table, Sounds(["s0"], clean, signals, signals), curves)
    assert picture.startswith(b"\x89PNG")
    return report, front


def test_the_page_shows_the_result_by_name() -> None:
    report, front = made_up_page()
    page, text = html(report, 0, front), markdown(report, front)
    assert "<h1>A hearing aid trained for one ear: N4 (severe loss)</h1>" in page
    assert page.index(front.lead) < page.index("<h2") and front.lead == demo_verdict(report)
    (players,) = (section.players for section in front.sections if section.players)
    names = [player.label.rsplit(" (", 1)[0] for player in players]
    assert names == [
        "original",
        *(f"heard, {name}" for name in (UNAIDED, PRESCRIBED, AS_LOUD, TRAINED)),
    ]
    for name, cells in (
        (UNAIDED, ("0.200", "65.0", "-50.0")),
        (TRAINED, ("0.720", "86.0", "+0.0")),
    ):
        assert (
            f'<th scope="row">{name}</th>' + "".join(f"<td>{cell}</td>" for cell in cells) in page
        )
        assert f"| {name} | {' | '.join(cells)} |" in text
    for name in (UNAIDED, PRESCRIBED, TRAINED):
        assert all(f'alt="Spectrogram: {name}, {what}"' in page for what in ("given", "heard"))
    # the report itself follows, folded on the page
    assert ">Details</h2></summary>" in page and page.index("<summary>") < page.index("Wilcoxon")
    assert (
        "Wilcoxon" in text
        and "players" not in text
        and "<audio" not in page[page.index("<summary>") :]
    )
