"""Independent solutions to compare jaxbeam with: numpy and scipy only, nothing from jaxbeam."""
