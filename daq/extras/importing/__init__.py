"""Import of time histories of real benches, from files of other programs, as recordings; without the simulator.

Start with `import_files`: a file of any format gives `Signal`s, a table assigns them to the channels of the scene.
"""
