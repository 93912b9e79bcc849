"""What the command line shows and writes: tables, figures together, the report page, the demo.

Start with `presentation`.
"""
