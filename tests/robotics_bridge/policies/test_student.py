"""The rsl_rl model class that feels, and its exports."""

from __future__ import annotations

import warnings
from dataclasses import asdict

import numpy as np
import pytest
import torch
from rsl_rl.utils import resolve_class, split_and_pad_trajectories
from tensordict import TensorDict

from brainbench import load_model
from brainbench.core.errors import DataError, UsageError
from robotics_bridge.policies.encoders.arms import ARMS, EncoderConfig, RunningScale
from robotics_bridge.policies.export import compare, export_policy, read_policy
from robotics_bridge.policies.student import StepPolicy, TactilePolicy
from robotics_bridge.policies.training.distill_config import DistillConfig

NETWORK = "zhuang-intersection-ln-small"
ITEMS = 45
GROUPS = {"student": ["proprio", "goal", "tactile"]}


def _observations(batch: int, steps: int = 1, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)

    def values(*shape: int) -> torch.Tensor:
        return torch.randn(steps, batch, *shape, generator=generator)

    touch = values(5, ITEMS, 6) * torch.tensor([0.2] * 3 + [2e-3] * 3)
    groups = {"proprio": values(30), "goal": values(1), "tactile": touch}
    return TensorDict(groups, batch_size=[steps, batch])


def _make_policy(name: str = NETWORK, **settings) -> TactilePolicy:
    cfg = {
        "class_name": "robotics_bridge.policies.student:TactilePolicy",
        "tactile": {"name": name, "placement": "tips", "resolution": "low", **settings.pop("tactile", {})},
        **settings,
    }
    kind, arguments = resolve_class(cfg)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        policy = kind(_observations(1)[0], GROUPS, "student", 12, **arguments)
    policy.update_normalization(_observations(64)[0])
    return policy


@pytest.mark.parametrize("name", [*ARMS, NETWORK, "s4-small", "zhuang-small+mamba"])
def test_every_arm_is_a_model_of_rsl_rl_whose_memory_is_reset_row_by_row(name) -> None:
    policy = _make_policy(name, embedder="lstm").eval()
    obs = _observations(3, 6)
    with torch.no_grad():
        whole = torch.stack([policy(obs[step]) for step in range(6)])
        assert whole.shape == (6, 3, 12)
        state = policy.get_hidden_state()
        assert state.shape == (1, 3, policy.core.state_size)
        policy.reset()
        for step in range(6):
            if step == 3:
                policy.reset(torch.tensor([0, 1, 0]))
            actions = policy(obs[step])
        torch.testing.assert_close(actions[[0, 2]], whole[-1, [0, 2]])
        policy.reset()
        for step in range(3, 6):
            fresh = policy(obs[step])
        torch.testing.assert_close(fresh[1], actions[1])


@pytest.mark.parametrize("name", ["rnn", NETWORK])
def test_padded_sequences_of_ppo_give_the_actions_of_the_rollout(name) -> None:
    policy = _make_policy(name, tactile={"learning": "finetuned"} if name == NETWORK else {}).eval()
    obs = _observations(2, 6)
    dones = torch.zeros(6, 2, 1)
    dones[2, 0] = 1
    with torch.no_grad():
        states, found = [], []
        for step in range(6):
            memory = policy.get_hidden_state()
            states.append(policy.zeros(2)[None] if memory is None else memory)
            found.append(policy(obs[step]))
            policy.reset(dones[step, :, 0])
        padded, masks = split_and_pad_trajectories(obs, dones)
        starts = torch.stack([states[0][0, 0], states[3][0, 0], states[0][0, 1]])[None]
        policy.reset()
        again = policy(padded, masks=masks, hidden_state=starts)
    torch.testing.assert_close(again, torch.stack(found), atol=1e-5, rtol=1e-4)


def test_gradients_reach_a_finetuned_network_and_never_a_frozen_one() -> None:
    for learning, moves in (("finetuned", True), ("frozen", False)):
        policy = _make_policy(tactile={"learning": learning}).train()
        obs = _observations(2, 5)
        for step in range(5):
            actions = policy(obs[step])
        actions.pow(2).mean().backward()
        front = policy.core.tactile.front  # type: ignore[union-attr]
        assert any(p.grad is not None and p.grad.any() for p in front.parameters()) is moves
        assert policy.core.tactile.project.weight.grad.any()  # type: ignore[union-attr]
        policy.detach_hidden_state()
        assert not policy.get_hidden_state().requires_grad


def test_kept_features_of_a_frozen_network_give_the_same_latent() -> None:
    policy = _make_policy().eval()
    front = policy.core.tactile.frozen_part  # type: ignore[union-attr]
    obs, h, own = _observations(2, 5), policy.zeros(2), torch.zeros(2, front.state_size)
    for step in range(5):
        latent, h = policy.advance(obs[step], h)
        features, own = front(obs[step]["tactile"], own)
        kept, _ = policy.advance(obs[step], policy.zeros(2), features)
        torch.testing.assert_close(latent, kept)


