"""The lines of the guide to toolkits run where the toolkit is installed."""

import inspect
import re
import subprocess
import sys
from pathlib import Path
from textwrap import indent
from types import ModuleType, SimpleNamespace

import pytest
import torch

import hlsim

PAGE = Path(__file__).parents[1] / "docs" / "guide" / "your-toolkit.md"


@pytest.mark.slow
@pytest.mark.parametrize("toolkit", ["speechbrain", "asteroid", "espnet2.tasks.enh"])
def test_a_program_of_the_guide_trains(toolkit: str, tmp_path: Path) -> None:
    pytest.importorskip(toolkit, exc_type=ImportError)
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    (program,) = [
        text for text in programs if f"from {toolkit}" in text or f"import {toolkit}" in text
    ]
    subprocess.run([sys.executable, "-c", program], check=True, cwd=tmp_path, timeout=600)


@pytest.mark.slow
def test_denoiser_trains_with_the_lines_of_the_guide(tmp_path: Path) -> None:
    solver = pytest.importorskip("denoiser.solver", exc_type=ImportError)
    section = PAGE.read_text(encoding="utf-8").split("## denoiser")[1]
    construction, branch = re.findall(r"```text\n(.*?)```", section, re.DOTALL)
    source = inspect.getsource(solver)
    ends = (
        "        self._reset()\n",
        "                else:\n                    raise ValueError",
    )
    assert all(source.count(end) == 1 for end in ends)
    source = source.replace(ends[0], ends[0] + indent(construction, " " * 8))
    source = source.replace(ends[1], indent(branch, " " * 16) + ends[1])
    edited = ModuleType("denoiser.solver_of_the_guide")
    edited.__dict__.update(__package__="denoiser", hlsim=hlsim)
    exec(compile(source, "solver.py", "exec"), edited.__dict__)

    network = torch.nn.Conv1d(1, 1, 65, padding=32)
    before = network.weight.detach().clone()
    clean = hlsim.example_speech()[8000:24000].repeat(2, 1, 1)
    batches = [(clean + 0.01 * torch.arange(16000).sin(), clean)] * 2
    loader = torch.utils.data.DataLoader(batches, batch_size=None)
    args = SimpleNamespace(
        loss="hearing",
        device="cpu",
        epochs=1,
        eval_every=1,
        num_prints=1,
        history_file=tmp_path / "history.json",
        samples_dir=tmp_path,
        stft_loss=False,
        stft_sc_factor=0.5,
        stft_mag_factor=0.5,
        remix=False,
        bandmask=0.0,
        shift=0,
        shift_same=False,
        revecho=0.0,
        checkpoint=False,
        restart=False,
        save_again=False,
        continue_from="",
        continue_pretrained=None,
    )
    data = {"tr_loader": loader, "cv_loader": loader, "tt_loader": None}
    optimizer = torch.optim.Adam(network.parameters(), 1e-3)
    training = edited.Solver(data, network, optimizer, args)
    training.train()
    with torch.no_grad():
        output = network(batches[0][0])
    expected = hlsim.HearingLossLoss("N3")(output.squeeze(1), clean.squeeze(1))
    assert training.history[0]["valid"] == pytest.approx(float(expected), abs=1e-5)
    assert not torch.equal(network.weight, before)
