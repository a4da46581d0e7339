"""Distances of a link from shapes, against trimesh and against points taken one by one."""

import numpy as np
import pytest

from brainbench.core.devices import to_struct
from brainbench.stimuli.engines.rod.limits import BOX, CAPSULE, CYLINDER, SPHERE
from tests.factories.rod_chain import in_double

wp = pytest.importorskip("warp")

SIZES = {SPHERE: (1.5, 0, 0), CAPSULE: (0.8, 1.2, 0), CYLINDER: (1.0, 1.4, 0), BOX: (1.0, 0.6, 1.5)}


def _signed(kind, size, points):
    """Signed distances of points [..., 3] from a primitive, from its definition."""
    x = np.asarray(points)
    if kind == SPHERE:
        return np.linalg.norm(x, axis=-1) - size[0]
    if kind == CAPSULE:
        near = np.zeros_like(x)
        near[..., 2] = np.clip(x[..., 2], -size[1], size[1])
        return np.linalg.norm(x - near, axis=-1) - size[0]
    over = np.abs(x) - size
    if kind == CYLINDER:
        over = np.stack([np.linalg.norm(x[..., :2], axis=-1) - size[0], np.abs(x[..., 2]) - size[1]], axis=-1)
    return np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)


def _segments(rng, count, size=3.0):
    start = rng.uniform(-size, size, (count, 3))
    return start, start + rng.normal(size=(count, 3))


@pytest.mark.parametrize("kind", sorted(SIZES))
@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_tapered_link_meets_a_turned_primitive_where_its_gap_is_least(kind, scale):
    kernels = in_double("narrow_phase")
    real, vec3 = wp.float64, kernels.vec3
    ShapeArrays, BodyMotion, LinkTaper = kernels.ShapeArrays, kernels.BodyMotion, in_double("state").LinkTaper
    link_shape_distance, cone = kernels.link_shape_distance, kernels.cone

    @wp.kernel(enable_backward=False, module="unique")
    def measure(
        shapes: ShapeArrays,
        body: BodyMotion,
        taper: LinkTaper,
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        numbers: wp.array2d(dtype=real),
        normals: wp.array2d(dtype=vec3),
    ):
        k = wp.tid()
        found = link_shape_distance(shapes, 0, body, cone(a[k], b[k], taper), real(1.0), real(1.0), 0, 0, 1)
        numbers[k, 0] = found.share
        numbers[k, 1] = found.gap
        numbers[k, 2] = found.end_gap
        numbers[k, 3] = found.clearance
        normals[k, 0] = found.normal
        normals[k, 1] = found.end_normal

    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(kind)
    own, body = Rotation.random(random_state=kind), Rotation.random(random_state=kind + 9)
    place, at = rng.normal(size=3), rng.normal(size=3)
    starts, stops = _segments(rng, 300)
    # From the shape's frame to the scene: the shape in its body, the body in the scene.
    world = [body.apply(own.apply(x) + place) + at for x in (starts, stops)]
    size = np.array(SIZES[kind], dtype=float)
    given = {"kind": np.array([kind], dtype=np.int32), "size": size[None], "place": place[None]}
    given |= {"quaternion": np.roll(own.as_quat(), 1)[None], "scale": np.array([scale])}
    given |= dict.fromkeys(("face", "faces", "box"), np.zeros(1, dtype=np.int32))
    motion, taper = BodyMotion(), LinkTaper()
    motion.place, motion.quaternion = at, np.roll(body.as_quat(), 1)
    taper.start_radius, taper.end_radius = 0.2, 0.05
    numbers, normals = wp.zeros((300, 4), dtype=real), wp.zeros((300, 2), dtype=vec3)
    points = (wp.array(x, dtype=vec3) for x in world)
    wp.launch(
        measure, 300, [to_struct(ShapeArrays, given, "cpu"), motion, taper, *points, numbers, normals], device="cpu"
    )
    (share, gap, end_gap, clearance), (normal, end_normal) = numbers.numpy().T, np.swapaxes(normals.numpy(), 0, 1)
    along = np.linspace(0, 1, 4001)[:, None, None]
    distance = _signed(kind, size, starts + along * (stops - starts))
    gaps = distance - (0.2 + along[..., 0] * (0.05 - 0.2))
    np.testing.assert_allclose(gap, gaps.min(axis=0), atol=2e-3)
    assert (gap <= gaps.min(axis=0) + 1e-6).all()
    np.testing.assert_allclose(end_gap, distance[-1] - 0.05, atol=1e-9)
    assert (clearance <= distance.min(axis=0) + 1e-6).all()
    # The normal is the slope of the distance, where that is smooth.
    step = 1e-6
    for found, point in ((normal, starts + share[:, None] * (stops - starts)), (end_normal, stops)):
        slope = np.stack(
            [(_signed(kind, size, point + step * e) - _signed(kind, size, point - step * e)) for e in np.eye(3)], axis=1
        ) / (2 * step)  # fmt: skip
        smooth = np.abs(np.linalg.norm(slope, axis=1) - 1) < 1e-4
        assert smooth.mean() > 0.9
        np.testing.assert_allclose(found[smooth], slope[smooth], atol=1e-3)


