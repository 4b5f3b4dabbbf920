"""The tables of the page on results are those of the report."""

import pytest

from experiments.thesis import results_tables


def rig(*shares: tuple[str, float, float]) -> list[str]:
    return [f"{k}: at least {a}% of the achievable, {b}% in the mean" for k, a, b in shares]


TABLES = (results_tables.TUNED_ROWS, results_tables.SENSED_ROWS)
LABELS = [labels for rows in TABLES for labels in rows.values()]
SHARES = [
    ["B: one span", *rig(*((labels[0], 90.0, 95.0) for labels in LABELS))],
    ["C: two spans", "0.4 kg: tuned 3%; at most 4%", *rig(*((x[-1], -8.0, 9.0) for x in LABELS))],
]
FRAGILE = [
    "0.4 kg; shares",
    "as tuned: hand-set trapezium 98.4%, tuned, bench 97.1%",
    "filter: tuned, sensors only -2.0%",
    "lift: tuned, bench 0.35 mm",
]
REPORT = {
    "experiments": {
        "tuned": {"remarks": sum(SHARES, [])},
        "sensed": {"remarks": sum(SHARES, [])},
        "fragile": {"remarks": FRAGILE},
    }
}
MARKED = "".join(f"<!-- {n} -->old<!-- end of {n} -->\n" for n in ("tuned", "sensed", "fragile"))


def test_tables_are_written_between_their_marks():
    written = results_tables.with_tables(MARKED, REPORT)
    assert "old" not in written and results_tables.with_tables(written, REPORT) == written
    assert "| tuned table | 90.0 % (95.0 %) | worse than no control |" in written
    assert "| as tuned | 98.4 % | 97.1 % |  |  |  |" in written
    assert "| filter |  |  |  |  | worse than no control |" in written and "lift" not in written
    with pytest.raises(ValueError, match="no marks <!-- sensed -->"):
        results_tables.with_tables(MARKED.replace("sensed", "x"), REPORT)
