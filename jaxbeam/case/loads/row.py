"""Several vehicles of one kind in a row, with one trajectory."""

from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.runtime.arrays import Array, xp


class AbstractRowLoad(AbstractVehicleLoad):
    """`count` vehicles in a row, the first wheels of neighbours `spacing` apart."""

    count: int = fields.count("number of vehicles in a row", default=1, kw_only=True)
    spacing: Float[Array, ""] | None = number(
        "m", "distance from vehicle to vehicle", NOT_NEGATIVE, default=None, kw_only=True
    )

    def row_spacing(self) -> Float[Array, ""] | None:
        """Distance (m) between the first wheels of neighbours; None if it is not given."""
        return self.spacing

    def spacings(self) -> Float[Array, " vehicle"]:
        if self.count == 1:
            return xp.zeros(1)
        return xp.arange(self.count) * self.row_spacing()

    def validate(self, address):
        if self.count > 1 and self.row_spacing() is None:
            return (
                f"{address}.spacing is missing; give the distance in m from vehicle to vehicle of"
                f" the {self.count}"
            )
        return super().validate(address)

    def overlap_error(self, address: str, wheelbase: Float[Array, ""], name: str) -> str | None:
        """Error message if a vehicle of a wheelbase (m) is longer than the spacing, or None."""
        spacing = self.row_spacing()
        if self.count == 1 or not (is_concrete(spacing) and is_concrete(wheelbase)):
            return None
        if concrete(spacing) > concrete(wheelbase):
            return None
        return (
            f"{address}.spacing must exceed the wheelbase of the {name},"
            f" {concrete(wheelbase):g} m; it is {concrete(spacing):g} m: give a larger one"
        )
