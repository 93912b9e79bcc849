"""The report: one self-contained HTML page with the answer, interactive charts, the test's settings and warnings."""
