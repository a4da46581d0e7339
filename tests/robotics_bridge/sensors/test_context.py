"""Launches and memory of a suite."""

from __future__ import annotations

from dataclasses import replace

import pytest

from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import (
    ContactDepthProbe,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
)
from robotics_bridge.sensors.kernels import dilation, kinematic, proximity
from robotics_bridge.sensors.kernels import probe as _probe_kernels
from tests.factories.touch_scenes import BALL, GRID, pad_scene, poses_at, state_of, suite_of


def test_sensors_of_one_class_share_a_launch_and_nothing_else_is_compiled() -> None:
    for factory in (kinematic.kinematic_kernel, proximity.proximity_kernel, dilation.marker_kernel):
        factory.cache_clear()
    _probe_kernels.probe_kernel.cache_clear()
    mesh = Mesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    aside = Geometry(name="aside", link="aside", kind="mesh", mesh=mesh)
    scene = pad_scene(BALL, aside)
    sensors = {f"tip{i}": ContactProbe(link="hand", probes=GRID, track=("object",)) for i in range(5)}
    suite = suite_of(sensors, scene=scene)
    suite.update(state_of(scene, poses_at(4, {2: (0, 0, 0.0145), 3: (1, 0, 0)})))
    assert len(suite.runtimes) == 1
    assert _fields_and_trees(suite) == (0, 0)
    assert _probe_kernels.probe_kernel.cache_info().currsize == 1
    assert kinematic.kinematic_kernel.cache_info().currsize == 0
    assert proximity.proximity_kernel.cache_info().currsize == 0
    assert dilation.marker_kernel.cache_info().currsize == 0


def _fields_and_trees(suite: SensorSuite) -> tuple[int, int]:
    solids = suite.solids.struct.solid.numpy().ravel()
    return len({*solids["first"][solids["counts"][:, 0] > 2]}), len({*solids["mesh"]} - {0})


NOISY = {
    "distance": (SurfaceDistanceProbe, "depth", {}),
    "contact": (ContactProbe, "bool", {}),
    "depth": (ContactDepthProbe, "depth", {}),
    "kinematic": (KinematicTaxel, "force", {}),
    "proximity": (ProximityTaxel, "proximity", {"points": 500}),
    "elastomer": (ElastomerTaxel, "elastomer", {"points": 500}),
}


@pytest.mark.parametrize("name", list(NOISY))
def test_a_noisy_taxel_keeps_at_most_130_bytes(name: str) -> None:
    kind, preset, options = NOISY[name]
    noise = Noise.preset(f"published-{preset}")
    noise = replace(noise, **{knob: 0.0 for knob in ("hysteresis", "radius") if knob not in kind.knobs})
    noise = noise if "gain" in kind.knobs else replace(noise, gain=(1.0, 1.0), dead_probability=0.0)
    sensor = kind(
        link="hand",
        probes=Probes.grid(10, 10, size=(0.02, 0.02), center=(0, 0, 5e-3), radius=0.003),
        noise=noise,
        **options,
    )
    assert suite_of({"taxel": sensor}).state_bytes / 100 <= 130
