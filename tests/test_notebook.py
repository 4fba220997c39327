"""The notebook runs from top to bottom, with shorter settings in the cell for them."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

TOUR = Path(__file__).parent.parent / "notebooks" / "tour.ipynb"


@pytest.fixture(scope="module")
def outputs():
    notebook = nbformat.read(TOUR, as_version=4)
    (parameters,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ()))
    parameters.source = "frames, seeds, horizon = 2_048, [0, 1], 80"
    NotebookClient(notebook, timeout=240, kernel_name="python3").execute()
    return [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]


def test_it_compares_draws_and_answers(outputs):
    printed = "".join(output.text for output in outputs if output.output_type == "stream" and output.name == "stdout")
    assert "bound: hindsight" in printed and "myopic_optimal" in printed
    assert "was rejected by dqn: " in printed and "The exact search finds" in printed
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 3
    assert sum("text/html" in output.get("data", {}) for output in outputs) == 2


def test_nothing_is_warned_of(outputs):
    written = [output.text for output in outputs if output.output_type == "stream" and output.name == "stderr"]
    # Where Ray is installed, importing TorchRL imports it, and Ray misses its widgets.
    assert not [text for text in written if "ipywidgets" not in text]
