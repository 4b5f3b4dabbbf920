"""The side-by-side comparison with pyOMA-2."""

import numpy as np
import pytest

from experiments.validation.modal_methods import PYOMA, ours, pyoma, table
from tests.oracles.planted_structures import sampled
from tests.tuning.modal.test_subspace import small_structure


@pytest.mark.filterwarnings("ignore")
def test_both_programs_find_the_modes_of_a_structure():
    pytest.importorskip("pyoma2")
    planted = sampled(small_structure(0), "ambient", 0, 100.0)
    found = {PYOMA: [pyoma(planted)], "plscf": [ours(planted, "plscf")]}
    for (one,) in found.values():
        assert np.all(np.abs(one.errors) < [0.01, 0.5])
    result = table([planted], found)
    assert [row[1] for row in result.rows] == ["3 of 3", "3 of 3"]
    assert all(len(row) == len(result.header) for row in result.rows)
