"""The configuration and the model card that are written beside a trained model, and its untrained twin.

The twin is the network that the training started from, to the last bit. Nothing of it is stored but its name, its seed
and a hash: ``load_model(name, seed=seed)`` draws it again, and the hash shows where another version of PyTorch draws
other numbers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from brainbench.core.files import hash_arrays, provenance, to_plain
from brainbench.models.registry import describe_model, load_model
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.evaluation import TWIN, Evaluation


def checkpoint_info(
    config: TrainingConfig,
    classes: tuple[str, ...],
    *,
    epochs_done: float | None,
    best_epoch: float | None,
    evaluation: Evaluation | None,
    twin: Mapping[str, Any],
    controls: Mapping[str, Evaluation] | None = None,
    data: Mapping[str, Any] | None = None,
    split: str = "test",
) -> dict[str, Any]:
    """Return what a checkpoint's configuration says beside the architecture, in plain values.

    ``twin`` is what :func:`~brainbench.models.training.card.describe_twin` told of the network before its training,
    ``controls`` are evaluations of :data:`~brainbench.models.training.evaluation.CONTROLS`, ``data`` the
    :attr:`~brainbench.models.training.batches.Data.summary` of the sweeps, ``split`` the part of them that the
    evaluation is of.
    """
    compared = {name: to_plain(found) for name, found in (controls or {}).items()}
    return {
        "objective": config.objective,
        "augmentation": config.augmentation + (f" + {config.masking:.0%} masking" if config.masking else ""),
        "seed": config.seed,
        "classes": list(classes),
        "epochs": epochs_done,
        "published_epochs": 100,
        "best_epoch": best_epoch,
        "training": dataclasses.asdict(config),
        "evaluation": to_plain(evaluation),
        "twin": dict(twin),
        "licence": "MIT",
        "provenance": provenance(),
        **({"data": dict(data)} if data else {}),
        **({"evaluated_split": split} if split != "test" else {}),
    } | ({"twin_evaluation": compared.pop(TWIN, None), "baselines": compared} if compared else {})


def model_card(config: TrainingConfig, info: Mapping[str, Any]) -> str:
    """Return the text of the model card (Mitchell et al. 2019), in Markdown."""
    model = describe_model(config.model)
    evaluation, data = info["evaluation"], info.get("data")
    rows = {
        "architecture": f"{config.model} ({model.citation})",
        "parameters": f"{model.parameters:,} with 117 classes; {len(info['classes'])} classes here",
        "input": "sweeps [B, T, 30, 5, 7] in N and N·m; normalised inside",
        "data": data
        and f"{data['hash']}: {data['train']:,} sweeps to train, {data['validation']:,} to validate, "
        f"{data['test']:,} of other objects to test; {data['left_out']:,} left out as unstable",
        "epochs": f"{info['epochs']} (published: {info['published_epochs']}); best: {info['best_epoch']}",
        "optimiser": f"{config.optimizer}, {config.schedule}, learning rate {config.learning_rate:g}, batch "
        f"{config.batch_size}, gradients clipped to a norm of {config.clip:g}, {config.precision}",
        "augmentation": info["augmentation"],
        "seed": str(config.seed),
    }
    if evaluation is not None:
        low, high = evaluation["interval"]["low"], evaluation["interval"]["high"]
        read = "linear probe on the frozen network" if config.objective != "supervised" else "its own decoder"
        split = info.get("evaluated_split")
        rows |= {
            "top-1": f"{evaluation['top1']:.3f} [{low:.3f}, {high:.3f}] on {evaluation['count']} sweeps ({read})",
            "beware": split and f"these accuracies are of the {split} sweeps, which chose the weights",
            "top-5": f"{evaluation['top5']:.3f}",
            "test data": evaluation["data"],
            "collapsed": f"yes: {evaluation['reason']}" if evaluation["collapsed"] else "no",
        }
    for name, text in (info.get("baselines") or {}).items():
        rows[name.replace("-", " ")] = f"linear probe: {_top1(text)}"
    twin = info["twin"]
    rows["untrained twin"] = f"{twin['name']}, seed {twin['seed']}{_beside(evaluation, info.get('twin_evaluation'))}"
    rows["licence"] = info["licence"]
    table = "".join(f"| {name} | {told} |\n" for name, told in rows.items() if told)
    return (
        f"# {config.model}.{config.objective}\n\n{model.description}, trained with brainbench: {config.objective}.\n\n"
        f"| | |\n|---|---|\n{table}\n"
        "Trained on simulated touch alone; what it says about brains is what `brainbench score` measures.\n"
    )


def _beside(trained: Mapping[str, Any] | None, twin: Mapping[str, Any] | None) -> str:
    """Return how a twin, read by a linear probe, compares with what was trained."""
    if not trained or not twin:
        return ""
    low, high = twin["interval"]["low"], twin["interval"]["high"]
    if trained["interval"]["low"] > high:
        verdict = "training helped"
    elif trained["interval"]["high"] < low:
        verdict = "**training made it worse**"
    else:
        verdict = "**training changed less than these intervals can tell**"
    return f", linear probe: {_top1(twin)}; {verdict}"


def _top1(evaluation: Mapping[str, Any]) -> str:
    return f"top-1 {evaluation['top1']:.3f} [{evaluation['interval']['low']:.3f}, {evaluation['interval']['high']:.3f}]"


def describe_twin(name: str, seed: int, model: nn.Module) -> dict[str, Any]:
    """Return what a configuration says of a network before its training: how to get it, and what it was.

    ``state`` is a SHA-256 (32 digits) over names, types, shapes and bytes of all parameters and buffers, the decoder's
    included: it belongs to a number of classes.
    """
    state = hash_arrays({key: value.detach().cpu().numpy() for key, value in model.state_dict().items()})
    return {"name": name, "seed": seed, "state": state, "torch": torch.__version__}


def difference(twin: Mapping[str, Any], drawn: Mapping[str, Any]) -> str:
    """Return why a network that was drawn again is not the twin, as :func:`describe_twin` tells of both; else ''."""
    if twin["state"] == drawn["state"]:
        return ""
    return (
        f"{twin['name']} with seed {twin['seed']} is not the network that training started from: PyTorch "
        f"{drawn['torch']} here draws other weights than PyTorch {twin['torch']} there"
    )


def draw_twin(twin: Mapping[str, Any], options: Mapping[str, Any]) -> tuple[nn.Module, str]:
    """Return the twin that a checkpoint's configuration names, and why it is another network after all, or ''.

    ``twin`` and ``options`` are entries of the configuration.
    """
    model = load_model(twin["name"], seed=twin["seed"], **options)
    return model, difference(twin, describe_twin(twin["name"], twin["seed"], model))
