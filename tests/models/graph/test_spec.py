import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn, zeros

from brainbench.core.errors import UsageError
from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node, Pool

CONV = Convolution(2)


def _spec(edges, names="abc", **changes):
    nodes = tuple(Node(name, CONV) for name in names)
    options = {"nodes": nodes, "edges": tuple(edges), "inputs": ("a",), "output": names[-1], "input_shape": (3, 5, 7)}
    return GraphSpec(**(options | changes))


def test_nodes_are_sorted_along_the_feedforward_edges():
    spec = _spec([Edge("c", "b"), Edge("a", "c"), Edge("b", "a", feedback=True)], output="b")
    assert spec.order == ("a", "c", "b")


def test_a_feedforward_cycle_is_refused_by_name():
    with pytest.raises(UsageError, match=r"'b', 'c' .*cycle"):
        _spec([Edge("a", "b"), Edge("b", "c"), Edge("c", "b")])


@pytest.mark.parametrize(
    ("edges", "changes", "message"),
    [
        ([Edge("a", "conv2"), Edge("a", "b")], {}, "Unknown node of an edge 'conv2'"),
        ([Edge("a", "b"), Edge("b", "c")], {"output": "C"}, "Unknown output node 'C'; did you mean 'c'"),
        ([Edge("a", "b"), Edge("b", "c")], {"inputs": ("x",)}, "Unknown input node 'x'"),
        ([Edge("a", "b")], {}, r"No path leads from the input nodes \['a'\] to 'c'"),
        ([Edge("a", "b"), Edge("b", "c"), Edge("a", "b")], {}, r"a → b .*once"),
        ([Edge("a", "b"), Edge("b", "c")], {"input_shape": (3, 5)}, r"must be \(channels, rows, columns\)"),
        ([], {"nodes": (Node("a", CONV), Node("a", CONV)), "output": "a"}, "appears more than once"),
        ([], {"nodes": (Node("a.b", CONV),), "inputs": ("a.b",), "output": "a.b"}, "contains a dot"),
    ],
)
def test_a_wrong_graph_is_answered_in_one_sentence(edges, changes, message):
    with pytest.raises(UsageError, match=message):
        _spec(edges, **changes)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Convolution(3, padding=np.array(3)), "Unknown padding of a convolution"),
        (lambda: Convolution(3, padding=(-1, 0)), "padding of a convolution.* at least 0; received -1"),
        (lambda: Convolution(3, padding="sam"), "padding of a convolution 'sam'; did you mean 'same'"),
        (lambda: Convolution(3, (0, 2)), "kernel_size of a convolution .*at least 1; received 0"),
        (lambda: Convolution(3, stride=(1, 1.5)), "stride of a convolution .*whole number.*received 1.5"),
        (lambda: Convolution(3, stride=(2, 1)), r"'same' keeps the grid and needs stride 1; received \[2, 1\]"),
        (lambda: Pool("max", (2, 2), padding=(0, -1)), "padding of a pool .*received -1"),
        (lambda: Pool("average", 6), "size of a pool holds 2 numbers; received 6"),
        (lambda: Pool("mean", (2, 2)), "kind of a pool 'mean'.*'max', 'average'"),
        (lambda: Convolution(3, dropout=-1), "dropout .*at least 0 .*received -1"),
        (lambda: Convolution(3, bias=float("nan")), "bias of a convolution must be a finite number; received nan"),
        (lambda: Convolution(0), "channels .*at least 1; received 0"),
        (lambda: Dense(4, dropout=1.5), "dropout .*at most 1; received 1.5"),
        (lambda: Dense(2.5), "features of a dense layer must be a whole number.*received 2.5"),
        (lambda: Memory("gru", (0, 2)), "kernel_size of a memory .*received 0"),
        (lambda: Memory(tau=float("inf")), "tau of a memory must be a finite number; received inf"),
    ],
)
def test_impossible_sizes_are_refused(make, message):
    with pytest.raises(UsageError, match=message):
        make()


