"""HearingLossLoss: frozen, unregistered, per-item, finite, in float32 under autocast, and its value."""

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from compensators import NALR
from hlsim import MSBG, Audiogram, HearingLossLoss, NeuroMSBG, load_pretrained
from hlsim.calibration import set_level
from hlsim.dsp.resample import resample
from hlsim.losses.band_levels import band_level_loss
from hlsim.losses.coherent_bands import DEFAULT_WEIGHTS as COHERENT_WEIGHTS
from hlsim.losses.coherent_bands import coherent_band_parts
from hlsim.losses.paper import DEFAULT_WEIGHTS, paper_parts
from hlsim.msbg.response import apply_bank_phase
from hlsim.pretrained import find_checkpoint

SIMULATORS = ("neuro-msbg", "msbg")
CRITERIA = ("coherent-bands", "paper", "bands")
N3, N4, S2 = (Audiogram.standard(name) for name in ("N3", "N4", "S2"))

both = pytest.mark.parametrize("simulator", SIMULATORS)
each_criterion = pytest.mark.parametrize("criterion", CRITERIA)


@pytest.fixture
def clean(speech: list[tuple[Tensor, int]]) -> Tensor:
    """0.3 s of two voices at 65 dB SPL. Shape: (2, time)."""
    return set_level(torch.cat([waveform[:, 10000:14800] for waveform, _ in speech[:2]]), 65.0)


class Host(nn.Module):
    """Somebody's compensator, with or without the loss inside."""

    def __init__(self, loss: nn.Module | None = None) -> None:
        super().__init__()
        self.filter = nn.Conv1d(1, 1, 9, padding=4)
        if loss is not None:
            self.loss = loss

    def forward(self, waveform: Tensor) -> Tensor:
        heard: Tensor = waveform + self.filter(waveform.unsqueeze(1)).squeeze(1)
        return heard


def gradient(
    loss: HearingLossLoss, compensated: Tensor, clean: Tensor, *rest: object
) -> tuple[Tensor, Tensor]:
    given = compensated.detach().clone().requires_grad_()
    value = loss(given, clean, *rest)
    return value.detach(), torch.autograd.grad(value, given)[0]


