"""Benchmark of first answers: rows, goals, and the script it is compared with."""

import numpy as np
import pytest

import jaxbeam as jb
from experiments.benchmarks.first_answer import __main__ as first_answer
from experiments.benchmarks.first_answer.rows import AXLES, ROWS, Row, train


def test_every_row_is_a_command_or_a_call_of_a_valid_case(tmp_path):
    for row in ROWS:
        assert bool(row.command) != bool(row.code), row.name
        compile(f"{row.setup}\n{row.code}", row.name, "exec")
    for i, text in enumerate({row.case for row in ROWS}):
        (tmp_path / f"{i}.toml").write_text(text)
        assert jb.load_case(tmp_path / f"{i}.toml").loads


def test_the_train_has_fifty_axles_in_mirrored_order(tmp_path):
    assert len(AXLES) == 50 and sorted(AXLES) == AXLES
    np.testing.assert_allclose(np.diff(AXLES), np.diff(AXLES)[::-1], rtol=1e-12)
    (tmp_path / "case.toml").write_text(train(4))
    assert len(jb.load_case(tmp_path / "case.toml").loads) == 4


def test_the_script_agrees_with_jaxbeam(tmp_path):
    _, found = first_answer.measure_script(tmp_path)
    assert first_answer.check_script(found) < 1e-8
    wrong = found | {"peaks": [1.00001 * peak for peak in found["peaks"]]}
    with pytest.raises(ValueError, match="differ by 1.0e-05"):
        first_answer.check_script(wrong)


def test_calls_commands_and_errors_are_timed_and_rows_that_follow_find_the_files(tmp_path):
    first = Row("file", 1.0, code="open('mark', 'w').close()")
    second = Row("again", 1.0, code="import os; os.stat('mark')", again=True)
    assert first_answer.groups([first, second, first]) == [[first, second], [first]]
    for seconds in first_answer.measure_rows([first, second], repeat=1):
        assert 0 <= seconds.wall < 1
    refused = Row("refused", 1.0, ("simulate", "{case}", "--plott"), fails=True)
    assert first_answer.measure_row(refused, tmp_path).processor > 0.01
    with pytest.raises(RuntimeError, match="--plott"):
        first_answer.measure_row(refused._replace(fails=False), tmp_path)


def test_a_star_marks_a_goal_missed_beyond_the_import_of_jax():
    jax_import, row = first_answer.Seconds(0.5, 0.4), Row("name", 1.0, beyond_jax=True)
    assert first_answer.table_line(row, first_answer.Seconds(1.4, 3.0), jax_import)[-1] == "+ 1"
    late = first_answer.table_line(row, first_answer.Seconds(1.6, 1.2), jax_import)
    assert late == ("name", "1.60", "1.20", "+ 1 *")
