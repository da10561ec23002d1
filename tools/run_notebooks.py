"""Run notebooks from top to bottom and keep what they put out: python tools/run_notebooks.py NOTEBOOK..."""

from __future__ import annotations

import sys

import nbclient
import nbformat

PATIENCE_S = 3600


def main() -> None:
    """Run each; one that fails is not written."""
    for path in sys.argv[1:]:
        notebook = nbformat.read(path, as_version=4)
        nbclient.NotebookClient(notebook, timeout=PATIENCE_S, kernel_name="python3").execute()
        for cell in notebook.cells:
            cell.metadata.pop("execution", None)  # the times of day change each time
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
