"""The noise model: published sequences, moments of every distribution, independence of the batch."""

import math
from functools import cache

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.sensors.noise.model import PRESETS, TAXEL_KNOBS, Noise


@cache
def _words_kernel():
    from brainbench.core.devices import warp
    from robotics_bridge.sensors.kernels.noise import philox

    wp = warp()

    @wp.kernel(module="unique", enable_backward=False)
    def words(counter: wp.array(dtype=wp.uint32), key: wp.array(dtype=wp.uint32), out: wp.array(dtype=wp.uint32)):
        a, b, c, d = philox(counter[0], counter[1], counter[2], counter[3], key[0], key[1])
        out[0] = a
        out[1] = b
        out[2] = c
        out[3] = d

    return words


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0,) * 4, (0,) * 2, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_gives_the_known_answers_of_its_authors(counter, key, expected):
    from brainbench.core.devices import warp

    wp = warp()
    arrays = [wp.array(np.array(item, np.uint32), device="cpu") for item in (counter, key, (0,) * 4)]
    wp.launch(_words_kernel(), dim=1, inputs=arrays, device="cpu")
    assert tuple(arrays[2].numpy()) == expected


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"white": -1.0}, "white .*at least 0; received -1.0"),
        ({"gain": (1.2, 0.8)}, "gain is a range"),
        ({"gain": (True, 1.0)}, "gain .*received True"),
        ({"gain": (-0.5, 1.0)}, r"gain .*at least 0; received -0\.5"),
        ({"gain": (0.5, 1.0, 1.5)}, "gain holds 2 numbers"),
        ({"gain": 1.2}, r"gain holds 2 numbers; received 1\.2"),
        ({"dead_range": (-1.0, math.inf)}, "dead_range .*received inf"),
        ({"dead_probability": 1.5}, r"dead_probability .*received 1\.5"),
        ({"jitter": 0.1}, "must not exceed read_delay"),
        ({"hysteresis": 0.5, "hysteresis_tau": 0.0}, "positive hysteresis_tau"),
        ({"bias": math.nan}, "bias must be a finite"),
    ],
)
def test_knobs_outside_their_range_are_refused(knobs, message):
    with pytest.raises(UsageError, match=message):
        Noise(**knobs)


def test_a_sensor_refuses_knobs_it_does_not_have():
    Noise(white=1.0, crosstalk_sigma=3.0).check(TAXEL_KNOBS, "ContactDepthProbe")
    with pytest.raises(UsageError, match=r"'crosstalk'; .*bias"):
        Noise(crosstalk=0.1).check(TAXEL_KNOBS, "ContactDepthProbe")


def test_presets_are_those_of_the_published_table():
    force = Noise.preset("published-force_torque")
    assert (force.white, force.walk, force.quantum, force.radius) == (5e-3, 1e-4, 1e-2, 3e-4)
    assert (force.gain, force.dead_probability, force.hysteresis, force.hysteresis_tau) == (
        (0.85, 1.15),
        0.05,
        0.5,
        0.05,
    )
    assert Noise.preset("published-agg_bool").set_knobs == ("dead_probability",)
    assert not PRESETS["none"].active
    with pytest.raises(UsageError, match="'published-depth'"):
        Noise.preset("published-dept")


@pytest.mark.shared
def test_presets_agree_with_the_released_parameters(reference):
    text = (reference / "tactile" / "tactile_params.yaml").read_text()
    for name, anchor in (("depth", "contact_depth_noise: &"), ("force", "kin_taxel_noise: &")):
        block = text.split(anchor)[1].split("\n\n")[0]
        values = {
            line.split(":")[0].strip(): line.split(":")[1].split("#")[0].strip()
            for line in block.splitlines()[1:]
            if ":" in line and not line.strip().startswith("#")
        }
        noise = PRESETS[f"published-{name}"]
        assert noise.white == float(values["noise"])
        assert noise.quantum == float(values["resolution"])
        assert noise.radius == float(values["probe_radius_noise"])
        assert noise.walk == float(values.get("random_walk", 0))
        assert noise.dead_probability == float(values["dead_taxel_probability"])
        assert str(list(noise.gain)) == values["probe_gain_resample_range"]
        assert noise.hysteresis_tau == float(values["hysteresis_tau"])


def test_a_preset_survives_its_file_and_other_files_are_refused(tmp_path):
    path = tmp_path / "preset.json"
    Noise.preset("published-elastomer").save(path, source="table 4.12")
    assert Noise.load(path) == Noise.preset("published-elastomer")
    path.write_text('{"format": "brainbench-noise-1", "noise": {"whit": 1}}')
    with pytest.raises(DataError, match="knobs: 'whit'"):
        Noise.load(path)
    path.write_text("[]")
    with pytest.raises(DataError, match=r"/preset\.json' .*'brainbench-noise-1'"):
        Noise.load(path)