def test_margins_may_be_an_array():
    assert Convolution(3, padding=np.array([1, 0])) == Convolution(3, padding=(1, 0))
    assert Convolution(3, padding=[1, 0]).output_shape((2, 5, 7)) == (3, 6, 6)


@pytest.mark.parametrize(
    ("nodes", "edges", "message"),
    [
        ((Node("a", Convolution(2, (6, 2), padding="valid")),), (), r"'a' has nothing left of a grid of \[5, 7\]"),
        ((Node("a", Dense(4)), Node("b", CONV)), (Edge("a", "b"),), "'b' is a convolution but its inputs have no grid"),
        (
            (Node("a", Dense(4), Memory("gru")),),
            (),
            "'a' has no grid, so it cannot carry the convolutional memory",
        ),
        (
            (Node("a", CONV), Node("b", Dense(4)), Node("c", CONV, shape_from="a")),
            (Edge("a", "b"), Edge("a", "c"), Edge("b", "c")),
            "dense outputs cannot be resized",
        ),
        (
            (Node("a", Convolution(2, padding="valid")), Node("b", CONV)),
            (Edge("a", "b"), Edge("b", "a", feedback=True)),
            None,
        ),
        (
            (Node("a", Convolution(2, padding="valid"), resize=False), Node("b", CONV)),
            (Edge("a", "b"), Edge("b", "a", feedback=True)),
            r"works on a grid of \[5, 7\] and receives \[4, 6\] from b",
        ),
    ],
)
def test_shapes_that_do_not_fit_name_the_node(nodes, edges, message):
    def shapes():
        return GraphSpec(nodes, edges, ("a",), nodes[-1].name, (3, 5, 7)).shapes()

    if message is None:
        assert shapes()[0]["a"] == (3 + 2, 5, 7)
        return
    with pytest.raises(UsageError, match=message):
        shapes()


@settings(max_examples=80)
@given(
    size=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    stride=st.none() | st.tuples(st.integers(1, 4), st.integers(1, 4)),
    grid=st.tuples(st.integers(4, 12), st.integers(4, 12)),
    padded=st.booleans(),
    ceil_mode=st.booleans(),
)
def test_pooled_shapes_equal_pytorchs(size, stride, grid, padded, ceil_mode):
    padding = (size[0] // 2, size[1] // 2) if padded else (0, 0)
    pool = Pool("max", size, stride, padding, ceil_mode)
    layer = nn.MaxPool2d(size, stride, padding, ceil_mode=ceil_mode)
    assert pool.output_shape((2, *grid)) == tuple(layer(zeros(1, 2, *grid)).shape[1:])


@settings(max_examples=60)
@given(
    kernel=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    stride=st.tuples(st.integers(1, 3), st.integers(1, 3)),
    padding=st.just("valid") | st.tuples(st.integers(0, 2), st.integers(0, 2)),
    grid=st.tuples(st.integers(4, 9), st.integers(4, 9)),
)
def test_convolved_shapes_equal_pytorchs(kernel, stride, padding, grid):
    convolution = Convolution(5, kernel, stride, padding)
    layer = nn.Conv2d(3, 5, kernel, stride, padding)
    assert convolution.output_shape((3, *grid)) == tuple(layer(zeros(1, 3, *grid)).shape[1:])


def test_feedback_alone_makes_no_group_but_a_loop_does():
    straight = _spec([Edge("a", "b"), Edge("b", "c")])
    looped = _spec([Edge("a", "b"), Edge("b", "c"), Edge("c", "b", feedback=True)])
    assert straight.groups == (("a",), ("b",), ("c",))
    assert looped.groups == (("a",), ("b", "c"))


def test_an_unknown_memory_names_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'lstm'"):
        Memory("lsmt")


def test_an_unknown_unrolling_names_the_choices():
    with pytest.raises(UsageError, match="'biological', 'full'"):
        _spec([Edge("a", "b"), Edge("b", "c")]).first_response("fully")
