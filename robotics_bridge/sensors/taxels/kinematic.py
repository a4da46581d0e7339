"""KinematicTaxel: force and torque per taxel from depth, normal and relative velocity (thesis 4.4–4.10)."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, unknown_name
from robotics_bridge.sensors.noise.model import GRID_KNOBS
from robotics_bridge.sensors.sensor import Convention, ProbeRuntime, QuerySensor, probe_rows

if TYPE_CHECKING:
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.sensor import Context

CONVENTIONS = ("physical", "thesis")


def check_convention(value: str) -> None:
    """Refuse an unknown force convention with UsageError."""
    if value not in CONVENTIONS:
        raise unknown_name("force convention", value, CONVENTIONS)


@dataclass(frozen=True, kw_only=True)
class KinematicTaxel(QuerySensor):
    """Force (N) and torque (N·m) on the sensor [N, 6], in the link frame, torques about the link's origin.

    With depth d, outward normal m of what is touched and relative velocity v (split into normal and tangential)::

        f = k_n d^α m + c_n d^α v_n ± k_t v_t,    τ = x × f ± k_ω (ω·m) m

    ``physical`` takes plus signs (friction drags the sensor along) and never pulls; ``thesis`` takes the published
    minus signs. Defaults are the published parameters (4.10).

    Raises:
        UsageError: the convention or the total is unknown, or the exponent is not positive.
    """

    stiffness: float = 500.0
    """k_n, N/m^α."""
    damping: float = 1.0
    """c_n, N·s/m^(1+α)."""
    exponent: float = 1.2
    """α."""
    shear: float = 2.0
    """k_t, N·s/m."""
    twist: float = 2.0
    """k_ω, N·m·s."""
    convention: Convention = "physical"
    total: Literal["law", "engine"] = "law"
    """``law``: each taxel by itself, as published. ``engine``: the field is scaled so that it pushes with just the
    normal force that the physics engine resolved between the link and what it tracks."""

    channels: ClassVar[int] = 6
    units: ClassVar[str] = "N, N m"
    knobs: ClassVar[frozenset[str]] = GRID_KNOBS

    def __post_init__(self) -> None:
        super().__post_init__()
        check_convention(self.convention)
        if self.total not in ("law", "engine"):
            raise unknown_name("total of a force field", self.total, ("law", "engine"))
        if not self.exponent > 0:
            raise UsageError(f"The exponent of a contact law is positive; received {self.exponent!r}.")

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return (self.query, self.convention, self.total)

    @classmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> KinematicRuntime:
        """Return the runtime that serves these sensors together."""
        return KinematicRuntime(sensors, context)


class KinematicRuntime(ProbeRuntime):
    """Serves kinematic taxels.

    Args:
        sensors: Of one group, by name; those of a group share what decides which kernels run.
        context: Of the suite: scene, environments, device, clock and geometries.
    """

    def __init__(self, sensors: Mapping[str, KinematicTaxel], context: Context) -> None:
        from robotics_bridge.sensors.probes.kernels.probe import KinematicParams

        first = next(iter(sensors.values()))
        scaled = first.total == "engine"
        super().__init__(sensors, 6, context, fusable=not scaled)
        self._options = (first.query == "raycast", first.convention == "physical")
        laws = []
        for sensor in sensors.values():
            law = KinematicParams()
            for name in ("stiffness", "damping", "exponent", "shear", "twist"):
                setattr(law, name, getattr(sensor, name))
            laws.append(law)
        wp = warp()
        self._laws = wp.array(laws, dtype=KinematicParams, device=context.device)
        self._loads: Any = (
            wp.zeros((len(laws), context.num_envs), dtype=wp.vec3f, device=context.device) if scaled else None
        )
        self._scales = wp.zeros((len(laws), context.num_envs), dtype=wp.float32, device=context.device)
        slots = self.probes.slot.numpy()
        spans = np.array([(p.start, p.start + p.count, slots[p.start]) for p in self.places.values()], np.int32)
        self._spans = wp.array(spans, dtype=wp.vec3i, device=context.device)
        self._rows = wp.array(
            probe_rows(self.places.values(), context, self.mode), dtype=wp.vec4i, device=context.device
        )

    def update(self, state: HandState, dt: float) -> None:
        """Read the state."""
        from robotics_bridge.sensors.probes.kernels.probe import kinematic_kernel

        self.begin(state, dt)
        kernel = kinematic_kernel(self.kinds, *self._options, self.mode, *self.stores, self.context.device.is_cuda)
        c = self.context
        inputs = [self.probes, self._rows, c.solids.struct, c.pairs.struct, self.io, self.knobs, self._laws]
        warp().launch(kernel, dim=(c.num_envs, self._rows.shape[0]), inputs=inputs, device=c.device)
        if self._loads is not None:
            self._scale(state)
        self.finish(dt)

    def _scale(self, state: HandState) -> None:
        """Make the field push as the engine does."""
        from robotics_bridge.sensors.taxels.kernels.contact_load import gather_loads, scale_field, weigh_field

        wp, c = warp(), self.context
        dim, device = self._loads.shape, c.device
        self._loads.zero_()
        contacts = [
            state.contact_count,
            state.contact_geom,
            state.contact_env,
            state.contact_normal,
            state.contact_force,
        ]
        inputs = [self._spans, c.pairs.plan, c.solids.struct.link, *contacts, self._loads]
        wp.launch(gather_loads, dim=state.contact_env.shape[0], inputs=inputs, device=device)
        inputs = [self._spans, c.pairs.plan, state.pose, self._truth, self._loads, self._scales]
        wp.launch(weigh_field, dim=dim, inputs=inputs, device=device)
        inputs = [self.probes.part, self._scales, self._truth, self._measured, int(self.noisy)]
        self.launch(scale_field, *inputs)
