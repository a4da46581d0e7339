"""``brainbench stimuli render`` and ``plot``: pictures and films of scenes, traces of forces."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import numbers, out_file_option, refuse, with_options
from brainbench.cli.output import Output, progress_bar
from brainbench.cli.stimuli import scenes
from brainbench.cli.stimuli.scenes import BackendOption, FidelityOption, StimulusOption, WhiskersOption
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE


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
        float | None, typer.Option(help="Instant of a picture, ms. [default: first full protraction]")
    ] = None,
    start: Annotated[float, typer.Option(help="First instant of a film, ms.")] = 0.0,
    stop: Annotated[
        float | None, typer.Option(help="Last instant of a film, ms. [default: 150 ms after start]")
    ] = None,
    step: Annotated[float, typer.Option(help="Time between the frames of a film, ms.")] = 2.0,
    view: Annotated[
        str, typer.Option(help="top, bottom, side, left, front, back, oblique, or a direction x,y,z to the camera.")
    ] = "oblique",
    look_at: Annotated[str | None, typer.Option(help="Point x,y,z in the middle, mm. [default: all in view]")] = None,
    width: Annotated[float | None, typer.Option(help="Width of the picture at that point, mm.")] = None,
    moment_limit: Annotated[float | None, typer.Option(help="Moment at the end of the colours, µN·m.")] = None,
    size: Annotated[str | None, typer.Option(help="Pixels. [default: 1280x960, a film 800x600]")] = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Draw a scene: whiskers bent by its objects, as a picture or a film; no display is needed."""
    from brainbench.core.figures import check_format
    from brainbench.stimuli.figures import pictures as drawing
    from brainbench.stimuli.figures.pictures import Style
    from brainbench.stimuli.figures.surfaces import Camera

    suffix = check_format(out, drawing.FORMATS)
    scene = scenes.choose_scene(scenes.open_recipe(source, whiskers), stimulus)
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
    import math

    from brainbench.core.errors import check_name
    from brainbench.core.figures import check_format
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
