"""What the benchmark does where a call fails."""

import contextlib
import json
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from hlsim.audiogram import Audiogram
from hlsim.benchmark import parts
from hlsim.benchmark import run as benchmark_module
from hlsim.benchmark.models import Row
from hlsim.benchmark.run import benchmark
from hlsim.benchmark.tables import benchmark_markdown
from hlsim.benchmark.timing import about, peak_mib, rows_by_turns
from hlsim.cli.main import main


def short_of_memory(message: str) -> Row:
    def call(waveform: Tensor) -> Tensor:
        if waveform.shape[-1] > 2 * 16000:
            raise RuntimeError(message)
        return 0.5 * waveform

    return Row("greedy", (16000,), lambda rate, ear, device: call)


def identity() -> Row:
    return Row("modest", (16000,), lambda rate, ear, device: torch.clone)


def test_a_row_that_runs_out_of_memory_is_left_out_there_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = [short_of_memory("DefaultCPUAllocator: can't allocate memory"), identity()]
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    result = benchmark(repeats=1, lengths=(1.0, 4.0), batches=(1, 2))
    assert result["skipped"] == ["greedy, 16000 Hz, 4 s, batch 1, forward: memory ran out"]
    sizes = {
        row["name"]: {(c["seconds"], c["batch"]) for c in row["cells"]} for row in result["rows"]
    }
    assert sizes == {"greedy": {(1.0, 1), (1.0, 2)}, "modest": {(1.0, 1), (4.0, 1), (1.0, 2)}}
    assert "skipped: greedy, 16000 Hz, 4 s" in benchmark_markdown(result)


def test_time_that_grows_with_the_square_is_seen_coming(monkeypatch: pytest.MonkeyPatch) -> None:
    def call(waveform: Tensor) -> Tensor:
        seconds = waveform.shape[-1] / 16000
        assert seconds < 10.0
        time.sleep(0.005 * seconds**2)
        return 0.5 * waveform

    square = Row("square", (16000,), lambda rate, ear, device: call)
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: ([square, identity()], []))
    result = benchmark(repeats=1, limit=0.5, lengths=(1.0, 4.0, 16.0), batches=(1,))
    lengths = [sorted({cell["seconds"] for cell in row["cells"]}) for row in result["rows"]]
    assert lengths == [
        [1.0, 4.0],
        [1.0, 4.0, 16.0],
    ]  # by the first second alone 80 ms would be expected


class NoWayBack(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, waveform: Tensor) -> Tensor:
        return waveform.clone()

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        raise NotImplementedError("no way back\nof that")


def raising(error: BaseException, seconds: float = 0.0) -> Callable[[Tensor], Tensor]:
    def call(waveform: Tensor) -> Tensor:
        if waveform.shape[-1] > seconds * 16000:
            raise error
        return 0.5 * waveform

    return call


def test_a_row_that_fails_loses_none_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    def unprepared(rate: int, ear: Audiogram, device: torch.device) -> Callable[[Tensor], Tensor]:
        raise OSError("no such file")

    rows = [
        Row("unprepared", (16000,), unprepared),
        Row(
            "broken",
            (16000,),
            lambda rate, ear, device: raising(RuntimeError("CUDA error: invalid argument")),
        ),
        Row("one-way", (16000,), lambda rate, ear, device: NoWayBack.apply),
        Row(
            "short",
            (16000,),
            lambda rate, ear, device: raising(RuntimeError("CUFFT_ALLOC_FAILED"), 2.0),
        ),
        identity(),
    ]
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    result = benchmark(repeats=2, lengths=(1.0, 4.0), batches=(1,))
    sizes = {
        row["name"]: [(c["seconds"], c["direction"]) for c in row["cells"]]
        for row in result["rows"]
    }
    assert sizes == {
        "one-way": [(1.0, "forward"), (4.0, "forward")],
        "short": [(1.0, "forward"), (1.0, "both")],
        "modest": [(1.0, "forward"), (1.0, "both"), (4.0, "forward")],
    }
    assert result["skipped"] == [  # each once
        "unprepared, 16000 Hz: OSError: no such file",
        "broken, 16000 Hz, 1 s, batch 1, forward: RuntimeError: CUDA error: invalid argument",
        "one-way, 16000 Hz, 1 s, batch 1, forward and backward: NotImplementedError: no way back",
        "short, 16000 Hz, 4 s, batch 1, forward: memory ran out",
    ]
    assert "| modest | - | 16000 |" in benchmark_markdown(result)


def test_nothing_but_failures_is_a_result_too(monkeypatch: pytest.MonkeyPatch) -> None:
    row = Row("broken", (16000,), lambda rate, ear, device: raising(RuntimeError("broken")))
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: ([row], []))
    result = benchmark(repeats=1, lengths=(1.0, 4.0), batches=(1,))
    assert result["rows"] == [] and "skipped: broken, 16000 Hz, 1 s" in benchmark_markdown(result)


