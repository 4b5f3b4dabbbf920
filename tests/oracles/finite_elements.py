"""A finite-element Euler-Bernoulli beam under travelling loads, independent of jaxbeam.

Hermite cubic elements, consistent mass, every support, patch edge and suspension on a node.
SI units; deflection is positive upwards, positions run from the left end, a load pushes down.

The beam with its supports and patches gives the modes. Suspensions (a shaker's spring, damper and
moving mass) act on these modes, coupled. Modal damping belongs to the modes without suspensions.
A run keeps the first `modes` of them, or all, which then is the full finite-element system.

A travelling mass m at x(t) stays on the beam (the contact may pull) and presses on it with

    m (g + w_tt + 2 x' w_xt + x'^2 w_xx + x'' w_x)      at x = x(t),

a travelling force with m g. The integration (DOP853) restarts whenever a load enters, leaves,
stops or passes a node, where w_xx of the elements jumps. The modal velocities are continuous
there: a mass that enters over a moving end takes up the motion of the end without an impact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import eigh, expm

GRAVITY = 9.81


@dataclass(frozen=True)
class Support:
    """A support: rigid in deflection unless it has a stiffness; may also resist rotation."""

    position: float
    stiffness: float | None = None  # N/m; None is rigid, 0.0 leaves the deflection free
    damping: float = 0.0  # N s/m
    rotational_stiffness: float = 0.0  # N m/rad
    rotational_damping: float = 0.0  # N m s/rad


@dataclass(frozen=True)
class Patch:
    """Stiffness and mass bonded to the beam between two positions."""

    start: float
    end: float
    flexural_rigidity: float = 0.0  # N m^2, added
    mass_per_length: float = 0.0  # kg/m, added


@dataclass(frozen=True)
class Suspension:
    """A point spring, damper and mass between beam and ground: a passive shaker."""

    position: float
    stiffness: float = 0.0  # N/m
    damping: float = 0.0  # N s/m
    mass: float = 0.0  # kg


@dataclass(frozen=True)
class Beam:
    length: float
    flexural_rigidity: float | Callable[[float], float]  # or a function of x, constant per element
    mass_per_length: float | Callable[[float], float]
    ends: str = "pinned-pinned"  # pinned, clamped, free or guided, left-right
    supports: Sequence[Support] = ()
    patches: Sequence[Patch] = ()
    suspensions: Sequence[Suspension] = ()
    damping_ratio: float | Sequence[float] = 0.0  # one for all modes, or the first few modes' own
    damped_modes: int | None = None  # how many modes one damping ratio reaches; None is all
    rayleigh: tuple[float, float] = (0.0, 0.0)  # damping matrix = first * mass + second * stiffness
    elements: int = 40  # at least so many


@dataclass(frozen=True)
class Load:
    """A load that enters at the left end, or at the right end if its speed is negative."""

    mass: float  # kg
    speed: float  # m/s at entry
    entry_time: float = 0.0  # s
    deceleration: float = 0.0  # m/s^2, against the travel; a load that stops stays
    kind: str = "mass"  # or "force", which is the weight of `mass` alone

    def time_at(self, distance: float) -> float:
        """When the load has travelled `distance` from its entry; infinite if it never does."""
        v, a = abs(self.speed), self.deceleration
        root = v**2 - 2.0 * a * distance
        return self.entry_time + 2.0 * distance / (v + root**0.5) if root >= 0.0 else np.inf

    @property
    def stop_time(self) -> float:
        a = self.deceleration
        return self.entry_time + abs(self.speed) / a if a > 0.0 else np.inf

    def motion(self, t: float, length: float, stopped: bool) -> tuple[float, float, float]:
        """Position, velocity and acceleration along the beam at time t."""
        s = min(t, self.stop_time) - self.entry_time if stopped else t - self.entry_time
        v, a = abs(self.speed), self.deceleration
        x, dx, ddx = v * s - 0.5 * a * s**2, v - a * s, -a
        if stopped:
            dx, ddx = 0.0, 0.0
        return (x, dx, ddx) if self.speed > 0.0 else (length - x, -dx, -ddx)


@dataclass(frozen=True)
class Model:
    """The assembled beam: matrices over the two degrees of freedom (deflection, slope) per node."""

    beam: Beam
    nodes: np.ndarray
    mass: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray  # of the supports alone
    free: np.ndarray  # indices of the unconstrained degrees of freedom

    def shape(self, x: float, derivative: int = 0, element: int | None = None) -> np.ndarray:
        """The row that takes nodal values to the deflection at x, or to its x-derivative."""
        if element is None:
            element = int(np.clip(np.searchsorted(self.nodes, x) - 1, 0, len(self.nodes) - 2))
        row = np.zeros(2 * len(self.nodes))
        left, right = self.nodes[element], self.nodes[element + 1]
        row[2 * element : 2 * element + 4] = hermite(x - left, right - left, derivative)
        return row

    def patch_row(self, start: float, end: float) -> np.ndarray:
        """Nodal forces of a unit patch moment: it lifts the beam between its two ends."""
        return self.shape(start, 1) - self.shape(end, 1)

    def modes(self, count: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Angular frequencies (mode,) and mass-normalised shapes (degree of freedom, mode)."""
        at = np.ix_(self.free, self.free)
        squares, vectors = eigh(self.stiffness[at], self.mass[at])
        squares[squares < 1e-13 * squares[-1]] = 0.0  # rigid-body modes
        shapes = np.zeros((len(self.mass), len(squares)))
        shapes[self.free] = vectors
        return np.sqrt(squares[:count]), shapes[:, :count]


