"""Modules stay on the device of their input and do not make the host wait, on a pretended GPU."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from compensators import WDRC, MappingCompensator, load_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained, torchtools
from hlsim.metrics import haaqi, haspi, hasqi, mbstoi
from hlsim.metrics.ear import model as ear_model
from tests.helpers import mostly_slow
from tests.pretend_device import DEVICE, PretendDevice, PretendTensor


@pytest.fixture(autouse=True)
def constants_on_the_pretended_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute constants in this thread, which has the device, and not in the shared cache."""
    monkeypatch.setattr(
        torchtools, "without_modes", lambda function, *args, **kwargs: function(*args, **kwargs)
    )
    monkeypatch.setattr(torchtools, "_RESULTS", OrderedDict())
    # so small that two items need several groups of channels
    monkeypatch.setattr(ear_model, "GPU_CHUNK", 2**19)


EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("N1", "N3", "NH", "N1")])
LENGTHS = [12000, 11500]
N3 = Audiogram.standard("N3")


class Call(NamedTuple):
    """A call of a module that is compared between devices.

    Attributes:
        build: Function that returns the module on the CPU.
        call: Function of the module, output and clean speech (4, time), and ears (4, 8).
        waits: Number of times that the host may wait for the device.
        samples: Duration of the signals.
    """

    build: Callable[[], nn.Module]
    call: Callable[[Any, Tensor, Tensor, Tensor], Tensor]
    waits: int = 0
    samples: int = 2000


def simulate(module: Any, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, ears)


def simulate_own_ear(module: Any, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave)


def compare(module: Any, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, clean, ears)


def compare_for_own_ear(module: Any, wave: Tensor, clean: Tensor, ears: Tensor) -> Tensor:
    return module(wave, clean)


