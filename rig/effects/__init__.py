"""What a scene turns on, what each effect adds in states, and what it costs in time: `rig explain`.

Packages above announce effects of theirs through entry points; none is imported here. Start with `explanation`.
"""
