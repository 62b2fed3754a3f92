"""Run the notebooks of examples/notebooks and keep what their cells print and draw.

Usage: python scripts/docs/doc_notebooks.py [NOTEBOOK ...]
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples/notebooks"


def notebooks() -> list[Path]:
    return sorted(FOLDER.glob("*.ipynb"))


def code_cells(notebook: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def run(notebook: dict[str, Any], name: str = "notebook") -> None:
    """Run the cells one after another, as a kernel would, and put in what they print and draw."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names: dict[str, Any] = {"__name__": "__main__"}
    for number, cell in enumerate(code_cells(notebook), 1):
        said, drawn = io.StringIO(), []
        shown, plt.show = plt.show, lambda drawn=drawn: drawn.extend(_pictures())
        try:
            with contextlib.redirect_stdout(said):
                exec(compile("".join(cell["source"]), f"{name}, cell {number}", "exec"), names)
        finally:
            plt.show = shown
            plt.close("all")
        cell["execution_count"] = number
        cell["outputs"] = [*_text(said.getvalue()), *drawn]


def _text(said: str) -> list[dict[str, Any]]:
    lines = said.splitlines(keepends=True)
    return [{"name": "stdout", "output_type": "stream", "text": lines}] if lines else []


def _pictures() -> list[dict[str, Any]]:
    """The open figures, as a notebook holds them; they are closed."""
    import matplotlib.pyplot as plt

    found = []
    for number in plt.get_fignums():
        file = io.BytesIO()
        plt.figure(number).savefig(file, format="png", dpi=72, bbox_inches="tight")
        data = {"image/png": base64.b64encode(file.getvalue()).decode(), "text/plain": ["figure"]}
        found.append({"data": data, "metadata": {}, "output_type": "display_data"})
    plt.close("all")
    return found


def main() -> None:
    for path in [Path(name) for name in sys.argv[1:]] or notebooks():
        notebook = json.loads(path.read_text(encoding="utf-8"))
        run(notebook, path.name)
        text = json.dumps(notebook, indent=1, ensure_ascii=False)
        path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
