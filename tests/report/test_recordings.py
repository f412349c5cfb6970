"""The page of ``haspi-report``: one verdict, the same p everywhere."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import soundfile
import torch

from hlsim.audio import write_audio
from hlsim.audiogram import Audiogram
from hlsim.evaluation import Condition, Evaluation, compare
from hlsim.evaluation.measures import MEASURES
from hlsim.evaluation.recorded_items import RecordedItem
from hlsim.evaluation.sounds import perceive_items
from hlsim.report.plots import means_pictures
from hlsim.report.recordings_page import report_page
from hlsim.report.tables import statistic, summary_table
from hlsim.report.verdict import verdict
from hlsim.report.writing import write_results

pandas = pytest.importorskip("pandas")
pytest.importorskip("matplotlib")

NAMES = ("unaided", "NAL-R", "<my> aid")


def evaluation(folder: Path, listen: int = 0) -> Evaluation:
    """A report of made-up scores of twelve items; all conditions are the same second of noise."""
    path = folder / "noise.wav"
    write_audio(path, 0.02 * torch.randn(1, 16000), 16000)
    files = dict.fromkeys(NAMES, path)
    audiograms = [Audiogram.standard(ear) for ear in ("N1", "N3", "N4", "S2")]
    items = [RecordedItem(f"s{i}", path, files, audiograms[i % 4]) for i in range(12)]
    rows = []
    for number, item in enumerate(items):
        low, rise = torch.rand(2).tolist()
        for place, condition in enumerate(NAMES):
            facts = {"item": number, "name": item.name, **item.facts, "condition": condition}
            facts |= {"listener": f"L{number % 3}", "snr": 5.0 * (number % 2)}
            scores = {"haspi": low / 2 + place * (rise - 0.3) / 4, "level": 65.0 + 6.0 * place}
            about = {"clean_level": 65.0, "full_scale_spl": 94.0}
            rows.append({**facts, **scores, **about, "failure": None})
    rows[-1] |= {"haspi": math.nan, "level": -40.0, "failure": "the file is silent"}
    table = pandas.DataFrame(rows)
    study = Evaluation(
        items=items,
        conditions=[Condition(name, kind="recorded") for name in NAMES],
        measures=[MEASURES["haspi"]],
        table=table,
        comparisons=compare(table, ["haspi"], planned=[("haspi", NAMES[0], NAMES[-1])]),
        settings={"seed": 0},
    )
    return replace(study, sounds=perceive_items(study, listen))


def test_a_comparison_has_one_p_wherever_it_appears(tmp_path: Path) -> None:
    study = evaluation(tmp_path)
    page, planned = report_page(study), study.headline
    assert [row[-1] for row in page.sections[0].tables[0].rows] == ["65.0", "71.0", "77.0"]
    assert planned is not None
    assert page.verdict == verdict(planned)
    assert page.markdown().count(f"p = {planned.overall.p_t:.5f}") >= 3
    assert "Planned before the scores were known" in page.markdown()


def test_verdict_and_scores_come_first_and_details_are_folded(tmp_path: Path) -> None:
    study = evaluation(tmp_path, listen=2)
    page = report_page(study)
    titles = [section.title for section in page.sections]
    assert titles == ["Scores", "Listen", "Details"] and page.sections[-1].folded
    details = [section.title for section in page.sections[-1].sections]
    assert details[:3] == ["All comparisons", "Items and listeners", "Parts of the items"]
    listen = page.sections[1].sections
    labels = [[sound.label for sound in section.player.sounds] for section in listen]
    assert labels == [["normal ear (the goal)", *NAMES]] * 2
    path = write_results(page, study, tmp_path / "out")
    html = path.read_text(encoding="utf-8")
    assert html.count("<audio") == 8 and "<my>" not in html and "the file is silent" in html
    data = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
    assert data["rows"][-1]["haspi"] is None and len(data["rows"]) == 36
    assert {c["name"] for c in data["conditions"]} == set(NAMES)
    assert len(data["comparisons"]) == 3
    assert data["comparisons"][0]["in_words"].startswith(verdict(study.comparisons[0]))
    scores = pandas.read_csv(path.with_name("scores.csv"))
    assert len(scores) == 36
    assert scores.haspi.to_numpy() == pytest.approx(study.table.haspi, abs=1e-6, nan_ok=True)
    assert scores.hl_250[0] == study.table.audiogram[0][0]


def test_sounds_of_a_condition_that_fails_are_named(tmp_path: Path) -> None:
    study = evaluation(tmp_path)
    (tmp_path / "noise.wav").rename(tmp_path / "clean.wav")
    items = [replace(item, clean=tmp_path / "clean.wav") for item in study.items]
    study = replace(study, items=items)
    page = report_page(replace(study, sounds=perceive_items(study, 1)))
    (player,) = page.sections[1].sections
    assert [sound.label for sound in player.player.sounds] == ["normal ear (the goal)"]
    assert "unaided cannot be played: " in player.paragraphs[1]


# MSBG accepts no rate above 48 kHz, and only the first 8 s are played.
@pytest.mark.parametrize(("rate", "silence"), [(96000, 0), (16000, 9 * 16000)])
def test_a_page_has_no_player_if_there_is_no_sound_to_play(
    tmp_path: Path, rate: int, silence: int
) -> None:
    study = evaluation(tmp_path)
    noise = torch.nn.functional.pad(0.02 * torch.randn(16000), (silence, 0))
    soundfile.write(tmp_path / "noise.wav", noise.numpy(), rate)
    page = report_page(replace(study, sounds=perceive_items(study, 1)))
    (section,) = page.sections[1].sections
    assert section.player is None
    assert section.paragraphs[-1] == "There is no sound to play."
    assert "no sound to play" in page.html()


def test_conditions_without_a_common_item_are_named(tmp_path: Path) -> None:
    study = evaluation(tmp_path)
    table = study.table[(study.table.condition == "unaided") == (study.table.item < 6)]
    unpaired = table[table.condition != "aid"]
    comparisons = compare(unpaired, ["haspi"])
    page = report_page(replace(study, table=unpaired, comparisons=comparisons))
    text = (
        f"Not compared, because no item has both scores: unaided and NAL-R, unaided and {NAMES[2]}."
    )
    assert text in page.sections[0].paragraphs[0]
    alone = unpaired[unpaired.condition != NAMES[2]]
    page = report_page(replace(study, table=alone, comparisons=[], conditions=study.conditions[:2]))
    means = alone.groupby("condition").haspi.mean()
    assert (
        f"of the condition unaided is {means['unaided']:.3f} on average (6 items, at"
        in page.verdict
    )
    assert f"of the condition NAL-R is {means['NAL-R']:.3f} on average (6 items, at" in page.verdict
    assert "no item has two scores, so that nothing can be compared" in page.verdict


def test_a_picture_shows_the_means_of_all_conditions(tmp_path: Path) -> None:
    study = evaluation(tmp_path)
    (picture,) = means_pictures(study)
    text = picture.data.decode()
    assert "unaided" in text and "NAL-R" in text and "&lt;my&gt; aid" in text
    assert "95 % intervals" in picture.note
    few = replace(study, table=study.table[study.table.item < 3])
    assert picture.data.count(b"<path") > means_pictures(few)[0].data.count(b"<path")
    single = replace(study, table=study.table[study.table.condition == "unaided"])
    assert means_pictures(single) == []


def test_the_reference_of_hasqi_and_both_scales_of_loss_are_stated(tmp_path: Path) -> None:
    study = evaluation(tmp_path, listen=1)
    page = report_page(study)
    assert "amplified by NAL-R" not in " ".join(page.sections[0].paragraphs)
    ear = study.sounds[0].ear
    about = page.sections[1].sections[0].paragraphs[0]
    assert f"WHO grade: {ear.who_grade}; MSBG's group: {ear.severity}" in about
    table = study.table.assign(hasqi=study.table.haspi)
    both = replace(study, table=table, measures=[*study.measures, MEASURES["hasqi"]])
    assert "amplified by NAL-R" in " ".join(report_page(both).sections[0].paragraphs)


def test_ratios_that_differ_by_rounding_are_one_row_of_a_table() -> None:
    """Ratios that were measured, such as 4.9999998 dB, have the heading of nominal ones."""
    ratios = [5.0, 4.9999998, 5.0000001, 0.0]
    rows = [("aid", snr, 0.1 * number) for number, snr in enumerate(ratios)]
    table = pandas.DataFrame(rows, columns=["condition", "snr", "haspi"])
    columns = {"n": (statistic("haspi", "count"), "d"), "HASPI": (statistic("haspi"), ".2f")}
    parts = summary_table("By SNR", table, columns, "snr").rows
    assert parts == [["0, aid", "1", "0.30"], ["5, aid", "3", "0.10"]]
