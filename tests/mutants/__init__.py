"""Whether the tests would notice: small faults put into the product one at a time, by Cosmic Ray (`make mutants`)."""
