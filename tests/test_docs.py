"""What the documentation shows, works."""

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)


def test_the_recordings_page_writes_a_file_that_can_be_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from brainbench.datasets import open_recordings

    monkeypatch.chdir(tmp_path)
    for block in _blocks("docs/recordings.md", "python"):
        exec(compile(block, "docs/recordings.md", "exec"), {})
    dataset = open_recordings("mouse-1.h5", conditions="trials:stimulus")
    assert dataset.attrs["vocabulary"] == ["a", "b", "c", "d", "e"]
    assert dataset.sizes["unit"] == 20


def test_the_scene_files_of_the_stimuli_page_are_valid(tmp_path: Path):
    import numpy as np

    from brainbench.stimuli import load_scene
    from tests.factories.whisker_tracks import bent_shapes, write_points

    poles, measured, bent, trials = (tmp_path / f"{name}.toml" for name in ("pole", "measured", "bent", "trials"))
    scene_file, tables, bends, filmed = _blocks("docs/stimuli.md", "toml")
    for path, block in (
        (poles, scene_file),
        (measured, scene_file + tables),
        (bent, scene_file + bends),
        (trials, filmed),
    ):
        path.write_text(block)
    assert load_scene(bent).scenes[0].array["C2"].whisker.rest_points([0.015])[0, 2] > 5e-5
    assert [scene.label for scene in load_scene(poles).scenes] == ["near", "far"]
    array = load_scene(measured).scenes[0].array
    assert array["C2"].whisker.radius(0.005) == pytest.approx(31e-6)
    assert array["C1"].whisker == load_scene(poles).scenes[0].array["C1"].whisker
    (tmp_path / "tracks").mkdir()
    for trial in ("1", "2"):
        table = write_points(tmp_path / "tracks" / f"{trial}.csv", bent_shapes(frames=500))
        head, *rows = table.read_text().splitlines()
        both = [f"{row},{whisker}" for whisker in (0, 1) for row in rows]
        table.write_text("\n".join([f"{head},whisker", *both]))
    scenes = load_scene(trials).scenes
    assert [scene.label for scene in scenes] == ["1", "2"]
    assert np.ptp(scenes[0].jobs()[1].follicle.pose(scenes[0].frames.times)[1][:, 0]) == pytest.approx(0.6, abs=0.02)


def test_the_data_set_of_the_datasets_page_can_be_made_and_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from brainbench.datasets import WhiskingDataset

    monkeypatch.chdir(tmp_path)
    made: dict[str, Any] = {}
    exec(compile(_blocks("docs/datasets.md", "python")[0], "docs/datasets.md", "exec"), made)
    assert made["manifest"]["sweeps"] == WhiskingDataset("mine", split="all").sweeps == 6


PAGES = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md"))


FRONT = ("README.md", "CONTRIBUTING.md", "RELEASING.md")
OTHERS = (
    ".github/pull_request_template.md", "CHANGELOG.md", "SECURITY.md", "benchmarks/README.md", "benchmarks/RESULTS.md",
    "leaderboards/policies/README.md", "leaderboards/results/README.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs" / "notebooks" / "sources").glob("*.md")),
)  # fmt: skip


