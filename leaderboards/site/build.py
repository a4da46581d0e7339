"""The static site of a leaderboard: a folder of pages that need no server and no network.

``index.html`` holds the table as compact columns that its script shows 50 rows at a time, so that it opens
quickly however many records there are; what concerns one model alone is on that model's page. Besides
there are ``figures.html``, the records themselves, and the table as CSV and JSON, all from one list of rows.

A build replaces and removes only what a build wrote: ``build-manifest.json`` lists each file with its SHA-256 hash.
While a build is under way it lists the hashes before and after, so that the next build also knows the files of one
that was killed.

The pages of a score, a report that stands alone and a model's page, are one file each without scripts, fonts or
anything else from the network. Every text of a record is escaped, and a content security policy lets nothing but
our own style and script take effect (:func:`render`). Equal records give equal pages.
"""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import math
import os
import shutil
import zipfile
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, BinaryIO

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from brainbench.core.errors import BrainbenchError, DataError, UsageError, visible, visible_lines, visible_name
from brainbench.core.files import (
    atomic_path,
    file_hash,
    is_temporary,
    lock_folder,
    read_json,
    sweep,
    sync_file,
    to_json,
    to_plain,
    writable,
    write_json,
    write_text,
)
from brainbench.core.reading.regular import temporary_folder
from brainbench.core.reading.values import typed_values
from brainbench.core.records import ResultRecord, Score
from brainbench.core.statistics import compare_scores
from leaderboards import text
from leaderboards.audit import remarks
from leaderboards.boards import RAW_INPUT, Baseline, Board, conclusions, means_over, rank, table_of
from leaderboards.entries import Entry
from leaderboards.figures.charts import board_figures
from leaderboards.figures.rdms import colour_stops, rdm_picture
from leaderboards.figures.record import (
    beside,
    diagram,
    draw_time_course,
    layer_order,
    layers,
    raw,
    stimulus_parts,
    unit_parts,
)
from leaderboards.figures.svg import interval_ends, score_scale
from leaderboards.ranking import MEANINGS, lacking, not_repeatable, standing_of
from leaderboards.store import MAKE_ONE, SCHEMA_PATH, StoredRecord, record_text
from leaderboards.text import ways_to_get, with_floats

_TEMPLATES = Path(__file__).parents[1] / "templates"


