"""Ready-made equations agree with formulas: heat, columns, waves, populations."""

import numpy as np
import pytest
from factories import broad, last_state, observe
from scipy.special import j0, jn_zeros
from skfem import ElementLineP2

import livepde as lp
from livepde.cases import load
from livepde.errors import CaseError, ModelError, SpaceError
from livepde.models import (
    EQUATIONS,
    advection_diffusion,
    borehole,
    conduction,
    fisher_kpp,
    fluid,
    heat,
    porous_fisher,
    reaction_diffusion,
    wave,
)
from livepde.stepping import Advance, Alexander2, simulate
from livepde.streams import AbsoluteNoise, Twin

PLATE = lp.rectangle((0.0, 1.0), (0.0, 2.0), (4, 5))


@pytest.mark.parametrize(
    "alpha",
    [
        lp.Normal(0.1, 1.0),
        lp.Piecewise({"a": lambda x: x[0] < 0.5, "b": lambda x: x[0] >= 0.5}, lp.Normal(0.1, 1.0)),
        lp.Field(PLATE, EQUATIONS["heat"].element(PLATE), prior=lp.Normal(0.1)),
    ],
)
def test_heat_by_number_layer_and_field_in_the_plane(alpha):
    model = heat(PLATE, alpha, {"left": 1.0, "right": 0.0})
    found = last_state(model, 0.0, np.linspace(0, 200, 50))
    assert found == pytest.approx(1.0 - PLATE.p[0], abs=1e-6)


def test_fluid_sees_the_resistance():
    mesh = lp.interval(0.05, 5.0, 20, geometric=True)
    model = borehole(mesh, lp.Normal(2.0, 1.0), lp.Normal(0.1, 0.1), H=20.0, rho_c=2e6, T0=10.0)
    points = lp.Points({"T": 0.05}, direct={"T": fluid(20.0)})
    observed = observe(model, points)
    moment = lp.fem.Moment(0.0, {"Q": 1000.0})
    u = model.initial(10.0)
    assert observed.predict(u, np.array([2.0, 0.1]), moment) == pytest.approx([10.0 + 0.1 * 50.0])


def test_reaction_diffusion_is_the_papers_example():
    mesh = lp.interval(0.0, 1.0, 20)
    model = reaction_diffusion(mesh, lp.Normal(3.0, 1.0), D=0.5, f=lambda x, t: 0.0 * x[0])
    found = last_state(model, lambda x: np.sin(np.pi * x[0]), np.linspace(0, 1, 101))
    exact = np.exp(-0.5 * np.pi**2 - 3.0) * np.sin(np.pi * mesh.p[0])
    assert found == pytest.approx(exact, abs=1e-5)


def test_geometric_interval():
    mesh = lp.interval(0.1, 10.0, 4, geometric=True)
    x = np.sort(mesh.p[0])
    assert np.allclose(x[1:] / x[:-1], 10**0.5)
    with pytest.raises(SpaceError, match="start > 0"):
        lp.interval(0.0, 1.0, 4, geometric=True)
    with pytest.raises(SpaceError, match="rectangle"):
        lp.rectangle((0, 1), (1, 0), (2, 2))


def test_loss_is_one_more_rate_of_decay():
    mesh = lp.interval(0.0, 1.0, 40)
    model = heat(mesh, broad(0.1), {"boundary": 0.0}, loss=broad(0.7))
    times, mode = np.linspace(0, 2, 81), np.sin(np.pi * mesh.p[0])
    found = last_state(model, lambda x: np.sin(np.pi * x[0]), times, lambda t: {"ambient": 0.0})
    assert np.abs(found - np.exp(-(0.1 * np.pi**2 + 0.7) * 2) * mode).max() < 1e-3


def test_loss_pulls_to_the_surroundings_as_a_fin_does():
    """Steady: alpha u'' = loss (u - 20), u(0) = 50, insulated at 1: a hyperbolic cosine."""
    mesh = lp.interval(0.0, 1.0, 80)
    model = heat(mesh, broad(0.1), {"left": 50.0}, loss=broad(0.9))
    found = last_state(model, 20.0, np.linspace(0, 60, 61), lambda t: {"ambient": 20.0})
    exact = 20 + 30 * np.cosh(3 * (1 - mesh.p[0])) / np.cosh(3)
    assert np.abs(found - exact).max() < 2e-3