def same(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> None:
    """Value and gradient of the same computation."""
    torch.testing.assert_close(second[0], first[0], rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(
        second[1], first[1], rtol=1e-4, atol=1e-4 * float(first[1].abs().max())
    )


def alike(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> None:
    """Value and direction of the gradient, in another precision: what is nearly silent moves with every rounding."""
    assert float(second[0]) == pytest.approx(float(first[0]), rel=1e-3)
    one, other = first[1].double().cpu().flatten(), second[1].double().cpu().flatten()
    assert float(torch.cosine_similarity(one, other, dim=0)) > 0.95


# Frozen


@both
def test_train_leaves_the_simulator_frozen(simulator: str) -> None:
    host = Host(HearingLossLoss(N3, simulator=simulator)).train().requires_grad_(True)
    assert host.loss.training
    assert not any(module.training for module in host.loss.simulator.modules())
    assert not any(parameter.requires_grad for parameter in host.loss.simulator.parameters())
    assert isinstance(host.loss.simulator, {"msbg": MSBG, "neuro-msbg": NeuroMSBG}[simulator])


@both
def test_host_does_not_know_the_simulator(simulator: str) -> None:
    loss = HearingLossLoss(N3, simulator=simulator)
    host, bare = Host(loss), Host()
    assert list(loss.parameters()) == [] and list(loss.buffers()) == [] and loss.state_dict() == {}
    for names in ("named_parameters", "named_buffers"):
        assert [n for n, _ in getattr(host, names)()] == [n for n, _ in getattr(bare, names)()]
    assert not any(isinstance(module, (MSBG, NeuroMSBG)) for module in host.modules())
    # a checkpoint made with the loss loads without it, and the other way round
    bare.load_state_dict(host.state_dict(), strict=True)
    host.load_state_dict(bare.state_dict(), strict=True)


@both
@each_criterion
def test_a_step_trains_the_compensator_alone(simulator: str, criterion: str, clean: Tensor) -> None:
    host = Host(HearingLossLoss(N3, simulator=simulator, criterion=criterion)).train()
    before = copy.deepcopy(host.loss.simulator.state_dict())
    optimiser = torch.optim.SGD(host.parameters(), lr=1e-3)
    value = host.loss(host(clean), clean)
    assert value.shape == ()
    value.backward()
    gradients = [parameter.grad for parameter in host.filter.parameters()]
    assert all(
        grad is not None and bool(grad.isfinite().all()) and bool(grad.any()) for grad in gradients
    )
    optimiser.step()
    assert all(parameter.grad is None for parameter in host.loss.simulator.parameters())
    after = host.loss.simulator.state_dict()
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize(
    ("criterion", "weights", "gain"),
    [("paper", {"magnitude": 0.9, "complex": 0.1, "time": 0.2}, 8.0), ("bands", None, 1.0)],
)
def test_gradient_is_that_of_the_value(
    criterion: str, weights: dict[str, float] | None, gain: float, clean: Tensor
) -> None:
    """Along a gain, by central differences in float64."""
    # without the phase, whose gradient is faded where it is faint; the weights of bands have none, but do not change
    # while everything is heard too softly
    loss = HearingLossLoss(N3, simulator="msbg", criterion=criterion, weights=weights)
    signal = clean.double()
    factor = torch.tensor(gain, dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(loss(signal * factor, signal), factor)
    ahead, behind = (float(loss(signal * g, signal)) for g in (gain + 1e-3, gain - 1e-3))
    assert float(slope) == pytest.approx((ahead - behind) / 2e-3, rel=1e-4)


@both
@each_criterion
def test_built_in_inference_mode_it_trains_later(
    simulator: str, criterion: str, clean: Tensor
) -> None:
    expected = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
    with torch.inference_mode():
        loss = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
        loss(3.0 * clean, clean)
    same(gradient(expected, 3.0 * clean, clean), gradient(loss, 3.0 * clean, clean))


# Moving, copying, compiling


@both
def test_moves_with_its_host_but_never_to_half(simulator: str, clean: Tensor) -> None:
    host = Host(HearingLossLoss(N3, simulator=simulator, criterion="bands"))
    kinds = {tensor.dtype for tensor in host.loss.simulator.state_dict().values()}
    host.to(torch.bfloat16)
    assert host.filter.weight.dtype == torch.bfloat16
    assert {tensor.dtype for tensor in host.loss.simulator.state_dict().values()} == kinds
    before = gradient(host.loss, 3.0 * clean, clean)
    host.double()
    floating = [t for t in host.loss.simulator.state_dict().values() if t.is_floating_point()]
    assert {tensor.dtype for tensor in floating} <= {torch.float64}
    value, slope = gradient(host.loss, 3.0 * clean.double(), clean.double())
    assert value.dtype == slope.dtype == torch.float64
    alike(before, (value, slope))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@both
@each_criterion
def test_cuda_is_like_the_cpu(simulator: str, criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
    before = gradient(loss, 3.0 * clean, clean)
    Host(loss).cuda()
    value, slope = gradient(loss, 3.0 * clean.cuda(), clean.cuda())
    assert value.is_cuda
    alike(before, (value, slope))
    ears = torch.tensor([N3.thresholds, N4.thresholds])  # on the CPU, as a data loader gives them
    assert bool(loss(clean.cuda(), clean.cuda(), ears).isfinite())
    loss.cpu()
    same(before, gradient(loss, 3.0 * clean, clean))


@both
@pytest.mark.parametrize("how", [copy.deepcopy, lambda loss: pickle.loads(pickle.dumps(loss))])
def test_copies_are_their_own(
    simulator: str, how: Callable[[nn.Module], Host], clean: Tensor
) -> None:
    host = Host(HearingLossLoss(N3, simulator=simulator))
    twin = how(host)
    assert twin.loss.simulator is not host.loss.simulator and list(twin.loss.parameters()) == []
    same(gradient(host.loss, 3.0 * clean, clean), gradient(twin.loss, 3.0 * clean, clean))
    twin.double()
    assert all(t.dtype != torch.float64 for t in host.loss.simulator.parameters())


@pytest.mark.slow
@both
def test_caller_can_be_compiled(simulator: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, simulator=simulator, criterion="bands")

    def step(gain: Tensor, signal: Tensor) -> Tensor:
        value: Tensor = loss((1.0 + gain).square() * signal, signal) * 0.5
        return value

    slopes = []
    for function in (step, torch.compile(step, backend="aot_eager")):
        gain = torch.tensor(0.5, requires_grad=True)
        value = function(gain, clean)
        slopes.append((value.detach(), torch.autograd.grad(value, gain)[0]))
    same(slopes[0], slopes[1])


class Halved(nn.Module):
    def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
        return 0.5 * waveform.sin()


@pytest.mark.parametrize("simulator", [*SIMULATORS, "neuro-msbg-light", Halved()])
@pytest.mark.parametrize("seconds", [0.3, 9.0])
def test_checkpoint_stores_less_and_changes_no_bit(
    simulator: str | nn.Module, seconds: float, clean: Tensor
) -> None:
    signal = clean.repeat(2, 32)[:, : round(16000 * seconds)]
    results, stored = [], []
    for checkpoint in (False, True):
        loss = HearingLossLoss([N3, S2] * 2, simulator=simulator, checkpoint=checkpoint)
        output = (3.0 * signal).requires_grad_()
        sizes: dict[int, int] = {}

        def pack(tensor: Tensor, sizes: dict[int, int] = sizes) -> Tensor:
            sizes[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            value = loss(output, signal)
        stored.append(sum(sizes.values()))
        results.append((value.detach(), torch.autograd.grad(value, output)[0]))
    assert torch.equal(results[0][0], results[1][0])
    assert torch.equal(results[0][1], results[1][1])
    if isinstance(simulator, str) and seconds < 1.0:
        assert stored[1] < 0.4 * stored[0]


def test_limited_gradient_has_no_derivative(clean: Tensor) -> None:
    for criterion in CRITERIA:
        loss = HearingLossLoss(N3, simulator=Halved(), criterion=criterion)
        output = (3.0 * clean).requires_grad_()
        (slope,) = torch.autograd.grad(loss(output, clean), output, create_graph=True)
        if criterion == "coherent-bands":
            with pytest.raises(RuntimeError, match="no second derivative"):
                torch.autograd.grad(slope.sum(), output)
        else:
            (curvature,) = torch.autograd.grad(slope.sum(), output)
            assert bool(curvature.isfinite().all())


# Audiograms


@both
def test_audiogram_in_every_form(simulator: str, clean: Tensor) -> None:
    stored = HearingLossLoss(N3, simulator=simulator, criterion="paper")
    bare = HearingLossLoss(simulator=simulator, criterion="paper")
    expected = stored(clean, clean)
    for ear in (N3, [N3, N3], torch.tensor(N3.thresholds), torch.tensor([N3.thresholds])):
        torch.testing.assert_close(bare(clean, clean, ear), expected)
        built = HearingLossLoss(ear, simulator=simulator, criterion="paper")
        torch.testing.assert_close(built(clean, clean), expected)
    # the call's comes before the stored one
    torch.testing.assert_close(stored(clean, clean, S2), bare(clean, clean, S2))
    magnitude = float(stored.parts(clean, clean)["magnitude"])
    assert float(stored.parts(clean, clean, S2)["magnitude"]) != pytest.approx(magnitude, rel=0.05)


@both
@each_criterion
def test_batch_is_the_mean_of_its_items(simulator: str, criterion: str, clean: Tensor) -> None:
    # the phase and the level of what is far from audible are rounding in float32: up to 3e-5 of the value
    loss = HearingLossLoss(simulator=simulator, criterion=criterion).double()
    signals = torch.cat((clean, 4.0 * clean.flip(-1))).double()
    aided = 3.0 * signals + 1e-4 * torch.randn(signals.shape)
    ears = torch.tensor([ear.thresholds for ear in (N3, S2, N4, Audiogram.standard("NH"))])
    items = [loss(aided[i], signals[i], ears[i]) for i in range(4)]
    assert float(loss(aided, signals, ears)) == pytest.approx(
        float(torch.stack(items).mean()), rel=1e-9
    )
    # any leading dimensions
    shape = (2, 2, -1)
    folded = loss(aided.reshape(shape), signals.reshape(shape), ears.reshape(shape))
    assert float(folded) == pytest.approx(float(torch.stack(items).mean()), rel=1e-5)


@both
def test_an_ear_can_be_trained(simulator: str, clean: Tensor) -> None:
    ear = nn.Parameter(torch.tensor(N3.thresholds))
    loss = HearingLossLoss(ear, simulator=simulator)
    loss(3.0 * clean, clean).backward()
    given = torch.tensor(N3.thresholds, requires_grad=True)
    HearingLossLoss(simulator=simulator)(3.0 * clean, clean, given).backward()
    assert ear.grad is not None and given.grad is not None and bool(ear.grad.any())
    torch.testing.assert_close(ear.grad, given.grad)
    assert list(loss.parameters()) == [] and loss.state_dict() == {}
    assert torch.equal(copy.deepcopy(loss)(3.0 * clean, clean), loss(3.0 * clean, clean))


# Padded batches


@both
@each_criterion
def test_items_that_are_as_long_as_the_batch_need_no_lengths(
    simulator: str, criterion: str, clean: Tensor
) -> None:
    loss = HearingLossLoss([N3, S2], simulator=simulator, criterion=criterion)
    expected = loss(3.0 * clean, clean)
    for lengths in ([4800, 4800], torch.tensor([4800, 4800])):
        assert torch.equal(loss(3.0 * clean, clean, lengths=lengths), expected)
    one = loss(3.0 * clean[0], clean[0], N3, lengths=torch.tensor(4800))
    assert torch.equal(one, loss(3.0 * clean[0], clean[0], N3))


@both
@each_criterion
@pytest.mark.parametrize("reference", ["clean", "normal-hearing"])
def test_a_padded_item_is_as_alone(
    simulator: str, criterion: str, reference: str, clean: Tensor
) -> None:
    loss = HearingLossLoss(
        simulator=simulator, criterion=criterion, reference=reference, reduction="none"
    ).double()
    # of next to nothing the exact model's phases depend on the length of its transforms
    ends = (4800, 4000) if simulator == "msbg" else (4800, 4000, 7800, 1600, 129, 31)
    signals = nn.functional.pad(clean.double(), (0, 3000)).repeat(len(ends) // 2, 1)
    ears = torch.tensor([N3.thresholds, S2.thresholds]).repeat(len(ends) // 2, 1)
    together = loss.parts(3.0 * signals, signals, ears, lengths=ends)
    for item, end in enumerate(ends):
        alone = loss.parts(3.0 * signals[item, :end], signals[item, :end], ears[item])
        for name, part in alone.items():
            assert float(together[name][item]) == pytest.approx(float(part), rel=2e-3), (name, end)


@both
@each_criterion
def test_what_follows_the_end_counts_for_nothing(
    simulator: str, criterion: str, clean: Tensor
) -> None:
    loss = HearingLossLoss([N3, S2], simulator=simulator, criterion=criterion)
    lengths = [4800, 3000]
    after = torch.zeros_like(clean)
    after[1, 3000:] = 1.0
    expected = gradient(loss, 3.0 * clean, clean, None, lengths)
    noisy = gradient(loss, 3.0 * clean + after, clean - after, None, lengths)
    assert torch.equal(noisy[0], expected[0]) and torch.equal(noisy[1], expected[1])
    assert not bool(expected[1][1, 3000:].any()) and bool(expected[1][1, :3000].any())
    assert float(expected[0]) != float(loss(3.0 * clean, clean))


@both
@each_criterion
def test_a_value_for_each_item(simulator: str, criterion: str, clean: Tensor) -> None:
    mean = HearingLossLoss([N3, S2], simulator=simulator, criterion=criterion)
    each = HearingLossLoss(
        [N3, S2], simulator=mean.simulator, criterion=criterion, reduction="none"
    )
    for lengths in (None, [1, 4800]):
        values = each(3.0 * clean, clean, lengths=lengths)
        assert values.shape == (2,) and values[0] != values[1]
        torch.testing.assert_close(values.mean(), mean(3.0 * clean, clean, lengths=lengths))
        parts = each.parts(3.0 * clean, clean, lengths=lengths)
        torch.testing.assert_close(
            sum(each.weights[name] * part for name, part in parts.items()), values
        )
    # one clip in two ears, and leading dimensions of two
    assert each(clean[0], clean[0], lengths=4000).shape == (2,)
    assert each(clean[:, None], clean[:, None], N3, lengths=[[4800], [99]]).shape == (2, 1)


@pytest.mark.parametrize(
    "lengths",
    [
        [4800, 0],
        torch.tensor([4801, 4800]),
        [4800],
        4800,
        [1.5, 0.5],
        [1.0, 0.0],
        [True, True],
        "long",
        [[1], [2, 3]],
    ],
)
def test_bad_lengths_raise_value_error(lengths: object, clean: Tensor) -> None:
    with pytest.raises(ValueError):
        HearingLossLoss(N3)(clean, clean, lengths=lengths)


# Criteria


@both
@each_criterion
@pytest.mark.parametrize("reference", ["clean", "normal-hearing"])
def test_parts_and_weights_make_the_value(
    simulator: str, criterion: str, reference: str, clean: Tensor
) -> None:
    loss = HearingLossLoss(N3, simulator=simulator, criterion=criterion, reference=reference)
    parts = loss.parts(2.0 * clean, clean)
    default = {"paper": DEFAULT_WEIGHTS, "bands": {"band_levels": 1.0}}.get(
        criterion, COHERENT_WEIGHTS
    )
    assert set(parts) == set(default)
    assert all(part.shape == () and float(part) >= 0.0 for part in parts.values())
    total = sum(default[name] * part for name, part in parts.items())
    torch.testing.assert_close(loss(2.0 * clean, clean), total)
    name = next(iter(parts))
    alone = HearingLossLoss(
        N3, simulator=loss.simulator, criterion=criterion, reference=reference, weights={name: 3.0}
    )
    torch.testing.assert_close(alone(2.0 * clean, clean), 3.0 * parts[name])


@each_criterion
def test_parts_can_be_trained_on(criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, criterion=criterion)
    given = (1000.0 * clean).requires_grad_()  # loud enough for all
    for name, part in loss.parts(given, clean).items():
        (slope,) = torch.autograd.grad(part, given, retain_graph=True)
        assert bool(slope.any()), name


@both
def test_what_is_heard_is_compared_with_the_reference(simulator: str, clean: Tensor) -> None:
    """In pascals, by the criteria themselves; band levels always with what a normal ear hears."""
    for reference in ("clean", "normal-hearing"):
        loss = HearingLossLoss(N3, simulator=simulator, reference=reference, criterion="paper")
        heard = loss.simulator(2.0 * clean, N3)
        normal = reference == "normal-hearing"
        aim = loss.simulator(clean, Audiogram.standard("NH")) if normal else clean
        aim = apply_bank_phase(aim, torch.tensor([N3.thresholds] * 2), 16000, normal=normal)
        for name, part in paper_parts(heard, aim).items():
            torch.testing.assert_close(loss.parts(2.0 * clean, clean)[name], part.mean(), msg=name)
        loss = HearingLossLoss(N3, simulator=simulator, criterion="bands", reference=reference)
        normal = loss.simulator(clean, Audiogram.standard("NH"))
        expected = band_level_loss(heard, normal, 16000).mean()
        torch.testing.assert_close(loss(2.0 * clean, clean), expected)
        assert float(expected) != float(band_level_loss(heard, clean, 16000).mean())


@both
@each_criterion
def test_a_normal_ear_loses_nothing(simulator: str, criterion: str, clean: Tensor) -> None:
    normal = Audiogram.standard("NH")
    loss = HearingLossLoss(
        normal, simulator=simulator, criterion=criterion, reference="normal-hearing"
    )
    # the default's normal ear is a filter, which is the exact model's to 69 dB, the network's to 55 dB
    assert float(loss(clean, clean)) < (1e-3 if criterion == "coherent-bands" else 1e-5)
    # 0 dB HL is where MSBG is linear: a gain is heard as it is
    if criterion == "bands":
        assert float(loss(clean * 10.0**0.5, clean)) == pytest.approx(10.0, abs=0.1)


@both
@pytest.mark.parametrize("reference", ["clean", "normal-hearing"])
@pytest.mark.parametrize("ear", ["NH", "N1", "N3", "N4", "S2"])
def test_speech_is_nearer_than_speech_turned_over(
    simulator: str, reference: str, ear: str, clean: Tensor
) -> None:
    """And than silence, though the banks have no linear phase: amplified by NAL-R, in each part that knows of phase."""
    audiogram = Audiogram.standard(ear)
    loss = HearingLossLoss(audiogram, simulator=simulator, reference=reference, criterion="paper")
    given = clean if ear == "NH" else NALR(audiogram)(clean)
    upright, over, silent = (loss.parts(factor * given, clean) for factor in (1.0, -1.0, 0.0))
    for name in ("phase", "complex", "time"):
        assert float(upright[name]) < 0.95 * float(over[name]), name
        assert float(upright[name]) < float(silent[name]), name


def test_a_module_of_ones_own_is_compared_as_it_is(clean: Tensor) -> None:
    class Own(nn.Module):
        def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
            return waveform

    for criterion in CRITERIA:
        own = HearingLossLoss(N3, simulator=Own(), criterion=criterion)
        assert float(own(clean, clean)) == pytest.approx(0.0, abs=1e-6), criterion

    class Around(Own):
        emulates_msbg = True

        def __init__(self) -> None:
            super().__init__()
            self.inner = MSBG(sample_rate=16000)

        def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
            heard: Tensor = self.inner(waveform, thresholds)
            return heard

    for criterion in CRITERIA:
        expected = HearingLossLoss(N3, simulator="msbg", criterion=criterion)(3.0 * clean, clean)
        found = HearingLossLoss(N3, simulator=Around(), criterion=criterion)(3.0 * clean, clean)
        torch.testing.assert_close(found, expected)


@both
@each_criterion
def test_a_prescribed_gain_is_better_than_none(
    simulator: str, criterion: str, clean: Tensor
) -> None:
    loss = HearingLossLoss(N4, simulator=simulator, criterion=criterion, reference="normal-hearing")
    assert float(loss(20.0 * clean, clean)) < float(loss(clean, clean))
    _, slope = gradient(loss, clean, clean)
    assert float((slope * clean).sum()) < 0.0  # more gain, less loss


def test_gradient_reaches_the_clean_speech_only_where_asked(clean: Tensor) -> None:
    loss = HearingLossLoss(N3, reference="normal-hearing")
    reference = clean.clone().requires_grad_()
    (slope,) = torch.autograd.grad(loss(2.0 * clean, reference), reference)
    assert bool(slope.any()) and bool(slope.isfinite().all())
    with torch.no_grad():
        assert not loss(2.0 * clean, reference).requires_grad


# Levels and rates


@both
@each_criterion
def test_full_scale_is_a_unit(simulator: str, criterion: str, clean: Tensor) -> None:
    # in double precision, for the phase of what is next to silent hangs on single precision's last bits
    clean = clean.double()
    pascals = HearingLossLoss(N3, simulator=simulator, criterion=criterion).double()
    other = HearingLossLoss(
        N3, simulator=simulator, criterion=criterion, full_scale_spl=114.0
    ).double()
    assert float(other(0.2 * clean, 0.1 * clean)) == pytest.approx(
        float(pascals(2.0 * clean, clean)), rel=1e-6
    )
    # levels matter: nothing is normalised
    assert float(pascals(0.2 * clean, 0.1 * clean)) != pytest.approx(
        float(pascals(2.0 * clean, clean)), rel=0.05
    )


@both
@each_criterion
def test_other_rates_judge_alike(simulator: str, criterion: str, clean: Tensor) -> None:
    low = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
    high = HearingLossLoss(N3, simulator=simulator, criterion=criterion, sample_rate=44100)
    faster = resample(clean, 16000, 44100)
    first, second = low.parts(3.0 * clean, clean), high.parts(3.0 * faster, faster)
    for name in set(first) - {"phase"}:
        assert float(second[name]) == pytest.approx(float(first[name]), rel=0.1), name
    value, slope = gradient(high, 3.0 * faster, faster)
    assert bool(value.isfinite()) and bool(slope.isfinite().all())


def test_above_8_khz_neuro_msbg_judges_nothing(clean: Tensor) -> None:
    """So that what the network cannot give back is no error of the compensator's."""
    loss = HearingLossLoss(N3, sample_rate=44100, criterion="paper")
    low = resample(clean, 16000, 44100)
    time = torch.arange(low.shape[-1]) / 44100.0
    whistle = 0.05 * torch.sin(2.0 * torch.pi * 12000.0 * time)
    before, after = loss.parts(low, low), loss.parts(low, low + whistle)
    for name in ("magnitude", "complex", "time"):
        assert float(after[name]) == pytest.approx(float(before[name]), rel=1e-3), name


class Wrapped(nn.Module):
    """A module around a Neuro-MSBG, which offers what the loss asks of one."""

    emulates_msbg = True
    highest_frequency = 8000.0
    needs_exact_lengths = True

    def __init__(self, inner: nn.Module) -> None:
        super().__init__()
        self.inner = inner

    def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
        heard: Tensor = self.inner(waveform, audiogram)
        return heard


def compiled(model: nn.Module) -> nn.Module:
    return torch.compile(model, backend="eager")


@pytest.mark.parametrize("wrap", [Wrapped, pytest.param(compiled, marks=pytest.mark.slow)])
def test_a_wrapped_neuro_msbg_judges_the_same_band(
    wrap: Callable[[nn.Module], nn.Module], clean: Tensor
) -> None:
    model = load_pretrained("neuro-msbg", sample_rate=44100)
    faster = resample(clean, 16000, 44100)
    expected = HearingLossLoss(N3, simulator=model, sample_rate=44100).parts(3.0 * faster, faster)
    found = HearingLossLoss(N3, simulator=wrap(model), sample_rate=44100).parts(
        3.0 * faster, faster
    )
    for name, part in expected.items():
        assert float(found[name]) == pytest.approx(float(part), rel=1e-3), name


# Hard inputs


HARD = {
    "silence": (0.0, 0.0),
    "zero gain": (0.0, 1.0),
    "silent clean": (1.0, 0.0),
    "faint": (1e-9, 1.0),
    "square wave": (1.0, 1.0),
    "130 dB SPL": (63.0, 63.0),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@both
@each_criterion
def test_hard_inputs_give_finite_values_and_gradients(
    simulator: str, criterion: str, dtype: torch.dtype, clean: Tensor
) -> None:
    loss = HearingLossLoss(simulator=simulator, criterion=criterion, reference="normal-hearing")
    ears = torch.tensor([ear.thresholds for ear in (Audiogram.standard("NH"), N3, S2)])
    square = torch.sign(torch.sin(torch.arange(1600) * 0.3 + 0.1))
    for name, (given, truth) in HARD.items():
        shape = clean[0, :1600] if name in ("zero gain", "faint", "silent clean") else square
        inputs = (given * shape).to(dtype).expand(3, -1), (truth * shape).to(dtype).expand(3, -1)
        value, slope = gradient(loss, *inputs, ears)
        assert bool(value.isfinite()) and bool(slope.isfinite().all()), name
        assert slope.dtype == dtype


@pytest.mark.parametrize("pause_spl", [None, -20.0, 10.0])
@both
@each_criterion
def test_pauses_do_not_take_the_gradient_over(
    simulator: str, criterion: str, pause_spl: float | None, clean: Tensor
) -> None:
    """Logarithm and phase have steep gradients near silence, where nobody hears anything."""
    signal = torch.cat((clean, torch.zeros(2, 8000)), -1)
    if pause_spl is not None:
        signal = signal + 10.0 ** ((pause_spl - 94.0) / 20.0) * torch.randn(signal.shape)
    loss = HearingLossLoss([N3, S2], simulator=simulator, criterion=criterion)
    _, slope = gradient(loss, 5.0 * signal, signal)
    speech, pause = slope[:, :4800].norm(), slope[:, 6400:].norm()
    assert float(speech) > 0.0 and float(pause) < 0.1 * float(speech)


@both
@each_criterion
def test_autocast_does_not_reach_inside(simulator: str, criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
    results, parts = [], []
    for autocast in (False, True):
        for given in (3.0 * clean, (3.0 * clean).bfloat16()):
            given.requires_grad_()
            with torch.autocast("cpu", dtype=torch.bfloat16, enabled=autocast):
                value = loss(given, clean)
                parts.append(loss.parts(given, clean))
            (slope,) = torch.autograd.grad(value, given)
            assert value.dtype == torch.float32 and slope.dtype == given.dtype
            results.append((value.detach(), slope))
    same(results[0], results[2])
    same(results[1], results[3])
    # without the phase: that of what is nearly silent is the input's rounding; nor what is not louder at all
    for name in set(parts[0]) - {"phase", "louder"}:
        assert float(parts[3][name]) == pytest.approx(float(parts[0][name]), rel=0.01), name


# Simulators and errors


def test_simulator_by_folder_and_as_a_module(clean: Tensor) -> None:
    expected = HearingLossLoss(N3)(2.0 * clean, clean)
    folder = find_checkpoint("neuro-msbg")
    model = load_pretrained("neuro-msbg").train().requires_grad_(True)
    for simulator in (Path("neuro-msbg"), folder, str(folder), model):
        loss = HearingLossLoss(N3, simulator=simulator)
        torch.testing.assert_close(loss(2.0 * clean, clean), expected)
    assert loss.simulator is model and not model.training
    assert not any(parameter.requires_grad for parameter in model.parameters())

    class Halved(nn.Module):
        def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
            return 0.5 * waveform

    own = HearingLossLoss(N3, simulator=Halved(), criterion="paper", weights={"time": 1.0})
    torch.testing.assert_close(own(2.0 * clean, clean), torch.tensor(0.0))


@pytest.mark.parametrize(
    "options",
    [
        {"simulator": "ear"},
        {"simulator": 3},
        {"simulator": nn.ReLU},
        {"simulator": MSBG(sample_rate=16000, aligned=False)},
        {"simulator": MSBG(sample_rate=44100)},
        {"simulator": MSBG(sample_rate=16000, full_scale_spl=120)},
        {"normal": "N0"},
        {"sample_rate": 8000},
        {"sample_rate": "16k"},
        {"full_scale_spl": 300},
        {"full_scale_spl": None},
        {"reference": "noisy"},
        {"reference": ["clean"]},
        {"reduction": "sum"},
        {"ears": "left"},
        {"criterion": "l1"},
        {"criterion": ["paper"]},
        {"criterion": nn.L1Loss},
        {"criterion": {}},
        {"criterion": {"l1": 1.0}},
        {"criterion": {"bands": -1.0}},
        {"criterion": {"bands": 0.0}},
        {"weights": 1.0},
        {"weights": {3: 1.0, "pitch": 1.0}},
        {"weights": {"levels": True}},
        {"weights": {"levels": -1.0}},
        {"weights": {"levels": float("nan")}},
        {"weights": {}},
        {"audiogram": Audiogram.standard("N7")},
        {"audiogram": torch.zeros(7)},
    ],
)
def test_bad_setting_raises_value_error(options: dict[str, Any]) -> None:
    with pytest.raises(ValueError):
        HearingLossLoss(**options)


SIGNAL = torch.randn(2, 1600)


@pytest.mark.parametrize(
    "arguments",
    [
        (SIGNAL, SIGNAL),
        (SIGNAL, SIGNAL[:, 1:], N3),
        (SIGNAL, SIGNAL[0], N3),
        (SIGNAL, SIGNAL.to("meta"), N3),
        (SIGNAL.long(), SIGNAL, N3),
        (SIGNAL[:, :0], SIGNAL[:, :0], N3),
        (SIGNAL, SIGNAL, [N3, N3, N3]),
        (SIGNAL, SIGNAL, Audiogram.standard("N7")),
        (SIGNAL, SIGNAL, 3),
    ],
)
def test_bad_call_raises_value_error(arguments: tuple[Any, ...]) -> None:
    with pytest.raises(ValueError):
        HearingLossLoss(simulator="msbg")(*arguments)


@pytest.mark.parametrize(
    "function",
    [
        lambda wave: nn.functional.pad(wave, (0, 100)),
        lambda wave: (wave, wave),
        lambda wave: wave.cfloat(),
        lambda wave: wave.mean(),
        lambda wave: wave.mean(0),
        lambda wave: wave.mean(-1),
        lambda wave: wave.expand(2, 2, -1),
    ],
)
def test_a_simulator_that_changes_the_shape_raises_value_error(
    function: Callable[[Tensor], object],
) -> None:
    class Own(nn.Module):
        def forward(self, waveform: Tensor, audiogram: Tensor) -> object:
            return function(waveform)

    with pytest.raises(ValueError):
        HearingLossLoss(N3, simulator=Own())(SIGNAL, SIGNAL)


@pytest.mark.parametrize("heard", [(4000,), (3, 4000)])
def test_own_simulator_may_broadcast_with_the_ears(heard: tuple[int, ...]) -> None:
    class Own(nn.Module):
        def forward(self, waveform: Tensor, audiogram: Tensor) -> Tensor:
            return waveform.expand(heard)

    wave = torch.randn(4000)
    loss = HearingLossLoss([N3, N4, S2], simulator=Own(), criterion="paper", weights={"time": 1.0})
    assert float(loss(wave, wave)) == 0.0


def test_a_simulator_on_another_device_raises_value_error() -> None:
    loss = HearingLossLoss(N3)
    loss.simulator.to("meta")
    with pytest.raises(ValueError):
        loss(SIGNAL, SIGNAL)


def test_a_stored_ear_is_its_own(clean: Tensor) -> None:
    given = torch.full((8,), 40.0)
    loss = HearingLossLoss(given)
    before = loss(2.0 * clean, clean)
    given.fill_(0.0)
    assert torch.equal(loss(2.0 * clean, clean), before)


@pytest.mark.slow
def test_import_and_simulator_leave_the_compiler_alone() -> None:
    code = (
        "import sys, torch, hlsim, hlsim.evaluation; hlsim.MSBG(torch.zeros(8))(torch.zeros(99)); "
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_one_ear_an_item_never_becomes_every_ear_for_every_item() -> None:
    loss, ears = (
        HearingLossLoss(simulator="msbg"),
        [Audiogram.standard("N2"), Audiogram.standard("N4")],
    )
    speech = 0.03 * torch.randn(2, 1, 2000)
    many = speech.unsqueeze(1).expand(2, 3, 1, 2000)
    with pytest.raises(ValueError):
        loss(many, many, ears)
    levels = torch.tensor([ear.thresholds for ear in ears])
    # (batch, 1, time), as conv1d has it, with one ear an item
    torch.testing.assert_close(loss(speech, speech, ears), loss(speech[:, 0], speech[:, 0], ears))
    expected = loss(speech[:, 0], speech[:, 0], ears)
    torch.testing.assert_close(loss(speech, speech, levels[:, None]), expected)
    assert bool(loss(speech[0, 0], speech[0, 0], ears).isfinite())  # one item and several ears


# Open at both ends


def test_several_criteria_of_one_hearing(clean: Tensor) -> None:
    calls = []

    class Counted(nn.Module):
        def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
            calls.append(waveform.shape)
            return 0.5 * waveform

    loss = HearingLossLoss(
        N3,
        simulator=Counted(),
        criterion={"bands": 0.1, "paper": 2.0},
        normal=lambda waveform: waveform,
    )
    value = loss(2.1 * clean, clean)
    assert len(calls) == 1
    alone = [
        HearingLossLoss(N3, simulator=Counted(), criterion=name, normal=lambda waveform: waveform)
        for name in ("bands", "paper")
    ]
    torch.testing.assert_close(
        value, 0.1 * alone[0](2.1 * clean, clean) + 2.0 * alone[1](2.1 * clean, clean)
    )
    assert set(loss.weights) == set(loss.parts(clean, clean)) == {"band_levels", *DEFAULT_WEIGHTS}


@both
def test_a_criterion_of_ones_own_gets_what_heard_gives(simulator: str, clean: Tensor) -> None:
    def own(heard: Tensor, reference: Tensor) -> Tensor:
        assert heard.shape == reference.shape and heard.ndim == 2
        return (heard - reference).square().mean(-1)

    for options in ({}, {"reference": "clean"}, {"full_scale_spl": 100.0}):
        loss = HearingLossLoss(
            [N3, S2], simulator=simulator, criterion=own, reduction="none", **options
        )
        given = (3.0 * clean).requires_grad_()
        heard, reference = loss.heard(given, clean)
        assert heard.shape == reference.shape == clean.shape and not reference.requires_grad
        torch.testing.assert_close(own(heard, reference), loss(given, clean))
        assert bool(torch.autograd.grad(heard.square().sum(), given)[0].any())
        # what follows an item's end is silent
        lengths = [4800, 3000]
        heard, reference = loss.heard(given, clean, lengths=lengths)
        assert not bool(heard[1, 3000:].any()) and not bool(reference[1, 3000:].any())
        scale = torch.tensor([1.0, 4800 / 3000])
        torch.testing.assert_close(
            own(heard, reference) * scale, loss(given, clean, lengths=lengths)
        )
    assert tuple(loss.parts(clean, clean)) == tuple(loss.weights) == ("criterion",)


def test_the_default_compares_what_heard_gives(clean: Tensor) -> None:
    loss = HearingLossLoss([N3, S2], full_scale_spl=100.0, reduction="none")
    parts = coherent_band_parts(*loss.heard(3.0 * clean, clean), 16000)
    found = loss.parts(3.0 * clean, clean)
    for name, part in parts.items():
        torch.testing.assert_close(found[name], part)


@pytest.mark.parametrize("returned", [torch.zeros(()), torch.zeros(3), 0.5])
def test_a_criterion_that_gives_no_value_an_item(returned: object, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, criterion=lambda heard, reference: returned)
    with pytest.raises(ValueError):
        loss(clean, clean)


@each_criterion
def test_relative_lengths_are_shares_of_the_longest(criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss([N3, S2], criterion=criterion)
    expected = loss(3.0 * clean, clean, lengths=[4800, 3000])
    for lengths in (torch.tensor([1.0, 0.625]), [1.0, 0.625], torch.tensor([1.0, 0.625]).double()):
        assert torch.equal(loss(3.0 * clean, clean, lengths=lengths), expected)
    one = loss(3.0 * clean[:, None], clean[:, None], lengths=torch.tensor([1.0, 0.625]))
    torch.testing.assert_close(one, expected)


class DeadRegion(nn.Module):
    """A linear attenuation, and nothing from an edge up, which is a parameter of the listener."""

    def forward(self, waveform: Tensor, thresholds: Tensor, edge: Tensor) -> Tensor:
        time = waveform.shape[-1]
        hz = torch.fft.rfftfreq(time, 1.0 / 16000)
        return torch.fft.irfft(torch.fft.rfft(waveform) * (hz < edge.unsqueeze(-1)), time)


@pytest.mark.parametrize("criterion", ["coherent-bands", "bands"])
def test_a_listener_is_more_than_an_audiogram(criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss(
        N3,
        simulator=DeadRegion(),
        criterion=criterion,
        reduction="none",
        normal=lambda waveform: waveform,
    )
    whole = {"edge": torch.tensor([1e5, 1e5])}
    assert loss(clean, clean, listener=whole).tolist() == pytest.approx([0.0, 0.0], abs=1e-4)
    first, second = loss(clean, clean, listener={"edge": torch.tensor([1e5, 2000.0])})
    assert float(first) == pytest.approx(0.0, abs=1e-4) and float(second) > 0.01
    heard, _ = loss.heard(clean, clean, listener=whole)
    torch.testing.assert_close(heard, clean)


def test_a_simulator_brings_its_normal_ear(clean: Tensor) -> None:
    low = DeadRegion()

    class Dull(nn.Module):
        def forward(self, waveform: Tensor, thresholds: Tensor) -> Tensor:
            return low(waveform, thresholds, torch.tensor(2000.0))

    # asked itself, it takes the speech over 2 kHz off the reference, too
    assert float(HearingLossLoss(N3, simulator=Dull())(clean, clean)) == pytest.approx(
        0.0, abs=1e-6
    )
    ear = nn.Conv1d(1, 1, 1)
    loss = HearingLossLoss(N3, simulator=Dull(), normal=nn.Identity())
    assert float(loss(clean, clean)) > 0.1
    assert HearingLossLoss(N3, normal=ear).normal is ear and not ear.weight.requires_grad
    assert list(HearingLossLoss(N3, normal=ear).parameters()) == []
    copied = copy.deepcopy(HearingLossLoss(N3, normal=ear)).double()
    assert copied.normal.weight.dtype == torch.float64 and ear.weight.dtype == torch.float32
    # a network of another teacher: its normal ear, given, has a phase of its own, not MSBG's
    perfect = copy.deepcopy(load_pretrained("neuro-msbg"))
    perfect.forward = lambda waveform, _: waveform * 1.0
    for criterion in ("paper", lambda heard, aim: (heard - aim).square().mean(-1)):
        learned = HearingLossLoss(
            N4, simulator=perfect, normal=nn.Identity(), criterion=criterion, reference="clean"
        )
        assert float(learned(clean, clean)) == pytest.approx(0.0, abs=1e-6)
    broken = HearingLossLoss(N3, normal=lambda waveform: waveform[..., 1:])
    with pytest.raises(ValueError):
        broken(clean, clean)


# The default


def at_snr(clean: Tensor, snr: float) -> Tensor:
    noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))
    return clean + noise * clean.square().mean(-1, keepdim=True).sqrt() * 10.0 ** (-snr / 20.0)


@both
@pytest.mark.parametrize("ear", ["N2", "N4", "S2"])
@pytest.mark.parametrize("gain", [0.0, 0.5, 1.0])
def test_less_noise_is_nearer_however_soft(
    simulator: str, ear: str, gain: float, clean: Tensor
) -> None:
    """Unaided, too, where noise fills the bands that are too soft."""
    audiogram = Audiogram.standard(ear)
    prescription = NALR(audiogram)
    loss = HearingLossLoss(audiogram, simulator=simulator)
    costs = []
    for snr in (100.0, 20.0, 10.0, 0.0, -5.0):
        noisy = at_snr(clean, snr)
        costs.append(float(loss((1.0 - gain) * noisy + gain * prescription(noisy), clean)))
    assert costs == sorted(costs) and costs[0] < costs[1]


@both
@pytest.mark.parametrize("ear", ["N1", "N3", "S2"])
def test_sign_and_a_millisecond_cost_less_than_noise(
    simulator: str, ear: str, clean: Tensor
) -> None:
    audiogram = Audiogram.standard(ear)
    loss = HearingLossLoss(audiogram, simulator=simulator)
    longer = nn.functional.pad(clean, (200, 200))
    aided = NALR(audiogram)
    noise, sign, delayed = (
        float(loss(aided(given), longer))
        for given in (at_snr(longer, 20.0), -longer, longer.roll(16, -1))
    )
    assert max(sign, delayed) < noise


def test_ears_and_levels_count_alike(clean: Tensor) -> None:
    """The gradient on eight band gains, from no gain."""
    hz = torch.fft.rfftfreq(clean.shape[-1], 1.0 / 16000)
    bands = torch.bucketize(
        hz, torch.tensor([354.0, 707.0, 1414.0, 2449.0, 3464.0, 4899.0, 6928.0])
    )
    slopes = []
    for ear, spl in [(f"N{i}", 65.0) for i in range(1, 6)] + [("N3", 50.0), ("N3", 80.0)]:
        gains = torch.zeros(8, requires_grad=True)
        speech = set_level(clean, spl)
        spectrum = torch.fft.rfft(speech) * 10.0 ** (gains[bands] / 20.0)
        HearingLossLoss(Audiogram.standard(ear))(
            torch.fft.irfft(spectrum, clean.shape[-1]), speech
        ).backward()
        slopes.append(float(gains.grad.norm()))
    assert max(slopes) < 5.0 * min(slopes)


@both
def test_the_gradient_is_zero_only_where_the_reference_is(simulator: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, simulator=simulator)
    for signal in (1e-4 * clean, clean[:, :40], clean[:, :1] + 0.01, 1e-7 * clean):
        value, slope = gradient(loss, signal, signal)
        assert bool(value.isfinite()) and bool(slope.isfinite().all()) and bool(slope.any())


@both
def test_no_sample_takes_the_gradient_over(
    simulator: str, speech: list[tuple[Tensor, int]]
) -> None:
    clean = torch.cat([waveform[:, 8000:24000] for waveform, _ in speech[:2]])
    for ear in ("N1", "N3", "N4"):
        loss = HearingLossLoss(Audiogram.standard(ear), simulator=simulator)
        for spl in (40.0, 65.0, 100.0):
            speech = set_level(clean, spl)
            _, slope = gradient(loss, NALR(Audiogram.standard(ear))(speech), speech)
            assert bool((slope.abs().amax(-1) < 100.0 * slope.abs().median(-1).values).all())


@both
@each_criterion
def test_torch_func_gives_the_same_gradients(simulator: str, criterion: str, clean: Tensor) -> None:
    loss = HearingLossLoss(N3, simulator=simulator, criterion=criterion)
    compensated = 3.0 * clean
    for argument, leaf in enumerate((compensated, clean)):
        signals = [compensated, clean]
        signals[argument] = leaf.clone().requires_grad_()
        (expected,) = torch.autograd.grad(loss(*signals), signals[argument])
        found = torch.func.grad(loss, argnums=argument)(compensated, clean)
        torch.testing.assert_close(found, expected)


@pytest.mark.slow
def test_a_program_without_breaks_cannot_hold_the_loss(clean: Tensor) -> None:
    loss = HearingLossLoss(N3)
    with pytest.raises(RuntimeError):
        torch.compile(lambda wave: loss(wave, clean), backend="eager", fullgraph=True)(clean)


def test_a_criterion_without_weight_is_not_computed() -> None:
    loss = HearingLossLoss(N3, criterion={"coherent-bands": 1.0, "haspi": 0.0})
    assert list(loss.criteria) == ["coherent-bands"]
    assert not loss.state_dict()
