"""Examples of scripts for the rig's instrument; run one with ``python -m daq.examples.finite_read``."""
