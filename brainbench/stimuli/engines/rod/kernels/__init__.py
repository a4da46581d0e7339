"""Warp kernels of the whisker solver. Units: mg, mm, ms, mN, µN·m.

``step`` runs whiskers from reading to reading. In each step ``articulated_body`` finds the motion of the chain and its
accelerations without contact, ``broad_phase`` and ``narrow_phase`` (with ``mesh_search`` and ``distances``) where it
may touch something, ``contact_solver`` and ``delassus`` the contact forces. Whiskers at rest are skipped; on a GPU
whiskers pause while kernels of ``narrow_phase`` and ``contact_solver`` find the distances and forces that they wait
for. Steps may be written down by the kernels of another package, the recorder.

The modules are ordinary Warp code for the types and sizes in ``parameters``. :func:`specialize` loads them once for
each precision and size, like a template.
"""

import importlib
import sys
import threading
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from brainbench.stimuli.engines.rod.limits import DISTANCE_GROUP, GROUPS, MESHES, contacts_for

BUILDING = threading.Lock()
"""To be held while kernels are built: two threads at once would build their structures twice."""


@dataclass(frozen=True, eq=False)
class Kernels:
    """Kernels of one precision and capacity, and the structures that they take."""

    run: Any
    """Takes every whisker to its last reading, or to where it pauses."""
    structs: ModuleType
    """Module of the structures (``kernels.state``) for these kernels."""
    go_on: Any = None
    """This and the next three only of kernels that pause: takes whiskers from their distances to contact forces."""
    swap_queues: Any = None
    measure_distances: Any = None
    distance_group: int = 1
    """Threads that answer one distance query."""
    solve_contacts: tuple[tuple[Any, int], ...] = ()
    """Kernel and threads for one whisker, of each queue of contact problems."""
    parameters: dict[str, Any] = field(default_factory=dict)
    """What they were built for."""
    loading: threading.Lock = field(default_factory=threading.Lock)


def specialize(module: str, *, recorder: str = "", **parameters: Any) -> ModuleType:
    """Return a module of this package for given ``parameters``; the others keep their values.

    ``recorder`` is the package of kernels whose modules stand beside these as ``recorder.…``.
    """
    label = "_".join(
        name if value is True else str(getattr(value, "__name__", value)) for name, value in sorted(parameters.items())
    )
    package = f"{__name__}_{label}"
    if package not in sys.modules:
        template = sys.modules[package] = ModuleType(package)
        template.__path__ = __path__
        given = vars(importlib.import_module(f"{package}.parameters"))
        if unknown := set(parameters) - set(given):
            raise TypeError(f"no such parameters: {sorted(unknown)}")
        given.update(parameters)
        if recorder:
            spec = find_spec(recorder)
            assert spec is not None
            beside = sys.modules[f"{package}.recorder"] = ModuleType(f"{package}.recorder")
            beside.__path__ = spec.submodule_search_locations
    return importlib.import_module(f"{package}.{module}")


@cache
def build_kernels(
    real: type,
    capacity: int,
    against: int = MESHES,
    bounds: tuple[int, int] | None = None,
    sliced: bool = False,
    cuda: bool = False,
    hinges: int = 2,
    recorder: str = "",
    features: tuple[str, ...] = (),
) -> Kernels:
    """Return the kernels for chains of at most ``capacity`` links in one precision; each is compiled by itself.

    Args:
        real, capacity: ``warp.float32`` or ``warp.float64``; links that fit.
        against: what there is to touch, :data:`NOTHING`, :data:`PRIMITIVES` or :data:`MESHES`.
        bounds: threads per block and blocks per multiprocessor that the CUDA compiler aims at.
        sliced: whether a whisker pauses wherever it needs a distance from a mesh or contact forces, so that both are
            done for all whiskers by kernels of their own; results are the same. One shape a scene.
        cuda: compile for a GPU: with approximate divisions and roots, and groups of threads that find contact forces.
        hinges: hinges of a joint, 2 for bending alone or 3 for bending and twist.
        recorder: package of the kernels that write steps down (``recording``, ``records``) and solve their contact
            forces to rounding (``newton``); whiskers then pause after some steps. Not with ``sliced``.
        features: those of ``smooth``, ``yields``, ``rolls`` and ``flows`` that a scene uses; a ``recorder`` knows only
            the first.
    """
    most = contacts_for(capacity)
    common = {"real": real, "capacity": capacity, "against": against, "sliced": sliced, "cuda": cuda, "hinges": hinges}
    common |= dict.fromkeys(features, True)
    whole = {"max_contacts": most, "bounds": bounds, **common}
    if recorder:
        whole |= {"recorded": True, "recorder": recorder}
    run, structs = specialize("step", stage=int(sliced), **whole).run, specialize("state", **whole)
    if not sliced:
        return Kernels(run, structs, parameters=whole)
    # Threads of a group: for few contacts, for some and for many. A processor takes them one by one.
    sizes = (*GROUPS, (most, 8 if most <= 8 else 16)) if cuda else ((most, 1),)
    group = DISTANCE_GROUP if cuda else 1
    return Kernels(
        run,
        structs,
        specialize("step", stage=2, **whole).run,
        specialize("broad_phase", **whole).swap_queues,
        specialize("narrow_phase", group_size=group, **common).measure_distances,
        group,
        tuple(
            (specialize("contact_solver", max_contacts=held, group_size=size, queue=rank, **common).solve_queue, size)
            for rank, (held, size) in enumerate(sizes)
        ),
    )
