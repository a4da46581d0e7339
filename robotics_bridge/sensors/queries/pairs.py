"""The plan of who may meet whom, and its refresh once per update for all sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.devices import to_struct, warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import LaunchContext
from robotics_bridge.sensors.kernels.pairs import PairArrays, SlotArrays, list_pairs, start_kernel
from robotics_bridge.sensors.queries.solids import Solids

DIVERGED = 1
"""Status of an environment: since its reset, a pose or velocity was not finite, or a quaternion not of unit length."""
OVERFULL = 2  # status of an environment: the state had no room for some contacts
_LISTED = 16  # geometries in contact with one link that are listed where lists of all would be too long
_LIST_BYTES = 2**28  # most memory for lists of all (bytes)
_PLACE_BYTES = 76  # memory of one place of a list (bytes)


class PairTable:
    """Lists, per environment and slot, the geometries that a sensor link meets.

    Sensors on one link that track the same geometries in the same way share a slot. Arrays are made by
    :meth:`freeze`, when all sensors have asked.

    Args:
        listed: geometries in contact with one link that are listed at once; None lists all, where that takes at most
            256 MiB, and 16 otherwise.
    """

    def __init__(self, context: LaunchContext, solids: Solids, listed: int | None = None) -> None:
        self._context, self._solids = context, solids
        self._listed, self._slots = listed, list[dict[str, Any]]()
        self.struct: Any = None
        """The Warp structure ``PairArrays``; None before :meth:`freeze`."""
        self.plan: Any = None
        """The Warp structure ``SlotArrays``; None before :meth:`freeze`."""
        self.crowded: Any = None
        """Warp array [B]: the most geometries that ever met a sensor whose list holds fewer; 0 where none was lost."""
        self.status: Any = context.zeros(context.num_envs, int)
        """Warp array [B] of :data:`DIVERGED` and :data:`OVERFULL`, as of the last update."""
        self._loaded: set[int] = set()
        self.loads: Any = None
        """Warp array [3, B, L] of links with taxels of ``total="engine"``: sum of the engine's forces, what taxels lack
        of them (N) and of their moment (N·m); None where there are none (:meth:`count_loads`)."""
        self.told: Any = context.zeros(2, int)
        """Warp array [2]: 1 once more than a hundredth of a load was missing, and once its place was off by a taxel."""
        self.widths = np.zeros(len(solids.scene.links), np.float32)
        """[L] sensing radius of the widest taxel that adds up to these forces (m)."""

    def slot(
        self,
        link: int,
        members: Sequence[int],
        *,
        contact: bool,
        center: ArrayLike = (0.0, 0.0, 0.0),
        reach: float = 0.0,
    ) -> int:
        """Return the number of the slot for a sensor link and the geometries that it may meet.

        Args:
            contact: list those in contact only; otherwise all within reach.
            center: middle of the probes in the link frame (m).
            reach: how far beyond it a geometry can matter (m); 0 lists all.
        """
        wanted = {"link": link, "members": tuple(members), "contact": contact}
        for number, slot in enumerate(self._slots):
            # Sensors of one link that may meet the same geometries share a list; lists by distance depend on where the
            # probes are.
            if all(slot[key] == value for key, value in wanted.items()) and (contact or reach == slot["reach"] == 0):
                return number
        self._slots.append({**wanted, "center": np.asarray(center, np.float32), "reach": float(reach)})
        return len(self._slots) - 1

    def count_loads(self, links: Sequence[int], widths: np.ndarray) -> tuple[Any, list[bool]]:
        """Return :attr:`loads`, made by the first call, and which of these links no call before has named.

        ``widths`` [L] are those of the caller's taxels.
        """
        if self.loads is None:
            self.loads = self._context.zeros((3, self._context.num_envs, len(self._solids.scene.links)))
        self.widths = np.maximum(self.widths, widths)
        fresh = [link not in self._loaded for link in links]
        self._loaded.update(links)
        return self.loads, fresh

    def freeze(self) -> None:
        """Make the arrays."""
        c, slots, envs = self._context, self._slots, self._context.num_envs
        self._contacts = any(slot["contact"] for slot in slots)
        most = self._listed
        if most is None and envs * _PLACE_BYTES * sum(len(s["members"]) for s in slots) > _LIST_BYTES:
            most = _LISTED
        self._rooms = [max(1, len(s["members"][: most if s["contact"] else None])) for s in slots]
        self._words = max([1, *(-(-len(s["members"]) // 32) for s in slots)])
        count = max(len(slots), 1)
        place = np.full((count, self._solids.kinds.shape[1]), -1)
        for number, slot in enumerate(slots):
            place[number, list(slot["members"])] = np.arange(len(slot["members"]))
        scene = self._solids.scene
        # The link of every geometry whose contacts matter, to turn the others away at once.
        links = scene.link_of if scene.geometries else np.full(1, -1)
        first = np.cumsum([0, *self._rooms])
        plan = {
            "link": [s["link"] for s in slots],
            "watched": np.where(np.isin(links, [s["link"] for s in slots if s["contact"]]), links, -1),
            "contact": [int(s["contact"]) for s in slots],
            "felt": [s["link"] if s["contact"] else -1 for s in slots],
            "first": first,
            "room": self._rooms,
            "members": [m for s in slots for m in s["members"]],
            "member_first": np.cumsum([0, *(len(s["members"]) for s in slots)]),
            "place": place,
            "center": np.reshape([s["center"] for s in slots], (-1, 3)),
            "reach": [s["reach"] for s in slots],
        }
        self.plan = to_struct(SlotArrays, {name: np.asarray(values) for name, values in plan.items()}, c.device)
        listed = (envs, max(int(first[-1]), 1))
        lists = PairArrays()
        lists.first, lists.count = self.plan.first, c.zeros((envs, count), int)
        lists.geometry, lists.rotation = c.zeros(listed, int), c.zeros(listed, warp().mat33f)
        for name in ("offset", "velocity", "spin"):
            setattr(lists, name, c.zeros(listed, warp().vec3f))
        self.struct = lists
        self._bits = c.zeros((envs, count * self._words), int)
        sided = self._solids.sided and bool(plan["members"])
        lists.push = c.zeros(listed if sided else (0, 0), warp().vec3f)
        self._pushes = c.zeros((envs, len(plan["members"]), 4) if sided else (0, 0, 0), int)
        self.crowded = c.zeros(envs, int)

    def update(self, state: HandState) -> None:
        """Count an update, refresh the state's status, mark contacts, and list what every slot meets now."""
        c, envs, room = self._context, self._context.num_envs, state.contact_env.shape[0]
        # A processor gains nothing from more threads.
        cuda = c.device.is_cuda
        dim, looks = max(envs, room) if self._contacts and cuda else envs, state.num_links if cuda else 1
        inputs = [self.plan, state.arrays, self._words, self._bits, self._pushes, c.age, self.status, dim]
        c.launch(start_kernel(self._contacts), dim, *inputs)
        inputs = [self.plan, self._solids.struct, state.arrays, self._words, self._bits, self._pushes, self.struct]
        c.launch(list_pairs, envs * (len(self._slots) + looks), *inputs, looks, self.crowded, self.status)
