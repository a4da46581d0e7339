"""Execute the notebooks of the documentation.

    PYTHONPATH=. python docs/notebooks/build.py [NAME ...] [--out FOLDER]

Each is written as a page of Markdown in ``sources``, so that it is read and changed as text: blocks of Python become cells of
code, each section a cell of text. The committed notebooks hold what the cells gave.
"""

from __future__ import annotations

import argparse
import os
import re
import tempfile
from pathlib import Path

FOLDER = Path(__file__).parent
NAMES = tuple(sorted(path.stem for path in (FOLDER / "sources").glob("*.md")))


def cells(name: str) -> list[tuple[str, str]]:
    """Return the cells of a notebook as (``markdown`` or ``code``, text)."""
    text = (FOLDER / "sources" / f"{name}.md").read_text(encoding="utf-8")
    found = []
    for index, part in enumerate(re.split(r"^```(?:python)?\n", text, flags=re.MULTILINE)):
        if index % 2:
            found.append(("code", part.strip()))
        else:
            found += [("markdown", section.strip()) for section in re.split(r"^(?=## )", part, flags=re.MULTILINE)]
    return [(kind, body) for kind, body in found if body]


def make(name: str, folder: Path) -> object:
    """Return the notebook, executed in an empty ``folder``.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    import nbformat
    from nbclient import NotebookClient

    made = [
        nbformat.v4.new_markdown_cell(text, id=f"cell-{index}")
        if kind == "markdown"
        else nbformat.v4.new_code_cell(text, id=f"cell-{index}")
        for index, (kind, text) in enumerate(cells(name))
    ]
    notebook = nbformat.v4.new_notebook(cells=made)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        # Times of execution would change at every build.
        cell.metadata.pop("execution", None)
    return notebook


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all by default: {', '.join(NAMES)}")
    parser.add_argument("--out", type=Path, default=FOLDER)
    options = parser.parse_args()
    for name in options.names:
        if name not in NAMES:
            parser.error(f"no notebook {name!r}; there are {', '.join(NAMES)}")
    import nbformat

    # The kernel starts in an empty folder and must find the package of this checkout.
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    for name in options.names or NAMES:
        with tempfile.TemporaryDirectory() as folder:
            nbformat.write(make(name, Path(folder)), options.out / f"{name}.ipynb")
        print(options.out / f"{name}.ipynb")


if __name__ == "__main__":
    main()