def hermite(s: float, h: float, derivative: int = 0) -> np.ndarray:
    """The four cubic shape functions of an element of length h at distance s from its left end."""
    z = s / h
    rows = (
        (1 - 3 * z**2 + 2 * z**3, h * (z - 2 * z**2 + z**3), 3 * z**2 - 2 * z**3, h * (z**3 - z**2)),
        (6 * z**2 - 6 * z, h * (1 - 4 * z + 3 * z**2), 6 * z - 6 * z**2, h * (3 * z**2 - 2 * z)),
        (12 * z - 6, h * (6 * z - 4), 6 - 12 * z, h * (6 * z - 2)),
        (12.0, 6 * h, -12.0, 6 * h),
    )
    return np.array(rows[derivative]) / h**derivative


def mesh(beam: Beam, extra: Sequence[float] = ()) -> np.ndarray:
    """Nodes from 0 to the length, one on every support, patch edge, suspension and extra point."""
    points = {0.0, beam.length, *extra, *(p for b in beam.patches for p in (b.start, b.end))}
    points |= {b.position for b in (*beam.supports, *beam.suspensions)}
    fixed = np.array(sorted(points))
    fixed = fixed[np.append(True, np.diff(fixed) > 1e-9 * beam.length)]
    counts = np.ceil(np.diff(fixed) * beam.elements / beam.length - 1e-9).astype(int)
    spans = zip(fixed[:-1], fixed[1:], counts, strict=True)
    return np.append(np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in spans]),
                     beam.length)  # fmt: skip


def assemble(beam: Beam, extra_nodes: Sequence[float] = ()) -> Model:
    nodes = mesh(beam, extra_nodes)
    size = 2 * len(nodes)
    mass, stiffness, damping = (np.zeros((size, size)) for _ in range(3))
    for e, (left, right) in enumerate(zip(nodes[:-1], nodes[1:], strict=True)):
        h, middle = right - left, 0.5 * (left + right)
        over = [p for p in beam.patches if p.start < middle < p.end]
        rigidity = _at(beam.flexural_rigidity, middle) + sum(p.flexural_rigidity for p in over)
        density = _at(beam.mass_per_length, middle) + sum(p.mass_per_length for p in over)
        at = slice(2 * e, 2 * e + 4)
        stiffness[at, at] += rigidity / h**3 * np.array(
            [[12, 6 * h, -12, 6 * h],
             [6 * h, 4 * h**2, -6 * h, 2 * h**2],
             [-12, -6 * h, 12, -6 * h],
             [6 * h, 2 * h**2, -6 * h, 4 * h**2]])  # fmt: skip
        mass[at, at] += density * h / 420 * np.array(
            [[156, 22 * h, 54, -13 * h],
             [22 * h, 4 * h**2, 13 * h, -3 * h**2],
             [54, 13 * h, 156, -22 * h],
             [-13 * h, -3 * h**2, -22 * h, 4 * h**2]])  # fmt: skip

    fixed: list[int] = []
    for end, dof in zip(beam.ends.split("-"), (0, size - 2), strict=True):
        fixed += {"pinned": [dof], "clamped": [dof, dof + 1], "free": [], "guided": [dof + 1]}[end]
    for support in beam.supports:
        dof = 2 * int(np.argmin(np.abs(nodes - support.position)))
        if support.stiffness is None:
            fixed.append(dof)
        else:
            stiffness[dof, dof] += support.stiffness
            damping[dof, dof] += support.damping
        stiffness[dof + 1, dof + 1] += support.rotational_stiffness
        damping[dof + 1, dof + 1] += support.rotational_damping
    free = np.setdiff1d(np.arange(size), fixed)
    return Model(beam, nodes, mass, stiffness, damping, free)


