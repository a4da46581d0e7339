"""Thermometers on the fingers, the heat latch and the success metric of hot_ball (thesis 4.41, 4.42).

Letters: B environment, F finger link with a grid, K ball.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, check_name
from brainbench.core.reading.ranges import check_fields, check_number
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import ABSOLUTE_ZERO, ThermalBody, ThermalMaterial, material
from robotics_bridge.sensors.temperature.runtime import link_temperature

if TYPE_CHECKING:
    import torch

    from robotics_bridge.tasks.step_context import StepContext, TaskScene


@dataclass(frozen=True, kw_only=True)
class ThermalSettings:
    """Materials of fingers and balls. The first four numbers are the axes of figure 4.8 and section 4.6.3."""

    conductivity: float = 150.0
    """Conductivity of the fingers [W/(m·K)]."""
    emissivity: float = 0.5
    heat: float = 500.0
    """Made inside the fingers, per area of a layer of cells [W/m²] (4.36)."""
    ambient: float = 22.0
    """Temperature of the room, the hand and all balls but one at the start [°C]."""
    hot: float = 45.0
    """Temperature of the target ball [°C]."""
    margin: float = 0.12
    """The latch fires at a progress of 1 − margin (42.2 °C)."""
    cells: tuple[int, int, int] = (4, 4, 4)
    """Cells of the grid on each finger link; not published."""
    density: float = 2700.0
    """Density of the fingers [kg/m³]; not published (aluminium)."""
    specific_heat: float = 900.0
    """[J/(kg·K)]; not published (aluminium)."""
    ball: str | ThermalMaterial = "aluminium"
    """Material of the balls; not published."""
    conduction: Literal["physical", "thesis"] = "thesis"
    """Contact law: the published heuristic (4.38, 4.39), or with the resistance of ball and cells."""
    convection: float = 10.0
    """[W/(m²·K)]; not published."""
    contact_radius: float = 0.005
    """Radius of the finger where it is touched, which with the overlap gives the area of a contact [m]; not
    published."""

    def __post_init__(self) -> None:
        if not self.hot > self.ambient:
            raise UsageError(f"The target is hotter than the room; received {self.hot} and {self.ambient} °C.")
        check_number("The latch's margin", self.margin, above=0, below=1)
        check_fields(self, "ambient", "hot", least=ABSOLUTE_ZERO)
        check_fields(self, "heat", "convection", least=0)
        check_fields(self, "contact_radius", above=0)
        check_fields(self, "cells", items=3, least=1, whole=True)
        check_name("conduction", self.conduction, ("physical", "thesis"))
        # What is wrong in the materials is told by them.
        _ = self.material, material(self.ball)

    @property
    def material(self) -> ThermalMaterial:
        """Material of the fingers."""
        return ThermalMaterial(self.conductivity, self.density, self.specific_heat, self.emissivity)

    @property
    def threshold(self) -> float:
        """Temperature at which the latch fires [°C]."""
        return self.ambient + (1 - self.margin) * (self.hot - self.ambient)


def progress(temperature: torch.Tensor, thermal: ThermalSettings) -> torch.Tensor:
    """Return the normalised progress of readings (°C), 0 at ambient to 1 at the target's temperature (4.41)."""
    return ((temperature - thermal.ambient) / (thermal.hot - thermal.ambient)).clamp(0.0, 1.0)