def in_pairs(call: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return a call with signals and ears of two listeners with two ears each."""
    return lambda module, *tensors: call(module, *(x.unflatten(0, (2, 2)) for x in tensors))


def score(measure: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Return a call that scores the first two items."""
    return lambda module, *tensors: measure(*(x[:2] for x in tensors), lengths=LENGTHS)


CALLS: dict[str, Call] = {
    # the exact model reads the severity of ears that it does not know from the CPU
    "msbg": Call(partial(MSBG, sample_rate=16000), simulate, waits=1),
    "msbg, ears on the host": Call(
        partial(MSBG, sample_rate=16000), lambda module, wave, *_: module(wave, EARS)
    ),
    "msbg, own ear": Call(partial(MSBG, N3, sample_rate=16000), simulate_own_ear),
    "msbg, late, own ear": Call(
        partial(MSBG, N3, aligned=False, rescale_active=True), simulate_own_ear
    ),
    "loss through msbg": Call(partial(HearingLossLoss, simulator="msbg"), compare, waits=1),
    "interaural loss": Call(partial(HearingLossLoss, criterion="interaural"), in_pairs(compare)),
    "mapping": Call(MappingCompensator, simulate),
    "linked wdrc": Call(partial(WDRC, linked=True), in_pairs(simulate)),
}
# the number of waits does not depend on the number of items, except for MBSTOI
CALLS["haspi"] = Call(nn.Identity, score(haspi), waits=6, samples=12000)
CALLS["hasqi"] = Call(nn.Identity, score(hasqi), waits=5, samples=12000)
CALLS["haaqi"] = Call(nn.Identity, score(haaqi), waits=5, samples=12000)
CALLS["mbstoi"] = Call(
    nn.Identity,
    in_pairs(lambda module, wave, clean, ears: mbstoi(wave, clean)),
    waits=5,
    samples=12000,
)
for name in ("neuro-msbg", "neuro-msbg-mamba", "neuro-msbg-transformer"):
    CALLS[name] = Call(partial(load_pretrained, name), simulate)
for name in ("nalr", "wdrc", "hearing-aid", "compensator-general"):
    CALLS[name] = Call(partial(load_compensator, name), simulate)
for criterion in ("coherent-bands", "bands", "paper"):
    CALLS[f"loss {criterion}"] = Call(partial(HearingLossLoss, criterion=criterion), compare)
for simulator in ("msbg", "neuro-msbg"):
    CALLS[f"loss through {simulator}, own ear"] = Call(
        partial(HearingLossLoss, N3, simulator=simulator), compare_for_own_ear
    )
CALLS["loss with checkpoint, own ear"] = Call(
    partial(HearingLossLoss, N3, checkpoint=True), compare_for_own_ear
)


def value_and_gradient(call: Call, module: nn.Module, *tensors: Tensor) -> tuple[Tensor, Tensor]:
    wave, clean, ears = tensors
    wave = wave.clone().requires_grad_()
    value = call.call(module, wave, clean, ears)
    value.square().sum().backward()
    assert wave.grad is not None
    return value.detach(), wave.grad


# each kind of module once; the others are slow
FAST = [
    "msbg",
    "neuro-msbg",
    "nalr",
    "hearing-aid",
    "loss coherent-bands",
    "loss through msbg",
]


@pytest.mark.parametrize("name", mostly_slow(CALLS, FAST))
def test_module_keeps_to_its_device_and_does_not_wait(name: str) -> None:
    call = CALLS[name]
    torch.manual_seed(0)
    module = call.build()
    signals = 0.02 * torch.randn(2, 4, call.samples)
    # two unlike ears of a pair, or differences between the ears would be next to nothing
    signals[0, 1::2] += 0.5 * signals[0, 0::2]
    on_cpu = value_and_gradient(call, module, *signals, EARS)
    with PretendDevice() as device:
        module.to(DEVICE)
        tensors = [tensor.to(DEVICE) for tensor in (*signals, EARS)]
        if "own ear" in name:  # which the first call moves to the device
            value_and_gradient(call, module, *tensors)
        device.waits.clear()
        on_device = value_and_gradient(call, module, *tensors)
        assert device.waits.total() == call.waits, device.waits
    for result, expected, tolerance in zip(on_device, on_cpu, (1e-4, 1e-2), strict=True):
        assert isinstance(result, PretendTensor)
        assert (result.inner - expected).norm() <= tolerance * expected.norm()


class Operations(TorchDispatchMode):
    """The operations in a context, with the shapes of their results."""

    def __init__(self) -> None:
        super().__init__()
        self.log: list[tuple[str, list[torch.Size]]] = []

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        tensors = [leaf for leaf in tree_leaves(result) if isinstance(leaf, Tensor)]
        self.log.append((str(func), [tensor.shape for tensor in tensors]))
        return result


@pytest.mark.parametrize(
    "name",
    mostly_slow(
        ["loss through msbg, own ear", "loss through neuro-msbg, own ear", "hearing-aid"],
        ["loss through neuro-msbg, own ear"],
    ),
)
def test_operations_and_shapes_do_not_depend_on_the_signal(name: str) -> None:
    """A CUDA graph replays the operations that it captured, in the memory that it captured."""
    call = CALLS[name]
    module = call.build()
    logs = []
    with PretendDevice() as device:
        module.to(DEVICE)
        ears = EARS.to(DEVICE)
        for scale in (0.02, 0.02, 1.0, 0.0):
            signals = (scale * torch.randn(2, 4, call.samples)).to(DEVICE)
            device.waits.clear()
            with Operations() as operations:
                value_and_gradient(call, module, *signals, ears)
            logs.append(operations.log)
            waits = device.waits.total()
    assert waits == 0 and logs[1] == logs[2] == logs[3]  # the first call computes the constants


def test_ears_on_a_device_that_are_out_of_range_give_nan() -> None:
    wave, ears = 0.02 * torch.randn(2, 4000), EARS[:2].clone()
    ears[1, 3] = 130.0
    with PretendDevice():
        for module in (load_pretrained("neuro-msbg"), *map(load_compensator, ("nalr", "wdrc"))):
            output = module.to(DEVICE)(wave.to(DEVICE), ears.to(DEVICE)).inner
            assert output[0].isfinite().all() and output[1].isnan().all()
        with pytest.raises(ValueError, match="outside this range"):
            MSBG(sample_rate=16000)(wave.to(DEVICE), ears.to(DEVICE))


def test_an_ear_that_changes_in_place_counts_as_changed() -> None:
    wave, ear = 0.02 * torch.randn(1, 4000), EARS[0].clone()
    simulator = MSBG(sample_rate=16000)
    with PretendDevice():
        first = simulator(wave.to(DEVICE), ear)
        ear += 30.0
        second = simulator(wave.to(DEVICE), ear)
    torch.testing.assert_close(second.inner, simulator(wave, ear))
    assert not torch.equal(first.inner, second.inner)


def test_the_pretended_device_refuses_tensors_of_the_cpu_and_counts_waits() -> None:
    with PretendDevice() as device:
        tensor = torch.arange(3.0, device=DEVICE)
        with pytest.raises(RuntimeError, match="the same device"):
            tensor + torch.ones(3)
        assert device.waits.total() == 0
        waiting: list[Callable[[], Any]] = [
            lambda: float(tensor.sum()),
            lambda: bool((tensor > 0.0).all()),
            tensor.tolist,
            tensor.cpu,
            lambda: tensor[tensor > 0.0],
            lambda: tensor[[0, 2]],
            lambda: torch.ones(3).to(DEVICE),
        ]
        for count, action in enumerate(waiting, start=1):
            action()
            assert device.waits.total() == count, device.waits
        torch.ones(3).to(DEVICE, non_blocking=True)
        assert device.waits.total() == len(waiting)
