"""Taxels of force and torque: ``sensors`` holds the configurations, ``runtime`` serves them.

A kinematic field can be scaled to the load that the physics engine resolved (``kernels.contact_load``).
"""