def _slugs(page: Path) -> set[str]:
    """Return the anchors of a page that both the repository host and the site give to its headings."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    slugs = set()
    for title in re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", title).replace("`", "").strip().lower()
        host = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        slugs |= {host} & {re.sub(r"[-\s]+", "-", host)}
    return slugs


@pytest.mark.parametrize("page", [*FRONT, *PAGES, *OTHERS])
def test_links_lead_to_files_and_headings_of_the_repository(page: str):
    text = re.sub(r"```.*?```|`[^`\n]*`", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    # The cells of a notebook stand where the notebook is written.
    folder = ROOT / "docs" / "notebooks" if "/sources/" in page else (ROOT / page).parent
    for target, anchor in re.findall(r"\]\(([^)#:]*)(?:#([^)]*))?\)", text):
        path = (folder / target) if target else ROOT / page
        assert path.exists(), f"{page} links to {target}, which does not exist"
        if anchor and path.suffix == ".md":
            assert anchor in _slugs(path), f"{page} links to {target}#{anchor}; its headings are {sorted(_slugs(path))}"


@pytest.mark.parametrize("page", [*FRONT, *PAGES])
def test_a_page_needs_no_renderer_of_its_own(page: str):
    text = re.sub(r"```.*?```|`[^`\n]*`", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    # Admonitions, tabs, attributes, generated documentation and snippets of mkdocs are plain characters elsewhere.
    alien = re.findall(r"^(?:!!!|\?\?\?|===|:::).*|\{[:#.][^}]*\}|--8<--|\[\[.*?\]\]", text, flags=re.MULTILINE)
    assert not alien, f"{page}: only the site renders {alien[0]!r}"


@pytest.mark.parametrize("page", [*FRONT, *PAGES, *(page for page in OTHERS if page != "CHANGELOG.md")])
def test_commands_and_options_of_a_page_exist(page: str):
    for line in _commands(page):
        command, words = _program(), shlex.split(line, comments=True)[1:]
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        assert not getattr(command, "commands", None) or not words or words[0].startswith("-"), f"{page}: {line}"
        known = {name for param in command.params for name in (*param.opts, *param.secondary_opts)} | {"--help"}
        used = {word.partition("=")[0] for word in words if re.fullmatch(r"--?[a-z][a-z-]*(=.*)?", word)}
        assert used <= known, f"{page}: {line} has {sorted(used - known)}; known are {sorted(known)}"


@cache
def _program() -> Any:
    import typer

    from brainbench.cli import app

    return typer.main.get_command(app)


def _commands(page: str) -> list[str]:
    text = re.sub(r"```.*?```", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    found = re.findall(r"`(brainbench [^`\[…|]+)`", text)
    indented = "\n".join(re.findall(r"^    (.+)$", text, flags=re.MULTILINE))
    for block in (*_blocks(page, "bash"), indented):
        for line in block.replace("\\\n", " ").splitlines():
            parts = re.split(r"&&|\|\|?", line.partition("#")[0])
            found += [part.strip() for part in parts if part.strip().startswith("brainbench ")]
    return found


PRELUDES = {
    "docs/export.md": "import torch\nstimuli = torch.zeros(2, 22, 30, 5, 7)",
    "docs/whiskit.md": "from brainbench.published import whiskit\nfrom brainbench.stimuli import WhiskerArray\n"
    "whiskit.save_parameters(WhiskerArray.rat(), 'whisker_param_average_rat/')",
}
"""What a page takes for granted."""

ELSEWHERE = ("docs/recordings.md", "docs/statistics.md", "docs/datasets.md")
"""Pages whose code other tests here run."""

SLOW = ("docs/rods.md", "docs/tactile-hands.md")


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else [])
        for page in PAGES
        if page not in ELSEWHERE and _blocks(page, "python")
    ],
)
def test_the_code_of_a_page_runs_from_top_to_bottom(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, registry, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(PRELUDES.get(page, ""), page, "exec"), names)
    text = (ROOT / page).read_text(encoding="utf-8")
    # A block of text right after one of code is what that code prints.
    for block, shown in re.findall(r"```python\n(.*?)```\n(?:\n```text\n(.*?)```\n)?", text, flags=re.DOTALL):
        capsys.readouterr()
        exec(compile(block, page, "exec"), names)
        assert not shown or capsys.readouterr().out == shown
    if page == "docs/score.md":
        assert names["record"].score.layer == "rotated"
        assert names["record"].score.p < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "commands"),
    [
        ("docs/score.md", ["score zhuang-small"]),
        ("docs/stimuli.md", ["stimuli simulate"]),
        ("docs/recordings.md", ["recordings inspect"]),
        ("docs/two-photon.md", ["recordings inspect", "recordings rdm", "score zhuang-small"]),
    ],
)
def test_what_a_page_prints_is_printed(page: str, commands: list[str], tmp_path: Path):
    from brainbench.scoring.demo import demo_recordings

    # The page on recordings shows the first of these.
    example = min(demo_recordings("demo-rodgers").glob("*.nwb"))
    (tmp_path / "poles.toml").write_text("".join(_blocks(page, "toml")[:1]))

    def run(*words: str) -> str:
        options: dict[str, Any] = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}}
        return subprocess.run([sys.executable, *words], check=True, capture_output=True, text=True, **options).stdout

    if page == "docs/two-photon.md":
        run("-c", _blocks(page, "py")[0])
    blocks = re.findall(r"```(\w*)\n(.*?)```", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL)
    pairs = [(code, shown) for (kind, code), (after, shown) in pairwise(blocks) if (kind, after) == ("bash", "text")]
    for command, (code, shown) in zip(commands, pairs, strict=False):
        line = next(line for line in code.splitlines() if line.startswith(f"brainbench {command}"))
        words = shlex.split(line.replace("data/mouse-1.nwb", str(example)), comments=True)
        printed = {" ".join(line.split()) for line in run("-m", *words).splitlines()}
        assert not {" ".join(line.split()) for line in shown.splitlines()} - printed, line


@pytest.fixture
def registry(monkeypatch: pytest.MonkeyPatch):
    from brainbench import list_models
    from brainbench.models import registry

    list_models()
    monkeypatch.setattr(registry, "_records", dict(registry._records))


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_asks_nothing_of_the_network(tmp_path: Path):
    pytest.importorskip("material")
    pytest.importorskip("mkdocstrings_handlers.python")
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in tmp_path.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="(https?:[^"]+)', text)
        loaded += re.findall(r'<link[^>]*rel="(?:stylesheet|preconnect|preload)"[^>]*href="(https?:[^"]+)', text)
        assert not loaded, f"{page.name} loads {loaded[0]}"
    assert "permuted" in (tmp_path / "api" / "metrics.html").read_text(encoding="utf-8")
    for page in (tmp_path / "api").glob("*.html"):
        assert "doc-heading" in page.read_text(encoding="utf-8"), f"{page} is empty"


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "docs/notebooks/sources").glob("*.md")))
def test_a_notebook_runs_and_gives_what_is_shown(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    spec = importlib.util.spec_from_file_location("build_notebook", ROOT / "docs" / "notebooks" / "build.py")
    assert spec is not None
    assert spec.loader is not None
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    shown = nbformat.read(build.FOLDER / f"{name}.ipynb", as_version=4)
    sources = [(cell.cell_type, cell.source) for cell in shown.cells]
    assert sources == build.cells(name), f"run docs/notebooks/build.py {name} anew"
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    made = build.make(name, tmp_path)
    for old, new in zip(shown.cells, made.cells, strict=True):
        if new.cell_type == "code":
            # A line on stderr cuts what is printed into two outputs.
            kinds = [
                [kind for kind, _ in groupby(out.output_type for out in cell.outputs if out.get("name") != "stderr")]
                for cell in (old, new)
            ]
            assert kinds[0] == kinds[1]


def test_the_metric_of_the_statistics_page_scores(tmp_path: Path):
    import numpy as np

    from brainbench.core.contracts import Trials
    from brainbench.metrics import get_metric

    (block,) = _blocks("docs/statistics.md", "python")
    path = tmp_path / "mine.py"
    path.write_text(block, encoding="utf-8")
    metric = get_metric(f"{path}:NearestNeighbour")
    rng = np.random.default_rng(0)
    latent, labels = rng.normal(size=(6, 3)), np.repeat(np.arange(6), 6)
    trials = [Trials((latent @ rng.normal(size=(3, 20)))[labels] + rng.normal(size=(36, 20)), labels) for _ in "abc"]
    animals = [metric.animal(str(i), [block], 6) for i, block in enumerate(trials)]
    score = metric.score({"same": latent}, animals, name="x", stimuli=list("abcdef"))
    assert score.value > 0.5