@pytest.mark.parametrize("scale", [1.0, 2e6])
def test_transfer_at_the_free_end(scale):
    """Steady: a straight line whose slope is that of Newton's law, alpha u' = -h (u - 10)."""
    mesh = lp.interval(0.0, 1.0, 10)
    k, h = broad(0.5 * scale), broad(1.5 * scale)
    if scale == 1.0:
        model = heat(mesh, k, {"left": 30.0}, transfer=h)
    else:
        model = conduction(mesh, k, {"left": 30.0}, C=scale, transfer=h)
    found = last_state(model, 10.0, np.linspace(0, 50, 51), lambda t: {"ambient": 10.0})
    assert found == pytest.approx(30 - 15 * mesh.p[0], abs=1e-6)


def test_source_by_layer():
    """Steady: a parabola where heat is gained, straight lines elsewhere."""
    mesh = lp.interval(0.0, 1.0, 40)
    halves = {"warm": lambda x: x[0] < 0.5, "still": lambda x: x[0] >= 0.5}
    source = lp.Piecewise(halves, lp.Normal(0.0, 1.0))
    model = heat(mesh, broad(0.5), {"boundary": 0.0}, source=source)
    q = model.initial_parameter({"alpha": 0.5, "source": [2.0, 0.0]})
    *_, (_, u) = simulate(model, q, 0.0, np.linspace(0, 40, 81), Advance(Alexander2()))
    x = mesh.p[0]
    exact = np.where(x < 0.5, 1.5 * x - 2 * x**2, 0.5 * (1 - x))
    assert model.state_block.at_vertices @ u == pytest.approx(exact, abs=1e-6)


def test_capacity_by_layer_keeps_the_heat():
    """Insulated layers of 3 and 1 J/(m^3 K) end at their weighted mean."""
    mesh = lp.interval(0.0, 1.0, 20)
    model = conduction(mesh, broad(1.0), C=lambda x: np.where(x[0] < 0.5, 3.0, 1.0))
    found = last_state(model, lambda x: 8.0 * (x[0] < 0.51), np.linspace(0, 20, 101))
    start = model.mass @ model.initial(lambda x: 8.0 * (x[0] < 0.51))
    assert found == pytest.approx(np.full(21, start.sum() / 2.0), abs=1e-6)
    assert found[0] == pytest.approx(6.0, abs=0.1)


def test_conduction_is_heat_in_other_units():
    mesh = lp.interval(0.0, 0.5, 25)
    times = np.linspace(0, 86400, 49)
    sides = {"left": lambda x, t: 10 * np.sin(2 * np.pi * t / 86400), "right": 0.0}
    one = last_state(heat(mesh, lp.Normal(5e-7, 1e-7), sides), 0.0, times)
    two = last_state(conduction(mesh, lp.Normal(1.25, 1.0), sides, C=2.5e6), 0.0, times)
    assert np.allclose(one, two, rtol=1e-10, atol=1e-12)


ONE = lp.Normal(1.0, 1.0)


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [
        (heat, {"dirichlet": {"left": 0.0, "right": 0.0}, "transfer": ONE}, "and there is none"),
        (conduction, {"C": 0.0}, "must be positive"),
        (advection_diffusion, {}, "give an unknown flux v"),
        (advection_diffusion, {"v": ONE, "L": 0.0}, "L must be a positive number"),
        (fisher_kpp, {"r": ONE, "K": 0.0}, "K must be a positive number"),
        (porous_fisher, {"r": ONE, "m": 0.5}, "m must be at least 1"),
    ],
)
def test_what_is_refused(build, options, message):
    with pytest.raises(ModelError, match=message):
        build(lp.interval(0.0, 1.0, 4), ONE, **options)


def test_the_surroundings_do_not_make_each_step_factorise_anew():
    exchange = {"loss": lp.Normal(0.1), "transfer": lp.Normal(0.2)}
    model = heat(lp.interval(0.0, 1.0, 4), lp.Normal(1.0), {"left": 0.0}, **exchange)
    assert model.steady
    assert not model.constant


def steady(x, w, kappa):
    return np.expm1(w * x / kappa) / np.expm1(w / kappa)


