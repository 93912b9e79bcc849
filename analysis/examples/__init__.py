"""The gallery: worked examples, as scripts with cell marks that notebook editors open and the documentation shows."""
