# ruff: noqa: ANN, B, C, D, E, F, I, N, PLR, SIM, UP - a trial, removed by the next commit
"""Time per distance of a link from a mesh: the own tree against Warp's mesh queries, on the queries of real sweeps.

python meshes.py DEVICE OBJECTS SWEEPS SLICES  (snapshots at these slices, by commas)
"""

import sys
import time

import numpy as np
import warp as wp

from benchmarks.whiskers.public_rate import load_objects
from brainbench.stimuli import Fidelity
from brainbench.stimuli.engines.rod import launch as LA
from brainbench.stimuli.engines.rod import slices as S
from brainbench.stimuli.engines.rod import sweeps as SW
from brainbench.stimuli.engines.rod.kernels import specialize
from brainbench.stimuli.engines.rod.limits import ANYWHERE, DISTANCE_GROUP, FAR, PARTS
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

device, objects, every, moments = sys.argv[1], sys.argv[2], int(sys.argv[3]), [int(w) for w in sys.argv[4].split(",")]
cuda = device != "cpu"


def warp_kernel(common, structs, cuda, loose):
    narrow = specialize("narrow_phase", group_size=DISTANCE_GROUP if cuda else 1, **common)
    from importlib import import_module

    package = narrow.__name__.rsplit(".", 1)[0]
    distances, motion, algebra, state = (
        import_module(f"{package}.{n}") for n in ("distances", "motion", "algebra", "state")
    )
    real, vec3 = wp.float32, algebra.vec3
    Cone, LinkDistance, BodyMotion, Nearest = state.Cone, state.LinkDistance, motion.BodyMotion, narrow.NearestTriangles
    pose_from, unrotate, cone = motion.pose_from, algebra.unrotate, state.cone
    mesh_distance, signed_direction, pseudo_normal, surface_point = (
        narrow.mesh_distance,
        narrow.signed_direction,
        narrow.pseudo_normal,
        narrow.surface_point,
    )
    ChainArrays, MotionArrays, ShapeArrays, JobArrays, PausedWhiskers = (
        getattr(state, n, None) or getattr(motion, n)
        for n in ("ChainArrays", "MotionArrays", "ShapeArrays", "JobArrays", "PausedWhiskers")
    )

    @wp.func_native(
        distances.TRIANGLES
        + """
    wp::vec_t<4, real> out;
    segment_triangle(a.c, b.c, p.c, q.c, r.c, out.c[0], out.c[1], out.c[2], out.c[3]);
    return out;"""
    )
    def segment_triangle(a: vec3, b: vec3, p: vec3, q: vec3, r: vec3) -> algebra.vec4: ...

    @wp.func
    def near_point(mesh: wp.uint64, x: vec3, far: real) -> wp.vec4:
        got = wp.mesh_query_point_no_sign(mesh, x, far)
        if not got.result:
            return wp.vec4(real(1e30), real(-1.0), real(0.0), real(0.0))
        away = x - wp.mesh_eval_position(mesh, got.face, got.u, got.v)
        # Warp's (u, v) weigh the first two corners; ours the last two.
        return wp.vec4(wp.dot(away, away), real(got.face), got.v, real(1.0) - got.u - got.v)

    @wp.kernel(enable_backward=False, module="unique", module_options={"fast_math": cuda})
    def run(
        chains: ChainArrays,
        motions: MotionArrays,
        shapes: ShapeArrays,
        jobs: JobArrays,
        paused: PausedWhiskers,
        meshes: wp.array(dtype=wp.uint64),
        answer: wp.array(dtype=LinkDistance),
        looked: wp.array(dtype=wp.int32),
    ):
        which = wp.tid()
        if which >= wp.min(paused.query_count[0], paused.query.shape[0]):
            return
        index = paused.query[which].job
        i = paused.query[which].link
        s = shapes.first[jobs.scene[index]]
        base = BodyMotion()
        base.coarse = paused.query_frame[index].coarse
        base.place = paused.query_frame[index].place
        body = pose_from(motions, shapes.track[s], paused.query_frame[index].time, base)
        margin = paused.query_margin[index]
        taper = chains.taper[i, jobs.whisker[index]]
        world = cone(paused.query[which].start, paused.query[which].stop, taper)
        bound = paused.query[which].bound
        scale = shapes.scale[s]
        local = unrotate(body.quaternion, world.a - body.place) - shapes.place[s]
        a = unrotate(shapes.quaternion[s], local) / scale
        local = unrotate(body.quaternion, world.b - body.place) - shapes.place[s]
        b = unrotate(shapes.quaternion[s], local) / scale
        link = Cone()
        link.a = a
        link.b = b
        link.start_radius = world.start_radius / scale
        link.end_radius = world.end_radius / scale
        within = (wp.max(world.start_radius, world.end_radius) + margin) / scale
        radius = wp.max(within, real(wp.static(FAR)) / scale)
        if margin < real(0.0):
            within = real(0.0)
            radius = -margin / scale
        farthest = radius
        if bound <= real(0.0):
            farthest = real(wp.static(ANYWHERE)) / scale
        mesh = meshes[s]
        got = Nearest()
        got.side = farthest * farthest
        got.end = got.side
        got.start = got.side
        got.face = -1
        got.end_face = -1
        got.start_face = -1
        reach = real(1e9)
        loosest = real(0.0)
        if wp.static(loose):
            middle = near_point(mesh, real(0.5) * (a + b), farthest + real(0.5) * wp.length(b - a))
            loosest = wp.max(wp.sqrt(middle[0]) - real(0.5) * wp.length(b - a), real(0.0))
            if loosest <= within:
                near = near_point(mesh, b, within)
                if near[0] < got.end:
                    got.end = near[0]
                    got.end_face = int(near[1])
                    got.end_v = near[2]
                    got.end_w = near[3]
                near = near_point(mesh, a, within)
                if near[0] < got.start:
                    got.start = near[0]
                    got.start_face = int(near[1])
                    got.start_v = near[2]
                    got.start_w = near[3]
                reach = within * real(1.0001) + real(1e-6)
        else:
            near = near_point(mesh, b, farthest)
            if near[0] < got.end:
                got.end = near[0]
                got.end_face = int(near[1])
                got.end_v = near[2]
                got.end_w = near[3]
            near = near_point(mesh, a, wp.sqrt(got.end))
            if near[0] < got.start:
                got.start = near[0]
                got.start_face = int(near[1])
                got.start_v = near[2]
                got.start_w = near[3]
            # Nothing of the segment is nearer than its middle less half of it, nor further than its ends.
            most = wp.min(got.end, got.start)
            middle = near_point(mesh, real(0.5) * (a + b), wp.sqrt(most) + real(0.5) * wp.length(b - a))
            most = wp.min(most, middle[0])
            reach = wp.sqrt(most) * real(1.0001) + real(1e-6)
        lower = wp.vec3(wp.min(a[0], b[0]) - reach, wp.min(a[1], b[1]) - reach, wp.min(a[2], b[2]) - reach)
        upper = wp.vec3(wp.max(a[0], b[0]) + reach, wp.max(a[1], b[1]) + reach, wp.max(a[2], b[2]) + reach)
        if reach < real(1e5):
            query = wp.mesh_query_aabb(mesh, lower, upper)
            face = 0
            seen = 0
            while wp.mesh_query_aabb_next(query, face):
                seen = seen + 1
                p = wp.mesh_eval_position(mesh, face, real(1.0), real(0.0))
                q = wp.mesh_eval_position(mesh, face, real(0.0), real(1.0))
                r = wp.mesh_eval_position(mesh, face, real(0.0), real(0.0))
                d = segment_triangle(a, b, p, q, r)
                if d[0] < got.side:
                    got.side = d[0]
                    got.share = d[1]
                    got.face = face
                    got.v = d[2]
                    got.w = d[3]
            looked[which] = seen
        found = mesh_distance(shapes, s, link, within, got)
        found.clearance = wp.min(found.clearance, radius)
        if wp.static(loose):
            found.clearance = wp.min(loosest, radius)
        if found.crossing == 1 and margin >= real(0.0):
            deepest = real(-1e20)
            for k in range(wp.static(PARTS + 1)):
                share = real(k) / real(wp.static(PARTS))
                x = a + (b - a) * share
                near = near_point(mesh, x, real(wp.static(ANYWHERE)))
                face = shapes.face[s] + int(near[1])
                away = x - surface_point(shapes, face, near[2], near[3])
                thick = link.start_radius + (link.end_radius - link.start_radius) * share
                out = pseudo_normal(shapes, face, near[2], near[3])
                depth = thick - signed_direction(away, wp.sqrt(near[0]), out, thick)[3]
                deepest = wp.max(deepest, depth)
                if k == 0:
                    found.start = 1
                    found.start_gap = -depth
            found.depth = deepest
        found.clearance = found.clearance * scale
        found.gap = found.gap * scale
        found.end_gap = found.end_gap * scale
        found.start_gap = found.start_gap * scale
        found.depth = found.depth * scale
        answer[which] = found

    run.answer = LinkDistance
    return run


