"""Chapter 5: optimal control of one span with a shaker."""
