"""Work-precision study: error against computing time for the engine and alternative methods: `rig cost`.

No other package imports these alternatives and references. Start with `motion_study`; `high_precision` is the
forty-digit reference for the error of every method.
"""
