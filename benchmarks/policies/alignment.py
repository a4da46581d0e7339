"""Does a better score against the default recordings go with better read-outs of an object in the hand?

    brainbench stimuli sweep thesis-low procedural-24:4 --out SWEEPS
    python -m benchmarks.policies.alignment --sweeps SWEEPS --out FOLDER [--envs 64] [--seeds 3] [--write]

Every network of the shipped board that can step through a hand's touch is read as an arm of ``brainbench policy probe``
on one rollout: features of the last step, all of the encoder's memory kept, a transformer over its last 22 steps. The
whisker accuracy is that of a ridge classifier on the same features after a sweep, objects left out. One JSON file a
network stands in the folder, and a network that stands there is not measured again. Seeds of one architecture are no
independent networks, so a point is a network (architecture and training), averaged over its seeds. With ``--write`` the
points are kept in ``records``, for :mod:`benchmarks.policies.success`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmarks.report import measure_once, publish, script_parser, table
from brainbench.cli.policy.options import World, agent_of
from brainbench.core.figures.style import COLORS, PALE, panels, save_figure
from brainbench.core.files import read_json, write_json
from brainbench.datasets import WhiskingDataset
from brainbench.models.architecture import Architecture
from brainbench.models.network import EncoderAttenderDecoder
from brainbench.models.registry import load_model
from brainbench.models.streaming import StreamingStep
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid
from robotics_bridge.policies.readouts.arms import without_latency
from robotics_bridge.policies.readouts.probe import ProbeOptions, plain, read_arm, roll_out
from robotics_bridge.policies.readouts.rollout import TARGETS, TouchRollout, calibrate

BOARD = Path(__file__).resolve().parents[2] / "leaderboards" / "results"
PICTURE = Path(__file__).resolve().parents[2] / "docs" / "images" / "policy-alignment.png"
RECORD = Path(__file__).parent / "records" / "networks-in_palm_rotate.json"
"""What was measured last, a row for each network."""
TASK, CONFIG, AGENT = "in_palm_rotate", "careful", "in_palm_rotate.teacher"
WINDOW = 22
"""Steps that a transformer sees, as in its training."""
PERMUTATIONS = 20_000
PENALTIES = np.array([1e-3, 1e-1, 1e1, 1e3])
"""Of the ridge classifier, per sweep."""
_CHUNK = 2048


def board() -> dict[str, dict[str, Any]]:
    """Return the records of the shipped board by model and seed: score, encoder, training and hidden truth."""
    found = {}
    for path in sorted(BOARD.glob("*.json")):
        record = read_json(path)
        score, card = record["score"], record["card"]
        seed = score["provenance"]["settings"].get("weights_seed") or 0
        found[f"{score['name']} seed {seed}"] = {
            "model": score["name"], "seed": seed, "score": score["value"], "training": card["objective"],
            "truth": score["provenance"]["recordings"]["truth"] == score["name"],
        }  # fmt: skip
    return found


def network_of(name: str, seed: int) -> EncoderAttenderDecoder:
    """Return a network of the registry that answers without added latency."""
    network = load_model(name, seed=seed, **without_latency(name))
    assert isinstance(network, EncoderAttenderDecoder)
    return network.eval().requires_grad_(False)


def stream(network: EncoderAttenderDecoder, stimulus: torch.Tensor, rollout: TouchRollout) -> torch.Tensor:
    """Return features [T, B, F] of steps [T, B, 30, 5, 7] in SI, memory forgotten where an episode begins.

    Those of a transformer are zero where nothing is read.
    """
    begun = rollout.begun
    gpt = network.spec.max_steps is not None
    # The encoder alone; a transformer then reads the last steps of it.
    step = StreamingStep(EncoderAttenderDecoder(network.encoder, normaliser=network.normaliser, unroll=network.unroll)
                         if gpt else network)  # fmt: skip
    state, rows = step.init_state(stimulus.shape[1]), []
    for now, first in zip(stimulus, begun, strict=True):
        features, state = step(now, torch.where(first[:, None], 0.0, state))
        rows.append(features)
    found = torch.stack(rows)
    if not gpt:
        return found
    assert network.attender is not None
    age = torch.zeros(begun.shape, dtype=torch.long)
    for number in range(1, len(begun)):
        age[number] = torch.where(begun[number], 0, age[number - 1] + 1)
    seen = torch.zeros(*begun.shape, network.features)
    length = (age + 1).clamp(max=WINDOW)
    for size in length.unique().tolist():
        when, who = ((length == size) & rollout.valid).nonzero(as_tuple=True)
        for times, rows_of in zip(when.split(_CHUNK), who.split(_CHUNK), strict=True):
            window = torch.stack([found[times - back, rows_of] for back in range(size - 1, -1, -1)], 1)
            seen[times, rows_of] = network.attender(window)[:, -1]
    return seen


def accuracy(network: EncoderAttenderDecoder, sweeps: tuple[torch.Tensor, NDArray[Any], NDArray[Any]]) -> float:
    """Return the share of sweeps whose family a ridge classifier names, each fold without its objects."""
    given, labels, folds = sweeps
    features = torch.cat([network.encode(part, last=True) for part in given.split(256)]).double().numpy()
    aims, hits = np.eye(labels.max() + 1)[labels], np.zeros(len(labels), dtype=bool)
    for fold in np.unique(folds):
        test, inner = folds == fold, folds == (fold + 1) % (folds.max() + 1)
        guess = {p: _ridge(features, aims, ~test & ~inner, inner, p).argmax(1) == labels[inner] for p in PENALTIES}
        best = max(guess, key=lambda penalty: guess[penalty].mean())
        hits[test] = _ridge(features, aims, ~test, test, best).argmax(1) == labels[test]
    return float(hits.mean())


def _ridge(x: NDArray[Any], y: NDArray[Any], train: NDArray[Any], test: NDArray[Any], penalty: float) -> NDArray[Any]:
    mean, scale = x[train].mean(0), x[train].std(0)
    used = scale > 1e-7 * scale.max()
    z = (x[:, used] - mean[used]) / scale[used]
    gram = z[train].T @ z[train] / train.sum() + penalty * np.eye(used.sum())
    return z[test] @ np.linalg.solve(gram, z[train].T @ (y[train] - y[train].mean(0)) / train.sum())


def read_sweeps(folder: Path) -> tuple[torch.Tensor, NDArray[Any], NDArray[Any]]:
    """Return sweeps [K, T, 30, 5, 7], their families [K], and folds [K] by object."""
    data = WhiskingDataset(folder, split="all", shuffle=False, batch_size=256)
    parts = list(data)
    objects = np.array(data.objects)
    number = np.array([int(name.rpartition("-")[2]) for name in objects])
    return torch.cat([part.input for part in parts]), torch.cat([part.label for part in parts]).numpy(), number


def partial_spearman(score: NDArray[Any], other: NDArray[Any], given: NDArray[Any] | None) -> tuple[float, float]:
    """Return Spearman's correlation, without what ``given`` explains of the ranks, and its two-sided permutation p.

    Residuals of the scores are permuted over networks (Freedman & Lane 1983); (b + 1)/(n + 1).
    """
    a, b = rankdata(score), rankdata(other)
    design = np.stack([np.ones(len(a)), *([] if given is None else [rankdata(given)])], 1)
    rest = np.eye(len(a)) - design @ np.linalg.pinv(design)
    a, b = rest @ a, rest @ b
    value = float(a @ b / np.sqrt((a @ a) * (b @ b)))
    rng = np.random.default_rng(0)
    drawn = np.stack([rest @ rng.permutation(a) for _ in range(PERMUTATIONS)])
    null = drawn @ b / np.sqrt((drawn**2).sum(1) * (b @ b))
    return value, (1 + int((np.abs(null) >= abs(value) - 1e-12).sum())) / (PERMUTATIONS + 1)


def points(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one point per architecture and training, averaged over seeds."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row["model"], []).append(row)
    return [
        {"model": name, "encoder": Architecture.parse(name).untrained.partition("+")[0], "seeds": len(group),
         "training": group[0]["training"], "truth": group[0]["truth"],
         **{key: float(np.mean([one[key] for one in group])) for key in ("score", "accuracy", *TARGETS)},
         "seed_spread": float(np.std([one["score"] for one in group], ddof=1)) if len(group) > 1 else None}
        for name, group in groups.items()
    ]  # fmt: skip


def correlations(found: list[dict[str, Any]]) -> list[list[str]]:
    """Return a row for each set of networks."""
    untrained = [one for one in found if one["training"] == "untrained"]
    encoders = {one["encoder"]: [other for other in untrained if other["encoder"] == one["encoder"]]
                for one in untrained}  # fmt: skip
    keys = ("score", "accuracy", *TARGETS)
    means = [{key: float(np.mean([one[key] for one in group])) for key in keys} for group in encoders.values()]
    sets = {
        "all": found,
        "all but the hidden network": [one for one in found if not one["truth"]],
        "untrained": untrained,
        "untrained, a point per encoder": means,
    }
    rows = []
    for name, some in sets.items():
        columns = {key: np.array([one[key] for one in some]) for key in keys}
        for given in (None, "accuracy"):
            told = [name, str(len(some)), "–" if given is None else "whisker accuracy"]
            for target in TARGETS:
                value, p = partial_spearman(columns["score"], columns[target], given and columns[given])
                told.append(f"{value:+.2f} (p {p:.3f})")
            if given is None:
                value, p = partial_spearman(columns["score"], columns["accuracy"], None)
            told.append(f"{value:+.2f} (p {p:.3f})" if given is None else "–")
            rows.append(told)
    return rows


def gains(found: list[dict[str, Any]]) -> list[list[str]]:
    """Return by how much each trained network exceeds its untrained twin, in score and in read-outs."""
    by_name = {one["model"]: one for one in found}
    pairs = [(one, twin) for one in found if one["training"] != "untrained"
             and (twin := by_name.get(Architecture.parse(one["model"]).untrained))]  # fmt: skip
    keys = ("score", "accuracy", *TARGETS)
    return [[one["model"], *(f"{one[key] - twin[key]:+.3f}" for key in keys)] for one, twin in pairs]


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return score, whisker accuracy and read-outs of every network."""
    known = board()
    # Every network once before any of them again, slow ones last: an interrupted run has most of them.
    names = sorted((name for name, one in known.items() if one["seed"] < options.seeds
                    and (Architecture.parse(one["model"]).small or options.large)),
                   key=lambda name: (known[name]["seed"], "+gpt" in name))  # fmt: skip
    if options.known:
        return list(measure_once(options.out, names, _unmeasured, known=True).values())
    sweeps = read_sweeps(options.sweeps)
    env = World(TASK, config=CONFIG).make([AGENT], num_envs=options.envs, observe="force_torque")
    policy, grid = agent_of(AGENT, env), TaxelGrid(env.hand)
    calibration = calibrate(env, policy, grid, 0)
    rollout = roll_out(env, policy, ProbeOptions(seconds=options.seconds))
    gain = torch.tensor(calibration.gains(rollout.taxels.shape[2]))[:, None, None]
    stimulus = (grid(rollout.taxels.flatten(0, 1)) * gain).unflatten(0, rollout.taxels.shape[:2])
    return list(measure_once(options.out, names, lambda name: _one(name, rollout, stimulus, sweeps)).values())


