"""Our own whisker solver in Warp: implicit, O(links), rigid contact with exact surfaces, on CPU and GPU.

Jobs of scenes (:mod:`.engine`) and of sweeps (:mod:`.sweeps`) are packed into arrays (:mod:`.packing`, :mod:`.shapes`),
launched and judged (:mod:`.launch`); on a GPU the kernels take turns (:mod:`.scheduling`).
"""

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.engines.rod.engine import RodEngine

__all__ = ["RodEngine"]
__getattr__, __dir__ = lazy_exports(__name__, {"RodEngine": ".engine"})