@pytest.mark.parametrize("w", [-3.0, 0.5, 2.0])
def test_steady_profile(w):
    errors = []
    for cells in (20, 40):
        mesh = lp.interval(0.0, 1.0, cells)
        model = advection_diffusion(mesh, broad(0.5), {"left": 0.0, "right": 1.0}, v=broad(w))
        found = last_state(model, 0.0, np.linspace(0, 20, 41))
        errors.append(np.abs(found - steady(mesh.p[0], w, 0.5)).max())
    assert errors[0] < 0.02
    assert errors[1] < 0.27 * errors[0]  # second order


def test_stabilised_it_is_exact_at_the_vertices_however_fast():
    mesh = lp.interval(0.0, 1.0, 10)
    sides = {"left": 0.0, "right": 1.0}
    model = advection_diffusion(mesh, broad(0.01), sides, v=broad(1.0), stabilise=True)
    found = last_state(model, 0.0, np.linspace(0, 20, 41))
    assert found == pytest.approx(steady(mesh.p[0], 1.0, 0.01), abs=1e-9)


@pytest.mark.slow
def test_a_warm_spot_drifts_with_the_water_and_spreads():
    """A Gaussian; the water follows the head, w = ratio K dH(t)/L, here back and forth."""
    kappa, K, L, ratio, start = 0.02, 3.0, 2.0, 1.5, 0.05
    mesh = lp.interval(-4.0, 4.0, 400)
    model = advection_diffusion(mesh, broad(kappa), {"boundary": 0.0}, K=broad(K), L=L, ratio=ratio)
    end = 2.0
    found = last_state(
        model,
        lambda x: np.exp(-(x[0] ** 2) / (4 * start)),
        np.linspace(0, end, 201),
        lambda t: {"dH": np.cos(t)},
    )
    moved, wide = ratio * K / L * np.sin(end), start + kappa * end
    exact = np.sqrt(start / wide) * np.exp(-((mesh.p[0] - moved) ** 2) / (4 * wide))
    assert np.abs(found - exact).max() < 2e-3


def test_dispersion_grows_with_the_speed_of_either_sign():
    mesh = lp.interval(0.0, 1.0, 40)
    sides = {"left": 0.0, "right": 1.0}
    for w in (-2.0, 2.0):
        model = advection_diffusion(mesh, broad(0.3), sides, v=broad(w), dispersivity=broad(0.1))
        plain = advection_diffusion(mesh, broad(0.5), sides, v=broad(w))
        times = np.linspace(0, 5, 11)
        assert np.allclose(last_state(model, 0.0, times), last_state(plain, 0.0, times))


def test_a_pipe_loses_heat_to_its_surroundings():
    # The steady state of v u_x = -loss (u - ambient) decays exponentially.
    mesh, v, loss, ambient = lp.interval(0.0, 1.0, 200), 2.0, 1.5, 9.0
    model = advection_diffusion(mesh, broad(1e-4), {"left": 80.0}, v=broad(v), loss=broad(loss))
    assert model.channel_units["ambient"] == "degC"
    assert "ambient" not in advection_diffusion(mesh, broad(1e-4), v=broad(v)).channels
    found = last_state(model, 80.0, np.linspace(0.0, 2.0, 41), lambda t: {"ambient": ambient})
    exact = ambient + (80.0 - ambient) * np.exp(-loss * mesh.p[0] / v)
    assert np.abs(found - exact).max() < 0.01


def test_flux_and_head_add_up():
    mesh = lp.interval(0.0, 1.0, 20)
    sides, times = {"left": 1.0, "right": 0.0}, np.linspace(0, 0.5, 11)
    both = advection_diffusion(mesh, broad(0.1), sides, v=broad(0.5), K=broad(2.0), L=4.0)
    one = advection_diffusion(mesh, broad(0.1), sides, v=broad(0.75))
    found = last_state(both, 0.0, times, lambda t: {"dH": 0.5})
    assert np.allclose(found, last_state(one, 0.0, times))


def test_a_measured_flow_carries_as_one_that_the_head_drives():
    mesh, times = lp.interval(0.0, 1.0, 20), np.linspace(0, 0.5, 11)
    given = mesh, broad(0.1), {"left": 1.0, "right": 0.0}
    more = {"dispersivity": broad(0.1), "ratio": 1.5, "stabilise": True}
    driven = advection_diffusion(*given, K=broad(2.0), L=4.0, **more)
    measured = advection_diffusion(*given, flow=True, **more)
    assert measured.channel_units["flow"] == "m/s"
    one = last_state(driven, 0.0, times, lambda t: {"dH": 2.0 * np.sin(9 * t)})
    two = last_state(measured, 0.0, times, lambda t: {"flow": np.sin(9 * t)})
    assert np.allclose(one, two, rtol=1e-12)


