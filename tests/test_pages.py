"""Every block of code of README and docs runs, or is named here with the test that stands for it.

The blocks of a page are run one after the other, as a reader types them, in a folder of their own
that holds links to `cases` and `examples`. What a block is says the word behind its fence:

    python    is run; all blocks of a page share their names
    sh        a command a line: livepde, a Python file, or what ELSEWHERE names
    toml      is a case file, or a part of one
    csv, json are read
    text      is what the block before it printed

A block with title="FILE" is a file of that name for the blocks after it.
"""

import ast
import contextlib
import csv
import doctest
import importlib
import io
import json
import os
import re
import runpy
import shlex
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

from benchmarks.__main__ import app as benchmarks
from experiments.__main__ import app as experiments
from livepde.cases.read import read_spec
from livepde.cli import app
from livepde.errors import LivepdeError
from livepde.reproduce import EXPERIMENTS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
FENCE = re.compile(
    r'^```(?P<kind>\w*)(?: title="(?P<title>[^"]+)")?\n(?P<text>.*?)^```$', re.MULTILINE | re.DOTALL
)
ALIKE = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
COMPLETES = ROOT / "cases" / "soil_layers.toml"  # gives what a part of a case leaves out

# Commands that need minutes, a broker, several ranks, or that go on for ever: the beginnings of
# those for which a test stands. `.ci/run` calls make; what installs is tried with the packages.
ELSEWHERE = {
    "test_pages.py": ["make", "python3 -m venv .venv", ". .venv/bin/activate", "pip install"],
    "test_cli.py": ["python -m benchmarks step"],
    "test_block_solver.py": ["python -m benchmarks scale"],
    "test_benchmarks.py::test_a_quick_run_ends_with_its_checks": [
        "python -m benchmarks fleet",
        "python -m benchmarks import",
        "python -m benchmarks peers",
    ],
    "test_benchmarks.py::test_steps_are_ratios": ["python -m benchmarks.suite.costs"],
    "test_compare.py::test_the_program_finds_the_fault_from_a_case_and_from_a_run": [
        "livepde compare"
    ],
    "test_dashboard.py::test_watch_says_where_and_ends_with_ctrl_c": ["livepde watch"],
    "test_dashboard.py::test_the_page_follows_a_run_and_looks_back": [
        "livepde run mycase/case.toml --watch"
    ],
    "test_dashboard.py::test_a_solid_is_drawn_and_a_token_is_asked_for": [
        "LIVEPDE_TOKEN=... livepde watch"
    ],
    "test_service.py::test_a_run_follows_a_file_stops_gracefully_and_resumes": [
        "livepde run case.toml"
    ],
    "test_end_to_end.py::test_soil_from_a_broker_to_a_browser": [
        "livepde run cases/soil_layers.toml --realtime"
    ],
    "test_petsc.py::test_examples_find_their_truth_on_two_ranks": [
        "mpirun -n 4 /opt/livepde/bin/python",
        "mpirun -n 4 python -m mpi4py",
        "deploy/petsc.sh",
    ],
    "test_deploy.py::test_the_unit_is_one": [
        "useradd --system",
        "python3.11 -m venv /opt",
        "install -",
        "cp deploy/",
        "systemctl",
    ],
    "test_deploy.py::test_options_exist": ["docker build", "LIVEPDE_TOKEN=$(openssl"],
}
PROGRAMS = {"python -m benchmarks ": benchmarks, "python -m experiments ": experiments}
BEGINNINGS = [start for several in ELSEWHERE.values() for start in several]


