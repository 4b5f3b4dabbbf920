"""Views of results for other libraries."""

import abc
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pandas  # imported where it is used, as it takes half a second


class TableViews:
    """Base of results that have columns of equally many numbers by their heads."""

    @property
    @abc.abstractmethod
    def columns(self) -> dict[str, np.ndarray]:
        """Columns by head, with units, as "frequency (Hz)"."""

    def to_dataframe(self) -> "pandas.DataFrame":
        """Columns as a table of pandas, the first of them as its index."""
        import pandas

        first, *_ = columns = self.columns
        return pandas.DataFrame(dict(columns)).set_index(first)
