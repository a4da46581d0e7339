"""hot_ball: rummage a tilted bin for the one hot ball of eight, known by touch alone.

Section 4.6.3 of the thesis gives the bin, the balls, temperatures, latch, metric and times; rewards, materials and how
the hand is carried are not published and ours. The hand hangs from slides along x, y and z, fingers down. Thermometers
on the fingers, the heat latch and the success metric are those of equations 4.41 and 4.42. Letters: B environment,
F finger link with a grid, K ball.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch

from brainbench.core.devices import mujoco_module, warp
from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, NotNegative, Positive, limited
from robotics_bridge.sensors import SensorSuite
from robotics_bridge.sensors.taxels.sensors import PUBLISHED_TWIST
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import ABSOLUTE_ZERO, ThermalBody, ThermalMaterial, material
from robotics_bridge.sensors.temperature.runtime import link_temperature
from robotics_bridge.tasks import terms
from robotics_bridge.tasks.objects import ball
from robotics_bridge.tasks.registry import bounded, register
from robotics_bridge.tasks.settings import StudentSettings, TeacherSettings
from robotics_bridge.tasks.task import ObservationNoise, Placement, Reward, Success, Task
from robotics_bridge.tasks.terms import StepContext, TaskScene

_Celsius = Annotated[float, Limit(least=ABSOLUTE_ZERO, unit="°C")]


@limited(of="{} of the hot ball", kw_only=True)
class ThermalSettings:
    """Materials of fingers and balls. The first four numbers are the axes of figure 4.8 and section 4.6.3."""

    conductivity: float = 150.0
    """Conductivity of the fingers [W/(m·K)]."""
    emissivity: float = 0.5
    heat: NotNegative = 500.0
    """Made inside the fingers, per area of a layer of cells [W/m²] (4.36)."""
    ambient: _Celsius = 22.0
    """Temperature of the room, the hand and all balls but one at the start [°C]."""
    hot: _Celsius = 45.0
    """Temperature of the target ball [°C]."""
    margin: Annotated[float, Limit(above=0, below=1)] = 0.12
    """The latch fires at a progress of 1 − margin (42.2 °C)."""
    cells: tuple[Count, Count, Count] = (4, 4, 4)
    """Cells of the grid on each finger link; not published."""
    density: float = 2700.0
    """Density of the fingers [kg/m³]; not published (aluminium)."""
    specific_heat: float = 900.0
    """[J/(kg·K)]; not published (aluminium)."""
    ball: str | ThermalMaterial = "aluminium"
    """Material of the balls; not published."""
    conduction: Literal["physical", "thesis"] = "thesis"
    """Contact law: the published heuristic (4.38, 4.39), or with the resistance of ball and cells."""
    convection: NotNegative = 10.0
    """[W/(m²·K)]; not published."""
    contact_radius: Positive = 0.005
    """Radius of the finger where it is touched, which with the overlap gives the area of a contact [m]; not
    published."""

    def __post_init__(self) -> None:
        if not self.hot > self.ambient:
            raise UsageError(f"The target is hotter than the room; received {self.hot} and {self.ambient} °C.")
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
        scene = env.simulation.engine.scene
        self._env, self.thermal, self._chooses = env, thermal, chooses
        links = [link for link in env.hand.links("fingers") if scene.geometries_of(link)]
        balls = env.model.objects
        bodies = {name: ThermalBody(thermal.ball, thermal.ambient) for name in balls}
        sensors = {}
        for link in links:
            low, high = TemperatureGrid(link=link, cells=thermal.cells).corners(scene)
            # Published: the source divided by the thickness of a cell gives power per volume (4.36).
            source = thermal.heat / float((high - low)[2] / thermal.cells[2])
            sensors[link] = TemperatureGrid(
                link=link, cells=thermal.cells, material=thermal.material, base_temperature=thermal.ambient,
                ambient_temperature=thermal.ambient, source=source, bodies=bodies,
                unlisted=ThermalBody("plastic", thermal.ambient),
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
        self._roles = torch.as_tensor(roles, device=env.device)
        state = env.simulation.state
        buffers = (state.contact_count, state.contact_geom, state.contact_env, state.contact_distance)
        self._contacts = tuple(map(warp().to_torch, buffers))
        self._places = torch.arange(len(self._contacts[2]), device=env.device)
        self._touched = torch.zeros(env.num_envs, len(balls), dtype=torch.long, device=env.device)
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
        return torch.stack([cells.flatten(1).amax(dim=1) for cells in self._cells], dim=1)

    def reset(self, mask: torch.Tensor) -> None:
        """Begin new episodes: cold fingers, another hot ball."""
        if self._chooses:
            balls = len(self._balls)
            drawn = (self._env.draw(1, 0.0, 1.0)[:, 0] * balls).long().clamp(max=balls - 1)
            self._env.episode.target.copy_(torch.where(mask, drawn, self._env.episode.target))
        # Another ball is hot, and the fingers are cold.
        self._apply(mask)
        self.suite.reset(mask)
        for cells in self._cells:
            # Until their next update, readings are those of the episode before.
            cells.masked_fill_(mask.view(-1, 1, 1, 1), self.thermal.ambient)
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
        count, pair, owner, distance = self._contacts
        used = (self._places < count) & ~(distance > 0) & (pair >= 0).all(dim=1)
        first, second = self._roles[torch.where(used[:, None], pair, 0)].unbind(1)
        ball = torch.where(first == 1, second, torch.where(second == 1, first, 0)) - 2
        touches = used & (ball >= 0)
        place = torch.where(touches, owner * len(self._balls) + ball, 0)
        self._touched.zero_().view(-1).index_add_(0, place, touches.long())
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
        t = self.thermal
        if group == "thermal":
            cells = torch.cat([readings.flatten(1) for readings in self._cells], dim=1)
            return ((cells - t.ambient) / (t.hot - t.ambient)).nan_to_num().float()
        flags = torch.stack((self.latched.float(), self.touching.float()), dim=1)
        return torch.cat((progress(self.temperature(), t).nan_to_num().float(), flags), dim=1)

    def memory(self) -> dict[str, torch.Tensor]:
        """Return the tensors themselves of latch, metric and temperatures."""
        tensors = {name: getattr(self, name) for name in ("latched", "latch_time", "contact", "touching", "age")}
        heat = self.suite.memory(self._env.simulation.timestep)
        return tensors | {f"heat.{name}": value for name, value in heat.items()}

    def _apply(self, mask: torch.Tensor) -> None:
        """Make the target ball hot."""
        hot = self._env.episode.target.unsqueeze(1) == self._numbers
        value = self.thermal.ambient + (self.thermal.hot - self.thermal.ambient) * hot
        present = self._heat[:, self._balls]
        self._heat[:, self._balls] = torch.where(mask.unsqueeze(1), value.to(present.dtype), present)


SIDE, WALL, HEIGHT, TILT = 0.5, 0.0125, 0.25, math.radians(10)
"""Outer edge of the bin, thickness of its walls and floor, its height [m], and how far it leans about y [rad]."""
BALLS, DIAMETER = 8, 0.08
_SPANS = {"x": (-0.22, 0.22), "y": (-0.22, 0.22), "z": (-0.2, 0.05)}
"""Distance that the hand can be carried from above the middle of the bin [m]."""
LOWER = 0.08
"""How much lower than published the hand begins on the task on which we train [m]; it can be carried as far."""
_SITES = tuple((0.13 * (i - 1), 0.13 * (j - 1), -0.13 * (i - 1) * math.sin(TILT)) for i in range(3) for j in range(3))


def bin_walls(spec: Any) -> None:
    """Add the tilted bin, its floor's middle at the origin."""
    mujoco = mujoco_module()
    body = spec.worldbody.add_body(name="bin", quat=(math.cos(TILT / 2), 0.0, math.sin(TILT / 2), 0.0))
    edge, half, top = SIDE / 2, WALL / 2, HEIGHT / 2
    walls = [((0.0, 0.0, -half), (edge, edge, half))]
    for place in (half - edge, edge - half):
        walls += [((place, 0.0, top), (half, edge, top)), ((0.0, place, top), (edge, half, top))]
    for index, (position, size) in enumerate(walls):
        body.add_geom(name=f"bin_{index}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=position, size=size)


def extra(m: StepContext, *, name: str) -> torch.Tensor:
    """Return what the thermometers add to a control step [B]: ``progress``, ``latched``, ``touching``, ``holding``."""
    return m.extras[name]


def reach(m: StepContext, *, sigma: float) -> torch.Tensor:
    """Return exp(−d/σ) of the distance d (m) from the nearest finger tip to the hot ball's centre."""
    return (-m.extras["reach"] / sigma).exp()


@register("hot_ball", "published")
def published() -> Task:
    """Return the task of section 4.6.3 at the cell of figure 4.8 that succeeds (150 W/(m·K), 0.5, 500 W/m²)."""
    return with_thermal(ThermalSettings())


def with_thermal(thermal: ThermalSettings) -> Task:
    """Return the task for fingers and balls of other materials."""
    # The palm faces uphill, so that the thumb stays within the bin.
    down = ((0.0, 0.0, 0.42), (0.0, 0.0, 1.0, 0.0))
    return Task(
        name="hot_ball",
        text="find the hot ball among eight by touch and stay in contact",
        objects=(ball(DIAMETER / 2),),
        copies=BALLS,
        placement=Placement(height=0.01, x=(-0.015, 0.015), y=(-0.015, 0.015), sites=_SITES),
        hand_poses={"xhand1": down, "sharpa": down},
        joints={"xhand1": {"right_hand_thumb_bend_joint": 1.5}},
        carriage={axis: (span, 2000.0, 120.0, 100.0) for axis, span in _SPANS.items()},
        furniture=bin_walls,
        task_state=partial(Thermometers, thermal=thermal),
        taxel_twist=PUBLISHED_TWIST,
        rewards={
            "reach": Reward(1.0, reach, {"sigma": 0.1}),
            "warmth": Reward(5.0, extra, {"name": "progress"}),
            "holding": Reward(20.0, extra, {"name": "holding"}),
            "action_rate_penalty": Reward(-0.002, terms.action_rate),
            "joint_limits_penalty": Reward(-20.0, terms.beyond_limits),
            "work_penalty": Reward(-0.0002, terms.work),
        },
        # Success is S > 0: one control step of latched contact.
        success=Success(metric="contact", threshold=0.025),
        episode=20.0,
        noise=ObservationNoise(position=0.005, velocity=0.005),
        groups={
            **dict.fromkeys(("actor", "critic", "rnd_state"), ("priv_proprio", "priv_obj_state", "priv_thermal")),
            "student": ("proprio", "thermal"),
        },
        teacher=TeacherSettings(iterations=5000),
        student=StudentSettings(iterations=2000),
    )  # fmt: skip


@register("hot_ball")
def default() -> Task:
    """Return the task on which we train; it differs from the published one in these points.

    The area of a contact follows from its overlap and a radius, which is not published: here it is that of the balls.
    With the 5 mm of the published task the latch cannot close under firm contacts, which overlap less: after 10 s on
    the hot ball fingers have 27 °C. The carriage moves at .5 m/s at most, and the hand begins 8 cm lower, because
    random actions from higher up do not meet a ball. The way is paid by the distance to the surface of the nearest
    ball, hot or not, which is 0 in a touch, and which teachers read; touching the hot ball is paid before it is warm.
    Actions begin smaller. Contacts, actions and taxels are those of
    :func:`~robotics_bridge.tasks.registry.bounded`.
    """
    task = bounded(with_thermal(ThermalSettings(contact_radius=DIAMETER / 2)))
    x, y, z = (task.carriage[axis] for axis in "xyz")
    rewards = {
        **task.rewards,
        "reach": Reward(2.0, terms.near_surface, {"nearest_k": 1, "sigma": 0.1}),
        "touch": Reward(3.0, extra, {"name": "touching"}),
    }
    settings = replace(
        task.teacher, discount=0.99, initial_std=0.6, std_range=(0.1, 1.0), rnd_weight=0.0, learning_rate=5e-4,
        learning_rate_range=(1e-4, 3e-3),
    )  # fmt: skip
    return replace(
        task, rewards=rewards, teacher=settings, distances_in="priv_obj_state",
        hand_poses={hand: ((*place[:2], place[2] - LOWER), turn) for hand, (place, turn) in task.hand_poses.items()},
        carriage={"x": x, "y": y, "z": ((z[0][0] + LOWER, z[0][1] + LOWER), *z[1:])},
    )  # fmt: skip