def natural_frequencies(beam: Beam, count: int) -> np.ndarray:
    """The first natural frequencies in Hz, without suspensions."""
    return assemble(beam).modes(count)[0] / (2.0 * np.pi)


def static_deflection(
    beam: Beam,
    positions: Sequence[float],
    forces: Sequence[tuple[float, float]] = (),
    moments: Sequence[tuple[float, float]] = (),
    patch_moments: Sequence[tuple[float, float, float]] = (),
) -> np.ndarray:
    """Deflection at `positions` under (position, upward force), (position, moment that turns the
    beam anticlockwise) and (start, end, patch moment); exact, suspensions included."""
    extra = [*positions, *(f[0] for f in forces), *(m[0] for m in moments)]
    model = assemble(beam, [*extra, *(x for p in patch_moments for x in p[:2])])
    stiffness = model.stiffness.copy()
    for s in beam.suspensions:
        stiffness += s.stiffness * np.outer(model.shape(s.position), model.shape(s.position))
    load = np.zeros(len(stiffness))
    for x, force in forces:
        load += force * model.shape(x)
    for x, moment in moments:
        load += moment * model.shape(x, 1)
    for start, end, moment in patch_moments:
        load += moment * model.patch_row(start, end)
    at = model.free
    deflection = np.zeros(len(load))
    deflection[at] = np.linalg.solve(stiffness[np.ix_(at, at)], load[at])
    return np.array([model.shape(x) @ deflection for x in positions])


@dataclass(frozen=True)
class Response:
    times: np.ndarray  # (time,) s
    deflection: np.ndarray  # (time, sensor) m
    velocity: np.ndarray  # (time, sensor) m/s
    acceleration: np.ndarray  # (time, sensor) m/s^2
    contact_force: np.ndarray  # (time, load) N, positive where the load presses; 0 off the beam
    modal: np.ndarray = field(repr=False)  # (time, mode) modal coordinates and, below, rates
    modal_rate: np.ndarray = field(repr=False)


def respond(
    beam: Beam,
    loads: Sequence[Load],
    sensors: Sequence[float],
    times: np.ndarray,
    *,
    modes: int | None = None,
    initial: tuple[np.ndarray, np.ndarray] | None = None,
    force: Callable[[float], np.ndarray] | None = None,
    breaks: Sequence[float] = (),
    rtol: float = 1e-11,
    atol: float = 1e-14,
) -> Response:
    """The beam's motion at the increasing `times`, from t = 0 and rest (or `initial` modal
    coordinates and rates). `force` gives further nodal forces, over the degrees of freedom of
    `assemble(beam)`, as a function of time, which may jump at the `breaks`."""
    model = assemble(beam)
    omega, shapes = model.modes(modes)
    n = len(omega)
    stiffness, damping, inertia = _modal_matrices(model, omega, shapes)
    mobility = np.linalg.inv(inertia)
    scale = np.append(np.maximum(omega, 1.0), np.ones(n))  # for well-scaled exponentials
    upper, lower = [np.zeros((n, n)), np.eye(n)], [-mobility @ stiffness, -mobility @ damping]
    state_matrix = scale[:, None] * np.block([upper, lower]) / scale
    propagators: dict[float, np.ndarray] = {}

    def accelerations(t: float, y: np.ndarray, active: list[_Contact]) -> tuple:
        """Modal accelerations and the contact forces of the active loads."""
        q, u = y[:n], y[n:]
        push = -damping @ u - stiffness @ q
        if force is not None:
            push = push + shapes.T @ force(t)
        rows = np.empty((len(active), n))
        excess = np.empty(len(active))  # contact acceleration but for the modal accelerations
        for i, contact in enumerate(active):
            x, dx, ddx = contact.load.motion(t, beam.length, contact.stopped)
            s = x - contact.left
            nodal = shapes[2 * contact.element : 2 * contact.element + 4]
            rows[i] = hermite(s, contact.h) @ nodal
            slope, curvature = (hermite(s, contact.h, d) @ nodal for d in (1, 2))
            excess[i] = 2 * dx * slope @ u + dx**2 * curvature @ q + ddx * slope @ q
        pressing = np.array([c.load.mass * GRAVITY for c in active])
        heavy = np.array([c.load.kind == "mass" for c in active], dtype=bool)
        if heavy.any():
            push = push - pressing[~heavy] @ rows[~heavy]
            spread = mobility @ rows[heavy].T
            masses = np.array([c.load.mass for c in active])[heavy]
            compliance = np.diag(1.0 / masses) + rows[heavy] @ spread
            known = GRAVITY + excess[heavy] + spread.T @ push
            pressing[heavy] = np.linalg.solve(compliance, known)
            push = push - pressing[heavy] @ rows[heavy]
        else:
            push = push - pressing @ rows
        return mobility @ push, pressing

    y = np.zeros(2 * n) if initial is None else np.concatenate(initial)
    states = np.zeros((len(times), 2 * n))
    second = np.zeros((len(times), n))
    contact_force = np.zeros((len(times), len(loads)))
    limits = _break_points(model, loads, breaks, times[-1])
    for k, (start, end) in enumerate(zip(limits[:-1], limits[1:], strict=True)):
        last = k == len(limits) - 2
        wanted = np.flatnonzero((times >= start) & ((times <= end) if last else (times < end)))
        marks = np.append(times[wanted], end)
        active = _contacts(model, loads, 0.5 * (start + end))
        if active or force is not None:
            solution = solve_ivp(
                lambda t, y, a=active: np.append(y[n:], accelerations(t, y, a)[0]),
                (start, end), y, method="DOP853", t_eval=np.unique(marks), rtol=rtol, atol=atol,
            )  # fmt: skip
            if not solution.success:
                raise RuntimeError(solution.message)
            path = solution.y.T[np.searchsorted(solution.t, marks)]
        else:  # free vibration, exactly
            path, t = np.empty((len(marks), 2 * n)), start
            for i, mark in enumerate(marks):
                step = float(mark - t)
                if step not in propagators:
                    propagators[step] = expm(state_matrix * step) * scale / scale[:, None]
                path[i] = propagators[step] @ (path[i - 1] if i else y)
                t = mark
        for i, state in zip(wanted, path, strict=False):
            states[i] = state
            second[i], pressing = accelerations(times[i], state, active)
            contact_force[i, [c.index for c in active]] = pressing
        y = path[-1]

    rows = np.array([model.shape(x) for x in sensors]).reshape(len(sensors), -1) @ shapes
    q, u = states[:, :n], states[:, n:]
    return Response(times, q @ rows.T, u @ rows.T, second @ rows.T, contact_force, q, u)


