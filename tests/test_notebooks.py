"""The notebooks run from their first cell to their last; each checks itself, gradients too."""

import json
import warnings

import doc_notebooks
import pytest


@pytest.mark.parametrize("path", doc_notebooks.notebooks(), ids=lambda path: path.stem)
def test_notebook_runs(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    kept = [cell["outputs"] for cell in doc_notebooks.code_cells(notebook)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        doc_notebooks.run(notebook, path.name)
    said = "".join(
        "".join(output.get("text", []))
        for cell in doc_notebooks.code_cells(notebook)
        for output in cell["outputs"]
    )
    assert "gradients agree" in said
    assert any("data" in output for outputs in kept for output in outputs), "run doc_notebooks.py"


def test_a_cell_that_fails_is_named():
    cells = [{"cell_type": "code", "source": [line]} for line in ("x = 1", "assert x == 2")]
    with pytest.raises(AssertionError) as caught:
        doc_notebooks.run({"cells": cells}, "some.ipynb")
    assert "some.ipynb, cell 2" in str(caught.traceback[-1].path)
