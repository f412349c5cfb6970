"""The benchmark's figures as tables."""

from __future__ import annotations

from typing import Any


def benchmark_markdown(result: dict[str, Any]) -> str:
    """One second at batch 1; longer clips and larger batches; the training step and the scan where they were timed."""
    lines = [
        f"{result['device']} ({result['machine']}, {result['cores']} cores, {result['threads']} threads), torch "
        f"{result['torch']}, {result['date']}; milliseconds, median (least to greatest) of {result['repeats']} rounds"
        + (" of three ears, of slow rows of fewer calls." if "rows" in result else "."),
        "",
    ]
    if "rows" in result:
        lines += [*_one_second(result["rows"]), "", *_sizes(result["rows"]), ""]
    for title, table in (("A training step", result.get("training")), ("Selective scan", result.get("scan"))):
        if table:
            lines += [f"| {title} | forward | forward + backward |", "|---|---|---|"]
            lines += [
                f"| {row['name']} | {_cell(row['forward'])} | {_cell(row['both'])} |" for row in table
            ] + [""]
    return "\n".join([*lines, *(f"skipped: {reason}" for reason in result["skipped"])]) + "\n"


def _one_second(rows: list[dict[str, Any]]) -> list[str]:
    lines = [
        "| 1 s, batch 1 | parameters | rate (Hz) | forward | forward + backward | peak memory (MiB) | times pyclarity |",
        "|---|---|---|---|---|---|---|",
    ]
    most = max(cell["counted"] for row in rows for cell in row["cells"])
    for row in rows:
        single = [cell for cell in row["cells"] if cell["seconds"] == 1.0 and cell["batch"] == 1]
        for forward in (cell for cell in single if cell["direction"] == "forward"):
            rate = forward["sample_rate"]
            both = next((c for c in single if c["direction"] == "both" and c["sample_rate"] == rate), None)
            peak = [
                f"{cell['peak_mib']:.0f}" for cell in (forward, both) if cell and cell["peak_mib"] is not None
            ]
            slow = f" ({forward['counted']} calls)" if forward["counted"] < most else ""
            cells = (
                row["name"] + slow,
                f"{row['parameters']:,}" if row["parameters"] else "-",
                rate,
                _cell(forward),
                _cell(both),
                ", ".join(peak) or "-",
                f"{forward['speedup']:.1f}" if forward["speedup"] else "-",
            )
            lines.append("| " + " | ".join(map(str, cells)) + " |")
    return lines


def _sizes(rows: list[dict[str, Any]]) -> list[str]:
    keys = sorted({(cell["batch"], cell["seconds"]) for row in rows for cell in row["cells"]})
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


def _size(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    peak = f" ({cell['peak_mib']:.0f})" if cell["peak_mib"] is not None else ""
    return f"{cell['median_ms']:.1f}{peak}"


def _cell(cell: dict[str, Any] | None) -> str:
    if cell is None:
        return "-"
    return f"{cell['median_ms']:.1f} ({cell['least_ms']:.1f} to {cell['greatest_ms']:.1f})"
