"""Views of a record: text, tables, labelled datasets, figures and files."""

import abc
import os
from typing import TYPE_CHECKING, Any

import equinox as eqx
from jaxtyping import Float
from numpy import ndarray

from jaxbeam.case.case import Case
from jaxbeam.case.display import TableViews
from jaxbeam.case.fields import is_concrete
from jaxbeam.files.endings import check_ending
from jaxbeam.files.netcdf import write_netcdf
from jaxbeam.files.tables import write_result
from jaxbeam.model.modes import Modes
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.dataset import labelled_dataset
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.whole_file import whole_file
from jaxbeam.simulation.extremes import Extremes
from jaxbeam.simulation.views.dataset import dataset_parts
from jaxbeam.simulation.views.table import record_columns
from jaxbeam.simulation.views.text import record_html, record_text

if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    from matplotlib.figure import Figure, SubFigure


class RecordViews(TableViews, Module):
    """Base of records: what others see of one."""

    case: eqx.AbstractVar[Case]
    modes: eqx.AbstractVar[Modes]
    times: eqx.AbstractVar[Float[Array, " time"]]
    coordinates: eqx.AbstractVar[Float[Array, "time mode"]]
    contact_force: eqx.AbstractVar[Float[Array, "time load"]]
    command: eqx.AbstractVar[Float[Array, "time actuator"]]

    @property
    @abc.abstractmethod
    def bodies(self) -> list[str]:
        """Names of the degrees of freedom of all vehicles."""

    @property
    @abc.abstractmethod
    def verdict(self) -> str:
        """Sentence on the run."""

    @property
    @abc.abstractmethod
    def extremes(self) -> Extremes:
        """Smallest and largest value of each sensor."""

    @property
    @abc.abstractmethod
    def sensor_values(self) -> Float[Array, "time sensor"]:
        """True quantity of each sensor."""

    def __repr__(self) -> str:
        if not self._is_one_known_run:
            return f"Record of {self.case.title!r}, traced or of several runs"
        return record_text(self.case, self.times, self.verdict, self.extremes)

    def _repr_html_(self) -> str | None:  # in notebooks; None leaves it to the text
        if not self._is_one_known_run:
            return None
        return record_html(self.case, self.times, self.verdict, self.extremes)

    @property
    def _is_one_known_run(self) -> bool:
        return is_concrete(self.coordinates) and self.times.ndim == 1

    def _dataset_parts(self) -> tuple[dict, dict, dict]:
        """Variables, coordinates and attributes of the labelled dataset."""
        return dataset_parts(
            self.case, self.modes, self.times, self.bodies, lambda name: getattr(self, name)
        )

    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units; `record_from_xarray` restores the record exactly."""
        return labelled_dataset(*self._dataset_parts())

    def plot(self, quantity: str | None = None, **options: Any) -> "Figure | SubFigure":
        """Figure of the record, or of one quantity of its sensors; see `jaxbeam.plot.plot_record`.

        `options` are its `ax`, `title` and `labels`; it raises as that function does.
        """
        from jaxbeam.plot import plot_record

        return plot_record(self, quantity, **options)

    def plot_envelope(self, quantity: str = "moment", **options: Any) -> "Figure | SubFigure":
        """Figure of the envelope of a quantity; see `jaxbeam.plot.plot_envelope`."""
        from jaxbeam.plot import plot_envelope

        return plot_envelope(self, quantity, **options)

    @property
    def columns(self) -> dict[str, Float[ndarray, " time"]]:
        """Histories by head, as "midspan deflection (m)"; `to_dataframe` has them too."""
        histories = self.sensor_values, self.contact_force, self.command
        return record_columns(self.case, self.times, *histories)

    def save(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write all of the record to .nc or .zarr, or its `columns` to .csv, .xlsx, .mat, .parquet.

        Raises FileExistsError if the file exists, without `overwrite`; ValueError for another
        ending; ImportError, with what to install, if a package is missing (see `jaxbeam.save`).
        """
        check_ending(path, "a record")
        if os.fspath(path).endswith(".nc"):  # without xarray, which takes long to import
            self.to_netcdf(path, overwrite)
        else:
            write_result(path, lambda: self.columns, self.to_xarray, overwrite)

    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists, without `overwrite`.
        """
        with whole_file(path, overwrite) as beside:
            write_netcdf(beside, *self._dataset_parts())
