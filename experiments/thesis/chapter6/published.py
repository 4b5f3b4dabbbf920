"""Chapter 6: displacement feedback of one and two spans with patches."""

from experiments.thesis.verdicts import (
    FORMULA,
    HZ,
    MEASURED,
    YES_OR_NO,
    PublishedNumbers,
    Tolerance,
    measured_peaks,
    measured_shares,
)

# Displacement feedback, masses m1 to m4.
RIG_B, RIG_C = "rig B, chapter 6", "rig C, chapter 6"
PEAKS_S1, PEAKS_S3 = (0.676, 0.833, 0.959, 1.331), (0.701, 0.873, 0.997, 1.383)  # mm, as printed
PEAKS_UP = 0.277, 0.338, 0.394, 0.536
ONE_SPAN_PEAKS = 0.870, 1.697  # mm, static, of the lightest and of the heaviest mass
# A cube has three times the relative noise of the deflection.
VOLTAGE = Tolerance(f"{MEASURED.basis}, cubed", 3 * MEASURED.absolute / PEAKS_S1[0])
MASS_LABELS = "m1 m2 m3 m4"
FREE_S1 = measured_peaks(
    "Table 6.1", "s1, no control", "0.676 0.833 0.959 1.331", MASS_LABELS, rig=RIG_C
)
CUBIC_S1 = measured_peaks(
    "Table 6.1",
    "s1, cubic",
    "0.653 0.782 0.895 1.160",
    MASS_LABELS,
    repeats="Table 6.1, from the peaks without control and the reductions",
    rig=RIG_C,
)
CUBIC_REDUCTION_S1 = measured_shares(
    "Table 6.1", "s1, reduction by cubic", "3.40 6.12 6.67 12.84", PEAKS_S1, MASS_LABELS, rig=RIG_C
)
LINEAR_S1 = PublishedNumbers(
    "Table 6.1", "s1, linear", "mm", "0.605 0.752 0.8607 1.196", MASS_LABELS, rig=RIG_C
)
LINEAR_REDUCTION_S1 = PublishedNumbers(
    "Table 6.1",
    "s1, reduction by linear",
    "%",
    "10.51 9.72 10.25 10.14",
    MASS_LABELS,
    repeats="Table 6.1, from the peaks without control and under the law",
    rig=RIG_C,
)
FREE_S3 = measured_peaks(
    "Table 6.2", "s3, no control", "0.701 0.873 0.997 1.383", MASS_LABELS, rig=RIG_C
)
FREE_S3_COMPUTED = PublishedNumbers(
    "Table 6.2", "s3, no control", "mm", "0.669 0.836 0.959 1.320", MASS_LABELS, rig=RIG_C
)
CUBIC_S3 = measured_peaks(
    "Table 6.2",
    "s3, cubic",
    "0.683 0.816 0.917 1.200",
    MASS_LABELS,
    repeats="Table 6.2, from the peaks without control and the reductions",
    rig=RIG_C,
)
CUBIC_REDUCTION_S3 = measured_shares(
    "Table 6.2", "s3, reduction by cubic", "2.56 6.53 8.02 13.23", PEAKS_S3, MASS_LABELS, rig=RIG_C
)
LINEAR_S3 = PublishedNumbers(
    "Table 6.2", "s3, linear", "mm", "0.607 0.755 0.864 1.188", MASS_LABELS, rig=RIG_C
)
LINEAR_REDUCTION_S3 = PublishedNumbers(
    "Table 6.2",
    "s3, reduction by linear",
    "%",
    "9.26 9.67 9.91 10",
    MASS_LABELS,
    repeats="Table 6.2, from the peaks without control and under the law",
    rig=RIG_C,
)
FREE_UP = measured_peaks(
    "Table 6.3", "s3 upwards, no control", "0.277 0.338 0.394 0.536", MASS_LABELS, rig=RIG_C
)
CUBIC_UP = measured_peaks(
    "Table 6.3",
    "s3 upwards, cubic",
    "0.264 0.322 0.377 0.489",
    MASS_LABELS,
    repeats="Table 6.3, from the peaks without control and the reductions",
    rig=RIG_C,
)
CUBIC_REDUCTION_UP = measured_shares(
    "Table 6.3",
    "s3 upwards, reduction by cubic",
    "4.69 4.73 4.31 8.77",
    PEAKS_UP,
    MASS_LABELS,
    rig=RIG_C,
)
FEEDBACK_VOLTAGE = PublishedNumbers(
    "Fig. 6.9",
    "largest voltage at a patch",
    "V",
    "111 680",
    "m1,span1 m4,span2",
    origin="measured",
    tolerance=VOLTAGE,
    rig=RIG_C,
)
TWO_MASSES = measured_shares(
    "Fig. 6.11", "s3, reduction by cubic for two masses", "10.5", (PEAKS_S3[-1],), rig=RIG_C
)
UNSTABLE_MASS = PublishedNumbers(
    "Fig. 6.10",
    "two spans, lightest mass with which the cubic law of k = 3 is unstable",
    "kg",
    "0.322",
    "lightest",
    origin="measured",
    tolerance=FORMULA,
    interpretation="of the masses tried; unstable means commands that grow to their limits",
    rig=RIG_C,
)
SWITCHING_MASSES = PublishedNumbers(
    "Fig. 6.7",
    "one span, masses from which cubic k = 2 beats linear k = 2 and 3",
    "kg",
    "0.345 0.45",
    "k2 k3",
    rig=RIG_B,
)
EQUIVALENT_LINEAR_GAIN = PublishedNumbers(
    "Fig. 6.7", "one span, linear gain as good as cubic k = 2", "V/mm", "3.6", rig=RIG_B
)
ONE_SPAN_LINEAR = measured_shares(
    "Fig. 6.6",
    "one span, reduction by linear, least and most",
    "9 11",
    ONE_SPAN_PEAKS,
    "least most",
    rig=RIG_B,
)
ONE_SPAN_CUBIC = measured_shares(
    "Fig. 6.6",
    "one span, reduction by cubic, least and most",
    "5.5 18.5",
    ONE_SPAN_PEAKS,
    "least most",
    rig=RIG_B,
)
FREE_VIBRATION_FREQUENCY = PublishedNumbers(
    "6.1", "one span, vibration after the exit", HZ, "17", origin="measured", rig=RIG_B
)
OSCILLATES = PublishedNumbers(
    "Fig. 6.4",
    "one span, cubic, 0.509 kg at 0.28 m/s, oscillates: yes 1, no 0",
    "1",
    "1 0",
    "10-Hz-filter 5-Hz-filter",
    origin="measured",
    tolerance=YES_OR_NO,
    interpretation="an oscillation of more than 0.1 mm from crest to trough",
    rig=RIG_B,
)
OSCILLATION_FREQUENCY = PublishedNumbers(
    "Fig. 6.4", "the same, with the filter of 10 Hz", HZ, "10", origin="measured", rig=RIG_B
)
LIGHTEST_MASS_REDUCTION = measured_shares(
    "Fig. 6.2",
    "one span, 0.261 kg, reduction by feedback",
    "10 5",
    (ONE_SPAN_PEAKS[0],),
    "linear cubic",
    repeats="Fig. 6.6 for 0.261 kg",
    repeated_labels="cubic",
    rig=RIG_B,
)
GAIN_MARGIN = PublishedNumbers(
    "6", "one span, gain margin of the open loop", "V/m", "2.6783e6", "margin", rig=RIG_B
)
SUMMARY_ONE = measured_shares(
    "Table 8.1",
    "one span, 0.509 kg, reduction by feedback",
    "11 18",
    (ONE_SPAN_PEAKS[-1],),
    "linear cubic",
    repeats="Fig. 6.6 for 0.509 kg",
    rig=RIG_B,
)
SUMMARY_TWO = measured_shares(
    "Table 8.1",
    "two spans, 0.509 kg, reduction by feedback",
    "10 13",
    (PEAKS_S1[-1],),
    "linear cubic",
    repeats="Table 6.1 for 0.509 kg",
    rig=RIG_C,
)
