"""Runs lessons in full and stores their outputs: `python tests/run_lessons.py [FILE ...]`.

Without names, all of notebooks/, some five minutes each on two cores. The metadata of a lesson keep
a hash of the code that made its outputs; test_lessons.py compares it with the code that is there.
"""

import hashlib
import os
import sys
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from tqdm import tqdm

LESSONS = Path(__file__).parent.parent / "notebooks"


def fingerprint(notebook):
    """Of the sources of all code cells, in their order."""
    sources = [cell.source for cell in notebook.cells if cell.cell_type == "code"]
    return hashlib.sha256("\0".join(sources).encode()).hexdigest()[:16]


def run(path):
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=None, resources={"metadata": {"path": path.parent}},
                            record_timing=False)
    with tqdm(total=len(notebook.cells), desc=path.stem, unit="cell") as bar:
        client.on_cell_complete = lambda cell, cell_index: bar.update(cell_index + 1 - bar.n)
        client.execute()
    for cell in notebook.cells:  # without progress bars
        if cell.cell_type == "code":
            cell.outputs = [out for out in cell.outputs if out.get("name") != "stderr"]
    notebook.metadata["executed"] = fingerprint(notebook)
    nbformat.write(notebook, path)


if __name__ == "__main__":
    os.environ.pop("CI", None)  # it asks for the short forms
    for name in sys.argv[1:] or sorted(LESSONS.glob("*.ipynb")):
        run(Path(name).resolve())