def test_what_is_measured_is_written_before_the_end(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rows = [
        identity(),
        Row("stopped", (16000,), lambda rate, ear, device: raising(KeyboardInterrupt(), 2.0)),
    ]
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    path = tmp_path / "speed.json"
    with contextlib.suppress(KeyboardInterrupt):
        main(["benchmark", "--repeats", "1", "--json", str(path)])
    result = json.loads(path.read_text())
    assert [row["name"] for row in result["rows"]] == ["modest", "stopped"]
    assert (4.0, 1) in {(cell["seconds"], cell["batch"]) for cell in result["rows"][0]["cells"]}


def test_a_table_without_what_fails() -> None:
    calls = {
        "whole": lambda: torch.zeros(1, requires_grad=True).sum(),
        "late": lambda: raising(RuntimeError("too long"))(torch.zeros(1)),
    }
    rows, skipped = rows_by_turns(calls, torch.device("cpu"), 1)
    assert "late, forward: RuntimeError: too long" in skipped and [row["name"] for row in rows] == [
        "whole"
    ]
    table = benchmark_markdown(about("cpu", 1) | {"training": rows, "skipped": skipped})
    assert "| A training step | forward | forward + backward | peak memory (MiB) |" in table


def test_metrics_stand_beside_the_reference(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(parts, "METRIC_SECONDS", 0.8)
    assert main(["benchmark", "--what", "metrics", "--repeats", "1"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| HAS")]
    assert len(lines) == 8 and all(line.split("|")[5].strip() not in ("", "-") for line in lines)
    assert lines[0].startswith("| HASPI (pyclarity) |") and lines[0].rstrip(" |").endswith("1.0")


def test_the_default_network_is_timed_on_a_batch_to_train_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def call(waveform: Tensor) -> Tensor:
        time.sleep(0.005)
        return 0.5 * waveform

    default = Row("default", (44100, 16000), lambda rate, ear, device: call, default=True)
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: ([default, identity()], []))
    result = benchmark(repeats=1, limit=0.5, lengths=(), batches=(), training=(2.0, 8))
    cells = [[c for c in row["cells"] if c["batch"] == 8] for row in result["rows"]]
    assert cells[1] == []
    (cell,) = cells[0]
    assert (cell["sample_rate"], cell["seconds"], cell["direction"]) == (16000, 2.0, "both")
    assert cell["times_real_time"] == pytest.approx(16000.0 / cell["median_ms"])
    table = benchmark_markdown(result)
    assert (
        f"| default, 16000 Hz, 8 of 2 s | {cell['median_ms']:.1f} " in table
        and "8 of 2 s |" not in table[: table.index("batch, forward + backward")]
    )
    brief = benchmark(
        repeats=1, limit=0.05, lengths=(), batches=(), training=(2.0, 8)
    )  # 16 times 5 ms
    assert {cell["batch"] for cell in brief["rows"][0]["cells"]} == {1}


def test_a_gpu_is_measured_by_its_number(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    for name in (
        "synchronize",
        "reset_peak_memory_stats",
        "memory_allocated",
        "max_memory_allocated",
    ):
        monkeypatch.setattr(
            torch.cuda, name, lambda device=None, name=name: asked.append((name, device)) or 0
        )
    second = torch.device("cuda:1")
    assert peak_mib(lambda: None, second) == 0.0
    assert len(asked) == 4 and all(device == second for _, device in asked)


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="Linux tells the peak")
def test_memory_that_is_given_back_counts() -> None:
    # freed, but kept by the process: 160 MiB below others that stay (blocks under 32 MiB are not mapped alone)
    torch.ones(2**23 - 2**12).sum()
    freed = [torch.ones(5 * 2**20) for _ in range(8)]
    kept = [torch.ones(2**18) for _ in range(16)]
    freed.clear()
    # the count is the whole process's: whatever another thread frees meanwhile is missing from it
    counted = [peak_mib(lambda: torch.ones(2**24).sum(), torch.device("cpu")) for _ in range(5)]
    assert any(60.0 < mib < 80.0 for mib in counted), counted  # 64 MiB of float32
    assert len(kept) == 16


def test_a_gpu_is_described(monkeypatch: pytest.MonkeyPatch) -> None:
    properties = SimpleNamespace(total_memory=80 * 2**30)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"GPU {device}")
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: properties)
    monkeypatch.setattr(
        torch.backends.cudnn, "version", lambda: 91900
    )  # it would ask the GPU the first time
    machine = about("cuda:1", 1)
    assert machine["machine"] == "GPU cuda:1" and machine["gpu"]["cuda"] == torch.version.cuda
    line = benchmark_markdown(machine | {"skipped": []}).splitlines()[0]
    assert "GPU memory 81920 MiB, CUDA" in line and "TF32 in convolutions, recurrent" in line
    with torch.backends.cudnn.flags(allow_tf32=False):
        assert about("cuda:1", 1)["gpu"]["tf32"]["convolutions"] is False


def test_rows_can_be_chosen_by_part_of_their_name(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [identity(), Row("modest too", (16000,), lambda rate, ear, device: torch.clone)]
    rows.append(Row("other", (16000,), lambda rate, ear, device: torch.clone))
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    result = benchmark(repeats=1, lengths=(), batches=(), only=["modest", "none"])
    assert [row["name"] for row in result["rows"]] == ["modest", "modest too"]
    assert all(len(row["cells"]) == 2 for row in result["rows"])  # 1 s at batch 1, there and back
    with pytest.raises(ValueError, match="no such row; there are modest, modest too, other"):
        benchmark(repeats=1, only=["none"])