COLUMN_CASE = """
equation = "advection_diffusion"
initial = 10.0
mesh = { from = 0, to = 1, cells = 10 }
options = { stabilise = true, ratio = 1.5 }
data = { file = "bed.csv", time = "t", time_unit = "s" }
law = { kind = "sensitivity" }

[unknowns]
kappa = { prior = 1e-6, std = 1e-7, regions = { a = [0, 0.5], b = [0.5, 1] } }
K = { prior = 0, std = 1e-5 }

[channels]
T_0 = { role = "boundary", column = "T_0", at = "left" }
T_5 = { role = "sensor", column = "T_5", at = 0.5, noise = 0.1 }
"""


def test_in_a_case_the_head_goes_with_the_conductivity(tmp_path):
    case = tmp_path / "bed.toml"
    (tmp_path / "bed.csv").write_text("t,T_0,T_5,dH\n0,10,10,0.1\n600,11,10,0.1\n")
    case.write_text(COLUMN_CASE)
    with pytest.raises(CaseError, match="head difference"):
        load(case).prepare()
    case.write_text(COLUMN_CASE + 'dH = { role = "input", column = "dH" }\n')
    assert load(case).model.channels == ("dH", "T_0")


def test_in_a_case_a_measured_flow_needs_no_unknown_flux(tmp_path):
    case = tmp_path / "bed.toml"
    (tmp_path / "bed.csv").write_text("t,T_0,T_5,w\n0,10,10,1\n600,11,10,2\n")
    text = "\n".join(line for line in COLUMN_CASE.splitlines() if not line.startswith("K ="))
    flow = 'flow = { role = "input", column = "w", unit = "mm/h" }\n'
    case.write_text(f"{text}\n{flow}")
    prepared = load(case).prepare()
    assert prepared.identifier.model.channels == ("flow", "T_0")
    first = next(iter(prepared.stream))
    assert first.z["flow"] == pytest.approx(1e-3 / 3600.0)
    case.write_text(f'{text}\n[inputs]\nflow = "2 mm/h"\n')
    assert load(case).prepare().identifier.model.channels == ("T_0",)
    case.write_text(text)
    with pytest.raises(ModelError, match="the input flow"):
        load(case).prepare()


FIXED = {"left": 0.0, "right": 0.0}
STRING = lp.interval(0.0, 1.0, 40)
TIMES = np.arange(0.0, 2.01, 0.02)


def pluck(x):
    return np.exp(-(((x[0] - 0.3) / 0.1) ** 2))


def energy(model, u, c2=1.0):
    K = model.bilinear(lambda u, v, x: lp.dot(lp.grad(u.w), lp.grad(v.w)) * c2 + u.p * v.p)
    return 0.5 * u @ (K @ u)


def test_a_standing_wave_has_its_period():
    model = wave(STRING, lp.Normal(4.0), dirichlet=FIXED, element=ElementLineP2())
    start = {"w": lambda x: np.sin(np.pi * x[0]), "p": 0.0}
    run = simulate(model, np.array([4.0]), start, [0.0, 0.25, 1.0], Advance(Alexander2(), 0.01))
    first, quarter, last = (u for _, u in run)
    w = model.state_space.part("w")
    assert np.abs(last[w] - first[w]).max() < 5e-3
    assert np.abs(quarter[w]).max() < 5e-3


@pytest.mark.parametrize("d", [0.0, 0.8])
def test_the_energy_decays_only_by_damping(d):
    model = wave(STRING, lp.Normal(1.0), d, FIXED)
    start = {"w": lambda x: np.sin(np.pi * x[0]), "p": 0.0}
    run = simulate(model, np.ones(1), start, np.linspace(0, 2, 21), Advance(Alexander2(), 0.01))
    energies = np.array([energy(model, u) for _, u in run])
    assert np.all(np.diff(energies) < 1e-9)
    ratio = energies[-1] / energies[0]
    if d == 0.0:
        assert ratio == pytest.approx(1.0, abs=2e-3)
    else:  # w = exp(-d t/2) (cos(s t) + d/(2 s) sin(s t)) sin(pi x), s^2 = pi^2 - d^2/4
        s = np.sqrt(np.pi**2 - d**2 / 4)
        c, n = np.cos(2 * s), np.sin(2 * s)
        w, p = c + d / (2 * s) * n, -(s + d**2 / (4 * s)) * n
        exact = np.exp(-2 * d) * (np.pi**2 * w**2 + p**2) / np.pi**2
        assert ratio == pytest.approx(exact, rel=5e-3)


