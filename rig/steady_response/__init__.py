"""The steady response by waiting for it: frequency by frequency, continued up or down, with the type of motion.

Start with `frequency_response`; `motion_type` classifies motions as Type I, II or III of the paper.
"""
