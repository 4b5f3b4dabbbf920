"""Tables at any width, labelled datasets, and views of results of notebooks, pandas and files."""

import csv
import functools
import html
import subprocess
import sys

import hypothesis
import numpy as np
import pytest
import xarray
from hypothesis import strategies

import jaxbeam as jb
import tuning
from jaxbeam.analysis.compare import compare
from jaxbeam.analysis.sections import Envelope
from jaxbeam.cli import main
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.printer import html_table, labelled_dataset, terminal_width, text_table
from jaxbeam.runtime.progress import ProgressBar
from tests.modules import DATA, ROOT
from tuning.control.tuning_result import RunSetResult
from tuning.parameters import FreeParameter

WORDS = strategies.text("abcdef", min_size=1, max_size=12)
CELLS = strategies.lists(WORDS, max_size=5).map(" ".join)
TABLES = strategies.integers(1, 8).flatmap(
    lambda count: strategies.lists(
        strategies.lists(CELLS, min_size=count, max_size=count), min_size=1, max_size=4
    )
)


def test_text_tables_are_aligned_column_by_column():
    rows = [("a", "1.5"), ("longer", "10")]
    assert text_table(("name", "m"), rows) == ["name    m", "a       1.5", "longer  10"]
    assert text_table(("name", "m"), rows, "<>")[1:] == ["a       1.5", "longer   10"]


@hypothesis.given(TABLES, strategies.integers(20, 120))
def test_no_line_is_wider_and_no_word_is_lost(rows, width):
    lines = text_table(rows[0], rows[1:], ">" * len(rows[0]), "  ", width)
    assert all(len(line) <= width for line in lines)
    printed = "".join(lines)
    for letter in "abcdef":  # those of a first column that is repeated are more
        assert printed.count(letter) >= sum(row.count(letter) for row in map("".join, rows))


def test_columns_that_do_not_fit_follow_below_with_the_first():
    rows = [("one", "1.25", "2.5", "3.75"), ("other", "4", "5", "6")]
    lines = text_table(("name", "first (m)", "second (m)", "third (m)"), rows, "<>>>", width=21)
    assert lines == [
        "        first  second",
        "name      (m)     (m)",
        "one      1.25     2.5",
        "other       4       5",
        "",
        "name   third (m)",
        "one         3.75",
        "other          6",
    ]


def test_the_width_is_that_of_the_terminal_or_of_columns(monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert terminal_width() is None  # of a file, or a pipe
    monkeypatch.setenv("COLUMNS", "60")
    assert terminal_width() == 60
    monkeypatch.setattr(sys, "stdout", None)  # of a program without a console
    monkeypatch.delenv("COLUMNS")
    assert terminal_width() is None


COMMANDS = [
    "compare examples/controlled_rig/case.toml",
    "assess examples/railway_bridge/case.toml --line-speed 50",
    "modes examples/railway_bridge/case.toml",
    "simulate examples/railway_bridge/case.toml",
]


@pytest.mark.parametrize("width", [60, 80])
@pytest.mark.parametrize("line", COMMANDS)
def test_tables_of_commands_fit_the_terminal(line, width, capsys, monkeypatch):
    """Lines with two columns or more; terminals wrap sentences."""
    monkeypatch.setenv("COLUMNS", str(width))
    monkeypatch.chdir(ROOT)
    with pytest.raises(SystemExit):
        main(line.split())
    lines = capsys.readouterr().out.splitlines()
    tables = [one for one in lines if "  " in one.strip()]
    assert tables and max(map(len, tables)) <= width


BEAM = jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2)
CASE = jb.Case(
    BEAM,
    actuators=[jb.PointForce(0.3, limits=(-2.0, 2.0))],
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    controller=jb.Feedback(gains=[500.0], period=0.01),
    run=jb.Run(0.3),
)


def decay_modes() -> tuning.ModalFit:
    times = 0.005 * np.arange(1600)
    values = np.exp(-0.3 * times) * np.cos(2 * np.pi * 3.2 * times)
    values = values + 1e-3 * np.random.default_rng(1).normal(size=times.size)
    return tuning.identify_modes(
        tuning.Log(times, values[:, None], ("a1",), ("acceleration",), ("m/s^2",))
    )


def tuned() -> tuning.TuningResult:
    """A result whose numbers are made up, as searches take long."""
    parameter = FreeParameter("controller.gains.0", "N/m", 500.0, 100.0, 5000.0, 500.0)
    peaks = (np.array([1e-3]), np.array([9e-4]), np.array([8e-4]), np.array([np.nan]))
    runs = RunSetResult("held out", ({"loads.0.mass": 0.3},), *peaks, np.zeros(1), [0.9, 0.8])
    values, history = np.array([640.0]), np.zeros((1, 1))
    return tuning.TuningResult(CASE, [parameter], values, tuning.Objective(), history, 0, [runs])


@functools.cache
def fit() -> tuning.Fit:
    return tuning.load_fit(DATA / "release_0_2_0" / "fit.npz")


