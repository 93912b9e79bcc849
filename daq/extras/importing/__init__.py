"""Converts time histories of real benches, in other programs' files, to recordings; independent of the simulator.

Start with `import_files`: a file of any format gives `Signal`s, a table assigns them to the channels of the scene.
"""
