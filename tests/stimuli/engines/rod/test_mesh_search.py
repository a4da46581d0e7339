"""The search for what is near among triangles, against every triangle looked at and against a reference library."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from brainbench.core.devices import to_struct
from brainbench.geometry import Mesh
from brainbench.geometry.mesh import point_triangle_distance
from brainbench.stimuli.engines.rod.kernels import specialize
from brainbench.stimuli.engines.rod.limits import WIDE
from brainbench.stimuli.engines.rod.packing import EMPTY, PackedShapes, PackedSurface, spatial_order, tree_boxes
from tests.factories.rod_threads import WARP, Memory, thread_warp

wp = pytest.importorskip("warp")


def _surface(name="gear-0"):
    from brainbench.stimuli.objects.collections import resolve_objects

    surface = resolve_objects([name], surfaces=True)[name].load().surface
    # The kernels' millimetres; trimesh takes small triangles in metres for points.
    return Mesh(surface.vertices * 1e3, surface.faces)


def _segments(surface, count, seed=0):
    """Segments that begin near random vertices, some a long way from the surface."""
    rng = np.random.default_rng(seed)
    size = np.ptp(surface.vertices, axis=0).max()
    start = surface.vertices[rng.integers(len(surface.vertices), size=count)]
    start = start + rng.normal(size=(count, 3)) * size * rng.choice([0.01, 0.05, 0.3], (count, 1))
    return start, start + rng.normal(size=(count, 3)) * size * 0.05


def test_every_aligned_run_of_triangles_is_a_box_that_holds_them():
    surface = _surface()
    corners = surface.vertices[surface.faces]
    order = spatial_order(corners)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(corners)))
    corners, nodes, run, first = corners[order], tree_boxes(corners[order]), WIDE, 0
    boxes = nodes.swapaxes(1, 2).reshape(-1, 2, 3)
    while first < len(boxes):
        count = -(-len(corners) // run)
        for rank in range(count):
            inside = corners[rank * run : (rank + 1) * run].reshape(-1, 3)
            np.testing.assert_array_equal(boxes[first + rank], [inside.min(axis=0), inside.max(axis=0)])
        # The last node of a level may lack children.
        assert (boxes[first + count : first + -(-count // WIDE) * WIDE] == EMPTY).all()
        first, run = first + -(-count // WIDE) * WIDE, run * WIDE
    assert first == len(boxes)
    # Neighbours in the order are neighbours in space: leaves are far smaller than those of triangles in any order.
    leaves = -(-len(corners) // WIDE)
    extent = np.ptp(boxes[:leaves], axis=1).max(axis=1).mean()
    mixed = tree_boxes(corners[np.random.default_rng(0).permutation(len(corners))])
    mixed = np.ptp(mixed.swapaxes(1, 2).reshape(-1, 2, 3)[:leaves], axis=1)
    assert extent < 0.3 * mixed.max(axis=1).mean()


def _ask(surface, starts, stops, radius, within, leaf):
    """Squared distances [segment, 3] of the kernel's search from the segments, their ends and their starts."""
    wp.init()
    search = specialize("mesh_search", real=wp.float64)
    nearest_triangles, ShapeArrays = search.nearest_triangles, search.ShapeArrays
    filled = to_struct(ShapeArrays, _shapes(surface), "cpu")

    @wp.kernel(enable_backward=False, module="unique")
    def ask(
        shapes: ShapeArrays,
        a: wp.array(dtype=wp.vec3d),
        b: wp.array(dtype=wp.vec3d),
        radius: wp.float64,
        within: wp.float64,
        leaf: wp.array(dtype=wp.int32),
        out: wp.array(dtype=wp.vec3d),
        opened: wp.array(dtype=wp.int32),
    ):
        k = wp.tid()
        got = nearest_triangles(shapes, 0, a[k], b[k], radius, within, leaf[k], 0, 1)
        out[k] = wp.vec3d(got.side, got.end, got.start)
        opened[k] = got.boxes

    out, opened = wp.zeros(len(starts), dtype=wp.vec3d), wp.zeros(len(starts), dtype=wp.int32)
    inputs = [filled, wp.array(starts, dtype=wp.vec3d), wp.array(stops, dtype=wp.vec3d), radius, within]
    wp.launch(ask, len(starts), [*inputs, wp.array(leaf, dtype=wp.int32), out, opened], device="cpu")
    return out.numpy(), opened.numpy()


