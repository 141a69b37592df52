"""An unknown offset of a boundary value: `offset` of a channel of role boundary."""

import pandas as pd
import pytest
from factories import short_rod

import livepde as lp
from livepde import cases
from livepde.cases.variants import Variant, run_variant
from livepde.errors import CaseError

OFFSET = 1.5  # K


def biased(folder):
    path = short_rod(folder, 61)
    table = pd.read_csv(path.parent / "rod.csv")
    table["T_left"] += OFFSET  # the thermometer at the end reads too much
    table.to_csv(path.parent / "rod.csv", index=False)
    return path


@pytest.mark.long
def test_the_offset_of_a_boundary_value_is_found(tmp_path):
    path = biased(tmp_path)
    plain = run_variant(path, [], Variant("as stated"))
    found = run_variant(path, [], Variant("offset", ("channels.T_left.offset='2 K'",)))
    assert not found.error
    offset, alpha = found.estimates["offset_T_left"], found.estimates["alpha"]
    # What the channel reads too much, as the offset of a sensor.
    assert offset.low < OFFSET < offset.high
    assert offset.std < 0.2
    assert alpha.low < 9.7e-5 < alpha.high
    assert found.gained(plain) > 100.0
    assert found.validation_error < plain.validation_error
    assert plain.level == "do not trust"
    assert found.level == "trusted"  # the offset itself is less certain than alpha


@pytest.mark.long
def test_without_an_offset_the_boundary_is_held_as_a_value_holds_it(tmp_path):
    path = short_rod(tmp_path, 41)
    held = run_variant(path, [], Variant("value"))
    near = run_variant(path, [], Variant("near", ("channels.T_left.offset='1e-6 K'",)))
    one, other = held.estimates["alpha"], near.estimates["alpha"]
    assert other.value == pytest.approx(one.value, rel=1e-3)
    assert other.std == pytest.approx(one.std, rel=0.05)
    assert near.log_evidence == pytest.approx(held.log_evidence, abs=0.5)


def test_an_offset_is_what_the_channel_reads_too_much_as_that_of_a_sensor(tmp_path):
    """A bias of all thermometers is one number: the offsets of boundary and sensor agree."""
    loaded = cases.load(short_rod(tmp_path, 11), settings={"channels.T_left.offset": "1 K"})
    model, inputs = loaded.model, {"T_left": 20.0, "T_right": 20.0}
    start, scheme = [0.0, 1e5], lp.Advance(lp.ImplicitEuler(), 1e4)
    q = model.initial_parameter({"alpha": 9.7e-5, "offset_T_left": OFFSET})
    *_, (_, u) = lp.simulate(model, q, 20.0, start, scheme, lambda t: inputs)
    values = model.state_block.at_vertices @ u
    # It is the left end that is colder than its channel, the right one is as its channel.
    assert values.min() == pytest.approx(20.0 - OFFSET, abs=1e-3)
    assert values.max() == pytest.approx(20.0, abs=1e-3)


def test_an_offset_needs_an_equation_with_fluxes_and_a_boundary_of_its_own(tmp_path):
    path = short_rod(tmp_path, 11)
    offset = {"channels.T_left.offset": "1 K"}
    labels = cases.load(path, settings=offset).model.parameter_space.labels
    assert "offset_T_left" in labels
    own = {**offset, "unknowns.offset_T_left": {"prior": 0, "std": 1}}
    with pytest.raises(CaseError, match="offset_T_left"):
        cases.load(path, settings=own)
    with pytest.raises(CaseError, match="has a condition already"):
        cases.load(path, settings={**offset, "boundary.left.flux": 1.0})
    with pytest.raises(CaseError, match="requires role = 'sensor'"):
        cases.load(path, settings={"channels.T_left.gain": 0.1})
