"""Ways of values through the code, measured: which modules stand on the call stack where a value is looked at.

    python docs/site/walks.py            writes the table of docs/architecture.md
    python docs/site/walks.py --check    fails where the table is another one

Each way names the functions at which its value is looked at, in order. The job runs once; at the first call of each of
these functions the modules of the call stack are noted. A module counts once, where it comes first.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"
BEGIN, END = "<!-- ways: written by docs/site/walks.py -->", "<!-- end of ways -->"
ROOMS = ("brainbench", "robotics_bridge", "leaderboards")


@dataclass(frozen=True)
class Way:
    """A value, the functions at which it is looked at (``module:function``), and a job that calls them."""

    title: str
    stops: tuple[str, ...]
    job: Callable[[], Any]


def measure(way: Way) -> list[str]:
    """Return the modules that the value of a way passes, in order."""
    left = list(way.stops)
    passed: dict[str, None] = {}

    def look(frame: FrameType, event: str, _: Any) -> None:
        if event != "call" or not left:
            return
        name = f"{frame.f_globals.get('__name__')}:{frame.f_code.co_qualname}"
        if name == left[0]:
            left.pop(0)
            stack = []
            caller: FrameType | None = frame
            while caller is not None:
                stack.append(str(caller.f_globals.get("__name__")))
                caller = caller.f_back
            passed.update((name, None) for name in reversed(stack) if name.partition(".")[0] in ROOMS)

    sys.setprofile(look)
    threading.setprofile(look)
    try:
        way.job()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    if left:
        raise SystemExit(f"{way.title}: {left[0]} was never called; name the functions anew in {Path(__file__).name}.")
    return list(passed)


def table(ways: tuple[Way, ...]) -> str:
    """Return the Markdown of all ways."""
    lines = []
    for way in ways:
        modules = measure(way)
        path = " → ".join(f"`{name.replace('.', '/')}`" for name in modules)
        lines.append(f"**{way.title}** ({len(modules)} modules). {path}.\n")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit with 1 where the page differs")
    options = parser.parse_args()
    page = PAGE.read_text(encoding="utf-8")
    head, _, rest = page.partition(BEGIN)
    before, _, tail = rest.partition(END)
    written = f"\n\n{table(WAYS)}\n"
    if options.check:
        raise SystemExit(0 if before == written else f"{PAGE.name} has other ways; run python docs/site/walks.py.")
    PAGE.write_text(f"{head}{BEGIN}{written}{END}{tail}", encoding="utf-8")


def _score() -> None:
    import brainbench

    brainbench.score("zhuang-small.supervised")


def _page() -> None:
    from leaderboards.site.build import build_leaderboard
    from leaderboards.store import read_records

    with tempfile.TemporaryDirectory() as folder:
        build_leaderboard(read_records(ROOT / "leaderboards" / "results"), Path(folder) / "site")


def _simulate() -> None:
    from brainbench.stimuli import PlacedObject, Scene, WhiskerArray, Whisking, simulate
    from brainbench.stimuli.objects.collections import resolve_objects

    array = WhiskerArray.of("mouse", whiskers="C2")
    (torus,) = resolve_objects(["torus"], surfaces=True).values()
    placed = PlacedObject(torus.load(), position=(0.03, 0.0, 0.0))
    simulate([Scene("way", array, (placed,), Whisking(frequency=10))], fidelity="fast", cache=False)


_STIMULI = "brainbench.stimuli"
WAYS = (
    Way(
        "Young's modulus of a whisker, to the kernel",
        (
            f"{_STIMULI}.whiskers.array:published_whisker",
            f"{_STIMULI}.whiskers.whisker:Whisker.bending_stiffness",
            f"{_STIMULI}.engines.rod.packing:pack_chains",
        ),
        _simulate,
    ),
    Way(
        "The motion of a whisk, to the pose of a base",
        (f"{_STIMULI}.scenes.scene:Scene.jobs", f"{_STIMULI}.motion.trajectories:ArrayFollicle.pose"),
        _simulate,
    ),
    Way(
        "A mesh, to the shape that a whisker touches",
        (
            f"{_STIMULI}.objects.procedural.families:make",
            f"{_STIMULI}.objects.solid:PlacedObject.obstacle",
            f"{_STIMULI}.engines.reach:reachable",
        ),
        _simulate,
    ),
    Way(
        "The name of a model, to a score",
        (
            "brainbench.scoring.scores:score_record",
            "brainbench.models.registry:locate_model",
            "brainbench.models.activations:extract",
            "brainbench.metrics.measures.rsa:RSA.compare_layers",
        ),
        _score,
    ),
    Way(
        "A record, to a page",
        (
            "leaderboards.store:_read",
            "leaderboards.boards:rank",
            "leaderboards.ranking:told_apart",
            "leaderboards.site.build:page_board",
        ),
        _page,
    ),
)

if __name__ == "__main__":
    main()
