"""A scene file with most of its keys."""

POLE = """
description = "a pole"
[array]
species = "rat"
side = "left"
whiskers = "C*"
[array.replace.C2]
young_modulus = 3.3e9
[head]
position_mm = [1, 2, 3]
rotation_deg = [0, 90, 0]
[whisking]
frequency_hz = 8
protraction_deg = 30
onset_ms = 50
rotations = "knutsen-b"
[frames]
first_ms = 0
interval_ms = 1
count = 10
[[object]]
shape = "box"
size_mm = [1, 2, 3]
[[scene]]
label = "near"
[[scene.object]]
shape = "cylinder"
radius_mm = 0.5
height_mm = 20
position_mm = [14, 5, 0]
friction = 0.3
velocity_mm_s = [0, -30, 0]
[[scene]]
label = "free"
[scene.whisking]
kind = "still"
[scene.head]
position_mm = [0, 0, 0]
"""
