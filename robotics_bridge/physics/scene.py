"""Scenes for sensors: links, the geometries fixed to them, pairs that may meet, and variants by environment.

Letters: G geometry, L link. Lengths in metres; quaternions here are (w, x, y, z), as in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError, check_name, check_number, check_numbers, repeats, unknown_name
from brainbench.geometry import Mesh

mujoco = mujoco_module()

KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "other")
"""Kinds of geometries; ``other`` (height fields and the like) collides in the engine, but no sensor can query it."""

_MUJOCO_KINDS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}
_SIZES = {"plane": 0, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0, "other": 0}

LONGEST_STEP = 0.1  # longest time step of an engine (s); contacts of hands need a hundredth of it


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """A solid that is fixed to a link."""

    name: str = ""
    link: str = ""
    """The link that carries it; empty while it belongs to none."""
    kind: str
    """One of :data:`KINDS`. Planes are half-spaces below z = 0, capsules and cylinders lie along z."""
    size: tuple[float, ...] = ()
    """Radius (sphere); radius and half length (capsule, cylinder); half axes (ellipsoid); half edges (box) [m]."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Origin of its frame in the link's frame [m]."""
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Orientation in the link's frame (w, x, y, z)."""
    mesh: Mesh | None = None
    """Surface of a ``mesh``, in the geometry's frame."""
    contype: int = 1
    """Collision bits, as in MuJoCo: two geometries may touch when one's type meets the other's affinity."""
    affinity: int = 1

    def __post_init__(self) -> None:
        check_name("kind of geometry", self.kind, KINDS)
        of = f"of {self.name!r}" if self.name else f"of a {self.kind}"
        check_numbers(f"size {of}", self.size, _SIZES[self.kind], above=0)
        check_number(f"contype {of}", self.contype, whole=True)
        check_number(f"affinity {of}", self.affinity, whole=True)
        check_numbers(f"position {of}", self.position, 3)
        check_numbers(f"quaternion {of}", self.quaternion, 4)
        if (self.kind == "mesh") != (self.mesh is not None):
            verb = "has" if self.mesh is not None else "names no"
            raise UsageError(f"The {self.kind} {self.name!r} {verb} mesh; kind='mesh' goes with mesh=Mesh(...).")
        norm = float(np.linalg.norm(self.quaternion))
        check_number(f"length of the quaternion {of}", norm, above=1e-6)
        object.__setattr__(self, "quaternion", tuple(float(q) / norm for q in self.quaternion))
        object.__setattr__(self, "size", tuple(float(s) for s in self.size))

    def reach(self, directions: ArrayLike) -> NDArray[np.float64]:
        """Return the support function: how far the solid reaches along unit directions [..., 3] of its frame (m)."""
        d, size = np.asarray(directions, dtype=float), self.size
        # Support function h(d) = max x · d of each solid, in closed form; that of a sum of bodies is the sum of theirs,
        # as for a capsule (segment and ball) or a cylinder (segment and disc).
        upright = np.abs(d[..., 2])
        if self.mesh is not None:
            return (d @ self.mesh.vertices.T).max(axis=-1)
        if self.kind == "sphere":
            return np.full(d.shape[:-1], size[0])
        if self.kind == "capsule":
            return upright * size[1] + size[0]
        if self.kind == "cylinder":
            return upright * size[1] + np.hypot(d[..., 0], d[..., 1]) * size[0]
        if self.kind == "ellipsoid":
            return np.linalg.norm(d * np.array(size), axis=-1)
        return np.abs(d) @ np.array(size) if self.kind == "box" else np.full(d.shape[:-1], np.inf)


