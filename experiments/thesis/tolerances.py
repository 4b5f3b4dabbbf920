"""Tolerances by the kind of published number, and the unit of frequency."""

from experiments.thesis.verdicts import Tolerance

EIGENVALUE_TABLE = Tolerance("eigenvalues of a problem that is stated in full", digits=1)
FORMULA = Tolerance("a formula whose numbers are printed", relative=0.001)
SAME_MODEL = Tolerance("computed with a model that is stated in full", relative=0.02)
COMPUTED_CURVE = Tolerance("read off a computed curve, and rounded in the text", relative=0.05)
GAIN = Tolerance("a computed gain, of which some digits are printed", relative=0.02, digits=0.5)
SAMPLE_INSTANT = Tolerance("an instant of a sampled run, to one sample", absolute=0.01)
COMPUTED_REDUCTION = Tolerance("a computed reduction in percent, to one point", absolute=1.0)
MEASURED = Tolerance("measured; the supports alone yield by 0.1 mm", relative=0.05)
MEASURED_REDUCTION = Tolerance(
    "a measured reduction in percent, mean of few runs, to three points", absolute=3.0
)
MEASURED_VOLTAGE = Tolerance("a measured voltage", relative=0.1)
HAND_FIT = Tolerance("fitted by hand, by eye", relative=0.05)
YES_OR_NO = Tolerance("yes (1) or no (0)", absolute=0.5)

HZ = "Hz"
