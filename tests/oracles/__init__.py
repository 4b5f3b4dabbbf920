"""Independent solutions to hold jaxbeam against: numpy and scipy only, nothing from jaxbeam."""
