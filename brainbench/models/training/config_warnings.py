"""What speaks against a training before it begins: settings that are allowed and cannot teach what is hoped for."""

from __future__ import annotations

from typing import Any

from brainbench.models.training.config import TrainingConfig

CONTRASTIVE = ("simclr", "simsiam")
PLAYED_BACKWARDS = ("physical", "thesis")
"""Augmentations that reverse time."""


def config_warnings(config: TrainingConfig, model: Any) -> list[str]:
    """Return reasons why a run may teach nothing, each a sentence and what to do instead.

    Args:
        config: The run.
        model: Its network, whose ``spec.receptive_field`` is read if there is one.
    """
    found: list[str] = []
    if config.objective not in CONTRASTIVE:
        return found
    if config.augmentation == "none" and not config.masking:
        found.append(
            f"Without augmentation or masking both views of a sweep are equal, so {config.objective} has nothing to "
            "ignore: only telling sweeps apart is rewarded, without bound, and such runs tend to diverge. Choose an "
            "augmentation, or masking."
        )
    seen = getattr(getattr(model, "spec", None), "receptive_field", None)
    if seen is not None and config.augmentation in PLAYED_BACKWARDS:
        steps = "the last step" if seen == 1 else f"the last {seen} steps"
        found.append(
            f"{config.model} has no memory: its last answer sees {steps} of a sweep alone. The augmentation "
            f"{config.augmentation!r} plays half of the views backwards, which end before the whiskers touch anything "
            f"and look all alike, so the loss of {config.objective} cannot fall far. A network with memory or an "
            "attender, or the augmentation 'image', can learn."
        )
    return found
