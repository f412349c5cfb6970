"""The torchmetrics against the functions, alone and in a validation loop of Lightning."""

import math
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim.audio import read_audio
from hlsim.audiogram import Audiogram
from hlsim.audiogram.thresholds import as_thresholds

pytest.importorskip("torchmetrics")

import hlsim.metrics
from hlsim.metrics import HAAQI, HASPI, HASQI, MBSTOI, mbstoi
from tests.helpers import default_type, mostly_slow

N3, S2 = Audiogram.standard("N3"), Audiogram.standard("S2")


def expected_score(
    clean: Tensor, output: Tensor, ear: Audiogram, *, name: str = "haspi", **options: Any
) -> float:
    function = getattr(hlsim.metrics, name)
    return float(function(output.double(), clean.double(), ear, **options))


def compute_quickly(
    highest: float,
    output: Tensor,
    clean: Tensor,
    audiogram: Any,
    lengths: Any = None,
    sample_rate: int = 16000,
    **settings: Any,
) -> Tensor:
    """Compute a score that depends on the difference of the signals and on the mean threshold."""
    time = clean.shape[-1]
    ends = torch.tensor([time] if lengths is None else lengths)
    if int(ends.min()) < 0.7 * sample_rate:
        raise ValueError("too short")
    is_signal = torch.arange(time) < ends.reshape(-1, *[1] * (clean.ndim - 1))
    error = ((output - clean) * is_signal).square().sum(-1)
    ratio = error / (clean * is_signal).square().sum(-1)
    return highest / (1.0 + ratio + as_thresholds(audiogram).mean(-1) / 100.0)


