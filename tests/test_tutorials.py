"""The tutorials run from end to end, and their results are those that their texts describe."""

from pathlib import Path
from typing import Any

import pytest

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
NOTEBOOKS = sorted(TUTORIALS.glob("*.ipynb"))

CLAIMS = {
    "hear-a-hearing-loss": """
normal, mild, severe = (level_spl(hlsim.simulate(presented, name)) for name in ("NH", "N2", "N4"))
assert bool((normal > mild).all()) and bool((mild > severe).all())
assert float(level_spl(speech) - level_spl(perceived)) == pytest.approx(55.0, abs=3.0)
assert float(normal[-1] - severe[-1]) == pytest.approx(15.0, abs=3.0)  # recruitment
""",
    "train-your-own-network": """
results = table.set_index(["condition", "speech (dB SPL)"])
network, nal_r = results.loc["this network"], results.loc["NAL-R"]
assert bool((network["HASPI"] >= nal_r["HASPI"]).all())
assert float(network["loudness error (dB)"].abs().max()) < 6.0
assert sum(history[-20:]) < 0.5 * sum(history[:20])
""",
    "score-an-enhancement-system": """
assert float(level_spl(aided).mean()) == pytest.approx(table["output level (dB SPL)"].iloc[-1], abs=0.01)
assert table["HASPI"].iloc[0] < table["HASPI"].iloc[1] < table["HASPI"].iloc[-1]
assert binaural["noise in front"]["normal hearing"] < binaural["noise from the left"]["normal hearing"]
""",
}


def _read(path: Path) -> Any:
    return pytest.importorskip("nbformat").read(path, as_version=4)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_are_stored_without_outputs(path: Path) -> None:
    for cell in _read(path).cells:
        if cell.cell_type == "code":
            assert not cell.outputs and cell.execution_count is None, cell.source


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_tutorials_run_and_keep_their_promises(path: Path) -> None:
    client = pytest.importorskip("nbclient")
    pytest.importorskip("pandas")
    notebook = _read(path)
    outputs = len(notebook.cells)
    claims = "import pytest\n" + CLAIMS[path.stem]
    notebook.cells.append(pytest.importorskip("nbformat").v4.new_code_cell(claims))
    executed = client.NotebookClient(notebook, timeout=1800, kernel_name="python3").execute(
        cwd=str(TUTORIALS.parents[1])
    )
    shown = [
        output.data
        for cell in executed.cells[:outputs]
        for output in cell.get("outputs", [])
        if "data" in output
    ]
    assert any("<audio" in data.get("text/html", "") for data in shown)
    assert any("image/png" in data for data in shown)
