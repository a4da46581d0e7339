"""Exported files that are damaged are refused before anything can move."""

from __future__ import annotations

import os
import shutil

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.files import write_json
from robotics_bridge.deploy.controller import read_deployed
from robotics_bridge.policies.export import compare, export_policy, read_policy
from robotics_bridge.policies.student import StepPolicy, TactilePolicy
from tests.factories.damage import damaged
from tests.factories.policies import GROUPS, NETWORK, contract_of, export_small, make_student, student_observations
from tests.factories.reading_trials import time_limit

SHAPES = {"proprio": (36,), "command": (1,), "tactile": (5, 5, 3)}


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    return export_small(tmp_path_factory.mktemp("onnx"))


def _check_mutants(path, folder, cases: int) -> None:
    whole, refused = path.read_bytes(), 0
    target = folder / path.name
    shutil.copy(path.with_name(f"{path.name}.json"), folder)
    for seed in range(cases):
        target.write_bytes(damaged(whole, seed))
        if target.read_bytes() != whole:
            with pytest.raises(DataError, match=path.name):
                read_deployed(target)
        try:
            run = read_policy(target, SHAPES, threads=1, actions=12)
        except BrainbenchError as error:
            refused += 1
            assert "\n" not in str(error)  # noqa: PT017 - of many cases, most raise
            continue
        # With other input, weights of 1e35 may still overflow; the control loop looks at each action.
        assert np.isfinite(run({name: np.zeros(shape, np.float32) for name, shape in SHAPES.items()}, True)).all()
    assert refused > cases // 4


def test_damaged_files_are_refused_or_compute_finite_actions(exported, tmp_path) -> None:
    _check_mutants(exported, tmp_path, 15)


@pytest.mark.slow
def test_many_damaged_files_are_refused_or_compute_finite_actions(exported, tmp_path) -> None:
    _check_mutants(exported, tmp_path, 500)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite_are_refused_by_name(exported, tmp_path, value) -> None:
    model = onnx.load(exported)
    weight = next(item for item in model.graph.initializer if "mlp.0.weight" in item.name)
    array = numpy_helper.to_array(weight).copy()
    array.flat[0] = value
    weight.CopyFrom(numpy_helper.from_array(array, weight.name))
    onnx.save(model, tmp_path / "policy.onnx")
    with pytest.raises(DataError, match=r"mlp\.0\.weight"):
        read_policy(tmp_path / "policy.onnx", SHAPES)


def test_weights_in_other_files_are_not_opened(exported, tmp_path) -> None:
    model = onnx.load(exported)
    onnx.save(model, tmp_path / "policy.onnx", save_as_external_data=True, location="elsewhere", size_threshold=0)
    with pytest.raises(DataError, match="other files"):
        read_policy(tmp_path / "policy.onnx", SHAPES)


def test_constants_of_branches_in_other_files_are_not_opened(exported, tmp_path) -> None:
    model = onnx.load(exported)
    (tmp_path / "elsewhere").write_bytes(bytes(4))
    value = onnx.TensorProto(name="w", data_type=onnx.TensorProto.FLOAT, dims=[1], data_location=1)
    value.external_data.add(key="location", value="elsewhere")
    model.graph.node.append(onnx.helper.make_node("Constant", [], ["unused"], value=value))
    (tmp_path / "policy.onnx").write_bytes(model.SerializeToString())
    with pytest.raises(DataError, match="other files"):
        read_policy(tmp_path / "policy.onnx", SHAPES)


def test_a_memory_without_bounds_is_refused(tmp_path) -> None:
    def value(name: str, *shape: int) -> onnx.ValueInfoProto:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1, *shape])

    inputs = [*(value(name, *shape) for name, shape in SHAPES.items()), value("h_in", 1 << 40)]
    nodes = [onnx.helper.make_node("Identity", [a], [b]) for a, b in (("h_in", "h_out"), ("proprio", "actions"))]
    graph = onnx.helper.make_graph(nodes, "policy", inputs, [value("actions", 36), value("h_out", 1 << 40)])
    path = tmp_path / "policy.onnx"
    onnx.save(onnx.helper.make_model(graph, ir_version=10, opset_imports=[onnx.helper.make_opsetid("", 18)]), path)
    with pytest.raises(DataError, match=r"takes 1,099,511,627,776 numbers as 'h_in'"):
        read_policy(path, SHAPES)


