"""From a fit to tuning: the identified plant, and other plants that its logs leave possible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxbeam.case.case import Case, replace
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues

if TYPE_CHECKING:
    from tuning.fit.identify import Fit
    from tuning.fit.uncertainty.posterior import Posterior

MAX_DRAWS_PER_PLANT = 100  # draws for each that has to lie within the bounds


def with_identified_plant(case: Case, found: Fit | Posterior) -> Case:
    """The case with the numbers of beam, supports, actuators and sensors that were identified.

    Numbers of loads and of single logs stay as they are in the case. Raises ValueError if the case
    lacks an address, or nothing that was identified concerns the plant.
    """
    values = found.values if hasattr(found, "values") else found.means
    return replace(case, _plant_values(found.addresses, values))


def draw_plants(found: Fit | Posterior, count: int, seed: int = 0) -> tuple[AddressValues, ...]:
    """Numbers of plants, by address, that are as likely as what was identified says.

    Of a fit, draws from its covariance, with Student's tails where few independent samples were
    left, each within the bounds; of a posterior, draws of its own. What belongs to loads or to
    single logs is left out, after drawing: the numbers of the plant keep their correlations.

    Raises ValueError for a fit with directions that its data cannot see, for a count below 1 or
    beyond the draws there are, and if hardly any draw lies within the bounds.
    """
    if count < 1:
        raise ValueError(f"the number of plants must be 1 or more, not {count}")
    rng = np.random.default_rng(seed)
    if hasattr(found, "draws"):
        rows = found.draws.reshape(-1, len(found.addresses))
        if count > len(rows):
            raise ValueError(f"{count} plants need as many draws; the posterior has {len(rows)}")
        rows = rows[rng.choice(len(rows), count, replace=False)]
    else:
        rows = _covariance_draws(found, count, rng)
    return tuple(_plant_values(found.addresses, row) for row in rows)


def _covariance_draws(fit: Fit, count: int, rng) -> np.ndarray:
    """Draws (count, free) from the covariance of a fit, within its bounds."""
    if not np.all(np.isfinite(fit.errors)):
        unidentifiable = [
            a for a, e in zip(fit.addresses, fit.errors, strict=True) if not np.isfinite(e)
        ]
        raise ValueError(
            f"the data cannot see {', '.join(unidentifiable)}, so that nothing says how far off a plant may"
            " be: fit with a prior, or hold what is known otherwise"
        )
    covariance = fit.correlation * np.outer(fit.errors, fit.errors)
    # Correlations of nearly one leave negative eigenvalues of rounding size.
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    low, high = (np.array([getattr(n, side) for n in fit.parameters]) for side in ("low", "high"))
    tries = MAX_DRAWS_PER_PLANT * count
    t_scale = np.sqrt(fit.degrees_of_freedom / rng.chisquare(fit.degrees_of_freedom, tries))
    drawn = fit.values + t_scale[:, None] * (rng.normal(size=(tries, len(values))) @ root.T)
    inside = drawn[np.all((drawn >= low) & (drawn <= high), axis=1)]
    if len(inside) < count:
        raise ValueError(
            f"of {tries} plants drawn only {len(inside)} lie within the bounds of the fit: its"
            " errors are too large for them; sample its posterior instead"
        )
    return inside[:count]


def _plant_values(addresses: list[str], row) -> AddressValues:
    """What belongs to the plant. Raises ValueError if nothing does."""
    pairs = zip(addresses, map(float, row), strict=True)
    found = {address: value for address, value in pairs if address.startswith(PLANT_PREFIXES)}
    if not found:
        raise ValueError(
            f"nothing that was identified concerns the plant; there are {', '.join(addresses)}"
        )
    return found
