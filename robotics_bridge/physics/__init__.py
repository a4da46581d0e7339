"""One state interface for tactile sensors, filled by C MuJoCo on the processor or MuJoCo Warp on the GPU.

``scene`` says what there is to touch, and what differs between environments; ``engines`` step it and fill a ``state``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports
from robotics_bridge.physics.scene import KINDS, Geometry, TouchScene, compile_variants

if TYPE_CHECKING:
    from robotics_bridge.physics.engines import MujocoEngine, MujocoWarpEngine
    from robotics_bridge.physics.state import HandState

__all__ = ["KINDS", "Geometry", "HandState", "MujocoEngine", "MujocoWarpEngine", "TouchScene", "compile_variants"]

# Tasks are made of geometries; only engines need torch.
__getattr__, __dir__ = lazy_exports(__name__)
