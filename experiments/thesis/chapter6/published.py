"""Chapter 6: displacement feedback of one and two spans with patches."""

from experiments.thesis.published_numbers import (
    APPROXIMATE_FREQUENCY,
    DIGITS,
    FORMULA,
    HZ,
    MEASURED,
    MEASURED_REDUCTION,
    MEASURED_VOLTAGE,
    YES_OR_NO,
    PublishedNumbers,
)

# Displacement feedback, masses m1 to m4.
MASS_LABELS = "m1 m2 m3 m4"
FREE_S1 = PublishedNumbers(
    "Table 6.1",
    "s1, no control",
    "mm",
    "measured",
    MEASURED,
    "0.676 0.833 0.959 1.331",
    MASS_LABELS,
)
CUBIC_S1 = PublishedNumbers(
    "Table 6.1",
    "s1, cubic",
    "mm",
    "measured",
    MEASURED,
    "0.653 0.782 0.895 1.160",
    MASS_LABELS,
    repeats="Table 6.1, from the peaks without control and the reductions",
)
CUBIC_REDUCTION_S1 = PublishedNumbers(
    "Table 6.1",
    "s1, reduction by cubic",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "3.40 6.12 6.67 12.84",
    MASS_LABELS,
)
LINEAR_S1 = PublishedNumbers(
    "Table 6.1", "s1, linear", "mm", "computed", DIGITS, "0.605 0.752 0.8607 1.196", MASS_LABELS
)
LINEAR_REDUCTION_S1 = PublishedNumbers(
    "Table 6.1",
    "s1, reduction by linear",
    "%",
    "computed",
    DIGITS,
    "10.51 9.72 10.25 10.14",
    MASS_LABELS,
    repeats="Table 6.1, from the peaks without control and under the law",
)
FREE_S3 = PublishedNumbers(
    "Table 6.2",
    "s3, no control",
    "mm",
    "measured",
    MEASURED,
    "0.701 0.873 0.997 1.383",
    MASS_LABELS,
)
FREE_S3_COMPUTED = PublishedNumbers(
    "Table 6.2",
    "s3, no control",
    "mm",
    "computed",
    DIGITS,
    "0.669 0.836 0.959 1.320",
    MASS_LABELS,
)
CUBIC_S3 = PublishedNumbers(
    "Table 6.2",
    "s3, cubic",
    "mm",
    "measured",
    MEASURED,
    "0.683 0.816 0.917 1.200",
    MASS_LABELS,
    repeats="Table 6.2, from the peaks without control and the reductions",
)
CUBIC_REDUCTION_S3 = PublishedNumbers(
    "Table 6.2",
    "s3, reduction by cubic",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "2.56 6.53 8.02 13.23",
    MASS_LABELS,
)
LINEAR_S3 = PublishedNumbers(
    "Table 6.2", "s3, linear", "mm", "computed", DIGITS, "0.607 0.755 0.864 1.188", MASS_LABELS
)
LINEAR_REDUCTION_S3 = PublishedNumbers(
    "Table 6.2",
    "s3, reduction by linear",
    "%",
    "computed",
    DIGITS,
    "9.26 9.67 9.91 10",
    MASS_LABELS,
    repeats="Table 6.2, from the peaks without control and under the law",
)
FREE_UP = PublishedNumbers(
    "Table 6.3",
    "s3 upwards, no control",
    "mm",
    "measured",
    MEASURED,
    "0.277 0.338 0.394 0.536",
    MASS_LABELS,
)
CUBIC_UP = PublishedNumbers(
    "Table 6.3",
    "s3 upwards, cubic",
    "mm",
    "measured",
    MEASURED,
    "0.264 0.322 0.377 0.489",
    MASS_LABELS,
    repeats="Table 6.3, from the peaks without control and the reductions",
)
CUBIC_REDUCTION_UP = PublishedNumbers(
    "Table 6.3",
    "s3 upwards, reduction by cubic",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "4.69 4.73 4.31 8.77",
    MASS_LABELS,
)
FEEDBACK_VOLTAGE = PublishedNumbers(
    "Fig. 6.9",
    "largest voltage at a patch",
    "V",
    "measured",
    MEASURED_VOLTAGE,
    "111 680",
    "m1,span1 m4,span2",
)
TWO_MASSES = PublishedNumbers(
    "Fig. 6.11",
    "s3, reduction by cubic for two masses",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "10.5",
)
UNSTABLE_MASS = PublishedNumbers(
    "Fig. 6.10",
    "two spans, lightest mass with which the cubic law of k = 3 is unstable",
    "kg",
    "measured",
    FORMULA,
    "0.322",
    interpretation="of the masses tried; unstable means commands that grow to their limits",
    labels="lightest",
)
SWITCHING_MASSES = PublishedNumbers(
    "Fig. 6.7",
    "one span, masses from which cubic k = 2 beats linear k = 2 and 3",
    "kg",
    "computed",
    DIGITS,
    "0.345 0.45",
    "k2 k3",
)
EQUIVALENT_LINEAR_GAIN = PublishedNumbers(
    "Fig. 6.7",
    "one span, linear gain as good as cubic k = 2",
    "V/mm",
    "computed",
    DIGITS,
    "3.6",
)
ONE_SPAN_LINEAR = PublishedNumbers(
    "Fig. 6.6",
    "one span, reduction by linear, least and most",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "9 11",
    "least most",
)
ONE_SPAN_CUBIC = PublishedNumbers(
    "Fig. 6.6",
    "one span, reduction by cubic, least and most",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "5.5 18.5",
    "least most",
)
FREE_VIBRATION_FREQUENCY = PublishedNumbers(
    "6.1", "one span, vibration after the exit", HZ, "measured", DIGITS, "17"
)
OSCILLATES = PublishedNumbers(
    "Fig. 6.4",
    "one span, cubic, 0.509 kg at 0.28 m/s, oscillates: yes 1, no 0",
    "1",
    "measured",
    YES_OR_NO,
    "1 0",
    "10-Hz-filter 5-Hz-filter",
    "an oscillation of more than 0.1 mm from crest to trough",
)
OSCILLATION_FREQUENCY = PublishedNumbers(
    "Fig. 6.4",
    "the same, with the filter of 10 Hz",
    HZ,
    "measured",
    APPROXIMATE_FREQUENCY,
    "10",
)
LIGHTEST_MASS_REDUCTION = PublishedNumbers(
    "Fig. 6.2",
    "one span, 0.261 kg, reduction by feedback",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "10 5",
    "linear cubic",
    repeats="Fig. 6.6 for 0.261 kg",
    repeated_labels="cubic",
)
GAIN_MARGIN = PublishedNumbers(
    "6",
    "one span, gain margin of the open loop",
    "V/m",
    "computed",
    DIGITS,
    "2.6783e6",
    labels="margin",
)
SUMMARY_ONE = PublishedNumbers(
    "Table 8.1",
    "one span, 0.509 kg, reduction by feedback",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "11 18",
    "linear cubic",
    repeats="Fig. 6.6 for 0.509 kg",
)
SUMMARY_TWO = PublishedNumbers(
    "Table 8.1",
    "two spans, 0.509 kg, reduction by feedback",
    "%",
    "measured",
    MEASURED_REDUCTION,
    "10 13",
    "linear cubic",
    repeats="Table 6.1 for 0.509 kg",
)
