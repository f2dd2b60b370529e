"""Every page of the documentation: its code runs, its names exist, its lines are short.

A fenced block is run by its language (`CHECKS`), or says why not in the line above it:
`<!-- not run: needs 3D-FRONT -->`.
"""

import ast
import json
import re
import runpy
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import yaml
from golden_values import TAKE
from pages import PAGES, ROOT, Block, blocks_of, commands_of, name_of
from typer.main import get_command

from data_prep.front.recipe import load_recipe
from sceneprior.apps.cli.commands import app
from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.comparison import load_comparison
from sceneprior.apps.sample import load_request
from sceneprior.core.scene_json import read_scene

LONGEST_LINE = 110

RUN_ELSEWHERE = {("docs/posed_data.md", "python"): "tests/data_prep/readers/test_posed_docs.py"}
"""Blocks that another test executes, because they need more than toy shards."""
BASES = [
    ROOT / name for name in ("", "sceneprior", "docs", "configs", "benchmarks", "data_prep/engine")
]
"""Folders to which paths in pages are relative."""
SHIPPED = {path.stem for path in (ROOT / "sceneprior/apps/priors").glob("*.prior")}
MADE_BY_USERS = {"config.yaml", "hparams.yaml"}
"""Names of YAML files that are no part of the repository."""


ALL_BLOCKS = [block for page in PAGES for block in blocks_of(page)]
BLOCKS = [block for block in ALL_BLOCKS if not block.not_run]


def block_id(block: Block) -> str:
    return f"{name_of(block.page)}:{block.line}"


# -- Commands --------------------------------------------------------------------------------------


def values_of(option: str, words: list[str]) -> tuple[str, ...]:
    return tuple(words[k + 1] for k, word in enumerate(words) if word == option)


def check_sceneprior(words: list[str], folder: Path) -> None:
    """The command and all its options exist; configs are shipped, and `--set` fits them."""
    commands = get_command(app).commands
    assert words[1] in commands, f"no command `sceneprior {words[1]}`"
    try:
        commands[words[1]].make_context(words[1], words[2:])
    except Exception as error:  # typer's usage errors, which are click's own or a copy of them
        pytest.fail(f"{shlex.join(words)}: {error}")
    if words[1] in ("evaluate", "eval-fid", "eval-svr") and {*values_of("--run", words)} & SHIPPED:
        assert "--out" in words, f"{shlex.join(words)}: a shipped prior has no folder for scores"
    for config in values_of("--config", words):
        written = folder / config
        source = str(written if written.is_file() else config)
        if words[1] == "compare":
            load_comparison(source)
        else:
            load_config(source, values_of("--set", words))


def check_shell(block: Block, folder: Path) -> None:
    """Commands, scripts and their options, and targets of the Makefile exist."""
    for words in commands_of(block.text):
        match words[0]:
            case "sceneprior":
                check_sceneprior(words, folder)
            case "python":
                source = (ROOT / words[1]).read_text()
                for option in (word for word in words[2:] if word.startswith("-")):
                    assert f'"{option}"' in source, f"{words[1]} has no option {option}"
            case "make":
                makefile = (ROOT / "Makefile").read_text()
                assert re.search(rf"^{words[1]}:", makefile, re.MULTILINE), words
            case "export":
                assert all("=" in word for word in words[1:]), words
            case _:
                pytest.fail(f"`{shlex.join(words)}` is not run; say why above the block")


# -- Other languages -------------------------------------------------------------------------------


def check_python(block: Block, folder: Path) -> None:
    """The block runs in a folder where `out/demo/shards` are toy rooms, and `out/demo/run` a tiny
    run."""
    if (other := RUN_ELSEWHERE.get((name_of(block.page), "python"))) is not None:
        assert block.page.name in (ROOT / other).read_text()
        return
    exec(compile(block.text, block_id(block), "exec"), {})


def check_json(block: Block, folder: Path) -> None:
    """JSON of a scene, or of a request, is read as one."""
    if json.loads(block.text)["format"] == "sceneprior-request":
        (folder / "request.json").write_text(block.text)
        assert load_request(folder / "request.json")["want"]
        return
    assert json.loads(block.text)["format"] == "sceneprior-scene"
    path = folder / "scene.json"
    path.write_text(block.text)
    assert read_scene(path).objects


