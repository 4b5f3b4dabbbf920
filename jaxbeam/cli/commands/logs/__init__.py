"""Commands on logs without a case."""
