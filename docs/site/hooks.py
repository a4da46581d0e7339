"""What mkdocs does not do: pages from files outside docs/, notebooks as pages, cells without words."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
OUTSIDE = {
    "results.md": "benchmarks/RESULTS.md",
    "contributing.md": "CONTRIBUTING.md",
    "changes.md": "CHANGELOG.md",
    "releasing.md": "RELEASING.md",
}
"""Page → the file of the repository that it shows."""
NOTEBOOKS = {
    f"notebooks/{path.stem}.md": path.relative_to(ROOT).as_posix() for path in (ROOT / "docs/notebooks").glob("*.ipynb")
}
_LINK = re.compile(r"(?<=\]\()(?!https?:|#|mailto:)([^)\s#]+)(#[^)\s]*)?(?=\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made from other files."""
    for page, source in OUTSIDE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=relinked(text, Path(source).parent, Path(page).parent)))
    for page, source in NOTEBOOKS.items():
        notebook = json.loads((ROOT / source).read_text(encoding="utf-8"))
        files.append(File.generated(config, page, content=notebook_page(notebook)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links that leave docs/ to the pages that show their targets."""
    if page.file.src_uri in OUTSIDE or page.file.src_uri in NOTEBOOKS:
        return markdown
    here = Path("docs") / Path(page.file.src_uri).parent
    return relinked(markdown, here, Path(page.file.src_uri).parent)


def on_page_content(html: str, **_: Any) -> str:
    """Make header cells without words plain cells, which screen readers do not announce as headers."""
    return re.sub(r"<th([^>]*)>\s*</th>", r"<td\1></td>", html)


def relinked(markdown: str, here: Path, there: Path) -> str:
    """Return Markdown written for the folder ``here`` of the repository with its links as seen from the page ``there``.

    A link to a file that is no page becomes the file's name as code.
    """
    shown = {source: page for page, source in (OUTSIDE | NOTEBOOKS).items()} | {"README.md": "index.md"}

    def lead(match: re.Match[str]) -> str:
        target = _normal(here / match[1])
        if target in shown:
            return _from(there, shown[target]) + (match[2] or "")
        if target.startswith("docs/"):
            return _from(there, target.removeprefix("docs/")) + (match[2] or "")
        return "#"

    text = _LINK.sub(lead, markdown)
    return re.sub(r"\[([^\]]+)\]\(#\)", lambda match: f"`{match[1].strip('`')}`", text)


def _normal(path: Path) -> str:
    parts: list[str] = []
    for part in path.parts:
        if part == ".." and parts:
            parts.pop()
        elif part not in (".", ".."):
            parts.append(part)
    return "/".join(parts)


def _from(folder: Path, page: str) -> str:
    return "../" * len([part for part in folder.parts if part != "."]) + page


def notebook_page(notebook: dict[str, Any]) -> str:
    """Return an executed notebook as Markdown: text, code, and outputs as they were."""
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
        elif source.strip():
            parts.append(f"```python\n{source}\n```")
            parts += [shown for output in cell["outputs"] if (shown := _output(output))]
    return "\n\n".join(parts) + "\n"


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    if "text/html" in data:
        # Markdown ends an HTML block at an empty line.
        body = re.sub(r"\n\s*\n", "\n", "".join(data["text/html"]))
    elif "image/svg+xml" in data:
        body = re.sub(r"\n\s*\n", "\n", "".join(data["image/svg+xml"]))
    elif "image/png" in data:
        body = f'<img alt="output" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    else:
        text = "".join(output.get("text", data.get("text/plain", "")))
        body = f"<pre>{html.escape(text)}</pre>" if text.strip() else ""
        body = re.sub(r"\n[ \t]*\n", "\n&nbsp;\n", body)
    return f'<div class="nb-output">{body}</div>' if body else ""