def test_what_is_no_file_is_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "policy.onnx")
    (tmp_path / "endless.onnx").symlink_to("/dev/zero")
    for name in ("policy.onnx", "endless.onnx"):
        with time_limit(), pytest.raises(DataError, match="device"):
            read_policy(tmp_path / name, SHAPES)


def test_a_program_is_not_deployed(tmp_path) -> None:
    """Files of versions that wrote TorchScript."""
    (tmp_path / "policy.pt").write_bytes(b"PK")
    write_json(tmp_path / "policy.pt.json", contract_of() | {"format": "jit"})
    with pytest.raises(DataError, match="TorchScript"):
        read_deployed(tmp_path / "policy.pt")


def test_files_that_fit_another_contract_are_refused(exported, tmp_path) -> None:
    with pytest.raises(DataError, match=r"\(12,\)"):
        read_policy(exported, SHAPES, actions=5)
    for shapes in ({**SHAPES, "command": (2,)}, {**SHAPES, "tactile": (5, 5)}, {"proprio": (36,)}):
        with pytest.raises(DataError, match=exported.name):
            read_policy(exported, shapes)
    with pytest.raises(DataError, match="'thermal'"):
        read_policy(exported, {**SHAPES, "thermal": (3,)})
    (tmp_path / "empty.onnx").touch()
    for path in (tmp_path, tmp_path / "empty.onnx", tmp_path / "none.onnx"):
        with pytest.raises(DataError, match=path.name):
            read_policy(path, SHAPES)


SLOWER = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in (NETWORK, "tactile_convrnn", "tactile_canvas_cnn", "s4-small")
]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mlp", *SLOWER])
def test_onnx_file_follows_the_policy_for_sixty_steps_with_resets(name, tmp_path) -> None:
    policy = make_student(name, tactile={"time": "resampled"} if name == NETWORK else {})
    found = export_policy(policy, tmp_path / "policy", deployment={"rate": 40})
    assert found.path == tmp_path / "policy.onnx"
    assert found.difference < 1e-4
    run = read_policy(found.path, policy.shapes, threads=1)
    other = make_student(name, tactile={"seed": 1} if name == NETWORK else {})
    with torch.no_grad():
        for weight in other.mlp.parameters():
            weight.add_(0.05)
    assert compare(other, run) > 1e-2
    assert '"rate": 40' in found.contract.read_text()


class _Forgetful(TactilePolicy):
    """What a user would write who overrides the latent alone: exports fall back on rsl_rl's, without encoders."""

    exported: type

    def as_onnx(self, verbose: bool = False):
        return self.exported(self)


class _HeadOnly(torch.nn.Module):
    def __init__(self, policy: TactilePolicy) -> None:
        super().__init__()
        full = StepPolicy(policy)
        self.mlp, self.latent = full.mlp, policy.core.features
        self.shapes = {name: shape for name, shape in full.shapes.items() if name != "tactile"}
        self.input_names, self.output_names = [*self.shapes, "h_in"], ["actions", "h_out"]

    def forward(self, *inputs):
        proprio, goal, h_in = inputs
        latent = torch.nn.functional.pad(torch.cat((proprio, goal), 1), (0, self.latent - 31))
        return self.mlp(latent), h_in + 0

    def get_dummy_inputs(self, batch: int = 1):
        return torch.zeros(batch, 30), torch.zeros(batch, 1), torch.zeros(batch, 1)


class _Numb(StepPolicy):
    """Takes touch, and does not use it."""

    def forward(self, *inputs):
        return super().forward(*(0.0 * item if item.ndim > 2 else item for item in inputs))


@pytest.mark.slow
@pytest.mark.parametrize(("wrong", "message"), [(_HeadOnly, "no input 'tactile'"), (_Numb, "differs from the policy")])
def test_an_export_that_loses_the_encoder_fails_and_leaves_no_file(wrong, message, tmp_path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tactile = {"name": "mlp", "placement": "tips", "resolution": "low"}
        policy = _Forgetful(student_observations(1)[0], GROUPS, "student", 12, tactile=tactile)
    policy.exported = wrong
    with pytest.raises(DataError, match=message):
        export_policy(policy, tmp_path / "policy")
    assert not list(tmp_path.iterdir())