def _shapes(surface):
    shapes = PackedShapes()
    one, still = np.ones(1), np.array([[1.0, 0, 0, 0]])
    prepared = PackedSurface.of(surface.vertices, surface.faces)
    shapes.add_placed(prepared, track=np.zeros(1), quaternion=still, scale=one, radius=one, speed=np.zeros(1))
    return shapes.arrays()


def _distances(surface, points):
    """Distances of points from a surface, by trimesh."""
    import trimesh

    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    return trimesh.proximity.closest_point_naive(mesh, points)[1]


@pytest.mark.slow
@pytest.mark.parametrize("hint", [False, True])
def test_the_nearest_triangle_is_found_wherever_the_search_begins(hint):
    surface = _surface()
    starts, stops = _segments(surface, 40)
    size = np.ptp(surface.vertices, axis=0).max()
    leaves = np.random.default_rng(1).integers(-(-len(surface.faces) // WIDE), size=len(starts)) if hint else None
    # Within so much of each, everything is found on its own.
    found, _ = _ask(surface, starts, stops, 2 * size, 2 * size, np.full(len(starts), -1) if leaves is None else leaves)
    ends = np.sqrt(found[:, 1:])
    np.testing.assert_allclose(ends[:, 0], _distances(surface, stops), atol=1e-9 * size)
    # What a start is near to is a matter of the link before.
    first = found.argmin(axis=1) == 2
    assert first.any()
    np.testing.assert_allclose(ends[first, 1], _distances(surface, starts)[first], atol=1e-9 * size)
    share = np.linspace(0, 1, 21)[:, None, None]
    along = _distances(surface, (starts + share * (stops - starts)).reshape(-1, 3)).reshape(21, -1).min(axis=0)
    nearest = np.sqrt(found.min(axis=1))
    half_gap = np.linalg.norm(stops - starts, axis=1) / 40
    assert (nearest <= along + 1e-9 * size).all()
    assert (nearest >= along - half_gap - 1e-9 * size).all()


def test_only_what_is_nearest_of_all_is_sought_beyond_what_matters_and_that_takes_fewer_boxes():
    surface = _surface()
    starts, stops = _segments(surface, 60)
    size = np.ptp(surface.vertices, axis=0).max()
    anywhere = np.full(len(starts), -1)
    full, many = _ask(surface, starts, stops, 2 * size, 2 * size, anywhere)
    quick, few = _ask(surface, starts, stops, 2 * size, 0.01 * size, anywhere)
    np.testing.assert_array_equal(quick.min(axis=1), full.min(axis=1))
    near = full[:, :2] <= (0.01 * size) ** 2
    assert near.any()
    assert not near.all()
    np.testing.assert_array_equal(quick[:, :2][near], full[:, :2][near])
    assert few.sum() < many.sum()
    # Nothing within the radius is said to be nearer, and nothing without it is found.
    short, _ = _ask(surface, starts, stops, 0.02 * size, 0.01 * size, anywhere)
    np.testing.assert_allclose(np.sqrt(short.min(axis=1)), np.minimum(np.sqrt(full.min(axis=1)), 0.02 * size))


def _inside(surface, points):
    """Whether points lie in a closed surface: its triangles fill the whole sphere around them."""
    a, b, c = (surface.vertices[surface.faces[:, k]] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    triple = np.einsum("...k,...k", a, np.cross(b, c))
    dots = (np.einsum("...k,...k", x, y) for x, y in ((a, b), (b, c), (c, a)))
    ab, bc, ca = dots
    half = np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)
    return half.sum(axis=1) > np.pi


@pytest.mark.slow
def test_a_link_outside_is_never_told_that_it_overlaps_wherever_the_search_begins():
    wp.init()
    phase = specialize("narrow_phase", real=wp.float64)
    link_shape_distance, ShapeArrays, BodyMotion = phase.link_shape_distance, phase.ShapeArrays, phase.BodyMotion
    LinkTaper, cone = specialize("state", real=wp.float64).LinkTaper, phase.cone

    @wp.kernel(enable_backward=False, module="unique")
    def ask(
        shapes: ShapeArrays,
        a: wp.array(dtype=wp.vec3d),
        b: wp.array(dtype=wp.vec3d),
        margin: wp.float64,
        leaf: wp.array(dtype=wp.int32),
        out: wp.array2d(dtype=wp.float64),
    ):
        k = wp.tid()
        body = BodyMotion()
        body.quaternion = wp.vec4d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0), wp.float64(0.0))
        thin = LinkTaper(wp.float64(1e-3), wp.float64(1e-3), wp.float64(0.0), wp.float64(1.0))
        found = link_shape_distance(shapes, 0, body, cone(a[k], b[k], thin), margin, wp.float64(1.0), leaf[k], 0, 1)
        out[k, 0] = wp.where(found.between == 1, found.gap, wp.float64(1e30))
        out[k, 1] = wp.where(found.end == 1, found.end_gap, wp.float64(1e30))

    # So small that every triangle is within sight.
    surface = _surface()
    surface = Mesh(surface.vertices * (3.0 / np.ptp(surface.vertices, axis=0).max()), surface.faces)
    # Links that stand on a face, most of each further away than what is looked for on its own.
    rng = np.random.default_rng(0)
    corners = surface.vertices[surface.faces[rng.integers(len(surface.faces), size=120)]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-12)[:, None]
    starts = corners.mean(axis=1) + 0.02 * normal
    stops = starts + 0.3 * (normal + 0.5 * rng.normal(size=normal.shape))
    share = np.linspace(0, 1, 9)[:, None, None]
    points = starts + share * (stops - starts)
    outside = ~np.array([_inside(surface, some) for some in points]).any(axis=0)
    away = np.array([_distances(surface, some) for some in points]).min(axis=0)
    outside &= away > 0.01
    starts, stops = starts[outside], stops[outside]
    assert len(starts) > 50
    leaf = np.random.default_rng(1).integers(1, -(-len(surface.faces) // WIDE), size=len(starts))
    out = wp.zeros((len(starts), 2), dtype=wp.float64)
    inputs = [
        to_struct(ShapeArrays, _shapes(surface), "cpu"),
        wp.array(starts, dtype=wp.vec3d),
        wp.array(stops, dtype=wp.vec3d),
    ]
    margin = 0.02 * np.ptp(surface.vertices, axis=0).max()
    wp.launch(ask, len(starts), [*inputs, margin, wp.array(leaf, dtype=wp.int32), out], device="cpu")
    gaps = out.numpy()
    assert (gaps > 0).all()
    # What is within the margin is told, at its true distance.
    ends = _distances(surface, stops) - 1e-3
    close = ends < margin
    assert close.any()
    np.testing.assert_allclose(gaps[close, 1], ends[close], atol=1e-9)


def _measure_leaves(arrays, starts, stops, threads):
    """Numbers [thread, segment, 7] that the threads of a group find in the leaf of each segment's rank."""
    nodes = specialize("mesh_search", real=wp.float64, group_size=threads)
    measure_triangles, NearestTriangles = nodes.measure_triangles, nodes.NearestTriangles
    SearchSegment, SearchBounds, LeafCorners = nodes.SearchSegment, nodes.SearchBounds, nodes.LeafCorners
    own = WIDE // threads

    @wp.kernel(enable_backward=False, module="unique")
    def measure(
        corners: wp.array(dtype=LeafCorners),
        count: int,
        a: wp.array(dtype=wp.vec3d),
        b: wp.array(dtype=wp.vec3d),
        out: wp.array3d(dtype=wp.float64),
    ):
        part, k = wp.tid()
        line = SearchSegment()
        line.a = a[k]
        line.b = b[k]
        line.length = wp.length(b[k] - a[k])
        line.axis = (b[k] - a[k]) / line.length
        got = NearestTriangles()
        got.face = -1
        got.side = wp.float64(1e20)
        got.end = got.side
        got.start = got.side
        bounds = SearchBounds()
        bounds.side = got.side
        bounds.end = got.side
        bounds.start = got.side
        measure_triangles(corners, k, WIDE * k + own * part, count, part, line, bounds, got)
        out[part, k, 0] = got.side
        out[part, k, 1] = got.end
        out[part, k, 2] = got.start
        out[part, k, 3] = wp.float64(got.face)
        out[part, k, 4] = got.share
        out[part, k, 5] = got.v
        out[part, k, 6] = got.w

    out = wp.zeros((threads, len(starts), 7), dtype=wp.float64)
    vectors = (wp.array(x, dtype=wp.vec3d) for x in (starts, stops))
    corners = wp.array(arrays["corners"], dtype=LeafCorners)
    wp.launch(measure, out.shape[:2], [corners, int(arrays["faces"][0]), *vectors, out], device="cpu")
    return out.numpy()


def test_triangles_measured_side_by_side_are_those_measured_one_by_one():
    wp.init()
    # The last leaf is not full, so that places without a triangle are met.
    surface = _surface()
    surface = Mesh(surface.vertices, surface.faces[:-3])
    arrays = _shapes(surface)
    assert arrays["faces"][0] % WIDE
    leaves = len(arrays["corners"])
    starts, stops = _segments(surface, leaves)
    together, apart = _measure_leaves(arrays, starts, stops, 1)[0], _measure_leaves(arrays, starts, stops, WIDE)
    np.testing.assert_array_equal(together[:, :3], apart[..., :3].min(axis=0))
    # Of triangles that are as near the first counts.
    first = apart[..., 0].argmin(axis=0)
    np.testing.assert_array_equal(together[:, 3:], apart[first, np.arange(leaves), 3:])
    assert len(np.unique(together[:, 3] % WIDE)) == WIDE


def _segments_apart(a, b, p, q):
    """Least squared distance of two segments."""
    return 2 * lsq_linear(np.stack([b - a, p - q], axis=1), p - a, bounds=(0, 1), method="bvls").cost


def _segment_triangle(a, b, corners):
    """Squared distance of a segment from the edges of a triangle; 0 where it pierces the face."""
    matrix = np.stack([corners[1] - corners[0], corners[2] - corners[0], a - b], axis=1)
    if abs(np.linalg.det(matrix)) > 1e-24:
        v, w, share = np.linalg.solve(matrix, a - corners[0])
        if min(v, w, share, 1 - share, 1 - v - w) >= 0:
            return 0.0
    return min(_segments_apart(a, b, corners[k], corners[k - 1]) for k in range(3))


def measure_triangles(children, corners, leaf, first, count, part, line, _bounds, got):
    own = range(min(children, count - first))
    triangles = [corners[leaf][:, children * part + k].reshape(3, 3) for k in own]
    for k, triangle in enumerate(triangles):
        ends = [float(point_triangle_distance(x[None], triangle[None])[0]) ** 2 for x in (line.b, line.a)]
        for name, face, square in (
            ("side", "face", _segment_triangle(line.a, line.b, triangle)),
            ("end", "end_face", ends[0]),
            ("start", "start_face", ends[1]),
        ):
            if square < getattr(got, name):
                setattr(got, name, square)
                setattr(got, face, first + k)


def bound_boxes(children, boxes, node, part, line, _bounds, level, side, end):
    for k in range(children):
        low, high = boxes[node][:, children * part + k].reshape(2, 3)
        ends = np.stack([line.a, line.b])
        gap = np.maximum(np.maximum(low - ends.max(axis=0), ends.min(axis=0) - high), 0)
        away = np.maximum(np.maximum(low - line.b, line.b - high), 0)
        side[level, k], end[level, k] = gap @ gap, away @ away


def nearest_child(children, side, end, level, part, bounds):
    code = 2**31 - 1
    for k in range(children):
        if side[level, k] < bounds.side or end[level, k] < bounds.end:
            bits = int(np.float32(side[level, k]).view(np.int32))
            code = min(code, (bits & -WIDE) + children * part + k)
    return code


@pytest.mark.slow
@pytest.mark.parametrize("lanes", [2, 4, 8])
def test_threads_that_search_together_find_what_one_finds(lanes):
    surface = _surface()
    count = WARP // lanes
    starts, stops = _segments(surface, 3 * count, seed=lanes)
    size = np.ptp(surface.vertices, axis=0).max()
    radius, within = 0.5 * size, 0.02 * size
    leaves = np.random.default_rng(2).integers(-1, 20, size=len(starts))
    alone, _ = _ask(surface, starts, stops, radius, within, leaves)
    # The single kernel may look at more than it must, but only within what matters.
    counts = (alone <= within**2) & (np.arange(3) < 2)
    alone = np.where((alone == alone.min(axis=1, keepdims=True)) | counts, alone, np.nan)
    arrays = _shapes(surface)
    with thread_warp(measure_triangles, bound_boxes, nearest_child) as (threads, load):
        nearest = load("mesh_search", group_size=lanes).nearest_triangles
        bodies = SimpleNamespace(**{name: Memory(values) for name, values in arrays.items()})
        for begin in range(0, len(starts), count):
            found = {}

            def look(thread, begin=begin, found=found):
                which = thread // lanes
                # The last group has nothing to look at and keeps the others company.
                live = int(which < count - 1)
                a, b, leaf = starts[begin + which], stops[begin + which], int(leaves[begin + which])
                got = nearest(bodies, 0, a, b, radius, within, leaf, thread % lanes, live)
                found[thread] = (got.side, got.end, got.start, got.face)

            threads.run(look)
            for which in range(count - 1):
                own = [found[which * lanes + part] for part in range(lanes)]
                assert len(set(own)) == 1
                exact = alone[begin + which]
                sure = np.isfinite(exact)
                np.testing.assert_allclose(np.array(own[0][:3])[sure], exact[sure], rtol=1e-9, atol=1e-18)
