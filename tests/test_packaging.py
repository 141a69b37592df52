"""Contents of a release: version, changelog, citation and shell completion."""

import datetime as dt
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.resources import files
from pathlib import Path

import pytest
from typer.testing import CliRunner

import livepde
from livepde import cli
from livepde.models import EQUATIONS

ROOT = Path(__file__).parents[1]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text()
CITATION = (ROOT / "CITATION.cff").read_text()
KINDS = {"Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"}


def told(*arguments: str, **environment: str) -> str:
    result = CliRunner().invoke(cli.app, list(arguments), prog_name="livepde", env=environment)
    assert result.exit_code == 0, result.output
    return result.output


# --- versions --------------------------------------------------------------------------------


def test_there_is_one_version():
    """It stands in livepde/__init__.py; CITATION.cff repeats it, and has to agree."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert "version" in project["project"]["dynamic"]
    assert project["tool"]["hatch"]["version"]["path"] == "src/livepde/__init__.py"
    assert re.fullmatch(r"\d+\.\d+\.\d+", livepde.__version__)
    assert re.findall(r"^version: (.*)$", CITATION, re.MULTILINE) == [livepde.__version__]
    assert told("--version") == f"livepde {livepde.__version__}\n"


def test_the_changelog_is_kept():
    """What is not released yet comes first, then releases, newest first, the last one's here."""
    titles = re.findall(r"^## (.*)$", CHANGELOG, re.MULTILINE)
    assert titles[0] == "[Unreleased]"
    releases = [re.fullmatch(r"\[(\d+)\.(\d+)\.(\d+)\] - (\S+)", title) for title in titles[1:]]
    assert all(releases), titles
    versions = [tuple(map(int, found.group(1, 2, 3))) for found in releases]
    dates = [dt.date.fromisoformat(found[4]) for found in releases]
    assert versions == sorted(set(versions), reverse=True)
    assert dates == sorted(dates, reverse=True)
    assert set(re.findall(r"^### (.*)$", CHANGELOG, re.MULTILINE)) <= KINDS
    if releases:
        assert ".".join(map(str, versions[0])) == livepde.__version__
        assert f"\ndate-released: {dates[0]}\n" in CITATION


def test_every_python_that_is_promised_is_tried():
    """The classifiers name what `make test` and `make versions` run on."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    promised = [
        found[1]
        for line in project["classifiers"]
        if (found := re.search(r"Python :: (3\.\d+)$", line))
    ]
    (tried,) = re.findall(r"^VERSIONS := (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    oldest = project["requires-python"].removeprefix(">=")
    assert promised == [oldest, *tried.split()]


def test_work_on_livepde_is_no_extra_of_the_wheel():
    """Who installs livepde is offered nothing that tests, builds or compares it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    extras, groups = project["project"]["optional-dependencies"], project["dependency-groups"]
    assert not set(extras) & {"dev", "test", "docs", "bench", "peers"}
    assert set(groups) == {"dev", "test", "docs", "bench", "peers"}
    makefile = (ROOT / "Makefile").read_text()
    (named,) = re.findall(r"^EXTRAS := (.*)$", makefile, re.MULTILINE)
    assert set(named.split(",")) <= set(extras)
    assert '-e ".[$(ALL_EXTRAS)]" --group dev' in makefile


