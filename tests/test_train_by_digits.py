"""The script that trains an aid by the digits that a recogniser finds behind simulated ears."""

from collections.abc import Callable
from types import ModuleType

import pytest
import torch

from compensators import HearingAid, load_compensator, save_compensator
from hlsim.checkpoint import read_record
from hlsim.data.bundled import SPEECH
from hlsim.data.clips import Clips
from tests.helpers import FIGURES, load_figure

pytestmark = pytest.mark.slow


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(FIGURES)
    script = load_figure("train_by_digits.py")
    monkeypatch.setattr(script, "BATCH", 2)
    monkeypatch.setattr(script, "CLEAN_ITEMS", 1)
    return script


def test_no_digits_are_won_by_amplification(script: ModuleType):
    speech = Clips(SPEECH, sample_rate=16000, seconds=1.0)
    noise = Clips(SPEECH, sample_rate=16000, seconds=3.0, repeat=True)
    aid = load_compensator("hearing-aid")
    lessons = script.Lessons(speech, noise, torch.full((1, 8), 50.0), ["attenuation"], aid)

    def terms(aid: Callable[..., torch.Tensor]) -> dict[str, torch.Tensor]:
        with torch.no_grad():
            return lessons.loss_terms(aid, torch.Generator().manual_seed(0))

    same, louder = terms(aid), terms(lambda sound, ears: 2.0 * aid(sound, ears))
    assert same["level"] == same["clean_bands"] == 0.0
    assert torch.isclose(louder["digits"], same["digits"], rtol=1e-4)
    assert torch.isclose(louder["level"], torch.tensor(6.02), atol=0.01)
    assert louder["clean_bands"] > 1.0


def test_a_training_changes_all_weights_and_records_its_settings(script: ModuleType, tmp_path):
    table = tmp_path / "ears.csv"
    frequencies = "250,500,1000,2000,3000,4000,6000,8000"
    table.write_text(f"name,{frequencies}\nA,20,30,50,60,60,60,60,60\n")
    start = HearingAid()
    save_compensator(start, tmp_path / "start")
    arguments = [str(SPEECH), str(SPEECH), "--audiograms", str(table), "--seed", "4"]
    arguments += ["--start", str(tmp_path / "start"), "--steps", "2"]
    script.main([*arguments, "--simulators", "attenuation", "--out", str(tmp_path / "trained")])
    trained = load_compensator(tmp_path / "trained").state_dict()
    unchanged = [
        name for name, weight in start.state_dict().items() if torch.equal(weight, trained[name])
    ]
    assert not unchanged
    about = read_record(tmp_path / "trained")["about"]
    assert about["start_sha256"] == read_record(tmp_path / "start")["sha256"]
    assert (about["steps"], about["recipe"]["seed"]) == (2, 4)
    assert about["simulator"] == ["attenuation"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (["--steps", "0"], "argument --steps: got '0', expected a whole number, 1 or more"),
        (["--start", "nobody"], "no checkpoint 'nobody'"),
        (["--audiograms", "nowhere.csv"], "nowhere.csv: cannot read audiograms"),
        (["--simulators", "nobody"], "no checkpoint 'nobody'"),
        ([], "nowhere: there is no such folder; correct the path"),
    ],
)
def test_a_wrong_argument_is_one_line(
    script: ModuleType, tmp_path, capsys: pytest.CaptureFixture[str], changed, message
):
    table = tmp_path / "ears.csv"
    table.write_text("name,500,1000,2000,4000\nA,30,50,60,60\n")
    folders = [str(SPEECH), str(SPEECH) if changed else "nowhere"]
    arguments = [*folders, "--audiograms", str(table), "--out", str(tmp_path / "trained"), *changed]
    with pytest.raises(SystemExit, match=r"^2$"):
        script.main(arguments)
    *usage, last = capsys.readouterr().err.splitlines()
    assert usage[0].startswith("usage: ") and message in last
    assert not (tmp_path / "trained").exists()