def render(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped, under a content security policy.

    The policy names our style and script by their hash, so even markup that slipped past the
    escaping could not run, load or send anything.
    """
    return _environment().get_template(template).render(**values, **_policy())


@cache
def _policy() -> dict[str, Any]:
    style, script = ((_TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_source_hash(style)}'; script-src '{_source_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return {"policy": policy, "style": Markup(style), "script": Markup(script)}


def render_markdown(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped for Markdown, and for the HTML that Markdown may hold."""
    environment = _environment().overlay(autoescape=False, finalize=escape_markdown)
    return environment.get_template(template).render(**values)


_MARKDOWN = str.maketrans({mark: f"\\{mark}" for mark in "\\`*_{}[]|#!"} | {"<": "&lt;", ">": "&gt;"})


def escape_markdown(value: Any) -> Any:
    """Return a value as text of one line that Markdown, and the HTML in it, take literally; markup stays as it is."""
    return value if isinstance(value, Markup) else " ".join(visible_lines(str(value)).translate(_MARKDOWN).split())


def script_json(value: Any) -> Any:
    """Return ``value`` as JSON that can stand inside a script element: nothing in it can end the element."""
    text = json.dumps(_visible_texts(to_plain(value)), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark, escaped in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026")):
        text = text.replace(mark, escaped)
    return Markup(text)


def _visible_texts(value: Any) -> Any:
    """Return plain values, or what a template shows, with control characters as escapes; markup stays as it is."""
    if isinstance(value, dict):
        return {visible(key): _visible_texts(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_visible_texts(inner) for inner in value]
    return visible_lines(value) if type(value) is str else value


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=_visible_texts,
    )  # fmt: skip
    helpers = (text.number, text.probability, text.count, text.span, text.level)
    environment.filters |= {helper.__name__: helper for helper in helpers}
    environment.globals |= {"STANDING": MEANINGS, "SYNTHETIC": text.SYNTHETIC, "p_sentence": text.p_sentence}
    environment.globals["colour_stops"] = colour_stops()
    return environment


def _source_hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_MOST_PAIRS = 100  # an RDM with more pairs than this is shown as a picture only; its numbers are in the record


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, standing and reasons, p, reliability and noise ceiling; baselines and
    animal-to-animal beside it; both RDMs; every layer with the held-out choice marked; the animals; methods, model
    card and provenance.
    """
    # Base64, so that nothing in the record can be read as markup.
    embedded = base64.b64encode((record.to_json() + "\n").encode()).decode()
    link = f"data:application/json;base64,{embedded}"
    page = render("report.html.j2", **_score_view(record), record_link=link)
    return write_text(path, page)


def model_page(entry: Entry) -> str:
    """Return a model's page on a site."""
    record, card = entry.records[0], entry.card
    graph = card.graph or layer_order(record.score)
    view = _score_view(record) | {
        "title": f"{entry.name}: brainbench leaderboard",
        "entry": entry,
        "standing": entry.standing,
        "graph": diagram(graph, entry.name) if graph else None,
        "connected": card.graph is not None,
        "layer_chart": layers(entry.records),
        "training": text.training_rows(card),
    }
    return render("model.html.j2", **view, here="", root="../")


def comparisons(record: ResultRecord) -> list[str]:
    """Say how the score stands to each baseline, by the paired test over animals and stimuli."""
    score, others = record.score, dict(record.baselines)
    if record.animal_to_animal is not None:
        others["animal-to-animal"] = record.animal_to_animal
    sentences, untested = [*filter(None, (text.unique_sentence(score),))], []
    for name, baseline in others.items():
        comparison = compare_scores(score, baseline)
        if not comparison.verdict or not "ok" == score.status == baseline.status:
            untested.append(name)
            continue
        words = f"difference {text.number(comparison.difference)} {text.span(comparison.interval)}"
        sentences.append(f"{comparison.verdict} {name}: {words}.")
    if untested:
        lacks = lacking(sum(item.status == "ok" for item in score.subjects), len(score.stimuli))
        why = f"this needs {lacks}" if lacks else "not both state reliable values of single animals and stimuli"
        sentences.append(f"Not compared with {', '.join(untested)}: {why}.")
    return sentences


def _score_view(record: ResultRecord) -> dict[str, Any]:
    """Return what both templates show of a score."""
    score, card = record.score, record.card
    raw_input = record.baselines.get(RAW_INPUT)
    above = raw_input is not None and compare_scores(score, raw_input).verdict == "Above"
    name = visible_name(score.name)
    rows = [("model", name, score), ("animals", "animal-to-animal", record.animal_to_animal)]
    rows += [("baseline", name, item) for name, item in record.baselines.items()]
    pairs = list(zip(combinations(score.stimuli, 2), score.model_rdm, score.brain_rdm, strict=False))
    return {
        "name": name,
        "title": f"{name}: brainbench score",
        "record": record,
        "standing": standing_of(score, above_raw=above),
        "scaled": math.isfinite(score.scaled),
        "not_repeatable": not_repeatable(record),
        "ways": text.ways_to_get(record),
        "recordings": score.provenance.recordings_name,
        "beside": beside(record),
        "raw": raw(record),
        "rows": [item for item in rows if item[2] is not None],
        "layer_chart": layers([record]),
        "layer_p": score.provenance.layer_p,
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "pairs": pairs if len(pairs) <= _MOST_PAIRS else [],
        "groups": text.group_rows(score.provenance.statistics),
        "parts": [part for part in (stimulus_parts(score), unit_parts(score.provenance.statistics)) if part],
        "time_course": draw_time_course(score.provenance.statistics),
        "comparisons": comparisons(record),
        "methods": text.methods([record]),
        "command": text.command_of(record),
        "card": text.card_rows(card) if card else [],
        "provenance": text.provenance_rows(score.provenance),
        "file_name": record.file_name,
        "graph": diagram(card.graph, name) if card and card.graph else None,
    }


COLUMNS: list[dict[str, Any]] = read_json(_TEMPLATES / "columns.json")
"""Columns of the table on the first page, as ``page.js`` takes them."""

_COMMON = ("benchmark", "recordings", "recordings_hash", "stimuli_hash", "time", "estimator", "metric", "synthetic")
_CARD = ("family", "encoder", "attender", "objective", "augmentation", "parameters", "multiply_adds", "top1", "top5")
FIELDS = (
    *_COMMON, "kind", "rank_first", "rank_last", "name", "scaled", "scaled_low", "scaled_high", "unique", "standing",
    "same_as", "unranked_because", "notes", "p", "spread", "value", "low", "high", "r", "reliability", "ceiling_lower",
    "ceiling_upper", "layer", "seeds", "animals", *_CARD, "seed", "weights", "version", "get", "page", "records",
)  # fmt: skip
"""Columns of the downloads."""


def board_label(board: Board) -> str:
    """Return benchmark and recordings of a board and what tells it from others of the same recordings."""
    return f"{f'{board.benchmark}: ' if board.benchmark else ''}{board.recordings}: {_rules(board)}"


def table_rows(board: Board) -> list[dict[str, Any]]:
    """Return every entry of a board and its baselines by :data:`FIELDS`; None where nothing is known."""
    common = {name: getattr(board, name) for name in _COMMON}
    rows = [*map(_entry_row, board.entries), *map(_baseline_row, board.baselines)]
    return [{name: _known((common | row).get(name)) for name in FIELDS} for row in rows]


def table_csv(rows: Iterable[dict[str, Any]]) -> str:
    """Return :func:`table_rows` as CSV with one header line."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(stream, FIELDS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return stream.getvalue()


def page_board(key: str, board: Board, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a board and its :func:`table_rows` as columns, by a key: what the script of the first page shows."""
    # Records of earlier versions state no chance: a board of such alone shows the metric's own values.
    scaled = any(row["scaled"] is not None for row in rows)
    score, low, high = ("scaled", "scaled_low", "scaled_high") if scaled else ("value", "low", "high")
    columns = []
    for row, entry in zip(rows, [*board.entries, *[None] * len(board.baselines)], strict=True):
        cells = {name: value for name, value in row.items() if name not in _COMMON}
        cells |= {"score": row[score], "score_low": row[low], "score_high": row[high]}
        if entry is not None:
            cells |= {"apart": entry.not_repeatable or None, "seed": entry.card.seed}
            cells |= {"runs": [record.score.scaled for record in entry.records] if entry.seeds > 1 else None}
        columns.append({name: with_floats(value, lambda cell: _known(round(cell, 6))) for name, value in cells.items()})
    trusted = [row for row in columns if row["standing"] != "unreliable"]
    values = [row[name] for row in trusted for name in ("score", "score_low", "score_high") if row[name] is not None]
    axis = score_scale(values, [], 0, 1)
    animals = next((row for row in columns if row["kind"] == "animals" and row["score_low"] is not None), None)
    return {
        "key": key,
        "recordings": (f"{board.benchmark}: " if board.benchmark else "")
        + board.recordings
        + (f" ({board.recordings_hash[:6]})" if board.recordings_hash else ""),
        "label": _rules(board),
        "about": _about(board),
        "conclusions": conclusions(board),
        "scaled": scaled,
        "ranked": bool(board.ranked),
        "axis": {"low": axis.low, "high": axis.high, "ticks": axis.ticks},
        "band": [animals["score_low"], animals["score_high"]] if animals else None,
        "data": {
            name: [row.get(name) for row in columns] for name in dict.fromkeys(key for row in columns for key in row)
        },
    }


def _rules(board: Board) -> str:
    parts = [board.metric or "metric not stated", board.estimator]
    parts += [f"time {board.time}"] if board.time else []
    parts += [f"stimuli {board.stimuli_hash[:6]}"] if board.stimuli_hash else []
    return ", ".join(parts)


def _about(board: Board) -> list[str]:
    first = f"{board.recordings}: {len(board.conditions)} stimuli, estimator {board.estimator}."
    brain, stimuli = board.recordings_hash or "unknown", board.stimuli_hash or "unknown"
    about = [f"Benchmark {board.benchmark}." if board.benchmark else "", first, board.stimuli]
    about += [f"Cite: {work.rstrip('.')}." for work in board.citations]
    return [*filter(None, about), f"Hash of the recordings {brain}, of the stimuli {stimuli}."]


def _entry_row(entry: Entry) -> dict[str, Any]:
    score, card = entry.score, entry.card
    low, high = interval_ends(entry.interval) or (None, None)
    # Where there are several seeds, what one of them states does not stand for all.
    alone = {"low": None, "high": None} if entry.seeds > 1 else {"seed": card.seed, "weights": card.weights}
    names = ("name", "scaled", "unique", "standing", "p", "spread", "value", "r", "seeds")
    return {
        **_score_row(score), **{name: getattr(card, name) for name in _CARD},
        **{name: getattr(entry, name) for name in names},
        **{name: getattr(entry, name) or None for name in ("same_as", "unranked_because", "layer", "page")},
        "kind": "model", "rank_first": entry.first, "rank_last": entry.last, "scaled_low": low, "scaled_high": high,
        "notes": "; ".join(entry.notes) or None, "version": score.provenance.version or None,
        "get": "; ".join(ways_to_get(entry.records[0])),
        "records": " ".join(record.identity for record in entry.records), **alone,
    }  # fmt: skip


def _baseline_row(baseline: Baseline) -> dict[str, Any]:
    score = baseline.score
    tested = math.isfinite(score.p) or score.status != "ok"
    return _score_row(score) | {
        "kind": baseline.kind,
        "name": baseline.name,
        "standing": standing_of(score, above_raw=False) if tested else None,
        "notes": "; ".join(baseline.notes) or None,
    }


def _score_row(score: Score) -> dict[str, Any]:
    row = {name: getattr(score, name) for name in ("scaled", "value", "p", "r", "reliability", "layer")}
    row |= zip(("low", "high"), interval_ends(score.interval), strict=False)
    row |= zip(("scaled_low", "scaled_high"), interval_ends(score.scaled_interval), strict=False)
    row |= {"animals": len(score.subjects) or None}
    if score.ceiling:
        row |= {"ceiling_lower": score.ceiling.lower, "ceiling_upper": score.ceiling.upper}
    return row


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    value = visible(value) if isinstance(value, str) else value
    # A spreadsheet would run text that starts like a formula.
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return f"'{value}"
    return value


MANIFEST = "build-manifest.json"
_Hashes = dict[str, list[str]]  # path in the site → the hashes that a build may have given it
_Content = str | bytes | BinaryIO  # content of a file of the site; a large one as a stream
_MANY = 100  # files that are brought to disk together rather than one by one


@contextmanager
def rebuilt(root: Path) -> Iterator[Callable[[str, _Content], Path]]:
    """Yield a function that takes a file of the new site: its path there and its content.

    The new files appear together when the block ends, the one given first last; after an error the folder is as it was
    before. Another build of the same folder waits until this one has ended.
    """
    check_site(root)
    before = {folder for folder, _, _ in os.walk(root)}
    with writable(root), _unmade(root, before), lock_folder(root):
        listed, present = check_site(root)
        for folder, _, _ in os.walk(root):
            sweep(Path(folder))
        _write_manifest(root, listed)
        new: _Hashes = {}
        staged: list[Path] = []
        with ExitStack() as stack:

            def stage(name: str, content: _Content) -> Path:
                """Write a file of the new site beside its place, and return that place."""
                temporary = stack.enter_context(atomic_path(root / name, sync=False))
                if isinstance(content, (str, bytes)):
                    data = content.encode() if isinstance(content, str) else content
                    temporary.write_bytes(data)
                    new[name] = [hashlib.sha256(data).hexdigest()]
                else:
                    with temporary.open("wb") as stream:
                        shutil.copyfileobj(content, stream)
                    new[name] = [file_hash(temporary, length=64)]
                staged.append(temporary)
                return root / name

            yield stage
            if len(staged) > _MANY and hasattr(os, "sync"):
                os.sync()
            else:
                for temporary in staged:
                    sync_file(temporary)
            both = {name: listed.get(name, []) + new.get(name, []) for name in listed.keys() | new.keys()}
            _write_manifest(root, both)
        for name in present - new.keys():
            (root / name).unlink(missing_ok=True)
        _write_manifest(root, new)


@contextmanager
def _unmade(root: Path, before: Container[str]) -> Iterator[None]:
    """After an error remove the folders that a build made, and a manifest that lists nothing."""
    try:
        yield
    except BaseException:
        if _read(root) == {}:
            (root / MANIFEST).unlink()
        for folder, _, _ in os.walk(root, topdown=False):
            if folder not in before:
                with suppress(OSError):
                    Path(folder).rmdir()
        raise


def check_site(root: Path) -> tuple[_Hashes, set[str]]:
    """Return what the manifest of a folder lists and which of it is there."""
    if root.is_file() or root.suffix.lower() in (".html", ".htm"):
        raise UsageError(
            f"A leaderboard is a folder; received {str(root)!r}. For a single page use: brainbench leaderboard report"
        )
    manifest, present = _read(root), set()
    for name in sorted(_files(root)):
        path = root / name
        temporary = is_temporary(path.name) and (manifest is not None or name.startswith(f".{Path(MANIFEST).stem}-"))
        if name == MANIFEST or (temporary and not path.is_symlink()):
            continue
        listed = (manifest or {}).get(name, [])
        if path.is_symlink() or not path.is_file() or file_hash(path, length=64) not in listed:
            what = "was changed since the last build" if listed else "no build of a leaderboard wrote"
            raise UsageError(f"The folder {str(root)!r} holds {name[-80:]!r}, which {what}; name a new folder.")
        present.add(name)
    return manifest or {}, present


def _files(root: Path) -> Iterator[str]:
    """Yield the paths of all files and links below a folder; links are not followed."""
    for folder, folders, files in os.walk(root):
        links = [name for name in folders if (Path(folder) / name).is_symlink()]
        yield from ((Path(folder) / name).relative_to(root).as_posix() for name in (*files, *links))


def _read(root: Path) -> _Hashes | None:
    """Return what the manifest lists; None without one, so that nothing counts as ours."""
    path = root / MANIFEST
    if not os.path.lexists(path):
        return None
    name = f"the manifest of a build {str(path)!r}"
    return typed_values(_Hashes, read_json(path, "manifest of a build"), name, advice=" Give a new folder.")


def _write_manifest(root: Path, hashes: _Hashes) -> None:
    write_json(root / MANIFEST, {name: sorted(set(hashes[name])) for name in hashes})


PAGE = 50  # rows of the table shown at once
MODEL_PAGES = 1000
"""Models of a board that have a page of their own, the best first; a site of one record makes that of any other."""
DOWNLOADS = {
    "data/leaderboard.csv": "Table (CSV)",
    "data/leaderboard.json": "Table (JSON)",
    "data/records.zip": "All records (JSON files, zip)",
    "data/record.schema.json": "JSON Schema of a record",
}


def build_leaderboard(
    records: Iterable[StoredRecord | ResultRecord],
    folder: str | os.PathLike[str],
    *,
    title: str = "Which networks process touch like a brain?",
) -> Path:
    """Write the site into ``folder`` and return its first page.

    The files appear together, the first page last, and none if there is an error. A manifest lists them, and files of
    an earlier build that are no longer needed are removed if they are as the manifest says. Equal records give equal
    files.

    Records are stored ones or in memory; those with problems are listed on the first page and left out of the boards.
    """
    stored = [_stored(item) if isinstance(item, ResultRecord) else item for item in records]
    if not stored:
        raise DataError(f"There are no result records to build a leaderboard from; {MAKE_ONE}")
    root = Path(folder)
    try:
        _write(stored, root, title)
    except BrainbenchError:
        raise
    except Exception:
        # Whatever a record may hold that no check foresaw: it is found by itself and left out, and the site is built.
        usable = [_tried(item) for item in stored]
        if usable == stored:
            raise
        _write(usable, root, title)
    return root / "index.html"


def _stored(record: ResultRecord) -> StoredRecord:
    path = Path(record.file_name)
    try:
        record_text(record)
    except DataError as error:
        return StoredRecord(path, None, str(error))
    return StoredRecord(path, record)


def _tried(stored: StoredRecord) -> StoredRecord:
    try:
        for _ in _pages([stored], ""):
            pass
    except Exception as error:  # noqa: BLE001 - see build_leaderboard
        return StoredRecord(stored.path, None, f"cannot be shown ({type(error).__name__}: {str(error)[:80]})")
    return stored


def _write(stored: Sequence[StoredRecord], root: Path, title: str) -> None:
    with rebuilt(root) as stage:
        for name, content in _pages(stored, title):
            stage(name, content)


def _pages(stored: Sequence[StoredRecord], title: str) -> Iterator[tuple[str, _Content]]:
    """Yield each file of the site with its content, the first page first.

    One after the other: those of thousands of records are gigabytes.
    """
    boards = rank([item.record for item in stored if item.record is not None], remarks(stored))
    for place, board in enumerate(boards):
        rest = (replace(entry, page="") for entry in board.entries[MODEL_PAGES:])
        boards[place] = replace(board, entries=(*board.entries[:MODEL_PAGES], *rest))
    synthetic = any(board.synthetic for board in boards)
    benchmarks, means = means_over(boards)
    rows = [table_rows(board) for board in boards]
    columns = [page_board(str(place), *both) for place, both in enumerate(zip(boards, rows, strict=True), start=1)]
    # Records of earlier versions state no unique part.
    unique = any(part is not None for board in columns for part in board["data"].get("unique", ()))
    table = [column for column in COLUMNS if unique or column["key"] != "unique"]
    yield (
        "index.html",
        render(
            "index.html.j2",
            title=title,
            count_sentence=_count(boards),
            boards=boards,
            labels=[board_label(board) for board in boards],
            concluded=[conclusions(board) for board in boards],
            synthetic=synthetic,
            benchmarks=benchmarks and table_of(benchmarks, means),
            problems=[item for item in stored if item.record is None],
            downloads=DOWNLOADS.items(),
            data=script_json({"boards": columns, "columns": table, "page": PAGE}),
            here="table",
            root="",
        ),
    )
    sections = []
    for place, board in enumerate(boards, start=1):
        figures = board_figures(board)
        if len(boards) > 1:
            figures = [replace(figure, key=f"{figure.key}-{place}") for figure in figures]
        sections.append({"label": board_label(board), "figures": figures})
    about = {"title": "Figures", "synthetic": synthetic, "here": "figures", "root": ""}
    yield "figures.html", render("board_figures.html.j2", boards=sections, **about)
    files = {item.record.identity: item for item in stored if item.record is not None}
    for entry in (entry for board in boards for entry in board.entries if entry.page):
        whole = (files[record.identity].whole for record in entry.records)
        yield f"models/{entry.page}", model_page(replace(entry, records=tuple(filter(None, whole))))
    with temporary_folder() as folder, Path(folder, "records.zip").open("w+b") as stream:
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            # Their names are those of their content, so that unpacking into a folder merges them.
            for name, file in sorted((file.record.file_name, file) for file in files.values() if file.record):
                entry = zipfile.ZipInfo(name)  # its fixed date of 1980 keeps the bytes equal
                entry.compress_type = zipfile.ZIP_DEFLATED
                archive.writestr(entry, text := file.text)
                yield f"records/{name}", text
        stream.seek(0)
        yield "data/records.zip", stream
    yield "data/leaderboard.csv", table_csv(row for part in rows for row in part)
    yield "data/leaderboard.json", to_json([row for part in rows for row in part]) + "\n"
    yield "data/record.schema.json", SCHEMA_PATH.read_bytes()
    if benchmarks:
        yield "data/benchmarks.json", to_json({"benchmarks": benchmarks, "models": means}) + "\n"


def _count(boards: Sequence[Board]) -> str:
    models = sum(len(board.entries) for board in boards)
    results = sum(entry.seeds for board in boards for entry in board.entries)
    counts = f"{text.plural(models, 'model')}"
    counts += f", {text.plural(results, 'record')}" if results != models else ""
    return counts + (f" on {text.plural(len(boards), 'board')}." if len(boards) != 1 else ".")
