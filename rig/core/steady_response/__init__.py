"""Steady response by time integration, continued upward or downward in frequency, with the type of motion.

Start with `frequency_response`; `motion_type` classifies motions as Type I, II or III of Inoue, Yokomichi and Hiraki
(2011).
"""
