"""The map from taxels to an encoder's input."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.fft import idct
from scipy.spatial.transform import Rotation

from brainbench import load_model
from brainbench.core.errors import DataError, UsageError
from brainbench.models.network import FORCE_SCALE, MOMENT_SCALE, Normaliser
from robotics_bridge import hands
from robotics_bridge.hands import layouts
from robotics_bridge.hands.observations import observation_type, observe
from robotics_bridge.policies.encoders.arms import EncoderConfig
from robotics_bridge.policies.encoders.taxel_grid import (
    SITES,
    FrontEnd,
    HandCalibration,
    Resampler,
    TaxelGraph,
    TaxelGrid,
    finger_rows,
)
from robotics_bridge.sensors import Probes

HANDS = ("xhand1", "sharpa")


def _base_poses(name: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Links' rotations and origins in the palm's frame, from MuJoCo by another way than the grid's own."""
    hand = hands.load(name)
    data = mujoco.MjData(hand.model)
    mujoco.mj_forward(hand.model, data)
    palm = data.body(hand.palm)
    base = Rotation.from_quat(palm.xquat, scalar_first=True)
    return {
        link: (
            (base.inv() * Rotation.from_quat(data.body(link).xquat, scalar_first=True)).as_matrix(),
            base.inv().apply(data.body(link).xpos - palm.xpos),
        )
        for link in (hand.palm, *(link for chain in hand.fingers.values() for link in chain))
    }


