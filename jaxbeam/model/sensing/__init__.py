"""What sensors measure: rows of quantities, signals, filters and readings."""
