"""Records as text: what was run, and the extremes of each sensor with their units."""

from html import escape

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.display import html_table, with_prefix
from jaxbeam.case.sensors import sensor_labels
from jaxbeam.files.report import text_table
from jaxbeam.simulation.extremes import Extremes

HEADER = ("sensor", "position", "quantity", "smallest", "at", "largest", "at")
MAX_SENSORS = 12  # with a row each


def record_text(case: Case, times, verdict: str, extremes: Extremes) -> str:
    """Title, duration and loads of a run, its verdict, and a row of extremes for each sensor."""
    rows = _sensor_rows(case, extremes)
    lines = text_table(HEADER, rows[:MAX_SENSORS], "<><>>>>") if rows else []
    return "\n  ".join([_head(case, times), verdict, *lines, *_left_out(rows)])


def record_html(case: Case, times, verdict: str, extremes: Extremes) -> str:
    """What `record_text` tells, as a table in HTML and a paragraph below it."""
    rows = _sensor_rows(case, extremes)
    table = html_table(_head(case, times), HEADER, rows[:MAX_SENSORS])
    return f"{table}<p>{escape('; '.join([verdict, *_left_out(rows)]))}</p>"


def _head(case: Case, times) -> str:
    times = np.asarray(times)
    parts = [f"{times.size} samples to {times[-1]:.4g} s"]
    for count, word in ((len(case.sensors), "sensor"), (len(case.loads), "load")):
        parts.append(f"{count} {word}{'s' * (count != 1)}")
    head = f"Record of {case.title!r}" if case.title else "Record"
    return f"{head}: {', '.join(parts)}"


def _left_out(rows: list) -> list[str]:
    return [f"... {len(rows) - MAX_SENSORS} more sensors"] if len(rows) > MAX_SENSORS else []


def _sensor_rows(case: Case, extremes: Extremes) -> list[tuple[str, ...]]:
    """Rows of a table: smallest and largest value of each sensor, signed, with their times."""
    rows = []
    columns = zip(case.sensors, sensor_labels(case.sensors), *extremes, strict=True)
    for sensor, label, low, low_time, high, high_time in columns:
        position, unit = f"{float(sensor.position):.4g} m", sensor.unit
        name = sensor.name or label.partition(":")[0]
        row = (name, position, sensor.quantity, with_prefix(float(low), unit))
        row += (f"{low_time:.4g} s", with_prefix(float(high), unit), f"{high_time:.4g} s")
        rows.append(row)
    return rows
