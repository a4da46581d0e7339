"""Write and execute the notebook of the documentation.

    PYTHONPATH=. python docs/notebooks/build.py [--out FILE]

The cells stand here, so that they are read and changed as text; the committed notebook holds what they gave.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path

NOTEBOOK = Path(__file__).with_name("from-simulation-to-leaderboard.ipynb")

CELLS: tuple[tuple[str, str], ...] = (
    (
        "markdown",
        """# From simulation to leaderboard

This notebook shows the main steps of brainbench in Python: whiskers touch an object, networks process the forces, the
networks' activity is compared with that of (synthetic) animals, and the scores become a leaderboard. No network connection
is needed. The recordings are synthetic, so the scores are no evidence about real brains.""",
    ),
    (
        "markdown",
        """## 1. Whiskers on an object

A scene is an array, objects and a motion. Four whiskers of row C whisk against a pole. Lengths in scene
files are in mm; all results are in SI units.""",
    ),
    (
        "code",
        """from pathlib import Path

from brainbench.stimuli import load_scene, simulate

Path("pole.toml").write_text('''
description = "A pole, near and far"
[array]
species = "mouse"
[whisking]
frequency_hz = 20
protraction_deg = 30
retraction_deg = 10
onset_ms = 50
[frames]
first_ms = 1
interval_ms = 9
count = 22
[[scene]]
label = "near"
[[scene.object]]
shape = "cylinder"
radius_mm = 0.5
height_mm = 20
position_mm = [10, 5, 0]
[[scene]]
label = "far"
[[scene.object]]
shape = "cylinder"
radius_mm = 0.5
height_mm = 20
position_mm = [12, 6, 0]
''')

felt = simulate(load_scene("pole.toml", whiskers="C0-C3").scenes, fidelity="fast")
print(dict(felt["wrench"].sizes), felt["wrench"].units)""",
    ),
    (
        "markdown",
        """The result is the force (three components) and the moment (three components) of each whisker on its base. Here is the moment
of the whisker with the largest one, for both distances.""",
    ),
    (
        "code",
        """import matplotlib.pyplot as plt
import numpy as np

moments = felt["wrench"].sel(channel=["Mx", "My", "Mz"])
moment = np.linalg.norm(moments, axis=-1) * 1e6  # µN·m
most = int(np.nanmax(moment, axis=(0, 1)).argmax())
figure, axes = plt.subplots(figsize=(6, 2.4), layout="constrained")
for index, label in enumerate(felt["stimulus"].values):
    axes.plot(felt["time"] * 1e3, moment[index, :, most], label=str(label))
axes.set(xlabel="time (ms)", ylabel="moment (µN·m)", title=f"whisker {felt['whisker'].values[most]}")
axes.legend(frameon=False)
axes.spines[["top", "right"]].set_visible(False)
plt.show()""",
    ),
    (
        "markdown",
        """## 2. A network processes the forces

The recipe `objects` is 40 procedural objects that are swept past twelve whiskers. A model maps [B, T, C, H, W] to a class; each
of its layers can be compared with the animals.""",
    ),
    (
        "code",
        """from brainbench import extract, load_model
from brainbench.stimuli import load_stimuli

stimuli = load_stimuli("objects")
model = load_model("zhuang-intersection-ln-small", seed=0)
activations = extract(model, stimuli.input)
{layer: values.shape for layer, values in activations.items()}""",
    ),
    (
        "code",
        """from brainbench.metrics import RDM, rdm

values = activations["encoder.fc7"].mean(axis=1)  # over time
RDM(rdm(values), stimuli.labels, title="encoder.fc7")""",
    ),
    (
        "markdown",
        """## 3. The score

Now the model is compared with the animals that felt these objects. For each animal the layer is chosen on the other animals,
and the comparison is corrected for noise in its recordings. The score lies between chance (0) and all that is reliable (1); its
interval is over animals and stimuli. The permutation p repeats the choice of layer for every order of the stimuli.""",
    ),
    (
        "code",
        """from brainbench.scoring.scores import score_record

