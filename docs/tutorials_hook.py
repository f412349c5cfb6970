"""Hook of mkdocs that runs the notebooks in docs/tutorials and shows them as pages, with sounds and pictures.

Executed notebooks are kept in build/tutorials, so that ``mkdocs serve`` runs only those whose cells have changed.
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

SUFFIXES = {"audio/flac": "flac", "image/svg+xml": "svg", "image/png": "png"}
_DATA_URI = re.compile(r'src="data:([\w/+]+);base64,([^"]+)"')


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each notebook. With ``TUTORIALS=plain`` in the environment nothing is run."""
    for path in sorted(TUTORIALS.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        if os.environ.get("TUTORIALS") != "plain":
            notebook = execute(notebook, EXECUTED / path.name)
        page, media = render(notebook, path.name)
        source = f"tutorials/{path.stem}"
        files.append(File.generated(config, f"{source}.md", content=page))
        for name, data in media.items():
            files.append(File.generated(config, f"{source}/{name}", content=data))
    return files


def execute(notebook: NotebookNode, stored: Path) -> NotebookNode:
    """Run a notebook, unless an executed one with the same cells is stored."""
    if stored.is_file():
        executed = nbformat.read(stored, as_version=4)
        if [cell.source for cell in executed.cells] == [cell.source for cell in notebook.cells]:
            return executed
    client = NotebookClient(notebook, timeout=TIMEOUT_SECONDS, kernel_name="python3")
    executed = client.execute(cwd=str(ROOT))
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
