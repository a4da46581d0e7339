"""``brainbench stimuli fit``, parameters or contact forces from measurements, and ``stimuli design``, motions."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import changed, items, option, out_file_option, picture_file, refuse, with_options
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.cli.stimuli import scenes
from brainbench.cli.stimuli.scenes import BackendOption, StimulusOption, WhiskersOption
from brainbench.core.errors import UsageError, brief, check_each, check_name
from brainbench.core.limits import read_pairs, read_value
from brainbench.core.plugins import OptionalPart
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.fitting import FitOptions, FitResult
    from brainbench.stimuli.fitting.design import DesignOptions
    from brainbench.stimuli.whiskers.whisker import Whisker

_FIT = "brainbench.stimuli.fitting.parameters:FitOptions"
_CONTACTS = "brainbench.stimuli.fitting.contacts:ContactOptions"
_TRACK = "brainbench.stimuli.tracks.readers:TrackOptions"
_OFFERED = (
    "metres_per_pixel", "frame_rate", "track", "layout", "zero_frame", "identities", "parts", "least_likelihood",
)  # fmt: skip
_PARAMETERS = "young_modulus,damping_ratio"


@with_options(_TRACK, _OFFERED, parameter="scale", build=False)
@with_options(_FIT)
def fit(
    file: Annotated[
        Path,
        typer.Argument(
            help="Track (.csv, .h5, .hdf5, .mat, .tr4, .whiskers) or base wrenches (.csv, .h5, .nwb) of one whisker."
        ),
    ],
    options: FitOptions,
    scale: dict[str, Any],
    whisker: Annotated[str, typer.Option(help="Whisker: mouse:C2, or C2 of the scene.")] = "mouse:C2",
    parameters: Annotated[str, typer.Option(help="Parameters to estimate, with commas between them.")] = _PARAMETERS,
    scene: Annotated[
        str | None, typer.Option(help="Scene file (.toml) with the motion and the objects. \\[default: a ring-down]")
    ] = None,
    stimulus: StimulusOption = None,
    deflection: Annotated[
        float | None, typer.Option(help="Deflection of a ring-down before the release, mm, roughly. \\[default: 1]")
    ] = None,
    contacts: Annotated[
        bool, typer.Option("--contacts", help="Estimate contact point and force in each frame of a track instead.")
    ] = False,
    properties: Annotated[
        str,
        typer.Option(
            "--known", help="Properties of the whisker that were measured, as arc_length=0.02,base_radius=5e-5 (SI)."
        ),
    ] = "",
    bounds: Annotated[
        str, typer.Option(help="Bounds of parameters, as young_modulus=1e9:9e9,damping_ratio=0.05:0.5 (SI).")
    ] = "",
    noise: Annotated[
        float | None, typer.Option(help="Standard deviation of a traced coordinate, µm, when repeats tell it.")
    ] = None,
    frames: Annotated[int, option(_CONTACTS, "frames")] = 1,
    first_arc: Annotated[
        float | None,
        typer.Option(help="Arc length of the first traced point, mm; nan for anywhere. \\[default: the base]"),
    ] = None,
    out: Annotated[Path | None, out_file_option("Write the result as JSON.")] = None,
    picture: Annotated[
        Path | None, typer.Option(callback=picture_file, help="Draw fit and residuals (.png, .svg or .pdf).")
    ] = None,
) -> Output:
    """Estimate parameters of a whisker, with intervals, from traced shapes or base wrenches."""
    from brainbench.stimuli.fitting.trials import read_wrenches
    from brainbench.stimuli.tracks.readers import TrackOptions, holds_shapes, read_shapes

    if contacts:
        of_fits = {"--parameters": parameters != _PARAMETERS, "--bounds": bounds, "--picture": picture}
        refuse({**of_fits, "--deflection": deflection, **changed(_FIT, vars(options))}, "with --contacts")
    else:
        refuse({"--frames": frames != 1, "--first-arc": first_arc is not None}, "without --contacts")
    refuse({"--deflection": deflection} if scene else {}, "with --scene")
    chosen = None if scene is None else scenes.choose_scene(scenes.open_recipe(scene, "all"), stimulus)
    start = _whisker(whisker, chosen, _pairs(properties, "--known"))
    if holds_shapes(file):
        refuse({} if scene else {"--stimulus": stimulus}, "with a track that has no --scene")
        measured = read_shapes(file, TrackOptions(**{name: one for name, one in scale.items() if one is not None}))
        if noise is not None:
            measured["noise"] = 1e-6 * noise
    else:
        of_tracks = {"--contacts": contacts, "--noise": noise, **changed(_TRACK, scale)}
        refuse(of_tracks, f"with wrenches, which {brief(str(file))} holds")
        measured = read_wrenches(file, whisker=None if scene is None else whisker, stimulus=stimulus)
    if contacts:
        data, text = _contacts(measured, start, noise, frames, first_arc)
    else:
        from brainbench.stimuli.fitting import Trial
        from brainbench.stimuli.fitting import fit as run
        from brainbench.stimuli.fitting.result import draw_fit

        trial = (
            Trial.ringdown(start, measured, 1e-3 * (1.0 if deflection is None else deflection))
            if chosen is None
            else Trial.of_scene(chosen, measured, whisker, start=start)
        )
        limits = {key: _span(value) for key, value in _pairs(bounds, "--bounds", text=True).items()}
        with progress_bar("fitting"):
            result = run(trial, items(parameters), bounds=limits, options=options)
        if picture is not None:
            draw_fit(trial, result, picture)
        data, text = result.summary(), _text(result, measured)
    return Output(data, text, out=out)


def _contacts(
    measured: xr.Dataset, whisker: Whisker, noise: float | None, frames: int, first_arc: float | None
) -> tuple[dict[str, Any], str]:
    """Return the contacts of a track as data and as a table."""
    from brainbench.stimuli.fitting import ContactOptions, find_contacts

    options_given: dict[str, Any] = {"noise": None if noise is None else 1e-6 * noise, "frames": frames}
    if first_arc is not None:
        options_given["first_arc"] = None if math.isnan(first_arc) else 1e-3 * first_arc
    options = ContactOptions(**options_given)
    with progress_bar("finding contacts"):
        contacts = find_contacts(measured, whisker, options=options)
    rows = [
        {
            "time": float(contacts["time"].values[index]),
            **{
                name: contacts[name].values[index].tolist()
                for name in contacts.data_vars
                if name not in ("status", "reason")
            },
            "status": str(contacts["status"].values[index]),
            "reason": str(contacts["reason"].values[index]),
        }
        for index in range(contacts.sizes["time"])
    ]
    columns = {
        ">ms": lambda row: f"{1e3 * row['time']:.2f}",
        ">force µN": lambda row: f"{1e6 * row['force']:.2f} ± {1e6 * row['force_deviation']:.2f}",
        ">arc mm": lambda row: f"{1e3 * row['arc']:.2f} ± {1e3 * row['arc_deviation']:.2f}",
        ">moment nN·m": lambda row: f"{1e9 * row['moment']:.3g}",
        "status": "{0[status]}",
        "": "{0[reason]}",
    }
    return {"frames": rows, "faults": measured.attrs.get("faults", [])}, table_of("", rows, columns)


def _text(result: FitResult, measured: xr.Dataset) -> str:
    columns = {
        "parameter": "{0.name}",
        ">estimate": lambda row: f"{row.value:.4g} {row.unit}",
        ">interval": lambda row: f"[{row.interval.low:.4g}, {row.interval.high:.4g}]",
        ">start": "{0.start:.4g}",
        "status": "{0.status}",
    }
    lines = [table_of("", result.estimates, columns), "", f"status  {result.status}"]
    lines += [f"  {reason}" for reason in (*result.reasons, *measured.attrs.get("faults", []))]
    noise = ", ".join(f"{name} {level:.2g}" for name, level in result.noise.items())
    lines += ["", f"noise   {noise} (SI)", *(f"  {one.words}" for one in result.directions if one.identified)]
    return "\n".join(lines)


def _whisker(name: str, scene: Any, properties: dict[str, Any]) -> Whisker:
    """Return the whisker that a fit starts from."""
    from brainbench.stimuli import Whisker, WhiskerArray

    if scene is not None:
        check_name("whisker of the scene", name, scene.names)
        whisker = scene.mounts[scene.names.index(name)].whisker
    else:
        species, colon, label = name.partition(":")
        if not colon:
            raise UsageError(f"Without a scene --whisker is species and whisker, as mouse:{name}; received {name!r}.")
        array = WhiskerArray.of(species)
        check_name(f"whisker of the {species}", label, array.names)
        whisker = array[label].whisker
    check_each("property of a whisker", properties, [item.name for item in fields(Whisker)])
    return replace(whisker, **properties)


def _pairs(given: str, flag: str, *, text: bool = False) -> dict[str, Any]:
    """Return NAME=VALUE pairs with commas between them; values are numbers, or texts."""
    pairs = read_pairs(items(given), flag, "damping_ratio=0.1")
    return {name: value if text else read_value(name, value, float) for name, value in pairs.items()}


def _span(text: str) -> tuple[float, float]:
    low, colon, high = text.partition(":")
    try:
        ends = float(low), float(high)
    except ValueError:
        ends = (0.0, 0.0)
    if not colon or not ends[0] < ends[1]:
        raise UsageError(f"--bounds takes LOW:HIGH for each parameter, the lower first; received {brief(text)}.")
    return ends


@with_options("brainbench.stimuli.fitting.design:DesignOptions")
def design(
    source: Annotated[str, typer.Argument(help="A scene file (.toml) or a recipe: a scene for each object.")],
    options: DesignOptions,
    variables: Annotated[
        str, typer.Option(help="What to choose: frequency, protraction, retraction, object_x, object_y, object_z.")
    ] = "frequency,protraction,retraction",
    networks: Annotated[
        str,
        typer.Option(
            help="Two networks, such as zhuang-small.simclr,resnet18-small.supervised: tell them apart in place of the "
            "objects. The noise is then that of animals, as in 'brainbench recovery'."
        ),
    ] = "",
    whiskers: WhiskersOption = "all",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Choose the whisking, or the place of the objects, that tells the objects, or two networks, apart best."""
    from brainbench.stimuli.fitting.design import VARIABLES
    from brainbench.stimuli.fitting.design import design as run

    recipe = scenes.open_recipe(source, whiskers)
    with progress_bar("searching"):
        result: Any
        how = {"options": options, "backend": backend}
        if networks:
            part = OptionalPart("", "--networks", "brainbench.scoring.recovery.motion:design_for_networks")

            result = part.load("option")(recipe.scenes, items(networks), items(variables), **how)
            rows = [
                ("1 − similarity of responses, objects of the search", *result.contrast),
                ("the same, held-out objects", *result.held_out),
                ("lead of the true network, held-out objects (score)", *result.leads),
                ("boards that it wins", *result.won),
            ]
            what, first = "networks", ">given"
            layers = ", ".join(f"{layer} of {name}" for name, layer in result.layers.items())
            gain = f"[{result.gain.low:.3g}, {result.gain.high:.3g}]" if result.gain else "none"
            words = f"gain    {result.leads[1] - result.leads[0]:.3g} {gain}, by {result.search}\nlayers  {layers}"
        else:
            result = run(recipe.scenes, items(variables), **how)
            rows = [(pair, *both) for pair, both in result.distances.items()]
            what, first = "objects", ">D² of a whisk, given"
            words = f"whisks  {result.whisks:.3g} of those of the given motion, time {result.time:.3g}"
    outcome = table_of("", rows, {what: "{0[0]}", first: "{0[1]:.3g}", ">chosen": "{0[2]:.3g}"}) + f"\n\n{words}"
    rows = [(name, result.start[name], value, VARIABLES[name].unit) for name, value in result.values.items()]
    chosen = table_of("", rows, {"variable": "{0[0]}", ">given": "{0[1]:.4g}", ">chosen": "{0[2]:.4g} {0[3]}"})
    status = f"status  {result.status} {result.reason}".rstrip()
    data = {name: value for name, value in vars(result).items() if name != "scenes"}
    return Output({**data, "options": options}, f"{chosen}\n\n{outcome}\n{status}")
