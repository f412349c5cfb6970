"""The script that trains the amplification of an aid for steady tones."""

import torch

from compensators import HearingAid, load_compensator, save_compensator
from docs.figures.train_tones import find_levels, main, steady_level
from hlsim import MSBG
from hlsim.calibration import set_level
from hlsim.checkpoint import read_record
from hlsim.data.bundled import SPEECH


def test_found_levels_are_perceived_as_loud_as_by_a_normal_ear():
    tone = torch.sin(2.0 * torch.pi * 1000.0 * torch.arange(4000) / 16000.0)
    tones = set_level(tone.expand(2, -1), torch.tensor([50.0, 70.0]))
    ears = torch.tensor([[50.0] * 8, [60.0] * 8])
    targets = find_levels(tones, ears, highest=torch.tensor([106.0, 106.0]))
    simulator = MSBG(sample_rate=16000)
    perceived = steady_level(simulator(set_level(tones, targets.levels), ears))
    normal = steady_level(simulator(tones, torch.zeros(2, 8)))
    assert torch.allclose(perceived, normal, atol=0.5)
    assert (targets.slopes > 1.5).all()  # recruitment
    bounded_targets = find_levels(tones, ears, highest=torch.tensor([55.0, 72.0]))
    assert torch.allclose(bounded_targets.levels, torch.tensor([55.0, 72.0]), atol=0.1)


def test_only_the_amplification_is_trained_and_the_settings_are_recorded(tmp_path):
    table = tmp_path / "ears.csv"
    frequencies = "250,500,1000,2000,3000,4000,6000,8000"
    table.write_text(f"name,{frequencies}\nA,20,30,50,60,60,60,60,60\n")
    start = HearingAid()
    save_compensator(start, tmp_path / "start")
    arguments = [str(SPEECH), str(SPEECH), "--audiograms", str(table), "--tones", "3"]
    arguments += ["--start", str(tmp_path / "start"), "--steps", "2"]
    main([*arguments, "--out", str(tmp_path / "trained")])
    trained = load_compensator(tmp_path / "trained").state_dict()
    changed = {
        name.split(".")[0]
        for name, weight in start.state_dict().items()
        if not torch.equal(weight, trained[name])
    }
    assert changed == {"correct"}
    about = read_record(tmp_path / "trained")["about"]
    assert about["start_sha256"] == read_record(tmp_path / "start")["sha256"]
    assert (about["steps"], about["recipe"]["tones"], about["recipe"]["seed"]) == (2, 3, 8)
