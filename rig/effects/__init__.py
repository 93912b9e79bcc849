"""Effects that a scene turns on, the states they add, and their cost in CPU time: `rig explain`.

Packages that build on the rig register their effects through entry points; none is imported here. Start with
`explanation`.
"""
