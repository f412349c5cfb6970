"""A listener's two ears are treated as two separate calls treat them."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from compensators import load_compensator
from hlsim import MSBG, Audiogram, HASPILoss, HearingLossLoss, Listener, load_pretrained
from hlsim.audiogram.table import read_listeners
from hlsim.calibration import set_level
from hlsim.metrics import haspi, hasqi
from tests.helpers import mostly_slow

LEFT, RIGHT = Audiogram.standard("N2"), Audiogram.standard("N4")
BOTH = Listener(LEFT, RIGHT)
ENTRY = {
    "name": "L0001",
    "audiogram_cfs": [250, 500, 1000, 2000, 3000, 4000, 6000, 8000],
    "audiogram_levels_l": [*LEFT.levels],
    "audiogram_levels_r": [*RIGHT.levels],
}


@pytest.fixture
def scene(speech: list[tuple[Tensor, int]]) -> Tensor:
    """Two channels of different speech. Shape: (2, 12000)."""
    return torch.cat([set_level(wave[:, 8000:20000], 65.0) for wave, _ in speech[:2]])


MODULES: dict[str, Callable[[], Any]] = {
    "msbg": MSBG,
    "neuro-msbg": partial(load_pretrained, "neuro-msbg"),
    **{name: partial(load_compensator, name) for name in ("nalr", "wdrc", "hearing-aid")},
}


@pytest.mark.parametrize("name", MODULES)
def test_both_ears_in_one_call_are_each_ear_alone(name: str, scene: Tensor) -> None:
    module = MODULES[name]()
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-6)
    with torch.no_grad():
        both = module(scene, BOTH)
        for channel, ear in enumerate((LEFT, RIGHT)):
            close(both[channel], module(scene[channel], ear))
        close(module(scene.flip(0), Listener(RIGHT, LEFT)).flip(0), both)
        items = module(torch.stack((scene, scene.flip(0))), [BOTH, Listener(RIGHT, LEFT)])
        close(items[0], both)
        close(items[1].flip(0), both)
        with pytest.raises(ValueError):
            module(scene[0], BOTH)
        if name in ("msbg", "nalr"):
            stored = type(module)(BOTH)
            close(stored(scene), both)
            with pytest.raises(ValueError):
                stored(scene[0])


@pytest.mark.parametrize("kind", mostly_slow([HearingLossLoss, HASPILoss], [HearingLossLoss]))
def test_the_loss_is_the_mean_over_both_ears_and_reaches_both(kind: Any, scene: Tensor) -> None:
    # In float32, the value depends on the size of the batch, by up to 2e-4 on some processors.
    scene = scene.double()
    loss, output = kind().double(), (0.5 * scene).requires_grad_()
    value = loss(output[None], scene[None], BOTH)
    left = loss(output[:1], scene[:1], LEFT).detach()
    right = loss(output[1:], scene[1:], RIGHT).detach()
    assert float(value.detach()) == pytest.approx(float(left + right) / 2.0, rel=1e-6)
    (gradient,) = torch.autograd.grad(value, output)
    assert bool(gradient.isfinite().all()) and bool(gradient.any(-1).all())
    stored = kind(BOTH).double()(output[None], scene[None]).detach()
    assert float(stored) == pytest.approx(float(value.detach()), rel=1e-5)
    for mono in (loss, kind(BOTH)):
        with pytest.raises(ValueError):
            mono(output[0], scene[0], BOTH if mono is loss else None)


def test_the_better_ear_counts_more_and_both_have_a_gradient(scene: Tensor) -> None:
    scenes = torch.stack((scene, scene.flip(0)))
    outputs = (0.5 * scenes).requires_grad_()
    listeners = [BOTH, Listener(RIGHT, LEFT)]
    losses = HearingLossLoss(reduction="none")(outputs, scenes, listeners)
    value = HearingLossLoss(reduction="none", ears="better")(outputs, scenes, listeners)
    shares = torch.softmax(-losses.detach() / 0.1, -1)
    torch.testing.assert_close(value, (shares * losses).sum(-1))
    assert bool((losses.amin(-1) < value).all()) and bool((value < losses.mean(-1)).all())
    torch.testing.assert_close(value[0], value[1], rtol=1e-4, atol=0)
    (gradient,) = torch.autograd.grad(value.sum(), outputs)
    assert bool(gradient.any(-1).all())
    with pytest.raises(ValueError):
        HearingLossLoss(LEFT, ears="better")(outputs[:, :1], scenes[:, :1])


@pytest.mark.parametrize("score", mostly_slow([haspi, hasqi], [haspi]))
def test_scores_have_one_value_per_ear(score: Any, scene: Tensor) -> None:
    output = scene + 0.02 * torch.randn(scene.shape, generator=torch.Generator().manual_seed(0))
    scores = score(output, scene, BOTH)
    expected = [float(score(output[i], scene[i], ear)) for i, ear in enumerate((LEFT, RIGHT))]
    assert scores.tolist() == pytest.approx(expected, abs=1e-5)


def test_read_from_csv_json_and_pyclarity(tmp_path: Path) -> None:
    table = tmp_path / "ears.csv"
    table.write_text("Listener;EAR;250;8 kHz\nA;R;10;20\nA;Left;;40\nb;le;5;\n")
    expected = {"A": Listener({8000: 40}, {250: 10, 8000: 20}), "b": Listener({250: 5}, None)}
    assert read_listeners(table) == expected
    (tmp_path / "listeners.json").write_text(json.dumps({"L0001": ENTRY}))
    assert read_listeners(tmp_path / "listeners.json") == {"L0001": BOTH}
    clarity = pytest.importorskip("clarity.utils.audiogram")
    assert Listener.from_clarity(clarity.Listener.from_dict(ENTRY)) == BOTH


def test_only_the_listeners_that_are_asked_for_are_validated(tmp_path: Path) -> None:
    broken = {"audiogram_cfs": [250, 500], "audiogram_levels_l": [None, "x"]}
    files = {
        "listeners.json": json.dumps({"L0001": ENTRY, "L0002": broken}),
        "listeners.csv": "listener,ear,hl_500\nL0001,l,20\nL0001,r,30\nL0002,both,NR\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        assert list(read_listeners(tmp_path / name, ["L0001"])) == ["L0001"]
        for names in (None, ["L0002"]):
            with pytest.raises(ValueError, match=r"line 4|listener L0002.*audiogram_levels_r"):
                read_listeners(tmp_path / name, names)
        with pytest.raises(ValueError, match="no listener 'L3'; expected a name such as L0001"):
            read_listeners(tmp_path / name, ["L0001", "L3"])


def test_bad_listeners(scene: Tensor) -> None:
    for ears in ((None, None), (LEFT, "N9"), (LEFT, 3)):
        with pytest.raises(ValueError):
            Listener(*ears)
    with pytest.raises(ValueError, match=r"pass listener\.right"):
        MSBG()(scene, Listener(None, RIGHT))


BAD_FILES = {
    "a.json": "{",
    "b.json": "[]",
    "c.json": '{"L1": {}}',
    "d.json": '{"L1": []}',
    "e.json": json.dumps({"L1": {key: ENTRY[key] for key in list(ENTRY)[:3]}}),
    "f.csv": "listener,ear,hl_500\nA,both,20\n",
    "g.csv": "listener,ear,hl_500\nA,l,20\nA,left,20\n",
    "i.json": f'{{"L1": {json.dumps(ENTRY)}, "L1": {json.dumps(ENTRY)}}}',
    "h.csv": "listener,ear,hl_500\n,l,20\n",
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_errors_name_the_file_of_listeners(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(BAD_FILES[name])
    with pytest.raises(ValueError, match=name):
        read_listeners(tmp_path / name)


def test_ears_in_batches_pass_through_lightning(tmp_path: Path) -> None:
    lightning = pytest.importorskip("lightning")

    class Module(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.gain, self.ears = torch.nn.Parameter(torch.ones(1)), []

        def training_step(self, batch: Any, index: int) -> Tensor:
            speech, *ears = batch
            self.ears += ears
            return (self.gain * speech).square().mean()

        def configure_optimizers(self) -> torch.optim.Optimizer:
            return torch.optim.SGD(self.parameters())

    batch = (torch.ones(2, 100), [LEFT, RIGHT], BOTH)
    module = Module()
    trainer = lightning.Trainer(fast_dev_run=True, accelerator="cpu", default_root_dir=tmp_path)
    loader = torch.utils.data.DataLoader([batch], batch_size=None)
    trainer.fit(module, loader)
    assert module.ears == [[LEFT, RIGHT], BOTH]
    fabric = lightning.Fabric(accelerator="cpu", devices=1)
    assert next(iter(fabric.setup_dataloaders(loader)))[1:] == [[LEFT, RIGHT], BOTH]


@pytest.mark.slow
def test_bootstrap_takes_ears_as_tensors_and_refuses_lists(scene: Tensor) -> None:
    """A list of audiograms would keep its order while the signals are drawn anew."""
    wrappers = pytest.importorskip("torchmetrics.wrappers")
    from hlsim.metrics.torchmetric import HASPI

    metric = wrappers.BootStrapper(HASPI(), num_bootstraps=2)
    metric.update(scene, scene, torch.tensor([LEFT.thresholds, RIGHT.thresholds]))
    assert float(metric.compute()["mean"]) > 0.5
    with pytest.raises(ValueError, match="frozen dataclass"):
        metric.update(scene, scene, [LEFT, RIGHT])
