"""The benchmark's figures as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hlsim.report.tables import Table, number

Row = Mapping[str, Any]

_PEAK = "peak memory (MiB)"


def benchmark_markdown(result: Row) -> str:
    """One second at batch 1; longer clips and larger batches; step and metrics where they were timed."""
    head = (
        f"{result['device']} ({result['machine']}, {result['cores']} cores, {result['threads']} threads), torch "
        f"{result['torch']}{_gpu(result['gpu'])}, {result['date']}; "
        f"milliseconds, median (least to greatest) of {result['repeats']} rounds"
        + (" of three ears, of slow rows of fewer calls." if "rows" in result else ".")
    )
    rows = result.get("rows", [])
    tables = [_one_second(rows), _sizes(rows), _training(rows)]
    for name, title in (("training", "A training step"), ("metrics", "3 s at 16 kHz, one thread")):
        tables.append([_part(title, part) for part in result.get(name, [])])
    texts = [Table.of("", table).markdown() + "\n" for table in tables if table]
    return (
        "\n".join([head, "", *texts, *(f"skipped: {reason}" for reason in result["skipped"])])
        + "\n"
    )


def _one_second(rows: Sequence[Row]) -> list[dict[str, str]]:
    table = []
    most = max((cell["counted"] for row in rows for cell in row["cells"]), default=0)
    for row in rows:
        cells = [cell for cell in row["cells"] if (cell["seconds"], cell["batch"]) == (1.0, 1)]
        single = {(cell["sample_rate"], cell["direction"]): cell for cell in cells}
        for (rate, direction), forward in single.items():
            if direction == "forward":
                slow = f" ({forward['counted']} calls)" if forward["counted"] < most else ""
                table.append(
                    {
                        "1 s, batch 1": row["name"] + slow,
                        "parameters": f"{row['parameters']:,}" if row["parameters"] else "-",
                        "rate (Hz)": str(rate),
                        **_both_ways(forward, single.get((rate, "both"))),
                        "times pyclarity": number(forward["speedup"], ".1f", "-"),
                    }
                )
    return table


def _sizes(rows: Sequence[Row]) -> list[dict[str, str]]:
    forward = {
        row["name"]: [cell for cell in row["cells"] if cell["direction"] == "forward"]
        for row in rows
    }
    keys = sorted(
        {(cell["batch"], cell["seconds"]) for cells in forward.values() for cell in cells}
    )
    table = []
    for row in rows:
        rate = forward[row["name"]][0]["sample_rate"]
        cells = {
            (c["batch"], c["seconds"]): c for c in forward[row["name"]] if c["sample_rate"] == rate
        }
        line = {"forward, ms (MiB)": f"{row['name']}, {rate} Hz"}
        for batch, seconds in keys:
            length = f"{seconds:g} s" if batch == 1 else f"{batch} of {seconds:g} s"
            line[length] = _size(cells.get((batch, seconds)))
        table.append(line)
    return table


def _training(rows: Sequence[Row]) -> list[dict[str, str]]:
    """Batches to train on, as far as they were timed."""
    return [
        {
            "batch, forward + backward": f"{row['name']}, {cell['sample_rate']} Hz, {cell['batch']} of "
            f"{cell['seconds']:g} s",
            "ms": _times(cell),
            "times real time": f"{cell['times_real_time']:.0f}",
            _PEAK: _peaks(cell),
        }
        for row in rows
        for cell in row["cells"]
        if cell["direction"] == "both" and (cell["seconds"], cell["batch"]) != (1.0, 1)
    ]


def _part(title: str, part: Row) -> dict[str, str]:
    line = {title: part["name"], **_both_ways(part["forward"], part["both"])}
    return line | (
        {"times pyclarity": number(part["speedup"], ".1f", "-")} if "speedup" in part else {}
    )


def _gpu(gpu: Row | None) -> str:
    if gpu is None:
        return ""
    rounded = ", ".join(name for name, on in gpu["tf32"].items() if on) or "nothing"
    return f", GPU memory {gpu['memory_mib']:.0f} MiB, CUDA {gpu['cuda']}, cuDNN {gpu['cudnn']}, TF32 in {rounded}"


def _both_ways(forward: Row | None, both: Row | None) -> dict[str, str]:
    return {
        "forward": _times(forward),
        "forward + backward": _times(both),
        _PEAK: _peaks(forward, both),
    }


def _size(cell: Row | None) -> str:
    return "-" if cell is None else f"{cell['median_ms']:.1f} ({_peaks(cell)})".removesuffix(" (-)")


def _times(cell: Row | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['median_ms']:.1f} ({cell['least_ms']:.1f} to {cell['greatest_ms']:.1f})"


def _peaks(*cells: Row | None) -> str:
    known = [cell["peak_mib"] for cell in cells if cell and cell["peak_mib"] is not None]
    return ", ".join(f"{peak:.0f}" for peak in known) or "-"
