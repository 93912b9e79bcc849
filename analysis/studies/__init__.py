"""Claims of the paper; error of the measuring chain."""
