"""Plants for a tuning: the identified one, and draws from the uncertainty of its parameters."""

import numpy as np

from jaxbeam.case.case import Case, replace
from tuning.control.load_cases import PLANT_PREFIXES, AddressValues
from tuning.fit.result import Fit
from tuning.fit.uncertainty.posterior import Posterior

MAX_DRAWS_PER_PLANT = 100  # draws from which each plant within the bounds is selected


def with_identified_plant(case: Case, found: Fit | Posterior) -> Case:
    """The case with the identified parameters of beam, supports, actuators and sensors.

    Parameters of loads and of single logs stay as they are in the case. Raises ValueError if the
    case lacks an address, or if no parameter of the plant was identified.

    `found` is the identification, by likelihood or with its posterior.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> round(float(tuning.with_identified_plant(fit.case, fit).beam.flexural_rigidity), 2)
    11.0
    """
    values = found.means if isinstance(found, Posterior) else found.values
    return replace(case, _plant_values(found.addresses, values))


def draw_plants(found: Fit | Posterior, count: int, seed: int = 0) -> tuple[AddressValues, ...]:
    """Parameters of plants, by address, drawn from the uncertainty of an identification.

    For a fit they are drawn from its covariance, with Student's distribution for its degrees of
    freedom, and lie within the bounds; for a posterior they are draws of it. Parameters of loads
    and of single logs are left out after drawing, so that the others keep their correlations.

    Raises ValueError for a fit with unidentifiable parameters, for a count below 1 or above the
    number of draws of the posterior, and if too few draws lie within the bounds.

    `found` is the identification; equal seeds give equal draws.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> [round(one["beam.flexural_rigidity"], 2) for one in tuning.draw_plants(fit, 2, seed=1)]
    [11.15, 10.72]
    """
    if count < 1:
        raise ValueError(f"the number of plants must be 1 or more, not {count}")
    rng = np.random.default_rng(seed)
    if isinstance(found, Posterior):
        rows = found.draws.reshape(-1, len(found.addresses))
        if count > len(rows):
            raise ValueError(f"{count} plants need as many draws; the posterior has {len(rows)}")
        rows = rows[rng.choice(len(rows), count, replace=False)]
    else:
        rows = _covariance_draws(found, count, rng)
    return tuple(_plant_values(found.addresses, row) for row in rows)


def _covariance_draws(fit: Fit, count: int, rng) -> np.ndarray:
    """Draws (count, parameter) from the covariance of a fit, within its bounds."""
    if not np.all(np.isfinite(fit.errors)):
        unidentifiable = [
            a for a, e in zip(fit.addresses, fit.errors, strict=True) if not np.isfinite(e)
        ]
        raise ValueError(
            f"not identifiable from the data: {', '.join(unidentifiable)}; to draw plants, fit with"
            " a prior, or hold parameters that are known otherwise"
        )
    covariance = fit.correlation * np.outer(fit.errors, fit.errors)
    # Correlations of nearly one lead to negative eigenvalues of rounding size.
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
    """Values of the parameters of the plant. Raises ValueError if there are none."""
    pairs = zip(addresses, map(float, row), strict=True)
    found = {address: value for address, value in pairs if address.startswith(PLANT_PREFIXES)}
    if not found:
        raise ValueError(f"no parameter of the plant was identified, only {', '.join(addresses)}")
    return found
