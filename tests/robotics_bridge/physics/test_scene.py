"""Scenes: what may touch what, per-environment shapes, and reading MuJoCo models."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry, MujocoEngine, TouchScene, compile_variants

CHAIN = """<mujoco><worldbody>
<geom name="floor" type="plane" size="0 0 1"/>
<body name="base" pos="0 0 1"><freejoint/><geom name="g0" type="sphere" size="0.1"/>
  <body name="arm"><joint axis="0 1 0"/><geom name="g1" type="capsule" size="0.05 0.1"/>
    <body name="tip" pos="0 0 .2"><joint axis="0 1 0"/><geom name="g2" type="box" size="0.05 0.05 0.05"/>
      <geom name="ghost" type="sphere" size="0.3" contype="0" conaffinity="0"/></body></body></body>
<body name="ball"><freejoint/><geom name="g3" type="ellipsoid" size="0.1 0.2 0.3" contype="2" conaffinity="2"/></body>
</worldbody><contact><exclude body1="tip" body2="world"/></contact></mujoco>"""
TRIANGLE = Mesh(np.eye(3), np.array([[0, 1, 2]]))


def _names(scene: TouchScene, link: str) -> list[str]:
    return [scene.geometries[g].name for g in scene.candidates(link)]


def test_candidates_follow_collision_bits_parents_and_exclusions() -> None:
    scene = TouchScene.from_mujoco(mujoco.MjModel.from_xml_string(CHAIN))
    assert _names(scene, "base") == ["floor", "g2"]
    assert _names(scene, "arm") == ["floor"]
    assert _names(scene, "tip") == ["g0"]
    assert _names(scene, "ball") == []
    assert scene.links == ("world", "base", "arm", "tip", "ball")


def test_every_pair_that_mujoco_finds_is_a_candidate() -> None:
    model = mujoco.MjModel.from_xml_string(CHAIN.replace('pos="0 0 1"', 'pos="0 0 0.1"'))
    scene, data = TouchScene.from_mujoco(model), mujoco.MjData(model)
    rng, seen = np.random.default_rng(0), set()
    for _ in range(200):
        data.qpos[:] = model.qpos0 + rng.normal(0, 0.4, model.nq)
        mujoco.mj_forward(model, data)
        for a, b in data.contact.geom:
            seen |= {(scene.geometries[a].link, int(b)), (scene.geometries[b].link, int(a))}
    assert seen
    assert all(geometry in scene.candidates(link) for link, geometry in seen if link != "world")


def test_variants_give_each_environment_its_shape() -> None:
    ball = Geometry(name="o", link="o", kind="sphere", size=(0.1,))
    box = Geometry(name="o", link="o", kind="box", size=(0.1, 0.1, 0.1))
    scene = TouchScene(("world", "o"), (ball,), variants={0: (box, box, ball)})
    assert [scene.geometry_in(env, 0).kind for env in range(4)] == ["box", "box", "sphere", "box"]


def test_compiled_variants_differ_where_they_should() -> None:
    spec = mujoco.MjSpec.from_string(CHAIN)
    shapes = [Geometry(name="g3", link="ball", kind="ellipsoid", size=(0.1, 0.1, s)) for s in (0.1, 0.2, 0.3)]
    models = compile_variants(spec, "g3", shapes, density=500)
    mass = [m.body("ball").mass[0] for m in models]
    np.testing.assert_allclose(mass, 500 * 4 / 3 * np.pi * 0.01 * np.array([0.1, 0.2, 0.3]), rtol=1e-6)
    engine = MujocoEngine(models, 5, assignment=[2, 0])
    geometry = [item.name for item in engine.scene.geometries].index("g3")
    assert [engine.scene.geometry_in(env, geometry).size[2] for env in range(3)] == [0.3, 0.1, 0.3]
    engine.step(3)
    assert np.isfinite(engine.state.pose.numpy()).all()
    with pytest.raises(UsageError, match="did you mean 'g3'"):
        compile_variants(spec, "g33", shapes)
    for density in (np.nan, -1.0, 0.0, True, "wood"):
        with pytest.raises(UsageError, match=rf"density .*{density}"):
            compile_variants(spec, "g3", shapes, density=density)
    heavy = [*compile_variants(spec, "g3", shapes[:1], density=100), *compile_variants(spec, "g3", shapes[:1])]
    for assignment in ((-1,), (2,), (0.0,), (True,)):
        with pytest.raises(UsageError, match=rf"assignment .*{assignment[0]}"):
            MujocoEngine(heavy, 2, assignment=assignment)


@pytest.mark.parametrize("inertial", ["", '<inertial pos=".1 0 0" mass=".7" diaginertia="1 1 1"/>'])
def test_density_decides_the_mass_of_variants_whatever_the_spec_states(inertial) -> None:
    spec = mujoco.MjSpec.from_string(
        f'<mujoco><worldbody><body name="o"><freejoint/>{inertial}<geom name="g" size=".1" mass=".1"/></body>'
        "</worldbody></mujoco>"
    )
    ball = Geometry(name="g", link="o", kind="sphere", size=(0.03,))
    body = compile_variants(spec, "g", [ball], density=200)[0].body("o")
    mass = 200 * 4 / 3 * np.pi * 0.03**3
    np.testing.assert_allclose(body.mass, mass, rtol=1e-6)
    np.testing.assert_allclose(body.inertia, 0.4 * mass * 0.03**2, rtol=1e-6)
    np.testing.assert_allclose(body.ipos, 0, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Geometry(name="a", link="b", kind="bx"), "did you mean 'box'"),
        (lambda: Geometry(name="a", link="b", kind="box", size=(1.0,)), "size of 'a' holds 3"),
        (lambda: Geometry(name="a", link="b", kind="box", size=(1.0, 1.0, 0.0)), r"size of 'a' .*received 0\.0"),
        (lambda: Geometry(name="a", link="b", kind="box", size=(1.0, "1", 1.0)), "size of 'a' .*received '1'"),
        (lambda: Geometry(name="a", link="b", kind="plane", position=(0, 0, True)), "position of 'a' .*received True"),
        (lambda: Geometry(name="a", link="b", kind="plane", position=(0, 0)), "position of 'a' holds 3 numbers"),
        (lambda: Geometry(name="a", link="b", kind="plane", quaternion=(0, 0, 0, 0)), "quaternion of 'a'"),
        (lambda: Geometry(name="a", link="b", kind="plane", quaternion=(1, 0, 0, np.nan)), "quaternion of 'a' .*nan"),
        (lambda: Geometry(name="a", link="b", kind="plane", contype=1.5), r"contype of 'a' .*received 1\.5"),
        (lambda: Geometry(name="a", link="b", kind="mesh"), "names no mesh"),
        (
            lambda: Geometry(name="a", link="b", kind="sphere", size=(1.0, 2.0)),
            r"size of 'a' holds 1 .*received \(1\.0, 2\.0\)",
        ),
        (
            lambda: Geometry(name="a", link="b", kind="sphere", size=(1.0,), mesh=TRIANGLE),
            "sphere 'a' has mesh",
        ),
        (lambda: TouchScene(("w", "w")), "two of the link 'w'"),
        (lambda: TouchScene(("w",), (Geometry(name="a", link="v", kind="plane"),)), "Geometry 'a' is fixed"),
        (lambda: TouchScene(("w",), variants={0: ()}), "at least one shape"),
        (lambda: TouchScene(("w",), excluded=frozenset({(0, 1)})), "no number 1"),
        (lambda: TouchScene(("w",), included=frozenset({(0, 1)})), "no number 0"),
        (lambda: TouchScene(("w",), variants={-1: (Geometry(name="a", link="w", kind="plane"),)}), "no number -1"),
    ],
)
def test_mistakes_are_named(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]