record = score_record("zhuang-intersection-ln-small", seed=0)
record.score""",
    ),
    (
        "code",
        """print(record.score.layer, "was chosen:", record.score.layer_rule)
for item in record.score.provenance.statistics["layer_tests"]:
    print(f"{item['layer']:15} p = {item['p']:.3f}, of the best layer {item['p_corrected']:.3f}")""",
    ),
    (
        "markdown",
        """## 4. The animals

Each animal has an RDM and a reliability: how well random halves of its trials agree. Animals with a low reliability are left
out.""",
    ),
    (
        "code",
        """for animal in record.score.subjects:
    print(f"{animal.subject}: {animal.units} units, {animal.trials} trials, "
          f"reliability {animal.reliability:.2f}, score {animal.value:.2f} with {animal.layer}")
RDM(record.score.brain_rdm, record.score.stimuli, title="mean over animals")""",
    ),
    ("code", """RDM(record.score.model_rdm, record.score.stimuli, title=f"model, {record.score.layer}")"""),
    (
        "markdown",
        """Is the model as similar to the animals as they are to one another? And how similar is it if the effect of the number of
contacts is removed? The second question needs recordings in which it differs, such as the six stimuli of `demo-rodgers`.""",
    ),
    (
        "code",
        """from brainbench.metrics.inference.equivalence import turing_test

print(turing_test(record.score, record.animal_to_animal).summary())
beyond = score_record("zhuang-intersection-ln-small", recordings="demo-rodgers", metric="rsa-partial",
                      baselines=False)
print(beyond.score.summary())
print(beyond.score.provenance.statistics["variance_partition"])""",
    ),
    (
        "markdown",
        """## 5. A leaderboard

Each score is saved as a record, one JSON file. A folder of records is a leaderboard. The neurons of `demo` mix the units of
`resnet18-small+gpt.simclr`, so this network should come first.""",
    ),
    (
        "code",
        """from leaderboards import build_leaderboard, rank, read_records, write_record

write_record(record, "results")
for name in ("resnet18-small+gpt.simclr", "s4-small"):
    write_record(score_record(name, seed=0), "results")
(board,) = rank(stored.record for stored in read_records("results"))
for entry in board.entries:
    print(entry.rank, entry.standing, entry.score.summary())""",
    ),
    (
        "code",
        """build_leaderboard(read_records("results"), "site")
sorted(str(path) for path in Path("site").rglob("*.html"))""",
    ),
    (
        "markdown",
        """Open `site/index.html` in a browser. Next steps: [real recordings](../recordings.md), [your own
network](../add-a-model.md), [training](../models.md), [what the statistics claim](../statistics.md).""",
    ),
)


def make(folder: Path) -> object:
    """Return the notebook, executed in an empty ``folder``.

    Raises:
        nbclient.exceptions.CellExecutionError: a cell fails.
    """
    import nbformat
    from nbclient import NotebookClient

    cells = [
        nbformat.v4.new_markdown_cell(text, id=f"cell-{index}")
        if kind == "markdown"
        else nbformat.v4.new_code_cell(text, id=f"cell-{index}")
        for index, (kind, text) in enumerate(CELLS)
    ]
    notebook = nbformat.v4.new_notebook(cells=cells)
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        # Times of execution would change at every build.
        cell.metadata.pop("execution", None)
    return notebook


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=NOTEBOOK)
    options = parser.parse_args()
    import nbformat

    # The kernel starts in an empty folder and must find the package of this checkout.
    os.environ["PYTHONPATH"] = str(Path(__file__).parents[2])
    with tempfile.TemporaryDirectory() as folder:
        nbformat.write(make(Path(folder)), options.out)
    print(options.out)


if __name__ == "__main__":
    main()
