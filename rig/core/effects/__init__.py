"""Effects that a scene turns on, and the states that they add: `rig explain`.

Packages that build on the rig register their effects through entry points; no such package is imported here. Start with
`explanation`.
"""
