"""Memory that HearingLossLoss takes for its gradient, with and without ``checkpoint=True``.

    python docs/figures/memory.py [--items 16] [--seconds 4]

The clean items are white noise at 65 dB SPL for an N3 ear, and the outputs are three times as
large. Each case runs in a process of its own. Prints a Markdown table in MB (10^6 bytes) with

- activations: what autograd stores in the forward pass, where each storage counts once
- peak: how much the largest resident memory of the process grows in forward and backward pass
"""

import argparse
import resource
import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context

import torch
from torch import Tensor

from hlsim import HearingLossLoss
from hlsim.calibration import set_level

SIMULATORS = ("msbg", "neuro-msbg")
CRITERIA = ("coherent-bands", "bands", "paper")
RATES = (16000, 44100)


def stored_bytes(loss: HearingLossLoss, output: Tensor, clean: Tensor) -> tuple[Tensor, int]:
    """Compute a loss, and the bytes that autograd stores for its gradient.

    Shape: (..., time) twice -> ().
    """
    sizes: dict[int, int] = {}

    def pack(tensor: Tensor) -> Tensor:
        storage = tensor.untyped_storage()
        sizes[storage.data_ptr()] = storage.nbytes()
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        value = loss(output, clean)
    return value, sum(sizes.values())


def peak_bytes() -> int:
    """Return the largest resident memory of this process until now."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure(
    simulator: str, criterion: str, rate: int, checkpoint: bool, items: int, seconds: float
) -> tuple[float, float]:
    """Return the stored activations and the growth of the peak in MB."""
    torch.manual_seed(0)
    clean = set_level(torch.randn(items, round(seconds * rate)), 65.0)
    output = (3.0 * clean).requires_grad_()
    loss = HearingLossLoss(
        "N3", simulator=simulator, criterion=criterion, sample_rate=rate, checkpoint=checkpoint
    )
    loss(output[:1].detach(), clean[:1])  # computes the constants
    peak_before = peak_bytes()
    value, stored = stored_bytes(loss, output, clean)
    value.backward()
    return stored / 1e6, (peak_bytes() - peak_before) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--items", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=4.0)
    options = parser.parse_args()
    print("| simulator | criterion | rate (Hz) | activations | with checkpoint | peak | with it |")
    print("|---|---|---|---|---|---|---|")
    spawn = get_context("spawn")
    with ProcessPoolExecutor(1, spawn, max_tasks_per_child=1) as pool:
        for simulator, criterion, rate in product(SIMULATORS, CRITERIA, RATES):
            tasks = [
                pool.submit(
                    measure, simulator, criterion, rate, checkpoint, options.items, options.seconds
                )
                for checkpoint in (False, True)
            ]
            (stored, peak), (stored_less, peak_less) = (task.result() for task in tasks)
            print(
                f"| `{simulator}` | `{criterion}` | {rate} | {stored:.0f} | {stored_less:.0f} "
                f"| {peak:.0f} | {peak_less:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
