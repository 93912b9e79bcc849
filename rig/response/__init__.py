"""The steady response by waiting for it: frequency by frequency, continued up or down, with the type of motion.

Start with `frequency_response`; `motion_type` tells Types I, II and III of the paper apart.
"""
