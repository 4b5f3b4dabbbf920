"""Tolerances by the kind of published number, and the unit of frequency.

Computed numbers: a unit of the last printed digit, and the rounding of the printed parameters where
the number follows from them. Measured numbers: the scatter that the thesis itself shows, between
the two spans of one beam (Tables 6.1 and 6.2) and between two series of the same case.
"""

from experiments.thesis.published_numbers import Tolerance

DIGITS = Tolerance("computed: a unit of the last printed digit", digits=1)
# 11.68 N m^2 and 0.535 kg/m are rounded by 0.04 and 0.09 %, frequencies by half of the sum.
FORMULA = Tolerance(
    "follows from 11.68 N m^2 and 0.535 kg/m as far as their digits go", digits=1, relative=0.0007
)
SAMPLE_INSTANT = Tolerance("an instant of a sampled run, to one sample", absolute=0.01)
MEASURED = Tolerance(
    "measured: without control the two spans differ by up to 4.8 % (Tables 6.1 and 6.2)",
    relative=0.048,
)
MEASURED_REDUCTION = Tolerance(
    "measured: under one law the two spans differ by up to 1.35 points (Tables 6.1 and 6.2)",
    absolute=1.35,
)
MEASURED_RATIO = Tolerance(
    "measured: the same case is printed as 12.8 and 15 % (Table 5.2, Fig. 5.13)", absolute=2.2
)
MEASURED_VOLTAGE = Tolerance("measured: the cube of deflections that scatter", relative=0.1)
APPROXIMATE_FREQUENCY = Tolerance("measured, and called approximate", absolute=1.0)
SAME_CURVE = Tolerance("called identical: the width of a line in a figure", absolute=1.0)
YES_OR_NO = Tolerance("yes (1) or no (0)", absolute=0.5)

HZ = "Hz"