@dataclass(frozen=True, eq=False)
class TouchScene:
    """Links, their geometries and the pairs that may touch; says nothing about motion."""

    links: tuple[str, ...]
    geometries: tuple[Geometry, ...] = ()
    excluded: frozenset[tuple[int, int]] = frozenset()
    """Pairs of link numbers (low, high) that never collide, such as parent and child."""
    included: frozenset[tuple[int, int]] = frozenset()
    """Pairs of geometry numbers (low, high) that collide whatever their bits say."""
    variants: Mapping[int, tuple[Geometry, ...]] = field(default_factory=dict)
    """By geometry number, where environments differ: its shapes in environments 0, 1, …, then from the first again."""
    flexes: tuple[str, ...] = ()
    """Names of soft bodies that collide; contacts of the engine have the number −1 in place of their geometry."""
    reports_forces: bool = False
    """True if an engine tells the forces of contacts."""

    def __post_init__(self) -> None:
        for what, names in (("link", self.links), ("geometry", [g.name for g in self.geometries])):
            if twice := repeats(filter(None, names)):
                raise UsageError(f"The scene has two of the {what} {twice[0]!r}; names must differ.")
        if not all(self.variants.values()):
            raise UsageError("Variants of a geometry need at least one shape.")
        numbered = (
            ("link", len(self.links), {n for pair in self.excluded for n in pair}),
            ("geometry", len(self.geometries), {*self.variants, *(n for pair in self.included for n in pair)}),
        )
        for what, count, numbers in numbered:
            if strange := sorted(number for number in numbers if not 0 <= number < count):
                raise UsageError(f"The scene has {count} of what is called {what}; there is no number {strange[0]}.")
        for geometry in self.geometries:
            check_name("link", geometry.link, self.links, hint=f"Geometry {geometry.name!r} is fixed to it.")

    @cached_property
    def link_of(self) -> NDArray[np.int32]:
        """Link number [G] of every geometry."""
        return np.array([self.links.index(geometry.link) for geometry in self.geometries], dtype=np.int32)

    def link_index(self, name: str) -> int:
        """Return the number of a link; an unknown name raises UsageError."""
        check_name("link", name, self.links)
        return self.links.index(name)

    def geometries_of(self, link: str) -> tuple[int, ...]:
        """Return the numbers of the geometries that a link carries."""
        return tuple(np.flatnonzero(self.link_of == self.link_index(link)).tolist()) if self.geometries else ()

    def geometry_in(self, env: int, geometry: int) -> Geometry:
        """Return a geometry as one environment has it."""
        shapes = self.variants.get(geometry) or (self.geometries[geometry],)
        return shapes[env % len(shapes)]

    @cached_property
    def _bits(self) -> NDArray[np.int64]:
        return np.array([(g.contype, g.affinity) for g in self.geometries], dtype=np.int64).reshape(-1, 2)

    def candidates(self, link: str) -> tuple[int, ...]:
        """Return the numbers of all geometries that may come into contact with a link."""
        free = ~np.isin(self.link_of, list(self._barred(link)))
        partners: set[int] = set()
        for geometry in self.geometries_of(link):
            kind, affinity = self._bits[geometry]
            # MuJoCo's rule: two geometries collide if the type of either is among the affinities of the other.
            meets = ((self._bits[:, 0] & affinity) | (self._bits[:, 1] & kind)) != 0
            partners |= set(np.flatnonzero(meets & free).tolist())
            partners |= {low + high - geometry for low, high in self.included if geometry in (low, high)}
        return tuple(sorted(partners))

    def _barred(self, link: str) -> set[int]:
        """Return the numbers of the links that never collide with a link, its own among them."""
        here = self.link_index(link)
        return {low + high - here for low, high in self.excluded if here in (low, high)} | {here}

    def surroundings(self, link: str) -> tuple[int, ...]:
        """Return the numbers of the geometries that a link may meet without regard to contacts.

        Those of :meth:`candidates`; for a link that collides with nothing, what collides of every other link that is
        not barred, or all that it has.
        """
        if partners := self.candidates(link):
            return partners
        around: list[int] = []
        for neighbour in {*range(len(self.links))} - self._barred(link):
            mine = [g for g in np.flatnonzero(self.link_of == neighbour).tolist() if self.geometries[g].kind != "other"]
            # Bits of zero collide with nothing at all.
            around += [g for g in mine if self._bits[g].any()] or mine
        return tuple(sorted(around))

    @classmethod
    def from_mujoco(cls, model: Any, others: Sequence[Any] = (), assignment: Sequence[int] = ()) -> TouchScene:
        """Read the scene out of a compiled ``mujoco.MjModel``; link 0 is the world.

        ``others`` are further variants that differ in numbers only. That of environment e is number
        ``assignment[e % len(assignment)]``; empty means each in turn.
        """
        check_number("time step of the engine (s)", float(model.opt.timestep), above=0, most=LONGEST_STEP)
        for number in assignment:
            check_number("variant of the assignment", number, least=0, below=1 + len(others), whole=True)
        links = tuple(_name(model, 1, index) for index in range(model.nbody))
        for neighbour in others:
            if neighbour.nbody != model.nbody or neighbour.ngeom != model.ngeom:
                raise UsageError(
                    f"Variants of a scene need the same links and geometries; one has {neighbour.nbody} links and "
                    f"{neighbour.ngeom} geometries, the first {model.nbody} and {model.ngeom}."
                )
        geometries, *rows = (_geometries(each, links) for each in (model, *others))
        order = list(assignment) or range(1 + len(others))
        variants = {
            index: tuple(shapes[number] for number in order)
            for index, shapes in enumerate(zip(geometries, *rows, strict=True))
            if any(_form(shape) != _form(shapes[0]) for shape in shapes[1:])
        }
        pairs = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        always = frozenset((min(pair), max(pair)) for pair in pairs)
        collides = (model.flex_contype | model.flex_conaffinity) != 0
        kind = mujoco.mjtObj.mjOBJ_FLEX
        flexes = tuple(mujoco.mj_id2name(model, kind, i) or f"flex{i}" for i in np.flatnonzero(collides).tolist())
        return cls(links, geometries, _never(model), always, variants, flexes, reports_forces=True)


