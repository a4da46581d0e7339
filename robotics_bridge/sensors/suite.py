"""SensorSuite: all sensors of a hand behind one interface. Letters: B environment, N probe, T reading of the past."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from brainbench.core.devices import pick_device, record_launches, warp
from brainbench.core.errors import UsageError, check_kind, check_name, check_number, listing
from brainbench.core.plugins import load_object
from brainbench.core.rotations import to_matrices
from robotics_bridge.physics.scene import TouchScene
from robotics_bridge.physics.state import MOST_ENVS, EnvIds, HandState, select_envs
from robotics_bridge.sensors.kernels.pairs import clear_readings, count_update, reset_clock
from robotics_bridge.sensors.probes.placement import Probes, enclosing_sphere
from robotics_bridge.sensors.probes.sensors import ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.queries.pairs import DIVERGED, OVERFULL, PairTable
from robotics_bridge.sensors.queries.solids import Solids
from robotics_bridge.sensors.runtime import History, Runtime, SuiteContext
from robotics_bridge.sensors.sensor import ProbeSensor, Sensor, SensorFidelity
from robotics_bridge.sensors.temperature.grid import TemperatureGrid

FARTHEST = 20.0  # distance of a sensor's link from the origin of the world (m) from which on depths are off by some µm
LARGEST = 3.0
"""Radius (m) around the probes of one sensor, or around a touched mesh, above which numbers look like millimetres."""
WIDEST = 0.3  # sensing radius (m) of a taxel above which it does, if it also exceeds the patch of its sensor
DEEPEST = 0.05  # depth (m) at which a contact begins above which it does
_LACKS = (
    "%.3g N of %.3g N on link %r are felt by no taxel: where the engine touches it, none of its taxels faces the "
    "contact within its sensing radius. suite.missing has the force of every link.",
    "%.3g N·m of the moment of %.3g N on link %r are shown by no taxel: it acts beyond those in touch, which push "
    "and cannot pull, and seems off by more than a sensing radius. suite.missing_moment has that of every link.",
)
_CONVEX = ("sphere", "capsule", "ellipsoid", "cylinder", "box")


def warn_of(scene: TouchScene, sensors: Mapping[str, Sensor]) -> None:
    """Warn once of lengths that look like millimetres, and of each sensor whose probes mostly lie inside its link."""
    probing = {name: sensor for name, sensor in sensors.items() if isinstance(sensor, ProbeSensor)}
    sizes = [(f"the probes of {name!r}", enclosing_sphere(sensor.probes)[1]) for name, sensor in probing.items()]
    tracked = {g for sensor in probing.values() for g in sensor.tracked(scene)}
    sizes += [(f"the mesh {mesh.name!r}", mesh.diagonal / 2) for g in tracked if (mesh := scene.geometries[g].mesh)]
    for name, sensor in sensors.items():
        if isinstance(sensor, TemperatureGrid) and sensor.low is not None and sensor.high is not None:
            sizes.append((f"the grid of {name!r}", float(np.linalg.norm(np.subtract(sensor.high, sensor.low))) / 2))
    doubts = [(what, f"{2 * size:g} m across") for what, size in sizes if size > LARGEST]
    for name, sensor in probing.items():
        widest = float(sensor.probes.radius.max(initial=0.0))
        patch = float(np.ptp(np.reshape(sensor.probes.position, (-1, 3)), axis=0).max())
        if widest > max(WIDEST, patch) and not isinstance(sensor, SurfaceDistanceProbe):
            doubts.append((f"the sensing radius of {name!r}", f"{widest:g} m"))
        if isinstance(sensor, ContactProbe) and sensor.threshold > DEEPEST:
            doubts.append((f"the threshold of {name!r}", f"{sensor.threshold:g} m"))
        if (gap := _gap(scene, sensor.link, sensor.probes)) > LARGEST:
            doubts.append((f"the probes of {name!r}", f"{gap:g} m from their own link"))
    if doubts:
        what, size = doubts[0]
        _warn(f"{what[:1].upper()}{what[1:]}: {size}. Lengths are in metres; scale millimetres by 1e-3.")
    for name, sensor in probing.items():
        buried = int(_buried(scene, sensor.link, sensor.probes).sum())
        # Some may lie where parts of a link overlap; distances are read from anywhere.
        if 2 * buried > int(sensor.probes.active.sum()) and not isinstance(sensor, SurfaceDistanceProbe):
            _warn(
                f"{buried} of {len(sensor.probes)} probes of {name!r} lie deeper inside their own link {sensor.link!r} "
                "than their sensing radius, so that nothing can touch them; place them on its surface."
            )


def _gap(scene: TouchScene, link: str, probes: Probes) -> float:
    """Return how far (m) at least the middle of probes lies from the nearest solid of their link; 0 without any."""
    gaps = []
    for geometry in (scene.geometries[g] for g in scene.geometries_of(link)):
        local = (enclosing_sphere(probes)[0] - geometry.position) @ to_matrices(geometry.quaternion)
        away = float(np.linalg.norm(local))
        gaps.append(away - float(geometry.reach(local / max(away, 1e-9))))
    return min(gaps, default=0.0)


def _warn(text: str) -> None:
    warnings.warn(text, RuntimeWarning, stacklevel=4)


def _buried(scene: TouchScene, link: str, probes: Probes) -> np.ndarray:
    """Return a mask [N] of active probes whose sensing sphere lies within one convex solid of their link."""
    inside = np.zeros(len(probes), bool)
    for geometry in (scene.geometries[g] for g in scene.geometries_of(link)):
        if geometry.kind in _CONVEX:
            local = (np.asarray(probes.position) - geometry.position) @ to_matrices(geometry.quaternion)
            # Depth in a convex solid is the least of h(d) − x · d over directions d, h its support function. Finitely
            # many directions overestimate it, by less than a fiftieth of its size.
            reach = geometry.reach(_DIRECTIONS)
            depth = (reach - local @ _DIRECTIONS.T).min(axis=1)
            inside |= probes.active & (depth > probes.radius + 0.02 * reach.max())
    return inside


def _spread(count: int) -> np.ndarray:
    """Return unit vectors [count + 6, 3], evenly spread and along the axes."""
    z = 1 - (2 * np.arange(count) + 1) / count
    turn, flat = np.pi * (1 + np.sqrt(5)) * np.arange(count), np.sqrt(1 - z**2)
    return np.concatenate([np.c_[flat * np.cos(turn), flat * np.sin(turn), z], np.eye(3), -np.eye(3)])


_DIRECTIONS = _spread(200)

wp = warp()
_log = logging.getLogger(__name__)


class SensorSuite:
    """Tactile sensors on the links of a scene.

    Sensors of one class share one launch, whatever their number. Only what they ask for is built: distance fields
    of the meshes they track, triangle trees, and kernels for the kinds of geometries they meet. On CUDA an update is
    recorded once and replayed; inside a recording of the caller's it becomes part of that one.

    Readings of environments that the state reports as diverged are NaN; the others do not notice.

    Args:
        scene: what there is to touch (``engine.scene``, or made by hand).
        sensors: configurations by name.
        num_envs: B.
        device: ``cpu`` or ``cuda``.
        seed: of the noise, together with each sensor's name.
        env_offset: number of environment 0 in the whole experiment, so that shards draw different noise.
        resolution: cells of distance fields along a mesh's longest edge; 64 by default.
        fidelity: query, resolution and surface points for all sensors, in place of their own.
        listed: geometries in contact with one link that are looked at; all by default, 16 where lists of all would take
            more than 256 MiB. A warning says once how many there were if some were lost (on a GPU when :attr:`crowded`
            is read).

    Example::

        suite = SensorSuite(engine.scene, {"tip": ContactProbe(link="tip", probes=probes)}, num_envs=engine.num_envs)
        engine.step()
        suite.update(engine.state)
        suite.read("tip")                    # torch [B, N]
    """

    def __init__(
        self,
        scene: TouchScene,
        sensors: Mapping[str, Sensor],
        *,
        num_envs: int,
        device: Any = "cpu",
        seed: int = 0,
        env_offset: int = 0,
        resolution: int | None = None,
        fidelity: SensorFidelity | None = None,
        listed: int | None = None,
    ) -> None:
        if fidelity is not None:
            sensors = fidelity.apply(sensors)
        if resolution is None:
            resolution = int(fidelity.resolution) if fidelity is not None else 64
        check_number("resolution", resolution, least=4, most=512, whole=True)
        check_number("seed", seed, whole=True)
        check_number("env_offset", env_offset, least=0, whole=True)
        if listed is not None:
            check_number("listed", listed, least=1, whole=True)
        check_number("environments of a suite", num_envs, least=1, most=MOST_ENVS, whole=True)
        check_kind("sensors of a suite", sensors, Mapping, "a dictionary of name to sensor")
        self.scene, self.sensors = scene, dict[str, Sensor]()
        self.num_envs, self.device = num_envs, pick_device(device)
        groups: dict[Any, dict[str, Sensor]] = {}
        for name, sensor in sensors.items():
            check_kind(f"sensor {name!r}", sensor, Sensor, "ContactProbe(...) or another one")
            scene.link_index(sensor.link)
            self.sensors[name] = sensor = sensor.for_scene(scene)
            groups.setdefault((type(sensor), sensor.group()), {})[name] = sensor
        warn_of(scene, self.sensors)
        queries = frozenset().union(*(sensor.queries(scene) for sensor in self.sensors.values()))
        with wp.ScopedDevice(self.device):
            self.solids = Solids(scene, num_envs, self.device, queries, resolution=resolution)
            shared = (num_envs, self.device, seed, env_offset, scene, self.solids, [*self.sensors.values()])
            self.context = context = SuiteContext(*shared)
            context.pairs = self.pairs = PairTable(context, self.solids, listed)
            self.runtimes: list[Runtime] = [
                load_object(next(iter(members.values())).runtime, "runtime")(members, context)
                for members in groups.values()
            ]
            self._owner = {name: runtime for runtime in self.runtimes for name in runtime.slices}
            self.pairs.freeze()
            self._updates = 0
            self._counter = context.zeros(1, int)
            self._histories = {
                name: History(self._owner[name].slices[name], max(sensor.channels, 1), sensor.history, context)
                for name, sensor in self.sensors.items()
                if sensor.history
            }
        # What reset() clears: every reading that can be asked for, and the windows of histories.
        readable = [planes for runtime in self.runtimes for planes in runtime.readable]
        readable += [history.ring.reshape((-1, *history.ring.shape[2:])) for history in self._histories.values()]
        self._readable = [planes for planes in readable if planes.size]
        self._resets = context.array(np.zeros(num_envs, bool), wp.bool)
        # The view is made once: a control step that resets must not copy from the host, or no graph can record it.
        self._resets_view = wp.to_torch(self._resets)
        # An update as a CUDA graph, for one state and time step (s).
        self._recorded: tuple[Callable[[], None], HandState, float] | None = None
        self._pose: Any = None  # poses of the last update; None before the first
        self._warned, self._lacked = False, np.zeros(2, bool)
        self._by_depth = [name for name, sensor in self.sensors.items() if sensor.ignores_load]

    def update(self, state: HandState, dt: float = 0.01) -> None:
        """Read the state of ``num_envs`` environments with every sensor, ``dt`` seconds after the last update."""
        if state.pose is not self._pose:
            self._check(state)
        check_number("dt (time since the last update, s)", dt, above=0)
        if not self.device.is_cuda:
            self._launch(state, dt)
            self._warn_crowded()
            self._tell_of_depth(state)
        elif self.device.is_capturing:
            if self._histories or not all(runtime.recordable for runtime in self.runtimes):
                raise UsageError("Sensors with a history or with meshes that move cannot be part of another recording.")
            self._launch(state, dt)
        elif self._recorded and self._recorded[1] is state and self._recorded[2] == dt:
            self._recorded[0]()
        elif self._recorded is None and self._pose is state.pose and all(r.recordable for r in self.runtimes):
            replay = record_launches(lambda: self._launch(state, dt), self.device)
            self._recorded = (replay, state, dt)
            replay()
        else:
            # The first update of a state compiles and allocates; the next ones replay what it does.
            with wp.ScopedDevice(self.device):
                self._launch(state, dt)
            self._recorded = None
            self._tell_of_depth(state)
        self._pose = state.pose
        self._updates += 1
        if not self.device.is_cuda:
            self._tell_of_missing()

    def read(self, name: str) -> torch.Tensor:
        """Return the measured reading of a sensor, [B, N] or [B, rows, columns], and channels last; a view.

        It is that of the last update; zero before the first one, and after a reset until the next.
        """
        return self._view(name, self.runtime_of(name).measured())

    def read_ground_truth(self, name: str) -> torch.Tensor:
        """Return the reading without noise, in the shape of :meth:`read`; a view."""
        return self._view(name, self.runtime_of(name).io.truth)

    def read_history(self, name: str) -> torch.Tensor:
        """Return the last measured readings [B, T, N(, C)], oldest first; zeros before the reset. A view."""
        self.runtime_of(name)
        if name not in self._histories:
            raise UsageError(f"The sensor {name!r} keeps no history; configure it with history=<readings>.")
        history = self._histories[name]
        first = self._updates % history.length
        # Every reading stands twice in the ring, so the window is a slice of it and no copy.
        window = wp.to_torch(history.ring)[first : first + history.length]
        tensor = window.permute(2, 0, 3, 1).unflatten(2, history.part.layout)
        return tensor.squeeze(-1) if history.part.scalar else tensor

    def reset(self, env_ids: EnvIds | None = None) -> None:
        """Start a new episode in some environments (all by default): memories are cleared, new errors drawn."""
        c, mask = self.context, self._resets
        self._resets_view.copy_(select_envs(env_ids, self.num_envs, wp.device_to_torch(self.device)))
        c.launch(reset_clock, self.num_envs, mask, c.age, c.episode, self.pairs.status)
        for planes in self._readable:
            c.launch(clear_readings, planes.shape[1:], mask, planes)

    def seed(self, seed: int) -> None:
        """Begin the random numbers of noise and sound anew, from the next reset of each environment on."""
        check_number("seed", seed, whole=True)
        self.context.seed = seed
        self.context.episode.zero_()
        for runtime in self.runtimes:
            runtime.seed()

    def memory(self, dt: float) -> dict[str, torch.Tensor]:
        """Return the tensors themselves that updates ``dt`` seconds (s) apart depend on, by name; without histories."""
        for runtime in self.runtimes:
            runtime.make_room(dt)
        arrays = [self.context.age, self.context.episode, self.pairs.status]
        arrays += [array for runtime in self.runtimes for array in runtime.memory()]
        return {str(number): wp.to_torch(array) for number, array in enumerate(arrays)}

    @property
    def diverged(self) -> torch.Tensor:
        """Mask [B] of environments that held numbers that are not finite since their reset; their readings are NaN."""
        return self._flagged(DIVERGED)

    @property
    def missing(self) -> torch.Tensor:
        """Force [B, L] (N) of the engine's contacts on each link of the scene at the last update, less what its taxels
        of ``total="engine"`` feel of it; 0 on links without such taxels.

        It counts contacts with what they track. NaN where nobody knows: in environments that diverged, and in all where
        the engine had no room for every contact.
        """
        return self._lack(1)

    @property
    def missing_moment(self) -> torch.Tensor:
        """Most moment [B, L] (N·m) that the taxels of a link may lack, like :attr:`missing`: contacts push beyond what
        the taxels in touch span. Over the load it is how far off the centre of pressure lies."""
        return self._lack(2)

    def _lack(self, plane: int) -> torch.Tensor:
        lost = self._flagged(DIVERGED | OVERFULL)[:, None]
        if self.pairs.loads is None:
            return torch.zeros(self.num_envs, len(self.scene.links), device=wp.device_to_torch(self.device))
        loads = wp.to_torch(self.pairs.loads)
        # What an engine that is about to diverge reports is too large to be compared.
        return loads[plane].masked_fill(lost | ~loads[0].isfinite(), torch.nan)

    @property
    def unfelt(self) -> torch.Tensor:
        """Mask [B] of environments in which more than a hundredth of the load of a link was :attr:`missing`."""
        return ~(self.missing <= 0.01 * self._lack(0)).all(dim=1)

    @property
    def unbalanced(self) -> torch.Tensor:
        """Mask [B] of environments in which the load of a link may lie farther from where its taxels show it than the
        sensing radius of the widest: :attr:`missing_moment` over the load."""
        load = self._lack(0)
        return ~(self.missing_moment <= load.new_tensor(self.pairs.widths) * load).all(dim=1)

    def _flagged(self, bit: int) -> torch.Tensor:
        if self._pose is None:
            raise UsageError("Nothing was read yet; call update(state) first.")
        return (wp.to_torch(self.pairs.status) & bit) != 0

    @property
    def crowded(self) -> torch.Tensor:
        """Mask [B] of environments that ever had more geometries in contact with one sensor link than are looked at, or
        at the last update more contacts than the state has room for."""
        self._warn_crowded()
        return (wp.to_torch(self.pairs.crowded) != 0) | ((wp.to_torch(self.pairs.status) & OVERFULL) != 0)

    def _warn_crowded(self) -> None:
        if not self._warned and (most := int(self.pairs.crowded.numpy().max())):
            self._warned = True
            warnings.warn(
                f"{most} geometries touched one sensor link at once, more than are listed; some were not felt. Make "
                f"the suite with listed={most}.",
                RuntimeWarning,
                stacklevel=3,
            )

    def _tell_of_missing(self) -> None:
        """Say once where taxels that add up to the engine's forces lack some of them, or of their moment, and why."""
        for number in np.flatnonzero(self.pairs.told.numpy() > self._lacked):
            self._lacked[number] = True
            lack, load = self._lack(1 + int(number)).nan_to_num(0.0), wp.to_torch(self.pairs.loads)[0]
            env, link = divmod(int((lack / load.clamp_min(1e-30)).argmax()), lack.shape[1])
            size, whole = float(lack[env, link]), float(load[env, link])
            if size > 0:
                _log.warning(_LACKS[number], size, whole, self.scene.links[link])

    def _tell_of_depth(self, state: HandState) -> None:
        """Say once which taxels read the depth of a contact although the engine knows its force."""
        if not (self._by_depth and (count := int(state.contact_count.numpy()[0]))):
            return
        forces = wp.to_torch(state.contact_force)[:count]
        if bool(forces.isnan().all()):
            # An engine that knows no forces has nothing better to offer.
            self._by_depth = []
        elif bool((forces > 0).any()):
            _log.warning(
                "%s read forces by a law of depths, which do not follow the load: engines let a heavy and a light body "
                "sink in by nearly the same depth. Use total='engine' for forces that add up to the engine's.",
                listing(self._by_depth),
            )
            self._by_depth = []

    @property
    def state_bytes(self) -> int:
        """Memory per environment of what sensors read and remember [bytes]."""
        arrays = (array for runtime in self.runtimes for array in runtime.memory())
        return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays) // self.num_envs

    def _launch(self, state: HandState, dt: float) -> None:
        self.pairs.update(state)
        for runtime in self.runtimes:
            runtime.update(state, dt)
        for name, history in self._histories.items():
            history.launch(self._owner[name].measured(), self._counter)
        if self._histories:
            self.context.launch(count_update, 1, self._counter)

    def _check(self, state: HandState) -> None:
        wanted = (self.num_envs, len(self.scene.links))
        if (state.num_envs, state.num_links) != wanted:
            raise UsageError(
                f"The suite serves {wanted[0]} environments with {wanted[1]} links; the state has "
                f"{state.num_envs} with {state.num_links}."
            )
        if str(state.device) != str(self.device):
            raise UsageError(f"The state lies on {state.device}, the suite on {self.device}; build both on one device.")
        links = [self.scene.link_index(sensor.link) for sensor in self.sensors.values()]
        if self._pose is None and links and not self.device.is_capturing:
            far = float(state.pose_torch[:, links, :3].abs().nan_to_num(0.0, 0.0, 0.0).max())
            if far > FARTHEST:
                warnings.warn(
                    f"Links with sensors lie up to {far:.3g} m from the origin of the world, where single precision "
                    f"tells depths to some {0.06 * far:.2g} µm only: keep hand and objects within ten metres of it.",
                    RuntimeWarning,
                    stacklevel=3,
                )

    def runtime_of(self, name: str, kind: type[Sensor] = Sensor, what: str = "sensor") -> Runtime:
        """Return the runtime of a sensor of a kind, which messages call ``what``."""
        choices = tuple(key for key, sensor in self.sensors.items() if isinstance(sensor, kind))
        check_name(what, name, choices)
        return self._owner[name]

    def _view(self, name: str, planes: Any) -> torch.Tensor:
        part = self._owner[name].slices[name]
        tensor = wp.to_torch(planes)[:, :, part.span].permute(1, 2, 0).unflatten(1, part.layout)
        return tensor.squeeze(-1) if part.scalar else tensor
