"""Types on the pages of the reference are those of the source."""

import pytest


def test_types_of_properties_are_those_of_the_source():
    pytest.importorskip("sphinx")
    from docs._ext.plain_docstrings import plain_type

    both = ": Float[jaxlib._jax.Array, 'time sensor'] | Float[ndarray, 'time sensor']"
    assert plain_type(both) == ": Float[Array, 'time sensor']"
    number = "Bool[jaxlib._jax.Array, ''] | Bool[ndarray, ''] | generic | None"
    assert plain_type(number) == "Bool[Array, ''] | None"
    assert plain_type("list[str]") == "list[str]"