SLOWER = [
    pytest.param(name, marks=pytest.mark.slow)
    for name in (NETWORK, "tactile_convrnn", "tactile_canvas_cnn", "s4-small")
]


@pytest.mark.parametrize("name", ["mlp", *SLOWER])
def test_onnx_file_follows_the_policy_for_sixty_steps_with_resets(name, tmp_path) -> None:
    policy = _make_policy(name, tactile={"time": "resampled"} if name == NETWORK else {})
    found = export_policy(policy, tmp_path / "policy", deployment={"rate": 40})
    assert found.path == tmp_path / "policy.onnx"
    assert found.difference < 1e-4
    run = read_policy(found.path, policy.shapes, threads=1)
    other = _make_policy(name, tactile={"seed": 1} if name == NETWORK else {})
    with torch.no_grad():
        for weight in other.mlp.parameters():
            weight.add_(0.05)
    assert compare(other, run) > 1e-2
    assert '"rate": 40' in found.contract.read_text()


def test_a_policy_that_was_sampled_in_training_is_exported_and_never_as_a_program(tmp_path) -> None:
    policy = _make_policy("zhuang-small", distribution_cfg={"class_name": "GaussianDistribution", "init_std": 1.0})
    assert export_policy(policy, tmp_path / "policy").difference < 1e-4
    with pytest.raises(UsageError, match="ONNX"):
        policy.as_jit()


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


@pytest.mark.parametrize(("wrong", "message"), [(_HeadOnly, "no input 'tactile'"), (_Numb, "differs from the policy")])
def test_an_export_that_loses_the_encoder_fails_and_leaves_no_file(wrong, message, tmp_path) -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        tactile = {"name": "mlp", "placement": "tips", "resolution": "low"}
        policy = _Forgetful(_observations(1)[0], GROUPS, "student", 12, tactile=tactile)
    policy.exported = wrong
    with pytest.raises(DataError, match=message):
        export_policy(policy, tmp_path / "policy")
    assert not list(tmp_path.iterdir())


def test_running_scale_counts_only_what_touches() -> None:
    scale = RunningScale(2)
    assert scale(torch.ones(1, 2)).tolist() == [[1.0, 1.0]]
    scale.update(torch.tensor([[0.0, 4.0], [3.0, 0.0], [0.0, float("nan")]]))
    assert scale(torch.tensor([[3.0, 4.0]])).tolist() == [[1.0, 1.0]]


def test_configurations_survive_a_file_and_name_what_is_wrong() -> None:
    config = EncoderConfig(name="mlp", calibration=EncoderConfig().calibration)
    assert EncoderConfig.of(asdict(config)) == config
    assert EncoderConfig(observe="agg_bool").arm == "rnn"
    assert EncoderConfig(observe="force").arm == "tactile_convrnn"
    with pytest.raises(UsageError, match="did you mean 'resolution'"):
        EncoderConfig.of({"resolutio": "med"})
    with pytest.raises(UsageError, match="did you mean 'tactile_cnn'"):
        EncoderConfig(name="tactil_cnn").build()
    with pytest.raises(UsageError, match=r"'tactile_cnn' .*'agg_bool'"):
        EncoderConfig(name="tactile_cnn", observe="agg_bool").build()
    with pytest.raises(UsageError, match=r"\[5, 199, 6\]; .*\[5, 45, 6\]"):
        TactilePolicy(_observations(1)[0], GROUPS, "student", 12, tactile={"name": "mlp"})
    with pytest.raises(UsageError, match=r"tactile={'name'"):
        TactilePolicy(_observations(1)[0], GROUPS, "student", 12)


def test_per_link_images_hold_each_taxel_once() -> None:
    encoder = EncoderConfig(name="tactile_cnn", placement="hand", resolution="high").build()
    slots, items, channels = encoder.shape
    assert items == 667
    taxels = torch.arange(1.0, items + 1).view(1, 1, items, 1).expand(1, slots, items, channels)
    pictures = encoder.pictures(taxels)  # type: ignore[attr-defined]
    values = pictures[:, 0].flatten()
    assert sorted(values[values != 0].tolist()) == np.arange(1.0, items + 1).tolist()


def test_a_network_keeps_the_weights_that_were_scored() -> None:
    policy = _make_policy()
    own = dict(load_model(NETWORK).named_parameters())
    front = policy.core.tactile.front  # type: ignore[union-attr]
    with warnings.catch_warnings():
        for name, weight in front.step.model.named_parameters():
            torch.testing.assert_close(weight, own[name], rtol=0, atol=0)