def test_segments_and_points_are_as_far_from_triangles_as_trimesh_says():
    import trimesh

    kernels = in_double("distances")
    native = kernels.TRIANGLES
    vec2, vec3, vec4 = kernels.vec2, kernels.vec3, kernels.vec4

    @wp.func_native(
        native
        + """wp::vec_t<4, real> found;
        segment_triangle(a.c, b.c, p.c, q.c, r.c, found.c[0], found.c[1], found.c[2], found.c[3]);
        return found;"""
    )
    def segment_triangle(a: vec3, b: vec3, p: vec3, q: vec3, r: vec3) -> vec4: ...

    @wp.func_native(
        native
        + """wp::vec_t<2, real> found;
        real square;
        from_triangle(x.c, p.c, q.c, r.c, square, found.c[0], found.c[1]);
        return found;"""
    )
    def point_triangle(x: vec3, p: vec3, q: vec3, r: vec3) -> vec2: ...

    @wp.kernel(enable_backward=False, module="unique")
    def measure(
        a: wp.array(dtype=vec3),
        b: wp.array(dtype=vec3),
        corner: wp.array2d(dtype=vec3),
        segment: wp.array(dtype=vec4),
        ends: wp.array2d(dtype=vec2),
    ):
        k = wp.tid()
        segment[k] = segment_triangle(a[k], b[k], corner[k, 0], corner[k, 1], corner[k, 2])
        ends[k, 0] = point_triangle(a[k], corner[k, 0], corner[k, 1], corner[k, 2])
        ends[k, 1] = point_triangle(b[k], corner[k, 0], corner[k, 1], corner[k, 2])

    rng = np.random.default_rng(0)
    count = 500
    starts, stops = _segments(rng, count, 1.0)
    corners = rng.normal(size=(count, 3, 3))
    segment, ends = wp.zeros(count, dtype=vec4), wp.zeros((count, 2), dtype=vec2)
    inputs = [wp.array(x, dtype=vec3) for x in (starts, stops, corners)]
    wp.launch(measure, count, [*inputs, segment, ends], device="cpu")
    square, share, *weights = segment.numpy().T

    def point(v, w):
        return (1 - v - w)[:, None] * corners[:, 0] + v[:, None] * corners[:, 1] + w[:, None] * corners[:, 2]

    closest = trimesh.triangles.closest_point
    for which, x in enumerate((starts, stops)):
        np.testing.assert_allclose(point(*ends.numpy()[:, which].T), closest(corners, x), atol=1e-9)
    # The closest points that are named are so far apart, and no place of the segment is nearer to the triangle.
    apart = np.linalg.norm(starts + share[:, None] * (stops - starts) - point(*weights), axis=1)
    np.testing.assert_allclose(np.sqrt(square), apart, atol=1e-9)
    assert (np.sqrt(square) < 1e-9).sum() > 20
    steps = np.linspace(0, 1, 401)
    away = [np.linalg.norm(x - closest(corners, x), axis=1) for x in (starts + s * (stops - starts) for s in steps)]
    least = np.minimum(np.sqrt(square), np.minimum(away[0], away[-1]))
    assert (least <= np.min(away, axis=0) + 1e-9).all()
    assert (least >= np.min(away, axis=0) - np.linalg.norm(stops - starts, axis=1) / 800 - 1e-9).all()
