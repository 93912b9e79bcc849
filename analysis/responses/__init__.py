"""From recordings to frequency responses: one estimator for each kind of test.

Start with `frequency_responses`, which chooses it; each estimator is named after its test, `frf` is what all return.
"""
