"""The public interface: exports, imports and representations."""

import ast
import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest

import livepde
from benchmarks.overhead import rod
from benchmarks.startup import BASE, SCRIPT
from livepde import errors

DOCUMENTED = (
    ".models",
    ".diagnostics",
    ".cases",
    ".runs",
    ".control",
    ".dashboard",
    ".exchange",
    ".reproduce",
    ".plots",
    ".streams",
    ".streams.mqtt",
    ".streams.opcua",
    ".laws",
    ".observation",
    ".stepping",
    ".fem",
    ".linalg",
    ".spaces",
    ".petsc",
    ".errors",
    ".fleet",
    ".forecast",
)


def test_exports_are_complete_and_sorted():
    """What runs and what type checkers see is the same list."""
    stub = ast.parse(Path(livepde.__file__).with_suffix(".pyi").read_text())
    lists = [
        ast.literal_eval(node.value)
        for node in stub.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    assert lists == [livepde.__all__]
    assert livepde.__all__ == sorted(livepde.__all__)
    assert set(livepde.__all__) <= set(dir(livepde))


def test_every_docstring_of_the_top_level_has_an_example():
    """The doctests run them; grad, dot and div are scikit-fem's."""
    ours = [getattr(livepde, name) for name in livepde.__all__]
    ours = [one for one in ours if callable(one) and one.__module__.startswith("livepde")]
    assert len(ours) > 30
    assert not [one.__name__ for one in ours if ">>>" not in (one.__doc__ or "")]


@pytest.mark.long
def test_parts_are_there_without_being_imported():
    """`livepde.fem.Moment` does not depend on what else a program has used before."""
    parts = sorted(name for name in DOCUMENTED if name[1:] in livepde.__all__)
    code = "".join(f"; print(livepde{part}.__name__)" for part in parts)
    found = subprocess.run(
        [sys.executable, "-c", f"import livepde{code}"], capture_output=True, text=True, check=True
    )
    assert found.stdout.split() == [f"livepde{part}" for part in parts]


def test_what_is_not_there_is_said():
    with pytest.raises(AttributeError, match="nothing_here"):
        livepde.nothing_here  # noqa: B018


def test_the_reference_holds_what_is_exported():
    """Pages are made of docstrings; helpers of scikit-fem have none there and stand in a table."""
    docs = Path(__file__).parents[1] / "docs"
    reference = (docs / "reference.md").read_text()
    helpers = re.findall(r"`([\w.]+)\(", reference)
    for name in livepde.__all__:
        owner = getattr(getattr(livepde, name), "__module__", "livepde")
        assert owner.startswith("livepde") != (name in helpers), name
    pages = "\n".join(path.read_text() for path in [docs / "reference.md", *docs.glob("api/*.md")])
    for package in ("", *DOCUMENTED):
        whole, rest = f"::: livepde{package}\n", f"<!-- members of livepde{package} -->\n"
        assert (whole in pages) != (rest in pages), package
        module = importlib.import_module(f"livepde{package}")
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert inspect.getdoc(value), name


def loaded(code):
    """Return the names of the modules that a fresh interpreter has after `code`."""
    code += "; import sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_loads_nothing():
    """What livepde exports is loaded on first use."""
    modules = loaded("import livepde")
    assert {name for name in modules if name.split(".")[0] == "livepde"} == {"livepde"}
    assert not {"numpy", "scipy", "skfem"} & modules


@pytest.mark.slow
def test_what_a_script_uses_is_light():
    """Beside SciPy and scikit-fem, a model and an identifier load nothing but the library's core.

    Neither pandas, xarray, Matplotlib, pydantic, rich, MPI and a web framework, nor the parts of
    SciPy that are slow to load: special, optimize, spatial, stats.
    """
    more = loaded(SCRIPT) - loaded(f"{BASE}, skfem.helpers")
    assert {"livepde.identifier", "livepde.laws.sensitivity"} <= more
    assert {name.split(".")[0] for name in more} - sys.stdlib_module_names == {
        "lazy_loader",
        "livepde",
    }
    assert not {"asyncio", "decimal", "multiprocessing", "sqlite3", "ssl"} & more
    above = "cases cli dashboard diagnostics fleet models reproduce runs streams"
    assert not {f"livepde.{name}" for name in above.split()} & more


@pytest.mark.slow
def test_the_command_line_comes_lightly_to_its_first_estimates(tmp_path):
    """Tables and the parts of SciPy that are slow to load wait until something needs them."""
    code = (
        "import livepde.cli; from livepde.cases import load; "
        f"case = load({str(rod(tmp_path, samples=60))!r}).prepare(); step = case.identifier.step; "
        "[step(sample.t, sample.z).parameters for _, sample in zip(range(2), case.stream)]"
    )
    more = loaded(code)
    assert {"livepde.runs.journal", "livepde.cases.case_channels", "livepde.streams.gaps"} <= more
    slow = {"matplotlib", "pandas", "pyarrow", "xarray"}
    slow |= {f"scipy.{part}" for part in ("interpolate", "ndimage", "optimize", "special", "stats")}
    assert not slow & more


def test_the_tree_of_exceptions_is_as_drawn():
    drawn = {}
    stack = []
    for match in re.finditer(r"^    ([│ ]*[├└]── )?(\w+)(?:  |$)", errors.__doc__, re.MULTILINE):
        depth = len(match[1] or "") // 4
        del stack[depth:]
        if match[2] in vars(errors):
            drawn[match[2]] = stack[-1] if stack else "Exception"
            stack.append(match[2])
    classes = {name: getattr(errors, name) for name in errors.__all__}
    assert set(drawn) == set(classes)
    for name, parent in drawn.items():
        assert classes[name].__bases__[0].__name__ == parent


def test_every_module_imports():
    import pkgutil

    for module in pkgutil.walk_packages(livepde.__path__, "livepde."):
        if module.name != "livepde.__main__":
            importlib.import_module(module.name)


@pytest.mark.slow
def test_no_modules_import_each_other():
    """Imports for type checkers included: a module is understood after those that it imports."""
    root = Path(livepde.__file__).parent
    modules = {
        ".".join(("livepde", *path.relative_to(root).with_suffix("").parts)): path
        for path in root.rglob("*.py")
    }
    imports: dict[str, set[str]] = {}
    for name, path in modules.items():
        imports[name] = found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                asked = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
                found |= asked & modules.keys() - {name}
    while imports:
        leaves = {name for name, found in imports.items() if not found}
        assert leaves, f"in or behind a circle: {sorted(imports)}"
        imports = {name: found - leaves for name, found in imports.items() if name not in leaves}
