"""What a benchmark ran on."""

from __future__ import annotations

import os
import platform
import time
from pathlib import Path
from typing import Any

import torch


def about(device: str, repeats: int) -> dict[str, Any]:
    """Machine, versions and date; of a GPU its memory, CUDA and cuDNN, and how float32 is multiplied there, too.

    Raises:
        ValueError: there is no such device.
    """
    found = ["cpu", *(f"cuda:{index}" for index in range(torch.cuda.device_count()))]
    if device not in (*found, *(["cuda"] if len(found) > 1 else ())):
        raise ValueError(f"device {device!r}: there is none that torch can use; allowed: {', '.join(found)}")
    on_gpu = device.startswith("cuda")
    machine = torch.cuda.get_device_name(device) if on_gpu else _processor()
    return {
        "device": device,
        "machine": machine,
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "date": time.strftime("%Y-%m-%d"),
        "repeats": repeats,
        "gpu": _gpu(device) if on_gpu else None,
    }


def _gpu(device: str) -> dict[str, Any]:
    backends: Any = torch.backends  # torch's own types know little of it
    return {
        "memory_mib": torch.cuda.get_device_properties(device).total_memory / 2**20,
        "cuda": torch.version.cuda,
        "cudnn": torch.backends.cudnn.version(),
        "tf32": {
            "products": backends.cuda.matmul.fp32_precision == "tf32",
            "convolutions": backends.cudnn.conv.fp32_precision == "tf32",
            "recurrent": backends.cudnn.rnn.fp32_precision == "tf32",
        },
    }


def _processor() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
