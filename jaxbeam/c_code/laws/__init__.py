"""C code of the laws, one family a file; each registers its writers (`jaxbeam.c_code.writers`)."""