def check_yaml(block: Block, folder: Path) -> None:
    """A comparison, a run's config or a section of one, a recipe."""
    data = yaml.safe_load(block.text)
    path = folder / "block.yaml"
    path.write_text(block.text)
    if "methods" in data:
        load_comparison(str(path))
    elif "method" in data:
        load_config(str(path))
    elif "room_types" in data:
        load_recipe(str(path))
    else:
        load_config("demo.yaml", tuple(f"{key}={json.dumps(value)}" for key, value in data.items()))


def check_drawing(block: Block, folder: Path) -> None:
    """Only the architecture is drawn; `test_the_tree_is_the_files` reads the tree."""
    assert name_of(block.page) == "docs/architecture.md"


CHECKS = {
    "": check_shell, "bash": check_shell, "sh": check_shell, "python": check_python,
    "json": check_json, "yaml": check_yaml, "text": check_drawing,
}  # fmt: skip
"""The check of a block, by its language; a block without a language holds commands."""


@pytest.mark.parametrize("block", BLOCKS, ids=block_id)
def test_every_block_runs(block: Block, tmp_path: Path, toy_shards: Path, monkeypatch, request):
    (tmp_path / "out" / "demo").mkdir(parents=True)
    (tmp_path / "out" / "demo" / "shards").symlink_to(toy_shards)
    if block.language == "python" and "out/demo/run" in block.text:
        run = request.getfixturevalue("toy_run")
        (tmp_path / "out" / "demo" / "run").symlink_to(run)
    for other in blocks_of(block.page):  # a page may show a config, then train with it
        if shown := re.match(r"# (\S+\.yaml)\n", other.text):
            (tmp_path / shown[1]).write_text(other.text)
    monkeypatch.chdir(tmp_path)
    assert block.language in CHECKS, f"no way to run '{block.language}'; say why above the block"
    CHECKS[block.language](block, tmp_path)


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path):
    """Strictly: links, anchors, the menu; nothing on its pages is fetched from a network."""
    pytest.importorskip("mkdocs", reason="no mkdocs here: pip install -e '.[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    for page in tmp_path.rglob("*.html"):
        fetched = re.findall(
            r"<(?:script|img|link)[^>]+(?:src|href)=\"(https?:[^\"]+)", page.read_text()
        )
        assert fetched == [], page.name
    commands = (tmp_path / "cli.html").read_text()
    assert [
        name for name in get_command(app).commands if f"sceneprior {name}" not in commands
    ] == []
    assert "Prior" in (tmp_path / "api.html").read_text()


def test_every_command_is_in_the_reference():
    """The page that the site makes from the commands' help has each, with what it does."""
    pytest.importorskip("mkdocs", reason="no mkdocs here: pip install -e '.[docs]'")
    page = runpy.run_path(str(ROOT / "docs/hooks.py"))["commands_page"]()
    told = dict(re.findall(r"^## `sceneprior ([a-z-]+)`\n\n(.+)$", page, re.MULTILINE))
    assert set(told) == set(get_command(app).commands)
    assert all(words.endswith((".", ":")) and len(words) > 20 for words in told.values()), told


# -- Names -----------------------------------------------------------------------------------------

PATH = re.compile(r"`([\w./-]+(?:\.py|\.yaml|\.csv|/))`")
"""A file or a folder of ours in the text of a page."""


def test_the_page_of_settings_is_what_its_script_makes():
    made = runpy.run_path(str(ROOT / "docs/write_configuration.py"))["page"]()
    if TAKE:
        (ROOT / "docs/configuration.md").write_text(made)
    assert made == (ROOT / "docs/configuration.md").read_text()


def find(path: str) -> Path | None:
    found = (base / path for base in BASES if (base / path).exists())
    return next(found, None)


def is_ours(path: str) -> bool:
    """True if a path names a file of the repository, rather than one of the user's."""
    return path.endswith((".py", ".yaml")) or path.split("/")[0] in (
        "sceneprior", "data_prep", "configs", "tests", "docs", "benchmarks", "baselines",
        "evaluation", "training", "models", "losses", "silhouettes", "cli",
    )  # fmt: skip


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_path_exists(page: Path):
    shown = {block.text.splitlines()[0].removeprefix("# ") for block in blocks_of(page)}
    missing = {
        path
        for path in PATH.findall(page.read_text())
        if is_ours(path) and find(path) is None and path not in MADE_BY_USERS | shown
    }
    # A module may be named alone after its folder.
    folders = [found for path in PATH.findall(page.read_text()) if (found := find(path))]
    near = {path for path in missing if any((folder / path).is_file() for folder in folders)}
    assert not missing - near


@cache
def names_in(path: Path) -> frozenset[str]:
    """Functions, classes, their members and constants of a module, members as `Class.member`."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        for name in defined(node):
            found.add(name)
            if isinstance(node, ast.ClassDef):
                members = {member for part in node.body for member in defined(part)}
                members |= set(re.findall(r"self\.(\w+)\b", ast.unparse(node)))
                found |= {f"{name}.{member}" for member in members}
    return frozenset(found)


def defined(node: ast.stmt) -> list[str]:
    match node:
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            return [name]
        case ast.Assign(targets=targets):
            return [target.id for target in targets if isinstance(target, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)):
            return [name]
    return []


def rows_with_code(page: Path) -> list[list[str]]:
    """The first two or three cells of table rows, as lists of backticked words."""
    rows = [line.strip("|").split("|") for line in page.read_text().splitlines() if line[:1] == "|"]
    return [re.findall(r"`([^`]+)`", " ".join(row[1:3])) for row in rows]


@pytest.mark.parametrize("name", ["paper_map.md", "architecture.md"])
def test_every_function_is_where_the_page_says(name: str):
    checked = 0
    for words in rows_with_code(ROOT / "docs" / name):
        module: Path | None = None
        for word in words:
            if word.endswith(".py"):
                module = find(word)
                assert module is not None, word
            elif re.fullmatch(r"[A-Za-z_]\w*(\.\w+)?", word) and module is not None:
                assert word in names_in(module), f"no {word} in {module.relative_to(ROOT)}"
                checked += 1
    assert checked >= {"paper_map.md": 30, "architecture.md": 3}[name]


def test_every_key_of_the_paper_map_is_one():
    """`section.key: value`, in the form in which the page has it, changes a config."""
    sections = "data|model|loss|layout|shape|sampling|samples"
    text = (ROOT / "docs" / "paper_map.md").read_text()
    keys = re.findall(rf"`((?:{sections})[\w.]*: [^`]+)`", text)
    assert len(keys) > 20
    for key in sorted(set(keys)):
        load_config("bedroom.yaml", (key.replace(": ", "=", 1),))
    named = set(re.findall(rf"`((?:{sections})\.[\w.]+)`", text))
    data = load_config("bedroom.yaml").model_dump(by_alias=True)
    for name in named:
        value = data
        for part in name.split("."):
            assert part in value, name
            value = value[part]


def test_the_tree_is_the_files():
    """Each folder of the drawing names all its modules, and no others."""
    drawn = tree_of(next(b for b in ALL_BLOCKS if block_id(b).startswith("docs/architecture.md")))
    wrong = {}
    for folder, names in drawn.items():
        files = {path.stem for path in (ROOT / folder).glob("*.py")} - {"__init__", "__main__"}
        if files != names:
            wrong[folder] = f"not drawn: {sorted(files - names)}; gone: {sorted(names - files)}"
    assert not wrong
    packages = {
        path.parent.relative_to(ROOT).as_posix()
        for top in ("sceneprior", "data_prep")
        for path in (ROOT / top).rglob("__init__.py")
    }
    assert packages <= set(drawn)


def tree_of(block: Block) -> dict[str, set[str]]:
    """Folder -> the modules that its entry names, before the colon."""
    entries: list[tuple[int, str, str]] = []
    for line in block.text.splitlines():
        if entry := re.match(r"( *)(\w+)/ +(.*)", line):
            entries.append((len(entry[1]), entry[2], entry[3]))
        else:
            depth, folder, text = entries[-1]
            entries[-1] = (depth, folder, f"{text} {line.strip()}")
    drawn, parents = {}, [""]
    for depth, folder, text in entries:
        parents = [*parents[: depth // 2], folder]
        path = ROOT.joinpath(*parents)
        assert path.is_dir(), f"no folder {'/'.join(parents)}"
        if (path / "__init__.py").is_file():
            drawn["/".join(parents)] = set(text.partition(":")[0].split())
    return drawn


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=name_of)
def test_links_lead_somewhere(page: Path):
    links = re.findall(r"\]\(([^)\s]+)\)", page.read_text())
    for link in links:
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors_of(target), link


def anchors_of(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CHANGELOG.md"], ids=name_of)
def test_lines_are_short(page: Path):
    lines = enumerate(page.read_text().splitlines(), start=1)
    assert [n for n, line in lines if len(line) > LONGEST_LINE and line[:1] != "|"] == []
