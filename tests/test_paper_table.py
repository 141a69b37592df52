"""docs/paper.md: each function it names can be imported, each test exists, no label is left out."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from typer.main import get_command

from experiments.__main__ import app as studies
from livepde.reproduce import EXPERIMENTS

PACKAGES = ("livepde.", "experiments.")
ROOT = Path(__file__).parents[1]
WHOLE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
PAGE = WHOLE[WHOLE.index("## Line by line") : WHOLE.index("## Conditions along a run")]
QUOTED = sorted(set(re.findall(r"`([^`]+)`", PAGE)))

# Labels of the paper's equations, assumptions, lemmas, propositions, theorems and figures.
LABELS = re.findall(
    r"\S+",
    """
main ass:equation LipschitzC AbdV AbdX AbdVV est_exact_q est_exact_u est_exact0 erp errorsys_e
errorsys_r errorsys_p id1 align:neplusnr cond:mu_1 est1 estp cond:nu prop:welldefine cond:mu02
th:state def:LA ineq:gamma est_er1 finiteintegral_r2 lem:est_state asspof est_er2 cond:link interpol
lemma1 th:parameter noisy_q noisy_u noisy_0 delta id2 id3 smooth_err_q smooth_err_r smooth_err_p
smooth_err_0 ass:mu_nu cond_d well_defined_noisy Tast est5 est4 ass:mu_noisy lemma_integral
ass:persistence_noisy thetatil ass:link_noisy lemma1_noisy th:parameter_noisy method_smooth_q
method_smooth_u method_smooth_0 err_smooth_r ass:mu_nu_smooth prop:wellposed_noisesmooth
cond:mu_smooth_2 th:state_noisesmooth lem:est_state_noisesmooth lemma1_noisesmooth
th:parameter_noisesmooth PDEdiff obsdiff MN1 MN2 fig:figure1 fig:figure2
""",
)


@pytest.mark.parametrize("name", [name for name in QUOTED if name.startswith(PACKAGES)])
def test_functions_exist(name: str) -> None:
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ModuleNotFoundError:
            continue
        for attribute in parts[cut:]:
            found = getattr(found, attribute)
        return
    pytest.fail(f"{name} cannot be imported")


@pytest.mark.parametrize("name", [name for name in QUOTED if name.startswith("test_")])
def test_tests_exist(name: str) -> None:
    file, _, function = name.partition("::")
    source = (ROOT / "tests" / file).read_text(encoding="utf-8")
    assert not function or re.search(rf"^def {function}\(", source, re.MULTILINE)


def test_commands_and_files_exist() -> None:
    for name in QUOTED:
        if name.startswith("livepde reproduce "):
            assert name.split()[-1] in EXPERIMENTS
        elif name.startswith("python -m experiments "):
            assert name.split()[-1] in get_command(studies).commands
        elif name.startswith("experiments/"):
            assert (ROOT / name).exists()
        else:
            assert name.startswith((*PACKAGES, "test_")), name


@pytest.mark.parametrize("label", LABELS)
def test_no_label_is_left_out(label: str) -> None:
    assert re.search(rf"(?<![\w:]){re.escape(label)}(?![\w:])", PAGE)


def test_every_row_is_full() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and "---" not in line]
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        assert len(cells) == 3, row
        assert all(cells), row
