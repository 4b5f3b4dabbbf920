"""LabVIEW measurement files, written by the tests after the published format."""

import re

import numpy as np
import pytest

from tuning import read_log
from tuning.logs.log import LogWarning

HEAD = """LabVIEW Measurement
Writer_Version{s}2
Reader_Version{s}2
Separator{s}{separator}
Decimal_Separator{s}{decimal}
Multi_Headings{s}{multi}
X_Columns{s}{clocks}
Time_Pref{s}Absolute
Date{s}2024/03/01
Time{s}23:59:59{decimal}5
***End_of_Header***
{s}
"""
SEGMENT = """Channels{s}2{s}{s}{s}
Samples{s}3{s}3{s}
Date{s}2024/03/01{s}2024/03/01{s}
Time{s}{start}{s}{start}{s}
Y_Unit_Label{s}g{s}mm{s}
X_Dimension{s}Time{s}Time{s}
X0{s}0{decimal}0{s}0{decimal}0{s}
Delta_X{s}0{decimal}001{s}0{decimal}001{s}
***End_of_Header***{s}{s}
"""
ROWS = {
    "One": "X_Value{s}a{s}b{s}Comment\n0{decimal}0000{s}1{decimal}5{s}2\n"
    "0{decimal}0012{s}2{decimal}5{s}3{s}a remark\n0{decimal}0024{s}3{decimal}5{s}4\n",
    "Multi": "X_Value{s}a{s}X_Value{s}b{s}Comment\n0{s}1{decimal}5{s}0{s}2\n"
    "0{decimal}0012{s}2{decimal}5{s}0{decimal}0012{s}3\n"
    "0{decimal}0024{s}3{decimal}5{s}0{decimal}0024{s}4\n",
    "No": "X_Value{s}a{s}b{s}Comment\n{s}1{decimal}5{s}2\n{s}2{decimal}5{s}3\n{s}3{decimal}5{s}4\n",
}


def lvm(clocks="One", separator="Comma", decimal=".", starts=("23:59:59.5",), multi="Yes"):
    """Text of a file with one segment for each start time."""
    fields = {
        "s": "," if separator == "Comma" else "\t",
        "separator": separator,
        "decimal": decimal,
        "clocks": clocks,
        "multi": multi,
    }
    text = HEAD.format(**fields)
    for start in starts:
        date, _, clock = start.rpartition(" ")
        segment = SEGMENT.format(start=clock.replace(".", decimal), **fields)
        text += segment.replace("2024/03/01", date or "2024/03/01")
        text += ROWS[clocks].format(**fields) + "\n"
    return text


def write(folder, text, name="run.lvm"):
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("clocks", ROWS)
@pytest.mark.parametrize(("separator", "decimal"), [("Comma", "."), ("Tab", "."), ("Tab", ",")])
@pytest.mark.parametrize("name", ["run.lvm", "run.txt"])
def test_layouts(tmp_path, clocks, separator, decimal, name):
    log = read_log(write(tmp_path, lvm(clocks, separator, decimal), name))
    step = 0.001 if clocks == "No" else 0.0012  # the printed Delta_X is used only without times
    assert (log.names, log.units) == (("a", "b"), ("g", "mm"))
    np.testing.assert_allclose(log.times, [0, step, 2 * step], rtol=1e-14)
    np.testing.assert_allclose(log.values[:, 0] / 9.80665, [1.5, 2.5, 3.5], rtol=1e-14)
    np.testing.assert_allclose(log.values[:, 1], [2e-3, 3e-3, 4e-3], rtol=1e-14)


def test_segments_follow_their_start_times(tmp_path):
    """The second segment starts one second later, past midnight."""
    text = lvm(starts=("23:59:59.5", "2024/03/02 00:00:00.5"))
    with pytest.warns(LogWarning, match="times jump by 0.9976 s after t = 0.0024 s, line 37"):
        log = read_log(write(tmp_path, text))
    expected = [0, 0.0012, 0.0024, 1, 1.0012, 1.0024]
    np.testing.assert_allclose(log.times, expected, rtol=1e-12)
    with pytest.raises(ValueError, match="not sampled evenly"):
        _ = log.sample_rate


def test_segments_whose_times_continue(tmp_path):
    text = lvm(starts=("23:59:59.5", "23:59:59.5"))
    head, first, second = text.partition("Channels")[0], *text.split("Channels")[1:]
    for old, new in (("0.0024", "0.0060"), ("0.0012", "0.0048"), ("0.0000", "0.0036")):
        second = second.replace(old, new)
    log = read_log(write(tmp_path, f"{head}Channels{first}Channels{second}"))
    np.testing.assert_allclose(log.times, 0.0012 * np.arange(6), rtol=1e-12)


def test_special_blocks_are_passed_over(tmp_path):
    block = "***Start_Special***\nLimits,1,2\n***End_Special***\n"
    text = lvm().replace("Channels,2", f"{block}Channels,2")
    assert read_log(write(tmp_path, text)).values.shape == (3, 2)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("***End_of_Header***", "", "the header has no end"),
        ("2.5", "2.5x", "line 24, column 'a': '2.5x' is no number"),
        ("2.5", "", "line 24, column 'a': the cell is empty"),
        ("0.0012", "0.0000", "line 24: time 0 s is repeated"),
        ("0.0012", "-1", "line 24: time -1 s comes after 0 s"),
        ("Y_Unit_Label,g,", "Y_Unit_Label,,", "column 'a': no unit found"),
        ("Y_Unit_Label,g,", "Y_Unit_Label,lux,", "column 'a': unknown unit 'lux'"),
        ("X_Value,a,b", "Zeit,a,b", "line 22: the column headings must be X_Value"),
        ("LabVIEW Measurement", "Something", "line 1: a LabVIEW measurement file starts with"),
    ],
)
def test_mistakes(tmp_path, old, new, message):
    text = lvm()
    assert old in text
    with pytest.raises(ValueError, match=message):
        read_log(write(tmp_path, text.replace(old, new)))


def test_a_key_without_a_value_counts_as_empty(tmp_path):
    text = lvm("No").replace("Separator,.", "Separator")
    assert "Decimal_Separator\n" in text
    assert len(read_log(write(tmp_path, text)).times) > 1
    with pytest.raises(ValueError, match="nor a Delta_X"):
        read_log(write(tmp_path, re.sub("Delta_X,.*", "Delta_X", text)))


def test_mistakes_between_segments(tmp_path):
    two = lvm(starts=("23:59:59.5", "23:59:59.5"))
    with pytest.raises(ValueError, match="starts before the one of line 23 ends"):
        read_log(write(tmp_path, two))
    head, _, second = two.rpartition("X_Value,a,b")
    with pytest.raises(ValueError, match="this segment has the channels a, c, the first one a, b"):
        read_log(write(tmp_path, f"{head}X_Value,a,c{second}"))
    with pytest.raises(ValueError, match="Time 'noon' do not tell when it started"):
        read_log(write(tmp_path, lvm(starts=("23:59:59.5", "noon"))))
    with pytest.raises(ValueError, match="the log is empty"):
        read_log(write(tmp_path, lvm().partition("0.0000")[0]))


def test_channels_with_their_own_times(tmp_path):
    text = lvm("Multi").replace("0.0012,3", "0.0013,3")
    with pytest.raises(ValueError, match="line 24: the channels have different times"):
        read_log(write(tmp_path, text))
