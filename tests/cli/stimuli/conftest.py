import pytest

SCENE = """
description = "A pole before two whiskers"
[array]
whiskers = "C1,C2"
[frames]
first_ms = 1
interval_ms = 5
count = 10
[[object]]
shape = "cylinder"
radius_mm = 1
height_mm = 10
position_mm = [12, 8, 3]
velocity_mm_s = [0, -30, 0]
friction = 0.3
[[scene]]
label = "whisking"
[[scene]]
label = "still"
[scene.whisking]
kind = "still"
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "pole.toml"
    path.write_text(SCENE)
    return str(path)
