"""Values of our sensors beside those of Genesis 1.4.5 in one scene: a turning box that is pressed on another.

    GENESIS/bin/python -m benchmarks.tactile.genesis_values --record states.npz
    python -m benchmarks.tactile.genesis_values --input states.npz --write

The first runs in an environment with ``genesis-world==1.4.5`` and keeps poses, velocities and readings of twelve steps;
the second reads the same states with our sensors. Proximity and elastomer taxels draw surface points at random in both
and cannot be compared number by number; sound is ours alone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

EDGE, RADIUS, STEPS = 0.25, 0.004, 12
SPIN = np.array([[0.1, -0.05, -0.2, 0.3, 0.2, 0.5], [0.0, 0.1, -0.1, -0.2, 0.1, -0.4]], dtype=np.float32)
LAW = {"stiffness": 500.0, "damping": 1.0, "exponent": 1.2, "shear": 2.0, "twist": 2.0}


def record(path: Path) -> None:
    """Step the boxes in Genesis and keep states and ground truth of every sensor."""
    import genesis as gs
    import torch

    gs.init(backend=gs.cpu, precision="32", logging_level="error")
    options = gs.options.RigidOptions(dt=0.01, tolerance=1e-5)
    scene = gs.Scene(sim_options=gs.options.SimOptions(dt=0.01), rigid_options=options, show_viewer=False)
    scene.add_entity(gs.morphs.Plane())
    places = ((0, 0, EDGE / 2), (0.1, 0.05, 0.37))
    boxes = [scene.add_entity(gs.morphs.Box(size=(EDGE,) * 3, pos=place)) for place in places]
    x = np.linspace(-0.5, 0.5, 10) * 0.2
    flat = np.stack(np.meshgrid(x, x, indexing="xy"), -1)
    points = np.concatenate([flat, np.full((10, 10, 1), EDGE / 2)], -1)
    where = {"entity_idx": boxes[0].idx, "link_idx_local": 0}
    common = where | {"probe_local_pos": points.tolist(), "probe_radius": RADIUS}
    law = dict(zip(("normal_stiffness", "normal_damping", "normal_exponent", "shear_scalar", "twist_scalar"),
                   LAW.values(), strict=True))  # fmt: skip
    listed = where | {"probe_local_pos": points.reshape(-1, 3).tolist(), "probe_radius": 0.5}
    added = {
        "distance": gs.sensors.SurfaceDistanceProbe(**listed, track_link_idx=(boxes[1].links[0].idx,)),
        "contact": gs.sensors.ContactProbe(**common),
        "depth": gs.sensors.ContactDepthProbe(**common),
        "kinematic": gs.sensors.KinematicTaxel(**common, **law),
    }
    sensors = {name: scene.add_sensor(made) for name, made in added.items()}
    scene.build(n_envs=2)
    boxes[1].set_dofs_velocity(SPIN)
    kept: dict[str, list] = {}

    def state(box: object, *names: str) -> np.ndarray:
        return np.concatenate([getattr(box, f"get_links_{name}")().cpu().numpy()[:, 0] for name in names], -1)

    for _ in range(STEPS):
        scene.step()
        kept.setdefault("pose", []).append(np.stack([state(box, "pos", "quat") for box in boxes], 1))
        kept.setdefault("velocity", []).append(np.stack([state(box, "vel", "ang") for box in boxes], 1))
        for name, sensor in sensors.items():
            found = sensor.read_ground_truth()
            parts = found if isinstance(found, tuple) else (found,)
            value = np.concatenate([torch.as_tensor(part).cpu().numpy().reshape(2, 100, -1) for part in parts], -1)
            kept.setdefault(f"reading.{name}", []).append(value)
    np.savez_compressed(path, allow_pickle=False, **{name: np.stack(values) for name, values in kept.items()})


def compare(path: Path) -> list[list[str]]:
    """Read the kept states with our sensors; rows of the table."""
    from scipy.spatial.transform import Rotation

    from robotics_bridge.physics import Geometry, HandState, TouchScene
    from robotics_bridge.sensors import (
        ContactDepthProbe,
        ContactProbe,
        KinematicTaxel,
        Probes,
        SensorSuite,
        SurfaceDistanceProbe,
    )

    with np.load(path, allow_pickle=False) as file:
        kept = {name: file[name] for name in file.files}
    half = (EDGE / 2,) * 3
    scene = TouchScene(("low", "top"), tuple(Geometry(name=n, link=n, kind="box", size=half) for n in ("low", "top")))
    grid = Probes.grid(10, 10, size=(0.2, 0.2), center=(0, 0, EDGE / 2), radius=RADIUS)
    common = {"link": "low", "probes": grid, "track": ("top",)}
    sensors = {
        "distance": SurfaceDistanceProbe(**common),
        "contact": ContactProbe(**common, threshold=1e-4),
        "depth": ContactDepthProbe(**common),
        "kinematic": KinematicTaxel(**common, convention="thesis", **LAW),
    }
    suite, state = SensorSuite(scene, sensors, num_envs=2), HandState.empty(2, 2, 8)
    state.set_contacts([0, 1], [(0, 1)] * 2)
    ours: dict[str, list[np.ndarray]] = {name: [] for name in sensors}
    for pose, velocity in zip(kept["pose"], kept["velocity"], strict=True):
        state.set_pose(pose)
        state.set_velocity(velocity)
        suite.update(state)
        for name, rows in ours.items():
            rows.append(suite.read(name).numpy().reshape(2, 100, -1).copy())
    read = {name: np.stack(rows) for name, rows in ours.items()}
    # Beside the face of the touched box, sensing spheres still reach its rim: Genesis gives up there by and by.
    places = np.array(grid.position).reshape(-1, 3)
    at = [Rotation.from_quat(np.roll(pose[..., 3:], -1, axis=-1).reshape(-1, 4)) for pose in
          (kept["pose"][:, :, 0], kept["pose"][:, :, 1])]  # fmt: skip
    flat = kept["pose"].reshape(-1, 2, 7)
    local = np.stack([
        top.inv().apply(low.apply(places) + pose[0, :3] - pose[1, :3]) for low, top, pose in zip(*at, flat, strict=True)
    ])  # fmt: skip
    over = (np.abs(local[..., :2]) <= EDGE / 2).all(axis=-1).reshape(STEPS, 2, 100)
    rim = (read["depth"][..., 0] > 0) & ~over
    cells = []
    for name, unit in (("distance", "m"), ("contact", "1"), ("depth", "m"), ("kinematic", "N, N m")):
        here, there = read[name], kept[f"reading.{name}"]
        if name == "distance":
            here, there = np.abs(here), np.abs(there)
        else:
            here, there = here[~rim], there[~rim]
        worst, size = float(np.abs(here - there).max()), float(np.abs(there).max())
        left = "–" if name == "distance" else str(int(rim.sum()))
        cells.append([name, unit, f"{here.size:,}", f"{size:.4g}", f"{worst:.1e}", f"{worst / size:.1e}", left])
    return cells


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--record", type=Path, help="run Genesis and keep its states and readings")
    parser.add_argument("--input", type=Path, help="what --record kept")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.record:
        record(options.record)
        return
    if not options.input:
        parser.error("give --record FILE, which needs Genesis, or --input FILE")
    from benchmarks.report import publish, table

    columns = ["sensor", "unit", "numbers", "largest", "largest difference", "of the largest", "taxels at the rim"]
    body = (
        "A turning box pressed on another, two environments, twelve steps, 100 taxels, the published convention and "
        "law. Genesis gives distances without a sign inside a body, so sizes are compared; taxels beside the touched "
        "face, whose spheres reach its rim alone, read less or nothing there: they are counted and left out. Proximity "
        "and elastomer taxels draw their points at random in both.\n\n"
    )
    body += table(columns, compare(options.input))
    publish(options, "Touch: values beside Genesis 1.4.5", body, "--input states.npz")


if __name__ == "__main__":
    main()
