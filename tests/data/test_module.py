"""Batches for Lightning: on the fly and from disk alike, in an order that resumes, varied when training."""

import itertools
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("lightning")

import lightning as L

from hlsim import MSBG
from hlsim.calibration import level_spl
from hlsim.data.instances import Instance, Plan
from hlsim.data.module import Batch, BatchData, PlanData, PlanItems, PlannedBatches, Step, collate
from hlsim.data.writing import Recipe, write_instances


def close(first: torch.Tensor, second: torch.Tensor) -> float:
    return float((first - second).norm() / second.norm())


@pytest.fixture
def written(plan: Path) -> Path:
    write_instances(plan, Recipe(), jobs=1)
    return plan


def test_whole_utterances_are_the_same_both_ways(written: Path) -> None:
    fly, disk = (
        PlanData(written, prepared=prepared, workers=0, batch=3) for prepared in (False, True)
    )
    for made, read in zip(fly.test_dataloader(), disk.test_dataloader(), strict=True):
        assert "impaired" not in made
        made = fly.on_after_batch_transfer(made, 0)
        assert set(made) == set(read) == {"clean", "signal", "impaired", "thresholds", "lengths"}
        for name in ("clean", "signal", "thresholds", "lengths"):
            assert torch.equal(made[name], read[name])
        assert close(made["impaired"], read["impaired"]) < 1e-5
        assert disk.on_after_batch_transfer(read, 0)["impaired"] is read["impaired"]
    # there is no validation split: test's serves
    assert len(list(fly.val_dataloader())) == 3


def test_clips_are_the_same_places_both_ways(written: Path) -> None:
    options = {"seconds": 0.15, "augment": False, "seed": 3}
    plan = Plan(written)
    fly, disk = (
        PlannedBatches(PlanItems(plan, "train", prepared=p), **options) for p in (False, True)
    )  # type: ignore[arg-type]
    teacher = MSBG(sample_rate=16000)
    speech = [plan.instance(index).clean for index in range(0, 16, 4)]
    starts: set[int] = set()
    for place in range(16):
        made, read = fly.clip(place), disk.clip(place)
        assert made.impaired is None and read.impaired is not None
        assert torch.equal(made.signal, read.signal) and torch.equal(made.clean, read.clean)
        assert made.signal.shape == read.impaired.shape == (2400,)
        heard = teacher(made.signal, made.thresholds)
        # at either end the one from disk knows what lies beyond; and what is under 0 dB SPL is no difference
        target, error = read.impaired[800:-800], (heard - read.impaired)[800:-800]
        assert float(level_spl(error)) < max(float(level_spl(target)) - 60.0, 0.0)
        starts |= {
            s for s in (0, 10240) for x in speech if torch.equal(made.clean, x[s : s + 2400])
        }
    assert starts == {0, 10240}


def test_every_instance_comes_once_an_epoch_and_the_order_resumes(plan: Path) -> None:
    items = PlanItems(Plan(plan), "train")
    options = {"seconds": 0.2, "seed": 1}
    clips = PlannedBatches(items, augment=False, **options)  # type: ignore[arg-type]
    seen = [
        tuple(clips.clip(i).signal[:50].tolist() + clips.clip(i).thresholds.tolist())
        for i in range(16)
    ]
    ears = [clips.clip(i).thresholds.tolist() for i in range(32)]
    assert sorted(ears[:16]) == sorted(ears[16:]) and ears[:16] != ears[16:]
    assert len(set(seen)) == 16
    for augment in (False, True):
        first = PlannedBatches(items, augment=augment, **options)  # type: ignore[arg-type]
        later = PlannedBatches(items, augment=augment, batch=6, **options)  # type: ignore[arg-type]
        for i in range(6):
            assert torch.equal(first.clip(6 + i).signal, later[Step(1)]["signal"][i])
            assert torch.equal(first.clip(13 + 2 * i).signal, later[Step(1, 1, 2)]["signal"][i])
    other = PlannedBatches(items, augment=False, seconds=0.2, seed=2)
    assert [other.clip(i).thresholds.tolist() for i in range(16)] != ears[:16]


def test_training_varies_level_ear_noise_and_spectrum(plan: Path) -> None:
    items = PlanItems(Plan(plan), "train")
    varied = PlannedBatches(items, seconds=0.5, augment=True, seed=0)
    drawn = [varied.clip(i) for i in range(64)]
    levels = torch.stack([level_spl(one.signal) for one in drawn])
    assert float(levels.min()) < 55.0 and float(levels.max()) > 85.0
    assert all(
        float(level_spl(one.clean)) == pytest.approx(float(level_spl(one.signal)), abs=0.1)
        for one in drawn
    )
    planned = {tuple(Plan(plan).thresholds(i).tolist()) for i in range(16)}
    assert not planned & {tuple(one.thresholds.tolist()) for one in drawn}
    assert all(
        float(one.thresholds.min()) >= -10.0 and float(one.thresholds.max()) <= 100.0
        for one in drawn
    )
    alike = [
        float(torch.nn.functional.cosine_similarity(one.signal, one.clean, 0)) for one in drawn
    ]
    assert sum(value > 0.9999 for value in alike) > 5 and sum(value < 0.98 for value in alike) > 15
    assert all(bool(torch.isfinite(one.signal).all()) for one in drawn)


