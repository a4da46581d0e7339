"""Write the sizes of the models that come with the package: python -m tests.factories.model_sizes."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from brainbench.core.files import write_json
from brainbench.models.registry import SIZES, list_models, locate_model, measure
from brainbench.models.training.checkpoints import shipped


def names_with_sizes() -> list[str]:
    """Names of our own models, untrained and trained."""
    return [name for name in list_models() if locate_model(name).record.source == "brainbench"] + list(shipped())


def plain_size(name: str) -> dict[str, Any]:
    """Size of a model as it is measured now, in JSON types."""
    size = asdict(measure(locate_model(name)))
    return {**size, "layers": list(size["layers"])}


if __name__ == "__main__":
    write_json(SIZES, {name: plain_size(name) for name in names_with_sizes()})