@dataclass(frozen=True)
class _Contact:
    """A load on one element."""

    load: Load
    index: int
    element: int
    left: float
    h: float
    stopped: bool


def _contacts(model: Model, loads: Sequence[Load], t: float) -> list[_Contact]:
    """The loads on the beam at time t."""
    length, found = model.beam.length, []
    for index, load in enumerate(loads):
        if load.entry_time < t < load.time_at(length):
            stopped = t > load.stop_time
            x = load.motion(t, length, stopped)[0]
            element = int(np.clip(np.searchsorted(model.nodes, x) - 1, 0, len(model.nodes) - 2))
            left, right = model.nodes[element : element + 2]
            found.append(_Contact(load, index, element, left, right - left, stopped))
    return found


def _break_points(
    model: Model, loads: Sequence[Load], breaks: Sequence[float], end: float
) -> np.ndarray:
    """Where the equations change: entries, exits, stops and passed nodes, from 0 to the end."""
    points = [0.0, end, *breaks]
    for load in loads:
        distances = model.nodes if load.speed > 0.0 else model.beam.length - model.nodes
        points += [load.stop_time, *(load.time_at(d) for d in distances)]
    found = np.unique(np.clip([p for p in points if p <= end], 0.0, None))
    return found[np.append(True, np.diff(found) > 1e-13 * end)]


def _modal_matrices(
    model: Model, omega: np.ndarray, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stiffness, damping and inertia over the modes, with support dampers and suspensions."""
    beam = model.beam
    ratios = np.zeros(len(omega))
    if isinstance(beam.damping_ratio, (int, float)):
        ratios[: beam.damped_modes] = beam.damping_ratio
    else:
        own = np.asarray(beam.damping_ratio)[: len(omega)]
        ratios[: len(own)] = own
    stiffness, inertia = np.diag(omega**2), np.eye(len(omega))
    damping = np.diag(2 * ratios * omega + beam.rayleigh[0] + beam.rayleigh[1] * omega**2)
    damping = damping + shapes.T @ model.damping @ shapes
    for s in beam.suspensions:
        row = model.shape(s.position) @ shapes
        stiffness = stiffness + s.stiffness * np.outer(row, row)
        damping = damping + s.damping * np.outer(row, row)
        inertia = inertia + s.mass * np.outer(row, row)
    return stiffness, damping, inertia


def _at(value: float | Callable[[float], float], x: float) -> float:
    return value(x) if callable(value) else value
