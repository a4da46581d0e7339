"""A parsed page, and texts that would do harm if they ran."""

from __future__ import annotations

import json
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

from brainbench.core.records import ResultRecord

VOID = {"meta", "img", "br", "hr", "input", "link"}
HOSTILE = (
    "</script><script>document.title='pwned'</script>",
    '"><img src=x onerror="document.title=\'pwned\'">',
    "' onmouseover='document.title=1' x='",
    "</style><svg onload=document.title='pwned'>",
    "javascript:document.title='pwned'",
    "{{ 7 * 7 }}{% raw %}",
    "]]><!--<title>pwned</title>",
)


class Page(HTMLParser):
    """The parsed page; fails on tags that do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(text for tag, text in self.texts if tag not in ("style", "script")).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), f"{tag} repeats an attribute"
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def shape(self) -> list[tuple[str, tuple[str, ...]]]:
        return [(tag, tuple(attributes)) for tag, attributes in self.elements]


def poison(data: Any, text: str) -> Any:
    """Replace every string of a record but its status, keys of open mappings included."""
    if isinstance(data, dict):
        poisoned = {key: value if key == "status" else poison(value, text) for key, value in data.items()}
        for key in ("baselines", "provenance"):
            if key in poisoned:
                poisoned[key] |= {text: next(iter(poisoned[key].values()))}
        return poisoned
    if isinstance(data, list):
        return [poison(item, text) for item in data]
    return text if isinstance(data, str) else data


def poisoned(record: ResultRecord, text: str) -> ResultRecord:
    return ResultRecord.from_json(poison(json.loads(record.to_json()), text))
