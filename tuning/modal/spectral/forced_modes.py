"""Modes from responses to measured forces, of a hammer or a shaker.

Poles of p-LSCF (`forced_fraction`) that are stable are refined by the likelihood of a modal model.
A wide band is divided into bands of three octaves, each decimated to a rate of its own.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from tuning.modal.ambient import (
    Candidate,
    divided_band,
    mean_square,
    overlapping,
    without_duplicates,
)
from tuning.modal.preprocessing import RATE_OVER_BAND, prepare
from tuning.modal.result import rejection_reason
from tuning.modal.spectral.forced_fraction import (
    Lines,
    fit_common_denominator,
    products,
    transforms,
)
from tuning.modal.spectral.forced_likelihood import refine_modal_model
from tuning.modal.stabilisation import Diagram, stabilise
from tuning.modal.subspace import Poles

MAX_ORDER = 60
PASSES = 2  # of the search for modes
WEIGHT_DEGREE_SHARE = 0.5  # degree of the denominator that weights lines, over the highest
MIN_WEIGHT = 1e-3  # size of the denominator, over its median, below which weights are equal
SAME_POLE = 0.5  # distance of two poles over the smaller decay rate, below which they are one


class ForcedModes(NamedTuple):
    """Candidate modes, stabilisation diagrams, and the share of the responses explained."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    explained: float


def forced_modes(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    forces: tuple[Float[np.ndarray, "time force"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
    *,
    order: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> ForcedModes:
    """Modes of a band (Hz) from records and the forces measured with them.

    Raises ValueError if a force is zero throughout.
    """
    found: list[Candidate] = []
    diagrams, rest, whole = [], 0.0, 0.0
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        part = overlapping((low, high), band)
        prepared = prepare(records, starts, rate, part)
        driving = prepare(forces, starts, rate, part).records
        scale, force_scale = (np.sqrt(mean_square(one)) for one in (prepared.records, driving))
        if not np.all(force_scale > 0):
            raise ValueError("a measured force is zero throughout; leave it out")
        scale = np.where(scale > 0, scale, 1.0)
        lines = transforms(
            tuple(record / scale for record in prepared.records),
            tuple(force / force_scale for force in driving),
            prepared.rate,
            (part[0] / 2, 0.45 * RATE_OVER_BAND * part[1]),
        )
        duration = sum(map(len, prepared.records)) / prepared.rate
        candidates, diagram, shares = _modes_of_lines(lines, scale, part, band, duration, order)
        found += candidates
        diagrams.append(diagram)
        rest, whole = rest + shares[0], whole + shares[1]
    return ForcedModes(without_duplicates(found), tuple(diagrams), 1 - rest / max(whole, 1e-300))


def _modes_of_lines(lines: Lines, scale, part, band, duration, order):
    """Candidates and diagram of a part of a band, and the powers of errors and responses.

    What the modes found leave is searched again, for modes that stood in the shade of others.
    """
    drawn, used, rest, dropped = None, np.zeros(0, complex), lines, []
    for _ in range(PASSES):
        diagram = _diagram(rest, scale, part, order)
        drawn = drawn or diagram
        before = used.size
        used = _distinct(used, diagram)
        if used.size == before and drawn is not diagram:
            break
        model, gone = _refined(lines, used, scale, part)
        dropped += gone
        used = np.array([mode.pole for mode in model.modes], complex)
        rest = model.rest
    modes = [mode for mode in model.modes if part[0] <= mode.frequency <= part[1]]
    candidates = [
        Candidate(mode, rejection_reason(mode, duration, band), 1) for mode in (*modes, *dropped)
    ]
    return candidates, drawn, (np.sum(np.abs(rest.outputs) ** 2), model.power)


def _diagram(lines: Lines, scale, part, order) -> Diagram:
    """Stabilisation diagram of common denominators of rising degree."""
    highest = min(order or MAX_ORDER, len(lines.z) // (4 * lines.inputs.shape[1] + 4))
    degrees = range(2, max(highest, 3) + 1)
    first = fit_common_denominator(
        products(lines, degrees[-1]), max(int(WEIGHT_DEGREE_SHARE * degrees[-1]), 2)
    )
    size = np.abs(np.polyval(first.denominator[::-1], lines.z))
    weights = 1 / np.maximum(size, MIN_WEIGHT * np.median(size))
    system = products(lines, degrees[-1], weights / weights.max())
    fits = [fit_common_denominator(system, degree) for degree in degrees]
    sizes = [fit.poles.size for fit in fits]
    poles = Poles(
        np.repeat(np.array(degrees), sizes),
        np.concatenate([fit.poles for fit in fits]),
        np.concatenate([fit.shapes for fit in fits]) * scale,
        np.zeros(sum(sizes)),
    )
    # Modes beside the band leave their flanks in it.
    return stabilise(poles, (part[0] / 4, 0.5 / lines.step))


def _refined(lines, poles, scale, part):
    """Modal model of those poles that are determined, and the modes of the others.

    Two poles for one resonance, or one for none, make others uncertain, so that one goes at a time.
    """
    dropped = []
    while True:
        model = refine_modal_model(lines, poles, scale, part)
        doubts = [mode.damping_sd / mode.damping_ratio for mode in model.modes]
        if not doubts or model.modes[0].quantile * max(doubts) < 1:
            return model, dropped
        worst = int(np.argmax(doubts))
        dropped.append(model.modes[worst])
        poles = np.delete(np.array([mode.pole for mode in model.modes], complex), worst)


def _distinct(known, diagram: Diagram) -> Complex[np.ndarray, " mode"]:
    """Known poles, and those of the chains of a diagram, the longer first, that are others."""
    kept = [complex(pole) for pole in known]
    for chain in sorted(diagram.chains, key=lambda chain: -chain.members.size):
        pole = complex(diagram.poles.poles[chain.best])
        if all(abs(pole - one) > SAME_POLE * min(-pole.real, -one.real) for one in kept):
            kept.append(pole)
    return np.array(sorted(kept, key=abs), complex)
