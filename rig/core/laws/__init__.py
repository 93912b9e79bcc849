"""Contact laws as data: the regimes of an element, its force in each regime, and the events that end a regime.

An *element* is a law at one place, such as the bed of a damper in its cavity. Start with `law`, which defines the
parts of a declaration; every other module declares one kind of element. The engine compiles the declarations into
tables (`rig.core.engine.law_tables`), and does not depend on the kinds of elements.
"""
