"""The public face: what is exported, what is imported, what is drawn."""

from __future__ import annotations

import importlib
import inspect
import re
import subprocess
import sys
from pathlib import Path

import livepde
from livepde import errors


def test_exports_are_complete_and_sorted():
    names = {
        name
        for name, value in vars(livepde).items()
        if not name.startswith("_") and not inspect.ismodule(value) and name != "annotations"
    }
    assert set(livepde.__all__) - {"__version__"} == names
    assert livepde.__all__ == sorted(livepde.__all__)


def test_the_reference_holds_what_is_exported():
    """Pages are made of docstrings; helpers of scikit-fem have none there and stand in a table."""
    reference = (Path(__file__).parents[1] / "docs" / "reference.md").read_text()
    helpers = re.findall(r"`(\w+)\(", reference)
    for name in livepde.__all__:
        owner = getattr(getattr(livepde, name), "__module__", "livepde")
        assert owner.startswith("livepde") != (name in helpers), name
    for package in ("", ".models", ".diagnostics", ".cases", ".runs", ".streams", ".streams.mqtt"):
        assert f"::: livepde{package}\n" in reference
        module = importlib.import_module(f"livepde{package}")
        for name in module.__all__:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert inspect.getdoc(value), name


def test_import_is_light():
    code = (
        "import sys, livepde; heavy = {'matplotlib', 'mpi4py', 'pint', 'pydantic', 'typer', "
        "'flask', 'dash', 'plotly', 'cheroot', 'prometheus_client', 'paho', 'asyncua', 'meshio', "
        "'zarr', 'h5py'} & set(sys.modules); print(sorted(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


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
