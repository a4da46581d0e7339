"""Objects that whiskers touch, from shape to obstacle.

``solid`` makes a ``Solid`` of primitives, mesh files and ``procedural`` families; a ``PlacedObject`` puts it into a
scene with a pose and a motion; engines see its ``obstacle``. ``collections`` names many objects, those of ShapeNet too,
that are built when they are needed.
"""
