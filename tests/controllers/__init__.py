"""Unmodified control and acquisition programs of other authors with the virtual instrument; run by hand."""
