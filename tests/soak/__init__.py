"""Fault injection: kills, damaged files, full disks and invalid input, drawn from a seed (`make soak`)."""
