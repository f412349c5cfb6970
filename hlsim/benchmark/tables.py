"""The benchmark's figures as tables."""

from __future__ import annotations

from typing import Any


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
        lines += [*_one_second(result["rows"]), "", *_sizes(result["rows"]), "", *_training(result["rows"])]
    for title, table in (("A training step", result.get("training")), ("Selective scan", result.get("scan"))):
        if table:
            lines += [
                f"| {title} | forward | forward + backward | peak memory (MiB) |",
                "|---|---|---|---|",
                *(f"| {row['name']} | {_step(row['forward'], row['both'])} |" for row in table),
                "",
            ]
    return "\n".join([*lines, *(f"skipped: {reason}" for reason in result["skipped"])]) + "\n"


def _one_second(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| 1 s, batch 1 | parameters | rate (Hz) | forward | forward + backward | peak memory (MiB) | times pyclarity |",
        "|---|---|---|---|---|---|---|",
    ]
    most = max((cell["counted"] for row in rows for cell in row["cells"]), default=0)
    for row in rows:
        single = [cell for cell in row["cells"] if cell["seconds"] == 1.0 and cell["batch"] == 1]
        for forward in (cell for cell in single if cell["direction"] == "forward"):
            rate = forward["sample_rate"]
            both = next((c for c in single if c["direction"] == "both" and c["sample_rate"] == rate), None)
            slow = f" ({forward['counted']} calls)" if forward["counted"] < most else ""
            cells = (
                row["name"] + slow,
                f"{row['parameters']:,}" if row["parameters"] else "-",
                rate,
                _cell(forward),
                _cell(both),
                _peaks(forward, both),
                f"{forward['speedup']:.1f}" if forward["speedup"] else "-",
            )
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def _sizes(rows: list[dict[str, Any]]) -> list[str]:
    keys = sorted(
        {(c["batch"], c["seconds"]) for row in rows for c in row["cells"] if c["direction"] == "forward"}
    )
    heads = [f"{seconds:g} s" if batch == 1 else f"{batch} of {seconds:g} s" for batch, seconds in keys]
    lines = [
        "| forward, ms (MiB) | " + " | ".join(heads) + " | growth with length, batch |",
        "|---" * (len(keys) + 2) + "|",
    ]
    for row in rows:
        forward = [cell for cell in row["cells"] if cell["direction"] == "forward"]
        rate = forward[0]["sample_rate"]
        by_size = {(c["batch"], c["seconds"]): c for c in forward if c["sample_rate"] == rate}
        cells = [_size(by_size.get(key)) for key in keys]
        growth = [f"{value:.2f}" if value is not None else "-" for value in row["growth"].values()]
        lines.append(f"| {row['name']}, {rate} Hz | " + " | ".join([*cells, ", ".join(growth)]) + " |")
    return lines


def _training(rows: list[dict[str, Any]]) -> list[str]:
    """Batches to train on, as far as they were timed."""
    found = [
        (row["name"], cell)
        for row in rows
        for cell in row["cells"]
        if cell["direction"] == "both" and (cell["seconds"], cell["batch"]) != (1.0, 1)
    ]
    if not found:
        return []
    lines = ["| batch, forward + backward | ms | times real time | peak memory (MiB) |", "|---|---|---|---|"]
    lines += [
        f"| {name}, {cell['sample_rate']} Hz, {cell['batch']} of {cell['seconds']:g} s | {_cell(cell)} | "
        f"{cell['times_real_time']:.0f} | {_peaks(cell)} |"
        for name, cell in found
    ]
    return [*lines, ""]


def _gpu(gpu: dict[str, Any] | None) -> str:
    if gpu is None:
        return ""
    rounded = [name for name, on in gpu["tf32"].items() if on]
    return (
        f", GPU memory {gpu['memory_mib']:.0f} MiB, CUDA {gpu['cuda']}, cuDNN {gpu['cudnn']}, "
        f"TF32 in {', '.join(rounded) or 'nothing'}"
    )


def _size(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    peak = f" ({cell['peak_mib']:.0f})" if cell["peak_mib"] is not None else ""
    return f"{cell['median_ms']:.1f}{peak}"


def _cell(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['median_ms']:.1f} ({cell['least_ms']:.1f} to {cell['greatest_ms']:.1f})"


def _step(forward: dict[str, Any] | None, both: dict[str, Any] | None) -> str:
    return f"{_cell(forward)} | {_cell(both)} | {_peaks(forward, both)}"


def _peaks(*cells: dict[str, Any] | None) -> str:
    return (
        ", ".join(f"{cell['peak_mib']:.0f}" for cell in cells if cell and cell["peak_mib"] is not None) or "-"
    )
