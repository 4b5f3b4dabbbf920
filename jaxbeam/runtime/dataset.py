"""Labelled datasets of NumPy arrays."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import xarray


def labelled_dataset(
    variables: Mapping[str, tuple],
    coordinates: Mapping[str, tuple],
    attributes: Mapping[str, Any] | None = None,
) -> "xarray.Dataset":
    """`xarray.Dataset` of tuples (dimensions, array, attributes), the last of which may be missing.

    The same dataset sooner: told that arrays are NumPy's, xarray does not import dask and pint,
    half a second, to see whether they are theirs.
    """
    import pandas
    import xarray

    def variable(dimensions, values, attributes=None):
        dimensions = (dimensions,) if isinstance(dimensions, str) else tuple(dimensions)
        return xarray.Variable(dimensions, np.asarray(values), attributes, fastpath=True)

    own = {name: variable(*given) for name, given in coordinates.items()}
    indexes = {
        name: xarray.indexes.PandasIndex(
            pandas.Index(one.data, dtype=object if one.dtype == object else None), name, one.dtype
        )
        for name, one in own.items()
        if one.dims == (name,)
    }
    for name, index in indexes.items():
        own |= index.create_variables({name: own[name]})
    return xarray.Dataset(
        {name: variable(*given) for name, given in variables.items()},
        xarray.Coordinates(own, indexes),
        attributes,
    )
