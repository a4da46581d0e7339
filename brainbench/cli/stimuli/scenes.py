"""``brainbench stimuli list | show | objects | render | plot``: what a SOURCE names, and pictures of it.

Objects are shape families and mesh files; what whiskers touch of them is told.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from brainbench.cli.options import SCORE, numbers, option, out_file, out_file_option, refuse, with_options
from brainbench.cli.output import Output, facts, progress_bar, table
from brainbench.core.errors import UsageError, check_name, choose_name
from brainbench.core.figures import check_format
from brainbench.core.reading.regular import readable
from brainbench.geometry import UNITS, DecompositionSettings, Mesh, load_mesh, save_mesh, winding_number
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli import Scene, Solid
    from brainbench.stimuli.scenes.scene_files import Recipe


WhiskersOption = Annotated[str, option(SCORE, "whiskers")]
FidelityOption = Annotated[str, option(SCORE, "fidelity")]
BackendOption = Annotated[str, option("brainbench.stimuli.sweeps.plan:GenerationSettings", "backend")]
UnitOption = Annotated[str | None, typer.Option(help="Length unit of mesh files: m, cm, mm, um or in.")]
CollisionOption = Annotated[
    str | None,
    typer.Option(help="What whiskers touch: exact, hull, pieces or decomposition; default as in scene files."),
]
StimulusOption = Annotated[str | None, typer.Option("--stimulus", "-s", help="Its label, where there are several.")]

_SHOWN = 20  # scenes that are printed in full; any number is written as JSON


def open_recipe(source: str, whiskers: str) -> Recipe:
    """Return the scenes that a recipe name or a scene file holds."""
    from brainbench.stimuli import get_recipe, list_recipes, load_scene

    suffix = Path(source).suffix
    if suffix == ".toml":
        return load_scene(source, whiskers=whiskers)
    if suffix in (".h5", ".hdf5", ".nc"):
        raise UsageError(
            f"{source!r} is a file of forces, in which objects and whiskers have no shape; give the recipe or the "
            "scene file (.toml) that it was made from."
        )
    if Path(source).is_file():
        raise UsageError(f"{source!r} is no scene file, which ends in .toml. Recipes: {', '.join(list_recipes())}.")
    return get_recipe(source, whiskers=whiskers)


def choose_scene(recipe: Recipe, stimulus: str | None) -> Scene:
    """Return the scene of a recipe that ``stimulus`` names, or its only one."""
    chosen = choose_name("stimulus", stimulus, recipe.labels, how="with --stimulus")
    return recipe.scenes[recipe.labels.index(chosen)]


def list_() -> Output:
    """List the stimulus recipes."""
    from brainbench.stimuli import list_recipes
    from brainbench.stimuli.scenes.recipes import describe_recipe

    recipes = {name: describe_recipe(name).strip() for name in list_recipes()}
    return Output(recipes, table("", ["recipe", ""], [list(item) for item in recipes.items()]))


def show(
    source: Annotated[str, typer.Argument(help="A recipe name, a scene file (.toml) or a stimulus-set file (.h5).")],
    stimulus: StimulusOption = None,
    whiskers: Annotated[str, typer.Option(help="Show the scenes with these whiskers only.")] = "all",
) -> Output:
    """Print what stands in the scenes: whiskers, objects, poses, motion and frames."""
    if Path(source).suffix in (".h5", ".hdf5", ".nc"):
        from brainbench.stimuli import read_stimulus_set

        dataset = read_stimulus_set(source)
        # Scenes of a set come from whoever wrote it.
        with readable(source, "description of a stimulus set"):
            data = _of_file(dataset, stimulus)
            text = _text(data)
    else:
        recipe = open_recipe(source, whiskers)
        data = _of_recipe(recipe, list(recipe.scenes) if stimulus is None else [choose_scene(recipe, stimulus)])
        text = _text(data)
    return Output(data, text)


def _of_recipe(recipe: Recipe, scenes: list[Scene]) -> dict[str, Any]:
    array = scenes[0].array
    described = []
    for scene in scenes:
        config = scene.config()
        for placed, written in zip(scene.objects, config["objects"], strict=True):
            low, high = placed.solid.bounds
            written["solid"]["size"] = (high - low).tolist()
        described.append(config)
    return {
        "name": recipe.name,
        "description": recipe.description.strip(),
        "array": {"species": array.species, "side": array.side, "whiskers": list(scenes[0].names)},
        "scenes": described,
    }


def _of_file(dataset: xr.Dataset, stimulus: str | None) -> dict[str, Any]:
    scenes = json.loads(dataset.attrs["scene"])
    labels = [scene["label"] for scene in scenes]
    if stimulus is not None:
        check_name("stimulus", stimulus, labels)
        scenes = [scenes[labels.index(stimulus)]]
    origin = {name: dataset.attrs[name] for name in ("backend", "version", "content_hash")}
    return {
        "name": "stimulus set",
        "description": f"simulated by {origin['backend']}, written by brainbench {origin['version']}",
        "array": json.loads(dataset.attrs["array"]),
        "scenes": scenes,
        "fidelity": json.loads(dataset.attrs["fidelity"]),
        **origin,
    }


def _text(data: dict[str, Any]) -> str:
    array, scenes = data["array"], data["scenes"]
    frames = scenes[0]["frames"]
    readings = "instantaneous" if frames["average"] == 1 else f"each the mean of {frames['average']} readings"
    readings += f", low-pass {frames['lowpass']:g} Hz" if frames.get("lowpass") else ""
    readings += f", clipped to ±{frames['clip']:g} N" if frames.get("clip") else ""
    readings += f", {frames['axes']} axes" if frames.get("axes", "world") != "world" else ""
    span = f"{frames['count']} from {_milli(frames['first'])} ms every {_milli(frames['interval'])} ms"
    lines = [
        f"{data['name']}: {data['description']}",
        "",
        f"whiskers  {array['species']}, {array['side']}: {len(array['whiskers'])} ({', '.join(array['whiskers'])})",
        f"frames    {span}, {readings}",
    ]
    if data.get("fidelity"):
        lines.append("fidelity  " + ", ".join(f"{name} {value}" for name, value in data["fidelity"].items()))
    rows = [row for scene in scenes[:_SHOWN] for row in _rows(scene)]
    lines += ["", table("", ["scene", "", "position mm", "rotation °", "motion", ""], rows)]
    if len(scenes) > _SHOWN:
        lines += ["", f"… and {len(scenes) - _SHOWN} more scenes (all with --json)"]
    return "\n".join(lines)


def _rows(scene: dict[str, Any]) -> list[list[str]]:
    if "head" not in scene:  # forces that were simulated elsewhere
        return [[scene["label"], scene.get("shape", ""), "", "", "", "no scene is known"]]
    head = scene["head"]
    rows = [
        [scene["label"], "head", _point(head["position"]), _angles(head["rotation"]), _motion(head["motion"]), ""],
        ["", "whiskers", "", "", _motion(scene["whisking"]), ""],
    ]
    for animal in scene.get("others", ()):
        place = _point(animal["head"]["position"]), _angles(animal["head"]["rotation"])
        rows.append(["", f"head of {animal['animal']}", *place, _motion(animal["head"]["motion"]), ""])
        rows.append(["", f"whiskers of {animal['animal']}", "", "", _motion(animal["whisking"]), ""])
    for body in scene["objects"]:
        solid, friction = body["solid"], body["friction"]
        size = " × ".join(map(_milli, solid.get("size", ()))) or f"diagonal {_milli(solid['diagonal'])}"
        count = solid["parts"]
        touched = f"{count} convex part{'s' if count > 1 else ''}" if count else "the triangles of its surface"
        notes = [touched, f"{size} mm"]
        notes += [] if friction is None else [f"friction {friction:g}"]
        notes += solid["notes"]
        place = _point(body["position"]), _angles(body["rotation"])
        rows.append(["", solid["name"], *place, _motion(body["motion"]), "; ".join(notes)])
    return rows


def _motion(config: dict[str, Any]) -> str:
    """Say in words how something moves."""
    kind = config["kind"]
    if kind == "still":
        return "still"
    if kind == "whisking":
        forth, back = (math.degrees(config[name]) for name in ("protraction", "retraction"))
        rotations = config["rotations"]["name"]
        return f"{config['frequency']:g} Hz, +{forth:g}° to −{back:g}°, onset {_milli(config['onset'])} ms, {rotations}"
    if kind == "translation":
        velocity = ", ".join(_milli(value) for value in config["velocity"])
        return f"({velocity}) mm/s, onset {_milli(config['onset'])} ms"
    if kind == "spin":
        speed = math.degrees(math.hypot(*config["velocity"]))
        axis = ", ".join(f"{math.degrees(value):.4g}" for value in config["velocity"])
        return f"turns by {speed:.4g}°/s about ({axis}), onset {_milli(config['onset'])} ms"
    if kind == "recorded":
        start = f"from azimuth {math.degrees(config['start']):g}°"
        return f"recorded for {config['duration']:g} s, {start}, trajectory {config['trajectory']}"
    if kind == "path":
        return f"path of {len(config['times'])} keyframes in {config['times'][-1]:g} s"
    return str(kind)


def _milli(value: float) -> str:
    return f"{value * 1e3:.6g}"


def _point(values: list[float]) -> str:
    return ", ".join(f"{value * 1e3:.4g}" for value in values)


def _angles(values: list[float]) -> str:
    return ", ".join(f"{math.degrees(value):.4g}" for value in values)


_MILLI = 1e3


@with_options("brainbench.geometry.pieces:DecompositionSettings", ("method", "threshold"), parameter="settings")
def objects(
    settings: Any,
    source: Annotated[str | None, typer.Argument(help="A shape family or a mesh file; all families without.")] = None,
    seed: Annotated[int, typer.Option(help="Which member of the family.")] = 0,
    detail: Annotated[int, typer.Option(help="About how many triangles a family's member has, 2000 to 20000.")] = 4_000,
    unit: UnitOption = None,
    diagonal_mm: Annotated[
        float | None, typer.Option(help="Scale to this bounding-box diagonal; families have 40 mm by default.")
    ] = None,
    collision: CollisionOption = None,
    export: Annotated[
        Path | None, typer.Option(callback=out_file, help="Write the repaired mesh, in mm (.obj .stl .ply .glb .off).")
    ] = None,
) -> Output:
    """List the shape families, or describe one object: its size, its faults, and what whiskers touch of it."""
    diagonal = None if diagonal_mm is None else diagonal_mm / _MILLI
    if source is None:
        single = {"--unit": unit, "--diagonal-mm": diagonal_mm, "--collision": collision, "--export": export}
        refuse(single, "without a family or a mesh file")
        return Output(*_families())
    with progress_bar("preparing the object"):
        if Path(source).is_file():
            refuse({"--seed": seed or None, "--detail": detail != 4_000}, "for a file")
            data, solid = _file(source, unit, diagonal, collision or "hull", settings)
        else:
            refuse({"--unit": unit}, "for a family")
            data, solid = _member(source, seed, detail, diagonal, collision, settings)
    if export is not None and solid.mesh is not None:
        data["export"] = save_mesh(export, solid.mesh, unit="mm")
    return Output(data, _object_text(data))


def _families() -> tuple[dict[str, Any], str]:
    from brainbench.stimuli.objects import procedural

    data = {family: procedural.describe_family(family) for family in procedural.list_families()}
    hint = '\n\nin scene files: shape = "family:NAME", seed, diagonal_mm; in detail: brainbench stimuli objects NAME'
    return data, table("", ["family", ""], [[name, text] for name, text in data.items()]) + hint


def _member(
    name: str, seed: int, detail: int, diagonal: float | None, collision: str | None, settings: DecompositionSettings
) -> tuple[dict[str, Any], Solid]:
    from brainbench.stimuli.objects import procedural
    from brainbench.stimuli.objects.solid import shape_solid

    family = name.removeprefix("family:")
    hint = "Or the path of a mesh file."
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
    from brainbench.stimuli.objects.solid import mesh_solid

    if unit is None:
        raise UsageError(f"Mesh files carry no unit; say what the numbers in {source!r} are: --unit {'|'.join(UNITS)}.")
    as_read = load_mesh(source, unit=unit)
    solid = mesh_solid(source, unit=unit, diagonal=diagonal, collision=collision, decomposition=settings)
    return {"file": source, "as_read": str(as_read.diagnosis), **_measures(solid.mesh or as_read, solid)}, solid


def _measures(mesh: Mesh, solid: Solid) -> dict[str, Any]:
    low, high = mesh.bounds
    # What two bodies share would count twice; the surface winds about it twice. Fine meshes get fewer points.
    points = low + (high - low) * np.random.default_rng(0).random((64 + 4_000_000 // len(mesh.faces), 3))
    twice = mesh.diagnosis.bodies > 1 and bool((winding_number(mesh, points) > 1.5).any())
    return {
        "name": solid.name,
        "size_mm": ((high - low) * _MILLI).tolist(),
        "diagonal_mm": mesh.diagonal * _MILLI,
        "volume_mm3": None if twice or not mesh.diagnosis.watertight else mesh.volume * _MILLI**3,
        "triangles": len(mesh.faces),
        "diagnosis": str(mesh.diagnosis),
        "content_hash": mesh.content_hash,
        "convex_parts": len(solid.parts),
        "notes": list(solid.notes),
    }


def _object_text(data: dict[str, Any]) -> str:
    size = " × ".join(f"{value:.4g}" for value in data["size_mm"])
    volume = "unknown: not closed, or bodies overlap" if data["volume_mm3"] is None else f"{data['volume_mm3']:.4g} mm³"
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


@with_options(
    "brainbench.stimuli.figures.pictures:Style",
    ("color", "thickness", "opacity", "frames_per_second"),
    parameter="style",
    flags={"frames_per_second": ("--fps",)},
    build=False,
)
@with_options("brainbench.stimuli.figures.surfaces:Camera", ("projection",), parameter="lens", build=False)
def render(
    style: dict[str, Any],
    lens: dict[str, Any],
    source: Annotated[str, typer.Argument(help="A recipe name or a scene file (.toml).")],
    out: Annotated[Path, out_file_option("File to write: .png for one instant, .mp4 or .gif.")],
    stimulus: StimulusOption = None,
    at: Annotated[
        float | None, typer.Option(help="Instant of a picture, ms. \\[default: first full protraction]")
    ] = None,
    start: Annotated[float, typer.Option(help="First instant of a film, ms.")] = 0.0,
    stop: Annotated[
        float | None, typer.Option(help="Last instant of a film, ms. \\[default: 150 ms after start]")
    ] = None,
    step: Annotated[float, typer.Option(help="Time between the frames of a film, ms.")] = 2.0,
    view: Annotated[str, option("brainbench.stimuli.figures.surfaces:Camera", "view")] = "oblique",
    look_at: Annotated[str | None, typer.Option(help="Point x,y,z in the middle, mm. \\[default: all in view]")] = None,
    width: Annotated[float | None, typer.Option(help="Width of the picture at that point, mm.")] = None,
    moment_limit: Annotated[float | None, typer.Option(help="Moment at the end of the colours, µN·m.")] = None,
    size: Annotated[str | None, typer.Option(help="Pixels. \\[default: 1280x960, a film 800x600]")] = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Draw a scene: whiskers bent by its objects, as a picture or a film; no display is needed."""
    from brainbench.stimuli.figures import pictures as drawing
    from brainbench.stimuli.figures.pictures import Style
    from brainbench.stimuli.figures.surfaces import Camera

    suffix = check_format(out, drawing.FORMATS)
    scene = choose_scene(open_recipe(source, whiskers), stimulus)
    if suffix == ".png":
        refuse(
            {"--start": start != 0, "--stop": stop, "--step": step != 2.0, "--fps": style["frames_per_second"] != 25.0},
            "for a picture",
        )
        times = [drawing.still_time(scene) if at is None else at * 1e-3]
    else:
        refuse({"--at": at}, "for a film, which takes --start, --stop and --step")
        times = list(drawing.film_times(scene, start * 1e-3, None if stop is None else stop * 1e-3, step * 1e-3))
    target = None if look_at is None else numbers(look_at, "--look-at", float, count=3)
    camera = Camera(
        view=view if view.replace("-", "").isalpha() else numbers(view, "--view", float, count=3),  # type: ignore[arg-type]
        **lens,
        target=None if target is None else tuple(1e-3 * value for value in target),  # type: ignore[arg-type]
        width=None if width is None else width * 1e-3,
    )
    default_size = Style().size if suffix == ".png" else drawing.FILM_SIZE
    pixels = default_size if size is None else numbers(size, "--size", count=2)
    limit = None if moment_limit is None else moment_limit * 1e-6
    drawn = Style(**style, moment_limit=limit, size=(pixels[0], pixels[1]))
    how = {"times": times, "camera": camera, "style": drawn}
    with progress_bar() as progress:
        path = drawing.render(scene, out, **how, fidelity=fidelity, backend=backend, progress=progress)
    data = {"path": path, "stimulus": scene.label, "times_s": times, "camera": camera, "style": drawn}
    what = f"{times[0] * 1e3:g}" if len(times) == 1 else f"{len(times)} frames, {times[0] * 1e3:g}–{times[-1] * 1e3:g}"
    return Output(data, f"{scene.label} ({what} ms)  {path}")


