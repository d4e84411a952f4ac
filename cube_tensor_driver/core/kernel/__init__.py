"""The kernel: one pass over the rows of a scan, in C where it is compiled, else in numpy."""
