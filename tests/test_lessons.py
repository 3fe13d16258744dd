"""The lessons as a reader finds them: with the outputs of the code that they show."""

import nbformat
import pytest
from run_lessons import LESSONS, fingerprint

NOTEBOOKS = sorted(LESSONS.glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_lesson_is_stored_with_the_outputs_of_its_own_code(path):
    notebook = nbformat.read(path, as_version=4)
    assert notebook.metadata.get("executed") == fingerprint(notebook), "python tests/run_lessons.py"
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.output_type == "error"]
    assert path.stat().st_size < 1e6
