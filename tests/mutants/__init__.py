"""Mutation testing: small faults are put into the product one at a time, by Cosmic Ray (`make mutants`)."""
