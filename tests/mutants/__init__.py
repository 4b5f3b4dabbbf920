"""Test of the tests: changed code (mutants) that they should notice."""
