"""Section properties along a beam: values at positions in a segment, and their validation.

The `beam` is a `jaxbeam.case.beam.Beam`, which has the parts of this package.
"""

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.beam_parts.segment import Segment
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.runtime.arrays import Array, xp

OPTIONAL = ("shear_stiffness", "rotary_inertia", "foundation_stiffness")
CHECKED_POSITIONS = np.linspace(0, 1, 129)  # in a segment: where its properties are validated
LENGTH_TOLERANCE = 1e-9  # of the length of the beam


def polynomial(coefficients, s) -> Float[Array, "*position"]:
    """Polynomial c_0 + c_1 s + ... at s, of a list of coefficients or one number."""
    coefficients = xp.atleast_1d(coefficients)
    total = xp.zeros(xp.shape(s)) + coefficients[-1]
    for power in range(coefficients.shape[0] - 2, -1, -1):
        total = total * s + coefficients[power]
    return total


def degree(coefficients) -> int:
    """Degree of a polynomial by its list of coefficients."""
    return 0 if coefficients is None else max(xp.size(coefficients), 1) - 1


def polynomial_degree(beam) -> int:
    """Largest degree of any property of any segment."""
    return max(
        max(
            degree(segment.width) + 3 * degree(segment.height),
            *(degree(getattr(segment, name)) for name in OPTIONAL),
            degree(segment.flexural_rigidity),
            degree(segment.mass_per_length),
        )
        for segment in beam.segments or (Segment(),)
    )


def has(beam, name: str) -> bool:
    """Whether the beam or one of its segments has an optional property."""
    return any(getattr(part, name) is not None for part in (beam, *beam.segments))


def segment_edges(beam) -> list:
    """Positions (m) of the edges of the segments, from 0 to the length of the beam."""
    edges = [xp.zeros(())]
    for segment in beam.segments[:-1]:
        edges.append(edges[-1] + segment.length)
    return [*edges, beam.length]


def rigidity(beam, segment: Segment, s) -> Float[Array, "*position"]:
    """Bending stiffness E I (N m^2) at relative positions s, 0 to 1, of a segment."""
    if segment.flexural_rigidity is not None:
        return polynomial(segment.flexural_rigidity, s)
    if segment.width is None and segment.height is None and beam.flexural_rigidity is not None:
        return xp.zeros(xp.shape(s)) + beam.flexural_rigidity
    width, height = _rectangle(beam, segment, s)
    return beam.youngs_modulus * width * height**3 / 12


def mass_per_length(beam, segment: Segment, s) -> Float[Array, "*position"]:
    """Mass per length (kg/m) at relative positions s, 0 to 1, of a segment."""
    if segment.mass_per_length is not None:
        return polynomial(segment.mass_per_length, s)
    if segment.width is None and segment.height is None and beam.mass_per_length is not None:
        return xp.zeros(xp.shape(s)) + beam.mass_per_length
    width, height = _rectangle(beam, segment, s)
    return beam.density * width * height


def optional_property(beam, segment: Segment, name: str, s) -> Float[Array, "*position"]:
    """Shear stiffness, rotary inertia or foundation stiffness at s; zero if there is none."""
    own = getattr(segment, name)
    value = getattr(beam, name) if own is None else own
    return xp.zeros(xp.shape(s)) if value is None else polynomial(value, s)


def _rectangle(beam, segment: Segment, s):
    sizes = (
        getattr(beam if getattr(segment, name) is None else segment, name)
        for name in ("width", "height")
    )
    return [polynomial(size, s) for size in sizes]


def mean(beam, of) -> Float[Array, ""]:
    """Mean over the length of a property, `rigidity` or `mass_per_length`."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges, total = segment_edges(beam), xp.zeros(())
    for i, segment in enumerate(beam.segments):
        values = of(beam, segment, (nodes + 1) / 2)
        total = total + (edges[i + 1] - edges[i]) * xp.sum(weights / 2 * values)
    return total / beam.length


def validate_segments(address: str, beam) -> str | None:
    """First inconsistency of the segments of a beam as an error message, or None."""
    name = "shear_stiffness"
    lacking = [i for i, segment in enumerate(beam.segments) if getattr(segment, name) is None]
    if lacking and has(beam, name) and getattr(beam, name) is None:
        return (
            f"{address}.segments.{lacking[0]}.{name} is missing: give it to every segment, or"
            f" {address}.{name} for those without"
        )
    for i, segment in enumerate(beam.segments):
        error = _validate_segment(f"{address}.segments.{i}", beam, segment, i)
        if error is not None:
            return error
    lengths = [segment.length for segment in beam.segments if segment.length is not None]
    if lengths and all(map(is_concrete, (*lengths, beam.length))):
        total, whole = sum(float(concrete(length)) for length in lengths), concrete(beam.length)
        complete = len(lengths) == len(beam.segments)
        if complete and abs(total - whole) > LENGTH_TOLERANCE * whole:
            return (
                f"the lengths of {address}.segments add up to {total:g} m, but {address}.length is"
                f" {whole:g} m; leave out the length of the last segment to let it take the rest"
            )
        if not complete and total >= (1 - LENGTH_TOLERANCE) * whole:
            return (
                f"the lengths of {address}.segments add up to {total:g} m and leave nothing of"
                f" {address}.length, {whole:g} m, for the last segment"
            )
    return None


def _validate_segment(address: str, beam, segment: Segment, index: int) -> str | None:
    if segment.length is None and index < len(beam.segments) - 1:
        return f"{address}.length is missing; give the length in m"
    properties = [("flexural_rigidity", "youngs_modulus"), ("mass_per_length", "density")]
    for name, source in properties:
        resized = segment.width is not None or segment.height is not None
        if getattr(segment, name) is not None:
            continue
        if resized or getattr(beam, name) is None:
            sizes = [
                size
                for size in ("width", "height")
                if getattr(segment, size) is None and getattr(beam, size) is None
            ]
            absent = [f"beam.{source}"] if getattr(beam, source) is None else []
            absent += [f"{address}.{size}" for size in sizes]
            if absent:
                return (
                    f"{address}.{name} is missing; give it, or {' and '.join(absent)}, from which"
                    " it follows"
                )
    positive = [("flexural_rigidity", rigidity), ("mass_per_length", mass_per_length)]
    numbers = [leaf for part in (beam, segment) for leaf in jax.tree.leaves(part)]
    if not all(map(is_concrete, numbers)):
        return None
    for name, of in positive:
        lowest = np.min(concrete(of(beam, segment, CHECKED_POSITIONS)))
        if not lowest > 0:
            return f"{address}.{name} must be positive all along; it falls to {lowest:g}"
    for name in OPTIONAL:
        values = concrete(optional_property(beam, segment, name, CHECKED_POSITIONS))
        if np.min(values) < 0 or (
            name == "shear_stiffness" and has(beam, name) and not np.all(values > 0)
        ):
            least = "positive" if name == "shear_stiffness" else "not negative"
            return f"{address}.{name} must be {least} all along; it falls to {np.min(values):g}"
    return None
