"""Error and cost of every setting of accuracy, and their pictures: the tables that ``Fidelity.auto`` reads.

    python -m benchmarks.tradeoffs whisker [--backends rod,mujoco] [--solvers dynamic,quasistatic] [--collisions all]
    python -m benchmarks.tradeoffs tactile [--out tactile-tradeoff.json]
    python -m benchmarks.tradeoffs pictures [--out docs/images]

A table goes on where it stopped: settings that stand in it are not measured again. The shipped ones are
``brainbench/stimuli/fidelity_table.json`` and ``robotics_bridge/sensors/fidelity_table.json``.
"""

from __future__ import annotations

import argparse
import platform
from pathlib import Path
from typing import Any

from benchmarks.tradeoffs import pictures, sensors, whiskers
from brainbench.core.errors import DataError
from brainbench.core.files import read_json, write_json
from brainbench.core.tradeoffs import TradeoffPoint, pareto_front

PARTS: dict[str, Any] = {"whisker": whiskers, "tactile": sensors}


def measure_settings(part: str, settings: list[dict[str, Any]], path: Path) -> list[dict[str, Any]]:
    """Measure the settings that the table at ``path`` lacks, writing it whole after each; return all its rows."""
    module, rows = PARTS[part], []
    if path.exists():
        table = read_json(path)
        if any(table.get(key) != value for key, value in module.FIXED.items()):
            raise DataError(f"{str(path)!r} was not measured with {module.FIXED}; write to another file.")
        rows = list(table["points"])
    head = {"made_by": f"python -m benchmarks.tradeoffs {part}", **module.ABOUT, **module.FIXED}
    for setting in settings:
        # A table may be older than a setting, whose default it then has.
        if not any(all(row.get(key, value) == value for key, value in setting.items()) for row in rows):
            rows.append({**setting, **module.measure(setting)})
            print(rows[-1], flush=True)
            write_json(path, {**head, "machine": platform.machine(), "points": rows})
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=[*PARTS, "pictures"])
    parser.add_argument("--out", type=Path, help="table, or folder of the pictures")
    parser.add_argument("--backends", default="rod", help="engines of whiskers")
    parser.add_argument("--solvers", default="dynamic", help="dynamic, quasistatic (of rod alone), or both")
    parser.add_argument("--collisions", default="", help="geometries of concave objects to measure too, or all")
    options = parser.parse_args()
    if options.part == "pictures":
        pictures.draw_tables(options.out or Path("docs/images"))
        return
    words = [options.backends.split(","), options.solvers.split(","), list(filter(None, options.collisions.split(",")))]
    settings = whiskers.settings(*words) if options.part == "whisker" else sensors.settings()
    rows = measure_settings(options.part, settings, options.out or Path(f"{options.part}-tradeoff.json"))
    if options.part == "whisker":
        print("Settings that none beats in the error that 90 % of the whiskers stay below, and in cost:")
        usable = (row for row in rows if row[whiskers.ERROR] is not None and whiskers.competes(row))
        for point in pareto_front(TradeoffPoint(row[whiskers.ERROR], row["cost"], row) for row in usable):
            print(f"{point.error:.2%} at {point.cost:.3g} s a whisker-second: {point.settings}")


if __name__ == "__main__":
    main()
