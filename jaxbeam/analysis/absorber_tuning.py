"""Spring and damper of an absorber by the rules of Den Hartog and Warburton, as starts of tunings.

Both are for one undamped mode: its mass at the absorber is 1 / psi(x)^2 with the mass-normalised
shape psi, mu is the absorber's mass over it. With the frequency f_a of the absorber and f_k of the
mode:

    den-hartog   f_a / f_k = 1 / (1 + mu)                    zeta^2 = 3 mu / (8 (1 + mu))
    warburton    f_a / f_k = sqrt(1 + mu / 2) / (1 + mu)
                 zeta^2 = mu (1 + 3 mu / 4) / (4 (1 + mu) (1 + mu / 2))

The first makes the two peaks of the frequency response equal, the smallest under a harmonic force
(J. P. Den Hartog, Mechanical Vibrations, 4th ed. 1956, sections 3.2 and 3.3); the second makes the
deflection under a white-noise force smallest (G. B. Warburton, Earthquake Engineering and
Structural Dynamics 10 (1982) 381-401).
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, check_is_case
from jaxbeam.case.fields import check_on_beam, concrete, is_concrete, suggestion
from jaxbeam.model.modes import Modes, modes
from jaxbeam.runtime.arrays import Array, xp

NODE = 1e-6  # of the largest value of a mode shape: less is a node


def _den_hartog(mu):
    return 1 / (1 + mu), xp.sqrt(3 * mu / (8 * (1 + mu)))


def _warburton(mu):
    damping = xp.sqrt(mu * (1 + 0.75 * mu) / (4 * (1 + mu) * (1 + mu / 2)))
    return xp.sqrt(1 + mu / 2) / (1 + mu), damping


RULES = {"den-hartog": _den_hartog, "warburton": _warburton}


@checks_classes
def tuned_absorber(
    case: Case,
    position: Float[Array, ""] | float,
    mass: Float[Array, ""] | float,
    mode: int = 1,
    rule: str = "den-hartog",
) -> Absorber:
    """Absorber of a mass (kg) at a position (m), tuned to a mode of the case, counted from 1.

    The rules are "den-hartog" and "warburton"; see the module. Other absorbers of the case are left
    out. Differentiable by the mass, the position and the numbers of the beam.

    Raises ValueError for a position off the beam or at a node of the mode, a mass that is not
    positive, a mode that the case does not have, and another rule.

    >>> import jaxbeam as jb
    >>> bridge = jb.Case(jb.Beam(25.0, 30e9, 15e3, damping_ratio=0.01))
    >>> absorber = jb.tuned_absorber(bridge, position=12.5, mass=3750.0)  # 2 % of the modal mass
    >>> print(f"{absorber.frequency:.3f} Hz, {absorber.damping_ratio:.4f}")
    3.485 Hz, 0.0857
    """
    check_is_case(case)
    if rule not in RULES:
        raise ValueError(f"rule cannot be {rule!r}; {suggestion(rule, RULES)}")
    check_on_beam("position", position, case.beam.length)
    if not isinstance(mode, int) or not 1 <= mode <= case.beam.modes:
        raise ValueError(
            f"mode must be from 1 to {case.beam.modes}, those of the case; it is {mode!r}"
        )
    if is_concrete(mass) and not concrete(mass, "mass") > 0:
        raise ValueError(f"mass must be positive, in kg; it is {mass:g}")
    found = modes(case)
    shape = found.shapes(xp.asarray(position, float))[mode - 1]
    if is_concrete(shape) and _is_node(found, mode, float(concrete(shape))):
        raise ValueError(
            f"position {position:g} m is at a node of mode {mode}, which it cannot damp"
        )
    ratio, damping = RULES[rule](mass * shape**2)
    frequency = ratio * found.frequencies[mode - 1]
    return Absorber(position, mass=mass, frequency=frequency, damping_ratio=damping)


def _is_node(found: Modes, mode: int, shape: float) -> bool:
    """Whether a value of the shape of a mode is zero within rounding."""
    nodes = concrete(found.nodes)
    shapes = concrete(found.shapes(np.linspace(nodes[0], nodes[-1], 201)))[:, mode - 1]
    return bool(abs(shape) <= NODE * np.max(np.abs(shapes)))