@pytest.mark.parametrize("name", [*ARMS, NETWORK])
def test_many_steps_at_once_are_those_steps_one_by_one(name) -> None:
    policy = _make_policy(name, embedder="lstm", tactile={"learning": "finetuned"} if name == NETWORK else {}).eval()
    obs, ended = _observations(3, 4), torch.zeros(4, 3, dtype=torch.bool)
    ended[1, 0] = ended[3, 2] = True
    with torch.no_grad():
        h, found = torch.randn(3, policy.core.state_size, generator=torch.Generator().manual_seed(1)), []
        latents, after = policy.unroll(obs, h, ended)
        for step in range(4):
            latent, h = policy.advance(obs[step], h)
            found.append(latent)
            h = torch.where(ended[step][:, None], 0.0, h)
    torch.testing.assert_close(latents, torch.stack(found), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(after, h, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("name", ["tactile_convrnn", "tactile_canvas_convrnn"])
def test_convolutions_as_products_give_the_same_answers_and_gradients(name) -> None:
    encoder = EncoderConfig(name=name, placement="tips", resolution="low").build()
    with torch.no_grad():
        for weight in encoder.parameters():
            weight += 0.1 * torch.randn(weight.shape, generator=torch.Generator().manual_seed(2))
    touch = _observations(6, 3)["tactile"]
    ended = torch.tensor([[0, 1, 0, 0, 0, 1], [1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0]], dtype=torch.bool)
    found = []
    for unroll in (super(type(encoder), encoder).unroll, encoder.unroll_as_products):  # type: ignore[operator]
        encoder.zero_grad()
        h = torch.full((6, encoder.state_size), 0.1, requires_grad=True)
        y, after = unroll(touch, h, ended)
        (y.pow(2).mean() + after.pow(3).mean()).backward()
        found.append([y.detach(), after.detach(), h.grad, *(weight.grad for weight in encoder.parameters())])
    for slow, fast in zip(*found, strict=True):
        scale = float(slow.abs().max())
        torch.testing.assert_close(fast, slow, rtol=1e-3, atol=1e-5 * scale)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mixed, _ = encoder.unroll_as_products(touch, h.detach(), ended)  # type: ignore[operator]
    torch.testing.assert_close(mixed.float(), found[0][0], rtol=0, atol=0.05 * float(found[0][0].abs().max()))


def test_what_a_frozen_network_gave_needs_no_memory_of_touch() -> None:
    policy = _make_policy(embedder="lstm").eval()
    front = policy.core.tactile.frozen_part  # type: ignore[union-attr]
    obs, own, features = _observations(2, 3), torch.zeros(2, front.state_size), []
    with torch.no_grad():
        for step in range(3):
            given, own = front(obs[step]["tactile"], own)
            features.append(given)
        whole, _ = policy.unroll(obs, policy.zeros(2))
        kept, after = policy.unroll(obs, policy.zeros(2, stored=True), None, torch.stack(features))
    assert after.shape == (2, policy.core.stored_size)
    torch.testing.assert_close(kept, whole, atol=1e-5, rtol=1e-4)


def test_units_are_of_the_lstm_alone() -> None:
    small, usual = (EncoderConfig(name="rnn", **own).build() for own in ({"units": 9}, {}))
    assert (small.state_size, usual.state_size) == (18, 128)
    count = [sum(weight.numel() for weight in each.parameters()) for each in (small, usual)]
    assert count[0] < count[1] / 6


@pytest.mark.parametrize(
    ("name", "own", "told"),
    [
        ("reservoir", {"units": 9}, "'units' = 9 .*'rnn'; 'reservoir'"),
        ("zhuang-small", {"units": 9}, "'units' = 9 .*'rnn'; 'zhuang-small'"),
        ("auto", {"time": "resampled"}, "'time' .*network.*'tactile_convrnn'"),
        ("reservoir", {"learning": "finetuned"}, "'learning' .*network.*'reservoir'"),
        ("mlp", {"pretrained": "a.safetensors"}, "'pretrained' .*network.*'mlp'"),
        ("rnn", {"options": {"unroll": "full"}}, "'options' .*network.*'rnn'"),
        ("tactile_cnn", {"calibration": {"force": 2.0}}, "'calibration' .*network.*'tactile_cnn'"),
        ("zhuang-small", {"time": "resample"}, "did you mean 'resampled'"),
        ("zhuang-small", {"learning": "froze"}, "did you mean 'frozen'"),
        ("reservoir", {"seed": -1}, "'seed' .*at least 0"),
    ],
)
def test_settings_that_an_encoder_does_not_have_are_refused(name, own, told) -> None:
    with pytest.raises(UsageError, match=told):
        EncoderConfig.of({"name": name, **own})
    with pytest.raises(UsageError, match=told):
        DistillConfig(task="in_palm_rotate", encoder=name, encoder_settings=own)


@pytest.mark.parametrize("name", [*ARMS, "zhuang-small"])
def test_settings_at_their_defaults_are_of_every_encoder(name) -> None:
    config = EncoderConfig(name=name)
    assert EncoderConfig.of(asdict(config)) == config


@pytest.mark.parametrize("own", ["hand", "observe", "placement", "resolution", "name"])
def test_what_is_the_students_own_cannot_be_set_for_its_encoder(own) -> None:
    with pytest.raises(UsageError, match=f"'{own}'"):
        DistillConfig(task="in_palm_rotate", encoder_settings={own: "tips"})
