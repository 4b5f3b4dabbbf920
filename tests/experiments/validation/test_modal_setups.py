"""The table of modes from several setups."""

import numpy as np

from experiments.validation.modal_setups import HEADER, REFERENCES, assess, planted_setups
from tests.oracles.planted_structures import random_structure

SEED = 57  # of a structure of three modes and six channels


def test_setups_share_the_references_and_have_all_channels_together():
    structure = random_structure(SEED)
    setups = planted_setups("decay", SEED)
    assert [len(own) for _, own in setups] == [4, 4]
    channels = [own for _, own in setups]
    assert set().union(*channels) == set(range(structure.shapes.shape[1]))
    assert set.intersection(*map(set, channels)) == set(REFERENCES)
    for planted, own in setups:
        np.testing.assert_array_equal(planted.structure.shapes, structure.shapes[:, own])


def test_a_row_of_the_table():
    row = assess("decay", [SEED])
    assert len(row) == len(HEADER)
    found, strong = (int(word) for word in row[1].split(" of "))
    assert found == strong > 1 and row[6] == "0"
    assert float(row[8]) < 0.2
