"""Studies: the claims of the paper, and the error of the measurement chain."""