@dataclass(frozen=True)
class Block:
    """One block of code, with the lines before it, so that errors have the page's line."""

    kind: str
    title: str | None
    text: str
    above: int

    @property
    def commands(self) -> list[str]:
        """The lines of a block of commands."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [line for line in lines if shlex.split(line, comments=True)]


@dataclass
class Session:
    """What a reader has in front of him: names, and what was printed last."""

    page: Path
    names: dict[str, Any] = field(default_factory=lambda: {"__name__": "__main__"})
    printed: str | None = None
    refused: str = ""

    def run(self, block: Block) -> None:
        if block.title is not None:
            Path(block.title).write_text(block.text, encoding="utf-8")
        if block.kind != "text":
            self.end()
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            getattr(self, f"_{block.kind}")(block)
        self.printed = printed.getvalue() if block.kind in ("python", "sh") else None

    def end(self) -> None:
        """What was refused has to be shown in the text that follows."""
        assert not self.refused, self.refused

    def _python(self, block: Block) -> None:
        exec(compile("\n" * block.above + block.text, str(self.page), "exec"), self.names)

    def _sh(self, block: Block) -> None:
        for command in block.commands:
            if _stands_elsewhere(command):
                continue
            program, *arguments = shlex.split(command, comments=True)
            module = next(
                (app for words, app in PROGRAMS.items() if command.startswith(words)), None
            )
            if module is not None:
                self._invoke(module, command, arguments[2:])
            elif program == "python":
                runpy.run_path(arguments[0], run_name="__main__")
            else:
                self._invoke(app, command, arguments)

    def _invoke(self, program: typer.Typer, command: str, arguments: list[str]) -> None:
        try:
            done = CliRunner().invoke(program, arguments, catch_exceptions=False)
        except LivepdeError as error:
            self.refused = f"{command}: {error}"
            print(f"Error: {error}")
        else:
            assert done.exit_code == 0, f"{command}: {done.output}"
            print(done.stdout)

    def _toml(self, block: Block) -> None:
        case = tomllib.loads(block.text)
        if not {"equation", "data"} <= set(case):
            case = tomllib.loads(COMPLETES.read_text(encoding="utf-8")) | case
        read_spec(case, self.page.name)

    def _csv(self, block: Block) -> None:
        assert len({len(row) for row in csv.reader(io.StringIO(block.text))}) == 1

    def _json(self, block: Block) -> None:
        json.loads(block.text)

    def _text(self, block: Block) -> None:
        assert self.printed is not None, "text has to follow what prints it"
        self.refused = ""
        if not doctest.OutputChecker().check_output(block.text, self.printed, ALIKE):
            pytest.fail(f"{self.page.name}:{block.above}: the program prints\n{self.printed}")


def _stands_elsewhere(command: str) -> str | None:
    """Return the beginning of a command that another test stands for."""
    return next((start for start in BEGINNINGS if command.startswith(start)), None)


def blocks(page: Path) -> Iterator[Block]:
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        above = text.count("\n", 0, found.start("text"))
        yield Block(found["kind"], found["title"], found["text"], above)


def needs_data(page: Path) -> bool:
    commands = [one for block in blocks(page) if block.kind == "sh" for one in block.commands]
    return any("cases/" in one and not _stands_elsewhere(one) for one in commands)


def takes_long(page: Path) -> bool:
    """Return whether a page runs before a release only: equations, tutorials, and the like."""
    deep = len(page.relative_to(ROOT).parts) > 2
    return deep or page.name in ("first-hour.md", "models.md", "extending.md")


RUN = [pytest.param(page, marks=pytest.mark.long if takes_long(page) else ()) for page in PAGES]


@pytest.mark.pages
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_a_page_runs(page, tmp_path, monkeypatch, request):
    if needs_data(page):
        monkeypatch.setenv("LIVEPDE_DATA", str(request.getfixturevalue("data_dir")))
    for folder in ("cases", "examples"):
        os.symlink(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    session = Session(page)
    for block in blocks(page):
        session.run(block)
    session.end()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_block_is_of_a_kind_that_runs(page):
    text = page.read_text(encoding="utf-8")
    found = list(blocks(page))
    assert text.count("```") == 2 * len(found), "a fence that is none: see the top of this file"
    for block in found:
        assert hasattr(Session, f"_{block.kind}"), f"line {block.above}: '{block.kind}'"
        for command in block.commands if block.kind == "sh" else ():
            known = command.startswith(("livepde ", "python ")) or _stands_elsewhere(command)
            if command.startswith("make "):
                known = re.search(rf"^{command.split()[1]}:", MAKEFILE, re.MULTILINE)
            assert known, f"line {block.above}: what tests '{command}'? Say it in ELSEWHERE."


def test_the_list_of_commands_is_right():
    """Each is on a page, and the test that stands for it exists."""
    shown = [
        _stands_elsewhere(command)
        for page in PAGES
        for block in blocks(page)
        if block.kind == "sh"
        for command in block.commands
    ]
    assert set(BEGINNINGS) == set(shown) - {None}
    assert all(map(is_a_test, ELSEWHERE))


def is_a_test(name: str) -> bool:
    """Return whether there is a test of the name `file::function`, or of the name `file`."""
    file, _, function = name.partition("::")
    source = (ROOT / "tests" / file).read_text(encoding="utf-8")
    return not function or re.search(rf"^def {function}\(", source, re.MULTILINE) is not None


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_a_page_names_is_there(page):
    """Commands, experiments, files and tests of the project, in quotes."""
    program = get_command(app)
    modules = {words: get_command(module).commands for words, module in PROGRAMS.items()}
    for name in set(re.findall(r"(?<!`)`([^`\n]+)`(?!`)", page.read_text(encoding="utf-8"))):
        words = name.split()
        if re.fullmatch(r"test_\w+\.py(::\w+)?", name):
            assert is_a_test(name), name
        elif re.fullmatch(r"(python )?(experiments|examples|cases)/[a-z_0-9]+\.(py|toml)", name):
            assert (ROOT / words[-1]).exists(), name
        elif name.startswith("python -m experiments."):
            assert (ROOT / f"{words[2].replace('.', '/')}.py").exists(), name
        elif words[0] == "make" and words[1:] and words[1].islower():
            assert re.search(rf"^{words[1]}:", MAKEFILE, re.MULTILINE), name
        elif name.startswith(tuple(PROGRAMS)) and re.fullmatch(r"[a-z-]+", words[3]):
            assert words[3] in modules[" ".join([*words[:3], ""])], name
        elif words[0] == "livepde" and words[1:] and re.fullmatch(r"[a-z]+", words[1]):
            assert words[1] in program.commands, name
            if words[1] == "reproduce" and words[2:] and words[2].islower():
                assert words[2] in EXPERIMENTS, name


@pytest.mark.parametrize("name", ["README.md", "CONTRIBUTING.md", "experiments/README.md"])
def test_links_of_pages_outside_of_the_site_lead_somewhere(name):
    """`make docs` follows those of the site."""
    page = ROOT / name
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if "://" in target:
            continue
        file, _, anchor = target.partition("#")
        assert (page.parent / file).exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.+)$", (page.parent / file).read_text(), re.MULTILINE)
            slugs = [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]
            assert anchor in slugs, target


def markers(source: str, function: str) -> set[str]:
    """Return what a test is marked by, itself or with its whole file."""
    body = ast.parse(source).body
    marked = [
        node.value
        for node in body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"
    ]
    for node in body:
        if isinstance(node, ast.FunctionDef) and node.name == function:
            marked += node.decorator_list
    return set(re.findall(r"pytest\.mark\.(\w+)", " ".join(map(ast.unparse, marked))))


@pytest.mark.slow
def test_guarantees_are_among_the_tests_of_what_users_rely_on():
    (left_out,) = re.findall(r'^USERS := -m "not \((.*)\)"$', MAKEFILE, re.MULTILINE)
    page = (ROOT / "docs" / "guarantees.md").read_text(encoding="utf-8")
    held = page[page.index("## Guaranteed") : page.index("\n## ", page.index("## Guaranteed") + 1)]
    names = re.findall(r"`(test_\w+\.py)::(\w+)`", held)
    assert len(names) > 20
    for file, function in names:
        if file != "test_petsc.py":  # `make mpi`
            source = (ROOT / "tests" / file).read_text(encoding="utf-8")
            assert not markers(source, function) & set(left_out.split(" or ")), (file, function)


def test_warnings_of_the_site_are_errors():
    """--quiet hides them from --strict, too: then nothing would be one."""
    (command,) = re.findall(r"mkdocs build.*", MAKEFILE)
    assert "--strict" in command
    assert "--quiet" not in command


@pytest.mark.slow
def test_a_site_that_loads_something_from_elsewhere_is_refused(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    links = importlib.import_module("links")
    (tmp_path / "index.html").write_text('<script async src="https://a.b/c.js"></script>')
    with pytest.raises(SystemExit, match=r"elsewhere:\n<script async src=.https://a\.b/c\.js"):
        links.main(tmp_path)
    text = '<a href="https://a.b">there</a> <script src="../c.js"></script> <img src="d.png">'
    assert not links.LOADED.findall(text)


def test_the_table_of_layers_is_that_of_the_import_contract():
    """The rows of CONTRIBUTING.md are the layers that `make check` holds, from the top."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = contracts["tool"]["importlinter"]["contracts"][0]["layers"]
    page = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    table = page[page.index("| package or") : page.index("Rules that hold")]
    drawn = [re.findall(r"`(\w+)`", line.split("|")[1]) for line in table.splitlines()[2:] if line]
    assert drawn == [re.findall(r"\w+", layer) for layer in layers]


