"""What runs on a GPU never mixes devices, as far as that can be told without one.

A pretended device: its tensors compute on the CPU, say that they are on a GPU, and refuse to meet one of the CPU. Torch
itself lets indices of the CPU pass, which it copies with every call; here they are refused, too.
"""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

from compensators import MappingCompensator, load_compensator
from hlsim import MSBG, Audiogram, HearingLossLoss, load_pretrained

GPU = torch.device("cuda", 0)
MOVES = {"aten::_to_copy", "aten::copy_"}  # these take tensors of both

# of what torch leaves for later, dispatch down here knows nothing
EAGER = {
    "aten::_conj": torch.ops.aten.conj_physical.default,
    "aten::_neg_view": torch.ops.aten.neg.default,
}


class OnGPU(Tensor):
    inner: Tensor
    # properties, for in a backward pass the mode below is not asked
    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)

    @staticmethod
    def __new__(cls, inner: Tensor) -> "OnGPU":
        made = Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
        )
        made.inner = inner
        return made

    def __repr__(self, **options: Any) -> str:
        return f"OnGPU({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
        others = [
            tuple(tensor.shape)
            for tensor in tensors
            if not isinstance(tensor, OnGPU) and tensor.ndim
        ]
        if others and func._schema.name not in MOVES:
            raise RuntimeError(
                f"{func} got tensors of the GPU and of the CPU, these of shape {others}"
            )
        func = EAGER.get(func._schema.name, func)
        out = func(*tree_map(inside, args), **tree_map(inside, kwargs))
        if func._schema.is_mutable:
            return kwargs.get("out", args[0])
        return tree_map(on_gpu, out)


def inside(value: Any) -> Any:
    return value.inner if isinstance(value, OnGPU) else value


def on_gpu(value: Any) -> Any:
    return OnGPU(value) if isinstance(value, Tensor) and not isinstance(value, OnGPU) else value


class ToGPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:
        return OnGPU(tensor.detach().clone())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return inside(gradient)


class ToCPU(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tensor: Tensor) -> Tensor:
        return inside(tensor).clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return OnGPU(gradient)


def moved(tensor: Tensor, device: torch.device | str) -> Tensor:
    there = torch.device(device).type == "cuda"
    if there == isinstance(tensor, OnGPU):
        return tensor
    return ToGPU.apply(tensor) if there else ToCPU.apply(tensor)


class PretendedGPU(TorchFunctionMode):
    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        if name in ("to", "cpu", "cuda"):
            tensor, *rest = args
            like = next((value for value in rest if isinstance(value, Tensor)), None)
            device = {"cpu": "cpu", "cuda": GPU}.get(name) or kwargs.get("device")
            device = device or next(
                (value for value in rest if isinstance(value, torch.device | str)), None
            )
            dtype = kwargs.get("dtype") or next(
                (v for v in rest if isinstance(v, torch.dtype)), None
            )
            if like is not None:
                device, dtype = GPU if isinstance(like, OnGPU) else "cpu", like.dtype
            tensor = tensor if dtype is None else func(tensor, dtype)
            return tensor if device is None else moved(tensor, device)
        device = kwargs.pop("device", None)
        if name == "tolist":
            return inside(args[0].detach()).tolist()
        if name == "new_tensor" and isinstance(args[0], OnGPU):
            return OnGPU(torch.tensor(args[1], dtype=args[0].dtype))
        if device is None:
            return func(*args, **kwargs)
        return moved(func(*args, **kwargs), device)


def to_gpu(module: nn.Module) -> nn.Module:
    for part in module.modules():
        for name, parameter in part._parameters.items():
            if parameter is not None:
                part._parameters[name] = nn.Parameter(
                    OnGPU(parameter.detach().clone()), requires_grad=parameter.requires_grad
                )
        for name, buffer in part._buffers.items():
            part._buffers[name] = on_gpu(buffer)
    return module


