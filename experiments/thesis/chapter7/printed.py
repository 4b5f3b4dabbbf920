"""Chapter 7: model predictive control of one and two spans with patches."""

from experiments.thesis.tolerances import EITHER, POINTS, SAMPLE
from experiments.thesis.verdicts import Printed

# Model predictive control, 0.509 kg at 1 m/s.
PREDICTIVE_ONE = Printed(
    "Fig. 7.1, Table 8.1", "one span, less by predictive control", "%", "computed", POINTS, "22"
)
SATURATED_ONE = Printed(
    "Figs 7.1, 7.2",
    "one span, first at 7.5 V",
    "s",
    "computed",
    SAMPLE,
    "0.04 0.32",
    "r_w=1e-11 r_w=1e-6",
)
PREDICTIVE_TWO = Printed(
    "Fig. 7.5, Table 8.1",
    "two spans, less by predictive control",
    "%",
    "computed",
    POINTS,
    "29 46 19",
    "s1,1st-half s2,1st-half s2,2nd-half",
    "r_w as for one span",
)
FEW_MODES = Printed(
    "Fig. 7.9",
    "two spans, controller with 3 modes on 12, reduces the peaks: 1, or not: 0",
    "1",
    "computed",
    EITHER,
    "1 1",
    "s1 s2",
)
ONE_MOVE_PEAKS = Printed(
    "Fig. 7.3",
    "one span, Nc = 1, peaks of the deflection at",
    "s",
    "computed",
    SAMPLE,
    "0.06 0.58",
    "first last",
)
PREDICTIVE_FAR = Printed(
    "Figs 7.5, 7.7",
    "two spans, s1, less in the second half",
    "%",
    "computed",
    POINTS,
    "64 54",
    "Np=4,Nc=3 Np=6,Nc=4",
)
SATURATED_TWO = Printed(
    "Fig. 7.6",
    "two spans, first at a limit",
    "s",
    "computed",
    SAMPLE,
    "0.08 0.09",
    "u1,7.5V u2,-2.5V",
)