def _unmeasured(name: str) -> dict[str, Any]:
    raise AssertionError(name)


@torch.no_grad()
def _one(name: str, rollout: TouchRollout, stimulus: torch.Tensor, sweeps: Any) -> dict[str, Any]:
    known = board()[name]
    network = network_of(known["model"], known["seed"])
    read = plain(read_arm(name, rollout, [stream(network, stimulus, rollout)]))
    row = {**known, "accuracy": accuracy(network, sweeps), **{target: read[target]["r2"] for target in TARGETS}}
    row["intervals"] = {target: [read[target]["low"], read[target]["high"]] for target in TARGETS}
    print(name, {key: round(row[key], 3) for key in ("score", "accuracy", *TARGETS)}, flush=True)
    return row


def draw(found: list[dict[str, Any]]) -> None:
    """Draw each read-out over the board's score, a network a point."""
    figure, axes = panels(1, len(TARGETS), (12.0, 3.4))
    for panel, target in zip(axes[0], TARGETS, strict=True):
        for one in found:
            trained = one["training"] != "untrained"
            color = COLORS[0] if trained else COLORS[1] if "+" in one["model"] else PALE
            panel.plot(
                one["score"], one[target], "*" if one["truth"] else "o", color=color, ms=10 if one["truth"] else 5
            )
        panel.set(title=target, xlabel="score on the board", ylabel="R² on environments left out")
    save_figure(figure, PICTURE, dpi=120)


