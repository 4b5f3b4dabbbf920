"""One case to one record."""
