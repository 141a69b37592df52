"""Theory report of a run: the paper's quantities on one page, with or without the truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp

from livepde.diagnostics.check_report import CheckReport, Table
from livepde.diagnostics.theory import error_bounds
from livepde.diagnostics.theory.constants import Spaces, constants
from livepde.diagnostics.theory.excitation import Excitation, Spectrum, interpolation, link
from livepde.errors import ConfigurationError, LivepdeError
from livepde.estimate import Estimate
from livepde.fem import Inputs, Moment
from livepde.identifier import Identifier
from livepde.laws.damping import Constants, Damping, Norms
from livepde.linalg import Array
from livepde.samples import Channels, Sample, sample_of
from livepde.streams import Twin

DEFINITIONS = {
    "L_C": ("LipschitzC", "|C(q,u+v+w) - C(q,u)|_X <= L_C (|v|_V~ + |w|_V^)"),
    "C_A": ("AbdX, AbdV, AbdVV", "|A(u+v)|_{Q->X} <= C_A (1 + |v|)"),
    "c_M": ("ass:equation 5", "(M v, v)_X >= c_M |v|_VX~^2"),
    "C_M": ("ass:equation 5", "|R M v|_X <= C_M |v|_V~"),
    "c_N": ("ass:equation 5", "(N v, v)_X >= c_N |v|_VX^^2"),
    "C_N": ("ass:equation 5", "|P N v|_X <= C_N |v|_V^"),
    "observed_V_VX": ("embedding", "|v|_VX~ <= C |v|_V~"),
    "observed_VX_X": ("embedding", "|v|_X <= C |v|_VX~"),
    "hidden_V_VX": ("embedding", "|v|_VX^ <= C |v|_V^"),
    "hidden_VX_X": ("embedding", "|v|_X <= C |v|_VX^"),
    "observed_ratio": ("interpol", "|v|_V~ |v|_X <= C |v|_VX~^2, 1/c_int"),
    "hidden_ratio": ("interpol", "|v|_V^ |v|_X <= C |v|_VX^^2"),
}
NEEDS_TRUTH = (
    "Without the truth u*, q* these cannot be evaluated: the errors e, r, p and with them the "
    "conditions on mu and nu (cond:mu_1, cond:mu02, cond:nu, ass:mu_nu, ass:mu_nu_smooth), the "
    "error bounds of the three propositions, T* itself, and lambda of the link conditions. A twin "
    "experiment of the same model evaluates them."
)
LINKED = (
    "That the error of q vanishes (th:parameter), or is at most 2 gamma_0/epsilon_0 sup ||d~||_X "
    "in the limit (th:parameter_noisesmooth), is promised only with persistence of excitation "
    "(asspof) and the link conditions (cond:link). Those fail for every data error that does not "
    "vanish."
)
# Number of states at which C_A is computed.
SNAPSHOTS = 6
# Number of modes in the table.
SHOWN = 8
NORMS = ("X", "VX", "V")
DIGITS = 4  # of the numbers of the page
# Number of cached matrices of G_alpha, one for each alpha.
MATRICES = 16


@dataclass(frozen=True, eq=False)
class TheoryReport:
    """Theory report of a run, as returned by `theory_report`.

    Attributes
    ----------
    tables, notes
        Quantities that could be evaluated, and those that could not, with reasons.
    reports
        Conditions and error bounds; only with a truth.
    constants, spectrum, stopping
        The numbers behind the tables; None if they could not be computed. `stopping` is the
        surrogate of T*, infinity if it was not reached.
    """

    tables: tuple[Table, ...]
    reports: tuple[CheckReport, ...] = ()
    notes: tuple[str, ...] = ()
    constants: Constants | None = None
    spectrum: Spectrum | None = None
    stopping: float | None = None

    def markdown(self, title: str = "Theory") -> str:
        """Return the report in Markdown."""
        parts = [f"# {title}", *(table.markdown(DIGITS) for table in self.tables)]
        parts += [f"```\n{report}\n```" for report in self.reports]
        parts += [f"> {note}" for note in self.notes]
        return "\n\n".join(parts) + "\n"


@dataclass(frozen=True)
class _Moment:
    """Online quantities of one sample."""

    t: float
    r: Norms
    theta: float
    d: Norms | None


class OnlineTracker:
    """Tracker of a run without its truth: residual, theta, excitation, surrogate of T*.

    Parameters
    ----------
    identifier
        Identifier whose model, sensors and law are used; it is not changed.
    window
        gamma_0 of the excitation Gramian and the link conditions.
    noise
        Standard deviation of the sensors: one number, one for each, or a function of z that returns
        them; default from the observation.
    """

    def __init__(self, identifier: Identifier, window: float, noise: Any = None) -> None:
        self.identifier = identifier
        self.window = window
        law, model = identifier.law, identifier.model
        self.channels = Channels(model.channels, identifier.observed, identifier.validation)
        self.gain = float(getattr(law, "gain", 1.0))
        damping = getattr(law, "damping", None)
        self.damping: Damping | None = damping if isinstance(damping, Damping) else None
        self.spaces = Spaces.of(model, identifier.observed, law)
        self.excitation = Excitation(self.spaces, window, self.gain)
        self.excited = self.excitation.init()
        self.moments: list[_Moment] = []
        self.states: list[Array] = []
        self.inputs: dict[str, float] = {}
        self.last: Estimate | None = None
        self.noise = identifier.observed.noise if noise is None else noise
        self._every = 1
        self._matrices: dict[int, Array | sp.csr_array] = {}
        self._sizes: dict[int, Norms] = {}

    def add(self, estimate: Estimate, sample: Sample) -> None:
        """Record one estimate; failed steps and samples without measurements are ignored."""
        model, observed = self.identifier.model, self.identifier.observed
        z, _, _, named = self.channels.parse(sample.z, sample.inputs or {})
        self.inputs |= {name: named[name] for name in model.channels if name in named}
        z[~np.isfinite(estimate.innovation)] = np.nan
        if not estimate.status.ok or not np.isfinite(z).any():
            return
        moment = Moment(estimate.t, Inputs(self.inputs))
        boundary = model.impose(np.zeros(model.X.dim), moment)
        _, direct = observed.jacobian(estimate.u, estimate.q, moment)
        if direct is not None:
            z = z - direct @ estimate.q
        z = observed.linearised(z, estimate.u)
        if self.damping is None:  # a law without a damping rule uses no G_alpha
            u_alpha, alpha = observed.split(np.isfinite(z)).reconstruct(z, boundary), 0.0
        else:
            found = observed.reconstruct(z, boundary=boundary)
            u_alpha, alpha = found.u, found.alpha
        r = observed.split(np.isfinite(z)).R @ (estimate.u - boundary) - u_alpha
        part = self.spaces.observed_part
        norms = part.norms(r)
        theta = np.nan
        if self.damping is not None:
            size = part.stage_norms(u_alpha)
            theta = self.damping.theta(part.stage_norms(r).residual(size))
        d = self._noise_size(z, u_alpha, alpha)
        self.moments.append(_Moment(estimate.t, norms, theta, d))
        # Only a law with a damping rule uses u_alpha + P u.
        w = estimate.u if self.damping is None else estimate.u - r
        self.excited = self.excitation.add(self.excited, estimate.t, w, self.inputs, estimate.q)
        self.last = estimate
        self._keep_state(estimate)

    def _keep_state(self, estimate: Estimate) -> None:
        if (len(self.moments) - 1) % self._every == 0:
            self.states.append(estimate.u)
            if len(self.states) > 2 * SNAPSHOTS:
                # The length of the run is unknown: snapshots are thinned and their spacing doubled
                # whenever there are too many, so that they always cover the whole run.
                self.states = self.states[::2]
                self._every *= 2

    def _noise_size(self, z: Array, u_alpha: Array, alpha: float) -> Norms | None:
        """Return the size of d, with G_alpha linearised at an alpha within a factor of 1.5."""
        if self.noise is None:
            return None
        observed, part = self.identifier.observed, self.spaces.observed_part
        # One matrix for each octave of alpha: the discrepancy principle gives another alpha for
        # every sample, and each matrix is dense.
        key = round(float(np.log2(alpha))) if alpha > 0 else 0
        matrix = self._matrix(key, alpha)
        if callable(self.noise) or key not in self._sizes:
            given = self.noise(z) if callable(self.noise) else self.noise
            std = np.broadcast_to(np.asarray(given, dtype=float), (observed.size,))
            self._sizes[key] = error_bounds.noise_size(self.spaces, std, matrix)
        noise = self._sizes[key]
        if alpha == 0:
            return noise
        lost = part.norms(matrix @ (observed.G @ u_alpha) - u_alpha)
        return Norms(*(float(np.hypot(getattr(noise, n), getattr(lost, n))) for n in NORMS))

    def _matrix(self, key: int, alpha: float) -> Array | sp.csr_array:
        """Return the matrix of G_alpha, cached by the number of the octave of alpha."""
        if key not in self._matrices:
            if len(self._matrices) >= MATRICES:
                self._matrices.clear()
                self._sizes.clear()
            observed = self.identifier.observed
            self._matrices[key] = (
                error_bounds.reconstruction_matrix(observed, alpha)
                if alpha > 0
                else observed.split().inverse
            )
        return self._matrices[key]

    @property
    def moment(self) -> Moment:
        """Time and inputs of the last sample."""
        t = self.last.t if self.last is not None else 0.0
        return Moment(t, Inputs(self.inputs))

    def constants(self) -> Constants:
        """Return the constants at the last q and at states along the run."""
        if self.last is None:
            raise ConfigurationError("theory: no sample of the run contains a measurement.")
        return constants(self.spaces, self.last.q, self.states, moment=self.moment, gain=self.gain)

    def stopping(self, c: Constants) -> error_bounds.StoppingState:
        """Return the surrogate of T*, which needs a noise level."""
        rule = error_bounds.OnlineStopping(c)
        state = rule.init()
        for item in self.moments:
            if item.d is not None:
                state = rule.add(state, item.t, item.r, item.d)
        return state

    def series(self, get: str) -> Array:
        """Return "t", "theta", "X", "VX" or "V" along the run, shape (samples,)."""
        if get in ("X", "VX", "V"):
            return np.array([getattr(item.r, get) for item in self.moments])
        return np.array([getattr(item, get) for item in self.moments])


def theory_report(
    identifier: Identifier,
    samples: Iterable[Any],
    *,
    window: float | None = None,
    noise: Any = None,
    twin: Twin | None = None,
) -> TheoryReport:
    """Run an identifier and evaluate the quantities of the paper's theory along the run.

    Quantities that cannot be evaluated are listed in a note, never guessed.

    Parameters
    ----------
    identifier
        New identifier, before its first sample.
    samples
        Items of a stream: `Sample`, (t, z) or (t, z, inputs).
    window
        gamma_0; default a twentieth of the run.
    noise
        Standard deviation of the sensors, for the surrogate of T*; default from the observation.
    twin
        Twin with the truth, if available; its samples are then used.

    Raises
    ------
    ConfigurationError
        The stream contains fewer than two samples, or the gain is not constant.
    """
    items = [sample_of(item) for item in samples]
    _check(identifier, items)
    if window is None:
        window = max((items[-1].t - items[0].t) / 20.0, 1e-12)
    tracker = OnlineTracker(identifier, window, noise)
    notes: list[str] = []
    followed = None if twin is None else _followed(tracker, twin, notes)
    for sample in items:
        estimate = identifier.step(sample.t, sample.z, sample.inputs)
        tracker.add(estimate, sample)
        if followed is not None and estimate.status.ok:
            followed.add(estimate, sample.z)
    tables: list[Table] = []
    found = _constants(tracker, tables, notes)
    tables += _residual_tables(tracker, notes)
    stopping = None if found is None else _stopping(tracker, found, tables, notes)
    spectrum = _spectrum(tracker, tables, notes)
    reports: list[CheckReport] = []
    if followed is None or found is None:
        notes.append(NEEDS_TRUTH)
    else:
        reports = _with_truth(followed, found, identifier.law, tables)
        notes.append(LINKED)
    return TheoryReport(tuple(tables), tuple(reports), tuple(notes), found, spectrum, stopping)


def _check(identifier: Identifier, items: Sequence[Sample]) -> None:
    if len(items) < 2:
        raise ConfigurationError(f"theory: needs at least two samples; got {len(items)}.")
    if getattr(identifier.law, "gain", 1.0) == "auto":
        raise ConfigurationError(
            "theory: the paper's quantities are those of a constant gain; give a number for `gain`."
        )


def _followed(
    tracker: OnlineTracker, twin: Twin, notes: list[str]
) -> error_bounds.TwinTracker | None:
    try:
        return error_bounds.TwinTracker(twin, tracker.spaces, tracker.gain, tracker.damping)
    except ConfigurationError as error:
        notes.append(str(error))
        return None


def _constants(tracker: OnlineTracker, tables: list[Table], notes: list[str]) -> Constants | None:
    try:
        c = tracker.constants()
    except LivepdeError as error:
        notes.append(f"The constants cannot be computed: {error}")
        return None
    how = dict.fromkeys(DEFINITIONS, "an eigenvalue")
    how |= dict.fromkeys(("C_A", "observed_ratio", "hidden_ratio"), "a bound")
    how |= dict.fromkeys(c.sampled, "estimated from below, by sampling")
    rows = [
        (name, float(getattr(c, name)), text, label, how[name])
        for name, (label, text) in DEFINITIONS.items()
    ]
    columns = ("constant", "value", "definition", "in the paper", "is")
    tables.append(Table("Constants of the discretised model", columns, rows))
    return c


def _residual_tables(tracker: OnlineTracker, notes: list[str]) -> list[Table]:
    if not tracker.moments:
        notes.append("No sample contains a measurement, so there is no residual.")
        return []
    X, VX, V = (tracker.series(name) for name in ("X", "VX", "V"))
    theta = tracker.series("theta")
    rows: list[tuple[Any, ...]] = [
        _range("||R u - u_alpha||_X", X),
        _range("||R u - u_alpha||_VX~", VX),
        _range("||R u - u_alpha||_V~", V),
    ]
    if tracker.damping is not None:
        rows += [_range("theta", theta), _range("mu = theta ||R u - u_alpha||_V~", theta * V)]
    else:
        notes.append("The law has no damping rule, so there is no theta, no mu and no kappa.")
    columns = ("along the run", "least", "median", "largest", "last")
    tables = [Table("Residual and damping", columns, rows)]
    rows = []
    try:
        quotients = interpolation([item.r for item in tracker.moments])
        rows.append(
            (
                "interpol",
                f"c_int = {quotients.c_int:.3g}, C_int = {quotients.C_int:.3g}",
                "||r||_VX~^2 against ||r||_V~ ||r||_X",
            )
        )
    except ConfigurationError as error:
        notes.append(str(error))
    if tracker.damping is not None:
        try:
            kappa = link(tracker.series("t"), theta * V, theta * VX**2, tracker.window)
            rows.append(("cond:link, kappa", str(kappa), "mu^kappa against theta of the paper"))
        except ConfigurationError as error:
            notes.append(f"Link condition of kappa: {error}")
    if rows:
        tables.append(Table("Conditions on the residual", ("label", "measured", "of"), rows))
    return tables


def _range(name: str, values: Array) -> tuple[Any, ...]:
    numbers = (values.min(), np.median(values), values.max(), values[-1])
    return (name, *(float(number) for number in numbers))


def _stopping(
    tracker: OnlineTracker, c: Constants, tables: list[Table], notes: list[str]
) -> float | None:
    if tracker.noise is None or not tracker.moments:
        notes.append(
            "No noise level is known, so there is no surrogate of T*: give the noise of the "
            "sensors."
        )
        return None
    state = tracker.stopping(c)
    d = tracker.moments[-1].d or Norms()
    verdict = f"{state.T:.5g}" if np.isfinite(state.T) else "not reached"
    tables.append(
        Table(
            "Surrogate of T*, the first violation of (cond_d)",
            ("T*", "margin at the end", "||d||_X", "||d||_VX~", "||d||_V~"),
            [(verdict, state.margin, d.X, d.VX, d.V)],
        )
    )
    return state.T


def _spectrum(tracker: OnlineTracker, tables: list[Table], notes: list[str]) -> Spectrum | None:
    try:
        spectrum = tracker.excitation.spectrum(tracker.excited)
    except LivepdeError as error:
        notes.append(f"Excitation Gramian: {error}")
        return None
    parts = tracker.identifier.model.latent.parts
    rows = []
    for k in range(min(SHOWN, len(spectrum.strength))):
        mode = spectrum.modes[:, k]
        sizes = {name: float(np.linalg.norm(mode[item.part])) for name, item in parts.items()}
        largest = max(sizes, key=lambda name: sizes[name])
        first = float(spectrum.strength[0]) or 1.0
        strength = float(spectrum.strength[k])
        rows.append((k + 1, strength, strength / first, largest))
    pinned = spectrum.pinned()
    title = (
        f"Excitation (asspof), windows of {tracker.window:.4g}: {pinned} of "
        f"{len(spectrum.strength)} modes of q within 1 % of the strongest"
    )
    tables.append(Table(title, ("mode", "strength", "relative", "mostly in"), rows))
    return spectrum


def _with_truth(
    tracker: error_bounds.TwinTracker, c: Constants, law: Any, tables: list[Table]
) -> list[CheckReport]:
    nu, sigma = getattr(law, "nu", 0.0), getattr(law, "sigma", 0.0)
    nu = float(nu) if isinstance(nu, int | float) else 0.0
    errors = tracker.errors
    noisy = tracker.twin.noise is not None
    T = error_bounds.stopping_time(errors, c) if noisy else np.inf
    first, last = errors[0], errors[-1]
    rows: list[tuple[Any, ...]] = [
        ("||e||_Q", first.e, last.e),
        ("||r||_X", first.r.X, last.r.X),
        ("||p||_X", first.p.X, last.p.X),
        ("||p||_V^", first.p.V, last.p.V),
        ("||e||_Q^2 + ||r||_X^2", first.energy, last.energy),
    ]
    if noisy:
        rows.append(("T* with truth", "", T))
    tables.append(Table("Errors against the truth", ("norm", "start", "end"), rows))
    data: Any = "noisy" if noisy else "exact"
    q_true = tracker.q_true
    return [
        error_bounds.conditions(errors, c, data=data, nu=nu, sigma=sigma),
        error_bounds.bounds(errors, c, data=data, nu=nu, sigma=sigma, q_true=q_true, until=T),
    ]
