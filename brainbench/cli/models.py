"""``brainbench models`` and ``brainbench export``: what can be scored by name, and a model as a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import SeedOption, out_file_option
from brainbench.cli.output import Output, facts, list_without_command, progress_bar, table, table_of, tracked
from brainbench.core.files import to_plain
from brainbench.models.recipes import Architecture, PublishedTraining, find_recipe, list_recipes
from brainbench.models.registry import (
    FAMILY,
    ModelDescription,
    add_user_model,
    describe_model,
    list_models,
    locate_model,
    remove_user_model,
    settings_file,
)
from brainbench.models.training.checkpoints import PREFIXES, find_folder, shipped

UNTRAINED = "untrained: random weights, drawn from --seed (0 unless you say otherwise)"


def model_card(name: str, model: ModelDescription, recipe: PublishedTraining | None, twin: str | None) -> str:
    """Lay out a model by the name that was asked for.

    ``recipe`` says how it was trained in the published study, where its weights are not here; ``twin`` is a sentence
    about the untrained twin of trained weights.
    """
    rows: dict[str, object] = {}
    if model.trained is not None:
        rows |= dict(_trained(model.trained))
    elif recipe is not None:
        train = f"brainbench train {recipe.architecture} --objective {recipe.objective} --data FOLDER"
        rows["weights"] = f"needs training: {train}"
        rows["published setting"] = f"{recipe.setting}, batch {recipe.batch_size:,}, {recipe.epochs} epochs"
        rows["published search"] = f"{len(recipe.search)} settings (--json lists them)"
    else:
        rows["weights"] = "what your code gives" if model.family == FAMILY else UNTRAINED
        rows["trained as"] = list(_tagged(model.name)) or "nothing that comes with the package"
    if twin:
        rows["untrained twin"] = twin
    cost = f", {model.multiply_adds / 1e6:,.1f} M multiply-adds per time step" if model.multiply_adds else ""
    rows["size"] = f"{model.parameters:,} parameters{cost}"
    rows["layers"] = list(model.layers) or "every part that is called (found when the model runs)"
    rows |= {"family": model.family, "licence of code": model.licence}
    if model.citation:
        rows["from"] = model.citation
    if recipe is None or model.trained is not None:
        rows["score it"] = f"brainbench score {name}"
    return "\n".join(filter(None, [name, model.description, "", facts(rows)]))


def _trained(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield what a folder of weights says of its training, where it says so."""
    parts = [f"trained: {config.get('objective') or 'objective not stated'}"]
    if config.get("epochs"):
        published = f" of {config['published_epochs']} published" if config.get("published_epochs") else ""
        parts.append(f"{config['epochs']}{published} epochs")
    parts += [f"{key} {config[key]}" for key in ("augmentation", "seed") if config.get(key) is not None]
    yield "weights", ", ".join(parts)
    if evaluation := config.get("evaluation"):
        yield "accuracy (top-1)", _accuracy(evaluation, config.get("evaluated_split"))
        others = dict(config.get("baselines") or {}) | {"untrained twin": config.get("twin_evaluation")}
        readouts = [f"{key.replace('-', ' ')} {item['top1']:.1%}" for key, item in others.items() if item]
        if readouts:
            yield "same readout of", ", ".join(readouts)
    if data := config.get("data"):
        yield "trained on", f"{data.get('train') or 0:,} sweeps of {data.get('classes')} classes ({data.get('hash')})"
    if config.get("licence"):
        yield "licence of weights", str(config["licence"])


def _accuracy(evaluation: Mapping[str, Any], split: str | None) -> str:
    span = evaluation.get("interval") or {}
    bounds = f" [{span['low']:.1%}, {span['high']:.1%}]" if {"low", "high"} <= span.keys() else ""
    sweeps = f"{split} sweeps, which chose the weights" if split else "sweeps that were held out"
    count = f", {evaluation['count']:,} {sweeps}" if evaluation.get("count") else ""
    return f"{evaluation['top1']:.1%}{bounds}{count}{', collapsed to one class' if evaluation.get('collapsed') else ''}"


def _tagged(name: str) -> Iterator[str]:
    return (tagged for tagged in shipped() if Architecture.parse(tagged).untrained == name)


app = typer.Typer(help="List and describe the registered models; add your own.")


