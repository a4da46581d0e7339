"""The least chain of kernels that gives engine totals, beside the law of depths and what ships.

``PYTHONPATH=.:benchmarks/tactile/totals_bound python benchmarks/tactile/totals_bound/bound.py time 16384 cuda 60 4c 5c 3c 5n 4n 3n 0c``
(``warm 64 cuda 60 …`` first, which compiles); a case is its number and c for clean or n for noisy.
"""

import statistics, sys, time
from dataclasses import replace
import numpy as np
import robotics_bridge.sensors.kernels.contact_load as contact_load
import robotics_bridge.sensors.taxels.runtime as taxel_runtime
from benchmarks.tactile.scene import FULL, restore
from scenes import cases as all_cases
from brainbench.core.devices import record_launches, warp
from robotics_bridge.sensors import Noise, SensorSuite
from robotics_bridge.sensors.kernels.kinematic import measure_kernel
from robotics_bridge.sensors.kernels.pairs import list_pairs
import least as L

wp = warp()
what, envs, device, limit, *cases = sys.argv[1:]
envs, limit, begin = int(envs), float(limit), time.perf_counter()
where = wp.get_device(device)
cuda = where.is_cuda
sync = lambda: wp.synchronize_device(device)


def us(f):
    if what == "warm":
        f()
        sync()
        return 0.0

    def group(n):
        sync()
        t = time.perf_counter()
        for _ in range(n):
            f()
        sync()
        return (time.perf_counter() - t) / n

    group(2)
    n = min(max(round(0.03 / group(3)), 3), 300)
    return statistics.median(group(n) for _ in range(5)) * 1e6


def graph(f):
    f()
    sync()
    if cuda and what != "warm":
        g = record_launches(f, where)
        g()
        sync()
        return us(g)
    return us(f)


every = all_cases()


def suite_of(scene, taxels, total, noise, state):
    s = SensorSuite(
        scene, {k: replace(t, total=total, noise=noise) for k, t in taxels.items()}, num_envs=envs, device=device
    )
    for _ in range(3):
        s.update(state, 0.01)
    sync()
    return s


def kernels(s, state):
    rows = {}
    if not cuda or what == "warm":
        return ""
    for r in range(8):
        s._pose = s._recorded = None
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL, synchronize=True)
        s.update(state, 0.01)
        for k, x in enumerate(wp.timing_end(synchronize=True)):
            if r > 1:
                rows.setdefault((k, x.name.split("(")[0]), []).append(x.elapsed * 1e3)
    for _ in range(3):
        s.update(state, 0.01)
    return "  ".join(
        f"{name.replace('forward kernel ', '').split('__')[0][:14]} {min(v):.1f}" for (k, name), v in rows.items()
    )


if what == "time" and cuda:
    out = wp.zeros(1, dtype=float, device=device)
    for dim in (1, 16384 * 100, 16384 * 1000):
        t = {
            k: graph(
                lambda: [wp.launch(L.nothing, dim=dim, inputs=[out], device=device, block_dim=256) for _ in range(k)]
            )
            for k in (1, 3, 7, 15)
        }
        print(
            f"EMPTY dim {dim}: "
            + "  ".join(f"{k} launches {v:.2f}" for k, v in t.items())
            + f"  per launch {(t[15] - t[3]) / 12:.2f} us",
            flush=True,
        )
