"""Estimators of the state, one a file, with the interface of `jaxbeam.case.controller`."""
