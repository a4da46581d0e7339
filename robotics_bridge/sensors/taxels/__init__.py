"""Taxels of force and torque: ``sensors`` holds the configurations of all of them.

``runtime`` serves those that act by themselves, ``elastomer`` those that share a soft layer.
"""