class Thermometers:
    """Temperature grids on every finger link, which ball is hot, the latch, and the time of latched contact.

    ``env.episode.target`` says which ball is hot; with ``chooses`` it is drawn anew at every reset.
    """

    def __init__(self, env: TaskScene, thermal: ThermalSettings, *, chooses: bool = True) -> None:
        import torch

        from robotics_bridge.sensors import SensorSuite

        wp, scene = warp(), env.simulation.engine.scene
        self._env, self.thermal, self._chooses = env, thermal, chooses
        links = [link for link in env.hand.links("fingers") if scene.geometries_of(link)]
        balls = env.model.objects
        bodies = {name: ThermalBody(thermal.ball, thermal.ambient) for name in balls}
        sensors = {}
        for link in links:
            plain = TemperatureGrid(link=link, cells=thermal.cells)
            low, high = plain.corners(scene)
            # Published: the source divided by the thickness of a cell gives power per volume (4.36).
            source = thermal.heat / float((high - low)[2] / thermal.cells[2])
            sensors[link] = TemperatureGrid(
                link=link, cells=thermal.cells, material=thermal.material, base_temperature=thermal.ambient,
                ambient_temperature=thermal.ambient, source=source, bodies=bodies,
                other=ThermalBody("plastic", thermal.ambient),
                conduction=thermal.conduction, convection=thermal.convection,
                contact_radius=thermal.contact_radius,
            )  # fmt: skip
        self.suite = SensorSuite(scene, sensors, num_envs=env.num_envs, device=env.simulation.warp_device)
        self._cells = [self.suite.read(link) for link in links]
        self._heat = link_temperature(self.suite, links[0])
        self._balls = torch.as_tensor([scene.link_index(name) for name in balls], device=env.device)
        self._numbers = torch.arange(len(balls), device=env.device)
        # 0 where a geometry is no tip and no ball, 1 for tips, 2 + k for ball k.
        roles = np.zeros(len(scene.geometries), dtype=np.int32)
        for tip in env.model.tips:
            roles[list(scene.geometries_of(tip))] = 1
        for index, name in enumerate(balls):
            roles[list(scene.geometries_of(name))] = 2 + index
        self._roles = wp.array(roles, dtype=wp.int32, device=env.simulation.warp_device)
        self._touch = wp.zeros((env.num_envs, len(balls)), dtype=wp.int32, device=env.simulation.warp_device)
        self._touched = wp.to_torch(self._touch)
        zeros = torch.zeros(env.num_envs, device=env.device)
        self.latched = zeros.bool()
        """[B] whether the latch has fired in this episode."""
        self.latch_time = zeros.clone()
        """[B] when it fired (s); infinite before."""
        self.contact = zeros.clone()
        """[B] seconds of latched contact S (4.42)."""
        self.touching = zeros.bool()
        """[B] whether a finger tip touches the hot ball now."""
        self.age = zeros.clone()
        self._apply(torch.ones_like(self.latched))

    def temperature(self) -> torch.Tensor:
        """Return the highest cell temperature [B, F] of every finger link (°C)."""
        import torch

        return torch.stack([cells.flatten(1).amax(dim=1) for cells in self._cells], dim=1)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes: cold fingers, another hot ball."""
        import torch

        if self._chooses:
            balls = len(self._balls)
            drawn = (self._env.draw(1, 0.0, 1.0)[:, 0] * balls).long().clamp(max=balls - 1)
            self._env.episode.target.copy_(torch.where(mask, drawn, self._env.episode.target))
        self._begin_anew(mask)
        self.latched &= ~mask
        self.touching &= ~mask
        self.latch_time.masked_fill_(mask, float("inf"))
        self.contact.masked_fill_(mask, 0.0)
        self.age.masked_fill_(mask, 0.0)

    def after_physics_step(self, dt: float) -> None:
        """Let heat flow for a physics step of dt (s)."""
        self.suite.update(self._env.simulation.state, dt)

    def after_control_step(self, context: StepContext) -> None:
        """Read the thermometers at the end of a control step, and tell the rewards."""
        self.update_latch(context.dt)
        tips = self._env.simulation.pose[:, self._env.contacts.tip_links, :3]
        target = self._env.target_pose[:, :3]
        context.extras["progress"] = progress(self.temperature().amax(dim=1), self.thermal)
        context.extras["holding"] = (self.latched & self.touching).float()
        context.extras["touching"] = self.touching.float()
        context.extras["latched"] = self.latched.float()
        context.extras["reach"] = (tips - target.unsqueeze(1)).norm(dim=2).amin(dim=1)

    def update_latch(self, dt: float) -> None:
        """Advance latch and metric by a control step of dt (s)."""
        import torch

        from robotics_bridge.tasks.kernels.touching import find_touched

        state, device = self._env.simulation.state, self._env.simulation.warp_device
        self._touch.zero_()
        inputs = [state.contact_count, state.contact_geom, state.contact_env, state.contact_distance]
        inputs += [self._roles, self._touch]
        warp().launch(find_touched, dim=state.contact_env.shape[0], inputs=inputs, device=device)
        self.age += dt
        self.touching.copy_(self._touched.gather(1, self._env.episode.target.unsqueeze(1))[:, 0] > 0)
        # The latch fires once, at progress 1 − m of the warmest cell, and holds for the episode; S counts from then on
        # (4.42).
        fires = (self.temperature().amax(dim=1) >= self.thermal.threshold) & ~self.latched
        self.latch_time.copy_(torch.where(fires, self.age, self.latch_time))
        self.latched |= fires
        self.contact += dt * (self.latched & self.touching)

    def metric(self) -> torch.Tensor:
        """Return the seconds of latched contact S [B] so far (4.42)."""
        return self.contact

    def observe(self, group: str) -> torch.Tensor:
        """Return ``thermal`` (all cells, as progress) or ``priv_thermal`` (progress per link, latch, touch)."""
        import torch

        t = self.thermal
        if group == "thermal":
            cells = torch.cat([readings.flatten(1) for readings in self._cells], dim=1)
            return ((cells - t.ambient) / (t.hot - t.ambient)).nan_to_num().float()
        flags = torch.stack((self.latched.float(), self.touching.float()), dim=1)
        return torch.cat((progress(self.temperature(), t).nan_to_num().float(), flags), dim=1)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves of latch and metric; the temperatures begin anew."""
        own = {"latched": self.latched, "latch_time": self.latch_time, "contact": self.contact}
        return {**own, "touching": self.touching, "age": self.age}

    def restored(self) -> None:
        """Make the target ball hot that a loaded state has, and the fingers cold: their temperatures are not kept."""
        self._begin_anew(self.latched | True)

    def _begin_anew(self, mask: torch.Tensor) -> None:
        """Make the target ball hot and the fingers cold."""
        self._apply(mask)
        self.suite.reset(mask)
        for cells in self._cells:
            # Until their next update, readings are those of the episode before.
            cells.masked_fill_(mask.view(-1, 1, 1, 1), self.thermal.ambient)

    def _apply(self, mask: torch.Tensor) -> None:
        """Make the target ball hot."""
        import torch

        hot = self._env.episode.target.unsqueeze(1) == self._numbers
        value = self.thermal.ambient + (self.thermal.hot - self.thermal.ambient) * hot
        known = self._heat[:, self._balls]
        self._heat[:, self._balls] = torch.where(mask.unsqueeze(1), value.to(known.dtype), known)
