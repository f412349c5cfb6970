"""Constants are made once for each type and device, and what a mode makes of them is not kept; freed memory is."""

import subprocess
import sys

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode

from hlsim import torchtools
from hlsim.torchtools import constant

CPU = torch.device("cpu")


def test_made_once_for_each_type_and_device() -> None:
    calls = []

    def make(count: int) -> list[int]:
        calls.append(count)
        return [1] * count

    first = constant(make, 3, dtype=torch.float32, device=CPU)
    assert constant(make, 3, dtype=torch.float32, device=CPU) is first and first.tolist() == [1.0] * 3
    assert constant(make, 3, dtype=torch.float64, device=CPU).dtype == torch.float64
    assert constant(make, 4, dtype=torch.float32, device=CPU).shape == (4,)
    assert constant(make, 3, dtype=torch.float32, device=torch.device("meta")).is_meta
    assert calls == [3, 3, 4, 3]


def test_what_inference_mode_or_a_transform_asks_for_first_serves_gradients_too() -> None:
    def make(value: float) -> list[float]:
        return [value]

    def scale(x: Tensor, value: float) -> Tensor:
        return x * constant(make, value, dtype=x.dtype, device=x.device)

    with torch.inference_mode():
        scale(torch.ones(1), 2.0)
    torch.func.vmap(lambda x: scale(x, 3.0))(torch.ones(4, 1))
    torch.func.grad(lambda x: scale(x, 4.0).sum())(torch.ones(1))
    for value in (2.0, 3.0, 4.0):
        x = torch.ones(1, requires_grad=True)
        scale(x, value).sum().backward()
        assert x.grad is not None and x.grad.item() == value


def test_what_fake_tensors_ask_for_is_not_kept() -> None:
    def make() -> list[float]:
        return [5.0]

    with FakeTensorMode():
        assert isinstance(constant(make, dtype=torch.float32, device=CPU), FakeTensor)
    assert constant(make, dtype=torch.float32, device=CPU).tolist() == [5.0]


# a child of its own, for the setting is the process's: megabytes again and again, as a training asks for them
_FAULTS = """
import resource, sys, torch
from hlsim.torchtools import keep_freed_memory
if sys.argv[1] == "keep" and not keep_freed_memory():
    sys.exit(7)
def step():
    held = [torch.ones(5_000_000) for _ in range(8)]
for _ in range(2):
    step()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(5):
    step()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    done = subprocess.run([sys.executable, "-c", _FAULTS, how], capture_output=True, text=True, timeout=120)
    if done.returncode == 7:
        pytest.skip("no glibc")
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_kept_memory_costs_no_page_faults() -> None:
    assert faults("keep") < faults("as it is") / 10


def test_other_c_libraries_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(_: object) -> object:
        raise OSError("no such library")

    monkeypatch.setattr(torchtools.ctypes, "CDLL", none)
    assert torchtools.keep_freed_memory() is False
    monkeypatch.setattr(torchtools.ctypes, "CDLL", lambda _: object())
    assert torchtools.keep_freed_memory() is False