def plot(
    source: Annotated[str, typer.Argument(help="A recipe name, a scene file (.toml) or a stimulus-set file (.h5).")],
    out: Annotated[Path, out_file_option("File to write (.png, .svg, .pdf); several stimuli make one file each.")],
    channel: Annotated[
        str, typer.Option(help="Fxyz, Mxyz (three components), F, M (magnitude), Fx, Fy, Fz, Mx, My or Mz.")
    ] = "Fxyz",
    stimulus: Annotated[str | None, typer.Option("--stimulus", "-s", help="Draw only this stimulus.")] = None,
    start: Annotated[float | None, typer.Option(help="First time shown, ms.")] = None,
    stop: Annotated[float | None, typer.Option(help="Last time shown, ms.")] = None,
    size: Annotated[str, typer.Option(help="Pixels.")] = "1600x960",
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Plot forces or moments of every whisker on the 5 × 7 layout, to one scale, contacts shaded."""
    from brainbench.stimuli.figures.pictures import PLOT_FORMATS, QUANTITIES
    from brainbench.stimuli.figures.pictures import plot as draw
    from brainbench.stimuli.sources import load_stimulus_set

    check_format(out, PLOT_FORMATS)
    check_name("channel", channel, QUANTITIES)
    with progress_bar() as progress:
        dataset, _ = load_stimulus_set(source, whiskers=whiskers, fidelity=fidelity, backend=backend, progress=progress)
    low = -math.inf if start is None else start * 1e-3
    high = math.inf if stop is None else stop * 1e-3
    width, height = numbers(size, "--size", count=2)
    chosen = {"channel": channel, "stimulus": stimulus, "window": (low, high)}
    paths = draw(dataset, out, **chosen, size=(width, height))
    return Output({"paths": paths, "channel": channel}, "\n".join(map(str, paths)))