def test_what_cannot_be_read_is_left_out_while_training(plan: Path, voicebank: Path) -> None:
    bad = voicebank / "clean_trainset_28spk_wav" / "p226_001.wav"
    bad.unlink()
    clips = PlannedBatches(PlanItems(Plan(plan), "train"), seconds=0.2, augment=True, seed=0)
    with pytest.warns(UserWarning, match=r"left out: .*p226_001.wav: no such file"):
        assert len([clips.clip(i) for i in range(16)]) == 16
    for path in (voicebank / "clean_trainset_28spk_wav").iterdir():
        path.unlink()
    clips = PlannedBatches(PlanItems(Plan(plan), "train"), seconds=0.2, augment=True, seed=0)
    with (
        pytest.warns(UserWarning),
        pytest.raises(ValueError, match="8 instances in a row cannot be read"),
    ):
        clips[Step(0)]


def test_workers_give_the_same_batches_and_the_wait_is_known(plan: Path) -> None:
    batches = []
    for workers in (0, 2):
        data = PlanData(plan, workers=workers, batch=2, seconds=0.3)
        loader = data.train_dataloader()
        batches.append([batch for batch, _ in zip(loader, range(4), strict=False)])
        assert loader is data.loader and data.loader.waited > 0.0
    for first, second in zip(*batches, strict=True):
        assert first["signal"].shape == (2, 4800)
        assert torch.equal(first["signal"], second["signal"]) and torch.equal(
            first["clean"], second["clean"]
        )


class Seen(L.LightningModule):
    """Keeps the sums of its batches, which tell them apart."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.sums: list[float] = []

    def training_step(self, batch: Batch, index: int) -> torch.Tensor:
        self.sums.append(float(batch["signal"].double().sum()))
        return self.weight * batch["signal"].mean()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_epochs_and_resumed_trainings_go_on_where_the_batches_were(
    plan: Path, tmp_path: Path
) -> None:
    def fit(epochs: int, state: Path | None = None) -> tuple[list[float], L.Trainer]:
        module = Seen()
        data = PlanData(plan, workers=0, batch=2, seconds=0.1, prepared=True)
        trainer = L.Trainer(
            accelerator="cpu",
            max_epochs=epochs,
            limit_train_batches=4,
            limit_val_batches=0,
            accumulate_grad_batches=2,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            default_root_dir=str(tmp_path),
        )
        trainer.fit(module, datamodule=data, ckpt_path=state, weights_only=True)
        return module.sums, trainer

    write_instances(plan, Recipe(), jobs=1)
    whole, _ = fit(3)
    loader = PlanData(plan, workers=0, batch=2, seconds=0.1, prepared=True).train_dataloader()
    expected = [
        float(batch["signal"].double().sum()) for batch, _ in zip(loader, range(12), strict=False)
    ]
    assert whole == expected and len(set(whole)) == 12
    first, trainer = fit(2)
    trainer.save_checkpoint(tmp_path / "state.ckpt")
    assert first + fit(3, tmp_path / "state.ckpt")[0] == expected


@pytest.mark.parametrize(
    ("ready", "completed", "steps", "first"),
    [(5, 4, 5, 5), (5, 4, 4, 4), (4, 4, 2, 4), (4, 4, 8, 4), (0, 0, 0, 0)],
    ids=[
        "stored after the step of a batch",
        "before it",
        "two batches a step",
        "two steps a batch",
        "new",
    ],
)
def test_the_first_batch_is_the_one_after_the_last_step(
    ready: int, completed: int, steps: int, first: int
) -> None:
    data = BatchData([])  # type: ignore[arg-type]
    total = SimpleNamespace(ready=ready, completed=completed)
    progress = SimpleNamespace(
        epoch_loop=SimpleNamespace(batch_progress=SimpleNamespace(total=total))
    )
    data.trainer = SimpleNamespace(
        fit_loop=progress, global_step=steps, global_rank=1, world_size=2
    )
    given = itertools.islice(iter(data.train_dataloader().sampler), 2)
    assert list(given) == [(first, 1, 2), (first + 1, 1, 2)]


def test_workers_go_on_too(plan: Path) -> None:
    sums: list[list[float]] = []
    for parts in ((4,), (1, 3)):
        loader = PlanData(plan, workers=1, batch=2, seconds=0.1).train_dataloader()
        batches = [b for n in parts for b in itertools.islice(loader, n)]
        sums.append([float(batch["signal"].double().sum()) for batch in batches])
    assert sums[0] == sums[1] and len(set(sums[0])) == 4


def test_collate_pads_with_silence() -> None:
    batch = collate(
        [Instance(torch.ones(n), torch.ones(n), torch.zeros(8), torch.ones(n)) for n in (3, 5)]
    )
    assert batch["lengths"].tolist() == [3, 5]
    assert batch["impaired"].tolist() == [[1, 1, 1, 0, 0], [1, 1, 1, 1, 1]]
    assert batch["thresholds"].shape == (2, 8)


def test_prepared_instances_must_be_there(plan: Path) -> None:
    with pytest.raises(
        ValueError, match=r"no instances of this plan; 'hlsim prepare --write' makes them"
    ):
        PlanData(plan, prepared=True)
    write_instances(plan, Recipe(), jobs=1)
    Plan(plan).path(3).unlink()
    with pytest.raises(ValueError, match="1 of 24 instances missing"):
        PlanData(plan, prepared=True)
    with pytest.raises(ValueError, match="has no instances for valid"):
        PlanItems(Plan(plan), "valid")


def test_what_a_worker_cannot_read_is_said_in_a_line(plan: Path, voicebank: Path) -> None:
    for path in voicebank.rglob("*.wav"):
        path.write_bytes(b"gone")
    with pytest.raises(
        ValueError, match=r"^8 instances in a row cannot be read, the last: .*wav: not readable"
    ) as caught:
        next(iter(PlanData(plan, workers=1).train_dataloader()))
    assert len(str(caught.value).splitlines()) == 1
