"""Numbers that the thesis prints, a file for each chapter."""