EARS = torch.tensor([Audiogram.standard(name).thresholds for name in ("N1", "N3", "NH", "N1")])
MODULES: dict[str, Callable[[], nn.Module]] = {
    "msbg at 16 kHz": lambda: MSBG(sample_rate=16000),
    "msbg at 44.1 kHz": MSBG,
    "msbg, late": lambda: MSBG(aligned=False, rescale_active=True),
    "neuro-msbg": lambda: load_pretrained("neuro-msbg"),
    "neuro-msbg at 44.1 kHz": lambda: load_pretrained("neuro-msbg", sample_rate=44100),
    "neuro-msbg-mamba": lambda: load_pretrained("neuro-msbg-mamba"),
    "neuro-msbg-lstm": lambda: load_pretrained("neuro-msbg-lstm"),
    "neuro-msbg-transformer": lambda: load_pretrained("neuro-msbg-transformer"),
    "nalr": lambda: load_compensator("nalr"),
    "compensator": MappingCompensator,
}


def output_and_slope(call: Callable[..., Tensor], *given: Tensor) -> tuple[Tensor, Tensor]:
    waveform = given[0].clone().requires_grad_()
    output = call(waveform, *given[1:])
    value = output.square().sum()
    # torch.autograd.grad would switch the pretended device off for what the backward pass makes
    (slope,) = torch.autograd.graph._engine_run_backward(
        (value,), (torch.ones_like(value),), False, False, (waveform,), False, accumulate_grad=False
    )
    return output.detach(), slope


def assert_alike(there: tuple[Tensor, Tensor], here: tuple[Tensor, Tensor]) -> None:
    for far, near, tolerance in zip(there, here, (1e-4, 1e-2), strict=True):
        assert isinstance(far, OnGPU)
        assert (far.inner - near).norm() <= tolerance * near.norm()


@pytest.mark.parametrize("name", MODULES)
def test_modules_keep_to_their_device(name: str) -> None:
    torch.manual_seed(0)
    module = MODULES[name]()
    wave = 0.02 * torch.randn(4, 9000)
    here = output_and_slope(module, wave, EARS)
    to_gpu(module)
    with PretendedGPU():
        there = output_and_slope(module, wave.to("cuda"), EARS.to("cuda"))
    assert_alike(there, here)


@pytest.mark.parametrize("simulator", ["msbg", "neuro-msbg"])
@pytest.mark.parametrize("criterion", ["paper", "bands"])
@pytest.mark.parametrize("reference", ["clean", "normal-hearing"])
def test_losses_keep_to_their_device(simulator: str, criterion: str, reference: str) -> None:
    loss = HearingLossLoss(simulator=simulator, criterion=criterion, reference=reference)
    wave, clean = 0.02 * torch.randn(2, 4, 9000)
    here = output_and_slope(loss, wave, clean, EARS)
    to_gpu(loss)
    to_gpu(loss.simulator)
    with PretendedGPU():
        there = output_and_slope(loss, wave.to("cuda"), clean.to("cuda"), EARS)
    assert_alike(there, here)


def test_the_pretended_device_refuses_the_cpus_tensors() -> None:
    with PretendedGPU(), pytest.raises(RuntimeError, match="of the GPU and of the CPU"):
        torch.ones(3, device="cuda") + torch.ones(3)


class Doubled(torch.autograd.Function):
    """Its way back takes a tensor of the device that the gradient, or else that the processor has."""

    seen: torch.device | None = None
    by_processor = False

    @staticmethod
    def forward(ctx: Any, waveform: Tensor) -> Tensor:
        return 2.0 * waveform

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        Doubled.seen = gradient.device
        return gradient * torch.full(
            (3,), 2.0, device="cpu" if Doubled.by_processor else gradient.device
        )


def test_the_pretended_device_is_there_on_the_way_back(monkeypatch: pytest.MonkeyPatch) -> None:
    with PretendedGPU():
        _, slope = output_and_slope(Doubled.apply, torch.ones(3, device="cuda"))
        assert Doubled.seen == GPU and inside(slope).tolist() == [8.0] * 3
        monkeypatch.setattr(Doubled, "by_processor", True)
        with pytest.raises(RuntimeError, match="of the GPU and of the CPU"):
            output_and_slope(Doubled.apply, torch.ones(3, device="cuda"))


def test_the_pretended_device_refuses_the_cpus_indices() -> None:
    with PretendedGPU(), pytest.raises(RuntimeError, match="of the GPU and of the CPU"):
        torch.ones(3, device="cuda")[[0, 2]]
