"""Numbers by which the plausibility of a case is judged, from its modes and without a run."""

import dataclasses
import itertools

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.influence import held_positions
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import Modes

GRAVITY = 9.81  # m/s^2, of weights where a case has none
POSITIONS, TIMES = 201, 501


@dataclasses.dataclass(frozen=True)
class Plausibility:
    """Numbers by which a case is judged (SI units), and warnings; None where one has no meaning.

    `span` is the longest distance between held points, `deflection` the largest static one under
    the loads on their way (both in m) and `own_deflection` that under the beam's own weight;
    `mass_ratio` is the load on the beam at once over the mass of the beam, `crossing_time` (s) that
    of the slowest load from entry to exit, and `critical_speed` is 2 f_1 times the span (m/s), at
    which a force would follow the first mode of a pinned beam: Fryba (1999), Vibration of solids
    and structures under moving loads, chapter 1. Static deflections are sums of the modes of the
    case.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5), loads=[jb.MovingMass(mass=0.1, speed=1.0)], run=jb.Run(1.0)
    ... )
    >>> found = jb.check(case)
    >>> print(f"{found.first_frequency:.1f} Hz, mass ratio {found.mass_ratio:.2f}")
    21.4 Hz, mass ratio 0.33
    """

    first_frequency: float | None
    span: float
    deflection: float | None
    own_deflection: float | None
    mass_ratio: float | None
    crossing_time: float | None
    speed: float | None
    critical_speed: float | None
    warnings: tuple[str, ...] = ()

    @property
    def span_over_deflection(self) -> float | None:
        """Span over the largest static deflection under the loads."""
        return self.span / self.deflection if self.deflection else None

    @property
    def speed_ratio(self) -> float | None:
        """Largest speed over the critical speed."""
        return self.speed / self.critical_speed if self.speed and self.critical_speed else None

    def __str__(self) -> str:
        """One line with the numbers."""
        parts = []
        if self.first_frequency is not None:
            parts.append(f"first frequency {self.first_frequency:.4g} Hz")
        if self.deflection:
            parts.append(f"span/deflection {float(f'{self.span_over_deflection:.3g}'):.15g}")
        if self.mass_ratio is not None:
            parts.append(f"load/beam mass {self.mass_ratio:.3g}")
        if self.crossing_time is not None:
            parts.append(f"crossing {self.crossing_time:.4g} s")
        if self.speed_ratio is not None:
            parts.append(f"speed/critical {self.speed_ratio:.3g}")
        return ", ".join(parts) or "no elastic mode and no load"


def plausible_numbers(case: Case, found: Modes) -> Plausibility:
    """The numbers of a case of known numbers with its modes, without warnings."""
    frequencies = found.frequencies[found.stiffness > 1e-9 * found.stiffness_unit]
    first = float(frequencies[0]) if frequencies.size else None
    span = _longest_span(case)
    loads = load_set(dataclasses.replace(case, absorbers=()))
    deflection, on_beam, fastest = _under_loads(case, found, loads)
    return Plausibility(
        first_frequency=first,
        span=span,
        deflection=deflection,
        own_deflection=_own_deflection(case, found),
        mass_ratio=_mass_ratio(case, on_beam),
        crossing_time=_crossing_time(case),
        speed=fastest,
        critical_speed=None if first is None else 2 * first * span,
    )


def _longest_span(case: Case) -> float:
    marks = sorted({0.0, *held_positions(case).tolist(), float(case.beam.length)})
    return max(right - left for left, right in itertools.pairwise(marks))


def compliance(found: Modes) -> Float[np.ndarray, " mode"]:
    """Inverse of the stiffness of modes; zero for motions as a rigid body."""
    elastic = found.stiffness > 1e-9 * found.stiffness_unit
    return np.where(elastic, 1 / np.where(elastic, found.stiffness, 1.0), 0.0)


def _is_held(found: Modes) -> bool:
    return bool(np.all(compliance(found) > 0))


def _under_loads(
    case: Case, found: Modes, loads: LoadSet
) -> tuple[float | None, float, float | None]:
    """Largest static deflection (m), largest weight on the beam at once (N), largest speed (m/s).

    The loads are on their way, whether the run sees them or not.
    """
    if not loads.wheel_count:
        return None, 0.0, None
    windows = np.asarray(loads.entry_exit_times())
    ends = np.where(windows < NEVER, windows, np.nan)
    start = float(np.nanmin(ends[:, 0])) if np.isfinite(ends[:, 0]).any() else 0.0
    last = max(float(np.nanmax(np.append(ends, start))), start)
    if np.any(windows[:, 1] >= NEVER):  # a load that stays on the beam
        last = max(last, float(case.run.duration))
    times = np.linspace(start, last, TIMES)
    position, speed, _ = map(np.asarray, loads.kinematics(times))
    x = np.linspace(0.0, float(case.beam.length), POSITIONS)
    present = (position >= 0) & (position <= x[-1])
    weight = np.where(present, np.asarray(loads.varying_weight(times))[..., 0].T, 0.0)
    fastest = float(np.max(np.abs(speed) * present))
    on_beam = float(np.max(np.abs(np.sum(weight, axis=0))))
    if not _is_held(found):
        return None, on_beam, fastest
    shapes = found.shapes(x)
    under_wheels = np.stack([np.interp(position, x, shape) for shape in shapes.T], -1)
    forces = np.einsum("wt,wtm->tm", weight, under_wheels)
    deflection = (forces * compliance(found)) @ shapes.T
    return float(np.max(np.abs(deflection))), on_beam, fastest


def _own_deflection(case: Case, found: Modes) -> float | None:
    if not _is_held(found):
        return None
    x = np.linspace(0.0, float(case.beam.length), POSITIONS)
    shapes = found.shapes(x)
    weight_per_length = float(case.beam.linear_density * case.run.gravity)
    forces = weight_per_length * np.trapezoid(shapes, x, axis=0)
    return float(np.max(np.abs(shapes @ (forces * compliance(found)))))


def _mass_ratio(case: Case, weight: float) -> float | None:
    if not case.loads:
        return None
    gravity = float(case.run.gravity) or GRAVITY
    return weight / gravity / float(case.beam.linear_density * case.beam.length)


def _crossing_time(case: Case) -> float | None:
    times = [leave - enter for enter, leave in crossing_times(case) if leave < NEVER]
    return float(max(times)) if times else None