for c in cases:
    if time.perf_counter() - begin > limit:
        print("OUT OF TIME before", c)
        break
    name, (scene, found, taxels) = every[int(c[0])]
    noisy = c[1] == "n"
    noise = FULL if noisy else Noise()
    label = f"{name}, {'noisy' if noisy else 'clean'}"
    state = restore(found, envs, device)
    law = suite_of(scene, taxels, "law", noise, state)
    t_law = us(lambda: law.update(state, 0.01))
    k_law = kernels(law, state)
    del law
    suite = suite_of(scene, taxels, "engine", noise, state)
    t_engine = us(lambda: suite.update(state, 0.01))
    k_engine = kernels(suite, state)
    r = suite.runtimes[0]
    p = suite.pairs
    ctx = suite.context
    count = int(state.contact_count.numpy()[0])
    touch = r.press.touch.numpy()[..., 3]
    head = r.faces.head.numpy()[:, r.plan.links.numpy()]
    touching = (touch > 0) & (r.faces.head.numpy()[:, r.plan.link.numpy()][:, r.part.numpy()] >= 0)
    print(
        f"CASE {label}: taxels {r.count} links {len(r.plan.links)} contacts/env {count / envs:.1f} links with faces {(head >= 0).mean():.3f} touching {touching.mean():.3f} lanes {r._lanes} mode {r.mode} stores {r.stores}",
        flush=True,
    )
    if k_law:
        print("  law    by kernel:", k_law)
        print("  engine by kernel:", k_engine, flush=True)
    row = {"law": t_law, "shipped": t_engine}

    def put(key, f):
        row[key] = graph(f)

    missing = ctx.zeros((3, envs, len(scene.links)))
    sums = wp.zeros((envs, len(scene.links), 7), dtype=float, device=device)
    records = wp.zeros((envs, len(scene.links)), dtype=L.Record, device=device)
    out = ctx.zeros(1)
    room = state.contact_env.shape[0]
    assert r.plan.sensors.shape[1] == 1

    def contacts():
        ctx.launch(L.read_contacts, max(count, 1), state.arrays, state.contact_friction, out)

    def stream(whole=1):
        ctx.launch(L.stream_kernel(noisy, *r.stores), envs * r.count, r.io, r.press.filled, missing, whole)

    truth = r.io.truth.numpy().copy()
    put("contacts", contacts)
    put("stream", stream)
    put("stream of parts", lambda: stream(0))
    put("both", lambda: (contacts(), stream()))
    missing.zero_()

    def front():
        dim = max(envs, room)
        ctx.launch(
            L.start_sum,
            dim,
            p.plan,
            state.arrays,
            state.contact_friction,
            r.plan,
            p._words,
            p._bits,
            p._pushes,
            ctx.age,
            p.status,
            dim,
            sums,
        )
        looks = state.num_links if cuda else 1
        ctx.launch(
            list_pairs,
            envs * (len(p._slots) + looks),
            p.plan,
            p._solids.struct,
            state.arrays,
            p._words,
            p._bits,
            p._pushes,
            p.struct,
            looks,
            p.crowded,
            p.status,
        )

    def depths():
        taxel_runtime.KinematicRuntime.run_kernels(r, state, 0.01)

    def shipped_front():
        p.update(state)

    row["front_law"] = graph(shipped_front)
    row["depths"] = graph(depths)
    row["front+depths"] = graph(lambda: (shipped_front(), depths()))
    most = max(x.count for x in r.slices.values())

    def group(lanes, per, moments, passes, write):
        block = max(lanes, 32) if lanes > 32 else 32
        ctx.launch(
            L.least_kernel(lanes, per, moments, passes, noisy, write),
            envs * r.plan.links.shape[0] * lanes,
            r.plan,
            r.probes,
            r.faces,
            r.press,
            r.io,
            sums,
            records,
            missing,
            block=block,
        )

    def emit(passes):
        ctx.launch(
            L.emit_kernel(noisy, passes, *r.stores),
            envs * -(-r.count // each),
            r.plan,
            r.probes,
            r.faces,
            r.press,
            r.io,
            records,
            each,
        )

    def measure():
        if noisy:
            ctx.launch(measure_kernel(*r.stores), envs * r.count, r.probes, r.press, r.io)

    each = 1 if noisy else 4
    lanes = r._lanes if cuda else 1
    layouts = [(lanes, 0)]
    if cuda and most > 128:
        layouts.append((256, -(-most // 256)))
    elif cuda:
        layouts.append((32, -(-most // 32)))
    row["front of the chain"] = graph(front)
    sums.zero_()
    row["sums of the chain"] = graph(lambda: group(lanes, 0, True, 2, False))
    row["emit of the chain"] = graph(lambda: emit(2))
    errors = {}
    for moments, passes in ((False, 2), (True, 2), (True, 3)):
        tag = {(False, 2): "force", (True, 2): "moment", (True, 3): "lean"}[moments, passes]
        best = {}
        for l, per in layouts:
            if not cuda and per and most > 2:
                continue
            if False:
                best[f"G{l}/{per}"] = graph(
                    lambda: (front(), depths(), group(l, per, moments, passes, True), measure())
                )
                if passes == 2 and moments:
                    errors[f"G{l}/{per}"] = float(missing.numpy()[1].max() / max(missing.numpy()[0].max(), 1e-9))
            best[f"R{l}/{per}"] = graph(
                lambda: (front(), depths(), group(l, per, moments, passes, False), emit(passes))
            )
        row[tag] = min(best.values())
        print(f"  {tag:7s}", "  ".join(f"{k} {v:.1f}" for k, v in best.items()), flush=True)
    print("  missing of the chain over the largest load:", errors)
    # what leaning costs in the shipped kernel: at most one round is none
    del r, p, ctx
    suite = None
    kept = contact_load.ROUNDS
    contact_load.ROUNDS = 1
    contact_load.spread_kernel.cache_clear()
    once = suite_of(scene, taxels, "engine", noise, state)
    row["shipped, two passes"] = us(lambda: once.update(state, 0.01))
    if cuda and what == "time":
        print("  two passes by kernel:", kernels(once, state))
    del once
    contact_load.ROUNDS = kept
    contact_load.spread_kernel.cache_clear()
    if what == "time":
        print(f"ROW {label}: " + "  ".join(f"{k} {v:.1f} ({v / t_law:.2f})" for k, v in row.items()), flush=True)
