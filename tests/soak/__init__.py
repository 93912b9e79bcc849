"""Fault injection: kills, damaged files, full disks and invalid input, from a seed; `make soak` prints the table."""
