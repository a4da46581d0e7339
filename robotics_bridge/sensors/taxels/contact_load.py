"""Runtime of taxels that add up to the contact forces of the engine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from brainbench.core.devices import warp
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.kernels import contact_load as kernels
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.runtime import SuiteContext
from robotics_bridge.sensors.taxels.runtime import KinematicRuntime
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel

wp = warp()


class ContactLoadRuntime(KinematicRuntime):
    """Serves kinematic taxels with ``total="engine"``: contact forces, spread by the depths of the law."""

    summed = True

    def __init__(self, sensors: Mapping[str, KinematicTaxel], context: SuiteContext) -> None:
        super().__init__(sensors, context)
        configs = list(sensors.values())
        links = [context.scene.link_index(sensor.link) for sensor in configs]
        order = [links[:number].count(link) for number, link in enumerate(links)]
        self._most = max(order) + 1
        places = np.full((len(context.scene.links), self._most), -1)
        places[links, order] = np.arange(len(links))
        spans = [(p.start, p.start + p.count, slot) for p, slot in zip(self.slices.values(), self.slots, strict=True)]
        plan = self.plan
        plan.sensors, plan.link = context.array(places, int), context.array(links, int)
        plan.order, plan.spans = context.array(order, int), context.array(spans, wp.vec3i)
        plan.reach = context.array(np.concatenate([contact_reach(sensor.probes) for sensor in configs]), float)
        plan.row_first = context.array(np.searchsorted(self.rows.numpy()[:, 3], np.arange(len(spans) + 1)), int)
        plan.status = context.pairs.status
        plan.slip = 1.0 if configs[0].convention == "physical" else -1.0
        shape, press = (context.num_envs, self.count), self.press
        press.weight, press.total = context.zeros(shape), context.zeros(shape)
        press.part = context.zeros((context.num_envs, self.rows.shape[0]), wp.spatial_vectorf)
        press.noisy = context.zeros(shape if self.noisy else (1, 1))
        press.normal, press.body = context.zeros(shape, wp.vec3f), context.zeros(shape, int)
        press.sigma = context.zeros(shape if configs[0].sticky else (0, 0), wp.vec3f)
        self.scratch = [press.weight, press.total, press.normal, press.body, press.sigma, press.part]
        self.scratch += [press.noisy] if self.noisy else []
        # Stages after this one write into the measured readings, which are then never left alone.
        self._written = context.array(np.full((context.num_envs, self.rows.shape[0]), self.noisy), wp.uint8)
        self.nodes = self._make_nodes(0)

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the kernels."""
        c, room = self.context, state.contact_env.shape[0]
        if self.nodes.felt.shape[0] != 2 * room:
            self.nodes = self._make_nodes(room)
        plan, nodes, press = self.plan, self.nodes, self.press
        # A processor can look how many contacts there are; on a GPU that would wait for it.
        found = room if c.device.is_cuda else min(room, int(state.contact_count.numpy()[0]))
        nodes.head.fill_(-1)
        known = [plan, c.pairs.plan, c.solids.struct.link, self.probes, state.arrays]
        c.launch(kernels.list_contacts, 2 * found, *known, state.contact_friction, nodes)
        if c.device.is_cuda:
            c.launch(kernels.sort_contacts, nodes.head.shape, nodes)
        super().run_kernels(state, dt)
        c.launch(kernels.share_contacts, (2 * found, self._most), *known, press, nodes)
        inputs = [plan, self.probes, self.rows, press, nodes, int(self.noisy), self._written, self.io]
        c.launch(kernels.spread_contacts, (c.num_envs, self.rows.shape[0]), *inputs)

    def _make_nodes(self, room: int) -> Any:
        c, nodes = self.context, kernels.ContactNodes()
        nodes.head = c.zeros((c.num_envs, len(c.scene.links)), int)
        for name in ("follower", "felt", "other"):
            setattr(nodes, name, c.zeros(2 * room, int))
        for name in ("point", "normal", "force"):
            setattr(nodes, name, c.zeros(2 * room, wp.vec3f))
        nodes.load, nodes.share = c.zeros(2 * room), c.zeros((2 * room, self._most), wp.vec4f)
        return nodes


def contact_reach(probes: Probes) -> np.ndarray:
    """Return how near [N] a contact must be to be felt (m): the sensing radius, or the corner of a taxel's own cell.

    Fillers get −1. The corner of a square cell is 1/√2 of the pitch away; of a grid's three nearest neighbours the
    third lies along its wider pitch.
    """
    reach, active = np.full(len(probes.radius), -1.0), np.asarray(probes.active, dtype=bool)
    places = np.asarray(probes.position)[active]
    cell = np.zeros(len(places))
    if len(places) > 1:
        cell = KDTree(places).query(places, k=min(4, len(places)))[0][:, -1] / np.sqrt(2)
    reach[active] = np.maximum(probes.radius[active], cell)
    return reach
