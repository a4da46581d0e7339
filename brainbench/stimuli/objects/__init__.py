"""Objects that whiskers touch, from shape to obstacle.

``primitives``, ``mesh_solids``, ``procedural`` families and ``shapenet`` make a ``Solid`` (``solid``); a
``placed_object`` puts it into a scene with a pose and a motion; engines see its ``obstacle``. ``collections``
names many objects that are built when they are needed.
"""