# A result, one of its columns, and what that has.
RESULTS = {
    "Modes": (
        lambda: jb.modes(CASE),
        "damping ratio",
        lambda found: [0.02, 0.02],
    ),
    "Envelope": (
        lambda: Envelope(*np.array([[-2.0, -3.0], [1.0, 0.0], [0.2, 0.3]]), "moment"),
        "lowest moment (N m)",
        lambda found: found.lowest,
    ),
    "Comparison": (
        lambda: compare(CASE, {"feedback": CASE.controller}),
        "peak (m)",
        lambda found: [found.records["feedback"].peak_deflection.max()],
    ),
    "Assessment": (
        lambda: jb.assess(jb.Case(jb.Beam(25.0, 3e10, 15000.0, damping_ratio=0.01)), "160 km/h"),
        "value",
        lambda found: [np.nan if one.value is None else one.value for one in found.checks],
    ),
    "Fit": (
        fit,
        "standard error",
        lambda found: found.errors,
    ),
    "ModalFit": (
        decay_modes,
        "frequency +- 95 % (Hz)",
        lambda found: [one.quantile * one.frequency_sd for one in found.modes],
    ),
    "TuningResult": (tuned, "after", lambda found: [640.0]),
}


@pytest.mark.parametrize("name", RESULTS)
def test_results_in_notebooks_pandas_and_files(name, tmp_path):
    make, head, expected = RESULTS[name]
    found = make()
    assert type(found).__name__ == name
    columns, frame = found.columns, found.to_dataframe()
    assert [frame.index.name, *frame.columns] == list(columns)
    assert list(frame.index) == list(next(iter(columns.values())))
    np.testing.assert_allclose(np.asarray(columns[head], float), expected(found), rtol=1e-12)
    shown = found._repr_html_()
    assert f"<b>{html.escape(found.headline)}</b></caption>" in shown
    assert all(f">{html.escape(one)}</th>" in shown for one in columns)
    assert shown.count("<tr>") == 1 + len(frame)
    jb.save(found, tmp_path / "found.csv")
    heads, *rows = csv.reader((tmp_path / "found.csv").read_text(encoding="utf-8").splitlines())
    assert heads == list(columns) and len(rows) == len(frame)


def test_a_fit_has_no_dataset(tmp_path):
    with pytest.raises(ValueError, match="a result is written to a .csv file; call it .*fit.csv"):
        jb.save(fit(), tmp_path / "fit.nc")


def test_without_pandas_a_sentence_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pip install pandas; \.columns has the same arrays"):
        jb.modes(CASE).to_dataframe()


def test_traced_and_several_results_are_left_to_their_text():
    import jax

    shown = []

    layout = mesh_layout(CASE)

    def lowest(rigidity):
        found = jb.modes(jb.replace(CASE, {"beam.flexural_rigidity": rigidity}), layout)
        shown.append(found._repr_html_())
        return found.frequencies[0]

    jax.jit(lowest)(12.0)
    assert shown == [None]


def test_long_results_are_shown_in_part():
    found = Envelope(*np.zeros((3, 50)))
    shown = found._repr_html_()
    assert shown.count("<tr>") == 21 + 1 and "... 30 more ..." in shown


def test_classes_of_cells_in_html():
    shown = html_table(("a",), [("x < y",)], cell_class=lambda cell: "wrong")
    assert shown == (
        '<table><thead><tr><th>a</th></tr></thead><tbody><tr><td class="wrong">x &lt; y</td></tr>'
        "</tbody></table>"
    )


def test_units_are_not_broken():
    rows = [("pier", "moment (N m)", "1.0"), ("first span", "deflection (m)", "2.0")]
    for width in (20, 28, 40):
        text = "\n".join(text_table(("sensor", "quantity", "least (N m)"), rows, width=width))
        assert "moment" in text and text.count("(N m)") == 2, text


VARIABLES = {
    "peak": (("speed", "sensor"), np.arange(6.0).reshape(3, 2), {"units": "m"}),
    "count": ("speed", np.arange(3)),
    "unit": ((), 4.0, {"units": "1"}),
    "failed": (("speed",), np.array([True, False, False]), {"long_name": "whether the run failed"}),
}
COORDINATES = {
    "speed": ("speed", np.array([1.0, 3.0, 2.0]), {"units": "m/s"}),
    "sensor": ("sensor", np.array(["midspan", "end"])),
    "position": ("sensor", [0.5, 1.0], {"units": "m"}),
    "place": ("place", np.array(["a", "bc"], object)),
    "mode": ("mode", np.arange(1, 4)),
}


def test_the_dataset_is_that_of_xarray():
    found = labelled_dataset(VARIABLES, COORDINATES, {"title": "a beam"})
    expected = xarray.Dataset(VARIABLES, COORDINATES, {"title": "a beam"})
    xarray.testing.assert_identical(found, expected)
    assert str(found) == str(expected)
    assert {name: one.dtype for name, one in found.variables.items()} == {
        name: one.dtype for name, one in expected.variables.items()
    }
    assert all(
        type(one.to_index()) is type(expected[n].to_index())
        for n, one in found.coords.items()
        if one.ndim
    )
    assert found.sel(speed=2.0, sensor="end").peak == 5.0


def test_no_package_of_other_arrays_is_imported():
    program = (
        "import sys; from jaxbeam.runtime.printer import labelled_dataset;"
        "labelled_dataset({'a': ('x', [1.0])}, {'x': ('x', [2.0]), 'name': ('x', ['b'])});"
        "assert not {'dask', 'pint', 'cupy', 'sparse'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_a_bar_counts_one_thing_in_the_singular(capsys):
    for total, expected in ((None, ("fit: 1 point [", "fit: 2 points [")), (1, ("1/1 point [",))):
        with ProgressBar(total, "point", shown=True, desc="fit", mininterval=0.0) as bar:
            for _ in expected:
                bar.update()
        written = capsys.readouterr().err
        assert all(words in written for words in expected), written