def test_the_core_needs_no_compiler():
    """Solvers with compiled parts that lack wheels for some machines are extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[<>=; ]", line)[0] for line in project["dependencies"]}
    assert not needed & {"pyamg", "pypardiso", "scikit-sparse", "pyyaml", "PyYAML"}
    assert any(line.startswith("pyamg") for line in project["optional-dependencies"]["solvers"])


def test_the_recipe_for_conda_agrees_with_the_wheel():
    recipe = (ROOT / "deploy" / "conda" / "recipe.yaml").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    run = recipe.partition("  run:\n")[2].partition("\ntests:")[0]
    found = {line.removeprefix("python-") for line in re.findall(r"- (.*)", run)}
    # One recipe is for all systems, and has what only one of them needs.
    needed = [line.partition(";")[0] for line in project["dependencies"]]
    expected = {re.sub(r"^([\w-]+)", r"\1 ", line) for line in needed}
    assert found == expected | {f"python {project['requires-python']}"}
    assert f'version: "{livepde.__version__}"' in recipe
    assert f"livepde = {project['scripts']['livepde']}" in recipe


# --- how to cite -----------------------------------------------------------------------------


def test_the_file_is_in_the_package():
    shipped = files("livepde").joinpath("CITATION.cff").read_text()
    assert shipped == (ROOT / "CITATION.cff").read_text() == told("citation", "--format", "cff")


def test_what_is_printed_is_in_the_file():
    """The facts of the file are printed: those of the paper in both forms."""
    references = CITATION.partition("references:\n")[2].replace(">-\n", "")
    facts = dict(re.findall(r"^ +(?:- )?([a-z-]+): +(.*)$", references, re.MULTILINE))
    names = re.findall(r"family-names: (.*)\n +given-names: (.*)\n", references)
    for form in ("bibtex", "apa"):
        paper = told("citation", "--format", form).split("\n\n")[1]
        for key in ("title", "journal", "volume", "start", "year", "doi"):
            assert facts[key].strip('"') in paper
        assert len(names) == 2
        assert all(", ".join(name) in paper for name in names)


def test_bibtex():
    text = told("citation")
    software, paper = text.split("\n\n")
    assert software.startswith("@misc{livepde,\n  author = {{The livepde authors}},\n")
    assert f"version {livepde.__version__}}}" in software
    assert paper.startswith("@article{Boiger2016,\n  author = {Boiger, R. and Kaltenbacher, B.},\n")
    for entry in (
        "title = {{An online parameter identification method for time dependent partial "
        "differential equations}}",
        "journal = {Inverse Problems}",
        "volume = {32}",
        "pages = {045006}",
        "year = {2016}",
        "doi = {10.1088/0266-5611/32/4/045006}",
    ):
        assert f"  {entry},\n" in paper
    assert text.count("{") == text.count("}")
    assert "None" not in text


# --- completion ------------------------------------------------------------------------------


def bash(line: str) -> list[str]:
    words = line.split(" ")
    given = {"COMP_WORDS": line, "COMP_CWORD": str(len(words) - 1)}
    return told(_LIVEPDE_COMPLETE="complete_bash", **given).split()


def zsh(line: str) -> list[str]:
    text = told(_LIVEPDE_COMPLETE="complete_zsh", _TYPER_COMPLETE_ARGS=line)
    return ["_files"] if text == "_files\n" else re.findall(r'^(?:.*\(\()?"([^"]+)"', text, re.M)


def fish(line: str) -> list[str]:
    given = {"_TYPER_COMPLETE_ARGS": line, "_TYPER_COMPLETE_FISH_ACTION": "get-args"}
    text = told(_LIVEPDE_COMPLETE="complete_fish", **given)
    return [row.split("\t")[0] for row in text.splitlines() if row]


@pytest.mark.slow
@pytest.mark.parametrize("shell", [bash, zsh, fish])
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("livepde re", ["report", "reproduce"]),
        ("livepde equations heat", ["heat"]),
        ("livepde equations ", list(EQUATIONS)),
        ("livepde reproduce se", ["seed", "seed-excited"]),
        ("livepde citation --format b", ["bibtex"]),
        ("livepde run case.toml --log ", ["text", "json"]),
    ],
)
def test_names_are_offered(shell, line, expected):
    assert shell(line) == expected


def test_files_are_left_to_the_shell():
    assert bash("livepde run ca") == []  # its script says: complete -o default
    assert zsh("livepde run ca") == ["_files"]
    assert fish("livepde run ca") == []


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts(shell):
    script = told(_LIVEPDE_COMPLETE=f"source_{shell}")
    assert f"_LIVEPDE_COMPLETE=complete_{shell}" in script
    assert "livepde" in script


@pytest.mark.process
@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
def test_bash_completes(tmp_path):
    """The shell calls what its script defines, with the words of a line, as after Tab."""
    program = tmp_path / "livepde"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nfrom livepde.cli import main\nsys.exit(main())\n"
    )
    program.chmod(0o755)
    script = told(_LIVEPDE_COMPLETE="source_bash")
    tab = "COMP_WORDS=(livepde equations hea); COMP_CWORD=2; _livepde_completion livepde"
    code = f'PATH="{tmp_path}:$PATH"\n{script}\n{tab}\necho "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "heat\n"