def _name(model: Any, what: int, index: int) -> str:
    return mujoco.mj_id2name(model, what, index) or f"{'link' if what == 1 else 'geometry'}{index}"


def _geometries(model: Any, links: tuple[str, ...]) -> tuple[Geometry, ...]:
    """Return the geometries of a model in its order; those of one mesh share it."""
    geometries = []
    meshes: dict[int, Mesh] = {}
    for index in range(model.ngeom):
        kind = _MUJOCO_KINDS.get(int(model.geom_type[index]), "other")
        data = int(model.geom_dataid[index])
        if kind == "mesh" and data not in meshes:
            meshes[data] = _mesh(model, data)
        rows = (model.geom_size[index], model.geom_pos[index], model.geom_quat[index])
        size, position, quaternion = (tuple(row.tolist()) for row in rows)
        geometries.append(
            Geometry(
                name=_name(model, int(mujoco.mjtObj.mjOBJ_GEOM), index), link=links[model.geom_bodyid[index]],
                kind=kind, size=size[: _SIZES[kind]], position=position, quaternion=quaternion,
                mesh=meshes[data] if kind == "mesh" else None, contype=int(model.geom_contype[index]),
                affinity=int(model.geom_conaffinity[index]),
            )
        )  # fmt: skip
    return tuple(geometries)


def _mesh(model: Any, index: int) -> Mesh:
    first, count = int(model.mesh_vertadr[index]), int(model.mesh_vertnum[index])
    face, faces = int(model.mesh_faceadr[index]), int(model.mesh_facenum[index])
    vertices = model.mesh_vert[first : first + count].astype(float)
    return Mesh(vertices, model.mesh_face[face : face + faces], _name(model, 7, index))


def _form(shape: Geometry) -> tuple[Any, ...]:
    mesh = shape.mesh and shape.mesh.content_hash
    return shape.kind, shape.size, shape.position, shape.quaternion, mesh


def _never(model: Any) -> frozenset[tuple[int, int]]:
    """Return the pairs of links that MuJoCo excludes: named ones, parents with children, links welded together."""
    excluded = ((int(signature) >> 16, int(signature) & 0xFFFF) for signature in model.exclude_signature)
    pairs = {(min(pair), max(pair)) for pair in excluded}
    weld, parent = model.body_weldid, model.body_parentid
    filtering = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    for body in range(model.nbody):
        above = weld[parent[weld[body]]]
        for sibling in np.flatnonzero(weld == weld[body]).tolist():
            if sibling != body:
                pairs.add((min(body, sibling), max(body, sibling)))
        # MuJoCo lets children of the world collide with it.
        if filtering and weld[body] and above:
            pairs |= {(min(body, o), max(body, o)) for o in np.flatnonzero(weld == above).tolist()}
    return frozenset(pairs)


