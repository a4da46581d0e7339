"""The options of an environment batch, stated once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from brainbench.core.devices import pick_device
from brainbench.core.errors import UsageError, check_kind, check_name
from brainbench.core.reading.ranges import check_fields
from robotics_bridge.hands.layouts import check_names
from robotics_bridge.hands.observations import observation_type
from robotics_bridge.physics.state import MOST_ENVS

ENGINES = ("mujoco", "warp")


@dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """Options of the simulation of a task, and of what is observed; a value that is not valid is a UsageError."""

    num_envs: int = 1
    """Environments B."""
    device: str = "cpu"
    """``cpu``, ``cuda`` or ``cuda:1``."""
    engine: str | None = None
    """``mujoco`` (C MuJoCo) or ``warp`` (MuJoCo Warp); by default the one for the device."""
    observe: str = "none"
    """Tactile observation type (table 4.3); ``none`` builds no tactile sensor."""
    placement: str = "hand"
    """Place of the taxels: ``hand``, ``fingers``, ``tips`` or ``palm``."""
    resolution: str = "med"
    """Number of taxels: ``low``, ``med`` or ``high``; or a probe file (``.json``)."""
    noisy: bool = False
    """Tactile readings with the published imperfections."""
    seed: int = 0
    """Seed of all random numbers."""
    link_pose: bool = False
    """Also observe the poses of the tactile links in the palm's frame."""
    keep_final: bool = False
    """Return the last observations of episodes that ended as ``info["final_observations"]``."""
    threads: int | None = None
    """Threads of C MuJoCo; None takes all processors."""
    knobs: Mapping[str, Any] = field(default_factory=dict)
    """Further settings of the tactile sensors, e.g. ``{"points": 500}``."""
    graphs: bool | None = None
    """Replay what a control step does around physics as CUDA graphs, recorded in the third step; by default on CUDA.

    A task whose terms cannot be recorded runs without, and says so; with ``True`` it is an error.
    """

    def __post_init__(self) -> None:
        check_fields(self, "num_envs", least=1, most=MOST_ENVS, whole=True)
        check_fields(self, "seed", least=0, below=2**63, whole=True)
        check_fields(self, "threads", least=1, whole=True)
        check_kind("device", self.device, str, "'cpu', 'cuda' or 'cuda:N'")
        object.__setattr__(self, "engine", self.engine or ("mujoco" if self.device == "cpu" else "warp"))
        check_name("engine", self.engine, ENGINES)
        observation_type(self.observe)
        check_names("low" if self.resolution == "custom" else self.resolution, self.placement)
        if self.observe == "none" and (self.noisy or self.knobs):
            raise UsageError("noisy and knobs are settings of tactile sensors; choose an observation type.")
        if self.link_pose and self.observe == "none":
            raise UsageError("Poses of tactile links belong to tactile sensors; choose an observation type.")
        pick_device(self.device)
        if self.graphs and not self.device.startswith("cuda"):
            raise UsageError(f"Graphs are recorded on CUDA only, not on {self.device}; leave it out.")
