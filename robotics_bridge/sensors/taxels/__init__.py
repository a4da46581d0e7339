"""Taxels of force and torque: ``kinematic`` (depth, normal, velocity) and ``proximity`` (nearby surface points).

``runtime`` serves both; a kinematic field can be scaled to the load that the physics engine resolved.
"""
