"""Commands of the command line, one or a few alike in each file."""