@app.command("list")
def list_(pattern: Annotated[str, typer.Argument(help="Shell pattern, e.g. '*-ln*'.")] = "*") -> Output:
    """List the models by name, with their sizes and what their weights are (also: brainbench models)."""
    here = shipped()
    names = [*list_models(pattern), *(name for name in here if fnmatchcase(name, pattern))]
    records = [describe_model(name) for name in tracked(names, "measuring models")]
    tags = {name: [str(Architecture.parse(one).tag) for one in list_recipes(f"{name}.*")] for name in names}
    data = [{**to_plain(item), "recipes": tags[item.name]} for item in records]
    rows = [
        [
            record.name,
            "trained" if record.trained else "your code" if record.family == FAMILY else "untrained",
            *_size(record),
        ]
        for record in records
    ]
    sizes = dict(zip(names, map(_size, records), strict=True))
    for name in list_recipes(pattern):
        plain = Architecture.parse(name).untrained
        if name not in here:
            sizes[plain] = sizes.get(plain) or _size(describe_model(plain))
            rows.append([name, "needs training", *sizes[plain]])
    if not rows:
        return Output(data, f"No model has a name like {pattern!r}; see them all with: brainbench models")
    rows.sort(key=lambda row: ("trained", "your code", "untrained", "needs training").index(row[1]))
    legend = (
        "trained: weights come with the package; untrained: random weights, drawn from --seed;\n"
        "needs training: published, to be trained with brainbench train.\n"
        "MACs/step: multiply-adds per time step."
    )
    lines = table("", ["model", "weights", "parameters", "MACs/step"], rows, right=(2, 3))
    return Output(data, f"{lines}\n\n{legend}")


list_without_command(app, list_)


@app.command("recipes")
def recipes(pattern: Annotated[str, typer.Argument(help="Shell pattern, e.g. '*.simclr'.")] = "*") -> Output:
    """List the published combinations of architecture and objective, with their training settings."""
    chosen = [find_recipe(name) for name in list_recipes(pattern)]
    sizes = {name: describe_model(name) for name in {item.architecture for item in chosen}}
    columns = {
        "recipe": "{0.name}",
        ">parameters": lambda recipe: f"{sizes[recipe.architecture].parameters:,}",
        ">multiply-adds/step": lambda recipe: _millions(sizes[recipe.architecture].multiply_adds),
        "default setting": "{0.setting}",
        ">batch": "{0.batch_size}",
        ">settings in the search": lambda recipe: len(recipe.search),
    }
    data = [{"name": item.name, **to_plain(item)} for item in chosen]
    return Output(data, table_of("", chosen, columns))


@app.command("show")
def show(
    name: Annotated[str, typer.Argument(help="A registry name, a recipe's name or a folder of trained weights.")],
) -> Output:
    """Describe one model: size, layers, citation and, with an objective, how it is trained."""
    recipe = find_recipe(name) if name in list_recipes() else None
    record = describe_model(recipe.model if recipe else name)
    data = {**to_plain(record), "trained_as": [*_tagged(record.name)]}
    if recipe:
        data["recipe"] = to_plain(recipe)
    twin = (record.trained or {}).get("twin")
    if twin:
        from brainbench.models.training.evaluation import draw_twin

        _, difference = draw_twin(twin, data["trained"]["options"])
        data["twin"] = difference or f"{twin['name']} with seed {twin['seed']}, drawn here to the last bit"
    return Output(data, model_card(name, record, recipe, data.get("twin")))


@app.command("add")
def add(
    target: Annotated[str, typer.Argument(help="FILE.py:NAME or package.module:NAME, which gives a torch module.")],
    name: Annotated[str, typer.Option(help="What to call it on the command line.")],
) -> Output:
    """Give a model of your own a name; it is kept in your settings, and the code stays where it is."""
    model = add_user_model(target, name, names=list_models())
    rows = {"model": model.name, "code": model.target, "kept in": settings_file()}
    return Output(model, f"{facts(rows)}\n\nscore it: brainbench score {model.name}")


@app.command("remove")
def remove(
    name: Annotated[str, typer.Argument(help="A name that brainbench models add was given.")],
) -> Output:
    """Take the name of a model of your own away; its code stays."""
    model = remove_user_model(name)
    return Output(model, f"{model.name} is no longer a name of {model.target}; the code was not touched.")


def export(
    model: Annotated[str, typer.Argument(help="A registry name, or local-dir:FOLDER of a trained model.")],
    format: Annotated[str, typer.Option(help="onnx, or torch (an exported program).")] = "onnx",
    out: Annotated[Path | None, out_file_option("File to write.")] = None,
    seed: SeedOption = 0,
) -> Output:
    """Export one step, obs and h_in to features and h_out, with its contract, and check the written file."""
    located = locate_model(model)  # before PyTorch is imported
    from brainbench.models.export import SUFFIXES, export_model

    name = find_folder(model).resolve().name if model.startswith(PREFIXES) else model
    target = out or Path(f"{name}{SUFFIXES.get(format, '')}")
    with progress_bar("exporting the network"):
        exported = export_model(located.build(seed), target, format=format, name=model)
    text = (
        f"{model}: {exported.features} features, {exported.state_size:,} numbers of state; the file agrees with the "
        f"network to {exported.difference:.1e}\n\nfile      {exported.path}\ncontract  {exported.contract}"
    )
    return Output(exported, text)


def _size(model: ModelDescription) -> tuple[str, str]:
    return f"{model.parameters:,}", _millions(model.multiply_adds)


def _millions(value: int | None) -> str:
    return "–" if value is None else f"{value / 1e6:,.1f} M"
