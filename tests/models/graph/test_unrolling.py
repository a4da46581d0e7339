from brainbench.models.encoders.zhuang import zhuang_graph
from brainbench.models.graph.unrolling import needed_steps


def test_what_no_answer_reads_is_left_out():
    spec = zhuang_graph("intersection")
    steps = needed_steps(spec, "biological", 22, whole=(), last=("fc8",))
    assert steps["fc8"] == (21, 22)
    assert steps["fc7"] == (20, 21)
    # Convolutions remember, so they start at 0; those of the last two steps come too late.
    assert {steps[f"conv{i}"] for i in (2, 4, 6)} == {(0, 20)}
    assert steps["conv3"] == steps["conv5"] == (0, 19)
    assert steps["conv1"] == (0, 19)


def test_a_feedforward_network_needs_its_receptive_field_alone():
    steps = needed_steps(zhuang_graph(feedforward=True), "biological", 22, whole=(), last=("fc8",))
    assert steps["conv6"] == (19, 20)
    assert steps["conv2"] == (15, 20)
    assert steps["conv1"] == (14, 19)


def test_everything_is_needed_when_everything_is_wanted():
    spec = zhuang_graph("gru")
    assert set(needed_steps(spec, "full", 5, whole=spec.order, last=()).values()) == {(0, 5)}


def test_a_sweep_shorter_than_the_latency_reaches_nothing():
    steps = needed_steps(zhuang_graph("gru"), "biological", 2, whole=("fc8",), last=())
    assert steps["fc8"] == (0, 2)
    assert steps["fc7"] == (0, 1)
    assert steps["conv1"] == (0, 0)
