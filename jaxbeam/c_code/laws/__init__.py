"""C code of the laws, one family a file; each registers its writers with `jaxbeam.c_code.writers`."""
