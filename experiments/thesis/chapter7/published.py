"""Chapter 7: model predictive control of one and two spans with patches."""

from experiments.thesis.verdicts import SAMPLE_INSTANT, YES_OR_NO, PublishedNumbers

RIG_B, RIG_C = "rig B, chapter 7", "rig C, chapter 7"

# Model predictive control, 0.509 kg at 1 m/s.
ONE_SPAN_REDUCTION = PublishedNumbers(
    "Fig. 7.1, Table 8.1", "one span, reduction by predictive control", "%", "22", rig=RIG_B
)
ONE_SPAN_SATURATION = PublishedNumbers(
    "Figs 7.1, 7.2",
    "one span, first at 7.5 V",
    "s",
    "0.04 0.32",
    "r_w=1e-11 r_w=1e-6",
    tolerance=SAMPLE_INSTANT,
    rig=RIG_B,
)
TWO_SPAN_REDUCTION = PublishedNumbers(
    "Fig. 7.5, Table 8.1",
    "two spans, reduction by predictive control",
    "%",
    "29 46 19",
    "s1,1st-half s2,1st-half s2,2nd-half",
    interpretation="r_w as for one span",
    rig=RIG_C,
)
REDUCED_MODEL = PublishedNumbers(
    "Fig. 7.9",
    "two spans, controller with 3 modes on 12, reduces the peaks: yes 1, no 0",
    "1",
    "1 1",
    "s1 s2",
    tolerance=YES_OR_NO,
    rig=RIG_C,
)
ONE_MOVE_PEAKS = PublishedNumbers(
    "Fig. 7.3",
    "one span, Nc = 1, peaks of the deflection at",
    "s",
    "0.06 0.58",
    "first last",
    tolerance=SAMPLE_INSTANT,
    rig=RIG_B,
)
SECOND_HALF_REDUCTION = PublishedNumbers(
    "Figs 7.5, 7.7",
    "two spans, s1, reduction in the second half",
    "%",
    "64 54",
    "Np=4,Nc=3 Np=6,Nc=4",
    rig=RIG_C,
)
TWO_SPAN_SATURATION = PublishedNumbers(
    "Fig. 7.6",
    "two spans, first at a limit",
    "s",
    "0.08 0.09",
    "u1,7.5V u2,-2.5V",
    tolerance=SAMPLE_INSTANT,
    rig=RIG_C,
)
