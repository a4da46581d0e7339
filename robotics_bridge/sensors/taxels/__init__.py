"""Taxels of force and torque: ``sensors`` holds the configurations, ``runtime`` serves them.

``contact_load`` serves kinematic taxels that add up to the forces of the physics engine.
"""