@pytest.fixture
def quick_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace HASPI and HASQI, which take most of the time, where any score will do."""
    for kind, name, highest in ((HASPI, "haspi", 1.0), (HASQI, "hasqi", 0.5)):
        score = partial(compute_quickly, highest)
        monkeypatch.setattr(kind, "score", staticmethod(score))
        monkeypatch.setattr(hlsim.metrics, name, score)


@pytest.fixture(scope="module")
def clean(speech_dir: Path) -> Tensor:
    """Two clips of 0.72 s at 16 kHz, (2, time)."""
    clips = [
        read_audio(speech_dir / "train" / f"flite-slt-0{i}.flac")[0][0, 16000:27520] for i in (1, 2)
    ]
    return torch.stack(clips)


def noisy(clean: Tensor) -> Tensor:
    return clean + 0.003 * torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("kind", "name", "full_scale"),
    [
        (HASPI, "haspi", 94.0),
        pytest.param(HASQI, "hasqi", 96.0, marks=pytest.mark.slow),
        pytest.param(HAAQI, "haaqi", 96.0, marks=pytest.mark.slow),
    ],
)
def test_the_mean_of_the_functions_scores(
    clean: Tensor, kind: type[Any], name: str, full_scale: float
) -> None:
    metric, outputs = kind(full_scale_spl=full_scale), noisy(clean)
    metric.update(outputs, clean, [N3, S2])
    metric.update(outputs[0], clean[0], N3)
    expected = [
        expected_score(x, y, ear, name=name, full_scale_spl=full_scale)
        for x, y, ear in zip(clean, outputs, (N3, S2), strict=True)
    ]
    mean = (2.0 * expected[0] + expected[1]) / 3
    assert float(metric.compute()) == pytest.approx(mean, abs=1e-6)
    levels = [full_scale + 10 * float(x.square().mean().log10()) for x in outputs]
    assert float(metric.level) == pytest.approx((2.0 * levels[0] + levels[1]) / 3, abs=1e-3)
    metric.reset()
    assert int(metric.count) == 0
    metric.update(noisy(clean)[:1].requires_grad_(), clean[:1], torch.tensor([N3.levels]))
    assert float(metric.compute()) == pytest.approx(expected[0], abs=1e-6)


@pytest.mark.usefixtures("quick_scores")
def test_the_better_ear_of_two_channels_counts(clean: Tensor) -> None:
    both = torch.stack([clean[0], clean[0]])[None]
    output = torch.stack([noisy(clean)[0], 3.0 * noisy(clean)[0]])[None]  # (batch, 2, time)
    scores = [expected_score(clean[0], output[0, i], ear) for i, ear in enumerate((N3, S2))]
    for ears in ([N3, S2], torch.tensor([[N3.levels, S2.levels]])):
        metric = HASPI(16000)
        metric.update(output, both, ears)
        assert float(metric.compute()) == pytest.approx(max(scores), abs=1e-6)
    for wrong in (N3, [N3], torch.zeros(2, 8, 1)):
        with pytest.raises(ValueError, match=r"thresholds|audiogram"):
            metric.update(output, both, wrong)


def test_mbstoi_scores_both_ears_of_an_item_together(clean: Tensor) -> None:
    from torchmetrics import MetricCollection

    both = torch.stack([clean, 0.7 * clean.roll(6, -1)], 1)  # (batch, 2, time)
    output = noisy(both)
    output[0, :, 11000:] = 0.1  # padding
    metric = MBSTOI(full_scale_spl=100.0)
    metric.update(output, both, lengths=[11000, 11520])
    metric.update(output[1], both[1])
    items = [(0, 11000), (1, 11520), (1, 11520)]
    pairs = [(output[i, :, :n].double(), both[i, :, :n].double()) for i, n in items]
    expected = [float(mbstoi(x, y)) for x, y in pairs]
    assert float(metric.compute()) == pytest.approx(sum(expected) / 3, abs=1e-6)
    levels = [100.0 + 10.0 * float(x.square().mean().log10()) for x, _ in pairs]
    assert float(metric.level) == pytest.approx(sum(levels) / 3, abs=1e-3)
    both[0] = 0.0
    with pytest.warns(UserWarning, match="MBSTOI leaves out item 3: clean is silent at both ears"):
        metric.update(output, both)
    assert (int(metric.count), int(metric.failed)) == (4, 1)
    collection = MetricCollection([HASPI(), MBSTOI()])
    values = collection(output[1:], both[1:], audiogram=[N3, N3])
    assert float(values["MBSTOI"]) == pytest.approx(expected[1], abs=1e-6)
    with pytest.raises(ValueError, match="takes no audiogram"):
        MBSTOI(audiogram="N3")
    with pytest.raises(ValueError, match="two ears"):
        metric.update(clean[0], clean[0])


@pytest.mark.usefixtures("quick_scores")
def test_limit_and_lengths(clean: Tensor) -> None:
    metric = HASPI(16000, limit=1)
    padded = torch.nn.functional.pad(clean, (0, 4000))
    for _ in range(2):
        metric.update(padded, padded, torch.tensor(N3.levels), lengths=torch.tensor([11520, 11520]))
    assert int(metric.count) == 1 and int(metric.seen) == 4
    metric.update(padded, padded, N3, lengths=torch.tensor([15520, 11520]))
    assert int(metric.seen) == 6
    assert float(metric.compute()) == pytest.approx(
        expected_score(clean[0], clean[0], N3), abs=1e-6
    )


@pytest.mark.usefixtures("quick_scores")
def test_a_call_is_an_update_and_returns_the_mean_of_its_batch(clean: Tensor) -> None:
    updated, called = HASPI(16000, limit=2), HASPI(16000, limit=2)
    values = []
    for batch in (noisy(clean)[:1], clean[:1], noisy(clean)[:1]):
        updated.update(batch, clean[:1], N3)
        values.append(float(called(batch, clean[:1], N3)))
        assert values[-1] == pytest.approx(float(called._forward_cache), nan_ok=True)  # Lightning
    assert int(called.count) == int(updated.count) == 2
    torch.testing.assert_close(called.compute(), updated.compute())
    assert sum(values[:2]) / 2 == pytest.approx(float(called.compute()), abs=1e-6)
    assert math.isnan(values[2])


@pytest.mark.usefixtures("quick_scores")
def test_a_collection_does_not_merge_different_metrics(clean: Tensor) -> None:
    from torchmetrics import MetricCollection

    collection = MetricCollection({"haspi": HASPI(), "hasqi": HASQI(), "one": HASPI(limit=1)})
    with pytest.warns(UserWarning, match="leaves out item 0"):
        collection.update(clean[:1, :8000], clean[:1, :8000], N3)  # no score: all states are equal
    collection.reset()
    collection.update(noisy(clean), clean, [N3, S2])
    expected = [HASPI(), HASQI(), HASPI(limit=1)]
    for metric in expected:
        metric.update(noisy(clean), clean, [N3, S2])
    values = [metric.compute() for metric in expected]
    torch.testing.assert_close(list(collection.compute().values()), values)
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("agg")
    assert len(collection.plot()) == 3
    collection["haspi"].merge_state(expected[0])
    assert int(collection["haspi"].count) == 4
    torch.testing.assert_close(collection["haspi"].compute(), values[0])


def test_items_without_a_score_are_left_out_with_a_warning(clean: Tensor) -> None:
    metric = HASPI(16000)
    for spoiled, reason in (
        ((clean[0] * 0, clean[0]), ".*is silent"),
        ((clean[0], clean[0] / 0), "output has samples that are NaN"),
    ):
        metric.reset()
        reference, output = (torch.stack([signal, clean[1]]) for signal in spoiled)
        with pytest.warns(UserWarning, match=f"HASPI leaves out item 0: {reason}"):
            metric.update(output, reference, N3)
        assert (int(metric.failed), int(metric.count)) == (1, 1)
        expected = expected_score(clean[1], clean[1], N3)
        assert float(metric.compute()) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("kind", mostly_slow([HASPI, HASQI, HAAQI], [HASPI]))
def test_an_item_with_one_broken_ear_is_left_out(clean: Tensor, kind: type[Any]) -> None:
    """Otherwise the score of the other ear would hide an output that diverges."""
    output, reference = (clean[0].repeat(3, 2, 1) for _ in range(2))
    output[0, 0, 100] = torch.nan
    reference[1, 1] = 0.0
    metric = kind()
    with pytest.warns(UserWarning) as warnings:
        metric.update(output, reference, [N3, N3])
    messages = [str(warning.message) for warning in warnings]
    assert all(f"leaves out item {item}" in messages[item] for item in (0, 1)), messages
    assert (int(metric.failed), int(metric.count)) == (2, 1)


@pytest.mark.usefixtures("quick_scores")
def test_signals_that_the_functions_accept(clean: Tensor) -> None:
    """One channel for each item, and lengths that differ by less than 0.1 s."""
    expected = HASPI()(noisy(clean), clean, N3, lengths=[11520, 11420])
    with_channel = HASPI()(noisy(clean)[:, None], clean[:, None], N3, lengths=[11520, 11420])
    torch.testing.assert_close(with_channel, expected)
    longer = torch.nn.functional.pad(clean, (0, 100))
    with pytest.warns(UserWarning, match="both are cut to the shorter length"):
        cut = HASPI()(noisy(clean), longer, N3, lengths=[11620, 11420])
    torch.testing.assert_close(cut, expected)


@pytest.mark.usefixtures("quick_scores")
def test_an_audiogram_for_all_batches(clean: Tensor) -> None:
    from torchmetrics.wrappers import MultitaskWrapper

    expected = HASPI()(noisy(clean), clean, N3)
    tasks = MultitaskWrapper({"speech": HASPI(audiogram=N3)})
    tasks.update({"speech": noisy(clean)}, {"speech": clean})
    torch.testing.assert_close(tasks.compute()["speech"], expected)
    torch.testing.assert_close(HASPI(audiogram="S2")(noisy(clean), clean, N3), expected)
    with pytest.raises(ValueError, match="expected an audiogram"):
        HASPI().update(clean, clean)


@pytest.mark.usefixtures("quick_scores")
def test_states_of_other_settings_are_not_merged(clean: Tensor) -> None:
    metric = HASPI(audiogram=N3)
    metric.update(clean[:1], clean[:1])
    metric.merge_state(HASPI(audiogram="N3").metric_state)
    assert int(metric.count) == 1
    settings = {"sample_rate": 44100}, {"audiogram": S2}, {"limit": 1}
    metrics = [HASPI(**{"audiogram": N3, **setting}) for setting in settings]
    for other in (*metrics, HASQI(audiogram=N3), {"total": torch.tensor(1.0)}):
        with pytest.raises(ValueError, match="with the settings of this metric"):
            metric.merge_state(other)
    for other in metrics:
        other.persistent(True)
        with pytest.raises(ValueError, match="with the settings of this metric"):
            metric.load_state_dict(other.state_dict())


@pytest.mark.usefixtures("quick_scores")
@pytest.mark.parametrize("is_built_so", [True, False])
def test_sums_are_not_in_half_precision(clean: Tensor, is_built_so: bool) -> None:
    with default_type(torch.bfloat16 if is_built_so else torch.float32):
        metric = HASPI(audiogram=N3)
    if not is_built_so:
        torch.nn.ModuleList([metric]).to(torch.bfloat16)
    metric.update(noisy(clean), clean)
    expected = HASPI(audiogram=N3)(noisy(clean), clean)
    torch.testing.assert_close(metric.compute(), expected, rtol=1e-6, atol=0.0)


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_options_of_torchmetrics() -> None:
    with pytest.raises(ValueError, match="dist_sync_on_step=True is not supported"):
        HASPI(dist_sync_on_step=True)
    for kind in (HASPI, HASQI, HAAQI, MBSTOI):
        torch.jit.script(kind())


def test_silence_in_place_of_speech_counts(clean: Tensor) -> None:
    """Otherwise an aid that mutes difficult items would have the best mean."""
    metric = HASPI(16000)
    metric.update(clean * torch.tensor([[0.0], [1.0]]), clean, N3)
    assert (int(metric.failed), int(metric.count)) == (0, 2)


def test_bad_arguments_raise_value_error() -> None:
    noise = torch.randn(2, 12800)
    for update in (
        {"clean": noise[:1]},
        {"output": noise.short()},
        {"audiogram": [N3]},
        {"lengths": torch.tensor([12801, 12800])},
    ):
        with pytest.raises(ValueError):
            HASPI().update(**{"output": noise, "clean": noise, "audiogram": N3, **update})
    for settings in ({"limit": 0}, {"full_scale_spl": math.inf}, {"sample_rate": 8000}):
        with pytest.raises(ValueError):
            HASPI(**settings)


@pytest.mark.slow
@pytest.mark.usefixtures("quick_scores")
def test_in_a_lightning_validation_loop(clean: Tensor, tmp_path: Path) -> None:
    lightning = pytest.importorskip("lightning")

    class Amplifier(lightning.LightningModule):
        def __init__(self) -> None:
            super().__init__()
            self.haspi = HASPI(16000)

        def validation_step(self, batch: list[Tensor], _: int) -> None:
            self.haspi.update(4.0 * batch[0], batch[0], N3)
            self.log("haspi", self.haspi, on_epoch=True)

    loader = torch.utils.data.DataLoader(torch.utils.data.TensorDataset(clean), batch_size=1)
    trainer = lightning.Trainer(accelerator="cpu", logger=False, default_root_dir=tmp_path)
    model = Amplifier()
    expected = sum(expected_score(clean[i], 4.0 * clean[i], N3) for i in range(2)) / 2
    for _ in range(2):  # epochs
        (values,) = trainer.validate(model, loader, verbose=False)
        assert values["haspi"] == pytest.approx(expected, abs=1e-6)
    # The checkpoint does not contain the metric.
    assert not model.state_dict()
