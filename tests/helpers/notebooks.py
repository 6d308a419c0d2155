"""The notebooks: each is a .py (jupytext, py:percent), and the .ipynb beside it is that .py, executed.

python -m tests.helpers.notebooks [NAME...] executes and writes them anew, all or those whose names begin so.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "notebooks"
_SECONDS = 600
_HEADER = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}, "language_info": {"name": "python"}}


def sources() -> list[Path]:
    """The .py files in the order in which they are read."""
    return sorted(FOLDER.glob("[0-9]*_*.py"), key=lambda path: int(path.name.split("_")[0]))


def read(source: Path, changes: dict[str, str] | None = None) -> nbformat.NotebookNode:
    """The notebook of ``source``, not executed; ``changes`` are texts to be replaced in it, each of which must be there."""
    text = source.read_text(encoding="utf-8")
    for old, new in (changes or {}).items():
        assert old in text, f"{source.name}: no '{old}'"
        text = text.replace(old, new)
    notebook = jupytext.reads(text, fmt="py:percent")
    notebook.metadata.clear()
    notebook.metadata.update(_HEADER)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"  # nbformat draws them at random
    return notebook


def execute(notebook: nbformat.NotebookNode) -> nbformat.NotebookNode:
    """Run it as a reader does, in its folder. Raises nbclient's CellExecutionError, which shows cell and traceback."""
    NotebookClient(notebook, timeout=_SECONDS, kernel_name="python3", resources={"metadata": {"path": str(FOLDER)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # wall clock
    return notebook


def main() -> None:
    for source in sources():
        if len(sys.argv) > 1 and not source.name.startswith(tuple(sys.argv[1:])):
            continue
        begin = time.perf_counter()
        nbformat.write(execute(read(source)), source.with_suffix(".ipynb"))
        print(f"{source.stem}: {time.perf_counter() - begin:.0f} s, {source.with_suffix('.ipynb').stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