scenes = SweepScenes(GRIDS["thesis-high"], load_objects([objects]))
fidelity = Fidelity.parse("fast,links=12,time_step=1e-3,steps_per_period=none").resolved(twist=True)
launcher = SW.SweepLauncher(scenes, fidelity, device, sliced=True)
groups = [(n, scenes.grid.sweeps(n)[::every]) for n in scenes.objects]
solver = launcher.solver
kernels, structs, dev = solver.kernels, solver.kernels.structs, solver.device
common = {k: v for k, v in kernels.parameters.items() if k not in ("max_contacts", "bounds")}
real_add = LA.PackedShapes.add_placed if hasattr(LA, "PackedShapes") else None
seen_surfaces = []
add = SW.PackedShapes.add_placed


def add_placed(self, surface, **columns):
    seen_surfaces.extend([surface] * len(columns["track"]))
    return add(self, surface, **columns)


SW.PackedShapes.add_placed = add_placed
rows = []


def measure(slices, inputs, slice_number):
    scene, problems, results = inputs
    on = slices.struct
    count = min(int(on.query_count.numpy()[0]), slices.queries)
    if not count:
        return
    threads = min(slices.queries, slices.capacity * slices.lanes) * kernels.distance_group
    threads = min(-(-threads // 32) * 32, S.MOST_THREADS)

    def own():
        wp.launch(
            kernels.measure_distances,
            threads,
            [*S.parts_of(scene)[:4], on, threads],
            device=dev,
            block_dim=128 if cuda else 1,
        )

    def timed(call, rounds=10):
        call()
        wp.synchronize_device(dev)
        begun = time.perf_counter()
        for _ in range(rounds):
            call()
        wp.synchronize_device(dev)
        return (time.perf_counter() - begun) / rounds

    own_s = timed(own)
    right = on.answer.numpy()[:count]
    line = f"slice {slice_number}: {count:,} distances; own tree {1e9 * own_s / count:.1f} ns each"
    for name, run in runs.items():
        answer, looked = wp.zeros(count, dtype=run.answer, device=dev), wp.zeros(count, dtype=wp.int32, device=dev)
        ids = meshes_of(name)

        def theirs():
            wp.launch(
                run, count, [*S.parts_of(scene)[:4], on, ids, answer, looked], device=dev, block_dim=64 if cuda else 1
            )

        their_s = timed(theirs)
        other = answer.numpy()
        gap = {n: np.abs(other[n] - right[n]).max() for n in ("clearance", "depth")}
        agree = (right["between"] == other["between"]) & (right["end"] == other["end"])
        both = (right["between"] == 1) & (other["between"] == 1)
        gap["gap of 999 in 1,000"] = np.quantile(np.abs(other["gap"] - right["gap"])[both], 0.999)
        line += (
            f"; Warp {name} {1e9 * their_s / count:.1f} ns ({their_s / own_s:.2f} x), looked at {looked.numpy().mean():.0f} triangles,"
            f" same contacts {agree.mean():.5f}, largest differences "
            + ", ".join(f"{k} {v:.1e}" for k, v in gap.items())
        )
    print(line, flush=True)


made = {}


def meshes_of(name):
    if name not in made:
        constructor, leaf = name.split()[0].split("/")
        unique = {}
        for surface in seen_surfaces:
            if id(surface) not in unique:
                c = surface.corners.transpose(0, 2, 1).reshape(-1, 3, 3)[: surface.triangles].astype(np.float32)
                faces = np.arange(3 * len(c), dtype=np.int32)
                unique[id(surface)] = wp.Mesh(
                    wp.array(c.reshape(-1, 3), dtype=wp.vec3, device=dev),
                    wp.array(faces, device=dev),
                    bvh_constructor=constructor,
                    **({"bvh_leaf_size": int(leaf)} if leaf else {}),
                )
        ids = wp.array(
            np.array([unique[id(s)].id for s in seen_surfaces], dtype=np.uint64), dtype=wp.uint64, device=dev
        )
        made[name] = (ids, unique)
    return made[name][0]


runs = {}
import inspect

sized = "bvh_leaf_size" in inspect.signature(wp.Mesh.__init__).parameters
exact, loose = (warp_kernel(common, structs, cuda, k) for k in (False, True))
for name in ("sah/1", "sah/4", "lbvh/4") if sized else ("sah/",):
    runs[name] = exact
runs["sah/4 loose" if sized else "sah/ loose"] = loose

real_run = S.Slices.run


def sliced_run(self, scene, problems, results, block):
    self.recorded = False
    self.streams = [None] * len(self.streams)
    self.stream = None
    for number in range(0, max(moments) + 1, S.SLICES_PER_CHECK):
        self._several((scene, problems, results), self.lanes, block)
        if number and any(number - S.SLICES_PER_CHECK < m <= number for m in moments):
            measure(self, (scene, problems, results), number)
    raise SystemExit(0)


S.Slices.run = LA.Slices.run = sliced_run
launcher.launch(groups)
