"""Hook of mkdocs that runs the notebooks in docs/tutorials and shows them as pages, with sounds and pictures.

Executed notebooks are kept in build/tutorials, and are run again if their cells have changed. ``mkdocs serve`` runs
none, so that it starts soon: it shows the outputs that are stored. ``TUTORIALS=run mkdocs serve`` runs them, and
``TUTORIALS=plain mkdocs build`` builds the site without running them. The build fails if a notebook raises an error,
or if what its text promises is no longer true.
"""

import base64
import hashlib
import os
import re
from html import escape
from pathlib import Path

import nbformat
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient
from nbformat import NotebookNode

ROOT = Path(__file__).parents[1]
TUTORIALS = ROOT / "docs" / "tutorials"
EXECUTED = ROOT / "build" / "tutorials"
TIMEOUT_SECONDS = 1800

SUFFIXES = {"audio/wav": "wav", "image/svg+xml": "svg", "image/png": "png"}
PROMISES = {
    "hear-a-hearing-loss": """
normal, mild, severe = (level_spl(hlsim.simulate(presented, name)) for name in ("NH", "N2", "N4"))
assert bool((normal > mild).all()) and bool((mild > severe).all())
assert abs(float(level_spl(speech) - level_spl(perceived)) - 55.0) < 3.0
assert abs(float(normal[-1] - severe[-1]) - 15.0) < 3.0  # recruitment
""",
    "train-your-own-network": """
results = table.set_index(["condition", "speech (dB SPL)"])
network, nal_r = results.loc["this network"], results.loc["NAL-R"]
assert bool((network["HASPI"] >= nal_r["HASPI"]).all())
assert float(network["loudness error (dB)"].abs().max()) < 6.0
assert sum(history[-20:]) < 0.5 * sum(history[:20])
""",
    "score-an-enhancement-system": """
assert abs(float(level_spl(aided).mean()) - table["output level (dB SPL)"].iloc[-1]) < 0.01
assert table["HASPI"].iloc[0] < table["HASPI"].iloc[1] < table["HASPI"].iloc[-1]
assert binaural["noise in front"]["normal hearing"] < binaural["noise from the left"]["normal hearing"]
""",
}
"""Assertions about the results of each notebook, which run after it and are not shown."""

_DATA_URI = re.compile(r'src="data:([\w/+]+);base64,([^"]+)"')


def on_startup(command: str, dirty: bool) -> None:
    """Run no notebook before the site is served, unless that was asked for."""
    if command == "serve":
        os.environ.setdefault("TUTORIALS", "plain")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook."""
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        executed = find_executed(notebook, EXECUTED / path.name)
        if executed is None and os.environ.get("TUTORIALS") != "plain":
            executed = execute(notebook, EXECUTED / path.name)
        notebook = executed or notebook
        page, media = render(notebook, path.name)
        kinds = {name.rpartition(".")[2] for name in media}
        assert executed is None or kinds >= {"wav", "png"}, f"{path.name} has no sound or picture"
        source = f"tutorials/{path.stem}"
        files.append(File.generated(config, f"{source}.md", content=page))
        for name, data in media.items():
            files.append(File.generated(config, f"{source}/{name}", content=data))
    return files


def find_executed(notebook: NotebookNode, stored: Path) -> NotebookNode | None:
    """Return the stored notebook with outputs, if it has the same cells, or else None."""
    if not stored.is_file():
        return None
    executed = nbformat.read(stored, as_version=4)
    is_same = [cell.source for cell in executed.cells] == [cell.source for cell in notebook.cells]
    return executed if is_same else None


def execute(notebook: NotebookNode, stored: Path) -> NotebookNode:
    """Run a notebook and the assertions about its results, and store it with its outputs."""
    notebook.cells.append(nbformat.v4.new_code_cell(PROMISES[stored.stem]))
    client = NotebookClient(notebook, timeout=TIMEOUT_SECONDS, kernel_name="python3")
    executed = client.execute(cwd=str(ROOT))
    executed.cells.pop()
    stored.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(executed, stored)
    return executed


def render(notebook: NotebookNode, name: str) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and its sounds and pictures by file name."""
    media: dict[str, bytes] = {}

    def store(kind: str, encoded: str) -> str:
        data = base64.b64decode(encoded)
        file = f"{hashlib.sha256(data).hexdigest()[:16]}.{SUFFIXES[kind]}"
        media[file] = data
        return f'src="{file}"'

    def show(output: NotebookNode, alt: str) -> str:
        if output.output_type == "stream":
            return f"```text\n{output.text.rstrip()}\n```" if output.name == "stdout" else ""
        data = output.data
        if "text/html" in data:
            html = data["text/html"].replace('border="1" class="dataframe"', "")
            html = _DATA_URI.sub(lambda match: store(match[1], match[2]), html)
            return f'<div class="output">{html}</div>'
        if "image/png" in data:
            return f'<p><img alt="{escape(alt)}" {store("image/png", data["image/png"])}></p>'
        return f"```text\n{data['text/plain']}\n```"

    link = f'<a href="../{name}" download>Download this notebook</a>'
    parts = []
    for cell in notebook.cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
        else:
            parts.append(f"```python\n{cell.source}\n```")
            alt = cell.metadata.get("alt", "")
            parts += [show(output, alt) for output in cell.outputs]
    parts.insert(1, link)
    return "\n\n".join(parts) + "\n", media
