"""The report: one self-contained HTML page with a summary, tables, interactive charts, settings and warnings."""