def test_a_moving_end_needs_its_velocity():
    moving = {"left": lambda x, t: np.sin(t)}
    with pytest.raises(ModelError, match="give its time derivative"):
        wave(STRING, lp.Normal(1.0), dirichlet=moving)
    speed = {"left": lambda x, t: np.cos(t)}
    model = wave(STRING, lp.Normal(1.0), dirichlet=moving, velocity=speed)
    u0 = {"w": 0.0, "p": lambda x: np.exp(-((x[0] / 0.1) ** 2))}
    *_, (_, u) = simulate(model, np.ones(1), u0, [0.0, 0.5], Advance(Alexander2(), 0.01))
    assert model.state_space.probe(np.array([[0.0]]), of="w") @ u == pytest.approx(np.sin(0.5))


@pytest.mark.slow
def test_speed_and_damping_from_two_points():
    model = wave(STRING, lp.Normal(1.3, 0.3), lp.Normal(0.2, 0.3), FIXED)
    sensors = lp.Points([0.45, 0.8], of="w", noise=0.01)
    twin = Twin(
        model=model,
        observation=sensors,
        q_true={"c2": 1.0, "d": 0.5},
        u0={"w": pluck, "p": 0.0},
        times=TIMES,
        scheme=Alexander2(),
        noise=AbsoluteNoise(0.01),
    )
    # The truth has the steps of the samples, too.
    law = lp.SensitivityLaw(shadows=lp.laws.Shadows(parts=1))
    ident = lp.Identifier(model, sensors, law, u0={"w": pluck, "p": 0.0}, scheme=Alexander2())
    (c2, c2_std), (d, d_std) = ident.run(twin).last.parameters.values()
    assert c2 == pytest.approx(1.0, abs=0.01)
    assert d == pytest.approx(0.5, abs=0.05)
    assert abs(c2 - 1.0) < 4 * c2_std
    assert abs(d - 0.5) < 4 * d_std


def kpp_wave(x, t):
    """Ablowitz and Zeppetella (1979): speed 5/sqrt(6)."""
    return (1.0 + np.exp((x - 5 / np.sqrt(6) * t) / np.sqrt(6))) ** -2.0


def sharp_wave(x, t):
    """Newman (1980): speed 1/sqrt(2), nothing beyond the front."""
    return np.maximum(1.0 - np.exp((x - t / np.sqrt(2)) / np.sqrt(2)), 0.0)