def main() -> None:
    parser = script_parser(__doc__, notes=True)
    parser.add_argument("--sweeps", type=Path, help="folder of brainbench stimuli sweep")
    parser.add_argument("--known", action="store_true", help="lay out what stands in the folder, measure nothing")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--envs", type=int, default=64)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--seeds", type=int, default=3, help="initial states of each untrained network, at most")
    parser.add_argument("--large", action="store_true", help="networks of published size too")
    options = parser.parse_args()
    if options.sweeps is None and not options.known:
        parser.error("--sweeps names the folder of sweeps on which the whisker accuracy is measured")
    found = sorted(points(measure(options)), key=lambda one: -one["score"])
    keys = ("score", "accuracy", *TARGETS)
    heads = ["score", "whisker accuracy", *TARGETS]
    rows = [[one["model"], str(one["seeds"]), *(f"{one[key]:.3f}" for key in keys)] for one in found]
    spread = [one["seed_spread"] for one in found if one["seed_spread"] is not None]
    others = np.std([one["score"] for one in found if not one["truth"]], ddof=1)
    again = f"; of seeds of one untrained network by {np.mean(spread):.3f}" if spread else ""
    parts = [
        f"{len(found)} networks of the default board, {options.envs} environments of {TASK} for {options.seconds:g} s "
        f"under `{AGENT}`. Without the hidden network, scores differ by {others:.3f} (standard deviation){again}.",
        table(["network", "seeds", *heads], rows),
        "Spearman's correlation of score and read-out over networks, two-sided p of permuted networks:",
        table(["networks", "count", "given", *TARGETS, "score with whisker accuracy"], correlations(found)),
        "Trained networks less their untrained twins:",
        table(["network", *heads], gains(found)),
    ]
    if options.write:
        draw(found)
        write_json(RECORD, found)
    words = f"--sweeps SWEEPS --out FOLDER --envs {options.envs} --seeds {options.seeds}{' --large' * options.large}"
    publish(options, "Scores of networks and read-outs of touch", "\n\n".join(parts), words)


if __name__ == "__main__":
    main()
