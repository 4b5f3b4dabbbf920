"""Controllers, one family a file, with the interfaces of `jaxbeam.case.controller`."""