def model_fields(model: Any) -> tuple[str, ...]:
    """Return the names of the numeric array fields of a ``mujoco.MjModel`` or ``MjData``."""
    names = (name for name in dir(model) if not name.startswith("_"))
    return tuple(name for name in names if isinstance(getattr(model, name, None), np.ndarray))


def check_model_fields(model: Any, fields: Mapping[str, ArrayLike], num_envs: int) -> dict[str, NDArray]:
    """Return the fields as arrays [B, ...] after checking names and shapes."""
    checked = {}
    for name, values in fields.items():
        field = getattr(model, name, None)
        if not isinstance(field, np.ndarray):
            raise unknown_name("model field", name, model_fields(model))
        array = np.asarray(values, dtype=field.dtype)
        if array.shape != (num_envs, *field.shape):
            needed = (num_envs, *field.shape)
            raise UsageError(f"The field {name!r} needs a value per environment, {needed}; received {array.shape}.")
        if array.dtype.kind == "f" and np.isnan(array).any():
            raise UsageError(f"The field {name!r} holds values that are no numbers (NaN).")
        checked[name] = array
    return checked


def differing_fields(models: Sequence[Any], order: Sequence[int], num_envs: int) -> dict[str, NDArray]:
    """Stack per environment e [B, ...] every field in which compiled variants ``order[e % len(order)]`` differ."""
    first = models[0]
    rows = np.array([order[env % len(order)] for env in range(num_envs)])
    differing = {}
    for name in model_fields(first):
        values = [getattr(model, name) for model in models]
        if any(value.shape != values[0].shape for value in values):
            raise UsageError(
                f"Variants of a model must differ in numbers only; the shape of {name!r} differs "
                f"({', '.join(sorted({str(value.shape) for value in values}))}). Give every variant all the meshes, "
                "as compile_variants does."
            )
        if any(not np.array_equal(value, values[0], equal_nan=value.dtype.kind == "f") for value in values[1:]):
            differing[name] = np.stack(values)[rows]
    return differing


def compile_variants(spec: Any, geometry: str, shapes: Sequence[Geometry], *, density: float = 1000.0) -> list[Any]:
    """Compile one model per shape of a geometry, ready for an engine.

    Every model holds the meshes of all shapes, so that they differ in numbers only. The link's mass and inertia
    follow from the density.

    Args:
        spec: a ``mujoco.MjSpec``; it is not changed.
        geometry: name of what is replaced there.
        shapes: what to put there, with the link and pose of the spec. MuJoCo Warp needs equal kinds.
        density: kg/m³.
    """
    check_number("density (kg/m³)", density, above=0)
    models = []
    for number, shape in enumerate(shapes):
        if shape.kind not in KINDS[1:-1]:
            raise UsageError(f"A {shape.kind} cannot be a variant of an object; use one of {', '.join(KINDS[1:-1])}.")
        copy = spec.copy()
        for index, variant in enumerate(shapes):
            if variant.mesh is not None:
                vertices, faces = variant.mesh.vertices.ravel().tolist(), variant.mesh.faces.ravel().tolist()
                copy.add_mesh(name=f"variant{index}", uservert=vertices, userface=faces)
        target = next((g for g in copy.geoms if g.name == geometry), None)
        if target is None:
            raise unknown_name("geometry", geometry, [g.name for g in copy.geoms if g.name])
        target.type = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
        target.size = [*shape.size, 0.0, 0.0, 0.0][:3]
        # A mass or an inertia that the spec states would come before the density.
        target.density, target.mass = density, np.nan
        target.parent.explicitinertial, target.parent.ipos = False, [np.nan] * 3
        if shape.mesh is not None:
            target.meshname = f"variant{number}"
        models.append(copy.compile())
    return models
