"""Files that are cut off, and times that are wrong: aligned and told, or refused in one sentence.

The right values are those of the functions of which the files are samples.
"""

import re
import warnings
import zoneinfo
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import scipy.io

import jaxbeam as jb
from tuning import read_log, read_logs
from tuning.control.run_set import read_load_cases
from tuning.logs.log import Log, LogWarning, doubts
from tuning.logs.readers.headings import seconds_of
from tuning.logs.reading import read_description

STEP = 0.005
TIMES = STEP * np.arange(400)


def signal(times):
    return np.sin(20 * times)


def read_warned(path, message, **options):
    """Log that is read with warnings, one of which is as said; all are in its notes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        log = read_log(path, **options)
    assert all(one.category is LogWarning for one in caught)
    said = [str(one.message).removeprefix(f"{log.source}: ") for one in caught]
    assert set(said) <= set(log.notes)
    assert any(re.search(message, one) for one in said), said
    return log


def tdms(path, channels):
    """Channels of values and properties."""
    nptdms = pytest.importorskip("nptdms")
    objects = [
        nptdms.ChannelObject("log", name, values, {"unit_string": "mm"} | properties)
        for name, (values, properties) in channels.items()
    ]
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment(objects)


def clock(start="2024-03-31T00:59:50", offset=0.0, step=STEP):
    """Waveform properties: the start is a second and more before clocks are put forward."""
    date = np.datetime64(start, "us") + np.timedelta64(round(1e6 * offset), "us")
    return {"wf_start_time": date, "wf_increment": step}


@pytest.mark.parametrize("key", ["wf_start_time", "wf_start_offset"])
@pytest.mark.parametrize(("offset", "atol"), [(0.5, 1e-9), (0.5025, 2.5e-5)])
def test_channels_that_start_at_different_times_are_aligned(tmp_path, key, offset, atol):
    """One function of time, of which the second channel has later samples, also half a step.

    Dates of the file are whole microseconds, in which the function changes by 2e-5.
    """
    later = clock(offset=offset) if key == "wf_start_time" else clock() | {key: offset}
    path = tmp_path / "run.tdms"
    tdms(path, {"a": (signal(TIMES), clock()), "b": (signal(TIMES + offset), later)})
    log = read_warned(path, r"different times \(a 0 to 1.995 s, b 0.5.* to .* aligned")
    assert log.times[0] == pytest.approx(np.ceil(offset / STEP) * STEP)
    assert log.start.startswith(f"2024-03-31T00:59:50.{1000 * log.times[0]:.0f}")
    assert log.times[-1] == pytest.approx(1.995)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(log.times), atol=1e-12)
    np.testing.assert_allclose(1e3 * log.values[:, 1], signal(log.times), atol=atol)


def test_channels_of_different_rates_are_interpolated_to_the_highest(tmp_path):
    path, slow = tmp_path / "run.tdms", 4 * STEP
    tdms(
        path,
        {"a": (signal(slow * np.arange(100)), clock(step=slow)), "b": (signal(TIMES), clock())},
    )
    log = read_warned(path, r"interpolated to 200 Hz, from .* a \(50 Hz, 0 s\)")
    assert log.names == ("a", "b") and log.sample_rate == pytest.approx(200.0)
    # The error of a cubic spline is 5/384 h^4 w^4 = 3.3e-4, more near its ends.
    error = np.abs(1e3 * log.values[:, 0] - signal(log.times))
    assert error[20:-20].max() < 3.4e-4 and error.max() < 2e-3
    np.testing.assert_allclose(1e3 * log.values[:, 1], signal(log.times), atol=1e-12)


def test_channels_without_a_time_in_common_are_refused(tmp_path):
    tdms(tmp_path / "run.tdms", {"a": (TIMES, clock()), "b": (TIMES, clock(offset=100.0))})
    with pytest.raises(ValueError, match=r"group 'log': its channels have no time in common: a 0"):
        read_log(tmp_path / "run.tdms")


def test_a_shorter_channel_is_read_as_far_as_it_goes(tmp_path):
    tdms(tmp_path / "run.tdms", {"a": (signal(TIMES), clock()), "b": (TIMES[:300], clock())})
    log = read_warned(tmp_path / "run.tdms", "from 0 to 1.495 s, which they have in common")
    assert log.values.shape == (300, 2)


def test_an_index_beside_a_file_is_not_believed(tmp_path):
    """LabVIEW writes one; that of an earlier file would give other channels."""
    tdms(tmp_path / "run.tdms", {"a": (signal(TIMES), clock())})
    (tmp_path / "run.tdms_index").write_bytes(b"TDSh and nothing else")
    np.testing.assert_allclose(1e3 * read_log(tmp_path / "run.tdms").values[:, 0], signal(TIMES))


def binary_set(number, start):
    """A response of type 58b in a universal file, as the format says."""
    data = (number * signal(TIMES + start)).astype("<f8").tobytes()
    lines = [
        "    -1",
        f"{58:6d}b{1:6d}{2:6d}{11:12d}{len(data):12d}{0:6d}{0:6d}{0:12d}{0:12d}",
        *["NONE"] * 5,
        f"{1:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{number:10d}{3:4d} {'NONE':10}{0:10d}{0:4d}",
        f"{4:10d}{TIMES.size:10d}{1:10d}{start:13.5e}{STEP:13.5e}{0.0:13.5e}",
        f"{17:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'s':20}",
        f"{8:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'mm':20}",
        *[f"{0:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'NONE':20}"] * 2,
    ]
    return "\n".join([*lines, ""]).encode() + data + b"\n    -1\n"


def universal_file(path, count=3, starts=(0.0, 0.0, 0.0), binary=True, unit="mm", kind=1):
    """Responses 1z, 2z, ..., the i-th i times as large; of text with a unit and of a kind."""
    pyuff = pytest.importorskip("pyuff")
    if binary:  # pyuff 2.5 leaves a binary file open
        path.write_bytes(b"".join(binary_set(i + 1, starts[i]) for i in range(count)))
        return
    for i in range(count):
        times = TIMES + starts[i]
        function = pyuff.prepare_58(
            return_full_dict=True, binary=0, id1="a", id2="", id3="", id4="", id5="",
            func_type=kind, ver_num=1, load_case_id=0, rsp_ent_name="", rsp_node=i + 1, rsp_dir=3,
            ref_ent_name="", ref_node=0, ref_dir=0, ord_data_type=4, num_pts=times.size,
            abscissa_spacing=1, abscissa_min=starts[i], abscissa_inc=STEP, z_axis_value=0.0,
            ordinate_spec_data_type=8, ordinate_axis_units_lab=unit, x=times,
            data=(i + 1) * signal(times), orddenom_spec_data_type=0,
        )  # fmt: skip
        function = {key: value for key, value in function.items() if value is not None}
        pyuff.UFF(str(path)).write_sets(function, mode="add" if i else "overwrite")


@pytest.mark.parametrize("unit", ["mm", "NONE"])
def test_universal_file(tmp_path, unit):
    universal_file(tmp_path / "run.uff", count=2, binary=False, unit=unit)
    log = read_log(tmp_path / "run.uff")
    scale = 1e-3 if unit == "mm" else 1.0
    assert log.names == ("1z", "2z") and log.quantities == ("deflection",) * 2
    np.testing.assert_allclose(log.times, TIMES, atol=1e-6)
    expected = scale * signal(TIMES)[:, None] * [1, 2]
    np.testing.assert_allclose(log.values, expected, atol=1e-6 * scale)


def test_universal_file_that_cannot_be_read(tmp_path):
    path = tmp_path / "run.uff"
    universal_file(path, count=2, binary=False, kind=4)
    with pytest.raises(ValueError, match="run.uff: the universal file has 2 functions, none of"):
        read_log(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ValueError, match="^[^\n]*run.uff: the file is damaged|no functions"):
        read_log(path)


def test_a_universal_file_with_exponents_of_fortran(tmp_path):
    path = tmp_path / "run.uff"
    universal_file(path, binary=False)
    text, times = path.read_text(), read_log(path).times
    path.write_text(re.sub(r"(?<=\d)[eE](?=[-+]\d\d)", "D", text))
    assert path.read_text().count("D-01") > 100
    log = read_log(path)
    np.testing.assert_array_equal(log.times, times)
    np.testing.assert_allclose(1e3 * log.values[:, 1], 2 * signal(TIMES), atol=1e-5)


@pytest.mark.parametrize("binary", [True, False])
def test_a_universal_file_that_is_cut_off_names_the_channel(tmp_path, binary):
    path = tmp_path / "run.uff"
    universal_file(path, binary=binary)
    data = path.read_bytes()
    third = data.rfind(b"    -1\n    58")
    line = data.count(b"\n", 0, third) + 1
    for place in (third + 900, third + 2000):
        path.write_bytes(data[:place])
        said = f"breaks off within data set 3, line {line}, of the channel 3z, which is left out"
        log = read_warned(path, said)
        assert log.names == ("1z", "2z")
    path.write_bytes(data[: third + 100])
    assert read_warned(path, "breaks off within data set 3").names == ("1z", "2z")
    path.write_bytes(data[: data.find(b"    -1\n    58", 100) - 200])
    with pytest.raises(ValueError, match="no functions of type 58, a response over time; the file"):
        read_log(path)


def test_responses_of_a_universal_file_are_aligned(tmp_path):
    universal_file(tmp_path / "run.uff", count=2, starts=(0.0, 0.5))
    log = read_warned(tmp_path / "run.uff", "aligned by them")
    assert log.names == ("1z", "2z") and log.times[0] == pytest.approx(0.5, abs=1e-6)
    np.testing.assert_allclose(1e3 * log.values, signal(log.times)[:, None] * [1, 2], atol=1e-5)


def csv(path, times, name="time [s]", form="{:.6f},{:.6f}\n"):
    path.write_text(f"{name},w [mm]\n" + "".join(form.format(t, signal(t)) for t in times))
    return path


def test_a_jump_of_times_is_told_with_its_line(tmp_path):
    path = csv(tmp_path / "run.csv", np.where(TIMES < 1, TIMES, TIMES + 5))
    said = r"jump by 5.005 s after t = 0.995 s, line 202, with steps of 0.005 s .* 1000 samples"
    assert read_warned(path, said).times.size == 400


@pytest.mark.parametrize(
    ("name", "scale", "said"),
    [
        ("time [s]", 1e3, "5 s apart, 0.2 samples a second: are they in ms, not in s?"),
        ("time [s]", 1e6, "5000 s apart, 0.0002 samples a second: are they in us, not in s?"),
        ("time [ms]", 1.0, "5e-06 s apart, 2e.05 samples a second: are they in s, not in ms?"),
        ("time [min]", 1.0, "0.3 s apart, 3.333 samples a second: are they in s, not in min?"),
        ("t/s", 1 / 60, "8.333e-05 s apart, 1.2e.04 samples a second: are they in min, not in s?"),
    ],
)
def test_times_in_another_unit_than_the_file_says(tmp_path, name, scale, said):
    read_warned(csv(tmp_path / "run.csv", scale * TIMES, name), said.replace("?", r"\?"))


@pytest.mark.parametrize("rate", [50.0, 100.0, 200.0, 256.0, 500.0, 512.0, 1000.0, 1024.0])
def test_minutes_are_told_from_the_rates_of_fast_loggers(rate):
    """Unless the unit is given."""
    minutes, columns = np.arange(900) / rate / 60, (("w",), np.zeros((900, 1)))

    def said(times, sure=False):
        return list(doubts(columns[0], times, columns[1], time_unit_is_sure=sure))

    assert ["are they in min" in sentence for sentence in said(minutes)] == [True]
    assert ["are they in min" in sentence for sentence in said(np.round(minutes, 6))] == [True]
    assert "are they in h, not in s" in said(np.arange(900) / 200 / 3600)[0]
    assert not said(minutes, sure=True) and not said(np.arange(900) / rate)
    for fast in (3200.0, 4096.0, 5000.0, 9600.0, 12800.0, 44100.0, 51200.0):
        assert not said(np.arange(900) / fast)


@pytest.mark.parametrize("suffix", [".mat", ".h5", ".parquet", ".xlsx"])
def test_minutes_are_told_in_every_format(tmp_path, suffix):
    path, columns = tmp_path / f"run{suffix}", {"t": TIMES / 60, "w": signal(TIMES)}
    if suffix == ".mat":
        scipy.io.savemat(path, columns)
    elif suffix == ".h5":
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, values in columns.items():
                file[name] = values
    elif suffix == ".parquet":
        arrow = pytest.importorskip("pyarrow")
        pytest.importorskip("pyarrow.parquet").write_table(arrow.table(columns), path)
    else:
        book = pytest.importorskip("openpyxl").Workbook()
        for row in [["t/s", "w/mm"], *zip(*columns.values(), strict=True)]:
            book.active.append(list(map(str, row) if row[0] == "t/s" else map(float, row)))
        book.save(path)
    with pytest.warns(LogWarning, match=r"are they in min, not in s\?"):
        log = read_log(path, units={"w": "mm"})
    np.testing.assert_allclose(60 * log.times, TIMES, atol=1e-9)
    seconds = read_log(path, units={"w": "mm", "t": "min"})
    np.testing.assert_allclose(seconds.times, TIMES, atol=1e-9)


def test_units_as_quotients_and_in_words(tmp_path):
    for name in ("t/ms", "t / ms", "Zeit in ms", "time [msec]"):
        log = read_log(csv(tmp_path / "run.csv", 1e3 * TIMES, name))
        np.testing.assert_allclose(log.times, TIMES, atol=1e-9)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        (np.where(TIMES < 1, TIMES, TIMES - 0.5), "line 202: time 0.5 s comes after 0.995 s"),
        (np.where(TIMES[7] == TIMES, TIMES[6] + 1e-8, TIMES), "line 9: time 0.03 s is repeated"),
    ],
)
def test_times_that_go_back_or_stand_are_refused(tmp_path, times, said):
    with pytest.raises(ValueError, match=rf"run.csv, {said}"):
        read_log(csv(tmp_path / "run.csv", times, form="{:.6f},{:.12f}\n"))


def test_columns_of_equal_names_are_renamed(tmp_path):
    rows = "".join(f"{t:.6f},{signal(t):.6f},{2 * signal(t):.6f}\n" for t in TIMES)
    (tmp_path / "run.csv").write_text(f"time [s],w [mm],w [mm]\n{rows}")
    log = read_warned(tmp_path / "run.csv", "columns of equal names are renamed: w .2.")
    assert log.names == ("w", "w (2)")
    log = read_warned(tmp_path / "run.csv", "renamed", columns="w (2)")
    np.testing.assert_allclose(1e3 * log.values[:, 0], 2 * signal(TIMES), atol=1e-6)


def test_rows_that_are_written_twice_are_left_out(tmp_path):
    path = csv(tmp_path / "run.csv", np.repeat(TIMES, np.where(np.arange(400) % 150 == 7, 2, 1)))
    log = read_warned(path, "3 rows repeat the one before and are left out, .* in line 10")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)


def test_rates_in_kilohertz_are_told(tmp_path):
    np.savetxt(tmp_path / "run.csv", signal(TIMES), header="w [mm]", comments="")
    read_warned(tmp_path / "run.csv", "5 s apart, 0.2 samples a second: are they in ms", rate=0.2)


def test_a_text_file_that_is_cut_off_is_refused(tmp_path):
    path = csv(tmp_path / "run.csv", TIMES)
    text = path.read_text()
    for cut in (-1, -4, -8, -12):  # the end of the line alone, decimals, the number, the column
        path.write_text(text[:cut])
        if cut == -1:
            assert read_log(path).times.size == TIMES.size
            continue
        with pytest.raises(ValueError, match=r"line 401: the file breaks off in its last line"):
            read_log(path)
    # Numbers of any length may end anywhere.
    path.write_text("time [s],w [mm]\n" + "\n".join(f"{t},{signal(t)}" for t in TIMES))
    assert read_log(path).times.size == TIMES.size


def test_a_labview_file_with_fewer_samples_than_it_says(tmp_path):
    head = "LabVIEW Measurement\nSeparator\tTab\nX_Columns\tOne\n***End_of_Header***\n\n"
    head += "Channels\t1\nSamples\t400\nY_Unit_Label\tmm\nX0\t0\nDelta_X\t0.005\n"
    head += "***End_of_Header***\nX_Value\tw\tComment\n"
    rows = [f"{t:.6f}\t{signal(t):.6f}\n" for t in TIMES]
    path = tmp_path / "run.lvm"
    path.write_text(head + "".join(rows))
    assert read_log(path).times.size == 400
    path.write_text(head + "".join(rows[:250]))
    read_warned(path, "breaks off after line 262: the last segment has 250 of 400 samples")


def test_bytes_in_the_wrong_order_are_refused(tmp_path):
    """Doubles that are read in the wrong order are of any size."""
    swapped = signal(TIMES[1:]).astype(">f8").view("<f8")
    scipy.io.savemat(tmp_path / "run.mat", {"t": TIMES[1:], "w": np.nan_to_num(swapped)})
    with pytest.raises(ValueError, match=r"run.mat, sample \d+, column 'w': .* is no measurement"):
        read_log(tmp_path / "run.mat", units="mm")
    # A universal file says its order.
    universal_file(tmp_path / "run.uff", count=1)
    data = (tmp_path / "run.uff").read_bytes()
    assert b"58b     1" in data
    (tmp_path / "run.uff").write_bytes(data.replace(b"58b     1", b"58b     2"))
    with pytest.raises(ValueError, match="is no measurement"):
        read_log(tmp_path / "run.uff")


def test_two_columns_of_times_are_one_or_are_refused(tmp_path):
    path = tmp_path / "run.csv"
    rows = [[t, signal(t), 1e3 * t, -signal(t)] for t in TIMES]
    text = "ta [s],a [mm],tb [ms],b [mm]\n"
    path.write_text(text + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows))
    log = read_log(path)
    assert log.names == ("a", "b")
    np.testing.assert_allclose(1e3 * log.values[:, 1], -signal(TIMES))
    rows = [[*row[:2], row[2] + 500.0, row[3]] for row in rows]
    path.write_text(text + "".join(",".join(map(repr, map(float, row))) + "\n" for row in rows))
    with pytest.raises(ValueError, match=r"run.csv: the columns 'ta' and 'tb' are both times and"):
        read_log(path)
    assert read_log(path, time="tb", columns=["b"]).times[0] == 0.5


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("X0\t0\t0.5", "X0 is 0 and 0.5"),
        ("X0\t0\t0\nTime\t09:30:00\t09:30:00.5", "Time is 09:30:00 and 09:30:00.5"),
        ("X0\t0\t0\nDelta_X\t0.005\t0.01", "Delta_X is 0.005 and 0.01"),
    ],
)
def test_channels_of_a_labview_file_that_start_at_different_times(tmp_path, row, said):
    head = "LabVIEW Measurement\nSeparator\tTab\nX_Columns\tNo\n***End_of_Header***\n\n"
    head += f"Channels\t2\nY_Unit_Label\tmm\tmm\nDelta_X\t0.005\t0.005\n{row}\n"
    head += "***End_of_Header***\nX_Value\ta\tb\tComment\n"
    rows = [f"\t{signal(t):.6f}\t{-signal(t):.6f}\n" for t in TIMES]
    (tmp_path / "run.lvm").write_text(head + "".join(rows))
    with pytest.raises(ValueError, match=f"line 1.: the channels a and b have .*: {said}; save"):
        read_log(tmp_path / "run.lvm")


def test_starts_of_datasets_may_be_dates(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file.attrs["sample_rate"] = 200.0
        file["a [mm]"], file["b [mm]"] = signal(TIMES), -signal(0.5 + TIMES)
        file["a [mm]"].attrs["start_time"] = "2024-03-31T02:59:59.500+02:00"
        file["b [mm]"].attrs["start_time"] = "2024-03-31T01:00:00Z"
    log = read_warned(tmp_path / "run.h5", "aligned by them, and read from 0.5 to 1.995 s")
    assert log.start == "2024-03-31T01:00:00.000+00:00"
    np.testing.assert_allclose(1e3 * log.values, signal(log.times)[:, None] * [1, -1], atol=1e-5)


def test_a_copied_channel_is_told(tmp_path):
    tdms(tmp_path / "run.tdms", {n: (signal(TIMES), clock()) for n in "ab"})
    read_warned(tmp_path / "run.tdms", "b equals a in every sample: is one of them a copy")


def test_variables_of_another_dimension_are_no_channels(tmp_path):
    """Two axes of as many times: of a netCDF file only one is that of a run."""
    with scipy.io.netcdf_file(tmp_path / "run.nc", "w") as file:
        for axis, shift in (("time", 0.0), ("time2", 7.0)):
            file.createDimension(axis, TIMES.size)
            variable = file.createVariable(axis, "d", (axis,))
            variable[:], variable.units = TIMES + shift, "s"
            channel = file.createVariable(f"w_{axis}", "h", (axis,))
            channel[:], channel.units = np.round(1e4 * signal(TIMES)), "mm"
            channel.scale_factor = 1e-4
    log = read_log(tmp_path / "run.nc")
    assert log.names == ("w_time",)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(TIMES), atol=6e-5)


def test_times_since_a_date_are_from_the_first(tmp_path):
    with scipy.io.netcdf_file(tmp_path / "run.nc", "w") as file:
        file.createDimension("time", TIMES.size)
        for name, values, unit in (
            ("time", 1e9 + 1e3 * TIMES, "milliseconds since 2020-01-01"),
            ("w", signal(TIMES), "mm"),
        ):
            variable = file.createVariable(name, "d", ("time",))
            variable[:], variable.units = values, unit
    np.testing.assert_allclose(read_log(tmp_path / "run.nc").times, TIMES, atol=1e-7)


def test_datasets_have_rates_and_starts_of_their_own(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "run.h5", "w") as file:
        file["a [mm]"], file["b [mm]"] = signal(TIMES), signal(0.1 + 2 * TIMES)
        file["a [mm]"].attrs["fs"], file["b [mm]"].attrs["dt"] = 200.0, 0.01
        file["b [mm]"].attrs["t0"] = 0.1
    log = read_warned(tmp_path / "run.h5", r"interpolated to 200 Hz, .* b \[mm\] \(100 Hz, 0.1 s\)")
    np.testing.assert_allclose(1e3 * log.values, signal(log.times)[:, None] * [1, 1], atol=1e-4)


def test_rates_that_contradict_each_other(tmp_path):
    scipy.io.savemat(tmp_path / "run.mat", {"acc": signal(TIMES), "fs": 200.0, "dt": 0.01})
    with pytest.raises(ValueError, match="run.mat: the sampling rates and steps of acc contradict"):
        read_log(tmp_path / "run.mat", units="g")
    scipy.io.savemat(tmp_path / "run.mat", {"acc": signal(TIMES), "fs": 0.0})
    with pytest.raises(ValueError, match="rate or step of acc is not positive"):
        read_log(tmp_path / "run.mat", units="g")


STAMPS = {
    "iso": "2024-05-14T23:59:59.{0:03d}000+02:00",
    "iso without zone": "2024-05-14 23:59:59.{0:03d}",
    "utc": "2024-05-14T23:59:59.{0:03d}Z",
    "german": "14.05.2024 23:59:59.{0:03d}",
    "british": "14/05/2024 23:59:59.{0:03d}",
    "american": "5/14/2024 11:59:59.{0:03d} PM",
    "time of day": "23:59:59.{0:03d}",
}


@pytest.mark.parametrize("form", STAMPS)
@pytest.mark.parametrize("separator", [",", ";"])
def test_dates_and_times_are_seconds_from_the_first_sample(tmp_path, form, separator):
    path = tmp_path / "run.csv"
    rows = [f"{STAMPS[form].format(5 * i)}{separator}{signal(TIMES[i]):.6f}" for i in range(200)]
    if separator == ";" and form == "german":
        rows = [
            f"{row.partition(';')[0]};{row.partition(';')[2].replace('.', ',')}" for row in rows
        ]
    path.write_text(f"Zeitstempel{separator}w [mm]\n" + "\n".join(rows) + "\n")
    log = read_log(path)
    np.testing.assert_allclose(log.times, TIMES[:200], atol=1e-9)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(log.times), atol=1e-6)
    assert log.start.startswith(("2024-05-14T23:59:59", "23:59:59.000"))


def stamps_of(moments, form):
    return [moment.strftime(form) for moment in moments]


SET = [
    datetime(2024, 10, 27, 0, 59, 59, tzinfo=UTC) + timedelta(seconds=STEP * i) for i in range(400)
]
BERLIN = [moment.astimezone(zoneinfo.ZoneInfo("Europe/Berlin")) for moment in SET]
SPRING = [(moment - timedelta(days=210)).astimezone(BERLIN[0].tzinfo) for moment in SET]
NIGHT = [datetime(2024, 5, 4, 23, 59, 59) + timedelta(seconds=STEP * i) for i in range(400)]
EPOCHS = [1.7e9 + STEP * i for i in range(400)]
TIME_CELLS = {  # of the same samples, by what is special of them
    "a.m. and p.m. by points": [
        f"{t:%I:%M:%S.%f} {'a.m.' if t.hour < 12 else 'p.m.'}"
        for t in (moment - timedelta(hours=12) for moment in NIGHT)
    ],
    "names of months": stamps_of(NIGHT, "%d-%b-%Y %H:%M:%S.%f"),
    "names of zones, and the clock is set": [
        f"{t:%Y-%m-%d %H:%M:%S.%f} {t.tzname()}" for t in BERLIN
    ],
    "offsets of zones, and the clock is set": [t.isoformat() for t in BERLIN],
    "day first, told by midnight alone": stamps_of(NIGHT, "%d/%m/%Y %H:%M:%S.%f"),
    "month first, told by midnight alone": stamps_of(NIGHT, "%m/%d/%Y %H:%M:%S.%f"),
    "seconds since 1970": [f"{t:.3f}" for t in EPOCHS],
    "milliseconds since 1970": [f"{1e3 * t:.0f}" for t in EPOCHS],
    "nanoseconds since 1970": [f"{round(1e3 * t)}000000" for t in EPOCHS],
}


@pytest.mark.parametrize("kind", TIME_CELLS)
def test_times_are_those_of_the_clock(tmp_path, kind):
    rows = [f"{cell},{signal(t):.6f}" for cell, t in zip(TIME_CELLS[kind], TIMES, strict=True)]
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows) + "\n")
    log = read_log(tmp_path / "run.csv")
    np.testing.assert_allclose(log.times, TIMES, atol=3e-7)  # of doubles of 1.7e18 ns
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(TIMES), atol=1e-6)
    year = (
        "2023-11-14T22:13:20" if "1970" in kind else "2024-" if "a.m." not in kind else "11:59:59"
    )
    assert log.start.startswith(year)


@pytest.mark.parametrize(("moments", "way"), [(BERLIN, "back"), (SPRING, "forward")])
def test_a_clock_that_is_set_by_an_hour_goes_on(tmp_path, moments, way):
    """Daylight saving begins and ends at full hours; stamps have no zone."""
    cells = stamps_of(moments, "%Y-%m-%d %H:%M:%S.%f")
    rows = [f"{cell},{signal(t):.6f}" for cell, t in zip(cells, TIMES, strict=True)]
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows) + "\n")
    log = read_warned(tmp_path / "run.csv", f"clock is set {way} by an hour in line 202 .daylight")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)


def test_an_hour_without_samples_is_no_clock_set_forward(tmp_path):
    """At a full hour by day: the logger paused."""
    begin = datetime(2024, 3, 31, 9, 59, 59)
    later = TIMES + np.where(TIMES >= 1.0, 3600.0, 0.0)
    cells = [(begin + timedelta(seconds=float(t))).isoformat() for t in later]
    rows = [f"{cell},{signal(t):.6f}" for cell, t in zip(cells, TIMES, strict=True)]
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows) + "\n")
    log = read_warned(tmp_path / "run.csv", "times jump by 3600 s")
    np.testing.assert_allclose(log.times, later, atol=1e-9)


def test_a_date_whose_day_may_be_its_month_is_left_out(tmp_path):
    """The fifth of June or the sixth of May; times are the same, and 5/5 is one day."""
    rows = [f"05/06/2024 09:30:{t:.3f} AM,{signal(t):.6f}" for t in TIMES + 10.0]
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows) + "\n")
    log = read_warned(tmp_path / "run.csv", "day or the month .* in 05/06/2024 .* is ambiguous")
    assert log.start == "09:30:10.000"
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows).replace("/06", "/05"))
    assert read_log(tmp_path / "run.csv").start == "2024-05-05T09:30:10"


def test_milliseconds_after_a_colon(tmp_path):
    rows = [f"09:59:{t:.3f},{signal(t):.6f}".replace(".", ":", 1) for t in TIMES + 10.0]
    (tmp_path / "run.csv").write_text("Time,w [mm]\n" + "\n".join(rows) + "\n")
    np.testing.assert_allclose(read_log(tmp_path / "run.csv").times, TIMES, atol=1e-9)


def test_commas_of_thousands_are_no_decimal_ones(tmp_path):
    """2,000 in a cell of a file separated by commas, or of a workbook, is 2 or 2000."""
    path, head = tmp_path / "run.csv", "time [s],w [mm]\n"
    path.write_text(head + '0.0,"2,000"\n0.1,950\n0.2,"-1,250,000"\n')
    with pytest.raises(ValueError, match=r"run.csv, line 2: the comma in '2,000' is a decimal one"):
        read_log(path)
    path.write_text(head + '"0,0","2,000"\n"0,1","950,5"\n')
    np.testing.assert_allclose(read_log(path).values[:, 0], [2e-3, 0.9505])
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["time [s]", "w [mm]"], [0.0, "2,000"], [0.1, "0,5"]):
        book.active.append(row)
    book.save(tmp_path / "run.xlsx")
    np.testing.assert_allclose(read_log(tmp_path / "run.xlsx").values[:, 0], [2e-3, 5e-4])
    book.active["B3"] = "1,500"
    book.save(tmp_path / "run.xlsx")
    with pytest.raises(ValueError, match="line 2: the comma in '2,000' is a decimal one"):
        read_log(tmp_path / "run.xlsx")


def test_a_temperature_called_t_is_no_time(tmp_path):
    """Of a LabVIEW file with a rate; it is sampled once a second, to 1 s."""
    path = tmp_path / "run.tdms"
    tdms(
        path,
        {
            "a": (signal(TIMES), clock()),
            "T": ([20.0, 22.0], clock(step=1.0) | {"unit_string": "degC"}),
        },
    )
    log = read_warned(path, "read from 0 to 1 s, which they have in common")
    assert log.names == ("a",) and log.times[-1] == pytest.approx(1.0)
    assert log.conditions == (("T (degC)", pytest.approx(21.0)),)
    (tmp_path / "run.csv").write_text("T [°C],w [mm]\n20,1\n21,2\n")
    log = read_log(tmp_path / "run.csv", rate=100.0)
    assert log.names == ("w",) and log.times[1] == pytest.approx(0.01)
    (tmp_path / "run.csv").write_text("T [°C],elapsed [sec],w [mm]\n20,0,1\n21,0.5,2\n")
    assert read_log(tmp_path / "run.csv").times[1] == 0.5


def test_dates_of_a_labview_file(tmp_path):
    """A channel of dates, a microsecond rounded, beside one without a clock."""
    dates = np.datetime64("2024-03-31T00:59:50", "us") + (1e6 * TIMES).astype("timedelta64[us]")
    tdms(tmp_path / "run.tdms", {"when": (dates, {}), "w": (signal(TIMES), {})})
    log = read_log(tmp_path / "run.tdms")
    assert log.names == ("w",) and log.start == "2024-03-31T00:59:50.000+00:00"
    np.testing.assert_allclose(log.times, TIMES, atol=1.1e-6)


@pytest.mark.parametrize("rate", [200.0, 51.2])
def test_stamps_of_whole_seconds_are_counted(tmp_path, rate):
    times = np.arange(int(12 * rate)) / rate
    moments = [datetime(2024, 5, 4, 9, 30) + timedelta(seconds=int(t + 0.37)) for t in times]
    cells = stamps_of(moments, "%d.%m.%Y %H:%M:%S")
    rows = [f"{cell};{signal(t):.6f}" for cell, t in zip(cells, times, strict=True)]
    (tmp_path / "run.csv").write_text("Time;w [mm]\n" + "\n".join(rows) + "\n")
    log = read_warned(tmp_path / "run.csv", "stamps of whole seconds: times are those of ")
    # A count of samples in ten seconds is right within one of them.
    np.testing.assert_allclose(log.sample_rate, rate, rtol=1e-12 if rate == 200.0 else 0.1 / rate)


def test_a_column_of_dates_beside_one_of_times(tmp_path):
    cells = stamps_of(NIGHT, "%d.%m.%Y;%H:%M:%S,%f")
    rows = [
        f"{cell};{signal(t):.6f}".replace(".", ",")
        .replace("05,2024", "05.2024")
        .replace(",05.", ".05.")
        for cell, t in zip(cells, TIMES, strict=True)
    ]
    (tmp_path / "run.csv").write_text("Datum;Zeit;w [mm]\n" + "\n".join(rows) + "\n")
    log = read_log(tmp_path / "run.csv")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(TIMES), atol=1e-6)
    assert log.start == "2024-05-04T23:59:59"


@pytest.mark.parametrize("parts", [1, 2])
def test_dates_of_a_workbook_over_midnight(tmp_path, parts):
    """In one column, or dates beside times of day, over midnight."""
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    book.active.append([*("Date", "Time")[-parts:], "w [mm]"])
    for moment, t in zip(NIGHT, TIMES, strict=True):
        day = datetime(moment.year, moment.month, moment.day)
        book.active.append([*([moment] if parts == 1 else [day, moment.time()]), float(signal(t))])
    book.save(tmp_path / "run.xlsx")
    log = read_log(tmp_path / "run.xlsx")
    np.testing.assert_allclose(log.times, TIMES, atol=1e-6)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(TIMES), atol=1e-9)
    assert log.start == "2024-05-04T23:59:59"


def test_days_of_a_workbook_saved_as_numbers(tmp_path):
    rows = [f"{45416 + (10 + t) / 86400:.12f},{signal(t):.6f}" for t in TIMES]
    (tmp_path / "run.csv").write_text("time [d],w [mm]\n" + "\n".join(rows) + "\n")
    log = read_log(tmp_path / "run.csv")
    np.testing.assert_allclose(log.times, TIMES, atol=2e-6)
    assert log.start.startswith(("2024-05-04T00:00:10", "2024-05-04T00:00:09.999"))


@pytest.mark.parametrize("word", ["OVR", "-OL-", "Overload", "#N/A", "-OVR-", "***"])
def test_samples_beyond_the_range_are_missing(tmp_path, word):
    cells = [
        word if i in (0, 57, 58) else f"{signal(t):.6E}".replace("E", "D")
        for i, t in enumerate(TIMES)
    ]
    rows = [f"{t:.3f},{cell}" for t, cell in zip(TIMES, cells, strict=True)]
    (tmp_path / "run.csv").write_text("time [s],w [mm]\n" + "\n".join(rows) + "\n")
    with pytest.raises(
        ValueError, match="run.csv, line 2, column 'w': the cell is empty, or says nan"
    ):
        read_log(tmp_path / "run.csv")
    log = read_log(tmp_path / "run.csv", missing="mask")
    valid = log.valid[:, 0]
    assert np.flatnonzero(~valid).tolist() == [0, 57, 58]
    np.testing.assert_allclose(1e3 * log.values[valid, 0], signal(TIMES[valid]), atol=1e-6)


def test_units_of_amplifiers_and_converters(tmp_path):
    rows = [f"{t:.3f},{signal(t) / 4:.8f},{round(1e5 * signal(t))},21.5" for t in TIMES]
    path = tmp_path / "run.csv"
    path.write_text("time [s],p [mV/V],a [counts],t [Deg C]\n" + "\n".join(rows) + "\n")
    log = read_log(path)
    assert log.names == ("p", "a") and log.conditions == (("t (Deg C)", 21.5),)
    assert log.quantities == ("voltage ratio", "counts")
    path.with_suffix(".toml").write_text(
        '[columns]\np = {unit = "mV/V", sensitivity = "0.25 mV/V/kN"}\n'
        'a = {unit = "counts", sensitivity = "1e5 counts/(m/s^2)"}\n'
    )
    log = read_log(path)
    assert log.quantities == ("force", "acceleration")
    np.testing.assert_allclose(1e-3 * log.values[:, 0], signal(TIMES), atol=1e-7)
    np.testing.assert_allclose(log.values[:, 1], signal(TIMES), atol=6e-6)
    path.with_suffix(".toml").write_text('[columns]\na = {sensitivity = "1e-5 (m/s^2)/count"}\n')
    np.testing.assert_allclose(read_log(path).values[:, -1], signal(TIMES), atol=6e-6)


def test_a_column_without_a_unit_is_no_channel_beside_others(tmp_path):
    rows = [f"{t:.3f},{signal(t):.6f},{i % 2}" for i, t in enumerate(TIMES)]
    (tmp_path / "run.csv").write_text("time [s],w [mm],door\n" + "\n".join(rows) + "\n")
    log = read_warned(tmp_path / "run.csv", "'door' is no channel, having no unit; write it in")
    assert log.names == ("w",) and log.conditions == (("door", 0.5),)


def test_times_of_day_and_dates_go_over_midnight(tmp_path):
    stamps = ["23:59:59.5", "23:59:59.75", "0:00:00.0", "0:00:00.25"]
    seconds = seconds_of(tmp_path, "t", stamps, [1, 2, 3, 4]).seconds
    np.testing.assert_allclose(seconds, [0, 0.25, 0.5, 0.75])
    stamps = ["31.12.2023 23:59:59", "01.01.2024 00:00:01"]
    assert seconds_of(tmp_path, "t", stamps, [1, 2]).seconds == [0.0, 2.0]
    with pytest.raises(ValueError, match="line 2, column 't': '7' is no date and time"):
        seconds_of(tmp_path, "t", ["0:00:01", "7"], [1, 2])
    with pytest.raises(ValueError, match="whether the day or the month comes first"):
        seconds_of(tmp_path, "t", ["1/2/2024 0:00", "2/2/2024 0:00"], [1, 2])
    with pytest.raises(ValueError, match="line 1.*dates and times: "):
        seconds_of(tmp_path, "t", ["31.02.2024 0:00"], [1])


def test_a_file_of_a_campbell_logger(tmp_path):
    rows = [f'"2024-05-14 09:30:{t:06.3f}",{i},{signal(t):.6f},"NAN"' for i, t in enumerate(TIMES)]
    head = '"TOA5","S","CR6","1","OS","P","1","Dyn"\n"TIMESTAMP","RECORD","w","a"\n'
    head += '"TS","RN","mm","m/s^2"\n"","","Smp","Smp"\n'
    (tmp_path / "run.dat").write_text(head + "\n".join(rows) + "\n")
    log = read_log(tmp_path / "run.dat", columns=["w"])
    np.testing.assert_allclose(log.times, TIMES, atol=1e-9)
    np.testing.assert_allclose(1e3 * log.values[:, 0], signal(TIMES), atol=1e-6)


def test_dates_of_a_workbook(tmp_path):
    import datetime

    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    sheet = book.active
    sheet.append(["Zeit", "w [mm]"])
    for i in range(100):
        moment = datetime.datetime(2024, 5, 14, 9, 30) + datetime.timedelta(seconds=0.01 * i)
        sheet.append([moment.time(), signal(0.01 * i)])
    book.save(tmp_path / "run.xlsx")
    log = read_log(tmp_path / "run.xlsx", units={"Zeit": "s"})
    np.testing.assert_allclose(log.times - log.times[0], 0.01 * np.arange(100), atol=1e-6)


def test_every_cut_of_every_format_is_told_or_refused(tmp_path):
    """No cut leaves wrong numbers without a word: what is read is right, and less of it is told."""
    files = {"run.uff": universal_file, "run.csv": lambda p: csv(p, TIMES)}
    files["run.tdms"] = lambda p: tdms(p, {n: (signal(TIMES), clock()) for n in "a"})
    columns = {"t": TIMES, "w": signal(TIMES)}
    files["run.mat"] = lambda p: scipy.io.savemat(p, columns)
    files["compressed.mat"] = lambda p: scipy.io.savemat(p, columns, do_compression=True)
    for name, write in files.items():
        write(tmp_path / name)
        data = (tmp_path / name).read_bytes()
        for end in np.linspace(10, len(data) - 2, 23).astype(int):
            cut = tmp_path / f"cut_{name}"
            cut.write_bytes(data[:end])
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                try:
                    logs = read_logs(cut, units="mm")
                except ValueError as error:
                    assert str(error).startswith(str(cut)) and "\n" not in str(error)
                    continue
            assert caught or name == "run.csv", (name, end)
            for log in logs:
                expected = signal(log.times)[:, None] * np.arange(1, log.values.shape[1] + 1)
                np.testing.assert_allclose(1e3 * log.values, expected, atol=1e-5)


def test_logs_made_in_python_are_not_warned_of():
    log = Log(60 * TIMES, signal(TIMES)[:, None], ("w",), ("deflection",), ("m",))
    assert log.start == ""


# Files of load cases and descriptions of logs that are wrong in kind: one sentence each.

LOAD_CASES = {
    "training = 163315.8": "training must be a table",
    '[training]\n"loads.0.mass" = 5': "training.loads.0.mass must be a list of numbers",
    '[training]\n"loads.0.mass" = [nan]': "training.loads.0.mass must be a list of numbers",
    f'[training]\n"loads.0.mass" = [1{"0" * 400}]': "training.loads.0.mass must be a list",
    f'[training]\n"loads.0.mass" = [1, 2]\ndraws = {"9" * 300}': "training.draws must be a whole",
    '[training]\n"loads.0.mass" = [1, 2]\nseed = -1': "training.seed must be a whole number",
    "[training]\ndraws = 3": "training.draws needs ranges",
    "held_out = [1]": "held_out must be a table",
    f"training = {'[' * 200}{']' * 200}": "nested more than 32 deep",
    f"training = {'[' * 5000}": "not valid TOML",
    "[trainings]": r"there is no table \[trainings\]",
}
DESCRIPTIONS = {
    "runs = 3": "runs must be a table",
    "[runs]\nfast = 5e-324": "runs.fast must be a table",
    "[runs.fast]\nloads = {}": "runs.fast.loads must be a list of tables",
    "columns = [1]": "columns must be a table",
    "[columns]\na = 3": "columns.a: give a unit",
    "[columns.a]\nsensor = 1.5": "columns.a.sensor must be a whole number",
    f"[columns.a]\nposition = {'9' * 400}": "columns.a.position must be a number in m",
    f'[[loads]]\nkind = "mass"\nspeed = 1.0\nmass = {"9" * 400}': "loads.0.mass must be one number",
    "loads = 5": "loads must be a list of tables",
    "time = 3": "time must be a word in quotes",
    "colums = 1": "unknown key colums; did you mean",
}


@pytest.mark.parametrize("text", LOAD_CASES)
def test_faulty_load_cases(tmp_path, text):
    path = tmp_path / "cases.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=LOAD_CASES[text]) as error:
        read_load_cases(path)
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) < 300 + len(str(path))


@pytest.mark.parametrize("text", DESCRIPTIONS)
def test_faulty_description(tmp_path, text):
    path = tmp_path / "log.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=DESCRIPTIONS[text]) as error:
        read_description(tmp_path / "log.csv")
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) < 300 + len(str(path))


def test_load_cases_with_units(tmp_path):
    """In SI units; a unit of another kind, or an address that does not exist, is refused."""
    path, beam = tmp_path / "loads.toml", jb.Beam(25.0, 3e10, 1.5e4)
    case = jb.Case(beam, loads=[jb.MovingForce(force=1e5, speed=20.0)])
    path.write_text('[training]\n"loads.0.speed" = ["36 km/h", "72 km/h"]\n"loads.0.force" = [1]\n')
    runs = read_load_cases(path, case).training
    assert [run["loads.0.speed"] for run in runs] == pytest.approx([10.0, 20.0])
    with pytest.raises(ValueError, match="must be a list of numbers"):
        read_load_cases(path)
    for address, message in (
        ("loads.0.mass", "no number at address 'loads.0.mass'"),
        ("loads.0.force", "training.loads.0.force.0 must be in N"),
    ):
        path.write_text(f'[training]\n"{address}" = ["36 km/h"]\n')
        with pytest.raises(ValueError, match=message):
            read_load_cases(path, case)