@pytest.mark.slow
def test_pages_that_the_program_writes(monkeypatch):
    """Every command with its options, and every key with what it may be."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    hooks = importlib.import_module("hooks")
    assert hooks.on_page_markdown("as it is") == "as it is"
    commands = hooks.on_page_markdown("<!-- command line --> <!-- benchmarks -->")
    described = {
        f"{prefix} {name}": command
        for prefix, program in (("livepde", app), ("python -m benchmarks", benchmarks))
        for name, command in get_command(program).commands.items()
    }
    for title, command in described.items():
        section = commands[commands.index(f"## `{title}`\n") :]
        for option in command.params:
            name = max(option.opts, key=len)
            assert name in section or not name.startswith("--") or option.hidden, name
    assert "Example: `livepde run mycase/case.toml`\n" in commands
    keys = hooks.on_page_markdown("<!-- keys of a case -->")
    assert "| `prior` | a quantity | required |" in keys
    assert '| `spacing` | `"uniform"` or `"geometric"` or [' in keys
    assert "| `start` | a date or a time |  |" in keys
    assert "| `cells` | a whole number or [a whole number, a whole number] |  |" in keys
    assert "## `[unknowns.NAME.evolution]`" in keys
    assert '## `[law]`, `kind = "gradient"`' in keys
    assert "| `refit` | true or false or a table | `true` |" in keys
    assert "## `[[variants]]`" in keys


def test_the_navigation_is_short_and_complete():
    """Every page that people write is in it."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    nav = text[text.index("\nnav:") : text.index("\nnot_in_nav:")]
    names = re.findall(r": ([\w/-]+\.md)$", nav, flags=re.MULTILINE)
    assert len(names) == len(set(names)) <= 24
    written = {*(path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md"))}
    generated = {"api", "gallery", "peers", "performance"}
    assert {str(path) for path in written if path.parts[0] not in generated} - set(names) == {
        "benchmark-commands.md",
        "experiment-commands.md",
    }


def test_every_finding_is_explained():
    """The page that assesses a run has a line for each finding, by the name that programs read."""
    source = "".join(path.read_text() for path in (ROOT / "src").rglob("*.py"))
    found = set(re.findall(r'\b(?:Finding|_said)\(\s*"([a-z ]+)"', source))
    page = (ROOT / "docs" / "trust.md").read_text(encoding="utf-8")
    explained = " ".join(re.findall(r"^\| (`.*?`) \|", page, flags=re.MULTILINE))
    assert len(found) > 20
    assert found <= set(re.findall(r"`([^`]+)`", explained))


def test_phrases_long_sentences_and_long_pages_are_found(tmp_path, monkeypatch):
    """Code and targets of links are no text; `make check` runs the check on the pages."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    check = importlib.import_module("plain_english")
    page = tmp_path / "trust.md"
    code = "`it says`, [a link](hardly.md)\n\n```sh\ntold\n```\n\n"
    page.write_text(code + "A b. " * 700)
    check.main([str(page)])
    wrong = "It goes\non. " + "One, " * 30 + "two.\n\n| a cell | hardly any |\n\n"
    page.write_text(code + wrong + "A b. " * 800)
    with pytest.raises(SystemExit) as refused:
        check.main([str(page)])
    assert str(refused.value).replace(f"{page}:", "").splitlines() == [
        "7: goes on -> continue",
        "7: One, One, One, One, One, One, ... (31 words) -> at most 30",
        "10: hardly -> barely",
        "1: 1641 words -> at most 1500",
    ]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_formulas_are_written_in_unicode(page):
    """The pages load nothing from elsewhere, so that nothing would draw LaTeX."""
    assert "$$" not in page.read_text(encoding="utf-8")
