"""The examples of training through the loss run as they stand, a few steps."""

import importlib
from pathlib import Path

import pytest
import torch

from tests.helpers import EXAMPLES, ROOT, load_example, load_figure, mostly_slow

TRAINING = EXAMPLES / "training"


def losses(out: str) -> list[float]:
    return [float(line.split(":")[1]) for line in out.splitlines()]


@pytest.mark.slow
def test_conv_tasnet_trains(
    tmp_path: Path, speech_dir: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    load_example("training/conv_tasnet.py").main(
        str(speech_dir / "train"), str(tmp_path / "out.pt"), "N3", "2", 0.3
    )
    assert all(0.0 < value < 5.0 for value in losses(capsys.readouterr().out))
    assert torch.load(tmp_path / "out.pt")


@pytest.mark.slow
@pytest.mark.parametrize(("network", "loss"), [("gru-mask", "with-haspi"), ("waveform", "default")])
def test_networks_are_trained_and_compared_with_nalr(
    network: str,
    loss: str,
    speech_dir: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(TRAINING)
    folders = (str(speech_dir / "train"), str(speech_dir / "valid"))
    options = f"--loss {loss} --steps 1 --rate 1e-9 --items 1 --noisy".split()
    load_figure("networks.py").main(["train", *folders, network, *options])
    out = capsys.readouterr()
    assert out.err.startswith("step 1: ")
    name, unaided, nalr, aided, _, _, *_, follows, as_it_is = out.out.strip("| \n").split(" | ")
    assert name == network and float(unaided) < float(nalr)
    assert aided == unaided and follows == as_it_is == "1.00"  # they start as what changes nothing


@pytest.mark.slow
def test_saved_networks_are_judged_at_the_level_of_nalr(
    tmp_path: Path,
    speech_dir: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("pandas")
    monkeypatch.syspath_prepend(TRAINING)
    monkeypatch.syspath_prepend(ROOT)
    listener = importlib.import_module("examples.machine_listener")
    networks = load_figure("networks.py")
    sentence = listener.Sentence("flite-rms-01.flac", 0.0, 1.0, "a b")
    monkeypatch.setattr(listener, "Whisper", lambda folder: lambda waveform: "a")
    monkeypatch.setattr(listener, "read_sentences", lambda path: [sentence])
    train, valid, out = str(speech_dir / "train"), str(speech_dir / "valid"), str(tmp_path / "out")
    options = "gru-mask-8ms --loss snr --steps 1 --rate 1e-9 --items 1".split()
    networks.main(["train", train, valid, *options, "--noise", valid, "--out", out])
    networks.main(["judge", out, valid, valid, "--model", "", "--snrs", "5"])
    printed = capsys.readouterr().out.replace("-0.000", "+0.000")
    assert "| NAL-R | 0.500 [" in printed
    # The network changes nothing, and NAL-R follows it.
    assert printed.count("| gru-mask-8ms.snr minus NAL-R | +0.000 [+0.000, +0.000]") == 2


def test_a_mask_looks_one_window_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(TRAINING)
    torch.manual_seed(0)
    network = load_figure("networks.py").gru_mask(128)
    torch.nn.init.normal_(network.layers[-1].weight)
    signal = torch.randn(1, 1600)
    changed = signal.clone()
    changed[:, 1000:] = 0.0
    difference = (network(changed) - network(signal)).abs()[0]
    assert difference[: 1000 - 128].max() < 1e-6 and difference[1000 - 64 : 1000].max() > 1e-2


def test_a_criterion_of_ones_own_trains(capsys: pytest.CaptureFixture[str]) -> None:
    load_example("training/your_criterion.py").main(steps=6)
    values = losses(capsys.readouterr().out)
    assert values[-1] < values[0]


@pytest.mark.parametrize("package", mostly_slow(["auraloss", "torch-stoi"], ["torch-stoi"]))
def test_criteria_of_other_packages_on_what_is_heard(
    package: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(package.replace("-", "_"))
    example = load_example("training/your_criterion.py")
    example.main(package, steps=6)
    values = losses(capsys.readouterr().out)
    assert values[-1] < values[0]
    # it has a gradient of its own, and the reference itself costs least
    criterion = example.import_criterion(package)
    reference = example.set_level(torch.randn(2, 16000), 65.0)
    noisy = (reference + 0.02 * torch.randn(2, 16000)).requires_grad_()
    value = criterion(noisy, reference)
    value.backward()
    assert float(criterion(reference, reference)) < value.item() and bool(noisy.grad.any())


def test_a_loop_of_accelerate(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("accelerate")
    aid = load_example("training/accelerate_loop.py").main(3)
    values = losses(capsys.readouterr().out)
    assert values[-1] < values[0]
    assert set(aid.state_dict()) == {"weight", "bias"}


def test_a_dead_region_is_silent_and_the_rest_is_attenuated() -> None:
    ear, rate = torch.tensor([20.0, 20.0, 25.0, 55.0, 75.0, 95.0, 95.0, 95.0]), 16000
    time = torch.arange(rate) / rate
    tones = torch.stack(
        [torch.sin(2 * torch.pi * hz * time) for hz in (500.0, 1000.0, 2000.0, 3500.0)]
    )
    perceived = load_example("training/dead_region.py").DeadRegion()(tones, ear)[:, 1000:-1000]
    levels = 20.0 * (perceived.std(-1) / tones[:, 1000:-1000].std(-1)).log10()
    torch.testing.assert_close(levels[:3], torch.tensor([-20.0, -25.0, -55.0]), atol=0.5, rtol=0.0)
    assert float(levels[3]) < -75.0
    # The output is in phase with the input, so it is not delayed.
    similarity = torch.nn.functional.cosine_similarity(perceived[0], tones[0, 1000:-1000], dim=0)
    assert float(similarity) > 0.9999


@pytest.mark.slow
def test_lightning_in_bf16(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("lightning")
    aid = load_example("training/lightning_bf16.py").main(2)
    assert set(aid.state_dict()) == {"network.weight", "network.bias"}
    assert float(aid.trainer.callback_metrics["loss"]) > 0.0


@pytest.mark.slow
def test_a_filter_bank_trains(speech_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = load_example("training/filter_bank.py")
    ear = example.Audiogram.standard("N3")
    aid = example.train_filter_bank(str(speech_dir / "train"), example.HearingLossLoss(ear), 8)
    start, *_, end = losses(capsys.readouterr().err)
    assert end < start
    assert float(aid.gain.mean()) > 0.1  # of 10 dB
    assert torch.equal(
        example.FilterBank()(torch.ones(1, 500)).isfinite(), torch.ones(1, 500, dtype=torch.bool)
    )
    speech = example.Clips(str(speech_dir / "valid"), sample_rate=16000, seconds=1.0).draw(
        1, torch.Generator().manual_seed(0)
    )
    unaided, louder = (
        example.describe_aid(lambda wave, g=gain: g * wave, ear, speech) for gain in (1.0, 10.0)
    )
    assert "output level 65.0 dB SPL" in unaided and "output level 85.0 dB SPL" in louder
    assert unaided < louder  # Both texts begin with HASPI.


@pytest.mark.slow
def test_haspi_trains(
    speech_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(TRAINING)
    example = load_example("training/haspi_objective.py")
    loss = example.LOSSES["HASPILoss"](example.Audiogram.standard("N3"))
    aid = example.train_filter_bank(str(speech_dir / "train"), loss, 3, clips=2)
    assert float(aid.gain.detach().mean()) > 0.05  # of 10 dB: speech is heard too softly
