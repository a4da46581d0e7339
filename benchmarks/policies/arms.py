"""The arms of the controlled comparison: what students feel, and through which encoder."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from robotics_bridge.policies.readouts.arms import without_latency
from robotics_bridge.policies.training.distill_config import DistillConfig

NETWORK = "zhuang-intersection-ln-small"
CHOSEN = "benchmarks/policies/records/taxels-in_palm_rotate-50.json"
"""The 50 taxels that read-outs chose."""
ARMS: dict[str, dict[str, Any]] = {
    "none": {"observe": "none"},
    # Wider, so that it learns as many parameters as the others.
    "none_memory": {"observe": "none", "embedder": "lstm", "hidden": (1024, 256, 128)},
    "ft_hand": {"observe": "force_torque", "placement": "hand"},
    "ft_tips": {"observe": "force_torque", "placement": "tips"},
    "bool_hand": {"observe": "agg_bool", "placement": "hand"},
    "bool_tips": {"observe": "agg_bool", "placement": "tips"},
    "ead_simclr": {"observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.simclr"},
    "ead_supervised": {"observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.supervised"},
    "ead_untrained": {"observe": "force_torque", "placement": "hand", "encoder": NETWORK},
    "reservoir": {"observe": "force_torque", "placement": "hand", "encoder": "reservoir"},
    "reservoir_50": {"observe": "force_torque", "placement": "hand", "encoder": "reservoir", "resolution": CHOSEN},
    "reservoir_graph": {"observe": "force_torque", "placement": "hand", "encoder": "reservoir_graph"},
    "raw_rnn": {"observe": "force_torque", "placement": "hand", "encoder": "rnn"},
    # As many parameters as ft_hand; and those that have as many as raw_rnn.
    "raw_rnn_small": {
        "observe": "force_torque", "placement": "hand", "encoder": "rnn", "encoder_settings": {"units": 9},
        "hidden": (128, 128, 128),
    },
    "ft_hand_large": {"observe": "force_torque", "placement": "hand", "hidden": (1376, 1024, 128)},
    "reservoir_large": {
        "observe": "force_torque", "placement": "hand", "encoder": "reservoir", "hidden": (1376, 1024, 128),
    },
    "ead_finetuned": {
        "observe": "force_torque", "placement": "hand", "encoder": f"{NETWORK}.simclr",
        "encoder_settings": {"learning": "finetuned"},
    },
    "ead_scratch": {
        "observe": "force_torque", "placement": "hand", "encoder": NETWORK,
        "encoder_settings": {"learning": "finetuned"},
    },
}  # fmt: skip
NETWORKS: dict[str, dict[str, Any]] = {
    name: {"observe": "force_torque", "placement": "hand", "encoder": name}
    for name in (
        "zhuang-small", "zhuang-ln-small", "zhuang-ugrnn-small", "zhuang-gru-small", "zhuang-lstm-small",
        "zhuang-intersection-small", "zhuang-feedforward-small", "resnet18-small", "s4-small", "zhuang-small+mamba",
        f"{NETWORK}+mamba", "zhuang-small.simclr", "zhuang-small.supervised", "resnet18-small.supervised",
    )
}  # fmt: skip
"""The other frozen networks of the default board, for the correlation of score and success (point 9 of issue 23). Those
with a transformer are left out: a policy runs without end."""


def settings_of(arm: str, draw: int, pretrained: Path | None = None) -> dict[str, Any]:
    """Return the settings of a student by name in DistillConfig.

    Args:
        arm: one of :data:`ARMS` or :data:`NETWORKS`.
        draw: seed of random encoders and initial states.
        pretrained: weights of another training, for arms with a trained network.
    """
    settings = dict((ARMS | NETWORKS)[arm])
    if "encoder" in settings:
        own: dict[str, Any] = {"seed": draw}
        if _is_network(settings):
            # Networks answer without added latency.
            options = without_latency(settings["encoder"])
            own |= {"learning": "frozen"} | ({"options": options} if options else {})
        if pretrained is not None and settings["encoder"].startswith(f"{NETWORK}."):
            own["pretrained"] = str(pretrained)
        settings["encoder_settings"] = own | settings.get("encoder_settings", {})
    return settings


def arm_of(config: DistillConfig) -> str | None:
    """Return the arm that a student belongs to; None where it belongs to none of them."""
    felt = () if config.observe == "none" else ("placement", "resolution", "encoder")
    for arm in ARMS | NETWORKS:
        wanted = _student_of(arm, config.task)
        same = all(getattr(config, name) == getattr(wanted, name) for name in ("observe", "embedder", "hidden", *felt))
        own, other = config.encoder_settings, wanted.encoder_settings
        if same and all(own.get(name) == other.get(name) for name in ("learning", "units")):
            return arm
    return None


@cache
def _student_of(arm: str, task: str) -> DistillConfig:
    return DistillConfig(task=task, **settings_of(arm, draw=0))


def _is_network(settings: dict[str, Any]) -> bool:
    return settings.get("encoder", "").startswith(NETWORK) or settings.get("encoder") in NETWORKS
