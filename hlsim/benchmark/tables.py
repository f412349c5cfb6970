"""The benchmark's figures as tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

Cell = dict[str, Any]


def benchmark_markdown(result: dict[str, Any]) -> str:
    """One second at batch 1; longer clips and larger batches; the training step and the scan where they were timed."""
    lines = [
        f"{result['device']} ({result['machine']}, {result['cores']} cores, {result['threads']} threads), torch "
        f"{result['torch']}{_gpu(result['gpu'])}, {result['date']}; "
        f"milliseconds, median (least to greatest) of {result['repeats']} rounds"
        + (" of three ears, of slow rows of fewer calls." if "rows" in result else "."),
        "",
    ]
    if "rows" in result:
        lines += _one_second(result["rows"]) + _sizes(result["rows"]) + _training(result["rows"])
    for name, title in (("training", "A training step"), ("scan", "Selective scan")):
        if table := result.get(name):
            rows = [
                (
                    row["name"],
                    _times(row["forward"]),
                    _times(row["both"]),
                    _peaks(row["forward"], row["both"]),
                )
                for row in table
            ]
            lines += _table((title, "forward", "forward + backward", "peak memory (MiB)"), rows)
    return "\n".join([*lines, *(f"skipped: {reason}" for reason in result["skipped"])]) + "\n"


def _table(heads: Iterable[str], rows: Iterable[Iterable[Any]]) -> list[str]:
    heads = list(heads)
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in (heads, *rows)]
    return [lines[0], "|---" * len(heads) + "|", *lines[1:], ""]


def _one_second(rows: list[dict[str, Any]]) -> list[str]:
    table = []
    most = max((cell["counted"] for row in rows for cell in row["cells"]), default=0)
    for row in rows:
        single = {
            (cell["sample_rate"], cell["direction"]): cell
            for cell in row["cells"]
            if cell["seconds"] == 1.0 and cell["batch"] == 1
        }
        for (rate, direction), forward in single.items():
            if direction == "forward":
                both = single.get((rate, "both"))
                slow = f" ({forward['counted']} calls)" if forward["counted"] < most else ""
                parameters = f"{row['parameters']:,}" if row["parameters"] else "-"
                speedup = f"{forward['speedup']:.1f}" if forward["speedup"] else "-"
                times = (_times(forward), _times(both), _peaks(forward, both))
                table.append((row["name"] + slow, parameters, rate, *times, speedup))
    heads = "1 s, batch 1|parameters|rate (Hz)|forward|forward + backward|peak memory (MiB)|times pyclarity"
    return _table(heads.split("|"), table)


def _sizes(rows: list[dict[str, Any]]) -> list[str]:
    forward = {row["name"]: [cell for cell in row["cells"] if cell["direction"] == "forward"] for row in rows}
    keys = sorted({(cell["batch"], cell["seconds"]) for cells in forward.values() for cell in cells})
    table = []
    for row in rows:
        rate = forward[row["name"]][0]["sample_rate"]
        cells = {(c["batch"], c["seconds"]): c for c in forward[row["name"]] if c["sample_rate"] == rate}
        growth = [f"{value:.2f}" if value is not None else "-" for value in row["growth"].values()]
        table.append(
            (f"{row['name']}, {rate} Hz", *(_size(cells.get(key)) for key in keys), ", ".join(growth))
        )
    heads = [f"{seconds:g} s" if batch == 1 else f"{batch} of {seconds:g} s" for batch, seconds in keys]
    return _table(("forward, ms (MiB)", *heads, "growth with length, batch"), table)


def _training(rows: list[dict[str, Any]]) -> list[str]:
    """Batches to train on, as far as they were timed."""
    table = [
        (
            f"{row['name']}, {cell['sample_rate']} Hz, {cell['batch']} of {cell['seconds']:g} s",
            _times(cell),
            f"{cell['times_real_time']:.0f}",
            _peaks(cell),
        )
        for row in rows
        for cell in row["cells"]
        if cell["direction"] == "both" and (cell["seconds"], cell["batch"]) != (1.0, 1)
    ]
    heads = ("batch, forward + backward", "ms", "times real time", "peak memory (MiB)")
    return _table(heads, table) if table else []


def _gpu(gpu: dict[str, Any] | None) -> str:
    if gpu is None:
        return ""
    rounded = ", ".join(name for name, on in gpu["tf32"].items() if on) or "nothing"
    return f", GPU memory {gpu['memory_mib']:.0f} MiB, CUDA {gpu['cuda']}, cuDNN {gpu['cudnn']}, TF32 in {rounded}"


def _size(cell: Cell | None) -> str:
    if cell is None:
        return "-"
    peak = f" ({cell['peak_mib']:.0f})" if cell["peak_mib"] is not None else ""
    return f"{cell['median_ms']:.1f}{peak}"


def _times(cell: Cell | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['median_ms']:.1f} ({cell['least_ms']:.1f} to {cell['greatest_ms']:.1f})"


def _peaks(*cells: Cell | None) -> str:
    return (
        ", ".join(f"{cell['peak_mib']:.0f}" for cell in cells if cell and cell["peak_mib"] is not None) or "-"
    )
