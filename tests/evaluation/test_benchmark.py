"""What the benchmark does where a call fails."""

import time

import pytest
import torch
from torch import Tensor

from hlsim.evaluation import benchmark as benchmark_module
from hlsim.evaluation.benchmark import benchmark
from hlsim.evaluation.benchmark_models import Row
from hlsim.evaluation.benchmark_report import benchmark_markdown


def short_of_memory(message: str) -> Row:
    def call(waveform: Tensor) -> Tensor:
        if waveform.shape[-1] > 2 * 16000:
            raise RuntimeError(message)
        return 0.5 * waveform

    return Row("greedy", (16000,), lambda rate, ear, device: call)


def identity() -> Row:
    return Row("modest", (16000,), lambda rate, ear, device: torch.clone)


def test_a_row_that_runs_out_of_memory_is_left_out_there_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [short_of_memory("DefaultCPUAllocator: can't allocate memory"), identity()]
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    result = benchmark(repeats=1, lengths=(1.0, 4.0), batches=(1, 2))
    assert result["skipped"] == ["greedy, 4 s, batch 1: memory ran out"]
    sizes = {row["name"]: {(c["seconds"], c["batch"]) for c in row["cells"]} for row in result["rows"]}
    assert sizes == {"greedy": {(1.0, 1), (1.0, 2)}, "modest": {(1.0, 1), (4.0, 1), (1.0, 2)}}
    assert "skipped: greedy, 4 s" in benchmark_markdown(result)


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
    assert lengths == [[1.0, 4.0], [1.0, 4.0, 16.0]]  # by the first second alone 80 ms would be expected


def test_another_error_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: ([short_of_memory("shapes")], []))
    with pytest.raises(RuntimeError, match="shapes"):
        benchmark(repeats=1, lengths=(1.0, 4.0), batches=(1,))


def test_rows_can_be_chosen_by_part_of_their_name(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = [identity(), Row("modest too", (16000,), lambda rate, ear, device: torch.clone)]
    rows.append(Row("other", (16000,), lambda rate, ear, device: torch.clone))
    monkeypatch.setattr(benchmark_module, "rows", lambda simulators: (rows, []))
    result = benchmark(repeats=1, lengths=(), batches=(), only=["modest", "none"])
    assert [row["name"] for row in result["rows"]] == ["modest", "modest too"]
    assert all(len(row["cells"]) == 2 for row in result["rows"])  # 1 s at batch 1, there and back
    with pytest.raises(ValueError, match="no such row; there are modest, modest too, other"):
        benchmark(repeats=1, only=["none"])
