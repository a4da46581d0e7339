"""``brainbench tactile demo | layouts | check``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import out_folder_option, with_options
from brainbench.cli.output import Output, table, table_of, tracked
from brainbench.cli.policy.train import ENV, DeviceOption, HandOption
from brainbench.core.errors import UsageError, brief

_HAND_FILES = (".urdf", ".xml", ".mjcf")


@with_options(ENV, ("resolution", "noisy"), defaults={"resolution": "high"}, build=False)
def demo(
    options: dict[str, Any],
    out: Annotated[Path, out_folder_option("Folder for the pictures.")] = Path("tactile-demo"),
    hand: HandOption = "xhand1",
) -> Output:
    """Let a hand close around a warm ball and draw what it feels.

    Four pictures: forces on the taxels, marker motion of an elastomer, temperature of the finger tips, and the sound
    of a ball on wood, metal and glass.
    """
    from brainbench.cli.tactile import scenes

    jobs = {
        "forces": lambda path: scenes.forces(path, hand, **options),
        "markers": lambda path: scenes.markers(path, noisy=options["noisy"]),
        "temperature": lambda path: scenes.temperature(path, hand),
        "sound": scenes.sound,
    }
    pictures: dict[str, Any] = {}
    for name, job in tracked(list(jobs.items()), "drawing"):
        path = out / f"tactile-{name}.png"
        pictures[name] = {"picture": path, **job(path)}
    columns = {
        "picture": "{0[picture]}",
        "shows": lambda row: ", ".join(f"{key} {value:.3g}" for key, value in row.items() if key != "picture"),
    }
    text = table_of("", pictures.values(), columns)
    if not pictures["forces"]["in contact"]:
        text += f"\n\nNo taxel of {hand} touched the ball: closed, its fingers do not reach it. "
        text += f"Its probes are listed by: brainbench tactile layouts --hand {hand}"
    return Output(pictures, text)


def layouts(
    hand: HandOption = "xhand1",
    probes: Annotated[Path | None, typer.Option(help="Probe file (published JSON form) to show instead.")] = None,
    links: Annotated[bool, typer.Option("--links", help="Also list every link.")] = False,
    out: Annotated[Path | None, out_folder_option("Write the layouts as probe files here.")] = None,
) -> Output:
    """Count the probes of a hand by resolution and placement, as table 4.11 of the thesis does."""
    from robotics_bridge import hands
    from robotics_bridge.hands import layouts

    chosen = hands.load(hand)
    resolutions: tuple[str, ...] = layouts.RESOLUTIONS
    if probes is not None:
        chosen, resolutions = chosen.with_probes(probes), ("custom",)
    counts, rows, detail = {}, [], []
    for resolution in resolutions:
        whole = chosen.layout(resolution)
        layout = {place: layouts.select(whole, chosen.links(place)) for place in layouts.PLACEMENTS}
        counts[resolution] = {place: layouts.active_count(layout[place]) for place in layouts.PLACEMENTS}
        rows.append([resolution, *(str(counts[resolution][place]) for place in layouts.PLACEMENTS)])
        for link, link_probes in layout["hand"].items():
            radius = sorted({float(f"{value:g}") for value in link_probes.radius[link_probes.active]})
            row = {"resolution": resolution, "link": link, "shape": link_probes.shape}
            detail.append({**row, "active": int(link_probes.active.sum()), "radius": radius})
        if out is not None:
            layouts.write_probes(out / f"{chosen.name}_{resolution}.json", layout["hand"])
    text = table(f"{chosen.name}: {len(chosen.joints)} joints, {len(chosen.fingers)} fingers, palm {chosen.palm}",
                 ["resolution", *layouts.PLACEMENTS], rows, right=(1, 2, 3, 4))  # fmt: skip
    columns = {
        "resolution": "{0[resolution]}", "link": "{0[link]}",
        "grid": lambda row: " × ".join(map(str, row["shape"])), ">active": "{0[active]}",
        "radius (mm)": lambda row: ", ".join(f"{1e3 * value:g}" for value in row["radius"]),
    }  # fmt: skip
    text += "\n\n" + table_of("", detail, columns) if links else ""
    about = {name: getattr(chosen, name) for name in ("palm", "joints", "fingers")}
    data = {"hand": chosen.name, **about, "counts": counts} | ({"links": detail} if links else {})
    return Output(data, text)


def check(
    folder: Annotated[Path | None, typer.Argument(help="Folder of hand files (URDF, MJCF), or one; searched.")] = None,
    device: DeviceOption = "cpu",
    out: Annotated[Path, out_folder_option("Folder for the pictures of hands.")] = Path("tactile-check"),
) -> Output:
    """Compare sensors with closed forms, or the hands of a folder with the engine; exit status 1 if one is off.

    Of each hand: whether it loads, its finger tips, its pads, and whether a ball pressed on each pad is felt.
    """
    if folder is not None:
        return _check_hands(folder, out)
    from robotics_bridge.sensors.checks import CHECKS

    results = []
    for name, run in tracked(list(CHECKS.items()), "checking"):
        value, truth, tolerance = run(device)
        error = abs(value - truth) / max(abs(truth), 1e-30)
        results.append({"check": name, "found": value, "truth": truth, "error": error, "passed": error <= tolerance})
    columns = {
        "check": "{0[check]}",
        ">found": "{0[found]:.6g}",
        ">truth": "{0[truth]:.6g}",
        ">relative error": "{0[error]:.1e}",
        "": lambda row: "ok" if row["passed"] else "OFF",
    }
    failure = None if all(result["passed"] for result in results) else typer.Exit(1)
    text = table_of(f"Checks on {device}", results, columns)
    return Output({"device": device, "checks": results}, text, failure=failure)


def _check_hands(folder: Path, out: Path) -> Output:
    """Check every hand of a folder's files."""
    from robotics_bridge.hands.gallery import check_file

    paths = [folder] if folder.is_file() else sorted(p for p in folder.rglob("*") if p.suffix.lower() in _HAND_FILES)
    if not paths:
        what = f"holds no hand file ({', '.join(_HAND_FILES)})" if folder.is_dir() else "is no folder or hand file"
        raise UsageError(f"{brief(str(folder))} {what}.")
    top, checks = folder.parent if folder.is_file() else folder, []
    for path in tracked(paths, "checking hands"):
        pictures = out / path.parent.relative_to(top)
        pictures.mkdir(parents=True, exist_ok=True)
        checks += check_file(path, pictures)
    columns = {
        "file": lambda check: str(Path(check.file).relative_to(top)),
        "palm": "{0.palm}",
        ">tips": lambda check: str(len(check.tips)),
        ">pads": "{0.pads}",
        ">taxels": "{0.taxels}",
        ">pressed": "{0.pressed}",
        ">most missing": "{0.worst:.2%}",
        ">off (mm)": lambda check: f"{1e3 * check.off:.1f}",
        ">unbalanced": lambda check: str(len(check.unbalanced)),
        "": lambda check: "ok" if check.passed else "; ".join(check.errors),
    }
    failed = sum(not check.passed for check in checks)
    text = table_of(f"Hands of {folder}", checks, columns) + f"\n\n{len(checks) - failed} of {len(checks)} are sound."
    data = [{**asdict(check), "passed": check.passed} for check in checks]
    return Output({"hands": data, "pictures": out}, text, failure=typer.Exit(1) if failed else None)
