"""Taxels: kinematic force and torque, and proximity."""
