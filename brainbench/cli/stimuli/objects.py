"""``brainbench stimuli objects``: shape families, mesh files and ShapeNet folders, and what whiskers touch of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.destinations import out_file
from brainbench.cli.options import refuse, with_options
from brainbench.cli.output import Output, facts, progress_bar, table

if TYPE_CHECKING:
    from brainbench.geometry import DecompositionSettings, Mesh
    from brainbench.stimuli import Solid

_MILLI = 1e3


@with_options("brainbench.geometry.pieces:DecompositionSettings", ("method", "threshold"), parameter="settings")
def objects(
    settings: Any,
    source: Annotated[
        str | None, typer.Argument(help="A shape family, a mesh file or a ShapeNet folder; all families without.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Which member of the family.")] = 0,
    detail: Annotated[int, typer.Option(help="About how many triangles a family's member has, 2000 to 20000.")] = 4_000,
    unit: Annotated[str | None, typer.Option(help="Length unit of a mesh file: m, cm, mm, um or in.")] = None,
    diagonal_mm: Annotated[
        float | None, typer.Option(help="Scale to this bounding-box diagonal; families have 40 mm by default.")
    ] = None,
    collision: Annotated[
        str | None,
        typer.Option(help="What whiskers touch: exact, hull, pieces or decomposition; default as in scene files."),
    ] = None,
    ids: Annotated[Path | None, typer.Option(help="For a ShapeNet folder: file of synset/model names.")] = None,
    categories: Annotated[Path | None, typer.Option(help="For a ShapeNet folder: CSV or JSON of labels.")] = None,
    export: Annotated[
        Path | None, typer.Option(callback=out_file, help="Write the repaired mesh, in mm (.obj .stl .ply .glb .off).")
    ] = None,
) -> Output:
    """List the shape families, or describe one object: its size, its faults, and what whiskers touch of it."""
    from brainbench.geometry import save_mesh

    diagonal = None if diagonal_mm is None else diagonal_mm / _MILLI
    if source is None or Path(source).is_dir():
        single = {"--unit": unit, "--diagonal-mm": diagonal_mm, "--collision": collision, "--export": export}
        refuse(single, "without a family or a mesh file")
        data, text = _families() if source is None else _folder(source, ids, categories)
        return Output(data, text)
    refuse({"--ids": ids, "--categories": categories}, "for one object")
    with progress_bar("preparing the object"):
        if Path(source).is_file():
            refuse({"--seed": seed or None, "--detail": detail != 4_000}, "for a file")
            data, solid = _file(source, unit, diagonal, collision or "hull", settings)
        else:
            refuse({"--unit": unit}, "for a family")
            data, solid = _member(source, seed, detail, diagonal, collision, settings)
    if export is not None and solid.mesh is not None:
        data["export"] = save_mesh(export, solid.mesh, unit="mm")
    return Output(data, _text(data))


def _families() -> tuple[dict[str, Any], str]:
    from brainbench.stimuli.objects import procedural

    data = {family: procedural.describe_family(family) for family in procedural.list_families()}
    hint = '\n\nin scene files: shape = "family:NAME", seed, diagonal_mm; in detail: brainbench stimuli objects NAME'
    return data, table("", ["family", ""], [[name, text] for name, text in data.items()]) + hint


def _folder(source: str, ids: Path | None, categories: Path | None) -> tuple[dict[str, Any], str]:
    from brainbench.stimuli.objects.collections import load_shapenet

    bodies = load_shapenet(source, ids=ids, categories=categories)
    data = {"models": len(bodies), "labels": bodies.counts, "missing": list(bodies.missing)}
    text = table("", ["label", "models"], [[label, str(n)] for label, n in bodies.counts.items()], right=(1,))
    return data, f"{len(bodies)} models of {len(bodies.labels)} labels, {len(bodies.missing)} missing\n\n{text}"


def _member(
    name: str, seed: int, detail: int, diagonal: float | None, collision: str | None, settings: DecompositionSettings
) -> tuple[dict[str, Any], Solid]:
    from brainbench.core.errors import check_name
    from brainbench.stimuli.objects import procedural
    from brainbench.stimuli.objects.solid import shape_solid

    family = name.removeprefix("family:")
    hint = "Or the path of a mesh file or of a ShapeNet folder."
    check_name("object", family, procedural.list_families(), hint=hint)
    shape = procedural.make(family, seed, detail=detail)
    size = 0.04 if diagonal is None else diagonal
    solid = shape_solid(shape, diagonal=size, collision=collision, decomposition=settings)
    about = {"family": family, "description": procedural.describe_family(family), "seed": seed}
    mesh = solid.mesh or shape.mesh
    return {**about, "parameters": dict(shape.parameters), **_measures(mesh, solid)}, solid


def _file(
    source: str, unit: str | None, diagonal: float | None, collision: str, settings: DecompositionSettings
) -> tuple[dict[str, Any], Solid]:
    from brainbench.core.errors import UsageError
    from brainbench.geometry import UNITS, load_mesh
    from brainbench.stimuli.objects.solid import mesh_solid

    if unit is None:
        raise UsageError(f"Mesh files carry no unit; say what the numbers in {source!r} are: --unit {'|'.join(UNITS)}.")
    as_read = load_mesh(source, unit=unit)
    solid = mesh_solid(source, unit=unit, diagonal=diagonal, collision=collision, decomposition=settings)
    return {"file": source, "as_read": str(as_read.diagnosis), **_measures(solid.mesh or as_read, solid)}, solid


def _measures(mesh: Mesh, solid: Solid) -> dict[str, Any]:
    low, high = mesh.bounds
    return {
        "name": solid.name,
        "size_mm": ((high - low) * _MILLI).tolist(),
        "diagonal_mm": mesh.diagonal * _MILLI,
        "volume_mm3": mesh.volume * _MILLI**3 if mesh.diagnosis.watertight else None,
        "triangles": len(mesh.faces),
        "diagnosis": str(mesh.diagnosis),
        "content_hash": mesh.content_hash,
        "convex_parts": len(solid.parts),
        "notes": list(solid.notes),
    }


def _text(data: dict[str, Any]) -> str:
    size = " × ".join(f"{value:.4g}" for value in data["size_mm"])
    volume = "unknown: not closed" if data["volume_mm3"] is None else f"{data['volume_mm3']:.4g} mm³"
    touched = "the triangles of its surface (engine rod; for others choose --collision decomposition)"
    if parts := data["convex_parts"]:
        touched = f"{parts} convex part{'' if parts == 1 else 's'}"
    rows = {"object": f"{data['name']}: {data['description']}" if "description" in data else data["name"]}
    if "parameters" in data:
        drawn = data["parameters"].items()
        rows["drawn"] = ", ".join(f"{key} {f'{one:.3g}' if isinstance(one, float) else one}" for key, one in drawn)
    if "as_read" in data:
        rows["as read"] = data["as_read"]
    rows |= {
        "surface": f"{data['diagnosis']}, {data['triangles']:,} triangles",
        "size": f"{size} mm, diagonal {data['diagonal_mm']:.4g} mm",
        "volume": volume,
        "touched": touched,
    }
    if data["notes"]:
        rows["note"] = "\n".join(data["notes"])
    rows["hash"] = data["content_hash"]
    if "export" in data:
        rows["written"] = f"{data['export']} (mm)"
    return facts(rows)
