"""The pyramid scene in Genesis 1.4.5 on the processor: env-steps/s without and with each sensor, read every step.

Runs in an environment of its own (``pip install genesis-world==1.4.5 torch``) and prints one JSON line per sensor:
``python -m benchmarks.tactile.genesis --envs 64 --steps 100``.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import numpy as np

EDGE, SPACING, ROWS = 0.25, 0.999, 4


def build(sensor: str, envs: int) -> tuple[Any, list[Any], Any]:
    import genesis as gs

    options = gs.options.RigidOptions(dt=0.01, tolerance=1e-5)
    scene = gs.Scene(sim_options=gs.options.SimOptions(dt=0.01), rigid_options=options, show_viewer=False)
    scene.add_entity(gs.morphs.Plane())
    boxes = []
    for column in range(ROWS):
        for level in range(ROWS - column):
            place = ((column + level / 2) * EDGE * SPACING, 0.0, EDGE / 2 + level * EDGE * SPACING)
            boxes.append(scene.add_entity(gs.morphs.Box(size=(EDGE,) * 3, pos=place)))
    x = np.linspace(-0.5, 0.5, 10) * 0.2
    grid = np.stack(np.meshgrid(x, x, indexing="xy"), -1)
    points = np.concatenate([grid, np.full((10, 10, 1), EDGE / 2)], -1)
    common = {
        "entity_idx": boxes[0].idx,
        "link_idx_local": 0,
        "probe_local_pos": points.tolist(),
        "probe_radius": 0.004,
    }
    tracked = {
        "track_link_idx": (boxes[1].links[0].idx,),
        "n_sample_points": 500,
        "probe_local_normal": (0.0, 0.0, 1.0),
    }
    s = gs.sensors
    from genesis.options.sensors.options import TemperatureProperties

    properties = {box.links[0].idx: TemperatureProperties() for box in boxes}
    made = {
        "none": lambda: None,
        "distance": lambda: s.SurfaceDistanceProbe(
            **common | {"probe_local_pos": points.reshape(-1, 3).tolist(), "probe_radius": 0.5},
            track_link_idx=(boxes[1].links[0].idx,),
        ),
        "contact": lambda: s.ContactProbe(**common),
        "depth": lambda: s.ContactDepthProbe(**common),
        "kinematic": lambda: s.KinematicTaxel(**common),
        "proximity": lambda: s.ProximityTaxel(**common, **tracked),
        "elastomer": lambda: s.ElastomerTaxel(**common, **tracked),
        "temperature": lambda: s.TemperatureGrid(
            entity_idx=boxes[0].idx, link_idx_local=0, grid_size=(2, 2, 2), properties_dict=properties
        ),
    }[sensor]()
    added = scene.add_sensor(made) if made is not None else None
    scene.build(n_envs=envs)
    return scene, boxes, added


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--warm-up", type=int, default=20)
    parser.add_argument("--sensor", default="none")
    options = parser.parse_args()
    import genesis as gs

    gs.init(backend=gs.cpu, precision="32", logging_level="error")
    scene, boxes, sensor = build(options.sensor, options.envs)
    rng = np.random.default_rng(0)
    for box in boxes:
        box.set_dofs_velocity(0.04 * rng.random((options.envs, 6)).astype(np.float32))
    for _ in range(options.warm_up):
        scene.step()
        if sensor is not None:
            sensor.read()
    start, worked = time.perf_counter(), time.process_time()
    for _ in range(options.steps):
        scene.step()
        if sensor is not None:
            sensor.read()
    elapsed, worked = time.perf_counter() - start, time.process_time() - worked
    steps = options.envs * options.steps
    found = {"sensor": options.sensor, "envs": options.envs, "env_steps_per_s": steps / elapsed}
    print(json.dumps(found | {"processor_us": worked / steps * 1e6}), flush=True)


if __name__ == "__main__":
    main()
