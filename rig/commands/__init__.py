"""Command line and calls."""
