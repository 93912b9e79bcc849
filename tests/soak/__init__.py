"""Faults by the hundred, seeded: kills, damage, full disks, odd inputs; `make soak` prints the table."""