def _total(grid: TaxelGrid, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force and moment about the palm's origin of a grid [6, 5, 7]."""
    force, moment = image[:3], image[3:]
    centers = grid.axes.centers.transpose(2, 0, 1)
    about = moment + np.cross(centers, force, axis=0)
    return force.sum((1, 2)), about.sum((1, 2))


@pytest.mark.parametrize("resolution", layouts.RESOLUTIONS)
@pytest.mark.parametrize("placement", layouts.PLACEMENTS)
@pytest.mark.parametrize("name", HANDS)
def test_force_and_torque_of_the_whole_hand_are_conserved(name, placement, resolution) -> None:
    grid = TaxelGrid(name, placement=placement, resolution=resolution)
    rng = np.random.default_rng(0)
    readings = torch.from_numpy(rng.normal(size=(1, 1, grid.items, 6))).float()
    image = grid(readings)[0].numpy().astype(float)
    poses = _base_poses(name)
    force, moment, item = np.zeros(3), np.zeros(3), 0
    for link, probes in grid.layout.items():
        turn, origin = poses[link]
        for _ in range(int(probes.active.sum())):
            wrench = readings[0, 0, item].numpy().astype(float)
            force += turn @ wrench[:3]
            moment += turn @ wrench[3:] + np.cross(origin, turn @ wrench[:3])
            item += 1
    assert item == grid.items
    found = _total(grid, image)
    np.testing.assert_allclose(found[0], force, atol=1e-4)
    np.testing.assert_allclose(found[1], moment, atol=1e-4)


@settings(max_examples=25)
@given(
    name=st.sampled_from(HANDS), item=st.integers(0, 198), force=st.tuples(*[st.floats(-5, 5)] * 3),
    torque=st.tuples(*[st.floats(-0.1, 0.1)] * 3),
)  # fmt: skip
def test_one_taxel_gives_its_wrench_about_the_centre_of_its_one_site(name, item, force, torque) -> None:
    grid = _GRIDS[name]
    readings = torch.zeros(1, 1, grid.items, 6)
    links = [link for link, probes in grid.layout.items() for _ in range(int(probes.active.sum()))]
    points = np.concatenate([probes.position[probes.active] for probes in grid.layout.values()])
    turn, origin = grid.axes.place[links[item]]
    # A taxel reads its own torque and the moment of its force about the link's origin.
    readings[0, 0, item] = torch.tensor([*force, *(np.array(torque) + np.cross(points[item], force))])
    image = grid(readings)[0].numpy()
    rows, columns = grid.axes.sites(links[item], points[item][None])
    site = image[:, rows[0], columns[0]]
    lever = turn @ points[item] + origin - grid.axes.centers[rows[0], columns[0]]
    expected = np.cross(lever, turn @ force) + turn @ torque
    np.testing.assert_allclose(site[:3], turn @ force, atol=1e-5)
    np.testing.assert_allclose(site[3:], expected, atol=1e-5)
    image[:, rows[0], columns[0]] = 0
    assert not image.any()


_GRIDS = {name: TaxelGrid(name) for name in HANDS}


@pytest.mark.parametrize("name", HANDS)
def test_medium_resolution_fills_every_site_and_sites_run_from_tip_to_wrist(name) -> None:
    grid = _GRIDS[name]
    assert bool(grid.occupied.all())
    centers = grid.axes.centers
    for row in range(1, 5):  # the fingers point along z of the palm, the thumb does not
        assert (np.diff(centers[row, :, 2]) < 0).all()
    # Fingers lie side by side along y, from the radial side on.
    assert (np.diff(centers[1:, 0, 1]) < 0).all()


@pytest.mark.parametrize("name", HANDS)
def test_a_spot_of_skin_keeps_its_cell_at_every_placement_and_resolution(name) -> None:
    whole = _GRIDS[name]
    for resolution in layouts.RESOLUTIONS:
        for placement in ("tips", "fingers"):
            part = TaxelGrid(name, placement=placement, resolution=resolution)
            np.testing.assert_array_equal(part.axes.edges, whole.axes.edges)
            np.testing.assert_array_equal(part.axes.centers, whole.axes.centers)
    tips = TaxelGrid(name, placement="tips").occupied
    assert bool(tips[:, 0].all())
    assert not tips[:, 4:].any()


def test_sub_steps_become_channels_in_the_order_of_the_encoder() -> None:
    grid = _GRIDS["xhand1"]
    readings = torch.randn(2, 5, grid.items, 6)
    image = grid(readings).view(2, 5, 6, 5, 7)
    for step in range(5):
        torch.testing.assert_close(image[:, step], grid(readings[:, step : step + 1]))


def test_fillers_never_count() -> None:
    grid = TaxelGrid("sharpa", resolution="high", placement="tips")
    assert any(not probes.active.all() for probes in grid.layout.values())
    readings = {link: torch.zeros(1, len(probes), 6) for link, probes in grid.layout.items()}
    for link, probes in grid.layout.items():
        readings[link][:, torch.from_numpy(~probes.active)] = 1e6
    assert not observe("force_torque", readings, grid.layout).any()


@pytest.mark.parametrize("kind", ["bool", "depth", "agg_bool", "agg_force", "force", "elastomer", "proximity"])
def test_every_type_with_touch_has_a_grid_that_pushes_into_the_skin(kind) -> None:
    grid = TaxelGrid("xhand1", observe=kind)
    channels = observation_type(kind).channels
    assert grid.channels == channels
    values = torch.zeros(1, 1, grid.items, channels)
    values[..., 0] = 1.0
    if kind in ("force", "elastomer", "proximity"):
        force = grid(values)[0, :3].sum((1, 2)).numpy()
        expected = np.zeros(3)
        for link, probes in grid.layout.items():
            expected += int(probes.active.sum()) * grid.axes.place[link][0][:, 0]
        np.testing.assert_allclose(force, expected, atol=1e-3)
    else:
        if kind == "agg_force":  # what a real tip reports when its link is pushed: summed normals, axes z y x
            normals = [probes.normal[probes.active].sum(axis=0) for probes in grid.layout.values()]
            values[0, 0] = torch.tensor(np.array(normals)[:, ::-1].copy())
        palm = list(grid.layout).index("right_hand_link")
        if kind in ("agg_bool", "agg_force"):
            values[0, 0, [i for i in range(grid.items) if i != palm]] = 0
        force = grid(values)[0, :3].sum((1, 2)).numpy()
        assert force[0] < 0  # the palm faces x and is pushed against it
        assert abs(force[1]) < 1e-3 * abs(force[0]) or kind in ("bool", "depth")


def test_a_hand_of_a_file_and_a_layout_of_ones_own_have_grids(tmp_path) -> None:
    mjcf = """<mujoco><worldbody><body name="palm"><geom type="box" size=".04 .01 .04"/>
      <body name="ff_1" pos=".03 0 .04"><joint name="a" axis="1 0 0" range="-90 0"/>
        <geom type="capsule" size=".01" fromto="0 0 0 0 0 .04"/>
        <body name="ff_tip" pos="0 0 .04"><joint name="b" axis="1 0 0" range="-90 0"/>
          <geom type="capsule" size=".009" fromto="0 0 0 0 0 .03"/></body></body>
      <body name="th_1" pos="-.04 0 0"><joint name="c" axis="0 0 1" range="-90 0"/>
        <geom type="capsule" size=".01" fromto="0 0 0 -.04 0 0"/></body>
      </body></worldbody></mujoco>"""
    path = tmp_path / "two.xml"
    path.write_text(mjcf)
    hand = hands.load(path)
    grid = TaxelGrid(hand)
    assert bool(grid.occupied[0].any())  # thumb
    assert bool(grid.occupied[1].any())  # index
    assert not grid.occupied[2:].any()
    own = hand.with_probes({"ff_tip": Probes.grid(2, 2, size=(0.01, 0.01), center=(0, -0.009, 0.015))})
    assert TaxelGrid(own, resolution="custom").items == 4


def test_unreadable_finger_names_take_rows_in_their_order(caplog) -> None:
    assert finger_rows({"mf": (), "th": (), "ff": ()}) == {"mf": 2, "th": 0, "ff": 1}
    assert finger_rows({"rh_ffdistal": (), "rh_thdistal": ()}) == {"rh_ffdistal": 1, "rh_thdistal": 0}
    assert not caplog.text
    assert finger_rows({"fingertip": (), "fingertip_2": ()}) == {"fingertip": 0, "fingertip_2": 1}
    assert finger_rows({"Zeigefinger": (), "Daumen": ()}) == {"Zeigefinger": 0, "Daumen": 1}
    assert "'Zeigefinger', 'Daumen' do not all tell which they are" in caplog.text
    with pytest.raises(UsageError, match=r"5 fingers; .*\b6\b"):
        finger_rows({f"finger{i}": () for i in range(6)})


def test_errors_say_what_is_wrong() -> None:
    with pytest.raises(UsageError, match=r"'none' .*touch"):
        TaxelGrid("xhand1", observe="none")
    with pytest.raises(UsageError, match=r"199 items, 6 channels.*198"):
        _GRIDS["xhand1"](torch.zeros(1, 5, 198, 6))
    with pytest.raises(UsageError, match="did you mean 'tips'"):
        TaxelGrid("xhand1", placement="tip")


def _line(count: int) -> Probes:
    points = np.zeros((count, 3))
    points[:, 0] = 2e-3 * np.arange(count)
    return Probes(points, np.tile([0.0, 0.0, 1.0], (count, 1)), 1e-3)


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_the_first_patterns_are_the_wrenches_of_the_links_about_the_middle_of_their_taxels(hand: str) -> None:
    layout = hands.load(hand).layout("med", "hand")
    graph = TaxelGraph(layout)
    felt = torch.randn(2, 3, graph.patterns.shape[1], 6, generator=torch.Generator().manual_seed(0))
    found = graph.wrenches(felt)
    assert found.shape == (2, 3, SITES, 6) == (2, 3, graph.cells, 6)
    first = 0
    for number, probes in enumerate(layout.values()):
        points = probes.position[probes.active]
        part = felt[:, :, first : first + len(points)].double()
        first += len(points)
        force, moment = part[..., :3].sum(2), part[..., 3:].sum(2)
        moment = moment - torch.linalg.cross(torch.from_numpy(points.mean(0)).expand_as(force), force)
        sign = torch.sign(found[0, 0, number, 0] * force[0, 0, 0])
        torch.testing.assert_close(
            sign * found[:, :, number].double(), torch.cat((force, moment), -1), atol=1e-4, rtol=0
        )


def test_patterns_of_a_link_are_smooth_and_of_equal_power() -> None:
    layout = hands.load("xhand1").layout("med", "hand")
    graph = TaxelGraph(layout)
    first = 0
    for probes in layout.values():
        count = int(probes.active.sum())
        part = graph.patterns[:, first : first + count]
        own = part[part.abs().amax(1) > 0]
        torch.testing.assert_close(own @ own.mT, count * torch.eye(len(own)), atol=1e-3, rtol=0)
        # No pattern reaches over two links.
        assert float(graph.patterns[part.abs().amax(1) > 0].square().sum()) == pytest.approx(count * len(own), rel=1e-5)
        first += count


def test_a_chain_of_taxels_has_cosines() -> None:
    # With neighbours alone they are those of the discrete cosine transform; farther taxels weigh little.
    count = 9
    found = TaxelGraph({"link": _line(count)}).patterns.double().numpy() / np.sqrt(count)
    for number in range(4):
        pure = idct(np.eye(count)[number], norm="ortho")
        assert abs(found[number] @ pure) > 0.99


def test_few_taxels_have_few_patterns_and_another_sense_has_none() -> None:
    assert TaxelGraph({"link": _line(1)}).patterns.tolist() == [[1.0]]
    assert TaxelGraph({"a": _line(2), "b": _line(3)}).cells == 5
    with pytest.raises(UsageError, match="reads 'force_torque'; received 'bool'"):
        TaxelGraph({"link": _line(2)}, "bool")


def _run(resampler: Resampler, signal, ticks: int) -> list[tuple[int, torch.Tensor]]:
    """Feed signal(t) [V]; return (tick, step [S, V]) of every completed step."""
    state = torch.zeros(1, resampler.state_size)
    found = []
    for tick in range(1, ticks + 1):
        times = 0.005 * torch.arange(5 * (tick - 1) + 1, 5 * tick + 1)
        step, new, state = resampler(signal(times)[None], state)
        if bool(new):
            found.append((tick, step[0]))
    return found


def test_a_ramp_is_read_exactly_at_the_encoders_own_times() -> None:
    found = _run(Resampler(2), lambda t: torch.stack([t, 3 * t], 1), 90)
    # 45 ms take 1.8 control steps: five steps end in every nine.
    assert [tick for tick, _ in found] == [-(-9 * m // 5) for m in range(1, 51)]
    for number, (_, step) in enumerate(found):
        times = 0.045 * number + 0.009 * torch.arange(1, 6)
        torch.testing.assert_close(step, torch.stack([times, 3 * times], 1), atol=1e-5, rtol=1e-5)


def test_before_the_reset_nothing_touched() -> None:
    (_, step), *_rest = _run(Resampler(1), lambda t: torch.ones_like(t)[:, None], 2)
    torch.testing.assert_close(step, torch.ones(5, 1))  # from 9 ms on; the first reading is that of 5 ms


@pytest.mark.parametrize("frequency", [2.0, 8.0])
def test_waves_are_kept_within_the_error_of_linear_interpolation(frequency) -> None:
    omega = 2 * torch.pi * frequency
    found = _run(Resampler(1), lambda t: torch.sin(omega * t)[:, None], 45)
    times = 0.009 * torch.arange(1, 5 * len(found) + 1)
    error = (torch.cat([step for _, step in found])[:, 0] - torch.sin(omega * times)).abs().max()
    assert error <= (omega * 0.005) ** 2 / 8 + 1e-5


def test_rows_keep_their_own_clock() -> None:
    resampler = Resampler(1)
    state = torch.zeros(2, resampler.state_size)
    for _ in range(3):
        _, _, state = resampler(torch.ones(2, 5, 1), state)
    state[1] = 0  # the reset of one environment
    after = [resampler(torch.ones(2, 5, 1), state)[1]]
    assert after[0].tolist() == [[True], [False]]


GRID = TaxelGrid("xhand1", placement="tips", resolution="low")
NAME = "zhuang-intersection-ln-small"


def _touch(batch: int, steps: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(steps, batch, 5, GRID.items, 6, generator=generator) * torch.tensor([0.2] * 3 + [2e-3] * 3)


def _stream(front: FrontEnd, touch: torch.Tensor) -> torch.Tensor:
    h, found = front.init_state(touch.shape[1]), []
    for x in touch:
        features, h = front(x, h)
        found.append(features)
    return torch.stack(found)


def test_the_stream_equals_the_networks_own_answer_to_the_whole_sweep() -> None:
    front = FrontEnd(NAME, GRID)
    touch = _touch(2, 8)
    features = _stream(front, touch)
    sweep = torch.stack([front.stimulus(x) for x in touch], 1)
    with torch.no_grad():
        expected = load_model(NAME).encode(sweep)
    torch.testing.assert_close(features, expected.transpose(0, 1), atol=1e-5, rtol=1e-4)


def test_a_reset_row_starts_anew_and_its_neighbour_does_not_notice() -> None:
    front = FrontEnd("zhuang-small", GRID, time="resampled")
    touch = _touch(2, 12)
    unbroken = _stream(front, touch)
    h = front.init_state(2)
    for step, x in enumerate(touch):
        if step == 5:
            h = h.clone()
            h[0] = 0
        features, h = front(x, h)
        torch.testing.assert_close(features[1], unbroken[step, 1])
    fresh = _stream(front, touch[5:, :1])
    torch.testing.assert_close(features[0], fresh[-1, 0])


def test_resampled_features_are_those_of_the_sweep_at_the_encoders_own_rate() -> None:
    front = FrontEnd("s4-small", GRID, time="resampled")
    touch = _touch(1, 18)
    features = _stream(front, touch)
    # Ten steps of 45 ms end in 18 control steps; interpolate the whole recording at once.
    stimulus = torch.stack([front.stimulus(x) for x in touch], 1).view(1, 90, 6, 5, 7)
    stimulus = torch.cat((torch.zeros(1, 1, 6, 5, 7), stimulus), 1)
    place = torch.arange(1, 51, dtype=torch.float64) * 9 / 5
    low = place.floor().long()
    share = (place - low).float().view(1, -1, 1, 1, 1)
    high = (low + 1).clamp(max=90)
    sampled = stimulus[:, low] * (1 - share) + stimulus[:, high] * share
    with torch.no_grad():
        expected = load_model("s4-small").encode(sampled.reshape(1, 10, 30, 5, 7))[0]
    assert not features[0].any()  # nothing complete yet: 45 ms take two control steps
    done = torch.arange(1, 19) * 5 // 9
    for tick in range(1, 18):
        torch.testing.assert_close(features[tick, 0], expected[done[tick] - 1], atol=1e-4, rtol=1e-3)


def test_forces_of_the_calibration_reach_the_network_as_ones() -> None:
    calibration = HandCalibration(force=0.3, moment=4e-3)
    front = FrontEnd("zhuang-small", GRID, calibration=calibration)
    seen = front.stimulus(torch.zeros(1, 5, GRID.items, 6))
    assert not seen.any()
    image = GRID(_touch(1, 1)[0])
    normalised = front.step.model.normaliser(front.stimulus(_touch(1, 1)[0])).view(5, 6, 5, 7)
    torch.testing.assert_close(normalised[:, :3], image.view(5, 6, 5, 7)[:, :3] / 0.3)
    torch.testing.assert_close(normalised[:, 3:], image.view(5, 6, 5, 7)[:, 3:] / 4e-3)


def test_the_networks_own_normaliser_acts_per_channel() -> None:
    network = load_model("zhuang-small")
    scale = [FORCE_SCALE * (1 + i) for i in range(30)]
    network.normaliser = Normaliser(scale)
    front = FrontEnd(network, GRID)
    plain = FrontEnd("zhuang-small", GRID)
    touch = _touch(1, 1)[0]
    ours, theirs = (f.step.model.normaliser(f.stimulus(touch)) for f in (front, plain))
    ratio = torch.tensor(Normaliser.physical().scale.flatten().tolist()) / torch.tensor(scale)
    torch.testing.assert_close(ours, theirs * ratio.view(-1, 1, 1))


def test_a_fitted_calibration_gives_touched_sites_unit_size() -> None:
    generator = torch.Generator().manual_seed(0)
    grid = torch.randn(200, 30, 5, 7, generator=generator).view(200, 5, 6, 5, 7)
    grid[:, :, :3] *= 0.7
    grid[:, :, 3:] *= 0.004
    grid[..., 3:] = 0  # sites that nothing touches do not count
    found = HandCalibration.fit(grid.flatten(1, 2))
    assert found.force == pytest.approx(0.7, rel=0.02)
    assert found.moment == pytest.approx(0.004, rel=0.02)
    gains = found.gains(5)
    assert gains[0] == pytest.approx(FORCE_SCALE / found.force)
    assert gains[29] == pytest.approx(MOMENT_SCALE / found.moment)
    with pytest.raises(DataError, match="Nothing touches"):
        HandCalibration.fit(torch.zeros(3, 30, 5, 7))
    with pytest.raises(DataError, match="not finite"):
        HandCalibration.fit(torch.full((3, 30, 5, 7), torch.nan))
    with pytest.raises(UsageError, match=r"force .*received -1"):
        HandCalibration(force=-1)
    with pytest.raises(UsageError, match=r"calibration 'mass'.*'force', 'moment'"):
        EncoderConfig.of({"name": NAME, "calibration": {"mass": 1}})


def test_a_frozen_network_learns_nothing_and_a_finetuned_one_does() -> None:
    frozen, tuned = FrontEnd("zhuang-small", GRID), FrontEnd("zhuang-small", GRID, learning="finetuned")
    touch = _touch(1, 5)
    assert not _stream(frozen, touch).requires_grad
    assert not frozen.train().step.training
    assert tuned.train().step.training
    _stream(tuned, touch)[-1].sum().backward()
    moved = [name for name, p in tuned.named_parameters() if p.grad is not None and p.grad.any()]
    assert any("conv1" in name for name in moved)
    assert not any("decoder" in name for name in moved)


def test_seeds_make_random_encoders_and_nothing_else_does() -> None:
    touch = _touch(1, 5)
    first, same, other = (_stream(FrontEnd(NAME, GRID, seed=seed), touch)[-1] for seed in (3, 3, 4))
    torch.testing.assert_close(first, same, rtol=0, atol=0)
    assert (first - other).abs().max() > 1e-3


def test_unsuited_networks_and_names_are_refused() -> None:
    with pytest.raises(UsageError, match=r"32 steps.*'gpt'"):
        FrontEnd("zhuang-small+gpt", GRID)
    with pytest.raises(UsageError, match="did you mean 'frozen'"):
        FrontEnd("zhuang-small", GRID, learning="froze")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="did you mean 'resampled'"):
        FrontEnd("zhuang-small", GRID, time="resample")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="received 'Linear'"):
        FrontEnd(torch.nn.Linear(3, 3), GRID)
    with pytest.raises(UsageError, match="5 sub-steps; received 4"):
        FrontEnd("zhuang-small", GRID).stimulus(torch.zeros(1, 4, GRID.items, 6))
