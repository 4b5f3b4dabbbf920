"""Chapter 6: displacement feedback of one and two spans with patches."""

from experiments.thesis.tolerances import (
    CURVE,
    EITHER,
    FORMULA,
    HZ,
    MEASURED,
    POINTS,
    RUNS,
    SAME_MODEL,
    VOLTS,
)
from experiments.thesis.verdicts import Printed, Tolerance

# Displacement feedback, masses m1 to m4.
FOUR = "m1 m2 m3 m4"
FREE_S1 = Printed(
    "Table 6.1", "s1, no control", "mm", "measured", MEASURED, "0.676 0.833 0.959 1.331", FOUR
)
CUBIC_S1 = Printed(
    "Table 6.1", "s1, cubic", "mm", "measured", MEASURED, "0.653 0.782 0.895 1.160", FOUR
)
CUBIC_LESS_S1 = Printed(
    "Table 6.1", "s1, less by cubic", "%", "measured", RUNS, "3.40 6.12 6.67 12.84", FOUR
)
LINEAR_S1 = Printed(
    "Table 6.1", "s1, linear", "mm", "computed", SAME_MODEL, "0.605 0.752 0.8607 1.196", FOUR
)
LINEAR_LESS_S1 = Printed(
    "Table 6.1", "s1, less by linear", "%", "computed", POINTS, "10.51 9.72 10.25 10.14", FOUR
)
FREE_S3 = Printed(
    "Table 6.2", "s3, no control", "mm", "measured", MEASURED, "0.701 0.873 0.997 1.383", FOUR
)
FREE_S3_COMPUTED = Printed(
    "Table 6.2", "s3, no control", "mm", "computed", SAME_MODEL, "0.669 0.836 0.959 1.320", FOUR
)
CUBIC_S3 = Printed(
    "Table 6.2", "s3, cubic", "mm", "measured", MEASURED, "0.683 0.816 0.917 1.200", FOUR
)
CUBIC_LESS_S3 = Printed(
    "Table 6.2", "s3, less by cubic", "%", "measured", RUNS, "2.56 6.53 8.02 13.23", FOUR
)
LINEAR_S3 = Printed(
    "Table 6.2", "s3, linear", "mm", "computed", SAME_MODEL, "0.607 0.755 0.864 1.188", FOUR
)
LINEAR_LESS_S3 = Printed(
    "Table 6.2", "s3, less by linear", "%", "computed", POINTS, "9.26 9.67 9.91 10", FOUR
)
FREE_UP = Printed(
    "Table 6.3",
    "s3 upwards, no control",
    "mm",
    "measured",
    MEASURED,
    "0.277 0.338 0.394 0.536",
    FOUR,
)
CUBIC_UP = Printed(
    "Table 6.3", "s3 upwards, cubic", "mm", "measured", MEASURED, "0.264 0.322 0.377 0.489", FOUR
)
CUBIC_LESS_UP = Printed(
    "Table 6.3", "s3 upwards, less by cubic", "%", "measured", RUNS, "4.69 4.73 4.31 8.77", FOUR
)
FEEDBACK_VOLTS = Printed(
    "Fig. 6.9", "largest voltage at a patch", "V", "measured", VOLTS, "111 680", "m1,span1 m4,span2"
)
TWO_MASSES = Printed("Fig. 6.11", "s3, less by cubic for two masses", "%", "measured", RUNS, "10.5")
UNSTABLE_MASS = Printed(
    "Fig. 6.10",
    "two spans, lightest mass with which the cubic law of k = 3 is unstable",
    "kg",
    "measured",
    FORMULA,
    "0.322",
    reading="of the masses tried; unstable is what drives the commands to their limits",
)
SWITCHED_MASSES = Printed(
    "Fig. 6.7",
    "one span, masses from which cubic k = 2 beats linear k = 2 and 3",
    "kg",
    "computed",
    CURVE,
    "0.345 0.45",
    "k2 k3",
)
LAST_GAIN = Printed(
    "Fig. 6.7", "one span, linear gain as good as cubic k = 2", "V/mm", "computed", CURVE, "3.6"
)
ONE_SPAN_LINEAR = Printed(
    "Fig. 6.6",
    "one span, less by linear, least and most",
    "%",
    "measured",
    RUNS,
    "9 11",
    "least most",
)
ONE_SPAN_CUBIC = Printed(
    "Fig. 6.6",
    "one span, less by cubic, least and most",
    "%",
    "measured",
    RUNS,
    "5.5 18.5",
    "least most",
)
AFTER_EXIT = Printed("6.1", "one span, vibration after the exit", HZ, "measured", CURVE, "17")
OSCILLATES = Printed(
    "Fig. 6.4",
    "one span, cubic, 0.509 kg at 0.28 m/s, oscillates: 1, or not: 0",
    "1",
    "measured",
    EITHER,
    "1 0",
    "10-Hz-filter 5-Hz-filter",
    "more than 0.1 mm from crest to trough counts",
)
OSCILLATION = Printed(
    "Fig. 6.4",
    "the same, with the filter of 10 Hz",
    HZ,
    "measured",
    Tolerance("read off a measured curve, and called approximate", relative=0.1),
    "10",
)
LIGHTEST_ONE = Printed(
    "Fig. 6.2",
    "one span, 0.261 kg, less by feedback",
    "%",
    "measured",
    RUNS,
    "10 5",
    "linear cubic",
)
GAIN_MARGIN = Printed(
    "6", "one span, gain margin of the open loop", "V/m", "computed", SAME_MODEL, "2.6783e6"
)
SUMMARY_ONE = Printed(
    "Table 8.1",
    "one span, 0.509 kg, less by feedback",
    "%",
    "measured",
    RUNS,
    "11 18",
    "linear cubic",
)
SUMMARY_TWO = Printed(
    "Table 8.1",
    "two spans, 0.509 kg, less by feedback",
    "%",
    "measured",
    RUNS,
    "10 13",
    "linear cubic",
)