def error(function, wave, cells, span, **options):
    mesh = lp.interval(*span, cells)
    model = function(mesh, ONE, ONE, **options)
    times = np.linspace(0.0, 6.0, cells // 5 + 1)
    control = Advance(Alexander2())
    *_, (t, u) = simulate(model, np.ones(2), lambda x: wave(x[0], 0.0), times, control)
    return model.state_block.at_vertices @ u - wave(mesh.p[0], t)


@pytest.mark.slow
def test_the_exact_wave_of_fisher_kpp():
    coarse, fine = (np.abs(error(fisher_kpp, kpp_wave, n, (-20, 40))).max() for n in (150, 300))
    assert fine < 4e-4
    assert coarse / fine > 3.5  # second order in space and time


@pytest.mark.slow
def test_the_sharp_wave_of_porous_fisher():
    coarse, fine = (error(porous_fisher, sharp_wave, n, (-10, 20)) for n in (150, 600))
    assert np.abs(fine).max() < 3e-3  # at the foot
    assert np.abs(fine).mean() < 5e-5
    assert np.abs(coarse).mean() / np.abs(fine).mean() > 8


LEFT = {"left": 0.0}
RODS = {
    "heat": lambda mesh, by: lp.models.heat(mesh, by, LEFT),
    "conduction": lambda mesh, by: lp.models.conduction(mesh, by, LEFT, C=1.0),
    "advection_diffusion": lambda mesh, by: lp.models.advection_diffusion(
        mesh, by, LEFT, v=lp.Normal(0.0, std=1.0)
    ),
    "fisher_kpp": lambda mesh, by: lp.models.fisher_kpp(mesh, by, lp.LogNormal(1.0, 1.0)),
    "wave": lambda mesh, by: lp.models.wave(mesh, by, d=0.0, dirichlet=LEFT),
}


@pytest.mark.parametrize(
    ("regions", "said"),
    [
        ({"a": lambda x: x[0] < 0.4, "b": lambda x: x[0] > 0.6}, "0.45 lies in 0 regions of"),
        ({"a": lambda x: x[0] < 0.6, "b": lambda x: x[0] > 0.4}, "0.45 lies in 2 regions of"),
        ({"a": "core", "b": lambda x: x[0] > 0.4}, "0.45 lies in 2 regions of"),
        ({"a": lambda x: x[0] < 2.0, "b": lambda x: x[0] > 2.0}, "in the region 'b' of"),
    ],
)
@pytest.mark.parametrize("name", RODS)
def test_layers_with_gaps_or_overlaps_are_refused(name, regions, said):
    """The coefficient would be zero in a gap, and a sum where two layers overlap."""
    mesh = lp.interval(0.0, 1.0, 10, regions={"core": lambda x: x[0] < 0.5})
    with pytest.raises(lp.errors.ModelError, match=f"^{name}: .*{said}"):
        RODS[name](mesh, lp.Piecewise(regions, lp.LogNormal(1.0, std=0.5)))
    halves = {"a": "core", "b": lambda x: x[0] > 0.5}
    RODS[name](mesh, lp.Piecewise(halves, lp.LogNormal(1.0, std=0.5)))


@pytest.mark.parametrize(
    ("C", "said"),
    [
        (lambda x: 1.0 - 2.0 * (x[0] > 0.5), "must be positive everywhere; its least value is -1"),
        (lambda x: 1.0 * (x[0] > 0.5), "must be positive everywhere; its least value is 0"),
        (np.nan, "must be positive; got nan"),
        ("2e6", "must be positive; got '2e6'"),
    ],
)
def test_a_heat_capacity_is_positive_everywhere(C, said):
    with pytest.raises(ModelError, match=said):
        conduction(lp.interval(0.0, 1.0, 10), lp.LogNormal(1.0, std=0.5), LEFT, C=C)


@pytest.mark.parametrize(
    ("coordinates", "shape", "rate"),
    [
        ("cylinder", lambda r: j0(jn_zeros(0, 1)[0] * r), jn_zeros(0, 1)[0] ** 2),
        ("sphere", np.sinc, np.pi**2),
    ],
)
def test_heat_around_an_axis_or_a_centre_decays_at_its_rate(coordinates, shape, rate):
    model = heat(
        lp.interval(0.0, 1.0, 40), lp.LogNormal(2.0, 1.0), {"right": 0.0}, coordinates=coordinates
    )
    places = {"centre": 0.0, "half": 0.5}
    sensors, scheme = lp.Points(places, noise=1e-4), lp.Alexander2()
    identifier = lp.Identifier(model, sensors, scheme=scheme, u0=lambda x: shape(x[0]))
    for t in np.arange(0.0, 0.2, 0.005):
        decayed = {name: shape(r) * np.exp(-1.3 * rate * t) for name, r in places.items()}
        estimate = identifier.step(t, decayed)
    assert estimate.parameters["alpha"][0] == pytest.approx(1.3, rel=2e-3)


@pytest.mark.parametrize(
    ("mesh", "coordinates", "told"),
    [
        (lp.interval(-1.0, 1.0, 4), "cylinder", "begins at -1; expected 0 or more"),
        (lp.rectangle((0.0, 1.0), (0.0, 1.0), (2, 2)), "sphere", "requires an interval of radii"),
        (lp.interval(0.0, 1.0, 4), "polar", "expected one of cartesian, cylinder, sphere"),
    ],
)
def test_coordinates_that_do_not_fit_the_mesh(mesh, coordinates, told):
    with pytest.raises(lp.errors.ModelError, match=told):
        heat(mesh, lp.LogNormal(1.0, 1.0), coordinates=coordinates)
