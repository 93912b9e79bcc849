"""Command line, tables, figures and report page."""
