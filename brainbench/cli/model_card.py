"""A model as people read it: what its weights are, what they can do, its size, and the next command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from brainbench.cli.output import facts

if TYPE_CHECKING:
    from brainbench.models.recipes import PublishedTraining
    from brainbench.models.registry import ModelDescription

UNTRAINED = "untrained: random weights, drawn from --seed (0 unless you say otherwise)"


def model_card(name: str, model: ModelDescription, recipe: PublishedTraining | None, twin: str | None) -> str:
    """Lay out a model by the name that was asked for.

    ``recipe`` says how it was trained in the published study, where its weights are not here; ``twin`` is a sentence
    about the untrained twin of trained weights.
    """
    from brainbench.models.user_models import FAMILY

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
        yield "accuracy (top-1)", _accuracy(evaluation)
        others = dict(config.get("baselines") or {}) | {"untrained twin": config.get("twin_evaluation")}
        readouts = [f"{key.replace('-', ' ')} {item['top1']:.1%}" for key, item in others.items() if item]
        if readouts:
            yield "same readout of", ", ".join(readouts)
    if data := config.get("data"):
        yield "trained on", f"{data.get('train') or 0:,} sweeps of {data.get('classes')} classes ({data.get('hash')})"
    if config.get("licence"):
        yield "licence of weights", str(config["licence"])


def _accuracy(evaluation: Mapping[str, Any]) -> str:
    span = evaluation.get("interval") or {}
    bounds = f" [{span['low']:.1%}, {span['high']:.1%}]" if {"low", "high"} <= span.keys() else ""
    count = f", {evaluation['count']:,} sweeps that were held out" if evaluation.get("count") else ""
    return f"{evaluation['top1']:.1%}{bounds}{count}{', collapsed to one class' if evaluation.get('collapsed') else ''}"


def _tagged(name: str) -> Iterator[str]:
    from brainbench.models.architecture import Architecture
    from brainbench.models.training.checkpoints import shipped

    return (tagged for tagged in shipped() if Architecture.parse(tagged).untrained == name)
