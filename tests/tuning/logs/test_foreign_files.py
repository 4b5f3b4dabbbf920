"""Logs of other loggers: headings of many kinds or none, universal files, several clocks, gaps."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tuning import Log, read_log
from tuning.logs import align_logs, find_faults
from tuning.logs.log import even_records

TIMES = np.arange(40) / 500
D1, D2 = np.sin(20 * TIMES), np.cos(30 * TIMES) - 1  # mm
TEXTS = {
    "preamble and units below": "Logger 7\nserial,1234,5\nt,a,b\ns,mm,[mm]\n0,1,2\n0.1,3,4\n",
    "spaces": "# comment\n t  a  b \n  s   mm  mm\n 0.0 1.0 2.0\n 0.1  3.0 4.0\n",
    "spaces, decimal comma": "t a b\ns mm mm\n0,0 1,0 2,0\n0,1 3,0 4,0\n",
    "comments within": "t [s];a [mm];b [mm]\n0,0;1,0;2,0\n% paused\n// again\n0,1;3,0;4,0\n",
    "several headings": "place;left;right\nt (s);a (mm);b (mm)\n0;1;2\n0,1;3;4\n",
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_headings_of_many_kinds(tmp_path, text):
    (tmp_path / "run.txt").write_text(text)
    log = read_log(tmp_path / "run.txt")
    assert log.names == ("a", "b") and log.units == ("mm", "mm")
    np.testing.assert_allclose(log.values, [[1e-3, 2e-3], [3e-3, 4e-3]])
    np.testing.assert_allclose(log.times, [0, 0.1])


def test_a_file_without_headings_is_read_with_named_columns(tmp_path):
    path = tmp_path / "node.csv"
    path.write_text("0.000,1.0,7\n0.001,2.0,7\n0.002,3.0,8\n")
    log = read_log(path, columns="time [s], a1 [g], -")
    assert log.names == ("a1",)
    np.testing.assert_allclose(log.values[:, 0], 9.80665 * np.arange(1, 4))
    with pytest.raises(ValueError, match="2 columns are named, but the file has 3; name all"):
        read_log(path, columns="time [s], a1 [g]")
    with pytest.raises(ValueError, match=r'columns="time \[s\], a1 \[g\], a2 \[g\]"'):
        read_log(path)
    path.write_text("1;2\n3;4\n5;6\n")
    log = read_log(path, columns=["a [mm]", "b [mm]"], rate=50.0)
    np.testing.assert_allclose(log.times, [0, 0.02, 0.04])
    with pytest.raises(ValueError, match="the log has a column of times, 'a'; leave the sampling"):
        read_log(path, columns="a [s], b [mm]", rate=50.0)
    with pytest.raises(ValueError, match="must be positive, not 0 Hz"):
        read_log(path, columns="a [mm], b [mm]", rate=0.0)


def test_units_are_given_with_the_names_of_columns(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,a,b\n0,1,2\n1,3,4\n")
    path.write_text("t [s],a,b\n0,1,2\n1,3,4\n")
    assert read_log(path, columns="b [mm]").values[:, 0].tolist() == [2e-3, 4e-3]


def write_uff(path, unit="mm", kind=1):
    pyuff = pytest.importorskip("pyuff")
    for node, values in ((1, D1), (2, D2)):
        function = pyuff.prepare_58(
            return_full_dict=True, binary=0, id1="run", id2="", id3="", id4="", id5="",
            func_type=kind, ver_num=1, load_case_id=0, rsp_ent_name="", rsp_node=node, rsp_dir=3,
            ref_ent_name="", ref_node=0, ref_dir=0, ord_data_type=4, num_pts=values.size,
            abscissa_spacing=1, abscissa_min=0.0, abscissa_inc=TIMES[1], z_axis_value=0.0,
            ordinate_spec_data_type=8, ordinate_axis_units_lab=unit, data=values, x=TIMES,
            orddenom_spec_data_type=0,
        )  # fmt: skip
        function = {key: value for key, value in function.items() if value is not None}
        pyuff.UFF(str(path)).write_sets(function, mode="add" if node > 1 else "overwrite")


@pytest.mark.parametrize("unit", ["mm", "NONE"])
def test_universal_file(tmp_path, unit):
    write_uff(tmp_path / "run.uff", unit)
    log = read_log(tmp_path / "run.uff")
    scale = 1e-3 if unit == "mm" else 1.0
    assert log.names == ("1z", "2z") and log.quantities == ("deflection",) * 2
    np.testing.assert_allclose(log.times, TIMES, atol=1e-6)
    np.testing.assert_allclose(log.values, scale * np.column_stack([D1, D2]), atol=1e-6 * scale)


def test_universal_file_that_cannot_be_read(tmp_path):
    path = tmp_path / "run.uff"
    write_uff(path, kind=4)
    with pytest.raises(ValueError, match="run.uff: the universal file has 2 functions, none of"):
        read_log(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="^[^\n]*run.uff: the file is damaged|no functions"):
        read_log(path)


def test_workbook_that_is_damaged(tmp_path):
    pytest.importorskip("openpyxl")
    path = tmp_path / "run.xlsx"
    path.write_bytes(b"PK\x03\x04 and nothing else")
    with pytest.raises(ValueError, match="run.xlsx: the file is damaged or cut off"):
        read_log(path)


def node(times, seed, clock_offset=0.0, clock_rate=1.0, sign=1.0):
    """Log of a node whose clock has an offset and a rate, of one broadband response and noise."""
    random = np.random.default_rng(3)
    fine = np.arange(0, 60, 1e-3)
    response = sum(
        lfilter([1.0], [1, -2 * r.real, abs(r) ** 2], random.normal(size=fine.size)) * size
        for r, size in (
            (np.exp(1e-3 * 2 * np.pi * f * (-0.01 + 1j)), s) for f, s in ((3.0, 1.0), (11.0, 9.0))
        )
    )
    values = sign * np.interp(times, fine, response / response.std())
    values = values + 0.1 * np.random.default_rng(seed).normal(size=times.size)
    return Log(
        (times - clock_offset) * clock_rate, values[:, None], ("a",), ("acceleration",), ("g",),
        f"node{seed}.csv",
    )  # fmt: skip


def test_clocks_of_several_nodes_are_aligned():
    first = node(np.arange(0, 50, 0.01), 1)
    second = node(np.arange(2.003, 55, 0.01), 2, clock_offset=7.5, clock_rate=1 + 2e-4, sign=-1)
    log = align_logs([first, second])
    assert log.names == ("1.a", "2.a")
    assert np.corrcoef(log.values.T)[0, 1] < -0.95
    assert "clock aligned by correlation" in log.notes[-1]
    offset = float(log.notes[-1].split("): ")[1].split(" s")[0])
    rate = float(log.notes[-1].split("rate ")[1].split(" ppm")[0])
    assert offset == pytest.approx(7.5, abs=0.02) and rate == pytest.approx(-200, abs=40)


def test_logs_without_a_common_signal_are_not_aligned():
    random = np.random.default_rng(0)
    logs = [
        Log(np.arange(4000) / 100, random.normal(size=(4000, 1)), ("a",), ("acceleration",), ("g",))
        for _ in range(2)
    ]
    with pytest.raises(ValueError, match="no signal in common with the first log"):
        align_logs(logs)
    with pytest.raises(ValueError, match="needs two logs or more, not 1"):
        align_logs(logs[:1])


def test_records_between_gaps():
    times = np.delete(np.arange(1000) / 100, slice(300, 400))
    values = np.sin(5 * times)[:, None]
    log = Log(times, values, ("a",), ("acceleration",), ("g",))
    rate, records, notes = even_records(log)
    assert rate == pytest.approx(100)
    assert [len(record.values) for record in records] == [300, 600]
    assert records[1].start == 4.0 and "1 gap: 2 records are used" in notes[0]
    wandering = times[:300] + 0.005 * np.sin(times[:300])
    log = Log(wandering, np.sin(5 * wandering)[:, None], ("a",), ("acceleration",), ("g",))
    rate, (record,), notes = even_records(log)
    grid = record.start + np.arange(len(record.values)) / rate
    np.testing.assert_allclose(record.values[:, 0], np.sin(5 * grid), atol=1e-6)
    assert "interpolated" in notes[0]
    with pytest.raises(ValueError, match="no record has 64 samples"):
        even_records(Log(times[:40], values[:40], ("a",), ("acceleration",), ("g",)))


def test_gravity_and_offsets_are_reported():
    times = np.arange(500) / 100
    wave = 0.1 * np.sin(30 * times)
    values = np.column_stack([wave + 9.81, wave, wave - 51 * 9.81])
    log = Log(times, values, ("up", "level", "odd"), ("acceleration",) * 3, ("g",) * 3)
    faults = {(fault.kind, fault.channel) for fault in find_faults(log)}
    assert faults == {("gravity", "up"), ("offset", "odd")}
