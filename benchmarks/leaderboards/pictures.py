"""Screenshots of the leaderboard and of a report for the documentation, and their accessibility by axe-core.

    brainbench leaderboard build leaderboards/results --out /tmp/site
    npm pack axe-core && tar xf axe-core-*.tgz package/axe.min.js
    brainbench score zhuang-intersection-ln --out /tmp/score
    python -m benchmarks.leaderboards.pictures /tmp/site --report /tmp/score/*.html --axe package/axe.min.js

Needs ``playwright``, ``pillow`` and Chromium (``--chromium PATH``). axe-core (MPL 2.0) is not shipped.
"""

from __future__ import annotations

import argparse
import io
import shutil
from pathlib import Path

VIEWS = {
    "table": ("index.html", 1280, 860, "light"),
    "dark": ("index.html", 1280, 860, "dark"),
    "phone": ("index.html", 390, 844, "light"),
    "model": ("MODEL", 1280, 1500, "light"),
    "model-dark": ("MODEL", 1280, 1500, "dark"),
    "model-phone": ("MODEL", 390, 844, "light"),
    "figures": ("figures.html", 860, 1400, "light"),
    "figures-dark": ("figures.html", 860, 1400, "dark"),
    "report": ("REPORT", 1000, 1040, "light"),
    "report-phone": ("REPORT", 390, 844, "light"),
}
"""View → page, width, height and colours."""
KEPT = ("table", "model", "report")
"""Views whose picture is written; the others are only checked."""


def main() -> None:
    from playwright.sync_api import sync_playwright

    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("site", type=Path)
    options.add_argument("--model", default="zhuang-intersection-ln-small")
    options.add_argument("--report", type=Path)
    options.add_argument("--axe", type=Path)
    options.add_argument("--out", type=Path, default=Path("docs/images"))
    options.add_argument("--chromium", default=shutil.which("chromium"))
    asked = options.parse_args()
    model = sorted((asked.site / "models").glob(f"{asked.model}--*.html"))[0]
    pages = {"MODEL": model, "REPORT": asked.report}
    with sync_playwright() as api:
        # The site may hold what strangers wrote, and its policy is lifted below.
        browser = api.chromium.launch(executable_path=asked.chromium, args=["--disable-gpu"], chromium_sandbox=True)
        for name, (address, width, height, colours) in VIEWS.items():
            if pages.get(address, model) is None:
                continue
            # axe must be put into the page, which its policy forbids; pictures need no such exception.
            context = browser.new_context(
                viewport={"width": width, "height": height}, color_scheme=colours, bypass_csp=True
            )
            page = context.new_page()
            page.goto(pages.get(address, asked.site / address).resolve().as_uri())
            page.wait_for_timeout(200)
            if name in KEPT:
                _write(
                    page.screenshot(), asked.out / (f"{name}.png" if address == "REPORT" else f"leaderboard-{name}.png")
                )
            if asked.axe is not None:
                page.evaluate(asked.axe.read_text(encoding="utf-8"))
                found = page.evaluate("axe.run(document)")
                faults = [
                    f"{item['id']} ({item['impact']}, {len(item['nodes'])} places)" for item in found["violations"]
                ]
                unsure = [item["id"] for item in found["incomplete"]]
                print(f"{name:13} {len(found['passes'])} rules pass, violations: {', '.join(faults) or 'none'}"
                      f"{'; for a person to judge: ' + ', '.join(unsure) if unsure else ''}")  # fmt: skip
            context.close()
        browser.close()


def _write(shot: bytes, path: Path) -> None:
    """Write a picture with a palette of its own, a third of the size and not visibly worse."""
    from PIL import Image

    Image.open(io.BytesIO(shot)).convert("RGB").quantize(192, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
